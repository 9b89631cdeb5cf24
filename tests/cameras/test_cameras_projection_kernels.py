"""Projection by a lookup table."""

from __future__ import annotations

import numpy as np

from tofuse.engine.cameras.projection_kernels import project_ray, project_rays


def test_many_rays_project_like_single_rays() -> None:
    rng = np.random.default_rng(0)
    lookup = rng.normal(50, 20, (7, 9, 2)).astype(np.float32)
    frame = np.array([-0.8, -0.6, 5.0, 5.0])
    # The grid reaches from -0.8 to 0.8 and from -0.6 to 0.6; some rays are outside.
    x, y = rng.uniform(-1, 1, (2, 500)).astype(np.float32)
    x[:4], y[:4] = [-0.8, 0.8, np.nan, 0.1], [-0.6, 0.1, 0.1, np.inf]
    u, v = np.empty(500), np.empty(500)
    project_rays(x, y, lookup, frame, u, v)
    inside = 0
    for k in range(500):
        alone = project_ray(x[k], y[k], lookup, frame)
        if alone[2] < 0:
            assert np.isnan(u[k])
        else:
            assert (u[k], v[k]) == alone[:2]
            inside += 1
    assert 100 < inside < 400
