"""Assessing poses from other sources: their consistency with the depth, and their accuracy.

As many views decide as show the whole path: a sample, spaced by the motion of the camera and with
the frames around jumps. Its poses replace tracking; loops are closed, and the views are refined
jointly. If images contradict even the refined poses, the recording is tracked, and the trajectory
with more support by the images counts.

Refined poses have errors too, mostly in poorly observable directions, so a distance from them does
not prove the given poses wrong. Pairs of views, registered around the refined poses, test that
(`pose_deviation`). The error bound is the distance from the refined poses and their own bound; for
poses that a run bounded by all of its frames, the run's bound, unless the sample contradicts it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse.apps.inspection import Finding, convention_of
from tofuse.apps.jobs import pose_scale
from tofuse.apps.results import folders, run_json, stated_accuracy, write_result
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.bounds import Bounds
from tofuse.engine.compute import threads as use_threads
from tofuse.engine.errors import InputError, signals_as_themselves
from tofuse.engine.frames import (
    DerivedSource,
    Frame,
    Recording,
    Source,
    evenly_spaced,
    frame_ranges,
)
from tofuse.engine.geometry import se3
from tofuse.engine.mapping import Config, adaptation, clips, from_method, reconstructing
from tofuse.engine.parts import check_number
from tofuse.engine.progress import Progress, receiver
from tofuse.engine.quality import (
    cross_view_agreement,
    map_agreement,
    pose_accuracy,
    pose_causes,
    pose_deviation,
    trajectory_errors,
)
from tofuse.engine.quantities import count, length, percent
from tofuse.engine.refinement import Joint, propagate_poses
from tofuse.engine.results import Reason, Reconstruction, Verdict, accuracy_card, checks, verdicts
from tofuse.engine.stored_views import PosedView, Spacing
from tofuse.engine.tracking import FrameTime, find_jumps, given
from tofuse.engine.views import PreparedView
from tofuse.formats.poses import TimedPoses, read_poses
from tofuse.formats.recordings import Opening, OpeningOptions, open_recording, read_reference
from tofuse.formats.rigs import check_one_camera

Views = Sequence[PosedView[PreparedView]]


# Motion between the views of the sample, that between keyframes, and the fewest of them.
_SPACING = Spacing(angle=0.2, distance=0.1)
_MIN_SAMPLE = 32
# Jumps whose frames are part of the sample.
_MAX_JUMPS = 20
# Frames of the sample that stay in memory.
_KEPT = 64
# Runs of views of the trial of a correction: two thirds of those of a run.
_TRIAL_RUNS = 8
# Earlier views that each one of the sample is refined with.
_NEIGHBOURS = 6
# Number of views that are compared under the poses, and of pairs for map consistency.
_COMPARED, _COMPARED_PAIRS = 40, 60
# With a smaller fraction of supporting measurements the recording is tracked again.
_SUPPORTED = 0.95
# With fewer overlapping views, relative to the refined poses, most poses are wrong.
_MIN_OVERLAPPING = 0.5


@dataclass(frozen=True, eq=False)
class Judgement:
    """Assessment of poses from another source by the depth images.

    Attributes
    ----------
    poses
        (N, 4, 4) T_world_camera of the frames as given, NaN where there is none; multiplied by the
        scale if that was applied.
    accuracy
        Of these poses.
    verdict, reasons
        As of a run.
    consistency, refined_consistency
        Map consistency of the given poses and of the refined ones; None if no two views overlap.
    deviation
        Deviation of these poses from pairwise registrations, and its significance; None if no two
        views could be compared.
    displacement_m
        (N,) distance of each given pose from the refined one after alignment, m; NaN where unknown.
    sampled
        The result of refining a sample of the views, without a surface.
    started
        Whether that began with the poses; if not, it is an independent run, which the images
        support better.
    scale
        Metres per unit of the poses as given; None if it can't be estimated, as from rotations.
    cause
        What is wrong with the poses, if one cause explains the deviation.
    finding
        That the poses fit in another convention or scale, if they do.
    """

    poses: Float64
    accuracy: pose_accuracy.Accuracy
    verdict: Verdict
    reasons: tuple[Reason, ...]
    consistency: map_agreement.Consistency | None
    refined_consistency: map_agreement.Consistency | None
    deviation: pose_deviation.Deviation | None
    displacement_m: Float64
    sampled: Reconstruction
    started: bool = True
    scale: pose_scale.PoseScale | None = None
    cause: pose_causes.Cause | None = None
    finding: Finding | None = None
    _reconstruct: Callable[[], Reconstruction] = field(kw_only=True, repr=False)

    @cached_property
    def refined(self) -> Reconstruction:
        """The result of all frames, as a run makes it; computed when it is first used.

        Where it began with the poses, it is of the frames that have one.
        """
        return self._reconstruct()

    def __repr__(self) -> str:
        return f"Judgement: {self.verdict}. {sentence(self, 'poses')}"

    def to_dict(self) -> dict[str, Any]:
        """Return the content of `judge.json`, with inf as it is."""
        return {
            "schema": 1,
            "verdict": self.verdict,
            "accuracy": run_json.accuracy_json(self.accuracy),
            "reasons": run_json.reasons_json(self.reasons),
            "frames": int(np.isfinite(self.poses[:, 0, 0]).sum()),
            "map_consistency": _dict(self.consistency),
            "deviation": _dict(self.deviation),
            "displacement_m": self.displacement_m,
            "cause": _dict(self.cause),
            "finding": _dict(self.finding),
            "scale": None if self.scale is None else asdict(self.scale),
            "refined": {
                "from_these_poses": self.started,
                "verdict": self.sampled.diagnostics.verdict,
                "accuracy": run_json.accuracy_json(self.sampled.diagnostics.accuracy),
                "map_consistency": _dict(self.refined_consistency),
            },
        }


def _dict(figures: Any) -> dict[str, Any] | None:
    return None if figures is None else figures.to_dict()


@signals_as_themselves()
def judge(
    recording: Recording | str | Path,
    trajectory: str | Path | Float64 | Reconstruction,
    *,
    tolerance_m: float | None = None,
    scale: bool = False,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Judgement:
    """Assess the accuracy of poses from any source, without a reference.

    Parameters
    ----------
    recording
        Range images, as of `tofuse.open`, or their path.
    trajectory
        A file in any supported format, a result or its folder, a recording with poses, or (N, 4, 4)
        T_world_camera of the frames, NaN where there is none. Timed poses are assigned to the
        nearest frames in time, within 20 ms.
    tolerance_m
        Accuracy required of good poses, m; see `Config`.
    scale
        Whether the poses are of unknown scale, which is then estimated from the depth and applied.
        Otherwise it is if it can't be that of metres, and the images agree better with it.
    threads
        Number of threads; None: all cores. The result does not depend on it.
    progress
        Shows the progress.

    Raises
    ------
    InputError
        If fewer than two frames have a pose, or the recording contains clouds; if the scale is
        unknown and can't be estimated.
    """
    progress = receiver(progress)
    if tolerance_m is not None:
        tolerance_m = check_number(tolerance_m, Bounds(0, exclusive=True), "tolerance_m")
    if not isinstance(recording, Recording):
        recording = open_recording(recording)
    check_one_camera(recording)
    given_poses = poses_for(recording, trajectory)
    config = _config(recording, tolerance_m)
    given_config = replace(
        config, odometry=given.GivenPoses(), refinement=Joint(neighbours=_NEIGHBOURS)
    )
    images = _Images(_sample_of(recording, given_poses), recording)
    with use_threads(threads), threadpool_limits(1):
        progress.stage("comparing images")
        poses, estimate = _in_metres(images, given_poses, required=scale)
        as_given = images.compared_at(poses[images.rows])
        given_config = adaptation.adapted(given_config, recording, threads, progress, _TRIAL_RUNS)
    refined = _refined(images, poses, as_given, (given_config, config), threads, progress)
    progress.stage("registering pairs")
    with use_threads(threads), threadpool_limits(1):
        used = _common(
            refined.views, poses, refined.poses, images.row_of, set(images.sample.indices.tolist())
        )
        deviation = _deviation(poses, refined.poses, used, images.row_of)
        cause = None
        # Another convention looks like drift.
        is_misread = refined.finding is not None and refined.finding.code == "poses_misread"
        if deviation is not None and not is_misread:
            velocity = _velocities(recording, poses)[[images.row_of[v.index] for v in used]]
            cause = pose_causes.cause_of(deviation, velocity)
        consistency, refined_consistency = _consistencies(
            images.sample, deviation, poses[images.rows], refined.poses[images.rows]
        )
    sampled = refined.result
    distances = _distances(poses, refined.poses)
    accuracy = _accuracy(
        distances, poses, refined.poses, images.rows, deviation, sampled, recording.indices
    )
    stated = _stated_accuracy(trajectory)
    if stated is not None and _holds(stated, accuracy, sampled.diagnostics.accuracy, deviation):
        accuracy = stated
    found = _reasons(
        recording,
        poses,
        refined.poses,
        accuracy,
        (deviation, cause),
        (as_given, refined.compared),
        checks.tolerance_of(tolerance_m, sampled.cloud.diagonal_m),
    )
    reasons = verdicts.ranked([*found])
    source = recording
    if refined.started:
        # Frames to which no pose was given are not lost.
        posed = recording.indices[np.isfinite(poses).all((1, 2))]
        source = replace(adaptation.with_odometry(recording, poses), indices=posed)
        config = replace(given_config, refinement=config.refinement)
    return Judgement(
        poses,
        accuracy,
        verdicts.verdict_of(reasons),
        reasons,
        consistency,
        refined_consistency,
        deviation,
        distances,
        sampled,
        refined.started,
        estimate,
        cause,
        refined.finding,
        _reconstruct=partial(
            reconstructing.reconstruct, source, config, threads=threads, progress=progress
        ),
    )


def _config(recording: Recording, tolerance_m: float | None) -> Config:
    """Return the configuration that judges the poses of a recording's images.

    External sensors do not measure these poses, and images are compared with the stated camera.
    """
    kind = reconstructing.view_kind(recording)
    if kind == "cloud":
        raise InputError(
            "contains clouds, and poses are judged by depth images",
            where=recording.path,
            remedy="compare the poses with a reference: tofuse evaluate",
        )
    return replace(
        from_method("default", kind), tolerance_m=tolerance_m, priors=(), self_calibration=False
    )


class _Images:
    """The images of a sample of a recording's frames, to compare them at poses (V, 4, 4).

    Attributes
    ----------
    sample, rows
        The sample, and the rows of its frames in the recording.
    row_of
        Row of each frame of the recording.
    """

    def __init__(self, sample: Recording, recording: Recording) -> None:
        self.sample, self.recording = sample, recording
        self.rows = np.searchsorted(recording.indices, sample.indices)
        self.row_of = {int(index): k for k, index in enumerate(recording.indices)}
        self._prepared: dict[int, PreparedView | None] = {}

    def views_at(self, poses: Float64) -> tuple[list[PreparedView], Float64]:
        """Return views of frames that have a pose, and their poses."""
        posed = evenly_spaced(np.flatnonzero(np.isfinite(poses).all((1, 2))), _COMPARED).tolist()
        views = {k: found for k in posed if (found := self._view(k)) is not None}
        return list(views.values()), poses[list(views)]

    def compared_at(self, poses: Float64) -> cross_view_agreement.CrossViewConsistency:
        """Compare the images."""
        return cross_view_agreement.compare_views(*self.views_at(poses))

    def _view(self, k: int) -> PreparedView | None:
        if k not in self._prepared:
            frame = self.sample.image(k)
            view = None if frame is None else cross_view_agreement.prepare_for_comparison(frame)
            self._prepared[k] = view
        return self._prepared[k]


def _in_metres(
    images: _Images, poses: Float64, *, required: bool
) -> tuple[Float64, pose_scale.PoseScale | None]:
    """Return poses in metres, and their scale, if it was estimated.

    It is applied if that is `required`, or if it can't be that of metres and the images agree
    better with it.
    """
    pairs = images.views_at(poses[images.rows])
    as_given = _support(images.compared_at(poses[images.rows]))
    estimate = pose_scale.first_scale(*pairs)
    if required or (as_given < _SUPPORTED if estimate is None else estimate.is_other_unit):
        estimate = pose_scale.estimated_scale(*pairs)
    if required and estimate is None:
        raise InputError(
            "can't be estimated: too few views with translation between them fit",
            where="scale",
            remedy="leave out --scale, or pass poses of more frames",
        )
    if estimate is None or not (required or estimate.is_other_unit):
        return poses, estimate
    multiplied = pose_scale.with_scale(poses, estimate.factor)
    if required or _support(images.compared_at(multiplied[images.rows])) > as_given:
        return multiplied, replace(estimate, applied=True)
    return poses, estimate


@dataclass(frozen=True, eq=False)
class _Refined:
    """Poses refined from the given ones, or tracked anew.

    Attributes
    ----------
    poses
        (N, 4, 4) of all frames.
    result, views
        The reconstruction, of the sample if `started`.
    compared
        The images at these poses.
    started
        Whether they were refined from the given ones.
    finding
        That the given ones fit in another convention or scale, if they do.
    """

    poses: Float64
    result: Reconstruction
    views: Views
    compared: cross_view_agreement.CrossViewConsistency
    started: bool
    finding: Finding | None = None


def _refined(
    images: _Images,
    poses: Float64,
    as_given: cross_view_agreement.CrossViewConsistency,
    configs: tuple[Config, Config],
    threads: int | None,
    progress: Progress,
) -> _Refined:
    """Refine the given poses; where images don't support them, track instead if that is better.

    Parameters
    ----------
    images, poses, as_given
        The images, poses (N, 4, 4) of all frames, and the comparison at these.
    configs
        To refine given poses, and to track.
    threads, progress
        As for `judge`.
    """
    recording, sample, rows = images.recording, images.sample, images.rows
    result, views = reconstructing.reconstruct_with_views(
        adaptation.with_odometry(sample, poses[rows]),
        configs[0],
        threads=threads,
        progress=progress,
    )
    refined_poses = _propagated(poses, rows, result.trajectory)
    refined = _Refined(refined_poses, result, views, as_given, True)
    if _support(as_given) >= _SUPPORTED:
        return refined
    if finding := convention_of(recording, poses):
        progress.note(str(finding))
        refined = replace(refined, finding=finding)
    refined = replace(refined, compared=images.compared_at(result.trajectory))
    if _support(refined.compared) >= _SUPPORTED:
        return refined
    tracked, views = reconstructing.reconstruct_with_views(
        recording, configs[1], threads=threads, progress=progress
    )
    as_tracked = images.compared_at(tracked.trajectory[rows])
    if _support(as_tracked) > _support(refined.compared):
        return _Refined(tracked.trajectory, tracked, views, as_tracked, False, refined.finding)
    return refined


class _Keeping(DerivedSource):
    """A source that keeps the first frames that are read."""

    def __init__(self, source: Source) -> None:
        super().__init__(source)
        self.frames: dict[int, Frame] = {}

    def read(self, index: int) -> Frame:
        """See `Source.read`."""
        if index in self.frames:
            return self.frames[index]
        frame = super().read(index)
        if len(self.frames) < _KEPT:
            self.frames[index] = frame
        return frame


def _sample_of(recording: Recording, poses: Float64) -> Recording:
    """Return the frames that are spaced by the motion of poses (N, 4, 4), and those at jumps."""
    posed = np.flatnonzero(np.isfinite(poses).all((1, 2)))
    indices = recording.indices[posed]
    spaced = clips.spaced_frames(
        recording, dict(zip(indices.tolist(), poses[posed], strict=True)), _SPACING
    )
    jumps = np.searchsorted(posed, [*_jumps(recording, poses)][:_MAX_JUMPS])
    at_jumps = [indices[k] for jump in jumps for k in (jump - 1, jump)]
    enough = len(spaced) >= _MIN_SAMPLE
    chosen = [*spaced, indices[-1]] if enough else evenly_spaced(indices, _MIN_SAMPLE).tolist()
    chosen = np.unique(np.array([*chosen, *at_jumps], np.intp))
    return replace(recording, source=_Keeping(recording.source), indices=chosen)


def _jumps(recording: Recording, poses: Float64) -> dict[int, str]:
    """Return the rows of poses (N, 4, 4) at which they jump, and what the jump is like."""
    times = zip(recording.indices.tolist(), recording.timestamps.tolist(), strict=True)
    known = [T if np.isfinite(T).all() else None for T in poses]
    return dict(find_jumps(known, [FrameTime(*of_frame) for of_frame in times]))


def _propagated(poses: Float64, rows: Intp, refined: Float64) -> Float64:
    """Return the refined poses of all frames, from those (V, 4, 4) of the sample at `rows`."""
    out = np.full_like(poses, np.nan)
    posed = np.flatnonzero(np.isfinite(poses).all((1, 2)))
    known = np.isfinite(refined).all((1, 2))
    out[posed] = propagate_poses(poses[posed], np.searchsorted(posed, rows[known]), refined[known])
    return out


def _velocities(recording: Recording, poses: Float64) -> Float64:
    """Return the motion (N, 6) of given poses per second, in the camera's frame."""
    out, times = np.full((len(poses), 6), np.nan), recording.timestamps
    posed = np.flatnonzero(np.isfinite(poses).all((1, 2)))
    last = np.arange(len(posed))
    before, after = posed[np.maximum(last - 1, 0)], posed[np.minimum(last + 1, len(posed) - 1)]
    seconds = times[after] - times[before]
    motion = se3.log(se3.inverse(poses[before]) @ poses[after])
    if recording.has_timestamps and (seconds > 0).all():
        out[posed] = motion / seconds[:, None]
    return out


