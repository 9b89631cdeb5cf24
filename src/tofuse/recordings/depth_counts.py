"""Depth stored as counts of 16 bits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import Float32

INVALID_DEPTH = 65535
MAX_COUNTS = 65535


def depth_from_counts(counts: NDArray[np.generic], unit_m: float) -> Float32:
    """Return depth in m (float32) of stored counts (H, W); 0 and 65535 give 0."""
    depth = counts.astype(np.float32) * np.float32(unit_m)
    depth[counts == INVALID_DEPTH] = 0
    return depth
