"""Overlap of the sessions of a merged result, with its evidence."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.frames import evenly_spaced
from tofuse.engine.quality import changes, cross_view_agreement
from tofuse.engine.quantities import MAX_PROBABILITY
from tofuse.engine.results import Reconstruction, SessionChange, SessionPair, SessionRecord
from tofuse.engine.stored_views import PosedView
from tofuse.engine.views import PreparedView

View = PosedView[PreparedView]

# Maximum number of views of each session for the comparison with others.
_COMPARED = 60


@dataclass(frozen=True, eq=False)
class SessionModel:
    """One of the models of a result: the main one, or that of a separate component.

    Attributes
    ----------
    poses
        (4, 4) T_world_camera by frame index.
    """

    result: Reconstruction
    poses: dict[int, Float64]

    @classmethod
    def of(cls, result: Reconstruction) -> SessionModel:
        """The main model of a result."""
        frames = zip(result.diagnostics.frames, result.trajectory, strict=True)
        return cls(result, {f.index: T for f, T in frames if np.isfinite(T).all()})

    def views(self, session: SessionRecord, views: Sequence[View]) -> list[View]:
        """Return evenly spaced views of a session that have a pose in this model."""
        members = [v for v in views if session.has(v.index) and v.index in self.poses]
        return evenly_spaced(members, _COMPARED)

    def posed(self, views: Sequence[View]) -> tuple[list[PreparedView], Float64]:
        """Return prepared views and their poses (N, 4, 4)."""
        poses = np.array([self.poses[v.index] for v in views]).reshape(-1, 4, 4)
        return [v.view for v in views], poses


def session_pairs(
    result: Reconstruction,
    records: Sequence[SessionRecord],
    components_before: Sequence[Collection[int]],
    views: Sequence[View],
) -> tuple[SessionPair, ...]:
    """Return for each pair of sessions whether they are in one model, and the evidence of overlap.

    Parameters
    ----------
    result, records
        The merged result, and its sessions.
    components_before
        For each session, the components of its frames before the merge.
    views
        Prepared views of frames with a pose.
    """
    separate = [c.result for c in result.components if c.result is not None and not c.connected]
    models = [SessionModel.of(each) for each in (result, *separate)]
    return tuple(
        _pair(a, b, records, models, components_before, views)
        for a, b in combinations(range(len(records)), 2)
    )


def _pair(
    a: int,
    b: int,
    records: Sequence[SessionRecord],
    models: Sequence[SessionModel],
    components_before: Sequence[Collection[int]],
    views: Sequence[View],
) -> SessionPair:
    """Return the links and the overlap of two sessions in the model that has views of both."""
    first, second = records[a], records[b]
    for model in models:
        views_a, views_b = model.views(first, views), model.views(second, views)
        if not views_a or not views_b:
            continue
        session_of = [0] * len(views_a) + [1] * len(views_b)
        posed = model.posed([*views_a, *views_b])
        cross_view = cross_view_agreement.compare_views(*posed, session_of)
        overlap = np.isfinite(cross_view.support_of_views())
        support = cross_view.support()
        return SessionPair(
            a,
            b,
            True,
            bool(set(components_before[a]) & set(components_before[b])),
            *_links(model.result, first, second),
            float(min(overlap[: len(views_a)].mean(), overlap[len(views_a) :].mean())),
            float(support) if np.isfinite(support) else None,
        )
    return SessionPair(a, b, joined=False)


def _links(
    result: Reconstruction, first: SessionRecord, second: SessionRecord
) -> tuple[int, float | None]:
    """Return the number of frame pairs of two sessions with accepted registrations.

    Also the probability that the join of the sessions is correct; None if it is indirect.
    """

    def between(i: int, j: int) -> bool:
        return (first.has(i) and second.has(j)) or (first.has(j) and second.has(i))

    d = result.diagnostics
    joins = [join for join in d.joins if between(join.link.i, join.link.j)]
    ends = [(join.link.i, join.link.j) for join in joins]
    ends += [(loop.i, loop.j) for loop in d.loops if loop.accepted and between(loop.i, loop.j)]
    probabilities = [join.probability for join in joins if join.probability is not None]
    probability = min(max(probabilities, default=0.0), MAX_PROBABILITY)
    return len(set(map(frozenset, ends))), probability if probabilities else None


def session_changes(
    result: Reconstruction, records: Sequence[SessionRecord], views: Sequence[View]
) -> tuple[SessionChange, ...]:
    """Detect changes of the scene between each pair of sessions in the main model.

    Parameters
    ----------
    views
        Prepared views of frames with a pose.
    """
    model = SessionModel.of(result)
    views_of = [model.views(record, views) for record in records]
    detected = []
    for a, b in combinations(range(len(records)), 2):
        found = changes(*model.posed(views_of[a]), *model.posed(views_of[b]))
        detected += [SessionChange(a, b, change) for change in found]
    return tuple(detected)
