"""Robust pooling of estimates that differ by more than their noise."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.normal import robust_sigma

# Degrees of freedom of Student's t (Lange, Little and Taylor 1989 suggest 4).
_FREEDOM = 4.0
# Grid of the pooled value, in spreads of the estimates, and of both deviations.
_VALUES, _DEVIATIONS = 121, 14
_VALUE_RANGE, _MIN_DEVIATION, _MAX_DEVIATION = 6.0, 0.02, 5.0


def pooled(estimates: Float64, information: Float64) -> tuple[float, float]:
    """Pool estimates by a random-effects model with Student's t, which is robust to outliers.

    The k-th estimate is t-distributed about the pooled value, with the squared scale ``tau^2 +
    s^2 / information_k``: tau is the heterogeneity of the estimates, s the unit of the noise
    (random-effects meta-analysis, DerSimonian and Laird 1986; with t, Baker and Jackson 2008).
    The pooled value, tau and s are integrated over a grid with flat priors (for tau and s, on their
    logarithm).

    Parameters
    ----------
    estimates
        (n,) of the same quantity, at least 2.
    information
        (n,) above 0, proportional to the inverse variance of their noise.

    Returns
    -------
    Posterior mean and standard deviation.
    """
    centre = float(np.median(estimates))
    spread = robust_sigma(estimates - centre)
    spread = spread or float(np.std(estimates))
    if not spread:
        return centre, 0.0
    relative = information / float(np.median(information))
    # Within the range of the estimates, extended by their spread.
    lowest = max(centre - _VALUE_RANGE * spread, float(estimates.min()) - spread)
    highest = min(centre + _VALUE_RANGE * spread, float(estimates.max()) + spread)
    values = np.linspace(lowest, highest, _VALUES)
    scales = spread * np.geomspace(_MIN_DEVIATION, _MAX_DEVIATION, _DEVIATIONS)
    value, tau, s = np.meshgrid(values, scales, scales, indexing="ij")
    logs = np.zeros(value.shape)
    for estimate, precision in zip(estimates, relative, strict=True):
        variance = tau**2 + s**2 / precision
        logs -= 0.5 * np.log(variance)
        logs -= 0.5 * (_FREEDOM + 1) * np.log1p((estimate - value) ** 2 / variance / _FREEDOM)
    weight = np.exp(logs - logs.max()).sum((1, 2))
    weight /= weight.sum()
    mean = float(weight @ values)
    return mean, float(np.sqrt(weight @ (values - mean) ** 2))
