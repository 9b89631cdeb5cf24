"""Small recordings in manufacturers' formats, and a full read of one."""

from __future__ import annotations

from collections.abc import Callable
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


def read_through(
    path: Path, format_: str | None, camera: Path | None = None
) -> tuple[int, int, int]:
    """Read every frame; return the numbers of readable and unreadable ones, and of rejections."""
    whole = unread = 0
    errors: list[TofuseError] = []
    try:
        for item in open_recording(path, format=format_, camera=camera).read_all():
            if isinstance(item, TofuseError):
                unread += 1
                errors.append(item)
            else:
                assert np.isfinite(item.points).all()
                whole += 1
    except TofuseError as error:
        errors.append(error)
    assert all(len(str(error).splitlines()) == 1 and error.where for error in errors)
    return whole, unread, len(errors) - unread
