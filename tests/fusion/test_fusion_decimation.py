"""Decimation by edge collapse: shape, orientation, attributes, and unusual meshes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.engine.errors import InputError
from tofuse.engine.fusion.mesh import Mesh, collapse_edges
from tofuse.engine.fusion.model import at_most
from tofuse.engine.geometry.kdtree import KdTree
from tofuse.lab.experiments.surface_error import Surface, distances


def hills(count: int = 120, seed: int = 0) -> Mesh:
    """A noisy, hilly surface of 2 m, with smooth colours, seen from above."""
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(np.linspace(-1, 1, count), np.linspace(-1, 1, count))
    z = 0.1 * np.sin(4 * u) * np.cos(5 * v) + 0.3 * np.abs(u)
    points = np.stack([u, v, z + rng.normal(0, 5e-4, z.shape)], -1).reshape(-1, 3)
    k = (np.arange(count - 1) + count * np.arange(count - 1)[:, None]).ravel()
    faces = np.concatenate(
        [np.stack([k, k + 1, k + count], 1), np.stack([k + 1, k + count + 1, k + count], 1)]
    )
    slope = np.stack(np.gradient(z, 2 / (count - 1)), -1).reshape(-1, 2)
    normals = np.concatenate([-slope[:, ::-1], np.ones((len(points), 1))], 1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh(
        points.astype(np.float32),
        faces.astype(np.int32),
        normals.astype(np.float32),
        np.round(128 + 100 * np.sin(2 * points)).astype(np.uint8),
        rng.uniform(0.001, 0.01, len(points)).astype(np.float32),
        rng.integers(1, 40, len(points)).astype(np.int32),
    )


def together(*meshes: Mesh) -> Mesh:
    first = np.cumsum([0, *(len(each) for each in meshes)])
    return Mesh(
        np.concatenate([each.vertices for each in meshes]),
        np.concatenate([each.faces + k for each, k in zip(meshes, first, strict=False)]),
        np.concatenate([each.normals for each in meshes]),
        np.concatenate([each.color for each in meshes]),
        np.concatenate([each.sigma for each in meshes]),
        np.concatenate([each.views for each in meshes]),
    )


def across(mesh: Mesh) -> np.ndarray:
    """Twice the area of each triangle, along its normal."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces].astype(float), 1, 0)
    return np.cross(b - a, c - a)


def off(whole: Mesh, small: Mesh) -> float:
    """Mean distance of either surface from the other, m."""
    one, other = (Surface(m.vertices.astype(float), m.faces) for m in (whole, small))
    there = distances(one.samples(40_000)[0], other, 100_000)
    return float(there.mean() + distances(other.samples(40_000)[0], one, 100_000).mean()) / 2


def turned_away(whole: Mesh, small: Mesh) -> float:
    """Share of the area that faces away from the nearest normal of the whole surface."""
    normals = across(small)
    middles = small.vertices[small.faces].mean(1)
    nearest, _ = KdTree(whole.vertices).neighbours(middles, 1)
    area = np.linalg.norm(normals, axis=1)
    away = np.einsum("ni,ni->n", normals, whole.normals[nearest[:, 0]]) < 0
    return float(area[away].sum() / area.sum())


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_edge_collapse_is_more_accurate_than_clustering(scale: float) -> None:
    whole = hills()
    whole = replace(whole, vertices=(scale * whole.vertices).astype(np.float32))
    by_edges, by_cells = whole.decimated(1500), whole.clustered(1500)
    assert 1400 < len(by_edges.faces) <= 1500
    assert off(whole, by_edges) < 0.7 * off(whole, by_cells)
    assert turned_away(whole, by_edges) < 0.001
    assert np.linalg.norm(across(by_edges), axis=1).min() > 0


def test_attributes_are_means_of_merged_vertices() -> None:
    whole = hills()
    small = whole.decimated(1500)
    nearest = KdTree(whole.vertices).neighbours(small.vertices, 1)[0][:, 0]
    np.testing.assert_allclose(np.linalg.norm(small.normals, axis=1), 1, atol=1e-5)
    # Off ridges, whose normals on both sides are averaged.
    smooth = np.abs(small.vertices[:, 0]) > 0.2
    cosine = np.einsum("ni,ni->n", small.normals, whole.normals[nearest])
    assert cosine[smooth].min() > 0.85
    assert np.abs(small.color.astype(int) - whole.color[nearest]).mean() < 4
    for name in ("color", "sigma", "views"):
        given, kept = getattr(whole, name), getattr(small, name)
        assert (kept.min(0) >= given.min(0)).all()
        assert (kept.max(0) <= given.max(0)).all()
    # Vertices without colour do not darken their neighbours.
    half = np.where(whole.vertices[:, :1] > 0, 0, [200, 100, 50]).astype(np.uint8)
    colors = np.unique(replace(whole, color=half).decimated(1500).color, axis=0)
    np.testing.assert_array_equal(colors, [[0, 0, 0], [200, 100, 50]])
    assert replace(whole, color=None).decimated(1500).color is None


