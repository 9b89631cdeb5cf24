"""The point of the model that is clicked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tofuse.arrays import Float64
from tofuse.files.geometry_record import GeometryRecord

_ON_RAY_ANGLE, _MAX_ANGLE = 0.006, 0.02  # rad, between a point's direction and the ray


@dataclass(frozen=True, eq=False)
class PickedPoint:
    """A point (3,) of the model, and its standard deviation in m, NaN if unknown."""

    point: Float64
    sigma: float


def pick(
    layers: Sequence[GeometryRecord], origin: ArrayLike, direction: ArrayLike
) -> PickedPoint | None:
    """Return the point of the layers on a ray, or None.

    The closest of the points that are practically on the ray; without any, that with the smallest
    angle to it. Back faces are not drawn, and so not picked.

    Parameters
    ----------
    layers
        The visible layers.
    origin, direction
        (3,) of the ray, world frame.
    """
    o, d = np.asarray(origin, float), np.asarray(direction, float)
    d = d / np.linalg.norm(d)
    best: tuple[float, float] | None = None
    picked = None
    for layer in layers:
        v = layer.points - o
        depth = v @ d
        pickable = depth > 1e-6
        if layer.faces is not None and layer.normals is not None:
            pickable &= (layer.normals * v).sum(1) < 0
        rows = np.flatnonzero(pickable)
        if len(rows) == 0:
            continue
        angle = np.linalg.norm(v[rows] - depth[rows, None] * d, axis=1) / depth[rows]
        on_ray = np.flatnonzero(angle < _ON_RAY_ANGLE)
        k = on_ray[np.argmin(depth[rows[on_ray]])] if len(on_ray) else int(np.argmin(angle))
        rank = (0.0, float(depth[rows[k]])) if len(on_ray) else (float(angle[k]), 0.0)
        if angle[k] < _MAX_ANGLE and (best is None or rank < best):
            row = rows[k]
            sigma = layer.scalars.get("sigma")
            row_sigma = float("nan") if sigma is None else float(sigma[row])
            best, picked = rank, PickedPoint(layer.points[row].astype(float), row_sigma)
    return picked
