"""The median of an array, without what NumPy's spends on axes and NaN: most of it on small ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def median(values: NDArray[np.floating[Any]]) -> float:
    """Upper median of values of any shape, of which there is at least one and none is NaN."""
    flat = values.ravel()
    k = flat.size // 2
    return float(np.partition(flat, k)[k])
