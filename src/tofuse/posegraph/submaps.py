"""Refinement of more views than fit into memory: in submaps, and by a graph of what they measured.

Views are cut into submaps by where they look, so that visits of one place are in one submap however
far apart in time. Each is refined in itself (`refine`), together with those views of its neighbours
that it overlaps with. What every pair measured then makes one sparse graph of all views: its least
squares are those of all pairs at once, about where each submap has them. A submap whose views come
to support each other less says that they stay as they were to each other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from tofuse.arrays import Float64, Intp
from tofuse.geometry import se3
from tofuse.kernels import refinement as kernels
from tofuse.kernels.executors import executor
from tofuse.posegraph.graph import PoseGraph
from tofuse.posegraph.levenberg import LevenbergMarquardt
from tofuse.posegraph.refine import (
    UNITS,
    Beside,
    Refined,
    RefineOptions,
    Support,
    chosen,
    refine,
    support_of,
)
from tofuse.posegraph.views import KeptView, Outlined, looked_at, overlaps

A = TypeVar("A")

# Views of its neighbours that a submap takes in, at most, as a share of its own.
_BORDER = 0.25
# How firmly a view is held beside the one before it where nothing else holds it.
_HELD = 1e-3


@dataclass(frozen=True, eq=False)
class Submap:
    """Views that are refined together.

    Attributes
    ----------
    views
        (N,) positions of its own views and of those of its neighbours, ascending.
    pairs
        (M, 2) positions i < j of the views, among all, that are compared here.
    """

    views: Intp
    pairs: Intp


@dataclass(frozen=True, eq=False)
class InSubmap:
    """One submap as it was refined: its views, where they are among all, and what was found."""

    views: Sequence[KeptView]
    at: Intp
    refined: Refined
    beside: Beside


def cut(middles: Float64, most: int) -> Intp:
    """(N,) number of the part that each of the places (N, 3) is in, of at most `most` places each.

    Halves, or as near to it as numbers allow, across the longest axis, again and again.
    """
    label = np.zeros(len(middles), np.intp)
    count = 0

    def split(rows: Intp, parts: int) -> None:
        nonlocal count
        if parts == 1:
            label[rows] = count
            count += 1
            return
        centred = middles[rows] - middles[rows].mean(0)
        axis = np.linalg.eigh(centred.T @ centred)[1][:, -1]
        axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
        order = rows[np.argsort(centred @ axis, kind="stable")]
        first = parts // 2
        at = len(rows) * first // parts
        split(np.sort(order[:at]), first)
        split(np.sort(order[at:]), parts - first)

    split(np.arange(len(middles)), max(1, -(-len(middles) // most)))
    return label


def submaps(middles: Float64, pairs: Intp, most: int) -> list[Submap]:
    """Cut views that look at places (N, 3), and overlap in pairs (M, 2), into submaps.

    A pair is compared in the submap of one of its views: that of the later one, as far as the other
    one is among those that most pairs of that submap ask for.
    """
    label = cut(middles, most)
    found = []
    for part in range(label.max() + 1):
        mine = label[pairs[:, 1]] == part
        inside = mine & (label[pairs[:, 0]] == part)
        asked, times = np.unique(pairs[mine & ~inside, 0], return_counts=True)
        own = np.flatnonzero(label == part)
        border = asked[np.argsort(-times, kind="stable")[: int(_BORDER * len(own))]]
        kept = inside | (mine & np.isin(pairs[:, 0], border))
        found.append(Submap(np.union1d(own, border), pairs[kept]))
    return found


def refine_submaps(
    outlines: Sequence[Outlined],
    poses: Float64,
    options: RefineOptions,
    most: int,
    load: Callable[[Intp], list[KeptView]],
    beside: Callable[[Intp | None], Beside],
    ask: Callable[[InSubmap], A],
    calibrate: Sequence[int] = (),
) -> tuple[Refined, list[A]]:
    """Refine all views, submap by submap; see `refine`. Returns also what each one answered.

    Parameters
    ----------
    outlines
        Of the N views.
    poses
        (N, 4, 4) T_world_camera to start from; the first stays.
    most
        Views of a submap, without those of its neighbours.
    load
        Gives views by their positions. Those of one submap are asked for at a time.
    beside
        Gives what is known beside them of views by their positions, None for all.
    ask
        Is asked about each submap once it was refined, maybe in another process.
    calibrate
        Errors of the camera that are estimated: in each submap by itself, and the median counts.
    """
    pairs = chosen(overlaps(outlines, poses, options.overlap)[0], options.neighbours)
    parts = [s for s in submaps(looked_at(outlines, poses), pairs, most) if len(s.pairs)]

    def arguments(k: int) -> tuple[Any, ...]:
        # The views go before those of the next submap come.
        part = parts[k]
        return (
            load(part.views),
            part,
            poses[part.views],
            options,
            calibrate,
            beside(part.views),
            ask,
        )

    made = executor().map(_refined_alone, len(parts), arguments, large=True)
    found = [(part, refined) for part, (refined, _) in zip(parts, made, strict=True)]
    if not found:
        none = np.zeros(0)
        nobody = Support(none.astype(np.intp), none.astype(np.intp), none, none)
        measured = np.zeros((0, 4, 4)), np.zeros((0, 6, 6))
        errors = np.zeros(kernels.ERRORS)
        still = Refined(poses, errors, pairs, (), nobody, nobody, *measured, np.zeros((0, 3)))
        return still, []
    errors = np.median([r.errors for _, r in found], axis=0)
    asked = np.concatenate([part.pairs for part, _ in found])
    T_i_j = np.concatenate([r.measured for _, r in found])
    information = np.concatenate([r.information for _, r in found])
    solved = _solved(poses, asked, T_i_j, information, beside(None))
    after = [
        support_of(load(part.views), solved[part.views], refined, options)
        for part, refined in found
    ]
    whole = Refined(
        solved,
        errors,
        asked,
        max((r.moved for _, r in found), key=len, default=()),
        _all([(part, r.before) for part, r in found]),
        _all([(part, s) for (part, _), s in zip(found, after, strict=True)]),
        T_i_j,
        information,
        np.concatenate([r.scales for _, r in found]),
    )
    return whole, [answer for _, answer in made]


def fell(gained: Float64) -> bool:
    """Whether the support of views (N,) fell on average by more than chance explains."""
    error = float(gained.std(ddof=1)) / np.sqrt(len(gained))
    return float(gained.mean()) < -error


def _refined_alone(
    views: Sequence[KeptView],
    part: Submap,
    poses: Float64,
    options: RefineOptions,
    calibrate: Sequence[int],
    beside: Beside,
    ask: Callable[[InSubmap], A],
) -> tuple[Refined, A]:
    """One submap by itself, from its views' poses (N, 4, 4), and what it answers."""
    local = np.searchsorted(part.views, part.pairs)
    start = se3.inverse(poses[0]) @ poses
    refined = refine(views, start, options, calibrate=calibrate, beside=beside, pairs=local)
    answer = ask(InSubmap(views, part.views, refined, beside))
    return _believed(refined, start), answer


