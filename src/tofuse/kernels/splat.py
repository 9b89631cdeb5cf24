"""Point splatting: the nearest point of each pixel."""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float64, Int32
from tofuse.kernels.jit import kernel

# Fraction of the eye's distance; nearer points are not drawn.
_MIN_DEPTH = 0.02


@kernel
def nearest_points(
    points: Float64,
    T_view_world: Float64,
    scale: float,
    distance: float,
    radius: int,
    depth: Float64,
    found: Int32,
) -> None:
    """Find the nearest point of each pixel, with points drawn as squares; ties go to the last.

    Parameters
    ----------
    points
        (N, 3) m.
    T_view_world
        (4, 4) into a view whose axes are x right, y down, z into the picture.
    scale
        Pixels per metre (at the view's origin, where there is a perspective).
    distance
        Of the eye from the view's origin in m; 0 for a parallel projection.
    radius
        Pixels along the side of a square, whose upper left one the point is in. Points outside of
        the picture are not drawn.
    depth, found
        (H, W) depths and rows of the nearest points, written where one is nearer: infinite and -1
        at first.
    """
    height, width = found.shape
    T = T_view_world
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        far = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        zoom = scale
        if distance > 0:
            far += distance
            if not far > _MIN_DEPTH * distance:
                continue
            zoom = scale * distance / far
        u = np.rint(0.5 * width + zoom * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]))
        v = np.rint(0.5 * height + zoom * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]))
        if not (u >= 0 and v >= 0 and u < width and v < height):
            continue
        for r in range(int(v), min(int(v) + radius, height)):
            for c in range(int(u), min(int(u) + radius, width)):
                if far <= depth[r, c]:
                    depth[r, c] = far
                    found[r, c] = k
