"""The verdict of a run, from its evidence and without a reference."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tofuse.engine.alignment import Registration
from tofuse.engine.arrays import Float64
from tofuse.engine.frames import frame_ranges
from tofuse.engine.geometry import se3
from tofuse.engine.graph import LoopRecord, Optimisation, external_sensors, graph_covariances
from tofuse.engine.quality import cross_view_agreement, pose_accuracy
from tofuse.engine.quantities import length, percent
from tofuse.engine.refinement import Refinement, calibration_check
from tofuse.engine.results.types import Component, FrameRecord, Reason, Verdict, in_main_model
from tofuse.engine.results.verdicts import ranked, verdict_of
from tofuse.engine.tracking import FrameTime, find_jumps

# Inlier fraction below which a registration is weak.
WEAK_INLIER_FRACTION = 0.05
# Largest fraction of registrations that may run out of iterations.
MAX_NOT_CONVERGED = 0.05
# Largest fraction of degenerate registrations; more accumulate drift.
MAX_DEGENERATE = 0.1
# Range of plausible typical depths of ToF cameras, m, and the maximum of laser scanners.
MIN_DEPTH_M, MAX_DEPTH_M = 0.15, 12.0
_MAX_SCAN_M = 1000.0
# Views are unordered if there are more jumps than this, and than this fraction of the poses.
MIN_UNORDERED, UNORDERED_FRACTION = 3, 0.2
# Largest motion of a camera that stands still.
STILL_M, STILL_RAD = 0.01, np.radians(0.5)
# Default tolerance: fraction of the model's diagonal, and its minimum in m.
TOLERANCE_FRACTION, TOLERANCE_M = 0.005, 0.01
# Tolerance of rotations.
TOLERANCE_RAD = np.radians(2)
# The squared Mahalanobis drift over a loop is chi-square distributed with six degrees of freedom if
# covariances are right: one in a thousand exceeds this.
MAX_LOOP_CHI2 = 22.46
# Without covariances: tolerated drift over a loop as a fraction of its path, and its minimum.
GAP_FRACTION, GAP_FLOOR_M, GAP_FLOOR_RAD = 0.02, 0.03, np.radians(2)
# What moves in more of the view may as well be what stands still.
MAX_MOVING = 0.25
# Maximum number of disconnected parts (the largest) and of loops that are named.
MAX_LISTED = 6
# Minimum fraction of overlapping measurements that support the poses; and its minimum ratio to that
# of consecutive images.
MIN_SUPPORT, AGREEMENT_RATIO = 0.5, 0.9


# What a bound is mostly due to.
_CAUSES = {
    "noise": "noise",
    "refinement": "the correction by the refinement",
    "disagreement": "surfaces that differ between views, by multipath or changes of the scene",
    "calibration": "the camera's calibration",
    "range": "range errors that differ from place to place, such as those by multipath",
}
# What would lower the bound, by what most of it is due to; "" for the orientations.
_REMEDIES = {
    "": "Return to places seen before, and keep corners and texture in view.",
    "noise": "Record more views of the same places, to average out the noise.",
    "refinement": "Return to the start: a loop would confirm it.",
    "disagreement": "Record while nothing moves, and view corners from several directions.",
    "calibration": "Calibrate the camera (tofuse calibrate depth), or turn it more and return to "
    "the start.",
    "range": "View the same places from several distances and directions.",
}


@dataclass(frozen=True, eq=False)
class Evidence:
    """The evidence of a run.

    Attributes
    ----------
    records, registrations
        One per frame, in order; a registration is None for the first and for lost frames.
        Registrations of frames outside the main model are ignored.
    loops
        All candidate loops.
    sequential
        (N, 4, 4) poses before optimisation, of the frames in the main model.
    optimisation
        The optimised graph.
    cross_view
        Consistency of overlapping images at the final poses; None if there are too few.
    accuracy
        Accuracy of the final poses.
    diagonal_m
        Diagonal of the model.
    tolerance_m
        Tolerance of the poses; None for a fraction of the model's diagonal.
    has_covariances
        Whether covariances of registrations are realistic, which ICP's are not.
    refinement
        Result of the refinement of all views.
    given_loops
        Pairs (i, j) of loops given by the user.
    depths
        Median radial range of every frame with a pose, m.
    ambiguity_m
        Ambiguity range of the camera, if known.
    scans
        Whether the views are bare clouds, which may be a laser scanner's.
    repeated
        Indices of the frames that equal the one before in every pixel.
    interruptions
        Positions among the records at which another recording begins.
    priors
        Records of external sensors.
    components
        As in `Reconstruction`; empty if all frames are in one.
    moving
        (frame index, fraction of the image) of frames with moving objects, or with depth that
        varies as if there were.
    moved
        Indices of the frames in which something certainly moved.
    rivals
        (frame index, share of the view) of frames of which a share follows a rival motion.
    measured
        Indices of the frames whose motion verified odometry measured, and agrees with.
    confirmed
        Indices of the frames whose pose the background confirms, although much moves in them.
    doubtful
        Indices of the frames that fit worse than usual for this camera.
    single_link_frames
        Indices of the frames that a single registration connects to the first one.
    ambiguous
        Indices of examined frames that another step, or another place, fits as well.
    main_is_first
        Whether the first session is in the main model, even if another one is longer.
    """

    records: tuple[FrameRecord, ...]
    registrations: tuple[Registration | None, ...]
    loops: tuple[LoopRecord, ...]
    sequential: Float64
    optimisation: Optimisation
    cross_view: cross_view_agreement.CrossViewConsistency | None
    accuracy: pose_accuracy.Accuracy = pose_accuracy.Accuracy()  # noqa: RUF009 - immutable
    diagonal_m: float = 0.0
    tolerance_m: float | None = None
    has_covariances: bool = False
    refinement: Refinement | None = None
    given_loops: frozenset[tuple[int, int]] = frozenset()
    depths: tuple[float, ...] = ()
    ambiguity_m: float | None = None
    scans: bool = False
    repeated: tuple[int, ...] = ()
    interruptions: tuple[int, ...] = ()
    priors: tuple[external_sensors.SensorRecord, ...] = ()
    components: tuple[Component, ...] = ()
    moving: tuple[tuple[int, float], ...] = ()
    moved: tuple[int, ...] = ()
    rivals: tuple[tuple[int, float], ...] = ()
    measured: frozenset[int] = frozenset()
    confirmed: frozenset[int] = frozenset()
    doubtful: tuple[int, ...] = ()
    single_link_frames: tuple[int, ...] = ()
    ambiguous: tuple[int, ...] = ()
    main_is_first: bool = False

    @property
    def full_range(self) -> tuple[frame_ranges.Range, ...]:
        """First and last frame of the recording."""
        return ((self.records[0].index, self.records[-1].index),)

    @property
    def posed_range(self) -> tuple[frame_ranges.Range, ...]:
        """First and last frame of the main model."""
        ids = self.optimisation.graph.ids
        return ((int(ids[0]), int(ids[-1])),)

    @property
    def tolerance(self) -> float:
        """Tolerance of the poses, m."""
        return tolerance_of(self.tolerance_m, self.diagonal_m)

    @property
    def in_main(self) -> list[bool]:
        """Whether each record is in the main model."""
        return [in_main_model(record, self.components) for record in self.records]

    def runs(self, marked: Sequence[bool]) -> tuple[frame_ranges.Range, ...]:
        """Return the ranges of marked records."""
        return frame_ranges.runs([record.index for record in self.records], marked)

    def runs_of(self, frames: Collection[int]) -> tuple[frame_ranges.Range, ...]:
        """Return the ranges of the records with these indices."""
        return frame_ranges.runs_of([record.index for record in self.records], frames)


def tolerance_of(tolerance_m: float | None, diagonal_m: float) -> float:
    """Return the tolerance of poses, m: by default proportional to the model's diagonal."""
    return max(TOLERANCE_M, TOLERANCE_FRACTION * diagonal_m) if tolerance_m is None else tolerance_m