def _overlapping(compared: cross_view_agreement.CrossViewConsistency) -> float:
    """Return the fraction of the views that overlap with another one."""
    support = compared.support_of_views()
    return float(np.isfinite(support).mean()) if len(support) else 0.0


def _support(compared: cross_view_agreement.CrossViewConsistency) -> float:
    """Return the fraction of the overlapping measurements that support the poses.

    It is reduced by the fraction of views that overlap with none.
    """
    return float(np.nan_to_num(compared.support())) * _overlapping(compared)


@dataclass(frozen=True)
class JudgeOptions(OpeningOptions, folders.OutputOptions):
    """The options of ``tofuse judge``; see its ``--help``."""

    tolerance: float | None = None
    scale: bool = False
    threads: int | None = None


def judge_files(
    inputs: Sequence[str | Path], trajectory: Path, options: JudgeOptions, progress: Progress
) -> Judgement:
    """Judge the poses in a file, and write the refined result if an output folder is given.

    Raises
    ------
    InputError
        If the recording or the poses can't be used.
    OutputError
        If the result can't be written; an existing folder is then unchanged.
    """
    opening = Opening.of(inputs, options)
    recording = opening.open()
    with options.folder() as folder:
        judgement = judge(
            recording,
            trajectory,
            tolerance_m=options.tolerance,
            scale=options.scale,
            threads=options.threads,
            progress=progress,
        )
        if folder is not None:
            refined = judgement.refined
            facts = {**refined.recording, "opening": opening.to_dict()}
            progress.stage("writing")
            with threadpool_limits(1):
                _write(judgement, replace(refined, recording=facts), trajectory, folder)
    return judgement


