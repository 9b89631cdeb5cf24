"""Joint alignment of more views than fit into memory: in submaps, and by a graph of their pairs.

Views are divided into submaps by the place that they show, so that all visits of a place are in
one submap. Each is refined separately (`refine`), together with overlapping views of its
neighbours. The measurements of all pairs then make one sparse graph of all views, whose least
squares are those of all pairs, linearised at the result of each submap. If the support between the
views of a submap falls, their relative poses are left unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.geometry import se3
from tofuse.engine.graph import PoseGraph, levenberg
from tofuse.engine.refinement.joint_alignment import (
    Priors,
    Refined,
    RefinedViews,
    Support,
    refine,
    spread_evenly,
    support_fell,
    support_of,
    weak_prior,
)
from tofuse.engine.stored_views import (
    HasCoarseView,
    SampledView,
    overlaps,
    pair_equations,
    world_centroids,
)
from tofuse.engine.stored_views import pair_equation_kernels as kernels

A = TypeVar("A")

# Largest number of neighbouring views in a submap, as a fraction of its core views.
_BORDER = 0.25


@dataclass(frozen=True, eq=False)
class Submap:
    """Views that are refined together.

    Attributes
    ----------
    views
        (N,) positions of its core views and of neighbouring ones, ascending.
    pairs
        (M, 2) positions i < j of the views, among all, that are compared in this submap.
    """

    views: Intp
    pairs: Intp


def partition(places: Float64, max_size: int) -> Intp:
    """(N,) part of each of the places (N, 3), with at most `max_size` places in each part.

    By recursive bisection, as evenly as possible, across the longest axis.
    """
    label = np.zeros(len(places), np.intp)
    count = 0

    def split(rows: Intp, parts: int) -> None:
        nonlocal count
        if parts == 1:
            label[rows] = count
            count += 1
            return
        centred = places[rows] - places[rows].mean(0)
        axis = np.linalg.eigh(centred.T @ centred)[1][:, -1]
        axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
        order = rows[np.argsort(centred @ axis, kind="stable")]
        first_parts = parts // 2
        middle = len(rows) * first_parts // parts
        split(np.sort(order[:middle]), first_parts)
        split(np.sort(order[middle:]), parts - first_parts)

    split(np.arange(len(places)), max(1, -(-len(places) // max_size)))
    return label


def submaps(places: Float64, pairs: Intp, max_size: int) -> list[Submap]:
    """Divide views of places (N, 3), which overlap in pairs (M, 2), into submaps.

    A pair is compared in the submap of its later view, if the other view belongs to it or is among
    the neighbouring views with most pairs in it.
    """
    label = partition(places, max_size)
    result = []
    for part in range(label.max() + 1):
        of_later_view = label[pairs[:, 1]] == part
        of_both_views = of_later_view & (label[pairs[:, 0]] == part)
        outside, pair_counts = np.unique(
            pairs[of_later_view & ~of_both_views, 0], return_counts=True
        )
        core = np.flatnonzero(label == part)
        border = outside[np.argsort(-pair_counts, kind="stable")[: int(_BORDER * len(core))]]
        kept = of_both_views | (of_later_view & np.isin(pairs[:, 0], border))
        result.append(Submap(np.union1d(core, border), pairs[kept]))
    return result


def refine_submaps(
    coarse: Sequence[HasCoarseView],
    poses: Float64,
    options: pair_equations.RefineOptions,
    max_size: int,
    load: Callable[[Intp], list[SampledView]],
    priors: Callable[[Intp | None], Priors],
    evaluate: Callable[[RefinedViews], A],
    calibrate: Sequence[int],
) -> tuple[Refined, list[A]]:
    """Refine all views submap by submap, see `refine`; also returns `evaluate` of each submap.

    Parameters
    ----------
    coarse
        Of the N views.
    poses
        (N, 4, 4) initial T_world_camera; the first stays.
    options
        As for `refine`.
    max_size
        Largest number of views of a submap, without those of its neighbours.
    load
        Returns views by their positions; called for one submap at a time.
    priors
        Returns the priors on views by their positions, None for all.
    evaluate
        Called with each refined submap.
    calibrate
        Errors of the camera to estimate: separately in each submap; the result is their median.
    """
    pairs = spread_evenly(overlaps(coarse, poses, options.overlap)[0], options.neighbours)
    parts = [s for s in submaps(world_centroids(coarse, poses), pairs, max_size) if len(s.pairs)]

    def refined_alone(part: Submap) -> tuple[Refined, A]:
        views, start, known = load(part.views), poses[part.views], priors(part.views)
        start = se3.inverse(start[0]) @ start
        local = np.searchsorted(part.views, part.pairs)
        refined = refine(views, start, options, calibrate=calibrate, priors=known, pairs=local)
        evaluation = evaluate(RefinedViews(views, refined, options, known, calibrate))
        return _or_unchanged(refined, start), evaluation

    results = [refined_alone(part) for part in parts]  # one submap's views in memory at a time
    refined_submaps = [(part, refined) for part, (refined, _) in zip(parts, results, strict=True)]
    if not refined_submaps:
        empty = np.zeros(0)
        no_support = Support(empty.astype(np.intp), empty.astype(np.intp), empty, empty)
        measured = np.zeros((0, 4, 4)), np.zeros((0, 6, 6))
        errors = np.zeros(kernels.ERRORS)
        no_scales = _combined_scales([])
        unmoved = Refined(
            poses, poses, errors, pairs, (), no_support, no_support, *measured, no_scales
        )
        return unmoved, []
    errors = np.median([r.errors for _, r in refined_submaps], axis=0)
    compared = np.concatenate([part.pairs for part, _ in refined_submaps])
    T_i_j = np.concatenate([r.measured for _, r in refined_submaps])
    information = np.concatenate([r.information for _, r in refined_submaps])
    optimised = _optimised_poses(poses, compared, T_i_j, information, priors(None))
    after = [
        support_of(load(part.views), optimised[part.views], refined, options)
        for part, refined in refined_submaps
    ]
    combined = Refined(
        optimised,
        poses,
        errors,
        compared,
        max((r.moved for _, r in refined_submaps), key=len, default=()),
        _combined_support([(part, r.before) for part, r in refined_submaps]),
        _combined_support([(part, s) for (part, _), s in zip(refined_submaps, after, strict=True)]),
        T_i_j,
        information,
        _combined_scales([(part, r.scales) for part, r in refined_submaps]),
    )
    return combined, [evaluation for _, evaluation in results]


def _or_unchanged(refined: Refined, start: Float64) -> Refined:
    """The result of a submap; its initial poses if the support of its views fell."""
    n = len(start)
    if not support_fell(refined.after.of_views(n) - refined.before.of_views(n)):
        return refined
    i, j = refined.pairs.T
    T_i_j = se3.inverse(start[i]) @ start[j]
    return Refined(
        start, start, np.zeros_like(refined.errors), refined.pairs, refined.moved, refined.before,
        refined.before, T_i_j, refined.information, refined.scales, refined.shared,
    )  # fmt: skip


def _optimised_poses(
    poses: Float64, pairs: Intp, measured: Float64, information: Float64, priors: Priors
) -> Float64:
    """Least-squares poses (N, 4, 4) of all pairs; the first stays."""
    previous = np.arange(len(poses) - 1)
    steps = np.stack([previous, previous + 1], 1)
    # Parts of the path that no pair connects keep their relative pose.
    weak, _ = weak_prior(len(steps))
    edges = np.concatenate([pairs, priors.pairs, steps])
    graph = PoseGraph(
        ids=np.arange(len(poses)),
        poses=poses,
        edges=edges,
        measurements=np.concatenate(
            [measured, priors.measured, se3.inverse(poses[:-1]) @ poses[1:]]
        ),
        information=np.concatenate([information, priors.information, weak]),
        loop=np.zeros(len(edges), bool),
        gravity=priors.gravity,
    )
    return levenberg.LevenbergMarquardt().optimise(graph).graph.poses


def _combined_support(supports: Sequence[tuple[Submap, Support]]) -> Support:
    """The support of all submaps, by positions among all views."""
    return Support(
        np.concatenate([part.views[s.target] for part, s in supports]),
        np.concatenate([part.views[s.source] for part, s in supports]),
        np.concatenate([s.score for _, s in supports]),
        np.concatenate([s.terms for _, s in supports]),
    )


def _combined_scales(
    scales: Sequence[tuple[Submap, pair_equations.KnownScales]],
) -> pair_equations.KnownScales:
    """The scales of all submaps, by positions among all views."""
    none = np.zeros(0, np.intp)
    return pair_equations.KnownScales(
        np.concatenate([none, *(part.views[s.target] for part, s in scales)]),
        np.concatenate([none, *(part.views[s.source] for part, s in scales)]),
        np.concatenate([np.zeros((0, 3)), *(s.scales for _, s in scales)]),
    )
