"""The sequences of the benchmarks: real ones, if available, and simulated ones.

Real sequences are read from a data folder that is not part of the project. Simulated ones, with all
camera errors and factory correction, are created once and kept.
"""

from __future__ import annotations

import shutil
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Unpack

import numpy as np

from made_once import made_once
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.filters.base import Filter, apply_filters
from tofuse.engine.frames.frames import Frame, RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.mapping.adaptation import with_recording_defaults
from tofuse.engine.mapping.methods import default
from tofuse.formats.poses.trajectory import associated_poses, read_tum
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.methods.filters_foreground import Foreground
from tofuse.lab.simulation.record import PlanOptions, simulate

HERE = Path(__file__).resolve().parent
OUT = HERE / "out"
DATA = HERE.parents[1] / "shared" / "data"


@dataclass(frozen=True, eq=False)
class Sequence:
    """Input frames of all methods, and the reference.

    Attributes
    ----------
    title
        Description, including the camera.
    frames
        Decoded, corrected and filtered as for the tracker of the default method.
    cleaned
        The same after the filters of the default method for its model: for trackers without
        a per-pixel noise model.
    checked
        The recording for map consistency: unfiltered, except that an object is segmented.
    reference
        (N, 4, 4) T_world_camera, NaN where unknown.
    exact
        Whether the reference is ground truth.
    """

    title: str
    frames: tuple[RangeFrame, ...]
    cleaned: tuple[RangeFrame, ...]
    checked: Recording
    reference: Float64
    exact: bool


@dataclass(frozen=True)
class _Kind:
    title: str
    open: Callable[[Path], Recording]
    exact: bool
    farthest_m: float | None = None  # separates the object from the background
    referenced: bool = True


def load(name: str, data: Path, frames: int | None = None, *, fresh: bool = False) -> Sequence:
    """Read a sequence into memory; FileNotFoundError if its data is missing."""
    kind = KINDS[name]
    if fresh:
        shutil.rmtree(OUT / "recordings" / name, ignore_errors=True)
    recording = kind.open(data).select(end=frames)
    cut = () if kind.farthest_m is None else (Foreground(kind.farthest_m),)
    tracked, cleaned, bare = prepared(recording, cut)
    reference = recording.reference
    if reference is None:
        reference = np.full((len(tracked), 4, 4), np.nan)
    source = ArraySource(bare, reference, metadata=recording.metadata)
    return Sequence(
        f"{kind.title}, {len(tracked)} frames",
        tracked,
        cleaned,
        Recording.of(source, name, "benchmark"),
        reference,
        kind.exact,
    )


def prepared(
    recording: Recording, cut: tuple[Filter, ...] = ()
) -> tuple[tuple[RangeFrame, ...], tuple[RangeFrame, ...], list[Frame]]:
    """Return the frames for the default method's tracker, for its model, and unfiltered."""
    config = with_recording_defaults(default("range"), recording)
    correctors = [correction.start() for correction in config.corrections]
    past: deque[Frame] = deque(maxlen=config.window - 1)
    tracked, cleaned, bare = [], [], []
    for frame in recording:
        bare.append(apply_filters(cut, frame)[0])
        for corrector in correctors:
            frame = corrector.apply(frame)
        tracked.append(apply_filters((*cut, *config.filters), frame, past)[0])
        cleaned.append(apply_filters(config.model_filters, tracked[-1], past)[0])
        past.append(frame)
    return _images(tracked), _images(cleaned), bare


def _images(frames: Iterable[Frame]) -> tuple[RangeFrame, ...]:
    """Copies of the frames without cached derived data."""
    return tuple(replace(frame) for frame in frames if isinstance(frame, RangeFrame))


def recorded(*parts: str) -> Callable[[Path], Recording]:
    """Return a function that opens a recording below the folder of recorded sequences."""

    def opened(data: Path) -> Recording:
        path = data.joinpath(*parts)
        if not path.exists():
            raise FileNotFoundError(path)
        return open_recording(path)

    return opened


def kinect_loop(data: Path) -> Recording:
    """Stop-and-go views, with the poses of the robot that carried the camera."""
    recording = recorded("kinectv2_loop", "recording")(data)
    times, poses = read_tum(Path(recording.path) / "reference_poses.txt")
    recording.source.reference = associated_poses(recording.timestamps, times, poses)
    return recording


def simulated(name: str, scene: str, **options: Unpack[PlanOptions]) -> Callable[[Path], Recording]:
    """Return a function that opens a simulated recording, which is made at the first call."""

    def opened(_data: Path) -> Recording:
        path = OUT / "recordings" / name
        return open_recording(made_once(path, partial(simulate, scene, **options)))

    return opened


_SR4000 = "simulated SR4000, 176 x 144"

KINDS = {
    "kitchen": _Kind(
        "7-Scenes kitchen, Kinect v1, 640 x 480", recorded("sevenscenes_kitchen"), False
    ),
    "iphone": _Kind("Chair, iPhone LiDAR, 256 x 192", recorded("iphone_chair_3dscannerapp"), False),
    "kinect": _Kind("Loop round boxes, Kinect v2, 512 x 424", kinect_loop, False),
    "corridor": _Kind(
        "Corridor, SR4000, 176 x 144", recorded("sr4000_corridor"), False, referenced=False
    ),
    "room": _Kind(f"Furnished room, {_SR4000}", simulated("room", "room"), True),
    "empty-room": _Kind(
        f"Empty room, textured, {_SR4000}", simulated("empty-room", "empty-room"), True
    ),
    "empty-room-uniform": _Kind(
        f"Empty room, uniform albedo, {_SR4000}",
        simulated("empty-room-uniform", "empty-room", texture=False),
        True,
    ),
    "rail": _Kind(f"Rail, {_SR4000}", simulated("rail", "rail"), True),
    "torso": _Kind(f"Torso, turned, {_SR4000}", simulated("torso", "torso"), True, 2.2),
    "box": _Kind(f"Box, turned, {_SR4000}", simulated("box", "box"), True, 1.8),
}


def names() -> list[str]:
    """Return the names of the sequences that have a reference."""
    return [name for name, kind in KINDS.items() if kind.referenced]


def check(name: str) -> str:
    """Return the name if there is such a sequence; InputError if not."""
    if name not in KINDS:
        raise InputError(f"is {name!r}", where="--sequences", remedy=f"use some of {list(KINDS)}")
    return name
