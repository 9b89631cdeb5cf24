"""Does a quantity change with time, by more than its uncertainty?

A trend is tested by weighted regression. The scatter of results that it does not explain, such as
that by different scenes, widens its uncertainty. A few results show no scatter: then differences
count, by chi-square with twice the stated sigmas.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc, nctdtrinc, stdtr, stdtrit

from tofuse.engine.arrays import Float64

# Of sessions in different places, in stated sigmas (benchmarks/card.py); for those that are too few
# to show their own.
_SCATTER = 2.0


@dataclass(frozen=True)
class Drift:
    """One quantity over time.

    Attributes
    ----------
    results
        Number of results that state it.
    mean, sigma
        Weighted mean and its standard deviation, enlarged by `scatter`.
    scatter
        Rms of the deviations from the mean, in stated sigmas (Birge ratio); at least 1.
    change, change_sigma
        By the regression line from the first to the last result; None where no trend was tested.
    p_change, p_trend
        Probability of such differences, and of such a trend, by chance; 1 where not tested.
    p
        Of the trend, or else of the differences, for all quantities together (Holm 1979).
    """

    results: int
    mean: float
    sigma: float
    scatter: float
    change: float | None
    change_sigma: float | None
    p_change: float
    p_trend: float
    p: float = 1.0

    def detectable(self, tests: int, more: int = 1) -> float:
        """Change over the time of which a trend is found in 95 % of such cameras.

        Among some tests, each at its share of 5 %, and with `more` times as many results; NaN where
        no trend was tested.
        """
        if self.change_sigma is None:
            return np.nan
        dof = more * self.results - 2
        found = nctdtrinc(dof, 0.05, stdtrit(dof, 1 - 0.025 / tests))
        return float(self.change_sigma * found / np.sqrt(more))

    @property
    def p_alone(self) -> float:
        """Probability of the test that counts."""
        if self.change is not None:
            return self.p_trend
        dof = self.results - 1
        return float(chdtrc(dof, dof * (self.scatter / _SCATTER) ** 2))


def drift_of(times: Float64, values: Float64, sigmas: Float64, *, trend: bool) -> Drift:
    """Test one quantity.

    Parameters
    ----------
    times, values, sigmas
        (N,) of at least two results.
    trend
        Whether to test a trend, if the times differ.
    """
    weights = sigmas**-2
    mean = float((weights * values).sum() / weights.sum())
    chi2 = float((weights * (values - mean) ** 2).sum())
    dof = len(values) - 1
    scatter = max(1.0, float(np.sqrt(chi2 / dof)))
    drift = Drift(
        len(values),
        mean,
        scatter / float(np.sqrt(weights.sum())),
        scatter,
        None,
        None,
        float(chdtrc(dof, chi2)),
        1.0,
    )
    span = float(np.ptp(times))
    if not trend or span == 0:
        return drift
    t = times - (weights * times).sum() / weights.sum()
    information = float((weights * t**2).sum())
    slope = float((weights * t * values).sum()) / information
    left = float((weights * (values - mean - slope * t) ** 2).sum())
    sigma = np.sqrt(max(1.0, left / (dof - 1)) / information)
    p = 2 * float(stdtr(dof - 1, -abs(slope) / sigma))
    return replace(drift, change=slope * span, change_sigma=float(sigma) * span, p_trend=p)


def holm(p: Sequence[float]) -> list[float]:
    """Return probabilities of tests made together, adjusted for their number (Holm 1979)."""
    order = np.argsort(p)
    adjusted = np.maximum.accumulate(np.array(p)[order] * np.arange(len(p), 0, -1)).clip(max=1.0)
    found = np.empty(len(p))
    found[order] = adjusted
    return [float(each) for each in found]
