"""Assessing poses from other sources: their consistency with the depth, and their accuracy.

The poses replace tracking; otherwise it is a run: loops are closed, and all views are refined
jointly. The error bound of the given poses is their distance from the refined ones plus the error
bound of those. If images contradict even the refined poses, the recording is tracked again, and the
trajectory with more support by the images counts.

Refined poses have errors too, mostly in poorly observable directions, so a distance from them does
not prove the given poses wrong. Pairs of views, registered around the refined poses, test that
(`evaluation.deviation`).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse.apps.inspection import convention_of
from tofuse.apps.jobs import pose_scale
from tofuse.apps.results import folders, run_json, write_result
from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounds
from tofuse.engine.compute import threads as use_threads
from tofuse.engine.errors import InputError
from tofuse.engine.frames import Recording, evenly_spaced, frame_ranges
from tofuse.engine.geometry import se3
from tofuse.engine.mapping import Config, adaptation, check_views, from_method, reconstructing
from tofuse.engine.parts import check_number
from tofuse.engine.progress import Progress, Silent
from tofuse.engine.quality import (
    cross_view_agreement,
    map_agreement,
    pose_accuracy,
    pose_deviation,
    trajectory_errors,
)
from tofuse.engine.results import Reason, Reconstruction, Verdict, accuracy_card, checks, verdicts
from tofuse.engine.stored_views import PosedView
from tofuse.engine.tracking import FrameTime, find_jumps, given
from tofuse.engine.views import PreparedView
from tofuse.formats.poses import TimedPoses, read_poses
from tofuse.formats.recordings import Opening, OpeningOptions, read_reference

Views = Sequence[PosedView[PreparedView]]

_length = accuracy_card.length

# Number of frames whose images are compared under the poses.
_CHECKED = 60
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
    refined
        The result of a refinement initialised with the poses; or of an independent run, if the
        images support that better.
    started
        Whether `refined` was initialised with the poses.
    scale
        Metres per unit of the poses as given; None if it can't be estimated, as from rotations.
    """

    poses: Float64
    accuracy: pose_accuracy.Accuracy
    verdict: Verdict
    reasons: tuple[Reason, ...]
    consistency: map_agreement.Consistency | None
    refined_consistency: map_agreement.Consistency | None
    deviation: pose_deviation.Deviation | None
    displacement_m: Float64
    refined: Reconstruction
    started: bool = True
    scale: pose_scale.PoseScale | None = None

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
            "scale": None if self.scale is None else asdict(self.scale),
            "refined": {
                "from_these_poses": self.started,
                "verdict": self.refined.diagnostics.verdict,
                "accuracy": run_json.accuracy_json(self.refined.diagnostics.accuracy),
                "map_consistency": _dict(self.refined_consistency),
            },
        }


def _dict(figures: Any) -> dict[str, Any] | None:
    return None if figures is None else figures.to_dict()


