"""The recordings of a rig's cameras: named, checked, and made ready to be compared."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from tofuse.errors import InputError, UnreadableFrameError
from tofuse.filters.base import apply_filters
from tofuse.pipeline.adaptation import with_recording_defaults
from tofuse.pipeline.config import Config, from_method
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.open import open_recording
from tofuse.recordings.recording import Recording
from tofuse.registration.prepared_view import PreparedView, SurfaceOptions, prepare_view

_MOST_CAMERAS = 64


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera of a rig: what it is called, and what it recorded."""

    name: str
    recording: Recording

    @cached_property
    def config(self) -> Config:
        """How its images are prepared.

        Corrections that are tried first are left out: the trial asks how neighbouring views of a
        moving camera fit.
        """
        config = with_recording_defaults(from_method("default", "range"), self.recording)
        kept = tuple(c for c in config.corrections if not c.needs_trial)
        return replace(config, corrections=kept)

    def images(self, count: int) -> list[RangeFrame]:
        """Read up to `count` evenly spaced images.

        Raises
        ------
        InputError
            If none can be read, or it holds clouds.
        """
        frames = [frame for frame in self.recording.images(count) if len(frame)]
        if not frames:
            raise InputError(
                "has no image that can be read and holds a measurement",
                where=self.recording.path,
                remedy="check the recording with `tofuse inspect`",
            )
        return frames

    def image(self, k: int) -> RangeFrame | None:
        """Read image `k`; None if it can't be read, or is empty."""
        try:
            frame = self.recording[k]
        except UnreadableFrameError:
            return None
        return frame if isinstance(frame, RangeFrame) and len(frame) else None

    def every_image(self) -> Iterator[RangeFrame]:
        """Read all images that can be read."""
        for item in self.recording.read_all():
            if isinstance(item, RangeFrame):
                yield item

    def corrected(self, frame: RangeFrame) -> RangeFrame:
        """An image without the errors that can be known of it, and without bad points."""
        for correction in self.config.corrections:
            made = correction.start().apply(frame)
            frame = made if isinstance(made, RangeFrame) else frame
        filtered, _ = apply_filters(self.config.filters, frame, ())
        return filtered if isinstance(filtered, RangeFrame) else frame

    def surface(self, frame: RangeFrame) -> PreparedView:
        """An image as it is compared."""
        return prepare_view(self.corrected(frame), SurfaceOptions())


def open_cameras(paths: Sequence[str | Path], format: str | None = None) -> list[Camera]:  # noqa: A002
    """Open the recordings of a rig's cameras, each called after its file or folder.

    Raises
    ------
    InputError
        If there are fewer than two or too many, one can't be opened, or one is given twice.
    """
    if len(paths) < 2:
        raise InputError("is one camera", where="a rig", remedy="give two recordings or more")
    if len(paths) > _MOST_CAMERAS:
        raise InputError(
            f"has {len(paths)} cameras", where="a rig", remedy=f"give at most {_MOST_CAMERAS}"
        )
    resolved = [Path(path).resolve() for path in paths]
    for k, path in enumerate(resolved):
        if path in resolved[:k]:
            raise InputError("is given twice", where=paths[k], remedy="give each camera once")
    names = unique_names(resolved)
    return [
        Camera(name, open_recording(path, format=format))
        for name, path in zip(names, paths, strict=True)
    ]


def unique_names(paths: Sequence[Path]) -> list[str]:
    """Short names: the last parts of the paths, as many as tell them apart."""
    for parts in range(1, 1 + max(len(path.parts) for path in paths)):
        names = ["/".join(path.parts[-parts:]) for path in paths]
        if len(set(names)) == len(names):
            return names
    return [f"camera {k}" for k in range(len(paths))]


def overlap_of_times(cameras: Sequence[Camera]) -> float:
    """By how much all recordings overlap in time by their own clocks, s; negative: not at all."""
    begin = max(float(c.recording.timestamps[0]) for c in cameras)
    end = min(float(c.recording.timestamps[-1]) for c in cameras)
    return float(np.subtract(end, begin))
