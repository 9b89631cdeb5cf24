"""Normal equations of the symmetric point-to-plane metric."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.compute import kernel


@kernel
def symmetric_sums(p: Float64, q: Float64, n: Float64, weight: Float64) -> tuple[Float64, Float64]:
    """Normal equations of the symmetric objective (Rusinkiewicz 2019, eq 10).

    Minimises ``sum w [(p - q) . n + ((p + q) x n) . a + n . t]^2`` for points (m, 3) about the
    centroid of each view, n the sum of both normals. Returns the (6, 6) matrix for (t, a) and the
    right-hand side (6,), negative.
    """
    H = np.zeros((6, 6))
    g = np.zeros(6)
    J = np.empty(6)
    for k in range(len(p)):
        r = 0.0
        for c in range(3):
            d = (c + 1) % 3
            e = (c + 2) % 3
            r += (p[k, c] - q[k, c]) * n[k, c]
            J[c] = n[k, c]
            J[3 + c] = (p[k, d] + q[k, d]) * n[k, e] - (p[k, e] + q[k, e]) * n[k, d]
        for c in range(6):
            x = weight[k] * J[c]
            g[c] += x * r
            for d in range(6):
                H[c, d] += x * J[d]
    return H, g