def _write(
    judgement: Judgement, refined: Reconstruction, trajectory: Path, folder: folders.OutputFolder
) -> None:
    """Write the refined result, with `judge.json` and the judgement as headline of the report."""
    from tofuse.apps.report import ReportExtras, write_report

    def report(result: Reconstruction, path: Path) -> None:
        headline = sentence(judgement, trajectory.name) if result is refined else ""
        title = f"{trajectory.name} on {Path(refined.recording['path']).name}"
        write_report(result, path / "report.html", ReportExtras(title, headline=headline))
        if result is refined:
            run_json.write_object(path / "judge.json", judgement.to_dict())

    write_result(refined, folder, report)


def sentence(judgement: Judgement, name: str) -> str:
    """Summarise the judgement: "poses.txt: ±31 mm ...; refined: ±9 mm ..."."""
    diagonal = judgement.sampled.cloud.diagonal_m
    given_bound = accuracy_card.bound(judgement.accuracy, diagonal)
    refined_bound = accuracy_card.bound(judgement.sampled.diagnostics.accuracy, diagonal)
    label = "refined" if judgement.started else "tracked again"
    posed = np.isfinite(judgement.poses[:, 0, 0])
    cause = "" if judgement.cause is None else f" The cause is probably {judgement.cause.text}."
    return (
        f"{name}{_scale(judgement.scale)}: {given_bound}, poses of {posed.sum()} of {len(posed)} "
        f"frames; {label}: {refined_bound}.{_agreement(judgement)}{cause}"
    )


