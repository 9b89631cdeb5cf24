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
from tofuse.engine.views import (
    DIFFERENCE,
    INLIERS,
    IS_INLIER,
    JACOBIAN,
    LANES,
    POINT_SIZE,
    ROWS,
    SQRT_WEIGHT,
    STAT,
    WEIGHT_G,
    WEIGHT_P,
    WEIGHTED_RESIDUAL,
    Residuals,
    TargetImage,
    ViewImages,
    compare_albedos,
    compare_planes,
    load_block,
    project_block,
    transform_block,
    write_point,
)

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
    source: ViewImages,
    target: TargetImage,
    T: Float64,
    residuals: Residuals,
    stride: int,
    tiles_x: int,
    tiles_y: int,
) -> tuple[Float64, Float64]:
    """Sum over every `stride`-th pixel of every `stride`-th row; see `alignment.accumulate`.

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
    points = np.zeros((LANES, POINT_SIZE), np.float32)
    tile_index = np.zeros(LANES, np.int64)
    block = np.zeros(ROWS * LANES, np.float32)
    sums = np.zeros((KINDS * UPPER, LANES))
    count = 0
    for row in range(stride // 2, rows, stride):
        for column in range(stride // 2, columns, stride):
            if planes[row, column, 3] > 0:
                write_point(
                    points[count],
                    rays[row, column],
                    planes[row, column],
                    plane_variance[row, column],
                    albedo[row, column],
                )
                tile_index[count] = row * tiles_y // rows * tiles_x + column * tiles_x // columns
                count += 1
            if count < LANES and (row + stride < rows or column + stride < columns):
                continue
            load_block(block, points[:count])
            transform_block(block, T)
            project_block(block, count, image, lookup, lookup_frame)
            compare_planes(block, T, scale_g, inflation, robust, min_cosine)
            _add_to_tiles(tiles, tile_index, block, count)
            _add_products(sums, block, GEOMETRIC, WEIGHT_G)
            if scale_p > 0:
                compare_albedos(block, T, exposure, scale_p, robust)
                _add_products(sums, block, PHOTOMETRIC, WEIGHT_P)
            count = 0
    upper = np.zeros((KINDS, UPPER))
    for c in range(KINDS):
        for q in range(UPPER):
            for k in range(LANES):
                upper[c, q] += sums[c * UPPER + q, k]
    return tiles, upper


@kernel
def _add_to_tiles(tiles: Float64, tile_index: Int64, block: Float32, count: int) -> None:
    for k in range(count):
        if block[IS_INLIER * LANES + k] > 0:
            tile, sqrt_weight = tiles[tile_index[k]], np.float64(block[SQRT_WEIGHT * LANES + k])
            for p in range(7):
                tile[RESPONSE + p] += sqrt_weight * block[(JACOBIAN + p) * LANES + k]
            tile[WEIGHT] += sqrt_weight * sqrt_weight
            tile[RESIDUAL] += sqrt_weight * block[WEIGHTED_RESIDUAL * LANES + k]
            tile[COUNT] += 1


@kernel
def _add_products(sums: Float64, block: Float32, kind: int, statistic: int) -> None:
    """Add the products of the rows of J to those of a kind, and to the weighted and cross sums."""
    slope = np.empty(LANES, np.float32)
    weights = block[(STAT + statistic - INLIERS) * LANES : (STAT + statistic - INLIERS + 1) * LANES]
    for k in range(LANES):
        slope[k] = tukey.relative_slope(weights[k])
    q = 0
    for p in range(7):
        a = block[(JACOBIAN + p) * LANES : (JACOBIAN + p + 1) * LANES]
        c = block[(DIFFERENCE + p) * LANES : (DIFFERENCE + p + 1) * LANES]
        for o in range(p, 7):
            b = block[(JACOBIAN + o) * LANES : (JACOBIAN + o + 1) * LANES]
            d = block[(DIFFERENCE + o) * LANES : (DIFFERENCE + o + 1) * LANES]
            products = sums[kind * UPPER + q]
            weighted, cross = sums[WEIGHTED * UPPER + q], sums[CROSS * UPPER + q]
            for k in range(LANES):
                products[k] += a[k] * b[k]
            if o < 6:
                for k in range(LANES):
                    symmetrised = a[k] * b[k] - c[k] * d[k]
                    weighted[k] += symmetrised
                    cross[k] += slope[k] * symmetrised
            else:  # the exposure has the same derivative in both Jacobians
                for k in range(LANES):
                    weighted[k] += a[k] * b[k]
                    cross[k] += slope[k] * a[k] * b[k]
            q += 1