def judge(evidence: Evidence) -> tuple[Verdict, tuple[Reason, ...]]:
    """Return the verdict and its reasons, each code once, the most severe first."""
    reasons = ranked(
        [
            *_poses(evidence),
            *_connections(evidence),
            *_motion(evidence),
            *_depths(evidence),
            *_registrations(evidence),
            *_loops(evidence),
            *(_uncertainty(evidence) if evidence.has_covariances else _drift(evidence)),
            *_optimiser(evidence),
            *_external_sensors(evidence),
            *_images(evidence),
            *_scene(evidence),
        ]
    )
    return verdict_of(reasons), reasons


def _poses(e: Evidence) -> Iterator[Reason]:
    readable = [r for r in e.records if r.status != "skipped"]
    if e.main_is_first:  # however long other, disconnected parts are
        away = {k for k, component in enumerate(e.components) if not component.connected}
        readable = [r for r in readable if r.component not in away]
    posed = [r for r in readable if r.status != "lost"]
    main = sum(e.in_main)
    # A single frame is no model if there are other, unconnected ones.
    scattered = main == 1 and len(posed) > 1
    if 2 * main < len(readable) or scattered:
        if main < len(posed):
            text = f"Only {main} of {len(readable)} readable frames are in the main model."
        else:
            text = f"{len(readable) - main} of {len(readable)} readable frames have no pose."
        yield Reason("few_poses", e.full_range, text)
    lost = ranges_with_status(e.records, "lost")
    if lost:
        text = f"{_sentence(lost)} {'has' if frame_ranges.is_single(lost) else 'have'} no pose."
        yield Reason("lost_frames", lost, text)
    skipped = ranges_with_status(e.records, "skipped")
    if skipped:
        first = next(r for r in e.records if r.status == "skipped")
        which = "" if frame_ranges.is_single(skipped) else f" Frame {first.index}:"
        text = f"{_sentence(skipped)} could not be read.{which} {first.reason.rstrip('.')}."
        yield Reason("unreadable_frames", skipped, text)
    if len(posed) == 1:
        frame = posed[0].index
        text = f"Only frame {frame} has a pose: nothing to register, accuracy not assessed."
        yield Reason("single_frame", ((frame, frame),), text)


