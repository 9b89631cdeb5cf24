"""Images of surfaces: what is nearer hides what is farther, and colours are interpolated."""

from __future__ import annotations

import numpy as np

from tofuse.engine.fusion import GeometryRecord, Mesh
from tofuse.engine.fusion.drawing import drawn

SIZE = (40, 150)  # more rows than are coloured at once


def two_squares() -> tuple[Mesh, np.ndarray, np.ndarray]:
    """A red square of the whole image at 2 m, and a smaller one from black to blue at 1 m."""
    width, height = SIZE
    far = [(-1, -1), (width, -1), (width, height), (-1, height)]
    near = [(9.5, 49.5), (29.5, 49.5), (29.5, 89.5), (9.5, 89.5)]
    pixels = np.array([*far, *near], float)
    depths = np.repeat([2.0, 1.0], 4)
    red, black, blue = (200, 0, 0), (0, 0, 0), (0, 0, 200)
    color = np.array([red] * 4 + [black, blue, blue, black], np.uint8)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    points = np.column_stack([pixels, depths]).astype(np.float32)
    return Mesh.of(GeometryRecord(points, faces=faces, color=color)), pixels, depths


def test_nearer_triangles_hide_farther_ones() -> None:
    mesh, pixels, depths = two_squares()
    image, distance = drawn(mesh, pixels, depths, np.ones(4, bool), SIZE)
    assert image.shape == (150, 40, 3)
    np.testing.assert_allclose(distance[50:89, 10:29], 1.0)
    np.testing.assert_allclose(distance[100:], 2.0)
    np.testing.assert_allclose(image[100:], np.broadcast_to([200, 0, 0], (50, 40, 3)), atol=0.01)
    blue = image[70, 10:29, 2]
    np.testing.assert_allclose(blue, 200 * (np.arange(10, 29) - 9.5) / 20, atol=0.5)


def test_triangles_that_are_not_shown_leave_holes() -> None:
    mesh, pixels, depths = two_squares()
    image, distance = drawn(mesh, pixels, depths, np.array([0, 0, 1, 1], bool), SIZE)
    assert (distance > 0).sum() == 20 * 40
    assert not image[distance == 0].any()


def test_texture_replaces_the_colours_of_vertices() -> None:
    mesh, pixels, depths = two_squares()
    picture = np.zeros((8, 8, 3), np.uint8)
    picture[:, 4:] = (0, 250, 0)
    texels = np.zeros((8, 2), np.float32)
    texels[4:] = [(0, 0), (7, 0), (7, 7), (0, 7)]
    shown = np.array([0, 0, 1, 1], bool)
    image, _ = drawn(mesh, pixels, depths, shown, SIZE, (texels, picture))
    assert not image[60, 10:18].any()
    np.testing.assert_allclose(image[60, 23:29], np.broadcast_to([0, 250, 0], (6, 3)), atol=0.1)
