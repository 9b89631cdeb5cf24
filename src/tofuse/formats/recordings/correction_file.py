"""The correction.npz of a recording, and its application to depth images."""

from __future__ import annotations

import zipfile
from pathlib import Path

from tofuse.engine.arrays import Float32
from tofuse.engine.errors import InputError
from tofuse.engine.cameras.cameras import Camera, range_from_z, z_from_range
from tofuse.engine.frames.frames import DepthKind
from tofuse.engine.sensor.depth_correction import DepthCorrection

_MAX_BYTES = 1 << 30


def read_correction(path: Path) -> DepthCorrection:
    """Read a correction.npz; InputError if it is invalid, or decompresses to an absurd size."""
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(item.file_size for item in archive.infolist())
    except (OSError, ValueError, zipfile.BadZipFile):
        size = 0  # reported by the loader
    try:
        if size <= _MAX_BYTES:
            return DepthCorrection.load(path)
    except MemoryError:
        pass
    raise InputError(
        "decompresses to more than a correction can be", where=path, remedy="write it again"
    )


def corrected_depth(
    correction: DepthCorrection, camera: Camera, depth: Float32, kind: DepthKind
) -> Float32:
    """Return depth (H, W) in m of the given kind, after correction of its radial range."""
    if kind == "range":
        return correction.correct(depth)
    return z_from_range(camera, correction.correct(range_from_z(camera, depth)))