def _scale(scale: pose_scale.PoseScale | None) -> str:
    """State the scale that was applied to the poses."""
    if scale is None or not scale.applied:
        return ""
    return f" times {scale.factor:.4g} \N{PLUS-MINUS SIGN} {scale.sigma:.1g} m (scale by depth)"


def _agreement(judgement: Judgement) -> str:
    """State whether the depth contradicts the poses."""
    deviation = judgement.deviation
    if deviation is None:
        return ""
    if not deviation.consistent:
        about, at_least = map(length, (deviation.estimate_m, deviation.at_least_m))
        beyond = any(r.code == "inconsistent_poses" for r in judgement.reasons)
        limit = "" if beyond else ", but not significantly beyond the tolerance"
        return (
            f" Inconsistent with the depth{limit}: surfaces displaced by about {about}, "
            f"at least {at_least} (95 %)."
        )
    if not np.isfinite(deviation.at_most_m):
        return " Consistent with the depth, as far as that constrains them."
    return f" Consistent with the depth to within {length(deviation.at_most_m)} (95 %)."


def _read(path: Path) -> TimedPoses:
    """Read a trajectory, or the poses in a recording, as of a phone, or else its odometry."""
    try:
        return read_poses(path)
    except InputError as no_trajectory:
        try:
            return read_reference(path, or_odometry=True)
        except InputError:
            raise no_trajectory from None