def _connections(e: Evidence) -> Iterator[Reason]:
    """Parts that are disconnected, or connected by one link or extrapolated motion only."""
    disconnected = [c for c in e.components if not c.connected]
    if disconnected:
        connected_ranges = [r for c in e.components if c.connected for r in c.frames]
        connected = e.runs([any(a <= r.index <= b for a, b in connected_ranges) for r in e.records])
        parts = sorted([connected, *(c.frames for c in disconnected)])
        yield Reason(
            "disconnected",
            frame_ranges.union(r for c in disconnected for r in c.frames),
            f"The recording consists of {len(parts)} disconnected parts: {_listed(parts)}; no "
            "pose between them could be verified.",
        )
    for joined_by, motion in (
        ("motion", "extrapolated motion"),
        ("odometry", "recorded odometry or the device's poses"),
    ):
        bridged = frame_ranges.union(
            r for c in e.components if c.joined == joined_by for r in c.frames
        )
        # If all pose errors are bounded, later measurements connect both sides.
        if bridged and (e.accuracy.unbounded or not e.accuracy.assessed):
            text = f"{_are(bridged)} connected to the rest by {motion} only."
            yield Reason("bridged_gap", bridged, text)
    single_link = e.runs_of(e.single_link_frames)
    if single_link:
        text = (
            f"{_are(single_link)} connected to the rest by a single registration, which no other "
            "view confirms."
        )
        yield Reason("single_link", single_link, text)


def _listed(parts: Sequence[tuple[frame_ranges.Range, ...]]) -> str:
    """Name the largest of several parts, in order."""
    largest = sorted(sorted(parts, key=frame_ranges.size, reverse=True)[:MAX_LISTED])
    if all(len(part) == 1 for part in largest):
        text = frame_ranges.in_words([part[0] for part in largest])
    else:
        text = "; ".join(frame_ranges.in_words(part) for part in largest)
    more = len(parts) - len(largest)
    return f"{text} and {more} smaller" if more else text


