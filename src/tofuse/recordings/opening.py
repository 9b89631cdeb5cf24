"""How a recording was opened, stored with a result so that it can be opened again."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from tofuse.errors import InputError
from tofuse.recordings.open import open_recording
from tofuse.recordings.recording import Recording
from tofuse.recordings.still import average_still


@dataclass(frozen=True, kw_only=True)
class OpeningOptions:
    """Options with which a recording is opened.

    Attributes
    ----------
    format, camera, topic
        See `open_recording`.
    start, end, every
        The selected frames, see `Recording.select`.
    average_still
        Whether stationary intervals are averaged to one frame each.
    """

    format: str | None = None
    camera: Path | None = None
    topic: str | None = None
    start: int = 0
    end: int | None = None
    every: int = 1
    average_still: bool = False


@dataclass(frozen=True)
class Opening(OpeningOptions):
    """Arguments with which a recording was opened; see `open_recording` and `tofuse run`.

    Attributes
    ----------
    paths
        Files or folders.
    """

    paths: tuple[Path, ...]

    @classmethod
    def of(cls, inputs: Iterable[str | Path], options: object) -> Opening:
        """Return the opening of files or folders with options named like the fields.

        Fields without an option keep their defaults.
        """
        names = [f.name for f in fields(cls) if hasattr(options, f.name)]
        return cls(tuple(map(Path, inputs)), **{name: getattr(options, name) for name in names})

    def open(self) -> Recording:
        """Open the recording; InputError if that fails."""
        recording = open_recording(
            *self.paths, format=self.format, camera=self.camera, topic=self.topic
        ).select(self.start, self.end, self.every)
        return average_still(recording) if self.average_still else recording

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, with absolute paths."""
        return {
            "paths": [str(path.absolute()) for path in self.paths],
            "format": self.format,
            "camera": None if self.camera is None else str(self.camera.absolute()),
            "topic": self.topic,
            "start": self.start,
            "end": self.end,
            "every": self.every,
            "average_still": self.average_still,
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], where: str | Path) -> Opening:
        """Return the inverse of `to_dict`; InputError naming `where` if the data is invalid."""
        try:
            paths = tuple(Path(str(path)) for path in data["paths"])
            camera, end = data["camera"], data["end"]
            opening = cls(
                paths,
                format=data["format"],
                camera=None if camera is None else Path(str(camera)),
                topic=data["topic"],
                start=int(data["start"]),
                end=None if end is None else int(end),
                every=int(data["every"]),
                average_still=bool(data["average_still"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError("does not state how its recording was opened", where=where) from error
        if not paths:
            raise InputError("names no recording", where=where)
        return opening
