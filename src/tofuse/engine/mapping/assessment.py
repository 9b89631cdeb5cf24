"""Accuracy and verdict of a reconstructed part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.frames import frame_ranges
from tofuse.engine.fusion import Model, with_pose_errors
from tofuse.engine.graph import LoopRecord, PoseGraph, external_sensors, graph_covariances
from tofuse.engine.loops import PriorLoop, cut_edges
from tofuse.engine.mapping import camera_uncertainty
from tofuse.engine.mapping.config import Config
from tofuse.engine.mapping.frame_log import Entry, FrameLog
from tofuse.engine.mapping.observations import CheckedImage, Observations
from tofuse.engine.mapping.tracked_graph import Optimised, Refined, TrackedGraph
from tofuse.engine.parts import name_of
from tofuse.engine.quality import (
    ambiguous_frames,
    ambiguous_places,
    background,
    cross_view_agreement,
    pose_accuracy,
    trajectory_errors,
)
from tofuse.engine.refinement import Refinement
from tofuse.engine.results import Component, FrameRecord, Reason, Verdict, checks, verdicts
from tofuse.engine.sensor import CameraErrors
from tofuse.engine.tracking import FrameTime, given, moving_objects, rival_motions
from tofuse.engine.views import PreparedView


@dataclass(frozen=True, eq=False)
class Assessed:
    """The result of the assessment.

    Attributes
    ----------
    verdict, reasons
        "good", "degraded" or "failed", and why.
    accuracy
        Bounds of the pose errors.
    records
        Records of all frames, with the covariances of their poses.
    model
        The model, whose errors include those of the poses.
    """

    verdict: Verdict
    reasons: tuple[Reason, ...]
    accuracy: pose_accuracy.Accuracy
    records: tuple[FrameRecord, ...]
    model: Model


@dataclass(frozen=True)
class _Motion:
    """Frames in which the tracker noticed that something moves, or fits badly.

    Attributes
    ----------
    moving, rivals
        Index, and the share of the view that moves; or that follows a rival of the tracked motion.
    moved
        Those in which outlines show that objects moved.
    doubtful
        Those with an unusual fit.
    """

    moving: tuple[tuple[int, float], ...]
    rivals: tuple[tuple[int, float], ...]
    moved: tuple[int, ...]
    doubtful: tuple[int, ...]

    @classmethod
    def of(cls, posed: Sequence[Entry]) -> _Motion:
        steps = [(e.record.index, e.step) for e in posed if e.step is not None]
        return cls(
            tuple((e.record.index, e.moving_fraction) for e in posed if e.moving_fraction > 0),
            tuple((k, step.rival) for k, step in steps if step.rival > 0),
            tuple(k for k, step in steps if step.moved > moving_objects.MIN_MOVING_FRACTION),
            tuple(k for k, step in steps if step.doubtful),
        )

    @property
    def shares(self) -> list[tuple[int, float]]:
        """All shares of views, by frame index."""
        return [*self.moving, *self.rivals]


@dataclass(frozen=True, eq=False)
class Assessment:
    """Assesses the reconstruction of one connected part.

    Attributes
    ----------
    config
        The configuration.
    log
        The frames of the part.
    tracked
        Its pose graph.
    observations
        Stored observations.
    prior_loops
        Given loops.
    """

    config: Config
    log: FrameLog
    tracked: TrackedGraph
    observations: Observations
    prior_loops: Sequence[PriorLoop]

    def run(
        self, closed: Optimised, refined: Refined, model: Model, components: tuple[Component, ...]
    ) -> Assessed:
        """Compare images at the final poses, bound the errors of the poses, and judge.

        Parameters
        ----------
        closed, refined
            Results of the earlier stages.
        model
            The fused model.
        components
            As in `Reconstruction`.
        """
        graph = refined.graph
        cross_view = self._cross_view(graph)
        accuracy, covariances = self._accuracy(closed, refined, model, cross_view)
        accuracy = self._with_camera(accuracy, refined.refinement, cross_view)
        motion = _Motion.of(self.tracked.posed)
        # Frames to which verified odometry measures the step.
        measured = frozenset(s.j for s in closed.sensors.steps if closed.sensors.verified)
        confirmed = self._confirmed(graph, motion, measured)
        ambiguous = self._ambiguous(graph)
        if (
            ambiguous
            or refined.refinement.range_change is not None
            or checks.open_motion(motion.shares, measured | confirmed)
            or checks.frozen(self._repeated)
        ):
            accuracy = accuracy.without_bound()
        if self.observations.has_covariances:
            model = self._with_pose_errors(model, graph, covariances)
        records = self._records(covariances)
        loops = tuple(c.record for c in closed.loops)
        evidence = checks.Evidence(
            records=records,
            registrations=tuple(
                None if e.step is None else e.step.registration for e in self.log.entries
            ),
            loops=loops,
            sequential=closed.visual.sequential if self._is_tracked else graph.poses,
            optimisation=closed.visual.optimisation,
            cross_view=cross_view,
            accuracy=accuracy,
            diagonal_m=model.cloud.diagonal_m,
            tolerance_m=self.config.tolerance_m,
            has_covariances=self.observations.has_covariances,
            refinement=refined.refinement,
            given_loops=frozenset((g.i, g.j) for g in self.prior_loops if g.by_user),
            depths=self._depths,
            ambiguity_m=self.observations.ambiguity_m,
            scans=model.mesh is None and self.observations.model.surface,
            repeated=tuple(self.log.repeated),
            interruptions=tuple(self.log.interruptions),
            priors=closed.sensors.records,
            components=components,
            moving=motion.moving,
            moved=motion.moved,
            rivals=motion.rivals,
            measured=measured,
            confirmed=confirmed,
            doubtful=motion.doubtful,
            single_link_frames=single_link_frames(self.tracked, loops),
            ambiguous=ambiguous,
            main_is_first=self.config.joining.main == "first",
        )
        verdict, reasons = checks.judge(evidence)
        if verdict == "failed":  # its evidence is contradicted, or says little about the rest
            accuracy = accuracy.without_bound()
            reasons = tuple(reason for reason in reasons if reason.code != "uncertain_poses")
        more = [*self._correction_reasons(), *self._surface_reasons(model)]
        return Assessed(verdict, verdicts.ranked([*reasons, *more]), accuracy, records, model)

    @property
    def _is_tracked(self) -> bool:
        return not isinstance(self.config.odometry, given.GivenPoses)

    @property
    def _repeated(self) -> Sequence[frame_ranges.Range]:
        """Ranges of frames whose image equals the one before."""
        return frame_ranges.runs_of([e.record.index for e in self.log.entries], self.log.repeated)

    @property
    def _depths(self) -> tuple[float, ...]:
        """Median depths of the frames of this part, m."""
        depths = self.observations.depths.items()
        return tuple(d for index, d in depths if d > 0 and index in self.tracked.poses)

    def _with_camera(
        self,
        accuracy: pose_accuracy.Accuracy,
        refinement: Refinement,
        cross_view: cross_view_agreement.CrossViewConsistency | None,
    ) -> pose_accuracy.Accuracy:
        """Add the uncertainty of the camera's parameters and of the surface."""
        check = refinement.calibration_check
        rms_m = np.nan if cross_view is None else cross_view.rms_m()
        return replace(
            accuracy,
            camera_sigmas={} if check is None else camera_uncertainty.sigmas(check),
            surface_m=rms_m if np.isfinite(rms_m) else None,
        )

    def _accuracy(
        self,
        closed: Optimised,
        refined: Refined,
        model: Model,
        cross_view: cross_view_agreement.CrossViewConsistency | None,
    ) -> tuple[pose_accuracy.Accuracy, Float64]:
        """Return the accuracy of the final poses, and their covariances (P, 6, 6).

        Bounded by images, then with other sensors, then with even motion: each is used where those
        before leave poses unbounded, and the verdict says which one bounds them. Not assessed if
        covariances of registrations are unrealistic.
        """
        if not self.observations.has_covariances:
            return pose_accuracy.Accuracy(), graph_covariances.GraphCovariances(
                closed.optimisation.graph
            ).of_poses
        observed = self._observed_errors(closed, refined, cross_view)
        claimed = self._by_depth(closed, refined)
        measured = self._measured(claimed, refined.refinement).with_poses(refined.graph.poses)

        def covariances_with(
            sensors: external_sensors.SensorPriors,
        ) -> graph_covariances.GraphCovariances:
            graph = external_sensors.with_sensors(measured, sensors).with_edges(refined.color)
            return graph_covariances.GraphCovariances(graph)

        def assessed(
            sensors: external_sensors.SensorPriors, observed: pose_accuracy.ObservedErrors
        ) -> tuple[pose_accuracy.Accuracy, graph_covariances.GraphCovariances]:
            covariances = covariances_with(sensors)
            bounds = pose_accuracy.accuracy_of(covariances, observed, model.cloud.diagonal_m)
            return bounds, covariances

        sensors = external_sensors.SensorPriors()
        accuracy, covariances = assessed(sensors, observed)
        by_images = accuracy
        together = closed.sensors.verified and closed.sensors.is_reliable
        if together:
            by_depth = covariances
            if refined.color:
                by_depth = graph_covariances.GraphCovariances(measured)
            scale = pose_accuracy.scale_of_registrations(by_depth, observed)
            sensors = closed.sensors.with_depth_scale_at_least(scale)
            observed = observed.of_other_sensors()
            accuracy, covariances = assessed(sensors, observed)
        elif closed.sensors.verified and accuracy.unbounded:
            steps = self.tracked.steps_at_degenerate(closed.sensors)
            sensors = external_sensors.SensorPriors(steps)
            accuracy, covariances = assessed(sensors, observed)
        by_sensors = accuracy
        between = self.tracked.steps_at_unbounded(claimed, accuracy.unbounded)
        if between:
            sensors = replace(sensors, steps=(*sensors.steps, *between))
            accuracy, covariances = assessed(sensors, observed)
        accuracy = replace(
            accuracy,
            by_odometry=_bounded_since(by_images, by_sensors),
            by_motion=_bounded_since(by_sensors, accuracy),
        )
        if closed.sensors and not together:  # sensors that bound nothing have moved the poses, too
            sensors = replace(closed.sensors, steps=(*closed.sensors.steps, *between))
            covariances = covariances_with(sensors)
        return accuracy, pose_accuracy.covariances_of(covariances, observed)

    def _by_depth(self, closed: Optimised, refined: Refined) -> PoseGraph:
        """Return the final graph without colour and external sensors."""
        if not closed.sensors and not refined.color:
            return refined.graph
        if not refined.refinement.kept:
            return closed.visual.optimisation.graph
        return self.tracked.build(closed.loops, refined.refinement, confirmed=closed.confirmed)

    def _observed_errors(
        self,
        closed: Optimised,
        refined: Refined,
        cross_view: cross_view_agreement.CrossViewConsistency | None,
    ) -> pose_accuracy.ObservedErrors:
        """Return the errors of the poses that their covariances don't include."""
        refinement, corrections = refined.refinement, self._estimated_corrections
        odometry = self.config.odometry
        if isinstance(odometry, given.GivenPoses):
            # Their initial error is unrelated to the final one, but not to that of an earlier run.
            moved = odometry.moved_m, 0.0
        else:
            moved = trajectory_errors.displacement(
                closed.optimisation.graph.poses, refined.graph.poses
            )
        excess_m = 0.0 if cross_view is None else cross_view.excess_m()
        calibration = 0.0, 0.0
        if refinement.calibration_check is not None:
            calibration = camera_uncertainty.pose_errors(refinement.calibration_check, corrections)
        split = (refinement.split_m, refinement.split_rad) if refinement.kept else None
        depth_m = float(np.median(self._depths)) if self._depths else 0.0
        positions = refined.graph.poses[:, :3, 3]
        range_m = pose_accuracy.error_by_range(positions, refinement.shared_rms, depth_m)
        return pose_accuracy.ObservedErrors(
            *moved, excess_m, *calibration, split, range_m, corrected=bool(corrections)
        )

    def _measured(self, graph: PoseGraph, refinement: Refinement) -> PoseGraph:
        return self.tracked.measured(graph, self.observations.views, refinement.non_overlap_edges)

    @property
    def _estimated_corrections(self) -> list[CameraErrors]:
        """The corrections of the camera that were estimated from its own views."""
        corrections = [c for c in self.config.corrections if isinstance(c, CameraErrors)]
        return [c for c in corrections if any(c.sigmas.values())]

    def _with_pose_errors(self, model: Model, graph: PoseGraph, covariances: Float64) -> Model:
        """Add the errors of the poses, with covariances (P, 6, 6), to those of the model."""
        images, rows = self._checked_images(graph)
        frames = (checked.image.get() for checked in images)
        return with_pose_errors(model, frames, graph.poses[rows], covariances[rows])

    def _records(self, covariances: Float64) -> tuple[FrameRecord, ...]:
        """Return the records, with the covariances (P, 6, 6) of the frames of this part."""
        covariance_of = dict(
            zip((e.record.index for e in self.tracked.posed), covariances, strict=True)
        )
        out = []
        for entry in self.log.entries:
            C = covariance_of.get(entry.record.index)
            finite = C is not None and bool(np.isfinite(C).all())
            out.append(replace(entry.record, covariance=C) if finite else entry.record)
        return tuple(out)

    def _cross_view(self, graph: PoseGraph) -> cross_view_agreement.CrossViewConsistency | None:
        """Compare overlapping images at the final poses."""
        views, poses = self._checked_views(graph)
        return cross_view_agreement.compare_views(views, poses) if len(views) > 1 else None

    def _confirmed(
        self, graph: PoseGraph, motion: _Motion, measured: frozenset[int]
    ) -> frozenset[int]:
        """Return the frames in which much moves, and whose poses the background confirms."""
        open_frames = checks.open_motion(motion.shares, measured)
        if not open_frames:
            return frozenset()
        moving, rivals = dict(motion.moving), dict(motion.rivals)
        excluded = {k: x for k, x in moving.items() if x > moving_objects.MIN_MOVING_FRACTION}
        movements = {
            k: background.Movement(excluded.get(k, 0.0), rivals.get(k, 0.0))
            for k in excluded.keys() | rivals.keys()
        }
        limits = background.Limits(checks.MAX_MOVING, rival_motions.DELAY)
        views, poses = self._checked_views(graph, with_open=True)
        frames = graph.ids.tolist()
        return background.confirmed(views, poses, frames, open_frames, movements, limits)

    def _ambiguous(self, graph: PoseGraph) -> tuple[int, ...]:
        """Return frames to which another step fits as well; odometry would exclude that."""
        posed = self.tracked.posed
        if not self._is_tracked or any(e.T_odometry is not None for e in posed):
            return ()
        poses = dict(zip(graph.ids.tolist(), graph.poses, strict=True))
        moments = [FrameTime(e.record.index, e.record.timestamp) for e in posed]
        views, newest = self.observations.views.of(poses), self.observations.newest
        # A camera that seems to stand still has one stored view; it may move on by a period.
        if newest is not None and newest.index in poses.keys() - {view.index for view in views}:
            views = [*views, newest]
        places = ambiguous_places(views, poses, moments)
        return tuple(sorted({*ambiguous_frames(views, poses, moments), *places}))

    def _checked_views(
        self, graph: PoseGraph, *, with_open: bool = False
    ) -> tuple[list[PreparedView], Float64]:
        """Return what is compared of the images for the final comparison, and their poses.

        One after the other, so that not all images are in memory.
        """
        images, rows = self._checked_images(graph, with_open=with_open)
        prepare = cross_view_agreement.prepare_for_comparison
        return [prepare(checked.image.get()) for checked in images], graph.poses[rows]

    def _checked_images(
        self, graph: PoseGraph, *, with_open: bool = False
    ) -> tuple[list[CheckedImage], Intp]:
        """Return the images for the final comparison, and their positions in the graph.

        Optionally with those in which so much moves that it is open what stands still.
        """
        images = {*self.observations.checks, *(self.observations.open_checks if with_open else ())}
        posed = [checked for checked in images if checked.index in self.tracked.poses]
        posed.sort(key=lambda checked: checked.index)
        row_of = {int(frame): k for k, frame in enumerate(graph.ids)}
        return posed, np.array([row_of[checked.index] for checked in posed], np.intp)

    def _correction_reasons(self) -> tuple[Reason, ...]:
        """Return the reason if a correction was left out."""
        names = [name_of(c) for c in self.config.corrections if c.disabled]
        if not names:
            return ()
        text = (
            f"Correction not applied: {' and '.join(names)}. Overlapping views do not clearly show "
            "the error that it compensates."
        )
        return (Reason("correction_left_out", self._whole_recording, text),)

    @property
    def _whole_recording(self) -> tuple[tuple[int, int], ...]:
        entries = self.log.entries
        return ((entries[0].record.index, entries[-1].record.index),)

    def _surface_reasons(self, model: Model) -> tuple[Reason, ...]:
        """Return the reason if there is no surface."""
        if not self.observations.model.surface or (model.mesh is not None and len(model.mesh)):
            return ()
        text = (
            "No connected surface is left at this resolution (--voxel): mesh.ply and mesh.glb are "
            "empty."
        )
        if model.mesh is None:
            text = "Clouds without a camera make no surface: there is no mesh.ply and no mesh.glb."
        return (Reason("no_surface", self._whole_recording, text),)


