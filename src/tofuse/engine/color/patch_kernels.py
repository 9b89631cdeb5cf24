"""Alignment of image patches: inverse compositional Lucas-Kanade (Baker and Matthews 2004).

A patch of the source is compared with the target under an affine map, after subtraction of its mean
and division by its standard deviation, so that exposure does not matter. Only its position is
estimated: the map follows from the predicted motion and the plane of the patch.
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64, UInt8
from tofuse.engine.compute import kernel

HALF = 5  # a patch has 2 HALF + 1 pixels along each side
_ITERATIONS = 8
_MAX_STEP = 2.0  # pixels of the level, in one iteration
_CONVERGED, _CLOSE = 0.01, 0.3  # pixels of the level
_MIN_DETERMINANT = (
    1e-6  # of the gradients' products, relative to their trace squared: one edge only
)
FAILED, UNKNOWN = -3.0, -2.0


@kernel
def _sample(image: UInt8, x: float, y: float) -> float:
    """Bilinear interpolation; (x, y) and its right and lower neighbours are inside."""
    x0, y0 = int(x), int(y)
    a, b = x - x0, y - y0
    upper = (1.0 - a) * image[y0, x0] + a * image[y0, x0 + 1]
    lower = (1.0 - a) * image[y0 + 1, x0] + a * image[y0 + 1, x0 + 1]
    return (1.0 - b) * upper + b * lower


@kernel
def align_patches(
    source: UInt8,
    target: UInt8,
    pixels: Float64,
    maps: Float64,
    scale: float,
    found: Float64,
    score: Float64,
) -> None:
    """Refine the positions of patches in another image, at one level of both.

    Parameters
    ----------
    source, target
        (H, W) grey images of the level.
    pixels
        (N, 2) centres of the patches in the full source image.
    maps
        (N, 2, 2) from offsets in the source to offsets in the target.
    scale
        Pixels of the full image per pixel of the level.
    found
        (N, 2) positions in the full target image; updated.
    score
        (N,) correlation of the patches, `FAILED` where it can't be computed, `UNKNOWN` where the
        iterations did not converge; patches that failed before are left out.
    """
    side = 2 * HALF + 1
    count = side * side
    margin = HALF + 1
    area = np.empty((side + 2, side + 2))
    patch, gx, gy = np.empty(count), np.empty(count), np.empty(count)
    for k in range(len(pixels)):
        x, y = (pixels[k, 0] + 0.5) / scale - 0.5, (pixels[k, 1] + 0.5) / scale - 0.5
        if (
            score[k] == FAILED
            or not (x >= margin and x < source.shape[1] - margin - 1)
            or not (y >= margin and y < source.shape[0] - margin - 1)
        ):
            continue
        for j in range(side + 2):
            for i in range(side + 2):
                area[j, i] = _sample(source, x + i - margin, y + j - margin)
        q = 0
        for j in range(1, side + 1):
            for i in range(1, side + 1):
                patch[q] = area[j, i]
                gx[q] = 0.5 * (area[j, i + 1] - area[j, i - 1])
                gy[q] = 0.5 * (area[j + 1, i] - area[j - 1, i])
                q += 1
        patch -= patch.mean()
        gx -= gx.mean()
        gy -= gy.mean()
        xx, xy, yy = (gx * gx).sum(), (gx * gy).sum(), (gy * gy).sum()
        of_x, of_y, square = (patch * gx).sum(), (patch * gy).sum(), (patch * patch).sum()
        determinant = xx * yy - xy * xy
        if determinant <= _MIN_DETERMINANT * (xx + yy) ** 2:
            score[k] = FAILED
            continue
        a, b, c, d = maps[k, 0, 0], maps[k, 0, 1], maps[k, 1, 0], maps[k, 1, 1]
        width, height = HALF * (abs(a) + abs(b)), HALF * (abs(c) + abs(d))
        u, v = (found[k, 0] + 0.5) / scale - 0.5, (found[k, 1] + 0.5) / scale - 0.5
        correlation, length, inside = 0.0, np.inf, True
        for _ in range(_ITERATIONS):
            inside = (
                u >= width
                and v >= height
                and u < target.shape[1] - width - 1
                and v < target.shape[0] - height - 1
            )
            if not inside or length < _CONVERGED:
                break
            total, squares, product, by_x, by_y = 0.0, 0.0, 0.0, 0.0, 0.0
            q = 0
            for j in range(-HALF, HALF + 1):
                for i in range(-HALF, HALF + 1):
                    t = _sample(target, u + a * i + b * j, v + c * i + d * j)
                    total += t
                    squares += t * t
                    product += t * patch[q]
                    by_x += t * gx[q]
                    by_y += t * gy[q]
                    q += 1
            variance = max(squares - total * total / count, 1e-9)
            gain = np.sqrt(square / variance)
            correlation = product / np.sqrt(square * variance)
            e_x, e_y = gain * by_x - of_x, gain * by_y - of_y
            step_x = (yy * e_x - xy * e_y) / determinant
            step_y = (xx * e_y - xy * e_x) / determinant
            length = np.hypot(step_x, step_y)
            shorten = min(1.0, _MAX_STEP / max(length, 1e-9))
            u -= shorten * (a * step_x + b * step_y)
            v -= shorten * (c * step_x + d * step_y)
        if inside:
            found[k, 0], found[k, 1] = (u + 0.5) * scale - 0.5, (v + 0.5) * scale - 0.5
            score[k] = correlation if length < _CLOSE else UNKNOWN
        else:
            score[k] = FAILED
