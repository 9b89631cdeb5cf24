"""The visible point at each pixel, against a slow reference."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.apps.report.thumbnails import splat


@pytest.mark.parametrize(("distance", "radius"), [(0.0, 1), (0.0, 3), (2.0, 1), (2.0, 2)])
def test_nearest_point_of_each_pixel_is_found(distance: float, radius: int) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.5, 1.5, (400, 3))
    points[5], points[6], points[7] = np.nan, points[8], (0, 0, -1.99)
    T = np.eye(4)
    T[:3, 3] = 0.1, -0.2, 0.3
    scale, (height, width) = 12.0, (23, 31)
    colors = np.stack([np.zeros(400), *np.divmod(np.arange(400), 256)], 1).astype(np.uint8)
    image = splat(
        points, colors, T, (width, height), scale=scale, distance=distance or None, radius=radius
    ).astype(int)
    found = np.where(image[..., 3] > 0, 256 * image[..., 1] + image[..., 2], -1)

    wanted = np.full((height, width), -1)
    nearest = np.full((height, width), np.inf)
    for k, p in enumerate(points + T[:3, 3]):
        if not np.isfinite(p).all() or (distance and p[2] + distance <= 0.02 * distance):
            continue
        zoom = scale * (distance / (p[2] + distance) if distance else 1.0)
        u, v = round(width / 2 + zoom * p[0]), round(height / 2 + zoom * p[1])
        if not (0 <= u < width and 0 <= v < height):
            continue
        square = np.s_[v : v + radius, u : u + radius]
        nearer = p[2] <= nearest[square]
        wanted[square][nearer] = k
        nearest[square][nearer] = p[2]
    np.testing.assert_array_equal(found, wanted)
    assert 50 < (found >= 0).sum() < found.size
    assert 6 not in found, "of two coincident points the last is seen"