def poses_for(recording: Recording, trajectory: str | Path | Float64 | Reconstruction) -> Float64:
    """Return the (N, 4, 4) poses of a recording's frames, NaN where there is none; see `judge`.

    Raises
    ------
    InputError
        If there are fewer than two frames with a pose, or an array has the wrong shape.
    """
    where = "trajectory"
    if isinstance(trajectory, str | Path):
        path = Path(trajectory)
        where = str(path)
        poses = _read(path).of_frames(recording.timestamps, recording.indices)
    elif isinstance(trajectory, Reconstruction):
        timed = TimedPoses(trajectory.trajectory, timestamps=trajectory.timestamps)
        poses = timed.of_frames(recording.timestamps, recording.indices)
    else:
        poses = se3.check_poses(trajectory, where=where, count=len(recording))
    if len(recording) == 1:
        raise InputError(
            "has a single frame, whose pose nothing contradicts",
            where=recording.path,
            remedy="pass a recording of several",
        )
    n_posed = int(np.isfinite(poses).all((1, 2)).sum())
    if n_posed < 2:
        raise InputError(
            f"has a pose for {n_posed} of the {len(recording)} frames",
            where=where,
            remedy="pass timestamps in seconds on the clock of the recording",
        )
    return poses


def _distances(poses: Float64, refined: Float64) -> Float64:
    common = np.isfinite(poses[:, 0, 0]) & np.isfinite(refined[:, 0, 0])
    out = np.full(len(poses), np.nan)
    if common.any():
        out[common] = trajectory_errors.distances_between(poses[common], refined[common])
    return out


