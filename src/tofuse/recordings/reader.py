"""The interface of a reader."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol

from tofuse.errors import InputError
from tofuse.recordings.recording import Source

SURE = 0.9
UNSURE = 0.5


@dataclass(frozen=True)
class Sniff:
    """What a reader makes of a path at first sight.

    Attributes
    ----------
    confidence
        0 to 1; a path is opened unasked only from `SURE` on. 1 is for names and contents that
        no other format has.
    saw
        What speaks for it, for messages.
    settle
        What a person should do where the reader isn't sure.
    """

    confidence: float
    saw: str
    settle: str = ""


@dataclass(frozen=True)
class ReaderOptions:
    """What a person may add to what lies on disk.

    Attributes
    ----------
    camera
        A camera.json that replaces the recording's own.
    topic
        Of a bag, where the guessed one isn't wanted.
    """

    camera: Path | None = None
    topic: str | None = None


class Reader(Protocol):
    """Reads one format. Registered by ``@part("reader", name)`` in a module of `readers`.

    Attributes
    ----------
    joinable
        Whether a folder of such recordings is one recording, joined in name order.
    """

    part_kind: ClassVar[str] = "reader"
    joinable: ClassVar[bool]

    def sniff(self, path: Path) -> Sniff | None:
        """Look at names and first bytes; None if it is something else. Raises no errors."""
        ...

    def open(self, path: Path, options: ReaderOptions) -> Source:
        """Open a file or folder.

        Raises
        ------
        InputError
            If it can't be used as a whole.
        """
        ...


def refuse_camera(options: ReaderOptions, name: str) -> None:
    """Raise InputError if a camera was given for a format that brings its own points."""
    if options.camera is not None:
        raise InputError(
            f"means nothing for the format {name!r}, which stores points",
            where="--camera",
            remedy="leave it out",
        )