def judge(
    recording: Recording,
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
        Range images, as of `tofuse.open`.
    trajectory
        A file of any format of `files.trajectory_formats`, a result or its folder, a recording with
        poses, or (N, 4, 4) T_world_camera of the frames, NaN where there is none. Timed poses are
        assigned to the nearest frames in time, within 20 ms.
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
    progress = progress or Silent()
    if tolerance_m is not None:
        check_number(tolerance_m, Bounds(0, exclusive=True), "tolerance_m")
    poses = poses_for(recording, trajectory)
    kind = reconstructing.view_kind(recording)
    # External sensors do not measure these poses, and images are compared with the stated camera.
    config = replace(
        from_method("default", kind), tolerance_m=tolerance_m, priors=(), self_calibration=False
    )
    given_config = replace(config, odometry=given.GivenPoses())
    check_views(given_config, kind)

    @cache
    def view(k: int) -> PreparedView | None:
        frame = recording.image(k)
        return None if frame is None else cross_view_agreement.prepare_for_comparison(frame)

    def views_at(poses: Float64) -> dict[int, PreparedView]:
        posed = evenly_spaced(np.flatnonzero(np.isfinite(poses).all((1, 2))), _CHECKED).tolist()
        return {k: found for k in posed if (found := view(k)) is not None}

    def compared_at(poses: Float64) -> cross_view_agreement.CrossViewConsistency:
        views = views_at(poses)
        return cross_view_agreement.compare_views(list(views.values()), poses[list(views)])

    def reconstructed(
        source: Recording, config_used: Config
    ) -> tuple[Reconstruction, Views, cross_view_agreement.CrossViewConsistency]:
        result, views = reconstructing.reconstruct_with_views(
            source, config_used, threads=threads, progress=progress
        )
        return result, views, compared_at(result.trajectory)

    progress.stage("comparing images")
    as_given = compared_at(poses)
    compared = views_at(poses)
    estimate = pose_scale.estimated_scale(list(compared.values()), poses[list(compared)])
    if scale and estimate is None:
        raise InputError(
            "can't be estimated: too few views with translation between them fit",
            where="scale",
            remedy="leave out --scale, or pass poses of more frames",
        )
    if estimate is not None and (scale or estimate.is_other_unit):
        multiplied = pose_scale.with_scale(poses, estimate.factor)
        as_scaled = compared_at(multiplied)
        if scale or _support(as_scaled) > _support(as_given):
            poses, as_given, estimate = multiplied, as_scaled, replace(estimate, applied=True)
    started = reconstructed(adaptation.with_odometry(recording, poses), given_config)
    best = started
    if _support(as_given) < _SUPPORTED and (finding := convention_of(recording, poses)):
        progress.note(str(finding))
    if _support(started[2]) < _SUPPORTED:
        best = max(started, reconstructed(recording, config), key=lambda found: _support(found[2]))
    refined, views, as_refined = best
    progress.stage("registering pairs")
    with use_threads(threads), threadpool_limits(1):
        deviation = _deviation(poses, refined, views)
    distances = _distances(poses, refined.trajectory)
    accuracy = _accuracy(distances, poses, refined)
    reasons = verdicts.ranked(
        [*_reasons(poses, accuracy, deviation, as_given, as_refined, refined, tolerance_m)]
    )
    return Judgement(
        poses,
        accuracy,
        verdicts.verdict_of(reasons),
        reasons,
        _consistency(recording, poses),
        _consistency(recording, refined.trajectory),
        deviation,
        distances,
        refined,
        best is started,
        estimate,
    )


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
class JudgeOptions(OpeningOptions):
    """The options of ``tofuse judge``; see its ``--help``."""

    out: Path | None = None
    overwrite: bool = False
    tolerance: float | None = None
    scale: bool = False
    threads: int | None = None


def judge_files(
    inputs: Sequence[str | Path],
    trajectory: Path,
    options: JudgeOptions | None = None,
    progress: Progress | None = None,
) -> Judgement:
    """Judge the poses in a file, and write the refined result if an output folder is given.

    Raises
    ------
    InputError
        If the recording or the poses can't be used.
    OutputError
        If the result can't be written; an existing folder is then unchanged.
    """
    options, progress = options or JudgeOptions(), progress or Silent()
    opening = Opening.of(inputs, options)
    recording = opening.open()
    out = options.out
    with (
        nullcontext()
        if out is None
        else folders.OutputFolder(out, overwrite=options.overwrite) as folder
    ):
        judgement = judge(
            recording,
            trajectory,
            tolerance_m=options.tolerance,
            scale=options.scale,
            threads=options.threads,
            progress=progress,
        )
        facts = {**judgement.refined.recording, "opening": opening.to_dict()}
        judgement = replace(judgement, refined=replace(judgement.refined, recording=facts))
        if folder is not None:
            progress.stage("writing")
            with threadpool_limits(1):
                _write(judgement, trajectory, recording, folder)
    return judgement


def _write(
    judgement: Judgement, trajectory: Path, recording: Recording, folder: folders.OutputFolder
) -> None:
    """Write the refined result, with `judge.json` and the judgement as headline of the report."""
    from tofuse.apps.report import ReportExtras, write_report

    def report(result: Reconstruction, path: Path) -> None:
        headline = sentence(judgement, trajectory.name) if result is judgement.refined else ""
        title = f"{trajectory.name} on {Path(recording.path).name}"
        write_report(result, path / "report.html", ReportExtras(title, headline=headline))
        if result is judgement.refined:
            text = json.dumps(run_json.plain(judgement.to_dict()), indent=1, allow_nan=False)
            (path / "judge.json").write_text(text + "\n", encoding="utf-8")

    write_result(judgement.refined, folder, report)


def sentence(judgement: Judgement, name: str) -> str:
    """Summarise the judgement: "poses.txt: ±31 mm ...; refined: ±9 mm ..."."""
    diagonal = judgement.refined.cloud.diagonal_m
    given_bound = accuracy_card.bound(judgement.accuracy, diagonal)
    refined_bound = accuracy_card.bound(judgement.refined.diagnostics.accuracy, diagonal)
    label = "refined" if judgement.started else "tracked again"
    readable = [f.status != "skipped" for f in judgement.refined.diagnostics.frames]
    posed = np.isfinite(judgement.poses[readable, 0, 0])
    return (
        f"{name}{_scale(judgement.scale)}: {given_bound}, poses of {posed.sum()} of {len(posed)} "
        f"frames; {label}: {refined_bound}.{_agreement(judgement.deviation)}"
    )


def _scale(scale: pose_scale.PoseScale | None) -> str:
    """State the scale that was applied to the poses."""
    if scale is None or not scale.applied:
        return ""
    return f" times {scale.factor:.4g} \N{PLUS-MINUS SIGN} {scale.sigma:.1g} m (scale by depth)"


def _agreement(deviation: pose_deviation.Deviation | None) -> str:
    """State whether the depth contradicts the poses."""
    if deviation is None:
        return ""
    if not deviation.consistent:
        about, at_least = map(_length, (deviation.estimate_m, deviation.at_least_m))
        return (
            " Inconsistent with the depth: surfaces displaced by about "
            f"{about}, at least {at_least} (95 %)."
        )
    if not np.isfinite(deviation.at_most_m):
        return " Consistent with the depth, as far as that constrains them."
    return f" Consistent with the depth to within {_length(deviation.at_most_m)} (95 %)."


def _read(path: Path) -> TimedPoses:
    """Read a trajectory, or the poses in a recording, such as those of a phone."""
    try:
        return read_poses(path)
    except InputError as no_trajectory:
        try:
            return read_reference(path)
        except InputError:
            raise no_trajectory from None


def poses_for(recording: Recording, trajectory: str | Path | Float64 | Reconstruction) -> Float64:
    """Return the (N, 4, 4) poses of a recording's frames, NaN where there is none; see `judge`.

    Raises
    ------
    InputError
        If fewer than two frames have a pose, or an array has the wrong shape.
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
    distances: Float64, poses: Float64, refined: Reconstruction
) -> pose_accuracy.Accuracy:
    """Return the bound of the given poses: distance from the refined ones plus their bound."""
    refined_accuracy = refined.diagnostics.accuracy
    common = np.flatnonzero(np.isfinite(distances))
    if not refined_accuracy.assessed or not len(common):
        return refined_accuracy
    moved, turned = trajectory_errors.displacement(refined.trajectory[common], poses[common])
    # In the worst case both have the same direction.
    position, rotation = moved + refined_accuracy.position_m, turned + refined_accuracy.rotation_rad
    worst = int(common[np.argmax(distances[common])])
    at_worst = pose_accuracy.WorstFrame(
        int(refined.diagnostics.frames[worst].index),
        float(distances[worst]) + refined_accuracy.position_m,
        rotation,
    )
    if refined_accuracy.unbounded and refined_accuracy.worst is not None:
        at_worst = refined_accuracy.worst
    diagonal = refined.cloud.diagonal_m
    relative = position / diagonal if diagonal > 0 else np.inf
    return pose_accuracy.Accuracy(
        position, rotation, relative, True, at_worst, refined_accuracy.unbounded
    )


def _deviation(
    poses: Float64, refined: Reconstruction, views: Views
) -> pose_deviation.Deviation | None:
    """Compare the poses with registered pairs of views that have a given and a refined pose."""
    row_of = {f.index: k for k, f in enumerate(refined.diagnostics.frames)}
    common = np.flatnonzero(np.isfinite(poses[:, 0, 0]) & np.isfinite(refined.trajectory[:, 0, 0]))
    common_rows = set(common.tolist())
    posed = [view for view in views if row_of[view.index] in common_rows]
    if len(posed) < 2:
        return None
    rows = [row_of[view.index] for view in posed]
    depth_m = float(np.median([view.depth for view in posed]))
    fit = pose_deviation.fitted(
        pose_deviation.measured_pairs(posed, refined.trajectory[rows]), depth_m
    )
    return pose_deviation.deviation(fit, poses[rows]) if fit.dof > 0 else None


def _reasons(
    poses: Float64,
    accuracy: pose_accuracy.Accuracy,
    deviation: pose_deviation.Deviation | None,
    as_given: cross_view_agreement.CrossViewConsistency,
    as_refined: cross_view_agreement.CrossViewConsistency,
    refined: Reconstruction,
    tolerance_m: float | None,
) -> Iterator[Reason]:
    frames = refined.diagnostics.frames
    indices = [f.index for f in frames]
    full_range = ((indices[0], indices[-1]),)
    before, after = _overlapping(as_given), _overlapping(as_refined)
    if before < _MIN_OVERLAPPING * after:
        text = (
            f"Only {before:.0%} of the images overlap with another under these poses; under the "
            f"refined ones {after:.0%} do."
        )
        yield Reason("images_disagree", full_range, text)
    yield from checks.cross_view_reasons(as_given, full_range)
    allowed_m = checks.tolerance_of(tolerance_m, refined.cloud.diagonal_m)
    contradictions = (
        [] if deviation is None else [*_contradiction(deviation, allowed_m, full_range)]
    )
    yield from contradictions
    # Uncertain poses are no further reason if they are known to be wrong.
    yield from (
        r
        for r in checks.accuracy_reasons(accuracy, allowed_m, indices)
        if not contradictions or r.code != "uncertain_poses"
    )
    # The camera itself may have moved abruptly; then the refined poses jump as well.
    moments = [FrameTime(f.index, f.timestamp) for f in frames]
    actual_jumps = {k for k, _ in find_jumps(_or_none(refined.trajectory), moments)}
    jumped = {
        k: words for k, words in find_jumps(_or_none(poses), moments) if k not in actual_jumps
    }
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
    allowed_m: float,
    full_range: tuple[frame_ranges.Range, ...],
) -> Iterator[Reason]:
    """Yield a reason if poses contradict the depth by more than the tolerance."""
    if deviation.at_least_m <= allowed_m:
        return
    text = (
        f"Registrations contradict the poses: surfaces are displaced by about "
        f"{_length(deviation.estimate_m)} rms, at least {_length(deviation.at_least_m)} (95 %); "
        f"the tolerance is {_length(allowed_m)}."
    )
    steps = tuple((int(a), int(b)) for a, b in deviation.ids[deviation.steps])
    if steps:
        a, b = steps[0]
        text += f" The motion from frame {a} to {b} is wrong by itself"
        others = len(steps) - 1
        text += f", and {others} other{'' if others == 1 else 's'}." if others else "."
    yield Reason("inconsistent_poses", steps or full_range, text)


def _or_none(poses: Float64) -> list[Float64 | None]:
    return [T if np.isfinite(T).all() else None for T in poses]


def _consistency(recording: Recording, poses: Float64) -> map_agreement.Consistency | None:
    consistency = map_agreement.map_consistency(recording, poses)
    return consistency if consistency.pairs else None
