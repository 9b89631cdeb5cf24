"""The accuracy of the surface during a recording, to show where to go next."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float32, Float64, Int64

_HALF_EXTENT = 1 << 20  # cells to each side of the origin


class Coverage:
    """A grid of cells with the standard deviation of the surface in each, from measurement noise.

    Every view of a cell adds the information of one measurement, as the errors of its pixels there
    are correlated. Pose errors are known only at the end, and are not included.

    Parameters
    ----------
    cell_m
        Edge of a cell, m.
    """

    def __init__(self, cell_m: float) -> None:
        self._cell = cell_m
        self._keys: Int64 = np.zeros(0, np.int64)
        self._information: Float64 = np.zeros(0)

    def add(self, points: Float32, sigma: Float64) -> None:
        """Add a view: points (N, 3) in the world frame and their standard deviations (N,), m."""
        keys, cell = np.unique(self._key(points), return_inverse=True)
        count = np.bincount(cell, minlength=len(keys))
        mean = np.bincount(cell, sigma, len(keys)) / np.maximum(count, 1)
        all_keys = np.concatenate([self._keys, keys])
        information = np.concatenate([self._information, 1 / np.maximum(mean, 1e-5) ** 2])
        unique_keys, row = np.unique(all_keys, return_inverse=True)
        self._keys = unique_keys.astype(np.int64)
        self._information = np.bincount(row, information, len(self._keys)).astype(float)

    def sigma(self, points: Float32) -> Float64:
        """Return the standard deviation (N,) of the surface at points (N, 3), m; else inf."""
        if not len(self._keys):
            return np.full(len(points), np.inf)
        keys = self._key(points)
        row = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        observed = self._keys[row] == keys
        return np.where(observed, 1 / np.sqrt(self._information[row]), np.inf)

    @property
    def sigmas(self) -> Float64:
        """(C,) standard deviations of all cells, m."""
        return 1 / np.sqrt(self._information)

    def _key(self, points: Float32) -> Int64:
        x, y, z = (
            np.floor(points / self._cell).astype(np.int64).clip(-_HALF_EXTENT, _HALF_EXTENT - 1).T
            + _HALF_EXTENT
        )
        keys: Int64 = (x << 42) | (y << 21) | z
        return keys
