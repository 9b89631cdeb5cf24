"""The fused cloud: points of all views in one frame, thinned to one per voxel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points in the world frame.

    Attributes
    ----------
    points
        (N, 3) float32 in m, relative to `offset`.
    normals
        (N, 3) float32 unit normals towards the cameras that saw them, or None.
    color
        (N, 3) uint8 RGB (amplitude as grey where there is no colour), or None.
    views
        (N,) int32, how many frames saw each point.
    offset
        (3,) float64.
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32] | None
    color: NDArray[np.uint8] | None
    views: NDArray[np.int32]
    offset: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.points)
