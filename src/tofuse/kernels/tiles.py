"""What each patch of an image says about a pose: normal equations, tile by tile.

Errors of a range camera that are not noise (light by way of other surfaces, scattering in the
lens, motion) are alike over patches much larger than a pixel. How the patches disagree about the
pose tells more of its error than the noise of the pixels does.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofuse.kernels.alignment import ALBEDO, ALBEDO_SLOPE, DISTANCE, PLANE, VARIANCE
from tofuse.kernels.jit import kernel
from tofuse.kernels.projection import jacobian_row, landing

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# Layout of a tile's sums.
H = 0  # 28: upper triangle of the 7x7 sum of w J J^T; the seventh unknown is the exposure
G = 28  # 7: sum of w J r
A = 35  # 7: sum of w J, what an error common to the tile does to G
WEIGHT = 42  # sum of w
RESIDUAL = 43  # sum of w r
COUNT = 44
CROSS = 45  # 28: symmetrised product of the Jacobians of target and source
SIZE = 73
GEOMETRY, PHOTO = 0, 1


@kernel
def tile_sums(
    rays: Float32,
    planes: Float32,
    plane_variance: Float32,
    photo: Float32,
    target: Float32,
    lookup: Float32,
    lookup_frame: Float64,
    T: Float64,
    exposure: float,
    scale_g: float,
    scale_p: float,
    robust: float,
    min_cosine: float,
    stride: int,
    tiles_x: int,
    tiles_y: int,
    start: int,
    stop: int,
) -> Float64:
    """Sum over the source's pixels of rows of tiles start..stop; see `alignment.accumulate`.

    The source is given by its images, the target as `alignment.make_target` packs it.

    Returns
    -------
    (stop - start, tiles_x, 2, SIZE), for the distances and for the albedo.
    """
    rows, columns = planes.shape[0], planes.shape[1]
    out = np.zeros((stop - start, tiles_x, 2, SIZE))
    height, width = target.shape[0], target.shape[1]
    limit2 = robust * robust
    J = np.zeros(7)
    K = np.zeros(7)
    first = (start * rows + tiles_y - 1) // tiles_y
    last = (stop * rows + tiles_y - 1) // tiles_y
    half = stride // 2
    for row in range(first + (half - first) % stride, last, stride):
        for column in range(half, columns, stride):
            inverse_z = np.float64(planes[row, column, 3])
            if inverse_z <= 0:
                continue
            tile = out[row * tiles_y // rows - start, column * tiles_x // columns]
            pz = 1 / inverse_z
            px = rays[row, column, 0] * pz
            py = rays[row, column, 1] * pz
            qz = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
            if qz <= 0.02:
                continue
            qx = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
            qy = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
            xn = qx / qz
            yn = qy / qz
            u, v, iu, _ = landing(xn, yn, lookup, lookup_frame)
            if iu < 0:
                continue
            if not (u > -0.5 and v > -0.5 and u < width - 0.5 and v < height - 0.5):
                continue
            pixel = target[int(v + 0.5), int(u + 0.5)]
            distance = np.float64(pixel[DISTANCE])
            if distance == 0:
                continue
            n0 = np.float64(pixel[PLANE])
            n1 = np.float64(pixel[PLANE + 1])
            n2 = np.float64(pixel[PLANE + 2])
            across = n0 * qx + n1 * qy + n2 * qz
            r = across - distance
            m0 = T[0, 0] * n0 + T[1, 0] * n1 + T[2, 0] * n2
            m1 = T[0, 1] * n0 + T[1, 1] * n1 + T[2, 1] * n2
            m2 = T[0, 2] * n0 + T[1, 2] * n1 + T[2, 2] * n2
            along = (m0 * px + m1 * py + m2 * pz) * pz
            own = along * along * plane_variance[row, column] + pixel[VARIANCE]
            variance = own * scale_g * scale_g
            e2 = r * r / variance
            if e2 >= limit2:
                continue
            a = np.float64(planes[row, column, 0])
            b = np.float64(planes[row, column, 1])
            c = np.float64(planes[row, column, 2])
            length = np.sqrt(a * a + b * b + c * c)
            s0 = a / length
            s1 = b / length
            s2 = c / length
            if s0 * m0 + s1 * m1 + s2 * m2 < min_cosine:
                continue
            f = 1 - e2 / limit2
            jacobian_row(J, m0, m1, m2, px, py, pz)
            J[6] = 0.0
            jacobian_row(K, s0, s1, s2, px, py, pz)
            K[6] = 0.0
            slope = f * (f - 4 * e2 / limit2) / variance
            _add(tile[GEOMETRY], J, K, r, f * f / variance, slope)

            tx = np.float64(pixel[ALBEDO_SLOPE])
            ty = np.float64(pixel[ALBEDO_SLOPE + 1])
            level = np.float64(photo[row, column, 0])
            if scale_p <= 0 or np.isnan(tx) or np.isnan(level):
                continue
            r = pixel[ALBEDO] + tx * xn + ty * yn - level - exposure
            e2 = r * r / (scale_p * scale_p)
            if e2 >= limit2:
                continue
            f = 1 - e2 / limit2
            d0 = tx / qz
            d1 = ty / qz
            d2 = -(tx * xn + ty * yn) / qz
            m0 = T[0, 0] * d0 + T[1, 0] * d1 + T[2, 0] * d2
            m1 = T[0, 1] * d0 + T[1, 1] * d1 + T[2, 1] * d2
            m2 = T[0, 2] * d0 + T[1, 2] * d1 + T[2, 2] * d2
            jacobian_row(J, m0, m1, m2, px, py, pz)
            J[6] = -1.0
            gx = np.float64(photo[row, column, 1])
            gy = np.float64(photo[row, column, 2])
            jacobian_row(K, gx / pz, gy / pz, -(gx * px + gy * py) / (pz * pz), px, py, pz)
            K[6] = -1.0
            p2 = scale_p * scale_p
            _add(tile[PHOTO], J, K, r, f * f / p2, f * (f - 4 * e2 / limit2) / p2)
    return out


@kernel
def _add(sums: Float64, J: Float64, K: Float64, r: float, weight: float, slope: float) -> None:
    q = 0
    for p in range(7):
        gj = weight * 0.5 * (J[p] + K[p])
        sums[G + p] += gj * r
        sums[A + p] += gj
        for o in range(p, 7):
            sums[H + q] += gj * 0.5 * (J[o] + K[o])
            sums[CROSS + q] += 0.5 * slope * (J[p] * K[o] + K[p] * J[o])
            q += 1
    sums[WEIGHT] += weight
    sums[RESIDUAL] += weight * r
    sums[COUNT] += 1
