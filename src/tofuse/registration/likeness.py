"""Which views look alike, at a glance: small images, compared at some shifts.

Of each view a small image is kept of how far the surfaces are and how they reflect, both as
logarithms. Two views look alike if their images differ little at some shift of one against the
other, as a camera that is turned a little sees the same, moved. No pose takes part.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tofuse.kernels.threads import run_chunks
from tofuse.maps.surface_map import SurfaceMap

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

_ROWS, _COLUMNS = 9, 12
_CHUNKS = 16
# Logarithms that differ by more are as good as unknown.
_MOST_DEPTH, _MOST_LIGHT = 0.3, 0.5
# Share of the cells of which both views know the albedo, below which it is not compared.
_LIT = 0.2


def look_of(view: SurfaceMap) -> Float32:
    """(2, 9, 12) mean log depth and log albedo of each cell, NaN where little is known."""
    rows, columns = view.z.shape
    i = np.arange(rows) * _ROWS // rows
    j = np.arange(columns) * _COLUMNS // columns
    cell = (i[:, None] * _COLUMNS + j).ravel()
    size = _ROWS * _COLUMNS
    third = np.bincount(cell, minlength=size) / 3
    look = np.full((2, size), np.nan, np.float32)
    depth = np.log(np.where(view.z > 0, view.z, np.float32(np.nan)))
    for image, out in ((depth, look[0]), (view.photo[..., 0], look[1])):
        known = np.isfinite(image).ravel()
        count = np.bincount(cell[known], minlength=size)
        total = np.bincount(cell[known], image.ravel()[known].astype(float), minlength=size)
        enough = (count > third) & (count > 0)
        out[enough] = total[enough] / count[enough]
    return look.reshape(2, _ROWS, _COLUMNS)


def unlikeness(look: Float32, others: Float32, shift: float) -> Float64:
    """(N,) how much views (N, 2, 9, 12) differ from one (2, 9, 12), each at its best shift.

    0 for the same image, 1 for nothing in common. Exposure is what the albedo differs by on
    average, and does not count. Views without light on both sides are compared by depth alone.

    Parameters
    ----------
    shift
        Largest one, as a share of the width.
    """
    across, down = round(shift * _COLUMNS), round(shift * _ROWS / 2)
    best = np.ones(len(others))
    for v in range(-down, down + 1):
        for u in range(-across, across + 1):
            here = look[:, max(v, 0) : _ROWS + v, max(u, 0) : _COLUMNS + u]
            there = others[:, :, max(-v, 0) : _ROWS - v, max(-u, 0) : _COLUMNS - u]
            np.minimum(best, _differ(here, there), out=best)
    return best


def mutual_unlikeness(looks: Sequence[Float32], shift: float) -> Float64:
    """(N, N) how much views differ from each other, see `unlikeness`."""
    stack = np.stack(looks)
    far = np.ones((len(stack), len(stack)))

    def rows(a: int, b: int) -> None:
        for k in range(a, b):
            far[k, k:] = unlikeness(stack[k], stack[k:], shift)

    run_chunks(rows, len(stack), _CHUNKS)
    return np.minimum(far, far.T)


def _differ(here: Float32, there: Float32) -> Float64:
    """(N,) mean of what cells differ by, of the most that counts."""
    apart = there - here
    known = np.isfinite(apart)
    count = known.sum((2, 3))
    apart = np.where(known, apart, 0)
    exposure = apart[:, 1].sum((1, 2)) / np.maximum(count[:, 1], 1)
    depth = np.minimum(np.abs(apart[:, 0]) / _MOST_DEPTH, 1)
    light = np.minimum(np.abs(apart[:, 1] - exposure[:, None, None]) / _MOST_LIGHT, 1)
    cells = here[0].size
    far = (depth.sum((1, 2)) + cells - count[:, 0]) / cells
    # Albedo is known of smooth surfaces alone: where it is not, nothing is told.
    shade = np.where(known[:, 1], light, 0).sum((1, 2)) / np.maximum(count[:, 1], 1)
    lit = count[:, 1] > _LIT * cells
    return np.asarray(np.where(lit, 0.5 * (far + shade), far), np.float64)
