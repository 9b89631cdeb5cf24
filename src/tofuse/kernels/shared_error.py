"""Correlated errors within image patches, marginalised from the normal equations of a pair.

With D the sums of the weights of the distances in each patch, R the sums of weight times (r, J)
divided by the root of D, and K the covariance of the patches' errors, the normal equations with one
error per patch marginalised contain R^T (1 + D^1/2 K D^1/2)^-1 R, where those of independent pixels
contain R^T R.
"""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float32, Float64, Int64
from tofuse.kernels.alignment import (
    FITS,
    JACOBIAN,
    LANES,
    MISFIT,
    ROOT,
    ROWS,
    TargetImage,
    compare_planes,
    load_block,
    project_block,
    transform_block,
)
from tofuse.kernels.jit import kernel
from tofuse.kernels.refinement import UNKNOWNS, G, H

# Of each patch: sums of w, w r and w J.
WEIGHT = 0
RESIDUAL = 1
RESPONSE = 2
PATCH_SIZE = 8


@kernel
def patch_sums(
    points: Float32,
    patch: Int64,
    target: TargetImage,
    T: Float64,
    scale_g: float,
    robust: float,
    min_cosine: float,
    out: Float64,
) -> None:
    """Sum the weighted residuals and Jacobians of each patch into `out` (patches, PATCH_SIZE).

    Parameters
    ----------
    points, target, T, scale_g, robust, min_cosine
        As in `alignment.accumulate` and its `Residuals`.
    patch
        (N,) index of the patch of each point.
    """
    image, lookup, lookup_frame = target
    out[:] = 0.0
    block = np.zeros(ROWS * LANES, np.float32)
    for first in range(0, len(points), LANES):
        count = min(LANES, len(points) - first)
        load_block(block, points[first : first + count])
        transform_block(block, T)
        project_block(block, count, image, lookup, lookup_frame)
        compare_planes(block, T, scale_g, 0.0, robust, min_cosine)
        for k in range(count):
            if not block[FITS * LANES + k] > 0:
                continue
            root = np.float64(block[ROOT * LANES + k])
            total = out[patch[first + k]]
            total[WEIGHT] += root * root
            total[RESIDUAL] += root * block[MISFIT * LANES + k]
            for p in range(6):
                total[RESPONSE + p] += root * block[(JACOBIAN + p) * LANES + k]


@kernel
def discount_shared_errors(sums: Float64, alike: Float64, variance: float, row: Float64) -> None:
    """Marginalise the patches' shared errors in the normal equations of a pair, in place.

    Parameters
    ----------
    sums
        (K, PATCH_SIZE), see `patch_sums`.
    alike
        (K, K) correlation of the errors of patches.
    variance
        Variance of these errors, m^2.
    row
        (SIZE,) equations of the pair, see `refinement`; updated.
    """
    count = len(sums)
    R = np.zeros((count, 7))
    root = np.sqrt(sums[:, WEIGHT])
    for k in range(count):
        if root[k] > 0:
            for p in range(7):
                R[k, p] = sums[k, RESIDUAL + p] / root[k]
    # Cholesky factor L of 1 + D^1/2 K D^1/2, row by row, and Z with L Z = R.
    L = np.zeros((count, count))
    Z = np.zeros((count, 7))
    for i in range(count):
        for j in range(i + 1):
            total = variance * root[i] * root[j] * alike[i, j]
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
            row[G + p] -= R[k, 0] * R[k, 1 + p] - Z[k, 0] * Z[k, 1 + p]
        place = H + p * UNKNOWNS - p * (p - 1) // 2
        for o in range(p, 6):
            for k in range(count):
                row[place + o - p] -= R[k, 1 + p] * R[k, 1 + o] - Z[k, 1 + p] * Z[k, 1 + o]
