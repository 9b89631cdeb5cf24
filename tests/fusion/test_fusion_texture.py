"""Textures: layout, content, files; and the preparation of meshes."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from parsed_glb import parse
from ray_casting import rays_at
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.fusion import atlas as atlas_module
from tofuse.engine.fusion import texture as texture_module
from tofuse.engine.fusion.atlas import MARGIN, unwrap
from tofuse.engine.fusion.atlas_kernels import NO_TRIANGLE, draw_triangles
from tofuse.engine.fusion.cloud import NO_COLOR
from tofuse.engine.fusion.mesh import Mesh
from tofuse.engine.fusion.texture import TextureView, baked, textured
from tofuse.engine.geometry import se3
from tofuse.formats.geometry.glb import linear
from tofuse.formats.geometry.ply import read_ply

CAMERA = Pinhole(80, 60, 70.0, 70.0, 39.5, 29.5)


def sheet(columns: int, rows: int, step: float, z: float = 2.0) -> Mesh:
    """A wall across the first camera's view, facing it, centred on its axis."""
    x, y = np.meshgrid(np.arange(columns) * step, np.arange(rows) * step)
    p = np.stack([x - x.mean(), y - y.mean(), np.full_like(x, z)], -1).reshape(-1, 3)
    k = (np.arange(columns - 1) + columns * np.arange(rows - 1)[:, None]).ravel()
    lower = np.stack([k, k + columns, k + 1], 1)
    upper = np.stack([k + 1, k + columns, k + columns + 1], 1)
    return mesh_of(p, np.concatenate([lower, upper]), np.tile([0, 0, -1.0], (len(p), 1)))


def mesh_of(points, faces, normals) -> Mesh:
    count = len(points)
    return Mesh(
        np.asarray(points, np.float32),
        np.asarray(faces, np.int32),
        np.asarray(normals, np.float32),
        np.full((count, 3), 9, np.uint8),
        np.full(count, 0.001, np.float32),
        np.full(count, 5, np.int32),
    )


def pattern(points: np.ndarray) -> np.ndarray:
    """Colours (N, 3), smooth over the wall."""
    x, y = points[..., 0], points[..., 1]
    waves = [np.sin(9 * x), np.cos(7 * y), np.sin(5 * x + 6 * y)]
    return 120 + 40 * np.stack(waves, -1)


def look(T: np.ndarray, gain: float, *, hidden: float | None = None, lamp: bool = False):
    """An image of the wall at z = 2 m; occluded 0.5 m nearer where its x exceeds `hidden`."""
    origin, away = rays_at(T, CAMERA)
    z = (2.0 - origin[2]) / away[..., 2]
    at = away * z[..., None] + origin
    light = pattern(at) * gain
    if hidden is not None:
        front = at[..., 0] > hidden
        z, light = np.where(front, z - 0.5, z), np.where(front[..., None], 255, light)
    if not lamp:
        color = np.round(light).clip(1, 255).astype(np.uint8)
        return RangeFrame(0, 0.0, CAMERA, z.astype(np.float32), color_image=color)
    square = (away**2).sum(-1) * z * z
    amplitude = (light[..., 0] / square).astype(np.float32)
    return RangeFrame(0, 0.0, CAMERA, z.astype(np.float32), amplitude_image=amplitude)


POSES = np.stack(
    [np.eye(4), se3.exp([0.2, 0, 0, 0, -0.1, 0]), se3.exp([-0.25, 0.1, 0.3, 0.05, 0.1, 0])]
)


def test_triangles_are_rasterized_in_place() -> None:
    corners = np.random.default_rng(0).uniform(-3, 33, (12, 3, 2)).astype(np.float32)
    owner = np.full((30, 30), NO_TRIANGLE, np.int32)
    places = np.zeros((30, 30, 2), np.float32)
    draw_triangles(corners, 1.4, owner, places)
    for v in range(30):
        for u in range(30):
            inside, near = [], []
            for m, (a, b, c) in enumerate(corners.astype(float)):
                s, t = np.linalg.solve(np.stack([b - a, c - a], 1), [u - a[0], v - a[1]])
                edges = [(b, c, 1 - s - t), (c, a, s), (a, b, t)]
                area = abs(np.linalg.det(np.stack([b - a, c - a])))
                out = max(-w * area / np.linalg.norm(q - p) for p, q, w in edges)
                low, high = corners[m].min(0) - 1, corners[m].max(0) + 1
                boxed = (low <= [u, v]).all() and ([u, v] <= high).all()
                near += [m] if boxed and out <= 1.4 - 1e-4 else []
                inside += [m] if out < -1e-4 else []
                if owner[v, u] == m:
                    np.testing.assert_allclose(places[v, u], [s, t], atol=1e-3)
                    assert out <= 1.4 + 1e-4
            if inside:
                assert owner[v, u] >= max(inside)
            elif near:
                assert owner[v, u] != NO_TRIANGLE


