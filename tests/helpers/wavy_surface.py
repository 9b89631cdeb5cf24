"""A wavy mesh of any size."""

from __future__ import annotations

import numpy as np

from tofuse.engine.fusion.mesh import Mesh

N = 180


def waves(n=N, origin=(3.0, -2.0, 5.0)):
    """A wavy surface of 2 n^2 triangles, 1 cm each, that closes over a part of itself."""
    x, y = np.meshgrid(np.arange(n + 1) / 100, np.arange(n + 1) / 100)
    z = 0.1 * np.sin(9 * x) * np.cos(7 * y)
    vertices = np.stack([x, y, z], -1).reshape(-1, 3) + origin
    k = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = k[:-1, :-1].ravel(), k[:-1, 1:].ravel(), k[1:, 1:].ravel(), k[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    normals = np.stack([-0.9 * np.cos(9 * x), 0 * y, np.ones_like(x)], -1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rng = np.random.default_rng(0)
    count = len(vertices)
    return Mesh(
        vertices.astype(np.float32),
        faces.astype(np.int32),
        normals.astype(np.float32),
        rng.integers(0, 256, (count, 3)).astype(np.uint8),
        rng.uniform(0.001, 0.02, count).astype(np.float32),
        rng.integers(1, 900, count).astype(np.int32),
    )