def _accuracy(
    distances: Float64,
    poses: Float64,
    refined_poses: Float64,
    rows: Intp,
    deviation: pose_deviation.Deviation | None,
    refined: Reconstruction,
    indices: Intp,
) -> pose_accuracy.Accuracy:
    """Return the bound of the given poses, from their distance from the refined ones.

    Unless images contradict the poses, that distance may be an error of either, and is independent
    of the bound of the refined ones. Otherwise both may have the same direction: the refinement
    began with the wrong poses. Between the `rows` of the sample, refined poses follow the given
    ones, whose noise shows only at these.
    """
    reference = refined.diagnostics.accuracy
    common = np.flatnonzero(np.isfinite(distances))
    if not reference.assessed or not len(common):
        return reference
    moved = np.max(
        [
            trajectory_errors.displacement(refined_poses[some], poses[some])
            for some in (common, np.intersect1d(common, rows))
            if len(some)
        ],
        axis=0,
    )
    stated = np.array([reference.position_m, reference.rotation_rad])
    consistent = deviation is not None and deviation.consistent
    position, rotation = (np.hypot(moved, stated) if consistent else moved + stated).tolist()
    worst = int(common[np.argmax(distances[common])])
    at_worst = pose_accuracy.WorstFrame(
        int(indices[worst]), float(distances[worst]) + reference.position_m, rotation
    )
    if reference.unbounded and reference.worst is not None:
        at_worst = reference.worst
    diagonal = refined.cloud.diagonal_m
    relative = position / diagonal if diagonal > 0 else np.inf
    return pose_accuracy.Accuracy(position, rotation, relative, True, at_worst, reference.unbounded)


