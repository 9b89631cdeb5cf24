"""Parts as drawn, and points on them as a scan measures them."""

from __future__ import annotations

import numpy as np

from tofuse.apps.compare.nearest import Reference
from tofuse.apps.compare.surface import Surface
from tofuse.engine.arrays import Float64
from tofuse.lab.world import mesh as meshes

NOISE = 0.0003


def drawn(*blocks: meshes.Mesh) -> Surface:
    """A plate with two blocks on it, or other blocks."""
    mesh = meshes.joined(
        blocks
        or [
            meshes.box([0.2, 0.14, 0.05]),
            meshes.box([0.05, 0.08, 0.06], [0.04, 0.02, 0.055]),
            meshes.box([0.03, 0.03, 0.05], [-0.07, -0.04, 0.05]),
        ]
    )
    vertices = np.asarray(mesh.vertices, float)
    return Surface("part", vertices, np.zeros_like(vertices), np.asarray(mesh.faces, np.int32))


def scan(
    reference: Reference,
    seed: int = 0,
    count: int = 15_000,
    shared: float | None = 0.0001,
    bump=0.0,
) -> Surface:
    """Points seen from above, with noise; a bump in the middle of the plate has a height, m."""
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(reference.area), count, p=reference.area / reference.area.sum())
    weights = rng.dirichlet([1, 1, 1], count)[:, :, None]
    p: Float64 = (weights * reference.triangles[chosen]).sum(1)
    n = reference.normals[chosen]
    hidden = (np.abs(p - [0.04, 0.02, 0.025]) < [0.0249, 0.0399, 1e-4]).all(1)
    hidden |= (np.abs(p - [-0.07, -0.04, 0.025]) < [0.0149, 0.0149, 1e-4]).all(1)
    kept = (n[:, 2] > -0.5) & ~hidden
    p, n = p[kept], n[kept]
    d = bump * np.exp(-((p - [-0.03, 0.03, 0.025]) ** 2).sum(1) / 0.02**2)
    d += rng.normal(0, NOISE, len(p))
    return Surface("scan", p + d[:, None] * n, n, None, True, np.full(len(p), NOISE), shared)
