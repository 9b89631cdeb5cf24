"""The back end: from tracked frames in one coordinate frame to a reconstruction."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from tofuse.arrays import Float64, Intp
from tofuse.corrections.camera_errors import CameraErrors
from tofuse.evaluation.cross_view import CrossViewConsistency, cross_view_consistency
from tofuse.evaluation.trajectory import displacement
from tofuse.files.memory import give_back
from tofuse.fusion.cloud import Cloud
from tofuse.fusion.model import Model, ModelBuilder
from tofuse.fusion.pose_errors import with_pose_errors
from tofuse.normal import OF_95_PERCENT
from tofuse.odometry.given import GivenPoses
from tofuse.odometry.prediction import Prediction, degenerate_runs, with_prediction
from tofuse.parts import name_of
from tofuse.pipeline.checkpoint import Stages
from tofuse.pipeline.checks import Evidence, judge
from tofuse.pipeline.config import Config
from tofuse.pipeline.frame_log import FrameLog
from tofuse.pipeline.progress import Progress, Stopwatch
from tofuse.posegraph.accuracy import (
    Accuracy,
    Shown,
    accuracy_of,
    covariances_of,
    degenerate_directions,
    without_degenerate,
)
from tofuse.posegraph.build import Measured, build_graph
from tofuse.posegraph.calibration_check import CalibrationCheck
from tofuse.posegraph.covariances import (
    MIN_WEIGHT,
    GraphCovariances,
    accepted_only,
)
from tofuse.posegraph.cut_edges import cut_edges
from tofuse.posegraph.external_sensors import SensorPriors, measure_all, with_sensors
from tofuse.posegraph.graph import LoopRecord, Optimisation, PoseGraph
from tofuse.posegraph.joining import Join
from tofuse.posegraph.loops import ClosedLoop, GivenLoop, Loops
from tofuse.posegraph.neighbour_check import worse_neighbours
from tofuse.posegraph.refinement import Refinement, Refiner
from tofuse.posegraph.view_store import ViewStore
from tofuse.recordings.frames import RangeFrame
from tofuse.registration.prepared_view import PreparedView
from tofuse.results.types import Component, Diagnostics, FrameRecord, Reason, Reconstruction
from tofuse.results.verdict import ranked

# Maximum number of repeated loop searches along a long trajectory.
_MAX_SEARCHES = 2

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class VisualEvidence:
    """The evidence of the images alone: a graph without external sensors.

    `sequential` are the poses before loops closed, with external sensors.
    """

    sequential: Float64
    optimisation: Optimisation


@dataclass(frozen=True, eq=False)
class Optimised:
    """The result of closing loops and optimising.

    `confirmed` are frames whose registrations fit unusually but that the loops show to be right.
    """

    loops: list[ClosedLoop]
    sequential: Float64
    optimisation: Optimisation
    sensors: SensorPriors
    visual: VisualEvidence
    confirmed: frozenset[int]


@dataclass(frozen=True, eq=False)
class Refined:
    """The result of refining all views."""

    graph: PoseGraph
    refinement: Refinement


@dataclass(frozen=True, eq=False)
class Fused:
    """The model, and a cloud at the poses before they were optimised; None if none moved."""

    model: Model
    before: Cloud | None


@dataclass(frozen=True, eq=False)
class BackEndInput:
    """Stored observations of all frames.

    Attributes
    ----------
    loops
        The loop detector, which received every frame.
    refiner
        The refinement, which received every frame.
    model
        Stored views of the model.
    checks
        Images that are compared with each other at the final poses.
    depths
        Typical radial range of each posed frame, m, by index.
    ambiguity_m
        Ambiguity range of the camera, if known.
    knows_errors
        Whether covariances of registrations are realistic; those of ICP are too small.
    views
        Prepared views, spaced by motion.
    """

    loops: Loops
    refiner: Refiner
    model: ModelBuilder
    checks: Sequence[RangeFrame]
    depths: dict[int, float]
    ambiguity_m: float | None
    knows_errors: bool
    views: ViewStore[PreparedView]


class BackEnd:
    """Closes loops, optimises, refines, fuses and judges one connected part of a recording.

    Parameters
    ----------
    config
        The configuration.
    log
        The frames of the part.
    poses
        (4, 4) T_world_camera by frame index, the identity first.
    joins
        Edges between components.
    given
        Given loops.
    kept
        Stored observations.
    progress, watch
        Receive stages and times.
    """

    def __init__(
        self,
        config: Config,
        log: FrameLog,
        poses: dict[int, Float64],
        joins: Sequence[Join],
        given: Sequence[GivenLoop],
        kept: BackEndInput,
        progress: Progress,
        watch: Stopwatch,
    ) -> None:
        self._config, self._log, self._poses, self._joins = config, log, poses, joins
        self._given, self._kept, self._progress, self._watch = given, kept, progress, watch
        self._posed = [e for e in log.posed if e.record.index in poses]
        self._tracks = not isinstance(config.odometry, GivenPoses)
        self._unobservable = {
            e.record.index: e.record.unobservable for e in self._posed if len(e.record.unobservable)
        }

    def run(self, stages: Stages, components: tuple[Component, ...]) -> Reconstruction:
        """Return the reconstruction; `stages` stores the result of each step."""
        closed = self._staged(stages, "loops", self._close_loops)
        refined = self._staged(stages, "refinement", lambda: self._refine(closed))
        fused = self._staged(stages, "fusion", lambda: self._fuse(closed, refined))
        return self._judge(closed, refined, fused, components)

    def _staged(self, stages: Stages, name: str, work: Callable[[], T]) -> T:
        """Return the result of a stage, stored by an interrupted job or computed now."""
        stored = stages.load(name)
        if stored is not None:
            result: T = stored[0]
            self._watch.seconds.update(stored[1])
            return result
        result = work()
        with self._watch.timing("keeping"):
            stages.save(name, (result, dict(self._watch.seconds)))
        give_back()
        return result

    def _close_loops(self) -> Optimised:
        self._progress.stage("closing loops")
        with self._watch.timing("loops"):
            tracked = self.graph(())
            # For the search, motion in degenerate directions may differ from that elsewhere.
            cautious = self.graph((), cautious=True) if self._unobservable else tracked
            covariances = dict(
                zip(cautious.ids.tolist(), GraphCovariances(cautious).of_poses, strict=True)
            )
            loops = with_joins(self._kept.loops.finish(self._poses, covariances), self._joins)
            loops = self._search_loops_again(loops)
            graph = self.graph(loops)
        # Without loops: with and without external sensors.
        sequential = guided = graph.poses
        sensors = SensorPriors()
        if self._config.priors:
            sensed = self._log.sensed(graph.ids.tolist())
            sensors = measure_all(self._config.priors, sensed, self._measured(tracked))
        optimisation = Optimisation(with_sensors(graph, sensors), (), True)
        confirmed: frozenset[int] = frozenset()
        if graph.loop.any() or sensors:
            self._progress.stage("optimising")
            with self._watch.timing("optimisation"):
                optimisation, confirmed = self._optimise(graph, loops, sensors)
                if sensors and graph.loop.any():  # the poses that loops are compared with
                    without_loops = with_sensors(tracked, sensors)
                    guided = self._config.optimiser.optimise(without_loops).graph.poses
            loops = _without_rejected(loops, optimisation)
            optimisation = accepted_only(optimisation)
        graph = optimisation.graph
        visual = VisualEvidence(guided, optimisation)
        if sensors:
            # The verdict rests on the images alone: external sensors can't improve it.
            images_only = self.graph(loops, confirmed=confirmed).with_poses(graph.poses)
            visual = VisualEvidence(guided, replace(optimisation, graph=images_only))
        return Optimised(loops, sequential, optimisation, sensors, visual, confirmed)

    def _optimise(
        self, graph: PoseGraph, loops: Sequence[ClosedLoop], sensors: SensorPriors
    ) -> tuple[Optimisation, frozenset[int]]:
        """Optimise a graph with loops; again if neighbouring views no longer agree.

        The registrations between those get their usual uncertainty: see `worse_neighbours`.
        Returns the frames of these registrations as well.
        """
        row = {int(index): k for k, index in enumerate(graph.ids)}
        suspects = frozenset(
            e.record.index for e in self._posed if e.step is not None and e.step.inflation > 1
        )
        confirmed: frozenset[int] = frozenset()
        while True:
            optimisation = self._config.optimiser.optimise(with_sensors(graph, sensors))
            views = self._kept.views.of(row) if suspects else []
            at = [row[v.index] for v in views]
            before, after = graph.poses[at], optimisation.graph.poses[at]
            worse = worse_neighbours(views, before, after, suspects)
            right = suspects.intersection(k for i, j in worse for k in range(i + 1, j + 1))
            if not right:
                return optimisation, confirmed
            confirmed, suspects = confirmed | right, suspects - right
            graph = self.graph(loops, confirmed=confirmed)

    def _search_loops_again(self, loops: list[ClosedLoop]) -> list[ClosedLoop]:
        """Search loops again once those found have corrected the poses in between.

        Along a long trajectory the drift exceeds the search range of loops; its middle is right
        once the ends are joined.
        """
        for _ in range(_MAX_SEARCHES if self._kept.loops.many else 0):
            graph = self.graph(loops)
            if not graph.loop.any():
                break
            graph = accepted_only(self._config.optimiser.optimise(graph)).graph
            poses = dict(zip(graph.ids.tolist(), graph.poses, strict=True))
            if not self._kept.loops.candidates_change(poses):
                break
            covariances = dict(
                zip(graph.ids.tolist(), GraphCovariances(graph).of_poses, strict=True)
            )
            loops = with_joins(self._kept.loops.finish(poses, covariances), self._joins)
        return loops

    def _refine(self, closed: Optimised) -> Refined:
        graph = closed.optimisation.graph
        self._progress.stage("refining")
        with self._watch.timing("refinement"):
            refinement = self._kept.refiner.finish(graph.ids.tolist(), graph.poses, closed.sensors)
            if refinement.kept:
                graph = self.graph(closed.loops, refinement, confirmed=closed.confirmed)
                graph = with_sensors(graph, closed.sensors)
        return Refined(graph, refinement)

    def _fuse(self, closed: Optimised, refined: Refined) -> Fused:
        graph, refinement, model = refined.graph, refined.refinement, self._kept.model
        moved = bool(graph.loop.any()) or refinement.kept or bool(closed.sensors)
        self._progress.stage("fusing", model.views)
        with self._watch.timing("fusion"):
            ids = graph.ids.tolist()
            fused = model.fuse(
                dict(zip(ids, graph.poses, strict=True)),
                self._progress.advance,
                refinement.errors,
            )
            started = dict(zip(ids, closed.sequential, strict=True))
            return Fused(fused, model.sketch(started) if moved else None)

    def _judge(
        self,
        closed: Optimised,
        refined: Refined,
        fused: Fused,
        components: tuple[Component, ...],
    ) -> Reconstruction:
        optimisation, graph, model = closed.optimisation, refined.graph, fused.model
        log, kept = self._log, self._kept
        self._progress.stage("checking")
        loops = tuple(c.record for c in closed.loops)
        with self._watch.timing("checking"):
            cross_view = self._cross_view(graph)
            accuracy, covariances = self._accuracy(closed, refined, model, cross_view)
            if kept.knows_errors:
                model = self._with_pose_errors(model, graph, covariances)
            records = self._records(covariances)
            evidence = Evidence(
                records,
                tuple(e.step.registration if e.step is not None else None for e in log.entries),
                loops,
                closed.visual.sequential if self._tracks else graph.poses,
                closed.visual.optimisation,
                cross_view,
                accuracy,
                model.cloud.diagonal_m,
                self._config.tolerance_m,
                kept.knows_errors,
                refined.refinement,
                frozenset((g.i, g.j) for g in self._given if g.by_user),
                tuple(d for index, d in kept.depths.items() if d > 0 and index in self._poses),
                kept.ambiguity_m,
                tuple(log.repeated),
                tuple(log.interruptions),
                closed.sensors.records,
                components,
                tuple((e.record.index, e.moving) for e in self._posed if e.moving > 0),
                tuple(
                    e.record.index for e in self._posed if e.step is not None and e.step.doubtful
                ),
                self._on_a_single_link(loops),
            )
            verdict, reasons = judge(evidence)
        return Reconstruction(
            trajectory=self._scatter(graph.poses),
            timestamps=np.array([e.record.timestamp for e in log.entries]),
            graph=graph,
            cloud=model.cloud,
            mesh=model.mesh,
            diagnostics=Diagnostics(
                verdict,
                ranked([*reasons, *self._correction_reasons(), *self._surface_reasons(model)]),
                records,
                loops,
                self._scatter(closed.sequential),
                optimisation.objective,
                {},
                dict(self._watch.seconds),
                fused.before,
                refined.refinement,
                optimisation.parts,
                closed.sensors.records,
                accuracy=accuracy,
                joins=tuple(self._joins),
            ),
            config=self._config.to_dict(),
            recording={"path": None, "format": "frames", "frames": len(log.entries)},
            seed=0,
            threads=1,
            components=components,
            up=closed.sensors.up(graph),
        )

    def graph(
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
        ids = [e.record.index for e in self._posed]
        tracked = np.array([self._poses[index] for index in ids])
        poses = tracked if refined is None else refined.poses
        refined_edges = () if refined is None else refined.edges
        replaced = {index for edge in refined_edges for index in (edge.i, edge.j)}
        place = {index: k for k, index in enumerate(ids)}
        unobservable = [e.record.unobservable for e in self._posed]
        run = degenerate_runs(unobservable)
        prediction = Prediction.of(tracked, unobservable) if run.any() else None
        if prediction is not None and cautious:
            prediction = prediction.at_worst()
        times = {e.record.index: e.record.timestamp for e in self._posed}
        interval = float(np.median(np.diff(list(times.values())))) if len(times) > 1 else 0.0
        sequence = []
        for entry in self._posed:
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
            for j in self._joins
            if j.needed and not {j.link.i, j.link.j} <= replaced
        ]
        closing = [
            Measured(c.record.i, c.record.j, c.T_i_j, c.information)
            for c in loops
            if c.T_i_j is not None and c.information is not None
        ]
        return build_graph(ids, poses, [*sequence, *needed, *refined_edges], closing)

    def _accuracy(
        self,
        closed: Optimised,
        refined: Refined,
        model: Model,
        cross_view: CrossViewConsistency | None,
    ) -> tuple[Accuracy, Float64]:
        """Return the accuracy of the final poses, and their covariances (P, 6, 6).

        Not assessed if covariances of registrations are unrealistic.
        """
        if not self._kept.knows_errors:
            return Accuracy(), GraphCovariances(closed.optimisation.graph).of_poses
        refinement = refined.refinement
        known = images_only = GraphCovariances(self._measured(refined.graph, refinement.stated))
        if closed.sensors:  # the accuracy rests on the images alone where they suffice
            without_sensors = closed.visual.optimisation.graph
            if refinement.kept:
                without_sensors = self.graph(closed.loops, refinement, confirmed=closed.confirmed)
            images_only = GraphCovariances(self._measured(without_sensors, refinement.stated))
        moved = 0.0, 0.0
        if self._tracks:  # the initial error of given poses says nothing of the final one
            moved = displacement(closed.optimisation.graph.poses, refined.graph.poses)
        excess = 0.0 if cross_view is None else cross_view.excess_m()
        calibration = self._by_calibration(refinement.calibration_check)
        shown = Shown(*moved, excess, *calibration, refinement.split_m, refinement.split_rad)
        covariances = covariances_of(known, shown)
        del known  # only one large factor is in memory
        accuracy = accuracy_of(images_only, shown, model.cloud.diagonal_m)
        if accuracy.unbounded and closed.sensors.verified:
            free = set(accuracy.unbounded)
            bounded = with_sensors(images_only.graph, self._where_degenerate(closed.sensors))
            accuracy = accuracy_of(GraphCovariances(bounded), shown, model.cloud.diagonal_m)
            by_odometry = tuple(sorted(free.difference(accuracy.unbounded)))
            accuracy = replace(accuracy, by_odometry=by_odometry)
        return accuracy, covariances

    def _by_calibration(self, check: CalibrationCheck | None) -> tuple[float, float]:
        """Return how far (m, rad) the poses may be off by the calibration (95 %).

        That is the gap of a loop that a better calibration would close, or the motion by one with
        which views agree better, unless a loop contradicts; and the uncertainty of a correction.
        """
        if check is None:
            return 0.0, 0.0
        errors = [np.zeros(2)]
        if check.alarm and check.gap is not None:
            errors.append(np.array(check.gap.before))
        elif check.unconfirmed:
            errors.append(np.array(check.moved))
        for part in self._config.corrections:
            if isinstance(part, CameraErrors):
                sigmas = part.sigmas
                errors += [
                    OF_95_PERCENT * sigmas[name] * np.array(motion)
                    for name, motion in check.motion.items()
                ]
        m, rad = np.linalg.norm(errors, axis=0).tolist()
        return m, rad

    def _where_degenerate(self, sensors: SensorPriors) -> SensorPriors:
        """Return the steps of odometry from and to degenerate frames, and over gaps."""
        ends = self._unobservable.keys()
        gaps = self._gaps()
        steps = [s for s in sensors.steps if s.i in ends or s.j in ends or (s.i, s.j) in gaps]
        return SensorPriors(tuple(steps))

    def _gaps(self) -> set[tuple[int, int]]:
        """Return the frames before and after the gaps that no registration closes."""
        return {(j.link.i, j.link.j) for j in self._joins if j.how != "links"}

    def _with_pose_errors(self, model: Model, graph: PoseGraph, covariances: Float64) -> Model:
        """Add the errors of the poses, with covariances (P, 6, 6), to those of the model."""
        frames, at = self._checked_images(graph)
        return with_pose_errors(model, frames, graph.poses[at], covariances[at])

    def _measured(self, graph: PoseGraph, stated: Sequence[tuple[int, int]] = ()) -> PoseGraph:
        """Return the graph without edges and directions that are extrapolated motion only.

        See `degenerate_directions` for `stated`.
        """
        own = {
            (e.step.reference, e.record.index)
            for e in self._posed
            if e.step is not None and e.step.reference is not None
        }
        views = {v.index: v for v in self._kept.views.of(self._poses)}
        directions = degenerate_directions(graph, self._unobservable, own, views, frozenset(stated))
        return without_degenerate(graph, directions, self._gaps())

    def _records(self, covariances: Float64) -> tuple[FrameRecord, ...]:
        """Return the records with the covariances (P, 6, 6) of the frames with a pose here."""
        known = dict(zip((e.record.index for e in self._posed), covariances, strict=True))
        out = []
        for entry in self._log.entries:
            C = known.get(entry.record.index)
            finite = C is not None and bool(np.isfinite(C).all())
            out.append(replace(entry.record, covariance=C) if finite else entry.record)
        return tuple(out)

    def _on_a_single_link(self, loops: Sequence[LoopRecord]) -> tuple[int, ...]:
        """Return the frames connected to the first one by a single, unconfirmed link."""
        if not self._joins:
            return ()
        component_of = {e.record.index: e.step.component for e in self._posed if e.step is not None}
        pairs = [(j.link.i, j.link.j) for j in self._joins]
        # Another registration of the same two views is no confirmation.
        known = {frozenset(pair) for pair in pairs}
        pairs += [(p.i, p.j) for p in loops if p.accepted and frozenset((p.i, p.j)) not in known]
        edges = [(component_of[i], component_of[j]) for i, j in pairs]
        first = component_of[self._posed[0].record.index]
        hanging: set[int] = set()
        for k, sides in cut_edges(edges).items():
            if k < len(self._joins) and self._joins[k].how == "links":
                hanging |= sides[1] if first in sides[0] else sides[0]
        return tuple(index for index, c in component_of.items() if c in hanging)

    def _cross_view(self, graph: PoseGraph) -> CrossViewConsistency | None:
        """Compare overlapping images at the final poses."""
        frames, at = self._checked_images(graph)
        return cross_view_consistency(frames, graph.poses[at]) if len(frames) > 1 else None

    def _checked_images(self, graph: PoseGraph) -> tuple[list[RangeFrame], Intp]:
        """Return the images for the final comparison, and their positions in the graph."""
        frames = [f for f in self._kept.checks if f.index in self._poses]
        row = {int(frame): k for k, frame in enumerate(graph.ids)}
        return frames, np.array([row[f.index] for f in frames], np.intp)

    def _scatter(self, poses: Float64) -> Float64:
        out = np.full((len(self._log.entries), 4, 4), np.nan)
        out[[e.record.index in self._poses for e in self._log.entries]] = poses
        return out

    def _correction_reasons(self) -> tuple[Reason, ...]:
        """Return the reason if a correction was left out."""
        names = [name_of(c) for c in self._config.corrections if c.disabled]
        if not names:
            return ()
        text = (
            f"Correction not applied: {' and '.join(names)}. Overlapping views do not clearly show "
            "the error that it compensates."
        )
        return (Reason("correction_left_out", self._whole_recording, text),)

    @property
    def _whole_recording(self) -> tuple[tuple[int, int], ...]:
        entries = self._log.entries
        return ((entries[0].record.index, entries[-1].record.index),)

    def _surface_reasons(self, model: Model) -> tuple[Reason, ...]:
        """Return the reason if there is no surface."""
        if model.mesh is not None and len(model.mesh):
            return ()
        text = (
            "No connected surface is left at this resolution (--voxel): mesh.ply and mesh.glb are "
            "empty."
        )
        if model.mesh is None:
            text = "Clouds without a camera make no surface: there is no mesh.ply and no mesh.glb."
        return (Reason("no_surface", self._whole_recording, text),)


def with_joins(loops: Sequence[ClosedLoop], joins: Sequence[Join]) -> list[ClosedLoop]:
    """Return loops, and the redundant joins of components, which close loops as well."""
    known = {(c.record.i, c.record.j) for c in loops}
    more = []
    for join in joins:
        link = join.link
        if join.needed or {(link.i, link.j), (link.j, link.i)} & known:
            continue
        r = link.registration
        record = LoopRecord(
            link.i,
            link.j,
            True,
            f"joins components, {link.how}",
            overlap=r.overlap,
            rms_m=r.rms_m if np.isfinite(r.rms_m) else None,
            free_space_violation=r.violation,
            margin=r.margin,
        )
        more.append(ClosedLoop(record, link.T_i_j, link.information))
    return [*loops, *more]


def _without_rejected(loops: Sequence[ClosedLoop], optimisation: Optimisation) -> list[ClosedLoop]:
    """Return the loops; those that the optimiser left out as contradictory are rejected."""
    if optimisation.weights is None:
        return list(loops)
    weights = iter(optimisation.weights[optimisation.graph.loop])
    out = []
    for loop in loops:
        if loop.T_i_j is not None and next(weights) < MIN_WEIGHT:
            reason = f"contradicts the rest of the graph ({loop.record.reason})"
            loop = ClosedLoop(replace(loop.record, accepted=False, reason=reason))
        out.append(loop)
    return out
