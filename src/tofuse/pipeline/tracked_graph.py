"""The pose graph of one connected part of a recording, from its registrations, joins and loops."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tofuse.arrays import Float64
from tofuse.odometry.prediction import Prediction, degenerate_runs, with_prediction
from tofuse.pipeline.frame_log import Entry
from tofuse.posegraph.accuracy import degenerate_directions, without_degenerate
from tofuse.posegraph.build import Measured, build_graph
from tofuse.posegraph.graph import PoseGraph
from tofuse.posegraph.loops import ClosedLoop
from tofuse.posegraph.merged_components import Join
from tofuse.posegraph.refinement import Refinement
from tofuse.posegraph.view_store import ViewStore
from tofuse.registration.prepared_view import PreparedView


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
        refined: Refinement | None = None,
        *,
        confirmed: Collection[int] = (),
        cautious: bool = False,
    ) -> PoseGraph:
        """Return the pose graph as tracked and joined, or with the edges of the refinement.

        Parameters
        ----------
        loops
            Closed loops to include.
        refined
            Replaces poses and edges of the views that it refined.
        confirmed
            Frames whose registrations get their uncertainty without `Step.inflation`.
        cautious
            Whether the error of predicted motion grows at the largest rate (`at_worst`).
        """
        ids = [e.record.index for e in self.posed]
        tracked = np.array([self.poses[index] for index in ids])
        poses = tracked if refined is None else refined.poses
        refined_edges = () if refined is None else refined.edges
        replaced = {index for edge in refined_edges for index in (edge.i, edge.j)}
        place = {index: k for k, index in enumerate(ids)}
        unobservable = [e.record.unobservable for e in self.posed]
        run = degenerate_runs(unobservable)
        prediction = Prediction.of(tracked, unobservable) if run.any() else None
        if prediction is not None and cautious:
            prediction = prediction.at_worst()
        times = {e.record.index: e.record.timestamp for e in self.posed}
        interval = float(np.median(np.diff(list(times.values())))) if len(times) > 1 else 0.0
        sequence = []
        for entry in self.posed:
            step, index = entry.step, entry.record.index
            if step is None or step.reference is None or step.registration is None:
                continue
            if {step.reference, index} <= replaced:
                continue
            r = step.registration
            # Over longer intervals than usual the prediction error grows with the time squared.
            frames = abs(place[index] - place[step.reference])
            elapsed = abs(times[index] - times[step.reference])
            longer = max(elapsed / (frames * interval), 1.0) if frames and interval > 0 else 1.0
            information = r.information
            if index in confirmed:
                information = information * step.inflation**2
            if prediction is not None:
                sigma = prediction.error(int(run[place[index]]), frames)
                predicted = (sigma[0] * longer**2, sigma[1] * longer**2)
                information = with_prediction(information, r.unobservable, predicted)
            sequence.append(Measured(step.reference, index, r.T_target_source, information))
        needed = [
            Measured(j.link.i, j.link.j, j.link.T_i_j, j.link.information)
            for j in self.joins
            if j.needed and not {j.link.i, j.link.j} <= replaced
        ]
        closing = [
            Measured(c.record.i, c.record.j, c.T_i_j, c.information)
            for c in loops
            if c.T_i_j is not None and c.information is not None
        ]
        return build_graph(ids, poses, [*sequence, *needed, *refined_edges], closing)

    def measured(
        self,
        graph: PoseGraph,
        views: ViewStore[PreparedView],
        stated: Sequence[tuple[int, int]] = (),
    ) -> PoseGraph:
        """Return a graph without edges and directions that are extrapolated motion only.

        Parameters
        ----------
        graph
            As built.
        views
            Prepared views of frames.
        stated
            See `degenerate_directions`.
        """
        own = {
            (e.step.reference, e.record.index)
            for e in self.posed
            if e.step is not None and e.step.reference is not None
        }
        stored = {v.index: v for v in views.of(self.poses)}
        directions = degenerate_directions(graph, self.unobservable, own, stored, frozenset(stated))
        return without_degenerate(graph, directions, self.gaps)

    @property
    def gaps(self) -> set[tuple[int, int]]:
        """The frames before and after the gaps that no registration closes."""
        return {(j.link.i, j.link.j) for j in self.joins if j.how != "links"}
