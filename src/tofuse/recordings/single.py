"""A single view by its name: a file with one frame, or `REC#12`, frame 12 of a recording."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.recordings.cloud_files import describe_shift
from tofuse.recordings.frames import Frame
from tofuse.recordings.open import open_recording

MIN_POINTS = 10


@dataclass(frozen=True, eq=False)
class SingleView:
    """A frame and its origin.

    Attributes
    ----------
    name
        As the user wrote it.
    path, format, index
        The recording, its reader, and the index of the frame.
    frame
        The view.
    shift
        (3,) m, to add to coordinates of the frame to get those of the file. Nonzero only for clouds
        in map coordinates.
    warnings
        Notes for the user on how it was read.
    """

    name: str
    path: str
    format: str
    index: int
    frame: Frame
    shift: Float64
    warnings: tuple[str, ...] = ()


def open_view(
    name: str,
    *,
    format: str | None = None,  # noqa: A002
    camera: Path | None = None,
    topic: str | None = None,
) -> SingleView:
    """Read the view called `name`; for the options see `open_recording`.

    Raises
    ------
    InputError
        If there is no such frame, the recording has several and `name` doesn't state which, or the
        frame can't be read or has fewer than ten points.
    """
    path, index = split_name(name)
    recording = open_recording(path, format=format, camera=camera, topic=topic)
    count = len(recording)
    if index is None and count > 1:
        raise InputError(
            f"contains {count} frames",
            where=name,
            remedy=f"choose one: {name}#0 to {name}#{count - 1}",
        )
    index = index or 0
    if index >= count:
        available = "its only frame is 0" if count == 1 else f"its frames are 0 to {count - 1}"
        raise InputError(f"has no frame {index}", where=path, remedy=available)
    frame = recording[index]
    if len(frame) < MIN_POINTS:
        raise InputError(
            f"has {len(frame)} valid points",
            where=name,
            remedy=f"use a view with {MIN_POINTS} or more",
        )
    shift = np.asarray(recording.metadata.get("shift_m", np.zeros(3)), float)
    # The shift is returned with the view, so a warning about it would mislead.
    shift_note = describe_shift(shift)
    warnings = tuple(line for line in recording.warnings if not line.endswith(shift_note))
    return SingleView(name, path, recording.format, index, frame, shift, warnings)


def split_name(name: str) -> tuple[str, int | None]:
    """Return the path and the frame index in `name`; None if it has no index.

    An existing path is taken literally, with any # in it.
    """
    if "#" not in name or os.path.lexists(name):
        return name, None
    path, _, frame = name.rpartition("#")
    if not (frame.isascii() and frame.isdecimal()):
        raise InputError(
            f"has the frame index {frame!r}",
            where=name,
            remedy="write a whole number after the #, such as recording#12",
        )
    return path, int(frame)
