"""Overlap of the sessions of a merged result, with its evidence."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from tofuse.arrays import Float64
from tofuse.evaluation.changes import changes
from tofuse.evaluation.cross_view import CrossViewConsistency, compare_views
from tofuse.posegraph.view_store import PosedView
from tofuse.recordings.recording import evenly
from tofuse.registration.prepared_view import PreparedView
from tofuse.results.session_words import MAX_STATED_PROBABILITY
from tofuse.results.types import Reconstruction, SessionChange, SessionPair, SessionRecord

View = PosedView[PreparedView]

# Number of views of each session that are compared with those of the others.
_COMPARED = 60


@dataclass(frozen=True, eq=False)
class Model:
    """One of the models of a result: the main one, or that of a separate component.

    Attributes
    ----------
    poses
        (4, 4) T_world_camera by frame index.
    """

    result: Reconstruction
    poses: dict[int, Float64]

    @classmethod
    def of(cls, result: Reconstruction) -> Model:
        """The main model of a result."""
        frames = zip(result.diagnostics.frames, result.trajectory, strict=True)
        return cls(result, {f.index: T for f, T in frames if np.isfinite(T).all()})

    def views(self, session: SessionRecord, views: Sequence[View]) -> list[View]:
        """Return evenly spaced views of a session that have a pose in this model."""
        mine = [v for v in views if session.has(v.index) and v.index in self.poses]
        return [mine[k] for k in evenly(np.arange(len(mine)), _COMPARED)]

    def links(self, one: SessionRecord, other: SessionRecord) -> set[tuple[int, int]]:
        """Return frame pairs (i < j) of two sessions with accepted registrations."""
        diagnostics = self.result.diagnostics
        ends = [(join.link.i, join.link.j) for join in diagnostics.joins]
        ends += [(loop.i, loop.j) for loop in diagnostics.loops if loop.accepted]
        return {
            (min(i, j), max(i, j))
            for i, j in ends
            if (one.has(i) and other.has(j)) or (one.has(j) and other.has(i))
        }

    def sure(self, one: SessionRecord, other: SessionRecord) -> float | None:
        """Return the probability that the join of two sessions is correct; None if indirect."""
        probabilities = [
            join.probability
            for join in self.result.diagnostics.joins
            if join.probability is not None
            and any(one.has(k) for k in (join.link.i, join.link.j))
            and any(other.has(k) for k in (join.link.i, join.link.j))
        ]
        return min(max(probabilities), MAX_STATED_PROBABILITY) if probabilities else None

    def seen(self, ours: Sequence[View], theirs: Sequence[View]) -> CrossViewConsistency:
        """Return the cross-view consistency between views of two sessions."""
        both = [*ours, *theirs]
        poses = np.array([self.poses[v.index] for v in both]).reshape(-1, 4, 4)
        return compare_views([v.view for v in both], poses, [0] * len(ours) + [1] * len(theirs))


def session_pairs(
    result: Reconstruction,
    records: Sequence[SessionRecord],
    stated: Sequence[Collection[int]],
    views: Sequence[View],
) -> tuple[SessionPair, ...]:
    """Return for each two sessions whether they are in one model, and the evidence of overlap.

    Parameters
    ----------
    result, records
        The merged result, and its sessions.
    stated
        For each session, the components of its frames before the merge.
    views
        Prepared views of frames with a pose.
    """
    apart = [c.result for c in result.components if c.result is not None and not c.connected]
    models = [Model.of(each) for each in (result, *apart)]
    pairs = []
    for a, b in combinations(range(len(records)), 2):
        one, other = records[a], records[b]
        for model in models:
            ours, theirs = model.views(one, views), model.views(other, views)
            if ours and theirs:
                before = bool(set(stated[a]) & set(stated[b]))
                pairs.append(_pair(a, b, one, other, model, ours, theirs, before=before))
                break
        else:
            pairs.append(SessionPair(a, b, joined=False))
    return tuple(pairs)


def _pair(
    a: int,
    b: int,
    one: SessionRecord,
    other: SessionRecord,
    model: Model,
    ours: Sequence[View],
    theirs: Sequence[View],
    *,
    before: bool,
) -> SessionPair:
    """Return the links and the overlap of two sessions in one model."""
    seen = model.seen(ours, theirs)
    overlap = np.isfinite(seen.support_of_views())
    supporting = seen.support()
    return SessionPair(
        a,
        b,
        True,
        before,
        len(model.links(one, other)),
        model.sure(one, other),
        float(min(overlap[: len(ours)].mean(), overlap[len(ours) :].mean())),
        float(supporting) if np.isfinite(supporting) else None,
    )


def session_changes(
    result: Reconstruction, records: Sequence[SessionRecord], views: Sequence[View]
) -> tuple[SessionChange, ...]:
    """Detect changes of the scene between each two sessions in the main model.

    Parameters
    ----------
    views
        Prepared views of frames with a pose.
    """
    model = Model.of(result)
    mine = [model.views(record, views) for record in records]
    found = []
    for a, b in combinations(range(len(records)), 2):
        both = [
            ([v.view for v in some], np.array([model.poses[v.index] for v in some]))
            for some in (mine[a], mine[b])
        ]
        found += [SessionChange(a, b, change) for change in changes(*both[0], *both[1])]
    return tuple(found)
