"""Calibration of static cameras: synchronisation of their images, and poses.

In a static scene the images of each camera are averaged. In a dynamic scene each instant shows the
moving objects from all sides at once, and all instants are used jointly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtr

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.geometry import se3
from tofuse.normal import MEDIAN_OF_NORMAL
from tofuse.pipeline.progress import Progress
from tofuse.posegraph.view_store import SampledView
from tofuse.recordings.background import FarSurface, far_surface
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.noise import noise_model_for
from tofuse.recordings.still import average_of, change_between
from tofuse.registration.prepared_view import PreparedView
from tofuse.rigs.clocks import lag_between
from tofuse.rigs.inputs import Camera
from tofuse.rigs.joint import Placed, View, distances_between, refine_together, refined_poses
from tofuse.rigs.placing import Placement, place

# A camera is static if this fraction of its pixels see the same surface in this fraction of the
# sampled frames.
_SAMPLED, _STILL_PIXELS, _STILL_FRAMES = 12, 0.5, 0.75
# Maximum number of instants of a dynamic scene, and of averaged images of a static one.
_INSTANTS, _AVERAGED = 60, 48
# Maximum and minimum number of points of a view, and target number over all instants.
_POINTS, _MIN_POINTS, _ALL_POINTS = 6000, 1500, 60_000
# Maximum time between images of an instant, as a fraction of the frame interval.
_SAME_INSTANT = 0.6
# Standard deviation of a clock, in frames: images are paired to within half of one.
_CLOCK = 0.3
# Maximum lag to either side, in images; number of instants at which lags are compared; and the
# truncation of distances, as a fraction of the depth.
_LAGS, _COMPARED, _FAR = 6, 10, 0.03
# Minimum number of instants that compare two lags, and the level of significance: about a dozen
# lags are compared with the best one.
_MIN_INSTANTS, _SIGNIFICANCE = 5, 0.001


@dataclass(frozen=True, eq=False)
class StillRig:
    """The calibration of static cameras.

    Attributes
    ----------
    placement
        Which cameras could be placed.
    placed
        Their refined poses, in the order of `cameras`.
    cameras
        (M,) the placed cameras, ascending.
    time_offsets
        (K,) of all cameras, s.
    instants
        Number of instants.
    notes
        Notes for the user.
    """

    placement: Placement
    placed: Placed
    cameras: tuple[int, ...]
    time_offsets: Float64
    instants: int
    notes: tuple[str, ...]


def stands_still(camera: Camera) -> bool:
    """Whether a camera does not move: most pixels see the same surface repeatedly."""
    frames = camera.images(_SAMPLED)
    if len(frames) < 3:
        model = noise_model_for(camera.recording)
        return len(frames) < 2 or change_between(frames[0], frames[1], model).still
    return bool(_unchanged(frames) >= _STILL_PIXELS)


def _unchanged(frames: Sequence[RangeFrame]) -> float:
    """Return the fraction of pixels that see the same surface in most of the frames."""
    far: FarSurface = far_surface(frames)
    seen = np.isfinite(far.z) & (far.z > 0)
    valid = np.mean([f.valid for f in frames], axis=0) > 0.5
    asked = valid | seen
    return float((far.static_fraction[asked] >= _STILL_FRAMES).mean()) if asked.any() else 1.0


def calibrate_still(cameras: Sequence[Camera], progress: Progress) -> StillRig:
    """Place and refine static cameras relative to each other."""
    notes: list[str] = []
    progress.stage("instants")
    offsets, instants = _instants(cameras, notes)
    progress.stage("placing")
    placement = place(instants)
    order = tuple(sorted(placement.poses))
    progress.stage("refining")
    placed = refine_together(_views(instants, order), np.stack([placement.poses[c] for c in order]))
    count = max((len(row) for row in instants), default=0)
    if count > 1:
        progress.stage("clocks")
        finer = _finer_offsets(cameras, order, placed, offsets, notes)
        if (finer != offsets).any():
            offsets = finer
            at = _common_times(cameras, offsets)
            instants = [_at_times(c, o, at) for c, o in zip(cameras, offsets, strict=True)]
            placed = refine_together(_views(instants, order), placed.poses)
        placed = _with_clock_errors(cameras, order, placed, offsets, instants)
    return StillRig(placement, placed, order, offsets, count, tuple(notes))


def _with_clock_errors(
    cameras: Sequence[Camera],
    order: Sequence[int],
    placed: Placed,
    offsets: Float64,
    instants: Sequence[Sequence[PreparedView | None]],
) -> Placed:
    """Add the uncertainty of the clocks to the covariances: how far poses move by one frame."""
    at = _common_times(cameras, offsets)
    by_clock = np.zeros_like(placed.covariance)
    for c in order[1:]:
        interval = float(np.median(np.diff(cameras[c].recording.timestamps)))
        late = list(instants)
        late[c] = _at_times(cameras[c], offsets[c] + interval, at)
        shifted = refined_poses(_views(late, order), placed.poses)
        for k in range(1, len(order)):
            xi = _CLOCK * se3.log(se3.inverse(placed.poses[k]) @ shifted[k])
            by_clock[k, :6, :6] += np.outer(xi, xi)
    return replace(
        placed,
        covariance=placed.covariance + by_clock,
        random_covariance=placed.random_covariance + by_clock,
    )


def _views(instants: Sequence[Sequence[PreparedView | None]], order: Sequence[int]) -> list[View]:
    """Return the views of the placed cameras, numbered in their order."""
    count = max((len(row) for row in instants), default=1)
    points = int(np.clip(_ALL_POINTS / count, _MIN_POINTS, _POINTS))
    return [
        View(k, m, SampledView.of(view, points))
        for k, c in enumerate(order)
        for m, view in enumerate(instants[c])
        if view is not None
    ]


def _finer_offsets(
    cameras: Sequence[Camera],
    order: Sequence[int],
    placed: Placed,
    offsets: Float64,
    notes: list[str],
) -> Float64:
    """Return time offsets (K,) at which moving surfaces of all placed cameras coincide.

    The images of each camera are compared with those of the cameras before it at several lags, a
    frame apart; the distance between surfaces is minimal at the correct lag, and quadratic nearby.
    A clock is corrected only if most instants agree on it (`minimum_cost_lag`).
    """
    out = offsets.copy()
    at = _common_times(cameras, offsets)
    at = at[np.unique(np.linspace(0, len(at) - 1, min(len(at), _COMPARED)).round().astype(int))]
    known = {0: [_kept(v) for v in _at_times(cameras[order[0]], out[order[0]], at)]}
    for k, c in enumerate(order):
        if k == 0:
            continue
        times = cameras[c].recording.timestamps
        interval = float(np.median(np.diff(times)))
        rows: dict[int, SampledView | None] = {}
        costs = np.full((len(at), 2 * _LAGS + 1), np.nan)
        lags = np.full(2 * _LAGS + 1, np.nan)
        for column, shift in enumerate(range(-_LAGS, _LAGS + 1)):
            apart: list[float] = []
            for m, t in enumerate(at):
                row = int(np.abs(times + out[c] - t).argmin()) + shift
                if not 0 <= row < len(times):
                    continue
                if row not in rows:
                    frame = cameras[c].image(row)
                    rows[row] = None if frame is None else _kept(cameras[c].surface(frame))
                view = rows[row]
                found = [np.zeros(0)]
                for other, theirs in known.items():
                    target = theirs[m]
                    if view is not None and target is not None:
                        T = se3.inverse(placed.poses[other]) @ placed.poses[k]
                        far = distances_between(target, view, T)
                        found.append(np.minimum(far, _FAR * target.depth))
                distances = np.concatenate(found)
                if len(distances):
                    costs[m, column] = distances.mean()
                    apart.append(float(times[row] + out[c] - t))
            if apart:
                lags[column] = np.mean(apart)
        lag = minimum_cost_lag(lags, costs)
        if lag is None:
            notes.append(f"{cameras[c].name}: its clock can't be estimated from the motion")
        elif abs(lag) > 0.02 * interval:
            out[c] -= lag
        known[k] = [_kept(v) for v in _at_times(cameras[c], out[c], at)]
    return out


def _kept(surface: PreparedView | None) -> SampledView | None:
    return None if surface is None else SampledView.of(surface, _MIN_POINTS)


def minimum_cost_lag(lags: Float64, costs: Float64) -> float | None:
    """Return the interpolated lag of minimum cost; None at an end, or if it is not distinct.

    Of lags that are not significantly worse than the best one, as for a periodic motion, the
    smallest is taken. It is distinct if lags two images away on both sides are worse. Costs are
    compared instant by instant, as what stands still contributes alike to all lags of an instant.

    Parameters
    ----------
    lags
        (L,) s, ascending; NaN if unknown.
    costs
        (M, L) of M instants, NaN if unknown.
    """
    known = np.isfinite(lags) & (np.isfinite(costs).sum(0) >= _MIN_INSTANTS)
    if known.sum() < 5:
        return None
    lags, costs = lags[known], costs[:, known]
    mean = np.nanmean(costs, axis=0)
    least = int(np.argmin(mean))
    alike = [k for k in range(len(lags)) if not _is_positive(costs[:, k] - costs[:, least])]
    best = min(alike, key=lambda k: abs(lags[k]))
    if not 2 <= best < len(lags) - 2:
        return None
    if not all(_is_positive(costs[:, best + k] - costs[:, best]) for k in (-2, 2)):
        return None
    near = slice(best - 2, best + 3)
    bend, slope, _ = np.polyfit(lags[near] - lags[best], mean[near], 2)
    if bend <= 0:
        return None
    step = float(
        np.clip(-0.5 * slope / bend, lags[best - 1] - lags[best], lags[best + 1] - lags[best])
    )
    return float(lags[best] + step)


def _is_positive(differences: Float64) -> bool:
    """Whether the mean of differences (M,) is significantly above 0 (Student's t-test)."""
    d = differences[np.isfinite(differences)]
    if len(d) < _MIN_INSTANTS:
        return False
    error = float(d.std(ddof=1)) / np.sqrt(len(d))
    return bool(d.mean() > 0 and stdtr(len(d) - 1, -d.mean() / max(error, 1e-12)) < _SIGNIFICANCE)


def _instants(
    cameras: Sequence[Camera], notes: list[str]
) -> tuple[Float64, list[list[PreparedView | None]]]:
    """Return time offsets (K,), and the views of all instants by camera."""
    offsets = np.zeros(len(cameras))
    sampled = [camera.images(_SAMPLED) for camera in cameras]
    if all(len(frames) == 1 for frames in sampled) or not any(map(_something_moves, cameras)):
        averaged = [[camera.surface(_average(camera))] for camera in cameras]
        return offsets, [list(row) for row in averaged]
    offsets = _time_offsets(cameras, notes)
    at = _common_times(cameras, offsets)
    return offsets, [_at_times(c, o, at) for c, o in zip(cameras, offsets, strict=True)]


def _at_times(camera: Camera, offset: float, at: Float64) -> list[PreparedView | None]:
    """Return the views of a camera at the rig's times; None where it has none."""
    times = camera.recording.timestamps + offset
    near = np.abs(times[None] - at[:, None]).argmin(1)
    apart = np.abs(times[near] - at)
    interval = float(np.median(np.diff(times))) if len(times) > 1 else np.inf
    row: list[PreparedView | None] = []
    for k, far in zip(near, apart, strict=True):
        frame = camera.image(int(k)) if far <= _SAME_INSTANT * interval else None
        row.append(None if frame is None else camera.surface(frame))
    return row


def _something_moves(camera: Camera) -> bool:
    """Whether the scene changes by more than noise."""
    frames = camera.images(_SAMPLED)
    model = noise_model_for(camera.recording)
    return any(not change_between(frames[0], f, model).still for f in frames[1:])


def _average(camera: Camera) -> RangeFrame:
    frames = camera.images(_AVERAGED)
    if len(frames) == 1:
        return frames[0]
    return average_of(frames, noise_model_for(camera.recording))


def _common_times(cameras: Sequence[Camera], offsets: Float64) -> Float64:
    """Return the times of the instants: those of the first camera that all recordings cover."""
    begin = max(c.recording.timestamps[0] + o for c, o in zip(cameras, offsets, strict=True))
    end = min(c.recording.timestamps[-1] + o for c, o in zip(cameras, offsets, strict=True))
    times = cameras[0].recording.timestamps
    margin = 0.5 * float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    shared = times[(times >= begin - margin) & (times <= end + margin)]
    if not len(shared):
        shared = times[:1]
    at = np.unique(np.linspace(0, len(shared) - 1, min(len(shared), _INSTANTS)).round().astype(int))
    return np.asarray(shared[at], np.float64)


def _time_offsets(cameras: Sequence[Camera], notes: list[str]) -> Float64:
    """Return the initial (K,) offset to add to each camera's timestamps, s.

    It is 0 if the timestamps overlap; otherwise the fractions of pixels that change over time are
    correlated.

    Raises
    ------
    InputError
        If the offset can't be determined.
    """
    offsets = np.zeros(len(cameras))
    first = cameras[0].recording.timestamps
    signal = None
    for k in range(1, len(cameras)):
        own = cameras[k].recording.timestamps
        shared = min(first[-1], own[-1]) - max(first[0], own[0])
        if shared > 0.2 * min(np.ptp(first), np.ptp(own)):
            continue
        signal = _activity(cameras[0]) if signal is None else signal
        lag = lag_between(*signal, *_activity(cameras[k]))
        if lag is None or not lag.certain:
            raise InputError(
                f"begins {own[0] - first[0]:+.1f} s after {cameras[0].name} by its clock, when "
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
    """Return times (N,) and the fraction of pixels that changed since the frame before."""
    times, fractions = [], []
    before: RangeFrame | None = None
    for frame in camera.every_image():
        if before is not None:
            both = before.valid & frame.valid
            change = np.abs(frame.z - before.z)[both]
            noise = float(np.median(change)) / MEDIAN_OF_NORMAL if len(change) else 0.0
            limit = np.maximum(5 * noise, 0.01 * before.z[both])
            times.append(0.5 * (before.timestamp + frame.timestamp))
            fractions.append(float((change > limit).mean()) if len(change) else 0.0)
        before = frame
    return np.array(times), np.array(fractions)
