"""Clouds of files as frames, without invalid points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.frames import CloudFrame
from tofuse.engine.fusion import GeometryRecord
from tofuse.formats.geometry import read_ply


def ply_frame(path: Path, index: int, timestamp: float) -> CloudFrame:
    """Read a PLY cloud; non-finite points are dropped."""
    return cloud_frame(index, timestamp, read_ply(path))


def to_float32(values: NDArray[Any]) -> Float32:
    """Return numbers of a file as float32: infinite beyond its range, NaN for signalling NaN."""
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(np.float32, copy=False)


def cloud_frame(
    index: int,
    timestamp: float,
    cloud: GeometryRecord,
    *,
    origin: Float64 | None = None,
) -> CloudFrame:
    """Return a cloud of a file as a view, without invalid points; see `CloudFrame.of`."""
    return CloudFrame.of(
        cloud.points,
        index=index,
        timestamp=timestamp,
        origin=origin,
        normals=cloud.normals,
        amplitude=cloud.amplitude,
        color=cloud.color,
    )
