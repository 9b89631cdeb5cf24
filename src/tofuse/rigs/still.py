"""Cameras that stand still: which of their images belong to one instant, and where the cameras are.

Where nothing moves, all images of a camera become one with less noise. Where something does, each
instant shows it from all sides at once, and all instants count together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofuse.maps.surface_map import SurfaceMap
from tofuse.pipeline.progress import Progress
from tofuse.posegraph.views import KeptView
from tofuse.recordings.background import FarSurface, far_surface
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.noise import noise_model_for
from tofuse.recordings.still import average_of, motion_between
from tofuse.rigs.clocks import lag_between
from tofuse.rigs.inputs import Camera
from tofuse.rigs.joint import Placed, View, refine_together
from tofuse.rigs.placing import Placement, place

Float64 = NDArray[np.float64]

# Frames that tell whether a camera stands still, and the share of its pixels that then do, in so
# many of them.
_LOOKED_AT, _STILL_PIXELS, _STILL_FRAMES = 12, 0.5, 0.75
# Instants of a moving scene, and images that are averaged of a still one.
_INSTANTS, _AVERAGED = 60, 48
# Points of a view: all instants together have about so many.
_POINTS, _LEAST_POINTS, _ALL_POINTS = 6000, 1500, 60_000
# Images of an instant are no further apart than this share of the time between images.
_SAME_INSTANT = 0.6


@dataclass(frozen=True, eq=False)
class StillRig:
    """What cameras that stand still tell of each other.

    Attributes
    ----------
    placement
        Which cameras could be placed.
    placed
        The refined poses of those, in the order of `cameras`.
    cameras
        (M,) the placed cameras, ascending.
    time_offsets
        (K,) of all cameras, s.
    instants
        How many there were.
    notes
        What a person should know.
    """

    placement: Placement
    placed: Placed
    cameras: tuple[int, ...]
    time_offsets: Float64
    instants: int
    notes: tuple[str, ...]


def stands_still(camera: Camera) -> bool:
    """Whether a camera does not move: most of its pixels see the same surface time and again."""
    frames = camera.images(_LOOKED_AT)
    if len(frames) < 3:
        model = noise_model_for(camera.recording)
        return len(frames) < 2 or motion_between(frames[0], frames[1], model).still
    return bool(_unchanged(frames) >= _STILL_PIXELS)


def _unchanged(frames: Sequence[RangeFrame]) -> float:
    """Share of the pixels that see the same surface in most of the frames."""
    far: FarSurface = far_surface(frames)
    seen = np.isfinite(far.z) & (far.z > 0)
    valid = np.mean([f.valid for f in frames], axis=0) > 0.5
    asked = valid | seen
    return float((far.share[asked] >= _STILL_FRAMES).mean()) if asked.any() else 1.0


def calibrate_still(cameras: Sequence[Camera], progress: Progress) -> StillRig:
    """Place and refine cameras that stand still against each other."""
    notes: list[str] = []
    progress.stage("instants")
    offsets, instants = _instants(cameras, notes)
    progress.stage("placing")
    placement = place([[None if v is None else v for v in row] for row in instants])
    order = tuple(sorted(placement.poses))
    progress.stage("refining")
    count = max((len(row) for row in instants), default=0)
    points = int(np.clip(_ALL_POINTS / max(count, 1), _LEAST_POINTS, _POINTS))
    views = [
        View(k, m, KeptView.of(view, points))
        for k, c in enumerate(order)
        for m, view in enumerate(instants[c])
        if view is not None
    ]
    placed = refine_together(views, np.stack([placement.poses[c] for c in order]))
    return StillRig(placement, placed, order, offsets, count, tuple(notes))


def _instants(
    cameras: Sequence[Camera], notes: list[str]
) -> tuple[Float64, list[list[SurfaceMap | None]]]:
    """Time offsets (K,), and for each camera its views of all instants."""
    offsets = np.zeros(len(cameras))
    sampled = [camera.images(_LOOKED_AT) for camera in cameras]
    if all(len(frames) == 1 for frames in sampled) or not any(map(_something_moves, cameras)):
        averaged = [[camera.surface(_average(camera))] for camera in cameras]
        return offsets, [list(row) for row in averaged]
    offsets = _time_offsets(cameras, notes)
    at = _common_times(cameras, offsets)
    rows: list[list[SurfaceMap | None]] = []
    for camera, offset in zip(cameras, offsets, strict=True):
        times = camera.recording.timestamps + offset
        near = np.abs(times[None] - at[:, None]).argmin(1)
        apart = np.abs(times[near] - at)
        interval = float(np.median(np.diff(times))) if len(times) > 1 else np.inf
        row: list[SurfaceMap | None] = []
        for k, far in zip(near, apart, strict=True):
            frame = camera.image(int(k)) if far <= _SAME_INSTANT * interval else None
            row.append(None if frame is None else camera.surface(frame))
        rows.append(row)
    return offsets, rows


def _something_moves(camera: Camera) -> bool:
    """Whether what a camera sees changes by more than noise."""
    frames = camera.images(_LOOKED_AT)
    model = noise_model_for(camera.recording)
    return any(not motion_between(frames[0], f, model).still for f in frames[1:])


def _average(camera: Camera) -> RangeFrame:
    frames = camera.images(_AVERAGED)
    if len(frames) == 1:
        return frames[0]
    return average_of(frames, noise_model_for(camera.recording))


def _common_times(cameras: Sequence[Camera], offsets: Float64) -> Float64:
    """Times of the instants: frames of the first camera that all others see too."""
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
    """What to add to each camera's timestamps, from how much of each view changes when."""
    signals = [_activity(camera) for camera in cameras]
    offsets = np.zeros(len(cameras))
    for k in range(1, len(cameras)):
        lag = lag_between(*signals[0], *signals[k])
        if lag is not None and lag.certain:
            offsets[k] = lag.seconds
        else:
            notes.append(
                f"{cameras[k].name}: when things move does not tell its clock; its timestamps are "
                f"taken to be those of {cameras[0].name}"
            )
    return offsets


def _activity(camera: Camera) -> tuple[Float64, Float64]:
    """Times (N,) and share of the pixels that changed since the frame before."""
    times, shares = [], []
    before: RangeFrame | None = None
    for frame in camera.every_image():
        if before is not None:
            both = before.valid & frame.valid
            change = np.abs(frame.z - before.z)[both]
            noise = float(np.median(change)) / 0.6745 if len(change) else 0.0
            limit = np.maximum(5 * noise, 0.01 * before.z[both])
            times.append(0.5 * (before.timestamp + frame.timestamp))
            shares.append(float((change > limit).mean()) if len(change) else 0.0)
        before = frame
    return np.array(times), np.array(shares)
