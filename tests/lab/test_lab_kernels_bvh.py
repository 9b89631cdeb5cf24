"""The bounding volume hierarchy against brute-force intersection, and its guarantees."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.lab.world import bvh_kernels as bvh


def brute_force_cast(triangles, origins, directions):
    """Möller and Trumbore (1997); returns distance (N,), inf without a hit, and face (N,)."""
    a, b, c = triangles.reshape(-1, 3, 3).transpose(1, 0, 2)
    e1, e2 = b - a, c - a
    d = directions[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        p = np.cross(d, e2)
        inverse = 1 / (p * e1).sum(-1)
        s = np.broadcast_to(origins, directions.shape)[:, None] - a
        u = (s * p).sum(-1) * inverse
        q = np.cross(s, e1)
        v = (d * q).sum(-1) * inverse
        t = (e2 * q).sum(-1) * inverse
        t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
    return t.min(1), t.argmin(1)


def soup(count, seed=0):
    rng = np.random.default_rng([seed, 10])
    middle = rng.uniform(-3, 3, (count, 1, 3))
    return (middle + rng.normal(0, 0.5, (count, 3, 3))).reshape(count, 9)


def unit(a):
    return a / np.linalg.norm(a, axis=-1, keepdims=True)


def cast(triangles, origins, directions, limit=np.inf):
    box, first, count, order = bvh.build_tree(triangles)
    distance = np.full(len(directions), limit)
    face = np.full(len(directions), -1, np.int32)
    weights = np.zeros((len(directions), 2))
    origins = np.ascontiguousarray(np.atleast_2d(origins), float)
    bvh.cast_rays(
        box, first, count, np.ascontiguousarray(triangles[order]),
        origins, directions, distance, face, weights,
    )  # fmt: skip
    return distance, np.where(face >= 0, order[face], -1), weights


def test_hits_match_brute_force():
    triangles = soup(300)
    rng = np.random.default_rng([1, 11])
    directions = unit(rng.normal(size=(1500, 3)))
    origins = rng.uniform(-4, 4, (1500, 3))
    wanted, face = brute_force_cast(triangles, origins, directions)
    distance, got, weights = cast(triangles, origins, directions)
    hit = np.isfinite(wanted)
    assert 0.2 < hit.mean() < 0.99
    np.testing.assert_array_equal(np.isfinite(distance), hit)
    np.testing.assert_array_equal(got[hit], face[hit])
    np.testing.assert_allclose(distance[hit], wanted[hit], rtol=0, atol=1e-9)
    corners = triangles[got[hit]].reshape(-1, 3, 3)
    w = np.column_stack([1 - weights[hit].sum(1), weights[hit]])
    points = origins[hit] + distance[hit, None] * directions[hit]
    np.testing.assert_allclose((w[..., None] * corners).sum(1), points, atol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 5, 400])
def test_coincident_triangles_make_a_tree(count):
    triangles = np.tile([0.0, -1, -1, 0, 1, -1, 0, 0, 1], (count, 1))
    distance, face, _ = cast(triangles, [-2, 0, 0], np.array([[1.0, 0, 0], [-1.0, 0, 0]]))
    assert distance[0] == 2.0
    assert 0 <= face[0] < count
    assert np.isinf(distance[1])
    assert face[1] == -1


def test_no_ray_passes_between_adjacent_triangles():
    """Rays through the exact vertices and edge points of a closed hull, from inside."""
    rng = np.random.default_rng([4, 12])
    rows, columns = 12, 20
    eta = np.linspace(-np.pi / 2, np.pi / 2, rows + 1)[:, None]
    omega = np.arange(columns)[None] * 2 * np.pi / columns
    ball = np.stack(
        np.broadcast_arrays(np.cos(eta) * np.cos(omega), np.cos(eta) * np.sin(omega), np.sin(eta)),
        -1,
    )
    ball *= rng.uniform(0.7, 1.3, (rows + 1, columns, 1))
    ball[0], ball[-1] = ball[0, 0], ball[-1, 0]
    quads = [
        (ball[i, j], ball[i, (j + 1) % columns], ball[i + 1, (j + 1) % columns], ball[i + 1, j])
        for i in range(rows)
        for j in range(columns)
    ]
    triangles = np.array(
        [np.concatenate(t) for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    )
    corners = triangles.reshape(-1, 3, 3)
    along = rng.uniform(0, 1, (len(corners), 40, 1))
    on_edges = corners[:, :1] * along + corners[:, 1:2] * (1 - along)
    targets = np.concatenate([corners.reshape(-1, 3), on_edges.reshape(-1, 3)])
    for origin in ([0.0, 0.0, 0.0], [0.11, -0.07, 0.2]):
        distance, _, _ = cast(triangles, origin, unit(targets - np.array(origin)))
        assert np.isfinite(distance).all()


def test_distance_limit_is_respected():
    triangles = np.array([[5.0, -1, -1, 5, 1, -1, 5, 0, 1]])
    ray = np.array([[1.0, 0, 0]])
    assert cast(triangles, [0, 0, 0], ray, limit=6.0)[0][0] == 5.0
    distance, face, _ = cast(triangles, [0, 0, 0], ray, limit=4.0)
    assert distance[0] == 4.0
    assert face[0] == -1


def test_non_finite_rays_hit_nothing():
    triangles = soup(50)
    directions = np.array([[np.nan, 0, 1], [0, 0, 0], [np.inf, 0, 0]], float)
    distance, face, _ = cast(triangles, [0, 0, 0], directions)
    assert np.isinf(distance).all()
    assert (face == -1).all()