def _motion(e: Evidence) -> Iterator[Reason]:
    posed = iter(e.sequential)
    has_pose = e.in_main
    poses = [next(posed) if has else None for has in has_pose]
    moments = [FrameTime(r.index, r.timestamp) for r in e.records]
    unmeasured = {k + 1 for k, record in enumerate(e.records) if len(record.unobservable)}
    unexpected = {*e.interruptions, *_component_changes(e.records, has_pose), *unmeasured}
    pose_jumps = [
        jump
        for jump in find_jumps(poses, moments, unexpected)
        if e.records[jump[0]].index not in e.measured
    ]
    if e.scans and not any(moment.is_timed for moment in moments):
        pose_jumps = []  # from tripods, perhaps: no motion predicts the next
    frames = [e.records[k].index for k, _ in pose_jumps]
    if len(pose_jumps) > max(MIN_UNORDERED, UNORDERED_FRACTION * sum(has_pose)):
        text = (
            f"{len(pose_jumps)} of {sum(has_pose)} poses are far from the predicted motion, as if "
            "the views were unordered: the motion cannot confirm them."
        )
        yield Reason("jumped", ((frames[0], frames[-1]),), text)
    elif pose_jumps:
        jumped = e.runs_of(frames)
        deviation = pose_jumps[0][1]
        text = (
            f"The pose of {frame_ranges.in_words(jumped)} jumps: {deviation}."
            if frame_ranges.is_single(jumped)
            else f"The poses of {frame_ranges.in_words(jumped)} jump; "
            f"that of frame {frames[0]} is {deviation}."
        )
        yield Reason("jumped", jumped, text)
    if ambiguous := e.runs_of(e.ambiguous):
        text = (
            f"Around {frame_ranges.in_words(ambiguous)} the scene repeats itself: another step "
            "between two frames, or another place of views that were joined, fits as well, so no "
            "bound on the pose errors is stated."
        )
        yield Reason("ambiguous_steps", ambiguous, text)
    repeated = e.runs_of(e.repeated)
    if repeated:
        n = sum(record.index in e.repeated for record in e.records)
        subject = "1 image repeats" if n == 1 else f"{n} images repeat"
        where = frame_ranges.in_words(repeated)
        text = f"{subject} the one before ({where}): nothing new was measured."
        if frozen(repeated):
            text += " Where the camera went meanwhile is unknown, so no bound is stated."
        yield Reason("repeated_images", repeated, text)
    T = e.optimisation.graph.poses
    moved = se3.inverse(T[:1]) @ T
    is_still = np.linalg.norm(moved[:, :3, 3], axis=1) < STILL_M
    if len(T) > 2 and (is_still & (se3.angle(moved) < STILL_RAD)).all():
        text = f"The camera never moved in {len(T)} frames: the model is that of a single view."
        if e.scans:
            text = f"The {len(T)} clouds fit as they are: all are in one frame, or of one place."
        yield Reason("stood_still", e.posed_range, text)


def _component_changes(records: Sequence[FrameRecord], selected: Sequence[bool]) -> list[int]:
    """Return the positions at which the chosen records change to another component."""
    positions = [k for k, has in enumerate(selected) if has]
    return [b for a, b in pairwise(positions) if records[a].component != records[b].component]


def _depths(e: Evidence) -> Iterator[Reason]:
    if not e.depths:
        return
    unit_verified = any(sensor.metric for sensor in e.priors)
    typical = float(np.median(e.depths))
    statement = f"The typical distance is {typical:.3g} m"
    if e.ambiguity_m is not None and typical > e.ambiguity_m:
        text = f"{statement}, but the camera's ambiguity range is {e.ambiguity_m:.3g} m"
    elif unit_verified:
        return
    elif typical > (_MAX_SCAN_M if e.scans else MAX_DEPTH_M):
        text = f"{statement}, farther than {'scanners' if e.scans else 'ToF cameras'} see"
    elif typical < MIN_DEPTH_M:
        text = f"{statement}, nearer than most ToF cameras see"
    else:
        return
    yield Reason("implausible_depth", e.full_range, f"{text}: check the depth unit.")


