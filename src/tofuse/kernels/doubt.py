"""Information that errors fixed to the camera can fake: what has to be left of it to be believed.

Independent noise cancels in the symmetrised cross-information of two views. What bends both views
alike does not: light by way of other surfaces rounds corners and bows walls, scattering and the
lens shade the albedo, and range errs with the brightness. Such errors tilt normals and slope the
albedo in both Jacobians, and a flat wall seems to hold what it can't. How much they can fake at
most follows from how large such tilts and slopes are known to be.
"""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float32, Float64
from tofuse.kernels.alignment import LIGHT, NORMAL, POINT, SIGMA
from tofuse.kernels.jit import kernel
from tofuse.kernels.projection import jacobian_row


@kernel
def faked_information(
    points: Float32,
    every: int,
    scale: float,
    slack: float,
    photo_variance: float,
    tilt: float,
    slope: float,
) -> Float64:
    """(6, 6) expected information, a point, of random tilts and slopes that two views share.

    Parameters
    ----------
    points
        (N, POINT_SIZE), see `alignment`; every so manieth is looked at.
    scale, slack
        Sigmas of the distances are multiplied by the first; the second is added in quadrature, m.
    photo_variance
        Of the log albedo; 0 if it takes no part.
    tilt
        Standard deviation of the common error of normals along either tangent, rad.
    slope
        The same of the log albedo's slopes by ray coordinate.
    """
    out = np.zeros((6, 6))
    J = np.empty(6)
    per_photo = slope * slope / photo_variance if photo_variance > 0 else 0.0
    count = 0
    for k in range(0, points.shape[0], every):
        count += 1
        x = np.float64(points[k, POINT])
        y = np.float64(points[k, POINT + 1])
        z = np.float64(points[k, POINT + 2])
        a = np.float64(points[k, NORMAL])
        b = np.float64(points[k, NORMAL + 1])
        c = np.float64(points[k, NORMAL + 2])
        sigma = (x * a + y * b + z * c) * np.float64(points[k, SIGMA]) * scale
        weight = tilt * tilt / max(2 * sigma * sigma + slack * slack, 1e-12)
        # Over both tangents: all three axes less the normal.
        _add(out, J, weight, 1.0, 0.0, 0.0, x, y, z)
        _add(out, J, weight, 0.0, 1.0, 0.0, x, y, z)
        _add(out, J, weight, 0.0, 0.0, 1.0, x, y, z)
        _add(out, J, -weight, a, b, c, x, y, z)
        if per_photo > 0 and not np.isnan(points[k, LIGHT]):
            _add(out, J, per_photo, 1 / z, 0.0, -x / (z * z), x, y, z)
            _add(out, J, per_photo, 0.0, 1 / z, -y / (z * z), x, y, z)
    return out / max(count, 1)


@kernel
def _add(
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
    jacobian_row(J, m0, m1, m2, x, y, z)
    for p in range(6):
        for o in range(6):
            out[p, o] += weight * J[p] * J[o]
