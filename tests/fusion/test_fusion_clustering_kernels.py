"""Groups of vertices and sums over their triangles, against slow references."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from tofuse.engine.fusion.clustering_kernels import (
    flatten_groups,
    number_keys,
    quadric_sums,
    union_faces,
)


def test_keys_are_numbered_in_order_of_appearance() -> None:
    rng = np.random.default_rng(0)
    for keys in (rng.integers(0, 3000, 9000), rng.integers(0, 1 << 62, 3000), np.zeros(0, int)):
        number = np.full(len(keys), -1)
        first = number_keys(keys, number)
        known: dict[int, int] = {}
        wanted = [known.setdefault(key, len(known)) for key in keys.tolist()]
        np.testing.assert_array_equal(number, wanted)
        assert keys[first].tolist() == list(known)
        np.testing.assert_array_equal(number[first], np.arange(len(known)))


def test_plane_sums_match_slow_sums() -> None:
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(30, 3)).astype(np.float32)
    faces = rng.integers(0, 30, (50, 3)).astype(np.int32)
    faces[0] = 4  # a point, without a plane
    group = rng.integers(0, 6, 30)
    middles = rng.normal(size=(6, 3))
    A, b = np.zeros((7, 3, 3)), np.zeros((7, 3))
    quadric_sums(vertices, faces, group, middles, A, b)
    wanted_A, wanted_b = np.zeros((7, 3, 3)), np.zeros((7, 3))
    for face in faces:
        corners = vertices[face].astype(float)
        across = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        area = np.linalg.norm(across)
        n = across / max(area, 1e-12)
        for corner, vertex in zip(corners, face, strict=True):
            g = group[vertex]
            wanted_A[g] += area * np.triu(np.outer(n, n))
            wanted_b[g] += area * n * (n @ (corner - middles[g]))
    np.testing.assert_allclose(A, wanted_A, atol=1e-12)
    np.testing.assert_allclose(b, wanted_b, atol=1e-12)
    assert not A[6].any(), "no vertex is in the last group"


def test_connected_pieces_match_scipy() -> None:
    rng = np.random.default_rng(3)
    for count, faces in ((40, 9), (500, 150), (500, 400), (5, 0)):
        rows = rng.integers(0, count, (faces, 3)).astype(np.int32)
        piece = np.arange(count, dtype=np.int32)
        for part in (rows[::2], rows[1::2]):
            union_faces(part, piece)
        flatten_groups(piece)
        ends = np.concatenate([rows[:, :2], rows[:, 1:]])
        links = coo_matrix((np.ones(len(ends)), ends.T), shape=(count, count))
        _, wanted = connected_components(links, directed=False)
        _, first = np.unique(wanted, return_index=True)
        np.testing.assert_array_equal(piece, first[wanted])