def _registrations(e: Evidence) -> Iterator[Reason]:
    pairs = [
        (record.index, r)
        for record, r, main in zip(e.records, e.registrations, e.in_main, strict=True)
        if r is not None and main
    ]
    if not pairs:
        return
    weak = e.runs_of({index for index, r in pairs if r.inlier_ratio < WEAK_INLIER_FRACTION})
    if weak:
        text = (
            f"Fewer than {percent(WEAK_INLIER_FRACTION)} of the points of "
            f"{frame_ranges.in_words(weak)} have a correspondence."
        )
        yield Reason("weak_registration", weak, text)
    if e.has_covariances:
        return  # degenerate or unconverged registrations are included in the bounds
    degenerate = {index for index, r in pairs if len(r.unobservable)}
    if len(degenerate) > MAX_DEGENERATE * len(pairs):
        text = (
            f"In {len(degenerate)} of {len(pairs)} registrations the motion is unobservable in "
            "some direction (degenerate geometry): the pose is predicted there, and drifts."
        )
        yield Reason("unobserved_motion", e.runs_of(degenerate), text)
    not_converged = {index for index, r in pairs if not r.converged}
    if len(not_converged) > MAX_NOT_CONVERGED * len(pairs):
        text = (
            f"{len(not_converged)} of {len(pairs)} registrations ran out of iterations before they "
            "converged."
        )
        yield Reason("not_converged", e.runs_of(not_converged), text)


def _loops(e: Evidence) -> Iterator[Reason]:
    rejected = [p for p in e.loops if (p.i, p.j) in e.given_loops and not p.accepted]
    if not rejected:
        return
    if len(rejected) == 1:
        (p,) = rejected
        text = f"Given loop closure {p.i}-{p.j} was not used: {p.reason}."
    else:
        listed = ", ".join(f"{p.i}-{p.j} ({p.reason})" for p in rejected[:MAX_LISTED])
        more = len(rejected) - MAX_LISTED
        listed += f" and {more} more" if more > 0 else ""
        text = f"{len(rejected)} given loop closures were not used: {listed}."
    yield Reason(
        "loop_rejected", frame_ranges.union((k, k) for p in rejected for k in (p.i, p.j)), text
    )


def _optimiser(e: Evidence) -> Iterator[Reason]:
    if not e.optimisation.converged:
        text = "The optimiser ran out of iterations before it converged."
        yield Reason("optimiser_gave_up", e.posed_range, text)
    tried = any(e.optimisation.objective) and not e.optimisation.improved
    if tried or any(part.before > 0 and not part.improved for part in e.optimisation.parts):
        text = "The optimiser did not improve on the initial poses."
        yield Reason("not_improved", e.posed_range, text)
    r = e.refinement
    if r is not None and r.pairs and not r.kept:
        text = "Global refinement did not improve consistency and was discarded."
        yield Reason("not_refined", e.posed_range, text)


def _external_sensors(e: Evidence) -> Iterator[Reason]:
    for sensor in e.priors:
        if 2 * sensor.used < sensor.measured:
            text = f"{sensor.text[0].upper()}{sensor.text[1:]}."
            yield Reason("sensor_differs", e.posed_range, text)


def _scene(e: Evidence) -> Iterator[Reason]:
    """Moving objects, unstable depth, and views with a bad fit."""
    fractions = {frame: fraction for frame, fraction in e.moving if fraction > 0}
    runs = e.runs_of(fractions)
    moving = tuple((a, b) for a, b in runs if any(a <= frame <= b for frame in e.moved))
    for code, where, words in (
        ("moving_objects", moving, "Moving objects cover up to {} of the image in {}; they are"),
        (
            "unstable_depth",
            tuple(run for run in runs if run not in moving),
            "The depth of up to {} of the image varies from view to view in {}, without a sign of "
            "anything moving; it is",
        ),
    ):
        if where:
            largest = max(
                x for frame, x in fractions.items() if any(a <= frame <= b for a, b in where)
            )
            text = words.format(percent(largest), frame_ranges.in_words(where))
            yield Reason(code, where, f"{text} excluded from tracking and from the model.")
    parts = [*e.moving, *e.rivals]
    if frames := open_motion(parts, e.measured | e.confirmed):
        where = e.runs_of(frames)
        largest = max(share for frame, share in parts if frame in frames)
        text = (
            f"Two parts of the view move differently in {frame_ranges.in_words(where)}, and either "
            f"may be the room: the one that the camera was not tracked by has up to "
            f"{percent(largest)}. So no bound on the pose errors is stated."
        )
        yield Reason("open_motion", where, text)
    doubtful = e.runs_of(e.doubtful)
    if doubtful and e.scans:
        text = (
            f"The registration of {frame_ranges.in_words(doubtful)} is probable, but not accepted."
        )
        yield Reason("weak_registration", doubtful, text)
    elif doubtful:
        description = (
            "fitted its keyframe worse than this camera's views usually do; look at it first."
            if frame_ranges.is_single(doubtful)
            else "fitted their keyframes worse than this camera's views usually do; look at them "
            "first."
        )
        yield Reason("doubtful_poses", doubtful, f"{_sentence(doubtful)} {description}")


