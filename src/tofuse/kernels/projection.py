"""What kernels that move points into another view share: where they land, and how they move."""

from __future__ import annotations

from tofuse.arrays import Float32, Float64
from tofuse.kernels.jit import kernel


@kernel
def landing(
    x: float, y: float, lookup: Float32, lookup_frame: Float64
) -> tuple[float, float, int, int]:
    """Pixel (u, v) that ray coordinates (x, y) land on, and the node (column, row) before it.

    `lookup` is (A, B, 2), the pixel of each node of a grid over ray coordinates; `lookup_frame`
    is (x0, y0, 1/dx, 1/dy). The node is (-1, -1) for rays outside the grid.
    """
    fu = (x - lookup_frame[0]) * lookup_frame[2]
    fv = (y - lookup_frame[1]) * lookup_frame[3]
    if not (fu >= 0 and fv >= 0 and fu < lookup.shape[1] - 1 and fv < lookup.shape[0] - 1):
        return 0.0, 0.0, -1, -1
    i = int(fu)
    j = int(fv)
    au = fu - i
    av = fv - j
    u = (1 - av) * ((1 - au) * lookup[j, i, 0] + au * lookup[j, i + 1, 0]) + av * (
        (1 - au) * lookup[j + 1, i, 0] + au * lookup[j + 1, i + 1, 0]
    )
    v = (1 - av) * ((1 - au) * lookup[j, i, 1] + au * lookup[j, i + 1, 1]) + av * (
        (1 - au) * lookup[j + 1, i, 1] + au * lookup[j + 1, i + 1, 1]
    )
    return u, v, i, j


@kernel
def jacobian_row(
    J: Float64, m0: float, m1: float, m2: float, px: float, py: float, pz: float
) -> None:
    """Derivative of m . p by the right perturbation, (m, p x m), into J[:6]."""
    J[0] = m0
    J[1] = m1
    J[2] = m2
    J[3] = py * m2 - pz * m1
    J[4] = pz * m0 - px * m2
    J[5] = px * m1 - py * m0
