"""The back end: from tracked frames in one coordinate frame to a reconstruction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.color import with_color
from tofuse.engine.compute import trim_memory
from tofuse.engine.fusion import Cloud, Model
from tofuse.engine.graph import (
    LoopRecord,
    Measured,
    Optimisation,
    PoseGraph,
    certificate,
    external_sensors,
    graph_covariances,
)
from tofuse.engine.loops import ClosedLoop, Join, PriorLoop, revisits
from tofuse.engine.mapping.assessment import Assessment
from tofuse.engine.mapping.color_frames import ColorFrames
from tofuse.engine.mapping.config import Config
from tofuse.engine.mapping.frame_log import FrameLog
from tofuse.engine.mapping.observations import Observations
from tofuse.engine.mapping.tracked_graph import Optimised, Refined, TrackedGraph, VisualEvidence
from tofuse.engine.progress import Progress
from tofuse.engine.refinement import Joint
from tofuse.engine.results import Component, Diagnostics, Reconstruction
from tofuse.engine.stopwatch import current, timing

# Maximum size of a certificate's factor, in numbers: a few per cent of a run.
_MAX_CERTIFIED = 3_000_000
# Maximum number of repeated loop searches along a long trajectory.
_MAX_SEARCHES = 2


@dataclass(frozen=True, eq=False)
class Job:
    """What all parts of a recording have in common.

    Attributes
    ----------
    config
        The configuration.
    observations
        Stored observations.
    prior_loops
        Given loops.
    progress
        Receives stages.
    colors
        Colour at its full resolution, if it is to be used.
    """

    config: Config
    observations: Observations
    prior_loops: Sequence[PriorLoop]
    progress: Progress
    colors: ColorFrames | None = None


class BackEnd:
    """Closes loops, optimises, refines, fuses and judges one connected part of a recording.

    Parameters
    ----------
    job
        The recording.
    log
        The frames of the part.
    poses
        (4, 4) T_world_camera by frame index; that of the first frame is the identity.
    joins
        Edges between components.
    """

    def __init__(
        self, job: Job, log: FrameLog, poses: dict[int, Float64], joins: Sequence[Join]
    ) -> None:
        self._config, self._log, self._prior_loops = job.config, log, job.prior_loops
        self._observations, self._progress = job.observations, job.progress
        self._colors = job.colors
        posed = [e for e in log.posed if e.record.index in poses]
        self._tracked = TrackedGraph(posed, poses, joins)

    def run(self, components: tuple[Component, ...]) -> Reconstruction:
        """Return the reconstruction."""
        closed = self._close_loops()
        trim_memory()
        closed, refined = self._refine(closed)
        trim_memory()
        model, cloud_before = self._fuse(closed, refined)
        trim_memory()
        return self._result(closed, refined, model, cloud_before, components)

    @timing("loops")
    def _close_loops(self) -> Optimised:
        self._progress.stage("closing loops")
        tracked = self._tracked.build(())
        # For the search, assume that motion in degenerate directions may differ from the rest.
        degenerate = bool(self._tracked.unobservable)
        conservative = self._tracked.build((), conservative=True) if degenerate else tracked
        sensors = external_sensors.SensorPriors()
        if self._config.priors:
            sensors = external_sensors.measure_all(self._config.priors, *self._measured(tracked))
            steps = self._tracked.steps_at_degenerate(sensors)
            conservative = conservative.with_edges(sensors.doubted(steps))
        detected = self._observations.loops.finish(self._tracked.poses, _covariances(conservative))
        loops = with_joins(detected, self._tracked.joins)
        del conservative
        loops = self._repeat_loop_search(loops)
        graph = self._tracked.build(loops)
        # Poses before loop closure, without and with external sensors.
        sequential = aided = graph.poses
        optimisation = Optimisation(external_sensors.with_sensors(graph, sensors), (), True)
        confirmed: frozenset[int] = frozenset()
        if graph.loop.any() or sensors:
            self._progress.stage("optimising")
            with timing("optimisation"):
                optimisation, confirmed = self._optimise(graph, loops, sensors)
                if sensors and graph.loop.any():  # loops are compared with these poses
                    without_loops = external_sensors.with_sensors(tracked, sensors)
                    aided = self._config.optimiser.optimise(without_loops).graph.poses
            loops = _without_rejected(loops, optimisation)
            optimisation = graph_covariances.accepted_only(optimisation)
        graph = optimisation.graph
        visual = VisualEvidence(aided, optimisation)
        if sensors:
            # Loops and registrations are checked by the images alone.
            images_only = self._tracked.build(loops, confirmed=confirmed).with_poses(graph.poses)
            visual = VisualEvidence(aided, replace(optimisation, graph=images_only))
        return Optimised(loops, sequential, optimisation, sensors, visual, confirmed)

    def _optimise(
        self, graph: PoseGraph, loops: Sequence[ClosedLoop], sensors: external_sensors.SensorPriors
    ) -> tuple[Optimisation, frozenset[int]]:
        """Optimise a graph with loops; repeat if neighbouring views become inconsistent.

        Registrations between such views then get their usual uncertainty (`degraded_neighbours`).
        Also returns the frames of these registrations.
        """
        row_of = {int(index): k for k, index in enumerate(graph.ids)}
        suspects = frozenset(
            e.record.index
            for e in self._tracked.posed
            if e.step is not None and e.step.inflation > 1
        )
        confirmed: frozenset[int] = frozenset()
        while True:
            optimisation = self._config.optimiser.optimise(
                external_sensors.with_sensors(graph, sensors)
            )
            views = self._observations.views.of(row_of) if suspects else []
            rows = [row_of[v.index] for v in views]
            before, after = graph.poses[rows], optimisation.graph.poses[rows]
            worse_pairs = revisits.degraded_neighbours(views, before, after, suspects)
            cleared = suspects.intersection(k for i, j in worse_pairs for k in range(i + 1, j + 1))
            if not cleared:
                return optimisation, confirmed
            confirmed, suspects = confirmed | cleared, suspects - cleared
            graph = self._tracked.build(loops, confirmed=confirmed)

    def _repeat_loop_search(self, loops: list[ClosedLoop]) -> list[ClosedLoop]:
        """Search loops again after the detected ones have corrected the poses in between.

        Along a long trajectory the drift exceeds the search range of loops; the poses in its middle
        are corrected only after its ends are joined.
        """
        for _ in range(_MAX_SEARCHES if self._observations.loops.is_long else 0):
            graph = self._tracked.build(loops)
            if not graph.loop.any():
                break
            graph = graph_covariances.accepted_only(self._config.optimiser.optimise(graph)).graph
            poses = dict(zip(graph.ids.tolist(), graph.poses, strict=True))
            if not self._observations.loops.candidates_change(poses):
                break
            detected = self._observations.loops.finish(poses, _covariances(graph))
            loops = with_joins(detected, self._tracked.joins)
        return loops

    @timing("refinement")
    def _refine(self, closed: Optimised) -> tuple[Optimised, Refined]:
        """Refine all poses; with odometry, the refined pairs and its steps are optimised again.

        As pairs of one view share its errors, their number says little of their accuracy. The
        pairs also show how odometry's errors grow over longer times than tracking does.
        """
        graph = closed.optimisation.graph
        self._progress.stage("refining")
        # Elsewhere images alone: their errors are estimated from the result.
        steps = self._tracked.steps_at_degenerate(closed.sensors)
        images = replace(closed.sensors, steps=steps, witness=closed.sensors.steps)
        refinement = self._observations.refiner.finish(graph, images)
        if refinement.kept:
            graph = self._tracked.build(closed.loops, refinement, confirmed=closed.confirmed)
            sensors = closed.sensors
            if sensors.steps:
                optimisation = self._config.optimiser.optimise(graph)
                graph = graph_covariances.accepted_only(optimisation).graph
                sensors = external_sensors.with_depth_scale(
                    sensors, *self._measured(graph, refinement.non_overlap_edges)
                )
                closed = replace(closed, sensors=sensors)
            graph = external_sensors.with_sensors(graph, sensors)
            if sensors.steps:
                graph = self._config.optimiser.optimise(graph).graph
        graph, edges = self._with_color(graph)
        return closed, Refined(graph, refinement, edges)

    @timing("colour")
    def _with_color(self, graph: PoseGraph) -> tuple[PoseGraph, tuple[Measured, ...]]:
        """Return the graph with the motions that colour images measure, and these edges."""
        depths, refinement = self._observations.color_depths, self._config.refinement
        wanted = isinstance(refinement, Joint) and refinement.color
        if self._colors is None or not depths or not wanted:
            return graph, ()
        self._progress.stage("comparing colour images")
        return with_color(graph, self._colors.views(graph, depths), self._config.optimiser)

    def _measured(
        self, graph: PoseGraph, non_overlap_edges: Sequence[tuple[int, int]] = ()
    ) -> tuple[external_sensors.SensorData, PoseGraph]:
        """Return what external sensors measure of a graph, and what its registrations do."""
        sensed = self._log.sensor_data(graph.ids.tolist())
        return sensed, self._tracked.measured(graph, self._observations.views, non_overlap_edges)

    @timing("fusion")
    def _fuse(self, closed: Optimised, refined: Refined) -> tuple[Model, Cloud | None]:
        """Return the model, and a cloud at the poses before optimisation if that changed any."""
        graph, refinement, model = refined.graph, refined.refinement, self._observations.model
        poses_changed = bool(graph.loop.any() or refinement.kept or closed.sensors or refined.color)
        self._progress.stage("fusing", model.views)
        ids = graph.ids.tolist()
        fused = model.fuse(
            dict(zip(ids, graph.poses, strict=True)),
            self._progress.advance,
            refinement.errors,
            refinement.pattern,
        )
        limit, count = self._config.fusion.faces, len(fused.mesh.faces) if fused.mesh else 0
        if 0 < limit < count:
            self._progress.note(f"{limit} triangles (faces) leave no surface: it has {count}")
        initial_poses = dict(zip(ids, closed.sequential, strict=True))
        return fused, model.sketch(initial_poses) if poses_changed and model.surface else None

    @timing("checking")
    def _result(
        self,
        closed: Optimised,
        refined: Refined,
        model: Model,
        cloud_before: Cloud | None,
        components: tuple[Component, ...],
    ) -> Reconstruction:
        self._progress.stage("checking")
        assessment = Assessment(
            self._config, self._log, self._tracked, self._observations, self._prior_loops
        )
        assessed = assessment.run(closed, refined, model, components)
        model, entries, watch = assessed.model, self._log.entries, current()
        return Reconstruction(
            trajectory=self._scatter(refined.graph.poses),
            timestamps=np.array([e.record.timestamp for e in entries]),
            graph=refined.graph,
            cloud=model.cloud,
            mesh=model.mesh,
            diagnostics=Diagnostics(
                verdict=assessed.verdict,
                reasons=assessed.reasons,
                frames=assessed.records,
                loops=tuple(c.record for c in closed.loops),
                sequential=self._scatter(closed.sequential),
                objective=closed.optimisation.objective,
                removed={},
                seconds=watch.seconds,
                cpu_seconds=watch.cpu_seconds,
                cloud_before=cloud_before,
                refinement=refined.refinement,
                parts=closed.optimisation.parts,
                certified=_certified(refined.graph),
                priors=closed.sensors.records,
                accuracy=assessed.accuracy,
                joins=tuple(self._tracked.joins),
            ),
            config=self._config.to_dict(),
            recording={"path": None, "format": "frames", "frames": len(entries)},
            seed=0,
            threads=1,
            components=components,
            up=closed.sensors.up(refined.graph),
        )

    def _scatter(self, poses: Float64) -> Float64:
        out = np.full((len(self._log.entries), 4, 4), np.nan)
        out[[e.record.index in self._tracked.poses for e in self._log.entries]] = poses
        return out


def _covariances(graph: PoseGraph) -> dict[int, Float64]:
    """Return the (6, 6) covariance of each pose by frame index."""
    return dict(
        zip(graph.ids.tolist(), graph_covariances.GraphCovariances(graph).of_poses, strict=True)
    )


def with_joins(loops: Sequence[ClosedLoop], joins: Sequence[Join]) -> list[ClosedLoop]:
    """Return the loops and the redundant joins of components, which close loops as well."""
    closed_pairs = {(c.record.i, c.record.j) for c in loops}
    redundant = []
    for join in joins:
        link = join.link
        if join.defines_pose or {(link.i, link.j), (link.j, link.i)} & closed_pairs:
            continue
        reason = f"joins components, {link.how}"
        record = LoopRecord.of((link.i, link.j), True, reason, link.registration)
        redundant.append(ClosedLoop.of(record, link.registration))
    return [*loops, *redundant]


@timing("optimisation")
def _certified(graph: PoseGraph) -> certificate.Certificate | None:
    """Return the certificate of the final poses, if it certifies anything."""
    if len(graph.edges) < len(graph.ids):
        return None  # a tree has no other solution
    certified = certificate.certify(graph, _MAX_CERTIFIED)
    return certified if certified and certified.text else None


def _without_rejected(loops: Sequence[ClosedLoop], optimisation: Optimisation) -> list[ClosedLoop]:
    """Return the loops; those that the optimiser left out as contradictory are rejected."""
    if optimisation.weights is None:
        return list(loops)
    weights = iter(optimisation.weights[optimisation.graph.loop])
    out = []
    for loop in loops:
        if loop.T_i_j is not None and next(weights) < graph_covariances.MIN_WEIGHT:
            reason = f"contradicts the rest of the graph ({loop.record.reason})"
            loop = ClosedLoop(replace(loop.record, accepted=False, reason=reason))
        out.append(loop)
    return out