def _stated_accuracy(
    trajectory: str | Path | Float64 | Reconstruction,
) -> pose_accuracy.Accuracy | None:
    """Return the accuracy that a run stated for its poses; None for other or edited ones."""
    if isinstance(trajectory, Reconstruction):
        return trajectory.diagnostics.accuracy
    if not isinstance(trajectory, str | Path):
        return None
    folder = folders.result_of_poses(Path(trajectory))
    if folder is None:
        return None
    try:
        return stated_accuracy(folder)
    except InputError:
        return None


def _holds(
    stated: pose_accuracy.Accuracy,
    found: pose_accuracy.Accuracy,
    reference: pose_accuracy.Accuracy,
    deviation: pose_deviation.Deviation | None,
) -> bool:
    """Whether images don't contradict poses, nor the refined poses the stated bound.

    Their distance is at most both bounds in quadrature; with the bound of the refined poses, that
    is the bound which was `found`.
    """
    if deviation is None or not deviation.consistent:
        return False
    return all(
        a**2 <= b**2 + 2 * c**2
        for a, b, c in (
            (found.position_m, stated.position_m, reference.position_m),
            (found.rotation_rad, stated.rotation_rad, reference.rotation_rad),
        )
    )


def _common(
    views: Views, poses: Float64, refined: Float64, row_of: dict[int, int], sample: set[int]
) -> Views:
    """Return the views of the sample that have a given and a refined pose (N, 4, 4)."""
    known = np.isfinite(poses[:, 0, 0]) & np.isfinite(refined[:, 0, 0])
    return [view for view in views if view.index in sample and known[row_of[view.index]]]


def _deviation(
    poses: Float64, refined: Float64, views: Views, row_of: dict[int, int]
) -> pose_deviation.Deviation | None:
    """Compare the poses with registered pairs of views, around the refined poses."""
    if len(views) < 2:
        return None
    rows = [row_of[view.index] for view in views]
    depth_m = float(np.median([view.depth for view in views]))
    fit = pose_deviation.fitted(pose_deviation.measured_pairs(views, refined[rows]), depth_m)
    return pose_deviation.deviation(fit, poses[rows]) if fit.dof > 0 else None


