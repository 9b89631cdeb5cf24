"""The interface of a reader."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Protocol

from tofuse.engine.frames import Source
from tofuse.formats.files import reading


@dataclass(frozen=True)
class Sniff:
    """A reader's guess whether a path has its format.

    Attributes
    ----------
    confidence
        0 to 1; a path is opened automatically from `CERTAIN` on, not if `UNCERTAIN`. 1 is for names
        and contents that no other format has.
    evidence
        The evidence for the format, for messages.
    remedy
        What to do if the confidence is below `CERTAIN`.
    needs_camera
        Whether it would be certain if the user passed a camera.
    """

    CERTAIN: ClassVar[float] = 0.9
    UNCERTAIN: ClassVar[float] = 0.5

    confidence: float
    evidence: str
    remedy: str = ""
    needs_camera: bool = False

    @classmethod
    def by_camera_file(cls, path: Path, evidence: str, remedy: str) -> Sniff:
        """Return the guess for a folder of images: certain if it has a camera.json."""
        if reading.is_file(path / "camera.json"):
            return cls(1.0, f"{evidence} and camera.json")
        return cls(cls.UNCERTAIN, evidence, remedy, needs_camera=True)

    def with_camera(self) -> Sniff:
        """Return the guess if the user passed a camera; of several the order remains."""
        if not self.needs_camera:
            return self
        return replace(self, confidence=self.CERTAIN + (1 - self.CERTAIN) * self.confidence)


@dataclass(frozen=True)
class ReaderOptions:
    """Options of the user for opening a recording.

    Attributes
    ----------
    camera
        A camera.json that replaces the recording's own.
    topic
        Of a bag, instead of the detected one.
    factor
        By which all lengths will be multiplied, whatever their unit; None if they must be in m.
    """

    camera: Path | None = None
    topic: str | None = None
    factor: float | None = None


@dataclass(frozen=True)
class Reader(Protocol):
    """A reader of one format, registered by ``@part("reader", name)`` in a module of `readers`.

    Attributes
    ----------
    joinable
        Whether a folder of such recordings is joined to one recording, in name order.
    has_topics
        Whether `ReaderOptions.topic` selects one of several streams.
    """

    part_kind: ClassVar[str] = "reader"
    joinable: ClassVar[bool] = False
    has_topics: ClassVar[bool] = False

    def sniff(self, path: Path) -> Sniff | None:
        """Detect the format from names and first bytes; None if it is another one.

        An InputError, if something can't be read, is taken for None.
        """
        ...

    def open(self, path: Path, options: ReaderOptions) -> Source:
        """Open a file or folder.

        Raises
        ------
        InputError
            If the recording as a whole is unusable.
        """
        ...
