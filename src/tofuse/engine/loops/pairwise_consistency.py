"""The largest set of pairwise consistent measurements (Mangelson et al., ICRA 2018).

Correct measurements between two maps are all consistent; wrong ones are rarely consistent with each
other. Each is a vertex, each consistent pair an edge: the maximum clique is accepted.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tofuse.engine.arrays import Bool


def maximum_consistent_set(consistent: Bool, weights: Sequence[float] | None = None) -> list[int]:
    """Return the clique of largest weight, ascending; of equals the one with the lowest indices.

    Exact, by branch and bound: made for tens of measurements, not for thousands.

    Parameters
    ----------
    consistent
        (N, N) symmetric; whether two measurements agree. The diagonal does not matter.
    weights
        (N,) above 0; 1 each unless given.
    """
    n = len(consistent)
    weight = np.ones(n) if weights is None else np.asarray(weights, float)
    # Heavy ones first, so that a good bound is found soon.
    order = np.lexsort((np.arange(n), -weight))
    best: list[int] = []
    best_weight = 0.0

    def grow(chosen: list[int], total: float, candidates: list[int]) -> None:
        nonlocal best, best_weight
        if total > best_weight:
            best, best_weight = list(chosen), total
        remaining = float(sum(weight[c] for c in candidates))
        for k, c in enumerate(candidates):
            if total + remaining <= best_weight:
                return
            remaining -= float(weight[c])
            compatible = [d for d in candidates[k + 1 :] if consistent[c, d]]
            grow([*chosen, c], total + float(weight[c]), compatible)

    grow([], 0.0, [int(k) for k in order])
    return sorted(best)