def _reasons(
    recording: Recording,
    poses: Float64,
    refined: Float64,
    accuracy: pose_accuracy.Accuracy,
    found: tuple[pose_deviation.Deviation | None, pose_causes.Cause | None],
    compared: tuple[
        cross_view_agreement.CrossViewConsistency, cross_view_agreement.CrossViewConsistency
    ],
    allowed_m: float,
) -> Iterator[Reason]:
    indices = recording.indices.tolist()
    full_range = ((indices[0], indices[-1]),)
    before, after = map(_overlapping, compared)
    if before < _MIN_OVERLAPPING * after:
        text = (
            f"Only {percent(before)} of the images overlap with another under these poses; under "
            f"the refined ones {percent(after)} do."
        )
        yield Reason("images_disagree", full_range, text)
    yield from checks.cross_view_reasons(compared[0], full_range)
    deviation, cause = found
    contradictions = (
        [] if deviation is None else [*_contradiction(deviation, cause, allowed_m, full_range)]
    )
    yield from contradictions
    # Uncertain poses are no further reason if they are known to be wrong.
    yield from (
        r
        for r in checks.accuracy_reasons(accuracy, allowed_m, indices)
        if not contradictions or r.code != "uncertain_poses"
    )
    # The camera itself may have moved abruptly; then the refined poses jump as well.
    actual = _jumps(recording, refined)
    jumped = {k: words for k, words in _jumps(recording, poses).items() if k not in actual}
    if jumped:
        first = next(iter(jumped))
        ranges = frame_ranges.runs_of(indices, [indices[k] for k in jumped])
        text = (
            f"The poses of {frame_ranges.in_words(ranges)} jump, and the refined ones don't; that "
            f"of frame {indices[first]} is {jumped[first]}."
        )
        yield Reason("jumped", ranges, text)


def _contradiction(
    deviation: pose_deviation.Deviation,
    cause: pose_causes.Cause | None,
    allowed_m: float,
    full_range: tuple[frame_ranges.Range, ...],
) -> Iterator[Reason]:
    """Yield a reason if poses contradict the depth by more than the tolerance."""
    if deviation.at_least_m <= allowed_m:
        return
    text = (
        f"Registrations contradict the poses: surfaces are displaced by about "
        f"{length(deviation.estimate_m)} rms, at least {length(deviation.at_least_m)} (95 %); "
        f"the tolerance is {length(allowed_m)}."
    )
    steps = tuple((int(a), int(b)) for a, b in deviation.ids[deviation.steps])
    if steps:
        a, b = steps[0]
        text += f" The motion from frame {a} to {b} is wrong by itself"
        others = len(steps) - 1
        text += f", and {count(others, 'other')}." if others else "."
    if cause is not None:
        text += f" The cause is probably {cause.text}."
    yield Reason("inconsistent_poses", steps or full_range, text)


def _consistencies(
    sample: Recording,
    deviation: pose_deviation.Deviation | None,
    given_poses: Float64,
    refined_poses: Float64,
) -> tuple[map_agreement.Consistency | None, map_agreement.Consistency | None]:
    """Return the map consistency of the sample under both poses, over pairs that overlap."""
    if deviation is None:
        return None, None
    ids, edges = deviation.fit.graph.ids, deviation.fit.graph.edges
    # Of every other eighth of the views, which overlap among each other.
    eighth = np.arange(len(ids)) * 8 // len(ids)
    edges = edges[(eighth[edges] % 2 == 0).all(1)]
    pairs = np.searchsorted(sample.indices, ids[evenly_spaced(edges, _COMPARED_PAIRS)])
    unit = sample.metadata.get("depth_unit_m")
    rows = np.unique(pairs)
    frames = [sample.image(k) for k in rows.tolist()]
    images = [map_agreement.SurfaceImage.of(frame, unit) for frame in frames if frame is not None]
    positions = [(int(i), int(j)) for i, j in np.searchsorted(rows, pairs)]

    def at(poses: Float64) -> map_agreement.Consistency | None:
        found = map_agreement.consistency_of_images(images, poses[rows], positions)
        return found if found.pairs else None

    return at(given_poses), at(refined_poses)
