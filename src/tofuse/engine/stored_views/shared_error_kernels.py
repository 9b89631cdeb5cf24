"""Correlated errors within image patches, marginalised from the normal equations of a pair.

With D the sums of the weights of the distances in each patch, R the sums of weight times (r, J)
divided by the root of D, and K the covariance of the patches' errors, the normal equations with one
error per patch marginalised contain R^T (1 + D^1/2 K D^1/2)^-1 R, where those of independent pixels
contain R^T R.
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.compute import kernel
from tofuse.engine.stored_views.pair_equation_kernels import (
    GRADIENT,
    PATCH_RESIDUAL,
    PATCH_WEIGHT,
    PRODUCTS,
    UNKNOWNS,
)


@kernel
def marginalise_shared_errors(
    sums: Float64, correlation: Float64, variance: Float64, pairs: Int64, rows: Float64
) -> None:
    """Marginalise the patches' shared errors out of the normal equations of pairs, in place.

    Parameters
    ----------
    sums
        (N, patches, PATCH_SIZE), see `pair_equations.target_equations`.
    correlation
        (patches, patches) correlation of the errors of patches.
    variance
        (K,) variances of these errors, m^2.
    pairs
        (K,) indices of the pairs.
    rows
        (N, SIZE) equations of the pairs, see `pair_equations`; updated.
    """
    for k in range(len(pairs)):
        _marginalise(sums[pairs[k]], correlation, variance[k], rows[pairs[k]])


@kernel
def _marginalise(sums: Float64, correlation: Float64, variance: float, row: Float64) -> None:
    """Do the same for one pair."""
    count = len(sums)
    R = np.zeros((count, 7))
    sqrt_weight = np.sqrt(sums[:, PATCH_WEIGHT])
    for k in range(count):
        if sqrt_weight[k] > 0:
            for p in range(7):
                R[k, p] = sums[k, PATCH_RESIDUAL + p] / sqrt_weight[k]
    # Cholesky factor L of 1 + D^1/2 K D^1/2, row by row, and Z with L Z = R.
    L = np.zeros((count, count))
    Z = np.zeros((count, 7))
    for i in range(count):
        for j in range(i + 1):
            total = variance * sqrt_weight[i] * sqrt_weight[j] * correlation[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                L[i, i] = np.sqrt(total + 1.0)
            else:
                L[i, j] = total / L[j, j]
        for p in range(7):
            total = R[i, p]
            for k in range(i):
                total -= L[i, k] * Z[k, p]
            Z[i, p] = total / L[i, i]
    for p in range(6):
        for k in range(count):
            row[GRADIENT + p] -= R[k, 0] * R[k, 1 + p] - Z[k, 0] * Z[k, 1 + p]
        index = PRODUCTS + p * UNKNOWNS - p * (p - 1) // 2
        for o in range(p, 6):
            for k in range(count):
                row[index + o - p] -= R[k, 1 + p] * R[k, 1 + o] - Z[k, 1 + p] * Z[k, 1 + o]
