"""Which views look alike, at a glance: small images of depth, compared at some shifts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tofuse.maps.surface_map import SurfaceMap

Float64 = NDArray[np.float64]

_ROWS, _COLUMNS = 9, 12
# How far one view may be turned against the other, in cells.
_DOWN, _ACROSS = 1, 3
# Logarithms of depth that differ by more are as good as unknown.
_MOST = 0.5


def thumbnail(view: SurfaceMap) -> Float64:
    """(9, 12) logarithm of the mean inverse depth of each cell, NaN where hardly any is known."""
    rows, columns = view.z.shape
    i = np.arange(rows) * _ROWS // rows
    j = np.arange(columns) * _COLUMNS // columns
    cell = (i[:, None] * _COLUMNS + j).ravel()
    z = view.z.ravel()
    known = z > 0
    size = _ROWS * _COLUMNS
    count = np.bincount(cell[known], minlength=size)
    total = np.bincount(cell[known], 1 / z[known].astype(float), minlength=size)
    enough = count > np.bincount(cell, minlength=size) / 3
    mean = np.full(size, np.nan)
    mean[enough] = np.log(total[enough] / count[enough])
    return mean.reshape(_ROWS, _COLUMNS)


def likeness(look: Float64, others: Sequence[Float64]) -> list[int]:
    """Positions of thumbnails, those most like `look` first, and of equals the last one."""
    stack = np.stack(others)
    best = np.full(len(stack), np.inf)
    for down in range(-_DOWN, _DOWN + 1):
        for across in range(-_ACROSS, _ACROSS + 1):
            here = look[max(down, 0) : _ROWS + down, max(across, 0) : _COLUMNS + across]
            there = stack[:, max(-down, 0) : _ROWS - down, max(-across, 0) : _COLUMNS - across]
            apart = np.minimum(np.abs(here - there), _MOST)
            apart[np.isnan(apart)] = _MOST
            best = np.minimum(best, apart.mean((1, 2)))
    return sorted(range(len(stack)), key=lambda k: (best[k], -k))
