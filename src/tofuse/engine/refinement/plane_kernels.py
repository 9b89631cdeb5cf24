"""Plane bundle adjustment: normal equations of all poses, with the shared planes eliminated.

Points are divided into cells, each with one plane. With x a world point, c the mean of its cell,
and n, u, v the principal axes of the cell's points (n the normal), the residual of a point is
``r = n . (x - c)``. Its derivative with respect to the pose of its view is J, and with respect to
the plane's offset and two slopes ``b = (1, u . (x - c), v . (x - c))``. The planes are eliminated
from the normal equations (Schur complement), so that a plane seen by a single view does not
constrain its pose.
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.cameras import projection_kernels
from tofuse.engine.compute import kernel
from tofuse.engine.compute import tukey_kernels as tukey
from tofuse.engine.icp import icp_kernels

_MIN_PIVOT = 1e-9
_MIN_POINTS = 4  # of a cell with a plane
# Residuals beyond this many standard deviations have no weight (Tukey's biweight; with 4.685 it has
# 95 % of the efficiency of least squares for normal errors).
ROBUST = 4.685


@kernel
def fit_cells(
    x: Float64,
    view: Int64,
    start: Int64,
    mean: Float64,
    axes: Float64,
    variances: Float64,
    view_counts: Int64,
) -> None:
    """Compute mean, principal axes and variances of the points of each cell, and count its views.

    Parameters
    ----------
    x, view
        (M, 3) world points and (M,) their views, sorted by cell and then by view.
    start
        (S + 1,) first point of each cell.
    mean, axes, variances, view_counts
        (S, 3), (S, 3, 3), (S, 3) and (S,), written. Axes are in rows, by ascending variance; axes
        and variances are 0 for cells of fewer than four points.
    """
    C = np.empty((3, 3))
    vectors = np.empty((3, 3))
    for s in range(len(start) - 1):
        a, b = start[s], start[s + 1]
        mean[s] = 0.0
        axes[s] = 0.0
        variances[s] = 0.0
        view_counts[s] = 0
        for k in range(a, b):
            for c in range(3):
                mean[s, c] += x[k, c]
            if k == a or view[k] != view[k - 1]:
                view_counts[s] += 1
        for c in range(3):
            mean[s, c] /= max(b - a, 1)
        if b - a < _MIN_POINTS:
            continue
        C[:, :] = 0.0
        for k in range(a, b):
            for c in range(3):
                for d in range(3):
                    C[c, d] += (x[k, c] - mean[s, c]) * (x[k, d] - mean[s, d])
        for c in range(3):
            for d in range(3):
                C[c, d] /= b - a - 3
        icp_kernels.symmetric_eigen(C, variances[s], vectors)
        for c in range(3):
            for d in range(3):
                axes[s, c, d] = vectors[d, c]


@kernel
def plane_equations(
    p: Float64,
    x: Float64,
    view: Int64,
    start: Int64,
    mean: Float64,
    axes: Float64,
    variance: Float64,
    rotations: Float64,
    pair_row: Int64,
    diagonal: Float64,
    gradient: Float64,
    cross: Float64,
) -> None:
    """Add the normal equations of the cells, with the planes eliminated, to those of the poses.

    Parameters
    ----------
    p, x, view, start
        Points (M, 3) in their camera's frame and in the world, as in `fit_cells`.
    mean, axes
        As from `fit_cells`.
    variance
        (S,) of the residuals of each cell; cells with 0 are left out.
    rotations
        (N, 3, 3) of the poses T_world_camera.
    pair_row
        (N, N) row in `cross` of each pair of views i < j.
    diagonal, gradient, cross
        (N, 6, 6), (N, 6) and (pairs, 6, 6), added to: diagonal blocks, gradient and off-diagonal
        blocks with respect to right perturbations of the poses.
    """
    J = np.empty(6)
    b = np.empty(3)
    max_views = 1
    for s in range(len(start) - 1):
        max_views = max(max_views, start[s + 1] - start[s])
    max_views = min(max_views, len(rotations))
    F = np.empty((max_views, 6, 3))
    E = np.empty((max_views, 6, 3))
    view_of = np.empty(max_views, np.int64)
    B = np.empty((3, 3))
    h = np.empty(3)
    for s in range(len(start) - 1):
        if variance[s] <= 0:
            continue
        view_count = 0
        B[:, :] = 0.0
        h[:] = 0.0
        n0, n1, n2 = axes[s, 0, 0], axes[s, 0, 1], axes[s, 0, 2]
        for k in range(start[s], start[s + 1]):
            i = view[k]
            if view_count == 0 or view_of[view_count - 1] != i:
                view_of[view_count] = i
                F[view_count] = 0.0
                view_count += 1
            d0, d1, d2 = x[k, 0] - mean[s, 0], x[k, 1] - mean[s, 1], x[k, 2] - mean[s, 2]
            r = n0 * d0 + n1 * d1 + n2 * d2
            e2 = r * r / (variance[s] * ROBUST * ROBUST)
            if e2 >= 1:
                continue
            w = tukey.weight(e2) / variance[s]
            R = rotations[i]
            projection_kernels.jacobian_row(
                J,
                R[0, 0] * n0 + R[1, 0] * n1 + R[2, 0] * n2,
                R[0, 1] * n0 + R[1, 1] * n1 + R[2, 1] * n2,
                R[0, 2] * n0 + R[1, 2] * n1 + R[2, 2] * n2,
                p[k, 0],
                p[k, 1],
                p[k, 2],
            )
            b[0] = 1.0
            for c in range(1, 3):
                b[c] = axes[s, c, 0] * d0 + axes[s, c, 1] * d1 + axes[s, c, 2] * d2
            for c in range(3):
                h[c] += w * b[c] * r
                for d in range(3):
                    B[c, d] += w * b[c] * b[d]
            for c in range(6):
                wJ = w * J[c]
                gradient[i, c] += wJ * r
                for d in range(6):
                    diagonal[i, c, d] += wJ * J[d]
                for d in range(3):
                    F[view_count - 1, c, d] += wJ * b[d]
        # Cholesky: B = L L^T, in place. An unconstrained slope is left out.
        pivot0, pivot1, pivot2 = B[0, 0], B[1, 1], B[2, 2]
        for c in range(3):
            pivot = pivot0 if c == 0 else (pivot1 if c == 1 else pivot2)
            remainder = B[c, c]
            for e in range(c):
                remainder -= B[c, e] * B[c, e]
            B[c, c] = np.sqrt(remainder) if remainder > _MIN_PIVOT * pivot else 0.0
            for d in range(c + 1, 3):
                value = B[d, c]
                for e in range(c):
                    value -= B[d, e] * B[c, e]
                B[d, c] = value / B[c, c] if B[c, c] > 0 else 0.0
        for c in range(3):
            for e in range(c):
                h[c] -= B[c, e] * h[e]
            h[c] = h[c] / B[c, c] if B[c, c] > 0 else 0.0
        # E = F L^-T, so that F B^-1 F^T = E E^T.
        for j in range(view_count):
            for a in range(6):
                for c in range(3):
                    value = F[j, a, c]
                    for e in range(c):
                        value -= B[c, e] * E[j, a, e]
                    E[j, a, c] = value / B[c, c] if B[c, c] > 0 else 0.0
                    gradient[view_of[j], a] -= E[j, a, c] * h[c]
        for j in range(view_count):
            for i in range(j + 1):
                out = diagonal[view_of[j]] if i == j else cross[pair_row[view_of[i], view_of[j]]]
                for a in range(6):
                    for c in range(6):
                        value = 0.0
                        for e in range(3):
                            value += E[i, a, e] * E[j, c, e]
                        out[a, c] -= value


@kernel
def plane_support(
    x: Float64,
    view: Int64,
    start: Int64,
    mean: Float64,
    axes: Float64,
    view_counts: Int64,
    limit: float,
    support: Float64,
) -> None:
    """Add the support of each view: its points on planes that other views see as well.

    Parameters
    ----------
    x, view, start, mean, axes, view_counts
        As in `fit_cells`.
    limit
        Distance from the plane, m, beyond which a point is no support (Tukey's biweight).
    support
        (N,), added to: 1 for a point on a plane.
    """
    for s in range(len(start) - 1):
        if view_counts[s] < 2 or start[s + 1] - start[s] < _MIN_POINTS:
            continue
        for k in range(start[s], start[s + 1]):
            r = 0.0
            for c in range(3):
                r += axes[s, 0, c] * (x[k, c] - mean[s, c])
            e2 = r * r / (limit * limit)
            if e2 < 1:
                support[view[k]] += tukey.support(tukey.weight(e2))
