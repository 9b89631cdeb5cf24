"""What patches of a view say of a pair's relative pose, where the pixels of a patch share an error.

With D the sums of the weights of the distances that fall into each patch, R the sums of weight
times (r, J) over the root of D, and K the covariance of the patches' errors, an alignment that
allows for these errors has the products R^T (1 + D^1/2 K D^1/2)^-1 R where one that takes all
pixels for independent has R^T R (the normal equations with an unknown for each patch, eliminated).
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
    distances,
    land,
    load,
    move,
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
    target: Float32,
    lookup: Float32,
    lookup_frame: Float64,
    T: Float64,
    scale_g: float,
    robust: float,
    min_cosine: float,
    out: Float64,
) -> None:
    """Sum what the distances of each patch say into `out` (patches, PATCH_SIZE), overwritten.

    Parameters
    ----------
    points, target, lookup, lookup_frame, T, scale_g, robust, min_cosine
        As in `alignment.accumulate`.
    patch
        (N,) the patch of each point.
    """
    out[:] = 0.0
    block = np.zeros(ROWS * LANES, np.float32)
    for first in range(0, len(points), LANES):
        count = min(LANES, len(points) - first)
        load(block, points[first : first + count])
        move(block, T)
        land(block, count, target, lookup, lookup_frame)
        distances(block, T, scale_g, 0.0, robust, min_cosine)
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
def allow(sums: Float64, alike: Float64, variance: float, row: Float64) -> None:
    """Take off a pair's normal equations what its patches can't say, as they share errors.

    Parameters
    ----------
    sums
        (K, PATCH_SIZE), see `patch_sums`.
    alike
        (K, K) correlation of the errors of patches.
    variance
        Of these errors, m^2.
    row
        (SIZE,) of the pair, see `refinement`; changed.
    """
    count = len(sums)
    R = np.zeros((count, 7))
    root = np.sqrt(sums[:, WEIGHT])
    for k in range(count):
        if root[k] > 0:
            for p in range(7):
                R[k, p] = sums[k, RESIDUAL + p] / root[k]
    # Cholesky's factor of 1 + D^1/2 K D^1/2, row by row, and Z with L Z = R.
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
