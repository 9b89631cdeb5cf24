"""The robust kernel of all alignments: Tukey's biweight (Beaton and Tukey 1974).

Its argument is e2, the square of a residual relative to the cut-off, beyond which a residual has no
weight: callers leave out residuals with e2 >= 1. With f = 1 - e2 the weight of a residual r is f^2,
its influence r f^2, and its cost proportional to 1 - f^3.

Another kernel in its place changes all alignments. It needs a cut-off, where its influence is zero
(`consistency` has two meanings only then), and a weight that determines e2 (`support` and
`relative_slope` take the weight).

The kernels give float32 for float32 and float64 for float64.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.compute.jit import kernel

_CONSTANTS: Any = [np.float32(x) for x in (0, 1, 4, 5)]
_ZERO, _ONE, _FOUR, _FIVE = _CONSTANTS
_STEPS = 100  # of the integration over the residuals within the cut-off, by the midpoint rule


@kernel
def weight(e2: float) -> float:
    """Return the weight of a residual within the cut-off, 0 to 1."""
    f = _ONE - e2
    return f * f


@kernel
def root_weight(e2: float) -> float:
    """Return the square root of the weight of a residual within the cut-off."""
    return _ONE - e2


@kernel
def support(w: float) -> float:
    """Return 1 minus the cost of a residual with the weight `w`, relative to that of an outlier."""
    return w * np.sqrt(w)


@kernel
def relative_slope(w: float) -> float:
    """Return the derivative of the influence over the weight `w`; 0 without a weight."""
    return _FIVE - _FOUR / np.sqrt(w) if w > _ZERO else _ZERO


@kernel
def consistency(cutoff: float) -> float:
    """Return the weighted mean square of normal residuals, in their variance.

    Dividing the weighted mean square of residuals by it gives their variance. It is the mean
    derivative of the influence over the mean weight as well (Stein 1981, lemma 1).

    Parameters
    ----------
    cutoff
        Residual that has no weight, in standard deviations.
    """
    weights, squares = 0.0, 0.0
    for k in range(_STEPS):
        e = (k + 0.5) / _STEPS
        r2 = (cutoff * e) ** 2
        expected = weight(e * e) * np.exp(-0.5 * r2)
        weights += expected
        squares += expected * r2
    return squares / weights


def weights(e2: Float64) -> Float64:
    """Return the weights of an array of residuals."""
    f = np.maximum(1 - e2, 0)
    return f * f


def slopes(e2: Float64) -> Float64:
    """Return the derivatives of the influences of an array of residuals."""
    return np.maximum(1 - e2, 0) * (1 - 5 * e2)