def _believed(refined: Refined, start: Float64) -> Refined:
    """What a submap says; where its views agree no better for it, that they stay as they were."""
    n = len(start)
    if not fell(refined.after.of_views(n) - refined.before.of_views(n)):
        return refined
    i, j = refined.pairs.T
    stays = se3.inverse(start[i]) @ start[j]
    return Refined(
        start, np.zeros_like(refined.errors), refined.pairs, refined.moved, refined.before,
        refined.before, stays, refined.information, refined.scales,
    )  # fmt: skip


def _solved(
    poses: Float64, pairs: Intp, measured: Float64, information: Float64, beside: Beside
) -> Float64:
    """Poses (N, 4, 4) at which all pairs together are satisfied best; the first stays."""
    before = np.arange(len(poses) - 1)
    held = np.stack([before, before + 1], 1)
    # Hardly anything: where no pair joins two parts of the path, they stay as they were.
    weak = np.tile(np.diag(_HELD / UNITS**2), (len(held), 1, 1))
    edges = np.concatenate([pairs, beside.pairs, held])
    graph = PoseGraph(
        ids=np.arange(len(poses)),
        poses=poses,
        edges=edges,
        measurements=np.concatenate(
            [measured, beside.measured, se3.inverse(poses[:-1]) @ poses[1:]]
        ),
        information=np.concatenate([information, beside.information, weak]),
        loop=np.zeros(len(edges), bool),
        gravity=beside.gravity,
    )
    return LevenbergMarquardt().optimise(graph).graph.poses


def _all(supports: Sequence[tuple[Submap, Support]]) -> Support:
    """The support of all submaps, by positions among all views."""
    return Support(
        np.concatenate([part.views[s.target] for part, s in supports]),
        np.concatenate([part.views[s.source] for part, s in supports]),
        np.concatenate([s.good for _, s in supports]),
        np.concatenate([s.terms for _, s in supports]),
    )
