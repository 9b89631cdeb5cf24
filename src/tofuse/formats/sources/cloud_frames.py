"""Clouds of files as frames, without invalid points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.frames import CloudFrame
from tofuse.engine.fusion import GeometryRecord
from tofuse.engine.geometry import se3
from tofuse.formats.geometry import read_ply


def ply_frame(path: Path, index: int, timestamp: float, shift: Float64 | None = None) -> CloudFrame:
    """Read a PLY cloud; non-finite points are dropped, and `shift` (3,) in m is subtracted."""
    ply = read_ply(path)
    with np.errstate(invalid="ignore"):  # signalling NaN
        points = to_float32(ply.points) if shift is None else ply.points.astype(np.float64)
    return cloud_frame(index, timestamp, replace(ply, points=points), shift=shift)


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
    shift: Float64 | None = None,
) -> CloudFrame:
    """Return a cloud of a file as a view, without invalid points.

    `shift` (3,) is subtracted from the points, in their own precision, and from the `origin` (3,).
    """
    points = cloud.points
    # False for NaN; the squares of the remaining coordinates fit into float32.
    measured = np.asarray((np.abs(points) < se3.MAX_COORDINATE_M).all(1))
    if shift is not None:
        with np.errstate(over="ignore", invalid="ignore"):
            points = points - shift
        measured &= (np.abs(points) < se3.MAX_COORDINATE_M).all(1)
        origin = None if origin is None else origin - shift
    if not measured.all():
        points = np.where(measured[:, None], points, 0)
    frame = CloudFrame(
        index,
        timestamp,
        to_float32(points),
        cloud.normals,
        amplitude=cloud.amplitude,
        color=cloud.color,
        origin=np.zeros(3) if origin is None else origin,
    )
    return frame if measured.all() else frame.keep(measured)