def test_groups_match_library_triangles() -> None:
    """The library's triangles connect the same groups."""
    from fast_simplification import simplify

    whole = hills(60)
    group, places = collapse_edges(whole.vertices, whole.faces, 2000, whole.spacing)
    assert len(places) == group.max() + 1
    middle = whole.vertices.mean(0, dtype=float)
    unit = 200 * whole.spacing
    moved, left = simplify((whole.vertices - middle) / unit, whole.faces, target_count=2000, agg=3)
    a, b, c = group[whole.faces].T
    found = group[whole.faces][(a != b) & (b != c) & (c != a)]
    np.testing.assert_allclose(places[found], moved[left] * unit + middle, atol=1e-9)


def test_small_and_empty_meshes_are_unchanged() -> None:
    whole = hills(20)
    assert whole.decimated(len(whole.faces)) is whole
    empty = whole.rows(np.zeros(len(whole.faces), bool))
    assert empty.decimated(10) is empty


def test_meshes_of_several_pieces_are_decimated() -> None:
    """Each is reduced; the limit also holds for single triangles, which can't be collapsed."""
    left, right = hills(40), hills(40, seed=1)
    right = replace(right, vertices=(right.vertices + np.array([3, 0, 0])).astype(np.float32))
    small = together(left, right).decimated(600)
    assert 550 < len(small.faces) <= 600
    beyond = small.vertices[:, 0] > 1.5
    assert len(set(map(tuple, beyond[small.faces].tolist()))) == 2  # no triangle between them
    rng = np.random.default_rng(5)
    n = 900
    scraps = Mesh(
        (rng.uniform(-1, 1, (n // 3, 1, 3)) + 0.01 * rng.normal(size=(n // 3, 3, 3)))
        .reshape(-1, 3).astype(np.float32),
        np.arange(n, dtype=np.int32).reshape(-1, 3),
        np.tile(np.float32([0, 0, 1]), (n, 1)),
        None, np.ones(n, np.float32), np.ones(n, np.int32),
    )  # fmt: skip
    assert len(scraps.decimated(100).faces) <= 100


@pytest.mark.parametrize("seed", range(6))
def test_irregular_meshes_are_decimated(seed: int) -> None:
    """Soups with non-manifold edges, duplicates, coincident and infinite vertices."""
    rng = np.random.default_rng(seed)
    n = 200
    points = rng.normal(size=(n, 3))
    if seed % 3 == 0:
        points = np.round(points, 1)
    if seed % 3 == 1:
        points[:, 2] = 0
    faces = rng.integers(0, n, (600, 3))
    faces = np.concatenate([faces, faces[::3], faces[::4, ::-1]])
    points[:3] = [[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf]]
    soup = Mesh(
        points.astype(np.float32), faces.astype(np.int32),
        np.tile(np.float32([0, 0, 1]), (n, 1)), None,
        np.ones(n, np.float32), np.ones(n, np.int32),
    )  # fmt: skip
    for count in (1, 40, 500):
        try:
            small = soup.decimated(count)
        except InputError:
            assert count < 100
            continue
        assert len(small.faces) <= count
        assert np.isfinite(small.vertices).all()
        assert (np.linalg.norm(across(small), axis=1) > 0).all()
        assert len(np.unique(small.faces)) == len(small)


def test_too_few_triangles_for_a_surface_are_refused() -> None:
    """Of many pieces round the origin, which cells of any size there keep apart."""
    offsets = np.array([[x, y, z] for x in (-3, 3) for y in (-3, 3) for z in (-3, 3)])
    piece = hills(12)
    pieces = [replace(piece, vertices=(piece.vertices + d).astype(np.float32)) for d in offsets]
    with pytest.raises(InputError, match="3 are too few for the surface: none is left"):
        together(*pieces).decimated(3)
    # A run, which has made the surface by then, keeps the fewest that leave some.
    assert 3 < len(at_most(together(*pieces), 3).faces) < 100
    assert len(at_most(together(*pieces), 0).faces) == 8 * len(piece.faces)