def open_motion(moving: Sequence[tuple[int, float]], decided: Collection[int] = ()) -> set[int]:
    """Return the frames in which what moves, (frame index, share of the view), is too much.

    Nothing is open in frames in which other evidence has decided what stands still.
    """
    return {frame for frame, fraction in moving if fraction > MAX_MOVING and frame not in decided}


def frozen(repeated: Sequence[frame_ranges.Range]) -> bool:
    """Whether an image was repeated more than once: `repeated` are ranges of such frames."""
    return any(last > first for first, last in repeated)


def _drift(e: Evidence) -> Iterator[Reason]:
    """Drift over loops, where registrations have no covariances."""
    graph = e.optimisation.graph
    if len(graph.ids) > 1 and not graph.loop.any():
        text = "No loop was closed: the accumulated drift is unchecked."
        yield Reason("unchecked_drift", e.posed_range, text)
    yield from _gap(e)


def _uncertainty(e: Evidence) -> Iterator[Reason]:
    """Uncertainty of the poses and of the calibration, from covariances of registrations."""
    yield from _loop_drift(e)
    yield from _range_changes(e)
    yield from _calibration_alarm(e)
    yield from _unchecked_calibration(e)
    yield from accuracy_reasons(e.accuracy, e.tolerance, [r.index for r in e.records])


def accuracy_reasons(
    a: pose_accuracy.Accuracy, tolerance_m: float, frames: Sequence[int]
) -> Iterator[Reason]:
    """Yield reasons if the accuracy of frames with these indices exceeds a tolerance, m."""
    if not a.assessed:
        return
    for code, indices, text in (
        (
            "unobserved_motion",
            a.unbounded,
            "not constrained in some direction (degenerate geometry): the "
            "motion is extrapolated there, and its error is not bounded.",
        ),
        (
            "bounded_by_odometry",
            a.by_odometry,
            "not constrained by the images in some direction (degenerate "
            "geometry): the recorded odometry, or the device's own poses, bound the error there.",
        ),
        (
            "bounded_by_motion",
            a.by_motion,
            "not constrained by the images in some direction (degenerate "
            "geometry): the bound holds if the camera moved on there, at up to twice its speed.",
        ),
    ):
        runs = frame_ranges.runs_of(frames, indices)
        if runs:
            yield Reason(code, runs, f"{_poses_of(runs)} {text}")
    if frame_ranges.runs_of(frames, a.unbounded) or not np.isfinite(a.position_m):
        return
    if a.position_m > tolerance_m or a.rotation_rad > TOLERANCE_RAD:
        error, allowed = length(a.position_m), length(tolerance_m)
        if a.position_m <= tolerance_m:
            error, allowed = _angle(a.rotation_rad), _angle(TOLERANCE_RAD)
        text = f"Pose errors may reach {error} rms (95 % bound); the tolerance is {allowed}."
        cause = a.limited_by if a.position_m > tolerance_m else ""
        if cause:
            text += f" Most of it is due to {_CAUSES[cause]}."
        if a.worst is not None:
            text += f" Frame {a.worst.frame} is the least certain: {length(a.worst.position_m)}."
        yield Reason("uncertain_poses", ((frames[0], frames[-1]),), text, _REMEDIES[cause])


