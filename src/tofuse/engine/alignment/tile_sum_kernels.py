"""Normal equations of an alignment per image tile, for its sandwich covariance.

Systematic errors of a range camera (multipath, lens scattering, motion) are correlated over patches
much larger than a pixel. The scatter of the tiles' gradients therefore measures the error of the
pose better than the pixels' noise.
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float32, Float64, Int64
from tofuse.engine.compute import kernel
from tofuse.engine.compute import tukey_kernels as tukey
from tofuse.engine.views import residual_kernels as res

# Layout of a tile's sums, over the distances of its pixels.
RESPONSE = 0  # 7: sum of w J, the response of the gradient to an error shared by the tile
WEIGHT = 7  # sum of w
RESIDUAL = 8  # sum of w r
COUNT = 9
SIZE = 10
# Sums over the whole image: upper triangles (28) of 7x7 matrices, whose seventh unknown is the
# exposure. w J J^T of the distances and of the albedo; and for both terms together, the symmetrised
# product of the target's and source's Jacobians, weighted by w and by the derivative of the
# influence function.
GEOMETRIC, PHOTOMETRIC, WEIGHTED, CROSS = 0, 1, 2, 3
KINDS = 4
UPPER = 28


@kernel
def tile_sums(
    source: res.ViewImages,
    target: res.TargetImage,
    T: Float64,
    residuals: res.Residuals,
    stride: int,
    tiles_x: int,
    tiles_y: int,
) -> tuple[Float64, Float64]:
    """Sum over every `stride`-th pixel of every `stride`-th row; see `residual_kernels.accumulate`.

    The image is divided into `tiles_y` x `tiles_x` tiles.

    Returns
    -------
    (tiles_y * tiles_x, SIZE) sums of the tiles, and (KINDS, UPPER) of the image.
    """
    rays, planes, plane_variance, albedo = source
    image, lookup, lookup_frame = target
    exposure, scale_g, scale_p, inflation, robust, min_cosine = residuals
    rows, columns = planes.shape[0], planes.shape[1]
    tiles = np.zeros((tiles_y * tiles_x, SIZE))
    points = np.zeros((res.LANES, res.POINT_SIZE), np.float32)
    tile_index = np.zeros(res.LANES, np.int64)
    block = np.zeros(res.ROWS * res.LANES, np.float32)
    sums = np.zeros((KINDS * UPPER, res.LANES))
    count = 0
    for row in range(stride // 2, rows, stride):
        for column in range(stride // 2, columns, stride):
            if planes[row, column, 3] > 0:
                res.write_point(
                    points[count],
                    rays[row, column],
                    planes[row, column],
                    plane_variance[row, column],
                    albedo[row, column],
                )
                tile_index[count] = row * tiles_y // rows * tiles_x + column * tiles_x // columns
                count += 1
            is_last = row + stride >= rows and column + stride >= columns
            if count < res.LANES and not is_last:
                continue
            res.load_block(block, points[:count])
            res.transform_block(block, T)
            res.project_block(block, count, image, lookup, lookup_frame)
            res.compare_planes(block, T, scale_g, inflation, robust, min_cosine)
            _add_to_tiles(tiles, tile_index, block, count)
            _add_products(sums, block, GEOMETRIC, res.WEIGHT_G)
            if scale_p > 0:
                res.compare_albedos(block, T, exposure, scale_p, robust)
                _add_products(sums, block, PHOTOMETRIC, res.WEIGHT_P)
            count = 0
    upper = np.zeros((KINDS, UPPER))
    for c in range(KINDS):
        for q in range(UPPER):
            for k in range(res.LANES):
                upper[c, q] += sums[c * UPPER + q, k]
    return tiles, upper


@kernel
def _add_to_tiles(tiles: Float64, tile_index: Int64, block: Float32, count: int) -> None:
    is_inlier, sqrt_weights = _row(block, res.IS_INLIER), _row(block, res.SQRT_WEIGHT)
    residuals = _row(block, res.WEIGHTED_RESIDUAL)
    for k in range(count):
        if is_inlier[k] > 0:
            tile, sqrt_weight = tiles[tile_index[k]], np.float64(sqrt_weights[k])
            for p in range(7):
                tile[RESPONSE + p] += sqrt_weight * block[(res.JACOBIAN + p) * res.LANES + k]
            tile[WEIGHT] += sqrt_weight * sqrt_weight
            tile[RESIDUAL] += sqrt_weight * residuals[k]
            tile[COUNT] += 1


@kernel
def _add_products(sums: Float64, block: Float32, kind: int, statistic: int) -> None:
    """Add the products of the rows of J to those of a kind, and to the weighted and cross sums."""
    slope = np.empty(res.LANES, np.float32)
    weights = _row(block, res.STAT + statistic - res.INLIERS)
    for k in range(res.LANES):
        slope[k] = tukey.relative_slope(weights[k])
    q = 0
    for p in range(7):
        a, c = _row(block, res.JACOBIAN + p), _row(block, res.DIFFERENCE + p)
        for o in range(p, 7):
            b, d = _row(block, res.JACOBIAN + o), _row(block, res.DIFFERENCE + o)
            products = sums[kind * UPPER + q]
            weighted, cross = sums[WEIGHTED * UPPER + q], sums[CROSS * UPPER + q]
            for k in range(res.LANES):
                products[k] += a[k] * b[k]
            if o < 6:
                for k in range(res.LANES):
                    symmetrised = a[k] * b[k] - c[k] * d[k]
                    weighted[k] += symmetrised
                    cross[k] += slope[k] * symmetrised
            else:  # the exposure has the same derivative in both Jacobians
                for k in range(res.LANES):
                    weighted[k] += a[k] * b[k]
                    cross[k] += slope[k] * a[k] * b[k]
            q += 1


@kernel
def _row(block: Float32, row: int) -> Float32:
    return block[row * res.LANES : (row + 1) * res.LANES]
