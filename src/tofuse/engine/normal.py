"""Constants of the normal distribution, for robust estimates and for bounds on errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

# Median of the absolute values, in standard deviations.
MEDIAN_OF_NORMAL = 0.6745
# One in twenty errors exceeds this many standard deviations; one in a hundred.
OF_95_PERCENT, OF_99_PERCENT = 1.96, 2.576


def robust_sigma(errors: ArrayLike) -> float:
    """Return the standard deviation of normal errors with the same median of absolute values."""
    return float(np.median(np.abs(errors))) / MEDIAN_OF_NORMAL