def _loop_drift(e: Evidence) -> Iterator[Reason]:
    """Drift beyond covariances: systematic errors of the camera bend the trajectory."""
    graph = e.optimisation.graph
    errors = graph_covariances.loop_errors(graph, e.sequential)
    finite = np.isfinite(errors)
    # The median, as single loops may be wrong.
    if not finite.any() or np.median(errors[finite]) <= MAX_LOOP_CHI2:
        return
    worst = int(np.nanargmax(errors))
    i, j = graph.edges[graph.loop][worst]
    gap = se3.inverse(graph.measurements[graph.loop][worst]) @ (
        se3.inverse(e.sequential[i]) @ e.sequential[j]
    )
    first, last = sorted((int(graph.ids[i]), int(graph.ids[j])))
    drift = f"{length(float(np.linalg.norm(gap[:3, 3])))}, {_angle(float(se3.angle(gap)))}"
    text = (
        f"Odometry drift over loop {first}-{last} is {drift}, {np.sqrt(errors[worst] / 6):.1f} "
        "times what noise explains: the depth offset or the focal length of the camera may be "
        "wrong."
    )
    yield Reason("calibration_alarm", ((first, last),), text)


def _range_changes(e: Evidence) -> Iterator[Reason]:
    """A change of the camera's range during the recording."""
    change = None if e.refinement is None else e.refinement.range_change
    if change is None:
        return
    text = (
        f"The range of the camera {change.in_words()}, as views of the same surfaces show: the "
        "model is distorted, and no bound on the pose errors is stated."
    )
    yield Reason("range_changes", e.posed_range, text)


def _calibration_alarm(e: Evidence) -> Iterator[Reason]:
    """A calibration error that the refined views show."""
    check = None if e.refinement is None else e.refinement.calibration_check
    if check is None or not check.alarm or check.gap is None:
        return
    gap = check.gap
    (m, rad), (m_after, rad_after) = gap.before, gap.after
    correction = calibration_check.in_words(check.errors)
    if gap.confirms:
        text = (
            f"Odometry drift over loop {gap.i}-{gap.j} is {length(m)}, {_angle(rad)}. "
            f"{correction[0].upper()}{correction[1:]} would reduce it to {length(m_after)}, "
            f"{_angle(rad_after)}: check the calibration."
        )
    else:  # an error that the drift hardly shows
        text = f"Views agree clearly better with {correction}: check the calibration."
    yield Reason("calibration_alarm", ((gap.i, gap.j),), text)


def _unchecked_calibration(e: Evidence) -> Iterator[Reason]:
    """A calibration that the recording does not determine."""
    check = None if e.refinement is None else e.refinement.calibration_check
    if check is None or check.alarm or check.range_change is not None:
        return
    undetermined = check.undetermined
    limits = undetermined and not check.unconfirmed and e.accuracy.limited_by == "calibration"
    if "focal" in undetermined or limits:
        name = max(undetermined, key=undetermined.__getitem__)
        text = (
            f"The recording does not determine the camera's {calibration_check.QUANTITIES[name]}: "
            f"the stated accuracy allows for an error of {calibration_check.usual_error(name)}."
        )
        motion = length(undetermined[name][0])
        if motion != length(0.0):  # else the views give no estimate
            text += f" It would move the poses by {motion}"
            if any(sensor.sensor == "odometry" and sensor.used for sensor in e.priors):
                text += ", but the recorded odometry, or the device's own poses, limit that"
            text += "."
    elif check.unconfirmed:
        correction = calibration_check.in_words(check.unconfirmed)
        text = (
            f"Views agree better with {correction}, but no loop closure confirms it: the stated "
            "accuracy includes its effect."
        )
    else:
        return
    yield Reason("unchecked_calibration", e.posed_range, text)


