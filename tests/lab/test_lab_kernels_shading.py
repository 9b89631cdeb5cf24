"""Procedural albedo against a NumPy reference, and its guarantees."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.lab.world import shading_kernels as kernels
from tofuse.lab.world.texture import Material, noise_tables, parameter_rows


def noise_twin(table, points):
    cell = np.floor(points)
    u = points - cell
    w = u * u * (3 - 2 * u)
    cell = cell.astype(int)
    permutation = table[0].astype(int)
    total = np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        c = cell + corner
        p = permutation[c[:, 0] % 256]
        p = permutation[(p + c[:, 1]) % 256]
        p = permutation[(p + c[:, 2]) % 256]
        share = np.where(np.array(corner) == 1, w, 1 - w).prod(1)
        total += share * table[1][p]
    return total


def fractal_twin(table, points):
    """Three octaves, each rotated and shifted."""
    turns = np.array([[2, 2, -1], [-1, 2, 2], [2, -1, 2]]) / 3
    second = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    third = np.array([[1, 0, 0], [0, 0.6, -0.8], [0, 0.8, 0.6]])
    p = points @ turns.T
    total = noise_twin(table, p)
    p = p @ second.T
    total += 0.7 * noise_twin(table, 2.13 * p + (31.7, 11.3, 47.1))
    p = p @ third.T
    return 1.3 * (total + 0.5 * noise_twin(table, 4.31 * p + (7.9, 53.9, 19.3)))


def test_noise_matches_twin():
    table = noise_tables(3)
    points = np.random.default_rng([0, 1]).uniform(-400, 400, (500, 3))
    got = [kernels.value_noise(*table, *p) for p in points]
    np.testing.assert_allclose(got, noise_twin(table, points), atol=1e-12)


def test_octaves_match_twin():
    table = noise_tables(4)
    points = np.random.default_rng([0, 3]).uniform(-50, 50, (300, 3))
    got = [kernels.fractal_noise(*table, *p) for p in points]
    np.testing.assert_allclose(got, fractal_twin(table, points), atol=1e-11)


def test_shading_matches_twin():
    rng = np.random.default_rng([0, 4])
    faces, rays = 20, 400
    materials = [
        Material("a", 0.5, 0.2, "noise", (0.3, 0.4, 0.5), gloss=0.1),
        Material("b", 0.7, 0.0, "plain", gloss=0.3),
    ]
    rows, table = parameter_rows(materials, 2), noise_tables(2)
    flat = rng.normal(size=(faces, 3))
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    corner = flat[:, None] + 0.4 * rng.normal(size=(faces, 3, 3))
    of_face = rng.integers(0, 2, faces).astype(np.int32)
    origins, directions = rng.normal(size=(2, rays, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    distance = rng.uniform(1, 4, rays)
    face = rng.integers(-1, faces, rays).astype(np.int32)
    weights = rng.dirichlet([1, 1, 1], rays)
    normal = np.zeros((rays, 3), np.float32)
    albedo, gloss = np.zeros((2, rays), np.float32)
    surface = np.full(rays, -1, np.int32)
    triangles = kernels.Triangles(corner.reshape(faces, 9), flat, of_face)
    others = np.ascontiguousarray(weights[:, 1:])
    kernels.shade_hits(
        triangles,
        kernels.Textures(rows, *table),
        kernels.Rays(origins, directions, distance, face, others),
        rotation,
        kernels.Shading(normal, albedo, gloss, surface),
    )
    hit = face >= 0
    assert (surface[~hit] == -1).all()
    assert not normal[~hit].any()
    f, d = face[hit], directions[hit]
    n = (weights[hit, :, None] * corner[f]).sum(1)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    sign = np.where((flat[f] * d).sum(1) > 0, -1.0, 1.0)
    away = sign * (n * d).sum(1) >= 0
    assert 0 < away.sum() < len(f) / 2
    n = np.where(away[:, None], flat[f], n) * sign[:, None]
    np.testing.assert_allclose(normal[hit], n @ rotation.T, atol=1e-6)
    s = of_face[f]
    np.testing.assert_array_equal(surface[hit], s)
    np.testing.assert_allclose(gloss[hit], np.array([0.1, 0.3])[s], rtol=1e-6)
    points = origins[hit] + distance[hit, None] * d
    pattern = fractal_twin(table, (points + rows[0, 7:10]) / rows[0, 2:5]).clip(-2.5, 2.5)
    wanted = np.where(s == 0, 0.5 * (1 + 0.2 * pattern), 0.7)
    np.testing.assert_allclose(albedo[hit], wanted, atol=1e-6)


def test_lattice_values_are_those_of_table_with_unit_variance():
    table = noise_tables(0)
    assert table[1].std() == pytest.approx(1.0, abs=0.01)
    value = kernels.value_noise(*table, 3.0, -7.0, 11.0)
    assert np.abs(table[1] - value).min() < 1e-12
