"""The pose graph of one connected part of a recording, from its registrations, joins and loops."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.geometry import se3
from tofuse.engine.graph import Measured, Optimisation, PoseGraph, build_graph, external_sensors
from tofuse.engine.loops import ClosedLoop, Join
from tofuse.engine.mapping.frame_log import Entry
from tofuse.engine.quality import pose_accuracy
from tofuse.engine.refinement import Refinement
from tofuse.engine.results import FrameRecord
from tofuse.engine.stored_views import ViewStore
from tofuse.engine.tracking import motion_prediction
from tofuse.engine.views import PreparedView


@dataclass(frozen=True, eq=False)
class TrackedGraph:
    """Builds pose graphs of the frames of one connected part.

    Attributes
    ----------
    posed
        The frames of the part, in order.
    poses
        (4, 4) T_world_camera by frame index, as tracked and joined.
    joins
        Edges between components.
    """

    posed: Sequence[Entry]
    poses: Mapping[int, Float64]
    joins: Sequence[Join]

    @cached_property
    def unobservable(self) -> dict[int, Float64]:
        """The degenerate directions (K, 6) of frames that have any, by index."""
        return {
            e.record.index: e.record.unobservable for e in self.posed if len(e.record.unobservable)
        }

    def build(
        self,
        loops: Sequence[ClosedLoop],
        refinement: Refinement | None = None,
        *,
        confirmed: Collection[int] = (),
        conservative: bool = False,
    ) -> PoseGraph:
        """Return the pose graph as tracked and joined, or with the edges of the refinement.

        Parameters
        ----------
        loops
            Closed loops to include.
        refinement
            Replaces the poses and edges of the refined views.
        confirmed
            Frames whose registrations get their uncertainty without `Step.inflation`.
        conservative
            Whether the error of predicted motion grows at the maximum rate (`with_max_growth`).
        """
        ids = [e.record.index for e in self.posed]
        tracked = np.array([self.poses[index] for index in ids])
        poses = tracked if refinement is None else refinement.poses
        refined_edges = () if refinement is None else refinement.edges
        refined = {index for edge in refined_edges for index in (edge.i, edge.j)}
        predicted = _PredictedMotion([e.record for e in self.posed], tracked, conservative)
        sequential_edges = [
            edge
            for entry in self.posed
            if not (entry.step and {entry.step.reference, entry.record.index} <= refined)
            and (edge := _sequential_edge(entry, predicted, confirmed)) is not None
        ]
        join_edges = [
            Measured(j.link.i, j.link.j, j.link.T_i_j, j.link.information)
            for j in self.joins
            if j.defines_pose and not {j.link.i, j.link.j} <= refined
        ]
        loop_edges = [
            Measured(c.record.i, c.record.j, c.T_i_j, c.information)
            for c in loops
            if c.T_i_j is not None and c.information is not None
        ]
        return build_graph(ids, poses, [*sequential_edges, *join_edges, *refined_edges], loop_edges)

    def measured(
        self,
        graph: PoseGraph,
        views: ViewStore[PreparedView],
        non_overlap_edges: Sequence[tuple[int, int]] = (),
    ) -> PoseGraph:
        """Return a graph without edges and directions that rest on extrapolated motion alone.

        Parameters
        ----------
        graph
            A graph from `build`.
        views
            Prepared views of frames.
        non_overlap_edges
            See `degenerate_directions`.
        """
        tracked_pairs = {
            (e.step.reference, e.record.index)
            for e in self.posed
            if e.step is not None and e.step.reference is not None
        }
        view_by_index = {v.index: v for v in views.of(self.poses)}
        directions = pose_accuracy.degenerate_directions(
            graph, self.unobservable, tracked_pairs, view_by_index, frozenset(non_overlap_edges)
        )
        return pose_accuracy.without_degenerate(graph, directions, self.gaps)

    def steps_at_degenerate(self, sensors: external_sensors.SensorPriors) -> tuple[Measured, ...]:
        """Return the odometry steps from and to degenerate frames, and over gaps."""
        ends, gaps = self.unobservable.keys(), self.gaps
        return tuple(s for s in sensors.steps if s.i in ends or s.j in ends or (s.i, s.j) in gaps)

    def steps_at_unbounded(
        self, graph: PoseGraph, unbounded: Collection[int]
    ) -> tuple[Measured, ...]:
        """Return the steps to and from unbounded frames of a graph that lie between bounded ones.

        They are known as far as cameras move evenly (`steps_between_bounded`), unless measurements
        about these frames contradict each other: then later frames may be off as well.
        """
        if not unbounded:
            return ()
        position = {int(index): k for k, index in enumerate(graph.ids)}
        records = [e.record for e in self.posed if e.record.index in position]
        indices = np.array([r.index for r in records], np.intp)
        poses = graph.poses[[position[r.index] for r in records]]
        bounded = ~np.isin(indices, list(unbounded))
        times = np.diff([r.timestamp for r in records])
        interval = float(np.median(times)) if len(times) else 0.0
        if interval <= 0:
            return ()
        found = motion_prediction.steps_between_bounded(
            poses, [r.unobservable for r in records], bounded, np.maximum(times / interval, 1.0)
        )
        run_of = np.cumsum(bounded, dtype=np.intp)
        contradicted = pose_accuracy.contradicted_runs(graph, indices[~bounded], run_of[~bounded])
        steps = []
        for k, covariance in found:
            i, j = records[k - 1].index, records[k].index
            run = int(run_of[k]) - int(bounded[k])  # the step after a run belongs to it
            if run not in contradicted and (i, j) not in self.gaps:
                T_i_j = se3.inverse(poses[k - 1]) @ poses[k]
                information = np.asarray(np.linalg.inv(covariance), np.float64)
                steps.append(Measured(i, j, T_i_j, information))
        return tuple(steps)

    @property
    def gaps(self) -> set[tuple[int, int]]:
        """The frames before and after the gaps that no registration closes."""
        return {(j.link.i, j.link.j) for j in self.joins if j.kind != "links"}


@dataclass(frozen=True, eq=False)
class _PredictedMotion:
    """What the prediction alone says about the motion between two of consecutive frames.

    `conservative` is that of `TrackedGraph.build`.
    """

    records: Sequence[FrameRecord]
    poses: Float64
    conservative: bool

    @cached_property
    def _error_model(self) -> motion_prediction.Prediction:
        model = motion_prediction.Prediction.of(self.poses, [r.unobservable for r in self.records])
        return model.with_max_growth() if self.conservative else model

    @cached_property
    def _positions(self) -> dict[int, int]:
        return {r.index: k for k, r in enumerate(self.records)}

    @cached_property
    def _degenerate_runs(self) -> Intp:
        return motion_prediction.degenerate_runs([r.unobservable for r in self.records])

    @cached_property
    def _interval(self) -> float:
        return float(np.median(np.diff([r.timestamp for r in self.records])))

    def sigma(self, i: int, j: int) -> tuple[float, float]:
        """Return sigma (m, rad) of the motion from frame i to frame j along a degenerate axis."""
        first, last = self._positions[i], self._positions[j]
        frames = abs(last - first)
        m, rad = self._error_model.error(int(self._degenerate_runs[last]), frames)
        # It grows with the square of the elapsed time.
        elapsed = abs(self.records[last].timestamp - self.records[first].timestamp)
        usual = frames * self._interval
        ratio = max(elapsed / usual, 1.0) if usual > 0 else 1.0
        return m * ratio**2, rad * ratio**2


def _sequential_edge(
    entry: Entry, predicted: _PredictedMotion, confirmed: Collection[int]
) -> Measured | None:
    """Return the edge by which a frame was tracked; None if it was not registered."""
    step, index = entry.step, entry.record.index
    if step is None or step.reference is None or step.registration is None:
        return None
    r = step.registration
    information = r.information * (step.inflation**2 if index in confirmed else 1.0)
    if len(r.unobservable):
        sigma = predicted.sigma(step.reference, index)
        information = motion_prediction.with_prediction(information, r.unobservable, sigma)
    return Measured(step.reference, index, r.T_target_source, information)


@dataclass(frozen=True, eq=False)
class VisualEvidence:
    """The evidence of the images alone: a graph without external sensors.

    `sequential` are the poses before loop closure, with external sensors.
    """

    sequential: Float64
    optimisation: Optimisation


@dataclass(frozen=True, eq=False)
class Optimised:
    """The result of closing loops and optimising.

    `confirmed` are frames whose registrations fit unusually badly, but are confirmed by the loops.
    """

    loops: list[ClosedLoop]
    sequential: Float64
    optimisation: Optimisation
    sensors: external_sensors.SensorPriors
    visual: VisualEvidence
    confirmed: frozenset[int]


@dataclass(frozen=True, eq=False)
class Refined:
    """The result of refining all views, with the edges of the graph that colour images measure."""

    graph: PoseGraph
    refinement: Refinement
    color: tuple[Measured, ...] = ()