def _gap(e: Evidence) -> Iterator[Reason]:
    """The loop with the largest drift relative to its path length."""
    graph = e.optimisation.graph
    steps = np.linalg.norm(np.diff(e.sequential[:, :3, 3], axis=0), axis=1)
    turns = se3.angle(se3.inverse(e.sequential[:-1]) @ e.sequential[1:])
    drifted: list[tuple[float, int, int, float, float]] = []
    for (i, j), measured in zip(
        graph.edges[graph.loop], graph.measurements[graph.loop], strict=True
    ):
        a, b = min(i, j), max(i, j)
        gap = se3.inverse(measured) @ se3.inverse(e.sequential[i]) @ e.sequential[j]
        distance, angle = se3.lengths(gap).tolist()
        excess = max(
            distance / max(GAP_FLOOR_M, GAP_FRACTION * float(steps[a:b].sum())),
            angle / max(GAP_FLOOR_RAD, GAP_FRACTION * float(turns[a:b].sum())),
        )
        if excess > 1:
            drifted.append((excess, int(graph.ids[a]), int(graph.ids[b]), distance, angle))
    if not drifted:
        return
    _, first, last, distance, angle = max(drifted)
    closed = int(graph.loop.sum())
    count_note = f" {len(drifted)} of {closed} loops drifted too far; this is the worst." * (
        closed > 1
    )
    text = (
        f"Odometry drift over loop {first}-{last} was {length(distance)}, {_angle(angle)} before "
        f"it was closed.{count_note}"
    )
    yield Reason("loop_gap", ((first, last),), text)


def _images(e: Evidence) -> Iterator[Reason]:
    if e.cross_view is not None:
        yield from cross_view_reasons(e.cross_view, e.posed_range)


def cross_view_reasons(
    cross_view: cross_view_agreement.CrossViewConsistency,
    full_range: tuple[frame_ranges.Range, ...],
) -> Iterator[Reason]:
    """Yield reasons if overlapping images contradict the poses of a range of frames."""
    if not np.isfinite(cross_view.support()):
        return
    summary = (
        f"{percent(cross_view.support())} of overlapping measurements are consistent with the poses"
    )
    if np.isfinite(cross_view.rms_m()):
        summary += f" ({cross_view.rms_m() * 1e3:.1f} mm rms)"
    if cross_view.support() < MIN_SUPPORT:
        yield Reason("images_disagree", full_range, f"Only {summary}.")
        return
    texts = []
    inconsistent = frame_ranges.runs(
        cross_view.frames, [support < MIN_SUPPORT for support in cross_view.support_of_views()]
    )
    if inconsistent:
        texts.append(f"{_are(inconsistent)} inconsistent with most overlapping frames.")
    # Consecutive images share the errors of the sensor, but have hardly any drift. The bounds
    # include distances of surfaces, but not the fraction of inconsistent measurements.
    consecutive = [p for p in cross_view.pairs if p.j == p.i + 1]
    consecutive_support = cross_view.support(consecutive)
    if cross_view.support() < AGREEMENT_RATIO * consecutive_support:
        consecutive_text = (
            f"{percent(consecutive_support)} ({cross_view.rms_m(consecutive) * 1e3:.1f} mm rms)"
        )
        texts.append(f"{summary}, but {consecutive_text} in consecutive images.")
    if texts:
        yield Reason("images_differ", inconsistent or full_range, " ".join(texts))


def ranges_with_status(
    records: Sequence[FrameRecord], status: str
) -> tuple[frame_ranges.Range, ...]:
    """Return (first, last) frame index of each range of consecutive frames with that status."""
    return frame_ranges.runs([r.index for r in records], [r.status == status for r in records])


def _sentence(ranges: Sequence[frame_ranges.Range]) -> str:
    """Return ranges as the start of a sentence: "Frame 3", "Frames 3-9, 20"."""
    return frame_ranges.in_words(ranges).capitalize()


def _are(ranges: Sequence[frame_ranges.Range]) -> str:
    return f"{_sentence(ranges)} {'is' if frame_ranges.is_single(ranges) else 'are'}"


def _poses_of(ranges: Sequence[frame_ranges.Range]) -> str:
    single = frame_ranges.is_single(ranges)
    subject, verb = ("The pose", "is") if single else ("Poses", "are")
    return f"{subject} of {frame_ranges.in_words(ranges)} {verb}"


def _angle(rad: float) -> str:
    return f"{np.degrees(rad):.1f}°"
