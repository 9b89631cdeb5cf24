"""Free, occupied and unknown space by casting rays, and distances to what is occupied.

The evidence of a voxel is a sum of log-odds with the constants of OctoMap (Hornung et al. 2013).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy import ndimage

from tofuse.engine.arrays import Bool, Float32, Float64, Int8, Int32, Intp
from tofuse.engine.errors import InputError

# As in ROS' nav_msgs/OccupancyGrid.
UNKNOWN, FREE, OCCUPIED = -1, 0, 100
# Log-odds of a hit and of a miss, and their limits: probabilities 0.7, 0.4, 0.12 and 0.97.
_HIT, _MISS, _MIN, _MAX = 0.85, -0.4, -2.0, 3.5
_MAX_VOXELS = 2**25
# Rays are this near to each other, in voxels, so that samples at steps of a voxel suffice.
_RAY_SPACING = 0.5
_KEYS = 2**21  # cells along an axis with different keys


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """Voxels along the axes of the world. `add` changes its arrays.

    Attributes
    ----------
    first
        (3,) index of the first voxel: voxel i covers i to i + 1 voxel sizes along each axis.
    voxel_m
        Voxel size, m.
    log_odds
        (X, Y, Z) of being occupied.
    last_seen
        (X, Y, Z) number of the last view that saw the voxel, from 1; 0 where none did.
    """

    first: Intp
    voxel_m: float
    log_odds: Float32
    last_seen: Int32

    @classmethod
    def around(cls, points: Float64, voxel_m: float) -> Self:
        """Make an unknown grid that contains all points (N, 3), and a voxel around.

        Raises
        ------
        InputError
            If it has too many voxels.
        """
        first = np.floor(points.min(0) / voxel_m).astype(np.intp) - 1
        shape = np.floor(points.max(0) / voxel_m).astype(np.intp) + 2 - first
        count = float(np.prod(shape.astype(float)))
        if count > _MAX_VOXELS:
            larger = 1.1 * voxel_m * np.cbrt(count / _MAX_VOXELS)
            raise InputError(
                f"of {voxel_m:g} m makes {count / 1e6:.0f} million voxels, more than "
                f"{_MAX_VOXELS / 1e6:.0f} million",
                where="--voxel",
                remedy=f"pass at least {larger:.2g}m",
            )
        return cls(first, voxel_m, np.zeros(shape, np.float32), np.zeros(shape, np.int32))

    @property
    def origin(self) -> Float64:
        """(3,) corner of the first voxel, m."""
        return np.asarray(self.first * self.voxel_m, np.float64)

    @property
    def states(self) -> Int8:
        """(X, Y, Z) `UNKNOWN`, `FREE` or `OCCUPIED`."""
        known = np.where(self.log_odds > 0, OCCUPIED, FREE)
        return np.where(self.last_seen > 0, known, UNKNOWN).astype(np.int8)

    @property
    def distances(self) -> Float32:
        """(X, Y, Z) distance of each voxel's centre from that of the nearest occupied one, m.

        Within what is occupied, minus the distance from the nearest voxel that is not; infinite
        where there is none.
        """
        occupied = self.states == OCCUPIED
        outside, inside = (_distance_from(mask) for mask in (occupied, ~occupied))
        return np.where(occupied, -inside, outside) * np.float32(self.voxel_m)

    def add(self, points: Float64, origin: Float64, view: int) -> None:
        """Add what one view saw: its points are occupied, and what lies before them is free.

        A view counts once for a voxel, and as a hit if one of its points is in it.

        Parameters
        ----------
        points
            (N, 3), m.
        origin
            (3,) from where they were seen, m.
        view
            Number of the view, from 1, larger than those before.
        """
        log_odds, seen = self.log_odds.reshape(-1), self.last_seen.reshape(-1)
        # Coordinates in voxels of the grid. Many points in one voxel tell no more than a few.
        ends = (points.T / self.voxel_m - self.first[:, None]).astype(np.float32)
        start = (origin / self.voxel_m - self.first).astype(np.float32)[:, None]
        ends = ends[:, _one_per_cell(ends / _RAY_SPACING)]
        hits = self._flat(ends)
        log_odds[hits] = np.minimum(log_odds[hits] + _HIT, _MAX)
        seen[hits] = view
        lengths = np.linalg.norm(ends - start, axis=0)
        order = np.argsort(-lengths)
        lengths = lengths[order]
        rays = (ends[:, order] - start) / np.maximum(lengths, 1e-6)
        for distance in range(int(lengths[0]) + 1 if len(lengths) else 0):
            n = np.searchsorted(-lengths, -distance)  # that reach as far
            passed = self._flat(start + distance * rays[:, :n])
            passed = passed[seen[passed] != view]
            log_odds[passed] = np.maximum(log_odds[passed] + _MISS, _MIN)
            seen[passed] = view

    def _flat(self, cells: Float32) -> Intp:
        """Positions in the flattened arrays, of coordinates (3, N) in voxels that are inside."""
        index = np.floor(cells).astype(np.int32)
        inside = np.ones(index.shape[1], bool)
        for row, size in zip(index, self.log_odds.shape, strict=True):
            inside &= (row >= 0) & (row < size)
        x, y, z = index[:, inside].astype(np.intp)
        _, n_y, n_z = self.log_odds.shape
        return (x * n_y + y) * n_z + z


def _one_per_cell(cells: Float32) -> Intp:
    """The first of the points (3, N) in each cell of size 1."""
    x, y, z = np.floor(cells).astype(np.int64) % _KEYS
    return np.unique((x * _KEYS + y) * _KEYS + z, return_index=True)[1]


def _distance_from(mask: Bool) -> Float32:
    """Exact distance of each voxel from the nearest one in a mask, in voxels."""
    if not mask.any():
        return np.full(mask.shape, np.inf, np.float32)
    return ndimage.distance_transform_edt(~mask).astype(np.float32)
