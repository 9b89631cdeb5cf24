"""The recordings of a rig's cameras, checked and prepared for comparison; a calibration of them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from tofuse.engine.errors import InputError
from tofuse.engine.filters import apply_filters
from tofuse.engine.frames import RangeFrame, Recording
from tofuse.engine.mapping import Config, adaptation, from_method
from tofuse.engine.views import PreparedView, SurfaceOptions, prepare_view
from tofuse.formats.recordings import open_recording
from tofuse.formats.rigs import Disagreement, Rig

_MAX_CAMERAS = 64


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera of a rig: its name and its recording."""

    name: str
    recording: Recording

    @cached_property
    def config(self) -> Config:
        """The configuration that prepares its images.

        Corrections that need a trial are omitted: it compares consecutive views of a moving camera.
        """
        config = adaptation.with_recording_defaults(from_method("default", "range"), self.recording)
        corrections = tuple(c for c in config.corrections if not c.needs_trial)
        return replace(config, corrections=corrections)

    def images(self, count: int) -> list[RangeFrame]:
        """Read up to `count` evenly spaced images.

        Raises
        ------
        InputError
            If none can be read, or the recording contains clouds.
        """
        frames = [frame for frame in self.recording.images(count) if len(frame)]
        if not frames:
            raise InputError(
                "has no readable image with a valid measurement",
                where=self.recording.path,
                remedy="check the recording with `tofuse inspect`",
            )
        return frames

    @cached_property
    def first_image(self) -> str:
        """Digest of the depth of its first image; empty if that can't be read."""
        frame = self.image(0)
        return "" if frame is None else hashlib.sha256(frame.depth.tobytes()).hexdigest()

    def image(self, k: int) -> RangeFrame | None:
        """Read image `k`; None if it can't be read, or is empty."""
        return measured_image(self.recording, k)

    def surface(self, frame: RangeFrame) -> PreparedView:
        """Return an image prepared for comparison, after corrections and filters."""
        for correction in self.config.corrections:
            corrected = correction.start().apply(frame)
            frame = corrected if isinstance(corrected, RangeFrame) else frame
        filtered, _ = apply_filters(self.config.filters, frame, ())
        frame = filtered if isinstance(filtered, RangeFrame) else frame
        return prepare_view(frame, SurfaceOptions())


def measured_image(recording: Recording, k: int) -> RangeFrame | None:
    """Read image `k` of a recording; None if it can't be read, or is empty."""
    frame = recording.image(k)
    return frame if frame is not None and len(frame) else None


def open_cameras(
    paths: Sequence[str | Path],
    format: str | None = None,  # noqa: A002
    names: Sequence[str] | None = None,
    topic: str | None = None,
) -> list[Camera]:
    """Open the recordings of a rig's cameras, by default named after their files or folders.

    Raises
    ------
    InputError
        If there are fewer than two, too many, or not as many as names; if one can't be opened, is
        given twice, or has the name of another camera.
    """
    if names is not None and len(paths) != len(names):
        raise InputError(
            f"has {len(names)} cameras ({', '.join(names)}), and {len(paths)} recordings are given",
            where="the rig",
            remedy="pass one recording for each, in this order",
        )
    if not 2 <= len(paths) <= _MAX_CAMERAS:
        raise InputError(
            f"has {len(paths)} cameras", where="a rig", remedy=f"pass 2 to {_MAX_CAMERAS}"
        )
    resolved = [Path(path).resolve() for path in paths]
    for k, path in enumerate(resolved):
        if path in resolved[:k]:
            raise InputError("is given twice", where=paths[k], remedy="pass each camera once")
    own_names = unique_names(resolved)
    for name, own_name, recording in zip(names or own_names, own_names, paths, strict=True):
        if own_name != name and own_name in (names or ()):
            raise InputError(
                f"is given for the camera {name}, but has the name of another one of the rig",
                where=recording,
                remedy=f"pass the recordings in the order {', '.join(names or ())}, or rename it",
            )
    return [
        Camera(name, open_recording(path, format=format, topic=topic))
        for name, path in zip(names or own_names, paths, strict=True)
    ]


def unique_names(paths: Sequence[Path]) -> list[str]:
    """Return the shortest suffixes of the paths that are unique."""
    for parts in range(1, 1 + max(len(path.parts) for path in paths)):
        names = ["/".join(path.parts[-parts:]) for path in paths]
        if len(set(names)) == len(names):
            return names
    return [f"camera {k}" for k in range(len(paths))]


@dataclass(frozen=True, eq=False)
class Calibration:
    """The result of a rig calibration.

    Attributes
    ----------
    rig
        The placed cameras; those that could not be placed are in its `unplaced`.
    how
        "one instant", "n instants", or "a walk".
    notes
        Notes for the user.
    """

    rig: Rig
    how: str
    notes: tuple[str, ...] = ()


def disagreement_rows(
    names: Sequence[str], distances: Mapping[tuple[int, int], tuple[float, int]]
) -> tuple[Disagreement, ...]:
    """Return the distances between the surfaces of pairs of cameras with their names, in order."""
    return tuple(
        Disagreement(names[a], names[b], median, pixels)
        for (a, b), (median, pixels) in sorted(distances.items())
    )
