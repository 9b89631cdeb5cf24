"""Small recordings in manufacturers' formats, and a full read of one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import made_arrays
import made_dumps
import made_exports
import made_ifm
import made_kinect
import made_phones
import made_sens
import made_tof
from tofuse.errors import TofuseError
from tofuse.recordings.frames import Frame
from tofuse.recordings.open import open_recording

# Function that writes a recording, name of its file (None: a folder), and its format.
MAKERS: dict[str, tuple[Callable[[Path], None], str | None, str]] = {
    "3dscannerapp": (made_phones.make_scanner_app, None, "3dscannerapp"),
    "stray": (made_phones.make_stray, None, "stray"),
    "record3d": (made_phones.make_record3d, None, "record3d"),
    "mkv": (made_kinect.make_small_mkv, "a.mkv", "azure-kinect"),
    "o3r": (made_ifm.make_o3r, "a.data", "ifm-o3r"),
    "npz": (made_arrays.make_npz, "a.npz", "npz"),
    "sens": (made_sens.make_sens, "a.sens", "sens"),
    "zense": (made_arrays.make_zense, None, "zense"),
    "helios": (made_exports.make_helios, None, "grid"),
    "csv": (made_exports.make_csv, None, "grid"),
    "r3d": (made_phones.make_r3d, "scan.r3d", "record3d"),
    "polycam": (made_dumps.make_polycam, None, "polycam"),
    "nerfstudio": (made_dumps.make_nerfstudio, None, "nerfstudio"),
    "nerfcapture": (made_dumps.make_nerfcapture, None, "nerfstudio"),
    "hololens2": (made_dumps.make_hololens, None, "hololens2"),
    "kinect2": (made_dumps.make_kinect2, None, "kinect2"),
    "depth16": (made_dumps.make_depth16, None, "depth16"),
    "arducam": (made_tof.make_arducam, None, "arducam"),
    "aditof": (made_tof.make_aditof, "a.bin", "aditof"),
}


@dataclass
class Read:
    """The readable frames of a recording, the number of others, and whether it was refused."""

    frames: list[Frame] = field(default_factory=list)
    unread: int = 0
    refused: bool = False
    warnings: list[str] = field(default_factory=list)


def read_frames(path: Path, format_: str | None, camera: Path | None = None) -> Read:
    """Read every frame; errors must have one line and a place."""
    read = Read()
    errors: list[TofuseError] = []
    try:
        recording = open_recording(path, format=format_, camera=camera)
        for item in recording.read_all():
            if isinstance(item, TofuseError):
                read.unread += 1
                errors.append(item)
            else:
                assert np.isfinite(item.points).all()
                read.frames.append(item)
        read.warnings = list(recording.warnings)
    except TofuseError as error:
        read.refused = True
        errors.append(error)
    assert all(len(str(error).splitlines()) == 1 and error.where for error in errors)
    return read


def read_through(
    path: Path, format_: str | None, camera: Path | None = None
) -> tuple[int, int, int]:
    """Read every frame; return the numbers of readable and unreadable ones, and of rejections."""
    read = read_frames(path, format_, camera)
    return len(read.frames), read.unread, int(read.refused)
