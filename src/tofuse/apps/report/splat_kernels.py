"""Point splatting: the nearest point of each pixel."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64, Int32
from tofuse.engine.compute import kernel

# Fraction of the viewpoint's distance; nearer points are not drawn.
_MIN_DEPTH = 0.02


@kernel
def nearest_points(
    points: Float64,
    T_view_world: Float64,
    scale: float,
    eye_distance: float,
    side: int,
    depth: Float64,
    index: Int32,
) -> None:
    """Find the nearest point of each pixel; points are drawn as squares, ties go to the last.

    Parameters
    ----------
    points
        (N, 3) m.
    T_view_world
        (4, 4) into a view whose axes are x right, y down, z into the image.
    scale
        Pixels per metre (in perspective projections at the view's origin).
    eye_distance
        Distance of the viewpoint from the view's origin in m; 0 for a parallel projection.
    side
        Pixels along the side of a square, whose upper left pixel contains the point. Points outside
        the image are not drawn.
    depth, index
        (H, W) depth and row of the nearest point, updated; initially infinite and -1.
    """
    height, width = index.shape
    T = T_view_world
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        view_z = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        zoom = scale
        if eye_distance > 0:
            view_z += eye_distance
            if not view_z > _MIN_DEPTH * eye_distance:
                continue
            zoom = scale * eye_distance / view_z
        u = np.rint(0.5 * width + zoom * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]))
        v = np.rint(0.5 * height + zoom * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]))
        if not (u >= 0 and v >= 0 and u < width and v < height):
            continue
        for r in range(int(v), min(int(v) + side, height)):
            for c in range(int(u), min(int(u) + side, width)):
                if view_z <= depth[r, c]:
                    depth[r, c] = view_z
                    index[r, c] = k
