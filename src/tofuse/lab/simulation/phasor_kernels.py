"""Phasors of the light in a pixel of an amplitude-modulated camera.

Light of strength s on a path of L m, at the wave number k (2 pi f / c, per m), contributes
``s exp(i n k L)`` to harmonic n. Channels, in this order: the sum of the strengths, then the real
and imaginary parts of harmonics 1, 3 and 5.
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.compute import kernel

CHANNELS = 7


@kernel
def ray_phasors(
    strength: Float64, path: Float64, wave_number: float, start: int, stop: int, out: Float64
) -> None:
    """Phasors `out` (N, 7) of rays start to stop, from R returns each: strength, path (N, R)."""
    for i in range(start, stop):
        for c in range(7):
            out[i, c] = 0.0
        for j in range(strength.shape[1]):
            s = strength[i, j]
            if s <= 0.0:
                continue
            phase = wave_number * path[i, j]
            re = np.cos(phase)
            im = np.sin(phase)
            re2 = re * re - im * im
            im2 = 2.0 * re * im
            re3 = re2 * re - im2 * im
            im3 = re2 * im + im2 * re
            out[i, 0] += s
            out[i, 1] += s * re
            out[i, 2] += s * im
            out[i, 3] += s * re3
            out[i, 4] += s * im3
            out[i, 5] += s * (re3 * re2 - im3 * im2)
            out[i, 6] += s * (re3 * im2 + im3 * re2)


@kernel
def pool(fine: Float64, weights: Float64, stride: int, start: int, stop: int, out: Float64) -> None:
    """Weighted sums `out` (H, W, C) over windows of `fine` (Hf, Wf, C), for rows start to stop."""
    for v in range(start, stop):
        for u in range(out.shape[1]):
            for c in range(out.shape[2]):
                total = 0.0
                for i in range(weights.shape[0]):
                    for j in range(weights.shape[0]):
                        total += weights[i] * weights[j] * fine[v * stride + i, u * stride + j, c]
                out[v, u, c] = total


@kernel
def plane_deviation(
    points: Float64,
    normals: Float64,
    window: int,
    stride: int,
    start: int,
    stop: int,
    out: Float64,
) -> None:
    """Largest distance `out` (H, W) of a window's points from the tangent plane at its centre.

    Non-finite points (Hf, Wf, 3) are ignored. Where the centre is not finite, the difference of the
    largest and the smallest range is used.
    """
    half = window // 2
    for v in range(start, stop):
        for u in range(out.shape[1]):
            cv, cu = v * stride + half, u * stride + half
            px, py, pz = points[cv, cu, 0], points[cv, cu, 1], points[cv, cu, 2]
            nx, ny, nz = normals[cv, cu, 0], normals[cv, cu, 1], normals[cv, cu, 2]
            centre = np.isfinite(px)
            largest = 0.0
            near = np.inf
            far = 0.0
            for i in range(window):
                for j in range(window):
                    x = points[v * stride + i, u * stride + j, 0]
                    y = points[v * stride + i, u * stride + j, 1]
                    z = points[v * stride + i, u * stride + j, 2]
                    if not np.isfinite(x):
                        continue
                    if centre:
                        d = abs(nx * (x - px) + ny * (y - py) + nz * (z - pz))
                        largest = max(largest, d)
                    else:
                        r = np.sqrt(x * x + y * y + z * z)
                        near = min(near, r)
                        far = max(far, r)
            out[v, u] = largest if centre else max(0.0, far - near)


@kernel
def upsample(
    coarse: Float64,
    coarse_points: Float64,
    coarse_normals: Float64,
    points: Float64,
    normals: Float64,
    step: int,
    start: int,
    stop: int,
    out: Float64,
) -> None:
    """Joint bilateral interpolation of a coarse grid, for rows start to stop of `out` (H, W, C).

    Node (i, j) of `coarse` (Hc, Wc, C) lies at pixel (step // 2 + i step, step // 2 + j step).
    Nodes are weighted by their distance in the image, by their distance from the pixel's tangent
    plane, and by the angle between the normals, so that nothing leaks across edges. `out` is 0 at
    non-finite points (H, W, 3).
    """
    first = step // 2
    for v in range(start, stop):
        for u in range(out.shape[1]):
            for c in range(out.shape[2]):
                out[v, u, c] = 0.0
            px, py, pz = points[v, u, 0], points[v, u, 1], points[v, u, 2]
            if not np.isfinite(px):
                continue
            nx, ny, nz = normals[v, u, 0], normals[v, u, 1], normals[v, u, 2]
            scale = 0.01 * np.sqrt(px * px + py * py + pz * pz) + 0.005
            fi = (v - first) / step
            fj = (u - first) / step
            ci = int(np.floor(fi + 0.5))
            cj = int(np.floor(fj + 0.5))
            total = 0.0
            for i in range(max(0, ci - 1), min(coarse.shape[0], ci + 2)):
                for j in range(max(0, cj - 1), min(coarse.shape[1], cj + 2)):
                    if not np.isfinite(coarse_points[i, j, 0]):
                        continue
                    deviation = (
                        nx * (coarse_points[i, j, 0] - px)
                        + ny * (coarse_points[i, j, 1] - py)
                        + nz * (coarse_points[i, j, 2] - pz)
                    ) / scale
                    cosine = (
                        nx * coarse_normals[i, j, 0]
                        + ny * coarse_normals[i, j, 1]
                        + nz * coarse_normals[i, j, 2]
                    )
                    cosine = max(0.0, cosine)
                    distance2 = (i - fi) ** 2 + (j - fj) ** 2
                    w = np.exp(-1.5 * distance2) * (
                        np.exp(-deviation * deviation) * cosine**4 + 1e-6
                    )
                    total += w
                    for c in range(out.shape[2]):
                        out[v, u, c] += w * coarse[i, j, c]
            if total > 0.0:
                for c in range(out.shape[2]):
                    out[v, u, c] /= total
