"""The point of the model that a click refers to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tofuse.arrays import Float64
from tofuse.viewer.content import Layer

_NEAR, _FAR = 0.006, 0.02  # angle to the ray in rad: as good as on it, and too far


@dataclass(frozen=True, eq=False)
class PickedPoint:
    """A point (3,) of the model, and its standard deviation in m, NaN where it is not known."""

    point: Float64
    sigma: float


def pick(layers: Sequence[Layer], origin: ArrayLike, direction: ArrayLike) -> PickedPoint | None:
    """Return the point of the layers on a ray, or None.

    The closest of the points that are as good as on the ray; without any, that with the smallest
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
    found = None
    for layer in layers:
        v = layer.points - o
        along = v @ d
        ahead = along > 1e-6
        if layer.faces is not None and layer.normals is not None:
            ahead &= (layer.normals * v).sum(1) < 0
        rows = np.flatnonzero(ahead)
        if len(rows) == 0:
            continue
        off = np.linalg.norm(v[rows] - along[rows, None] * d, axis=1) / along[rows]
        on = np.flatnonzero(off < _NEAR)
        k = on[np.argmin(along[rows[on]])] if len(on) else int(np.argmin(off))
        rank = (0.0, float(along[rows[k]])) if len(on) else (float(off[k]), 0.0)
        if off[k] < _FAR and (best is None or rank < best):
            row = rows[k]
            sigma = float("nan") if layer.sigma is None else float(layer.sigma[row])
            best, found = rank, PickedPoint(layer.points[row].astype(float), sigma)
    return found
