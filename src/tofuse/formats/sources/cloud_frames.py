"""Clouds of files as frames, without invalid points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.frames import CloudFrame, map_shift
from tofuse.engine.fusion import GeometryRecord
from tofuse.engine.geometry import se3
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
    """Return a cloud of a file as a view, without invalid points.

    Map coordinates are shifted in the precision of the points, and so is the `origin` (3,).
    """
    points = cloud.points
    with np.errstate(over="ignore", invalid="ignore"):  # signalling NaN as well
        shift = map_shift(points)
        points = points - shift if shift.any() else points
        # False for NaN; the squares of the remaining coordinates fit into float32.
        measured = np.asarray((np.abs(points) < se3.MAX_COORDINATE_M).all(1))
    if not measured.all():
        points = np.where(measured[:, None], points, 0)
    frame = CloudFrame(
        index,
        timestamp,
        to_float32(points),
        cloud.normals,
        amplitude=cloud.amplitude,
        color=cloud.color,
        origin=(np.zeros(3) if origin is None else origin) - shift,
        shift=shift,
    )
    return frame if measured.all() else frame.keep(measured)
