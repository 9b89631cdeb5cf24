"""Standard deviation of the range of each pixel, in one pass over the rows of an image."""

from __future__ import annotations

import math

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.compute import kernel

BY_RANGE, BY_AMPLITUDE, BY_CONFIDENCE, BY_CAMERA = 0, 1, 2, 3
SATURATED = 65535.0


@kernel
def range_sigma(
    depth: Float32,
    is_range: bool,
    rays: Float32,
    law: int,
    channel: Float32,
    compensated: bool,
    levels: Float64,
    cosine: Float32,
    parameters: Float64,
    start: int,
    stop: int,
    out: Float32,
) -> None:
    """Write the standard deviation in m of the radial range of each pixel of some rows.

    Parameters
    ----------
    depth
        (H, W) in m, 0 where invalid; radial range or z.
    is_range
        Whether `depth` is the radial range, not z.
    rays
        (H, W, 2) x/z and y/z, NaN where unknown.
    law
        `BY_RANGE`, `BY_AMPLITUDE`, `BY_CONFIDENCE`, or `BY_CAMERA`.
    channel
        (H, W) amplitude, confidence or the camera's own sigma, depending on `law`; (0, 0) if none.
    compensated
        Whether the amplitude was multiplied by the squared range and divided by the falloff.
    levels
        (K,) sigma in m at 1 m of each level of confidence.
    cosine
        (H, W) of the incidence, NaN where unknown; (0, 0) if unknown everywhere.
    parameters
        ceiling, floor, shot, dark, falloff, a, b, power, footprint: fields of the noise model.
    start, stop
        Rows of `out` (H, W) to write: 0 where invalid.
    """
    ceiling, floor, shot, dark, falloff, a, b, power, footprint = parameters
    width = depth.shape[1]
    slanted = cosine.shape[0] > 0 and footprint > 0
    if law == BY_RANGE and not slanted:
        _by_range(depth, is_range, rays, a, b, ceiling, start, stop, out)
        return
    for i in range(start, stop):
        for j in range(width):
            out[i, j] = 0
            x, y = float(rays[i, j, 0]), float(rays[i, j, 1])
            measured = float(depth[i, j])
            if not (measured > 0 and x == x and y == y):
                continue
            length2 = 1 + x * x + y * y
            distance2 = measured * measured if is_range else measured * measured * length2
            if law == BY_AMPLITUDE:
                amplitude = float(channel[i, j])
                if not amplitude < SATURATED:
                    amplitude = 0.0
                elif compensated:
                    amplitude /= distance2
                    if falloff == 4:
                        amplitude /= length2 * length2
                    elif falloff > 0:
                        amplitude *= length2 ** (-0.5 * falloff)
                if amplitude > 0:
                    inverse = 1 / amplitude
                    variance = floor * floor + (shot * shot + dark * dark * inverse) * inverse
                else:
                    variance = ceiling * ceiling
            elif law == BY_CONFIDENCE:
                level = min(max(int(channel[i, j]), 0), len(levels) - 1)
                variance = levels[level] ** 2
                if power > 0:
                    variance *= distance2**power
            elif law == BY_CAMERA:
                camera_sigma = float(channel[i, j])
                variance = camera_sigma * camera_sigma if camera_sigma > 0 else ceiling * ceiling
            else:
                sigma = a + b * distance2
                variance = sigma * sigma
            variance = min(variance, ceiling * ceiling)
            if slanted and cosine[i, j] == cosine[i, j]:
                neighbour = j + 1 if j + 1 < width else j - 1
                pitch = math.hypot(rays[i, neighbour, 0] - x, rays[i, neighbour, 1] - y)
                if pitch == pitch:
                    c = min(max(abs(float(cosine[i, j])), 0.1), 1.0)
                    extent = footprint * pitch * math.sqrt(distance2 / length2 * (1 - c * c)) / c
                    variance += extent * extent
            out[i, j] = math.sqrt(variance)


@kernel
def _by_range(
    depth: Float32,
    is_range: bool,
    rays: Float32,
    a: float,
    b: float,
    ceiling: float,
    start: int,
    stop: int,
    out: Float32,
) -> None:
    """Do the same for the law `BY_RANGE`, branch-free so that the loop is vectorised."""
    for i in range(start, stop):
        for j in range(depth.shape[1]):
            x, y = float(rays[i, j, 0]), float(rays[i, j, 1])
            measured = float(depth[i, j])
            known = (measured > 0) & (x == x) & (y == y)
            length2 = 1.0 if is_range else 1 + x * x + y * y
            sigma = min(a + b * (measured * measured * length2), ceiling)
            out[i, j] = sigma if known else 0.0
