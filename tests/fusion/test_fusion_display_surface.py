"""The surface that is shown: shards are left out, small holes filled unless seen through."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames import RangeFrame
from tofuse.engine.fusion import display_surface
from tofuse.engine.fusion.display_surface import Witness, boundary_loops, triangulated
from tofuse.engine.fusion.mesh import Mesh
from tofuse.engine.fusion.texture import TextureView
from tofuse.engine.geometry import se3

CAMERA = Pinhole(160, 120, 140.0, 140.0, 79.5, 59.5)
STEP = 0.05
SIDE = 41


def wall(missing=lambda x, y: np.zeros_like(x, bool), height=lambda x, y: 0 * x) -> Mesh:
    """A wall at z = 2 m, which faces the origin, without the triangles of `missing` vertices."""
    x, y = np.meshgrid(*2 * [(np.arange(SIDE) - SIDE // 2) * STEP])
    points = np.stack([x, y, 2 - height(x, y)], -1).reshape(-1, 3)
    k = (np.arange(SIDE - 1) + SIDE * np.arange(SIDE - 1)[:, None]).ravel()
    faces = np.concatenate(
        [np.stack([k, k + SIDE, k + 1], 1), np.stack([k + 1, k + SIDE, k + SIDE + 1], 1)]
    )
    faces = faces[~missing(x, y).ravel()[faces].any(1)]
    return mesh_of(points, faces)


def mesh_of(points, faces) -> Mesh:
    corners = points[faces]
    normals = np.zeros_like(points)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for k in range(3):
        np.add.at(normals, faces[:, k], across)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    count = len(points)
    return Mesh(
        points.astype(np.float32),
        faces.astype(np.int32),
        normals.astype(np.float32),
        None,
        np.full(count, 0.002, np.float32),
        np.full(count, 6, np.int32),
    )


def witnesses(depth=lambda x, y: np.full_like(x, 2.0), count=6) -> list[Witness]:
    """Views from the left to the right; `depth` is z in the world at x and y of the wall."""
    out = []
    for left in np.linspace(-0.6, 0.6, count):
        T = se3.exp(np.array([left, 0, 0, 0, 0, 0]))
        x, y = np.moveaxis(2.0 * CAMERA.rays(), -1, 0)
        out.append(Witness(depth(x + left, y).astype(np.float32), CAMERA, T))
    return out


def in_window(x, y):
    return (np.abs(x) < 0.13) & (np.abs(y) < 0.13)


def area(mesh: Mesh, faces: np.ndarray) -> float:
    a, b, c = (mesh.vertices[faces[:, k]].astype(float) for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def test_shard_that_views_look_through_is_left_out():
    base = wall()
    x = 0.3 + STEP * np.arange(8)
    # A ridge from the wall towards the camera, at an edge of depth, seen by a single view.
    ridge = np.stack([np.stack([x, np.full(8, y), np.full(8, 1.7)], -1) for y in (0.0, 0.05)])
    rows = len(base) + np.arange(16).reshape(2, 8)
    strip = np.concatenate(
        [
            np.stack([rows[0, :-1], rows[1, :-1], rows[0, 1:]], 1),
            np.stack([rows[0, 1:], rows[1, :-1], rows[1, 1:]], 1),
        ]
    )
    mesh = mesh_of(
        np.concatenate([base.vertices.astype(float), ridge.reshape(-1, 3)]),
        np.concatenate([base.faces, strip]),
    )
    mesh.views[len(base) :] = 1
    shown, filled = display_surface.displayed(mesh, witnesses())
    assert filled == 0
    assert np.allclose(shown.vertices[:, 2], 2.0)
    assert len(shown.faces) == len(base.faces)


def test_surface_that_few_of_its_views_support_is_left_out():
    mesh = wall()
    weak = mesh.vertices[:, 0] > 0.6
    mesh.views[weak] = 1
    assert 0.55 < display_surface.without_shards(mesh, witnesses()).vertices[:, 0].max() < 0.7
    mesh.views[weak] = 3
    assert len(display_surface.without_shards(mesh, witnesses()).faces) == len(mesh.faces)


def unknown_in_window(x, y):
    return np.where(in_window(x, y), 0.0, 2.0)


def test_hole_of_unknown_depth_is_filled_last():
    mesh = wall(in_window)
    shown, filled = display_surface.displayed(mesh, witnesses(unknown_in_window))
    assert filled > 0
    used = mesh.rows(np.ones(len(mesh.faces), bool))
    np.testing.assert_array_equal(shown.faces[:-filled], used.faces)
    whole = wall()
    assert area(shown, shown.faces) == pytest.approx(area(whole, whole.faces), rel=1e-5)
    added = shown.vertices[shown.faces[-filled:]]
    a, b, c = (added[:, k] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] < 0).all()  # they face the camera, as the wall does


@pytest.mark.parametrize(
    ("what", "mesh", "depth"),
    [
        ("window", wall(in_window), lambda x, y: np.where(in_window(x, y), 4.0, 2.0)),
        ("edge of the wall", wall(), lambda x, y: np.full_like(x, 2.0)),
        (
            "corner of a box",
            wall(in_window, lambda x, y: 0.5 * np.maximum(0, 0.3 - np.hypot(x, y))),
            lambda x, y: np.where(in_window(x, y), 0.0, 2.0),
        ),
        (
            "frame as thin as the hole is wide",
            wall(lambda x, y: in_window(x, y) | (np.maximum(np.abs(x), np.abs(y)) > 0.17)),
            unknown_in_window,
        ),
    ],
)
def test_other_gaps_stay_open(what, mesh, depth):
    shown, filled = display_surface.with_filled_holes(mesh, witnesses(depth))
    assert filled == 0, what
    np.testing.assert_array_equal(shown.faces, mesh.faces)


def test_touching_rims_are_separate_loops():
    faces = wall(
        lambda x, y: np.isclose(np.abs(x - y), 0) & np.isin(np.rint(x / STEP), (0, 1))
    ).faces
    assert sorted(len(loop) for loop in boundary_loops(faces))[-1] == 4 * (SIDE - 1)
    for loop in boundary_loops(faces):
        assert len(set(loop.tolist())) == len(loop)


@pytest.mark.parametrize("seed", range(5))
def test_triangles_cover_polygon(seed):
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0, 2 * np.pi, 24))
    polygon = np.stack([np.cos(angle), np.sin(angle)], -1) * rng.uniform(0.3, 1, (24, 1))
    triangles = triangulated(polygon)
    x, y = polygon.T
    shoelace = 0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum()
    a, b, c = (polygon[triangles[:, k]] for k in range(3))
    areas = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert len(triangles) == 22
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(shoelace)
    assert triangulated(polygon[::-1]) is None


def test_polygon_that_crosses_itself_has_no_triangles():
    assert triangulated(np.array([[0.0, 0], [1, 1], [1, 0], [0, 1.2]])) is None


def test_depth_of_large_images_is_reduced_where_they_see_it() -> None:
    """A step at column 500 of 1000 is at the same place, for what is seen and what is painted."""
    camera = Pinhole(1000, 200, 800.0, 800.0, 499.5, 99.5)
    z = np.where(np.arange(1000) < 500, 1.0, 3.0)[None].repeat(200, 0).astype(np.float32)
    color = np.full((200, 1000, 3), 100, np.uint8)
    frame = RangeFrame(0, 0.0, camera, z, color_image=color, color_registered=True)
    beside = np.array([[-0.006, 0.0, 1.0], [0.018, 0.0, 3.0], [0.018, 0.0, 1.0]])
    inside, behind = Witness.of(frame, np.eye(4)).looks(beside)
    assert inside.all()
    assert np.abs(behind[:2]).max() < 1e-3 < 1 < behind[2]
    view = TextureView.of(frame)
    assert view is not None
    assert view.z.shape == view.known.shape == view.projection.rays.shape[:2] == (50, 250)
    assert view.image.shape == color.shape
    assert (view.z[0, :125] == 1).all()
    assert (view.z[0, 125:] == 3).all()
    assert abs(view.projection.rays[0, 124:126, 0].mean()) < 1e-6