@pytest.mark.parametrize("plain", [False, True])
def test_atlas_holds_every_triangle_once(plain: bool, monkeypatch) -> None:
    mesh = sheet(9, 7, 0.1)
    if plain:
        monkeypatch.setitem(sys.modules, "xatlas", None)
    else:
        pytest.importorskip("xatlas")
    atlas = unwrap(mesh, 256)
    np.testing.assert_array_equal(
        np.sort(np.sort(atlas.vertices[atlas.faces], 1), 0), np.sort(np.sort(mesh.faces, 1), 0)
    )
    # With the same winding, so that the outside stays outside.
    np.testing.assert_array_equal(
        {tuple(np.roll(f, -np.argmin(f))) for f in atlas.vertices[atlas.faces].tolist()},
        {tuple(np.roll(f, -np.argmin(f))) for f in mesh.faces.tolist()},
    )
    corners = atlas.texels[atlas.faces]
    assert atlas.size <= 300
    assert corners.min() >= 0
    assert corners.max() <= atlas.size - 1
    # No texel within one triangle is taken by another.
    owner = np.full((atlas.size, atlas.size), NO_TRIANGLE, np.int32)
    places = np.zeros((atlas.size, atlas.size, 2), np.float32)
    for order in (slice(None), slice(None, None, -1)):
        owner[:] = NO_TRIANGLE
        draw_triangles(np.ascontiguousarray(corners[order]), 0.0, owner, places)
        number = np.arange(len(corners))[order]
        found = np.where(owner == NO_TRIANGLE, -1, number[owner])
        if order == slice(None):
            first = found
    shared = (places.min(-1) > 1e-3) & (places.sum(-1) < 1 - 1e-3)
    np.testing.assert_array_equal(found[shared], first[shared])
    across = np.linalg.det(corners[:, 1:].astype(float) - corners[:, :1])
    assert np.abs(across).min() > 20  # texels
    if plain:
        assert atlas_module.plain_atlas(mesh, 64).size < atlas.size


def test_texture_has_uniform_exposure() -> None:
    mesh = sheet(25, 17, 0.05)
    gains = np.array([1.0, 1.3, 0.8])
    views = [TextureView.of(look(T, g)) for T, g in zip(POSES, gains, strict=True)]
    made = textured(mesh, views, POSES, 256)
    expected = np.exp(np.log(gains).mean()) / gains
    np.testing.assert_allclose(made.gains, np.tile(expected[:, None], 3), rtol=0.01)
    assert made.coverage > 0.8  # the rest is partly beyond the images
    atlas = made.atlas
    owner = np.full((atlas.size, atlas.size), NO_TRIANGLE, np.int32)
    places = np.zeros((atlas.size, atlas.size, 2), np.float32)
    draw_triangles(atlas.texels[atlas.faces], MARGIN, owner, places)
    inside = (owner != NO_TRIANGLE) & (places.min(-1) >= 0) & (places.sum(-1) <= 1)
    p = mesh.vertices[atlas.vertices[atlas.faces[owner[inside]]]]
    b, c = places[inside].T[:, :, None]
    at = p[:, 0] * (1 - b - c) + p[:, 1] * b + p[:, 2] * c
    truth = pattern(at) * np.exp(np.log(gains).mean())
    error = np.abs(made.image[inside] - truth)
    assert error.mean() < 1.0
    assert np.quantile(error, 0.99) < 4.0
    # With the original exposures, the best view alone would be off by 20 % and more.
    assert np.abs(pattern(at) * 1.3 - truth).mean() > 20


