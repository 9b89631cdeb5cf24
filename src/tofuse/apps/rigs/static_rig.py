"""Calibration of static cameras: synchronisation of their images, and poses.

In a static scene the images of each camera are averaged. In a dynamic scene all cameras observe the
moving objects at each instant, and all instants are used jointly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import stdtr

from tofuse.apps.rigs.clocks import lag_between
from tofuse.apps.rigs.inputs import Calibration, Camera, disagreement_rows
from tofuse.apps.rigs.joint import RigView, distances_between, refine_together, refined_poses
from tofuse.apps.rigs.placing import place
from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.errors import InputError
from tofuse.engine.filters import BackgroundSurface, background_surface
from tofuse.engine.frames import RangeFrame, evenly_spaced
from tofuse.engine.geometry import se3
from tofuse.engine.noise import noise_model_for
from tofuse.engine.normal import robust_sigma
from tofuse.engine.progress import Progress
from tofuse.engine.stored_views import SampledView
from tofuse.engine.times import nearest
from tofuse.engine.views import PreparedView
from tofuse.formats.recordings import still
from tofuse.formats.rigs import Rig, RigCamera

# A camera is static if this fraction of its pixels measure the same surface in this fraction of the
# sampled frames.
_SAMPLED_FRAMES, _STATIC_PIXELS, _STATIC_FRAMES = 12, 0.5, 0.75
# Maximum number of instants of a dynamic scene, and of averaged images of a static one.
_MAX_INSTANTS, _MAX_AVERAGED = 60, 48
# Maximum and minimum number of points of a view, and target number over all instants.
_POINTS, _MIN_POINTS, _TOTAL_POINTS = 6000, 1500, 60_000
# Maximum time between the images of an instant, in frame intervals.
_MAX_INTERVALS = 0.6
# Standard deviation of a clock, in frames: images are paired to within half a frame.
_CLOCK_SIGMA = 0.3
# Maximum lag in either direction, in images; number of instants at which lags are compared; and the
# truncation of distances, as a fraction of the depth.
_MAX_LAG, _COMPARED_INSTANTS, _MAX_DISTANCE = 6, 10, 0.03
# Minimum number of instants to compare two lags, and the significance level: about a dozen lags
# are compared with the best one.
_MIN_INSTANTS, _SIGNIFICANCE = 5, 0.001


def is_static(camera: Camera) -> bool:
    """Whether a camera does not move: most pixels measure the same surface repeatedly."""
    frames = camera.images(_SAMPLED_FRAMES)
    if len(frames) < 3:
        model = noise_model_for(camera.recording)
        return len(frames) < 2 or still.change_between(frames[0], frames[1], model).still
    return bool(_static_fraction(frames) >= _STATIC_PIXELS)


def _static_fraction(frames: Sequence[RangeFrame]) -> float:
    """Return the fraction of pixels that measure the same surface in most of the frames."""
    background: BackgroundSurface = background_surface(frames)
    has_background = np.isfinite(background.z) & (background.z > 0)
    valid = np.mean([f.valid for f in frames], axis=0) > 0.5
    observed = valid | has_background
    return (
        float((background.static_fraction[observed] >= _STATIC_FRAMES).mean())
        if observed.any()
        else 1.0
    )


def calibrate_static(cameras: Sequence[Camera], progress: Progress) -> Calibration:
    """Place and refine static cameras relative to each other."""
    notes: list[str] = []
    progress.stage("instants")
    offsets, instants = _views_by_instant(cameras, notes)
    progress.stage("placing")
    placement = place(instants)
    order = tuple(sorted(placement.poses))
    progress.stage("refining")
    start = np.stack([placement.poses[c] for c in order])
    refined = refine_together(_views(instants, order), start)
    count = len(instants[0])
    if count > 1:
        progress.stage("clocks")
        times = _common_times(cameras, offsets)
        new_offsets = _refined_offsets(cameras, order, refined.poses, offsets, times, notes)
        if (new_offsets != offsets).any():
            offsets = new_offsets
            times = _common_times(cameras, offsets)
            instants = [_views_at(c, o, times) for c, o in zip(cameras, offsets, strict=True)]
            refined = refine_together(_views(instants, order), refined.poses)
        C = _clock_covariance(cameras, order, refined.poses, offsets, instants, times)
        random = refined.random_covariance + C
        refined = replace(refined, covariance=refined.covariance + C, random_covariance=random)
    rows = tuple(
        RigCamera(
            cameras[c].name,
            cameras[c].recording.path,
            refined.poses[k],
            refined.covariance[k][:6, :6],
            float(offsets[c]),
            -float(refined.offsets[k]),
            refined.random_covariance[k][:6, :6],
        )
        for k, c in enumerate(order)
    )
    pairs = disagreement_rows([row.name for row in rows], refined.disagreement)
    unplaced = {cameras[c].name: reason for c, reason in sorted(placement.reasons.items())}
    how = "one instant" if count == 1 else f"{count} instants"
    return Calibration(Rig(rows, pairs, unplaced), how, tuple(notes))


def _clock_covariance(
    cameras: Sequence[Camera],
    order: Sequence[int],
    poses: Float64,
    offsets: Float64,
    instants: Sequence[Sequence[PreparedView | None]],
    times: Float64,
) -> Float64:
    """Return the covariances (K, 7, 7) due to the clocks, by the change of poses per frame."""
    C = np.zeros((len(order), 7, 7))
    for c in order[1:]:
        delayed = list(instants)
        delayed[c] = _views_at(cameras[c], offsets[c] + _interval(cameras[c]), times)
        shifted = refined_poses(_views(delayed, order), poses)
        xi = _CLOCK_SIGMA * se3.log(se3.inverse(poses[1:]) @ shifted[1:])
        C[1:, :6, :6] += xi[:, :, None] * xi[:, None]
    return C


def _interval(camera: Camera) -> float:
    """Return the time between the images of a camera, s; inf for a single one."""
    times = camera.recording.timestamps
    return float(np.median(np.diff(times))) if len(times) > 1 else np.inf


def _views(
    instants: Sequence[Sequence[PreparedView | None]], order: Sequence[int]
) -> list[RigView]:
    """Return the views of the placed cameras, numbered in their order."""
    points = int(np.clip(_TOTAL_POINTS / max(len(instants[0]), 1), _MIN_POINTS, _POINTS))
    return [
        RigView(k, m, SampledView.of(view, points))
        for k, c in enumerate(order)
        for m, view in enumerate(instants[c])
        if view is not None
    ]


def _refined_offsets(
    cameras: Sequence[Camera],
    order: Sequence[int],
    poses: Float64,
    offsets: Float64,
    times: Float64,
    notes: list[str],
) -> Float64:
    """Return time offsets (K,) at which moving surfaces of all placed cameras coincide.

    The images of each camera are compared with those of the preceding cameras at several lags, one
    frame apart; the distance between surfaces is minimal at the correct lag, and quadratic nearby.
    A clock is corrected only if most instants agree on the lag (`minimum_cost_lag`).
    """
    corrected = offsets.copy()
    times = evenly_spaced(times, _COMPARED_INSTANTS)
    before: list[list[SampledView | None]] = []  # views of the preceding cameras
    for k, c in enumerate(order):
        if before:
            lags, costs = _costs_of_lags(cameras[c], corrected[c], times, before, poses[: k + 1])
            lag = minimum_cost_lag(lags, costs)
            if lag is None:
                notes.append(f"{cameras[c].name}: its clock can't be estimated from the motion")
            elif abs(lag) > 0.02 * _interval(cameras[c]):
                corrected[c] -= lag
        before.append([_sampled(view) for view in _views_at(cameras[c], corrected[c], times)])
    return corrected


def _costs_of_lags(
    camera: Camera,
    offset: float,
    times: Float64,
    before: Sequence[Sequence[SampledView | None]],
    poses: Float64,
) -> tuple[Float64, Float64]:
    """Return the lags (L,) of a camera, and its mean distances (M, L) from the preceding ones.

    `poses` are those of the preceding cameras and of this one.
    """
    stamps = camera.recording.timestamps + offset
    rows = nearest(stamps, times)[:, None] + np.arange(-_MAX_LAG, _MAX_LAG + 1)
    inside = (rows >= 0) & (rows < len(stamps))
    views: dict[int, SampledView | None] = {}
    for row in np.unique(rows[inside]).tolist():
        frame = camera.image(row)
        views[row] = None if frame is None else _sampled(camera.surface(frame))
    lags = stamps[rows.clip(0, len(stamps) - 1)] - times[:, None]
    costs = np.full(rows.shape, np.nan)
    for m, column in np.argwhere(inside):
        view = views[int(rows[m, column])]
        distances = [
            np.minimum(distances_between(target, view, T), _MAX_DISTANCE * target.depth)
            for T_rig_camera, instants in zip(poses, before, strict=False)
            if view is not None and (target := instants[m]) is not None
            for T in [se3.inverse(T_rig_camera) @ poses[-1]]
        ]
        if sum(map(len, distances)):
            costs[m, column] = np.concatenate(distances).mean()
    return np.ma.masked_where(np.isnan(costs), lags).mean(0).filled(np.nan), costs


def _sampled(surface: PreparedView | None) -> SampledView | None:
    return None if surface is None else SampledView.of(surface, _MIN_POINTS)


def minimum_cost_lag(lags: Float64, costs: Float64) -> float | None:
    """Return the interpolated lag of minimum cost; None at an end, or if it is not distinct.

    Of lags that are not significantly worse than the best one, as for a periodic motion, the
    smallest is taken. It is distinct if the lags two images away on both sides are worse. Costs are
    compared instant by instant, as static surfaces contribute equally to all lags of an instant.

    Parameters
    ----------
    lags
        (L,) s, ascending; NaN if unknown.
    costs
        (M, L) at M instants; NaN if unknown.
    """
    valid = np.isfinite(lags) & (np.isfinite(costs).sum(0) >= _MIN_INSTANTS)
    if valid.sum() < 5:
        return None
    lags, costs = lags[valid], costs[:, valid]
    mean = np.nanmean(costs, axis=0)
    worse = _are_worse(costs, int(np.argmin(mean)))
    best = int(np.argmin(np.where(worse, np.inf, np.abs(lags))))
    if not 2 <= best < len(lags) - 2 or not _are_worse(costs, best)[[best - 2, best + 2]].all():
        return None
    window = slice(best - 2, best + 3)
    curvature, slope, _ = np.polyfit(lags[window] - lags[best], mean[window], 2)
    if curvature <= 0:
        return None
    return float(np.clip(lags[best] - 0.5 * slope / curvature, lags[best - 1], lags[best + 1]))


def _are_worse(costs: Float64, column: int) -> Bool:
    """Whether (L,) the costs are significantly above those of a column (Student's t-test)."""
    d = np.ma.masked_invalid(costs - costs[:, [column]])
    count = d.count(0)
    standard_error = np.maximum(d.std(0, ddof=1) / np.sqrt(count), 1e-12)
    chance = stdtr(count - 1, -(d.mean(0) / standard_error).filled(0.0))
    return np.asarray((count >= _MIN_INSTANTS) & (chance < _SIGNIFICANCE))


def _views_by_instant(
    cameras: Sequence[Camera], notes: list[str]
) -> tuple[Float64, list[list[PreparedView | None]]]:
    """Return time offsets (K,), and for each camera the views of all instants."""
    offsets = np.zeros(len(cameras))
    images = [camera.images(_SAMPLED_FRAMES) for camera in cameras]
    if all(len(frames) == 1 for frames in images) or not any(map(_is_dynamic, cameras)):
        averaged = [[camera.surface(_average(camera))] for camera in cameras]
        return offsets, [list(row) for row in averaged]
    offsets = _time_offsets(cameras, notes)
    times = _common_times(cameras, offsets)
    return offsets, [_views_at(c, o, times) for c, o in zip(cameras, offsets, strict=True)]


def _views_at(camera: Camera, offset: float, times: Float64) -> list[PreparedView | None]:
    """Return the views of a camera at the rig's times; None where it has none."""
    limit = _MAX_INTERVALS * _interval(camera)
    rows = nearest(camera.recording.timestamps + offset, times, limit).tolist()
    frames = [camera.image(row) if row >= 0 else None for row in rows]
    return [None if frame is None else camera.surface(frame) for frame in frames]


def _is_dynamic(camera: Camera) -> bool:
    """Whether the scene changes by more than noise."""
    frames = camera.images(_SAMPLED_FRAMES)
    model = noise_model_for(camera.recording)
    return any(not still.change_between(frames[0], f, model).still for f in frames[1:])


def _average(camera: Camera) -> RangeFrame:
    frames = camera.images(_MAX_AVERAGED)
    one = len(frames) == 1
    return frames[0] if one else still.average_of(frames, noise_model_for(camera.recording))


def _common_times(cameras: Sequence[Camera], offsets: Float64) -> Float64:
    """Return the times of the instants: those of the first camera that all recordings cover."""
    begin = max(c.recording.timestamps[0] + o for c, o in zip(cameras, offsets, strict=True))
    end = min(c.recording.timestamps[-1] + o for c, o in zip(cameras, offsets, strict=True))
    times = cameras[0].recording.timestamps
    margin = 0.5 * _interval(cameras[0]) if len(times) > 1 else 0.0
    common = times[(times >= begin - margin) & (times <= end + margin)]
    if not len(common):
        common = times[:1]
    return evenly_spaced(common, _MAX_INSTANTS)


def _time_offsets(cameras: Sequence[Camera], notes: list[str]) -> Float64:
    """Return the initial (K,) offset to add to each camera's timestamps, s.

    It is 0 if the timestamps overlap; otherwise it is estimated by correlating the fractions of
    pixels that change over time.

    Raises
    ------
    InputError
        If the offset can't be determined.
    """
    offsets = np.zeros(len(cameras))
    first = cameras[0].recording.timestamps
    signal = None
    for k in range(1, len(cameras)):
        times = cameras[k].recording.timestamps
        overlap = min(first[-1], times[-1]) - max(first[0], times[0])
        if overlap > 0.2 * min(np.ptp(first), np.ptp(times)):
            continue
        signal = _activity(cameras[0]) if signal is None else signal
        lag = lag_between(*signal, *_activity(cameras[k]))
        if lag is None or not lag.certain:
            raise InputError(
                f"begins {times[0] - first[0]:+.1f} s after {cameras[0].name} by its clock, when "
                f"that had ended, and no motion that both see determines the offset of the clocks",
                where=cameras[k].recording.path,
                remedy="pass recordings of the same time",
            )
        offsets[k] = lag.seconds
        notes.append(
            f"the clock of {cameras[k].name} differs by {lag.seconds:.2f} s from that of "
            f"{cameras[0].name}, by the timing of motion"
        )
    return offsets


def _activity(camera: Camera) -> tuple[Float64, Float64]:
    """Return times (N,) and the fraction of pixels that changed since the previous frame."""
    times, fractions = [], []
    previous: RangeFrame | None = None
    for frame in camera.recording.read_all():
        if not isinstance(frame, RangeFrame):
            continue
        if previous is not None:
            valid = previous.valid & frame.valid
            change = np.abs(frame.z - previous.z)[valid]
            noise = robust_sigma(change) if len(change) else 0.0
            limit = np.maximum(5 * noise, 0.01 * previous.z[valid])
            times.append(0.5 * (previous.timestamp + frame.timestamp))
            fractions.append(float((change > limit).mean()) if len(change) else 0.0)
        previous = frame
    return np.array(times), np.array(fractions)
