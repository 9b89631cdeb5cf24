"""Spurious information about the relative pose of two views, due to shared systematic errors.

Independent noise cancels in the symmetrised cross-information of two views. Errors that distort
both views alike do not: multipath rounds corners and bends walls, scattering and lens shading
change the albedo, and the range depends on the amplitude. They tilt normals and add albedo
gradients in both Jacobians, so that a flat wall seems to constrain directions that it does not
constrain. The expected information follows from the standard deviations of such tilts and
gradients.
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.cameras import projection_kernels
from tofuse.engine.compute import kernel
from tofuse.engine.views import residual_kernels


@kernel
def spurious_information(
    points: Float32,
    stride: int,
    scale: float,
    inflation: float,
    albedo_variance: float,
    tilt: float,
    slope: float,
) -> Float64:
    """Return the expected information (6, 6) per point due to tilts and slopes shared by two views.

    Parameters
    ----------
    points
        (N, POINT_SIZE), see `alignment`.
    stride
        Every `stride`-th point is used.
    scale, inflation
        Factor of the sigmas of distances, and noise inflation added in quadrature, m.
    albedo_variance
        Variance of the log albedo residuals; 0 without the photometric term.
    tilt
        Standard deviation of the shared error of normals, per tangent direction, rad.
    slope
        Standard deviation of the shared error of the log albedo's slope per ray coordinate.
    """
    out = np.zeros((6, 6))
    J = np.empty(6)
    albedo_weight = slope * slope / albedo_variance if albedo_variance > 0 else 0.0
    count = 0
    for k in range(0, points.shape[0], stride):
        count += 1
        x = np.float64(points[k, residual_kernels.POINT])
        y = np.float64(points[k, residual_kernels.POINT + 1])
        z = np.float64(points[k, residual_kernels.POINT + 2])
        a = np.float64(points[k, residual_kernels.NORMAL])
        b = np.float64(points[k, residual_kernels.NORMAL + 1])
        c = np.float64(points[k, residual_kernels.NORMAL + 2])
        sigma = (x * a + y * b + z * c) * np.float64(points[k, residual_kernels.SIGMA]) * scale
        weight = tilt * tilt / max(2 * sigma * sigma + inflation * inflation, 1e-12)
        # Sum over both tangent directions: all three axes minus the normal.
        _add_outer(out, J, weight, 1.0, 0.0, 0.0, x, y, z)
        _add_outer(out, J, weight, 0.0, 1.0, 0.0, x, y, z)
        _add_outer(out, J, weight, 0.0, 0.0, 1.0, x, y, z)
        _add_outer(out, J, -weight, a, b, c, x, y, z)
        if albedo_weight > 0 and not np.isnan(points[k, residual_kernels.POINT_ALBEDO]):
            _add_outer(out, J, albedo_weight, 1 / z, 0.0, -x / (z * z), x, y, z)
            _add_outer(out, J, albedo_weight, 0.0, 1 / z, -y / (z * z), x, y, z)
    return out / max(count, 1)


@kernel
def _add_outer(
    out: Float64,
    J: Float64,
    weight: float,
    m0: float,
    m1: float,
    m2: float,
    x: float,
    y: float,
    z: float,
) -> None:
    projection_kernels.jacobian_row(J, m0, m1, m2, x, y, z)
    for p in range(6):
        for o in range(6):
            out[p, o] += weight * J[p] * J[o]