def test_bands_leave_no_trace(monkeypatch) -> None:
    mesh, views = sheet(30, 22, 0.05), [TextureView.of(look(T, 1.0)) for T in POSES]
    monkeypatch.setattr(texture_module, "_BAND", 1024)
    at_once = textured(mesh, views, POSES, 1024)
    monkeypatch.setattr(texture_module, "_BAND", 7)
    in_bands = textured(mesh, views, POSES, 1024)
    assert at_once.image.shape[0] > 7 * 10
    assert np.ptp(at_once.image) > 60  # it shows the pattern
    np.testing.assert_array_equal(in_bands.image, at_once.image)


def test_amplitude_becomes_albedo_and_grey() -> None:
    mesh = sheet(25, 17, 0.05)
    views = [TextureView.of(look(T, g, lamp=True)) for T, g in zip(POSES, (1, 2, 1), strict=True)]
    made = textured(mesh, views, POSES, 128)
    assert (np.ptp(made.image.astype(int), axis=-1) == 0).all()
    assert np.ptp(made.image) > 200


def test_occluded_surface_is_not_painted_by_occluder() -> None:
    mesh = sheet(25, 17, 0.05)
    view = TextureView.of(look(np.eye(4), 1.0, hidden=0.2))
    made = textured(mesh, [view], POSES[:1], 256)
    corners = made.atlas.texels[made.atlas.faces].mean(1).round().astype(int)
    x = mesh.vertices[made.atlas.vertices[made.atlas.faces]].mean(1)[:, 0]
    shown = made.image[corners[:, 1], corners[:, 0]]
    assert (shown[x > 0.3] == 9).all()  # the vertices' own colour
    assert (shown[x < 0.05] > 60).all()
    assert (shown != 255).any(1).all()
    # From behind, the surface is not seen.
    turned = mesh_of(mesh.vertices, mesh.faces[:, ::-1], -mesh.normals)
    assert textured(turned, [view], POSES[:1], 256).coverage == 0


def test_missing_colour_does_not_darken(tmp_path) -> None:
    wall = sheet(40, 40, 0.05)
    dark = wall.vertices[:, 0] > 0
    wall = replace(wall, color=np.where(dark[:, None], 0, [180, 180, 180]).astype(np.uint8))
    small = wall.decimated(400)
    assert set(np.unique(small.color).tolist()) == {0, 180}
    assert set(np.unique(baked(wall, 400, 256).image).tolist()) == {NO_COLOR[0], 180}
    small.save(tmp_path / "shown.glb")
    document, arrays = parse(tmp_path / "shown.glb")
    colors = arrays[document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    light = linear(np.full((1, 3), [NO_COLOR[0], 180, 0], np.uint8))[0, :2]
    assert set(np.unique(colors[:, :3]).tolist()) == set(light.tolist())
    small.save(tmp_path / "data.ply")
    assert set(np.unique(read_ply(tmp_path / "data.ply").color).tolist()) == {0, 180}


def test_decimation_keeps_edges_sharp_and_sides_separate() -> None:
    front, top = sheet(41, 41, 0.01), sheet(41, 41, 0.01)
    # A ledge: a wall, and from its upper edge a plane away from the camera; not aligned with cells.
    upper = top.vertices[:, [0, 2, 1]] * [1, 0, 1] + [0, -0.2, 2.2]
    ledge = mesh_of(
        np.concatenate([front.vertices, upper]) + 0.0037,
        np.concatenate([front.faces, top.faces + len(front)]),
        np.concatenate([front.normals, np.tile([0, -1.0, 0], (len(top), 1))]),
    )
    small = ledge.decimated(700)
    assert 200 < len(small.faces) <= 700
    p = small.vertices.astype(float) - 0.0037
    assert np.minimum(np.abs(p[:, 2] - 2.0), np.abs(p[:, 1] + 0.2)).max() < 0.002
    assert ledge.decimated(10**6) is ledge
    # A board 1 cm thick, seen from both sides: cells of 5 cm do not merge its sides.
    back = sheet(41, 41, 0.01, 2.01)
    board = mesh_of(
        np.concatenate([front.vertices, back.vertices]),
        np.concatenate([front.faces, back.faces[:, ::-1] + len(front)]),
        np.concatenate([front.normals, -back.normals]),
    )
    thin = board.clustered(len(board.faces) // 40)
    z = thin.vertices[:, 2].astype(float)
    assert np.abs(np.minimum(np.abs(z - 2.0), np.abs(z - 2.01))).max() < 1e-3
    np.testing.assert_array_equal(z > 2.005, thin.normals[:, 2] > 0)