def _bounded_since(
    before: pose_accuracy.Accuracy, after: pose_accuracy.Accuracy
) -> tuple[int, ...]:
    """Return the frames that are unbounded before, but not after more was measured."""
    return tuple(sorted(set(before.unbounded).difference(after.unbounded)))


def single_link_frames(tracked: TrackedGraph, loops: Sequence[LoopRecord]) -> tuple[int, ...]:
    """Return the frames connected to the first one by a single, unconfirmed link."""
    if not tracked.joins:
        return ()
    component_of = {e.record.index: e.step.component for e in tracked.posed if e.step is not None}
    pairs = [(j.link.i, j.link.j) for j in tracked.joins]
    # Another registration of the same two views does not confirm it.
    joined_pairs = {frozenset(pair) for pair in pairs}
    pairs += [(p.i, p.j) for p in loops if p.accepted and frozenset((p.i, p.j)) not in joined_pairs]
    edges = [(component_of[i], component_of[j]) for i, j in pairs]
    first = component_of[tracked.posed[0].record.index]
    weak_components: set[int] = set()
    for k, sides in cut_edges(edges).items():
        if k < len(tracked.joins) and tracked.joins[k].kind == "links":
            weak_components |= sides[1] if first in sides[0] else sides[0]
    return tuple(index for index, c in component_of.items() if c in weak_components)
