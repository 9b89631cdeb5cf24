"""Large surfaces as 3D Tiles: requirements of the specification, levels, cracks, the folder."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from parsed_glb import parse
from report_results import make_room
from tofuse.errors import InputError, OutputError
from tofuse.files.geometry_record import GeometryRecord
from tofuse.files.glb import read_glb, write_glb
from tofuse.files.ply import read_ply
from tofuse.files.tileset import R_TILES_GLTF, Tile, read_tileset, write_tileset
from tofuse.fusion import levels as detail
from tofuse.fusion.levels import levels
from tofuse.fusion.upright import upright
from tofuse.geometry import se3
from tofuse.results import tiles
from tofuse.results.folder import OutputFolder
from tofuse.results.output import write_result
from tofuse.results.tiles import TilingSummary, is_tiles, write_tiles
from tofuse.results.types import Component
from wavy_surface import N, waves

R = se3.so3_exp([0.3, -0.7, 2.8])


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> SimpleNamespace:
    """Waves in tiles of 32 cells instead of 128."""
    folder = tmp_path_factory.mktemp("tiled") / "tiles"
    mesh = waves()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(detail, "_TRIANGLES_PER_EDGE", 32)
        tiled = write_tiles(mesh, R, folder)
    root, extras = read_tileset(folder / "tileset.json")
    return SimpleNamespace(folder=folder, mesh=mesh, tiled=tiled, root=root, extras=extras)


def checked(tile: dict, parent: dict | None, folder: Path) -> int:
    """Check the requirements of 3D Tiles 1.1 (sections 7.1 to 7.5); return the number of tiles."""
    assert set(tile) <= {
        *("boundingVolume", "geometricError", "refine", "content", "children", "extras"),
    }
    (box,) = tile["boundingVolume"].values()  # exactly one
    assert set(tile["boundingVolume"]) == {"box"}
    assert len(box) == 12
    assert np.isfinite(box).all()
    axes = np.array(box[3:]).reshape(3, 3)
    assert (np.linalg.norm(axes, axis=1) > 0).all()
    assert tile["geometricError"] >= 0
    assert parent is not None or tile["refine"] in ("ADD", "REPLACE")
    if parent is not None:
        assert tile["geometricError"] < parent["geometricError"]
    if "content" in tile:
        uri = tile["content"]["uri"]
        document, arrays = parse(folder / uri)
        assert document["asset"]["version"] == "2.0"
        # glTF has y up, tiles z: x, -z, y. All points are inside the boxes of all tiles above.
        p = arrays[0].astype(float)
        turned = np.stack([p[:, 0], -p[:, 2], p[:, 1]], -1)
        inside = np.abs((turned - box[:3]) @ np.linalg.inv(axes))
        assert inside.max() <= 1 + 1e-6
    children = tile.get("children")
    assert children is None or len(children) >= 1  # absent if there are none
    count = 1
    for child in children or []:
        mine = np.array(child["boundingVolume"]["box"])
        corner = np.abs(mine[:3] - box[:3]) + np.abs(mine[3:]).reshape(3, 3).sum(0)
        assert (corner <= np.abs(axes).sum(0) + 1e-3 + 1e-9).all()
        count += checked(child, tile, folder)
    return count


def test_tileset_matches_specification(made) -> None:
    document = json.loads((made.folder / "tileset.json").read_text())
    assert set(document) == {"asset", "geometricError", "root", "extras"}
    assert document["asset"]["version"] == "1.1"
    assert document["geometricError"] > document["root"]["geometricError"]
    count = checked(document["root"], None, made.folder)
    named = {tile.content for tile in made.root.walk()} - {None}
    assert count >= len(named)
    assert named | {"tileset.json"} == {p.name for p in made.folder.iterdir()}
    assert is_tiles(made.folder)
    assert made.tiled.tiles == len(named)


def meshes(made, level):
    """The meshes of a level, in world coordinates."""
    out = []
    for path in sorted(made.folder.glob(f"{level}-*.glb")):
        glb = read_glb(path)
        out.append((glb.points.astype(float) @ R, glb.faces, glb))
    return out


def test_finest_level_is_the_surface(made) -> None:
    parts = meshes(made, 0)
    assert len(parts) >= 36
    found = np.concatenate([points[faces].reshape(-1, 9) for points, faces, _ in parts])
    wanted = made.mesh.vertices[made.mesh.faces].reshape(-1, 9)
    flat = [0, 1, 3, 4, 6, 7]  # x and y are multiples of 1 cm
    order = [np.lexsort(np.round(each[:, flat], 3).T) for each in (found, wanted)]
    np.testing.assert_allclose(found[order[0]], wanted[order[1]], atol=2e-6)
    leaves = [tile for tile in made.root.walk() if not tile.children]
    assert sum(tile.faces for tile in leaves) == len(made.mesh.faces) == made.tiled.faces
    assert all(tile.error_m == 0 for tile in leaves)
    # Attributes of vertices are kept.
    # By x and y, which are multiples of 1 cm.
    key = {tuple(p): k for k, p in enumerate(np.round(made.mesh.vertices[:, :2], 2).tolist())}
    points, _, glb = parts[7]
    rows = [key[tuple(p)] for p in np.round(points[:, :2], 2).astype(np.float32).tolist()]
    np.testing.assert_array_equal(glb.color, made.mesh.color[rows])
    np.testing.assert_array_equal(glb.scalars["sigma"], made.mesh.sigma[rows])
    np.testing.assert_array_equal(glb.scalars["views"], made.mesh.views[rows])
    np.testing.assert_allclose(glb.normals @ R, made.mesh.normals[rows], atol=1e-6)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_tiles_of_a_level_have_no_cracks(made, level) -> None:
    """Each edge belongs to two triangles, in whatever tiles, except at the surface border."""
    edges = []
    for points, faces, _ in meshes(made, level):
        p = np.round(points, 5)
        ends = p[np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])]
        edges.append(ends)
    ends = np.concatenate(edges)
    names, index = np.unique(ends.reshape(-1, 3), axis=0, return_inverse=True)
    pairs, count = np.unique(np.sort(index.reshape(-1, 2), axis=1), axis=0, return_counts=True)
    rim = names[pairs[count == 1]] - [3.0, -2.0, 5.0]
    at_rim = (np.abs(rim[..., :2] - N / 200) > N / 200 - 0.015 * 2**level).any(-1).all(-1)
    assert at_rim.all()
    assert (count > 2).mean() < 0.001


def test_levels_are_within_stated_error(made) -> None:
    faces = []
    for level in range(made.tiled.levels):
        tiles_of = [t for t in made.root.walk() if t.content and t.content.startswith(f"{level}-")]
        faces.append(sum(t.faces for t in tiles_of))
        (error,) = {t.error_m for t in tiles_of}
        off = []
        for points, _, _ in meshes(made, level):
            x, y, z = (points - [3.0, -2.0, 5.0]).T
            off.append(np.abs(z - 0.1 * np.sin(9 * x) * np.cos(7 * y)))
        assert np.concatenate(off).max() <= error + 1e-5
    assert faces == sorted(faces, reverse=True)
    assert faces[0] > 3 * faces[1] > 9 * faces[2]
    assert made.tiled.levels == 4  # 180 cells, 32 across a tile: 6, 3, 2, 1


def test_tiles_are_reproducible(made, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(detail, "_TRIANGLES_PER_EDGE", 32)
    write_tiles(made.mesh, R, tmp_path / "again")
    for path in made.folder.iterdir():
        assert (tmp_path / "again" / path.name).read_bytes() == path.read_bytes()


def test_levels_without_triangles_keep_a_root(tmp_path, monkeypatch) -> None:
    """Two specks far apart: at some level neither has a triangle left."""
    monkeypatch.setattr(detail, "_TRIANGLES_PER_EDGE", 4)
    small = waves(2)
    far = replace(small, vertices=small.vertices + np.float32([40, 0, 0]))
    both = replace(
        small,
        vertices=np.concatenate([small.vertices, far.vertices]),
        faces=np.concatenate([small.faces, far.faces + len(small)]),
        **{
            name: np.concatenate([getattr(small, name)] * 2)
            for name in ("normals", "color", "sigma", "views")
        },
    )
    write_tiles(both, np.eye(3), tmp_path)
    document = json.loads((tmp_path / "tileset.json").read_text())
    checked(document["root"], None, tmp_path)
    root, _ = read_tileset(tmp_path / "tileset.json")
    leaves = [tile for tile in root.walk() if tile.content and tile.error_m == 0]
    assert sum(tile.faces for tile in leaves) == 16
    assert root.low[0] < 3.1
    assert root.high[0] > 43


def test_single_triangle_and_slivers_give_one_tile(tmp_path) -> None:
    one = waves(1).rows(np.array([True, False]))
    (level,) = levels(one)
    assert level.tile_indices == ((0, 0, 0),)
    flat = replace(one, vertices=np.float32([[0, 0, 0], [1, 0, 0], [2, 0, 0]]))
    assert len(list(levels(flat))[-1].tile_indices) <= 1
    assert write_tiles(one, np.eye(3), tmp_path).overview is one
    assert level.mesh is one


def test_damaged_tilesets_are_refused_in_one_line(made, tmp_path) -> None:
    good = (made.folder / "tileset.json").read_text()
    path = tmp_path / "tileset.json"
    for wrong in (
        "",
        "[]",
        good[: len(good) // 2],
        good.replace('"1.1"', '"0.9"', 1),
        good.replace('"uri": "', '"uri": "../', 1),
        good.replace('"box"', '"sphere"', 1),
        good.replace('"faces": ', '"faces": "x', 1),
    ):
        path.write_text(wrong)
        with pytest.raises(InputError) as caught:
            read_tileset(path)
        assert "\n" not in str(caught.value)
    nested = Tile(np.zeros(3), np.ones(3), 0.0, None, 0)
    for _ in range(60):
        nested = Tile(np.zeros(3), np.ones(3), 0.0, None, 0, [nested])
    write_tileset(path, nested, generator="", extras={})
    with pytest.raises(InputError, match="not a tileset written by tofuse"):
        read_tileset(path)


def test_boxes_round_trip_in_gltf_axes(tmp_path) -> None:
    tile = Tile(np.array([-1.0, 2, 3]), np.array([1.0, 5, 9]), 0.5, "0-0-0-0.glb", 7)
    write_tileset(tmp_path / "t.json", tile, generator="", extras={"a": 1})
    found, extras = read_tileset(tmp_path / "t.json")
    np.testing.assert_allclose([found.low, found.high], [tile.low, tile.high])
    assert (found.error_m, found.content, found.faces, extras) == (0.5, "0-0-0-0.glb", 7, {"a": 1})
    box = json.loads((tmp_path / "t.json").read_text())["root"]["boundingVolume"]["box"]
    np.testing.assert_allclose(box[:3], R_TILES_GLTF @ [0, 3.5, 6])
    np.testing.assert_allclose(np.diag(np.reshape(box[3:], (3, 3))), [1, 3, 1.5])


def test_glb_round_trip_and_foreign_files_are_refused(tmp_path) -> None:
    mesh = waves(4)
    path = tmp_path / "a.glb"
    color = np.repeat(np.arange(25, dtype=np.uint8)[:, None] * 10, 3, 1)
    write_glb(
        path, GeometryRecord(mesh.vertices, mesh.faces, color=color, scalars={"sigma": mesh.sigma})
    )
    found = read_glb(path)
    np.testing.assert_array_equal(found.points, mesh.vertices)
    np.testing.assert_array_equal(found.faces, mesh.faces)
    np.testing.assert_array_equal(found.color, color)
    np.testing.assert_array_equal(found.scalars["sigma"], mesh.sigma)
    assert found.normals is None
    data = path.read_bytes()
    for wrong in (b"", data[:300], data.replace(b'"SCALAR"', b'"MATRIX"'), b"glTF" + data[5:]):
        path.write_bytes(wrong)
        with pytest.raises(InputError, match="not a mesh written by tofuse"):
            read_glb(path)
    write_glb(path, GeometryRecord(np.zeros((0, 3)), np.zeros((0, 3), int)))
    assert len(read_glb(path).faces) == 0


@pytest.fixture
def small_limits(monkeypatch) -> None:
    monkeypatch.setattr(tiles, "MAX_UNTILED_FACES", 10_000)
    monkeypatch.setattr(tiles, "OVERVIEW_BYTES", 600_000)
    monkeypatch.setattr(detail, "_TRIANGLES_PER_EDGE", 32)


@pytest.mark.slow
def test_large_result_has_tiles_and_overview(tmp_path, small_limits) -> None:
    result, _ = make_room()
    mesh = waves()
    result = replace(result, mesh=mesh)
    out = tmp_path / "out"
    write_result(result, OutputFolder(out))
    run = json.loads((out / "run.json").read_text())["tiles"]
    assert run["tileset"] == "tiles/tileset.json"
    assert run["faces"] == len(mesh.faces)
    root, extras = read_tileset(out / run["tileset"])
    np.testing.assert_allclose(
        np.array(extras["T_up_world"])[:3, :3], upright(mesh, result.trajectory)
    )
    assert len([t for t in root.walk() if t.content]) == run["tiles"]
    assert (out / "mesh.glb").stat().st_size <= 600_000
    overview = read_glb(out / "mesh.glb")
    assert len(overview.faces) == run["overview_faces"] < len(mesh.faces) / 3
    whole = read_ply(out / "mesh.ply")
    np.testing.assert_array_equal(whole.points, mesh.vertices)
    np.testing.assert_array_equal(whole.faces, mesh.faces)
    if __import__("importlib").util.find_spec("lazrs"):
        laspy = pytest.importorskip("laspy")
        np.testing.assert_allclose(
            laspy.read(out / "cloud.laz").xyz, result.cloud.points, atol=0.51e-4
        )
    # A small result replaces it, including the tiles.
    small = replace(result, mesh=waves(10))
    write_result(small, OutputFolder(out, overwrite=True))
    assert not (out / "tiles").exists()
    assert not (out / "cloud.laz").exists()
    assert json.loads((out / "run.json").read_text())["tiles"] is None
    assert len(read_glb(out / "mesh.glb").faces) == 200
    # But not if the folder contains foreign files.
    write_result(result, OutputFolder(out, overwrite=True))
    (out / "tiles" / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="is not a file of an earlier result"):
        OutputFolder(out, overwrite=True)


def test_glb_is_simplified_and_ply_is_complete(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(tiles, "OVERVIEW_BYTES", 600_000)
    result, _ = make_room()
    result = replace(result, mesh=waves())
    out = tmp_path / "out"
    write_result(result, OutputFolder(out))
    assert json.loads((out / "run.json").read_text())["tiles"] is None
    assert 400_000 < (out / "mesh.glb").stat().st_size <= 600_000
    assert len(read_ply(out / "mesh.ply").faces) == len(waves().faces)


def test_tiles_without_colour_are_grey(tmp_path) -> None:
    colors = np.full((len(waves()), 3), 200, np.uint8)
    colors[::2] = 0
    write_tiles(replace(waves(), color=colors), np.eye(3), tmp_path)
    for path in tmp_path.glob("*.glb"):
        shown = read_glb(path).color
        assert set(shown[:, 0].tolist()) <= {142, 200}


def test_component_may_be_tiled_too(tmp_path, small_limits) -> None:
    result, _ = make_room()
    own = replace(result, mesh=waves())
    first = replace(result.components[0], result=None) if result.components else None
    if first is None:
        first = Component(((0, 9),), np.eye(4), None, None)
    apart = replace(first, T_main_component=None, result=own)
    both = replace(result, mesh=waves(10), components=(first, apart))
    out = tmp_path / "out"
    write_result(both, OutputFolder(out))
    assert is_tiles(out / "component-1" / "tiles")
    write_result(both, OutputFolder(out, overwrite=True))  # is recognised as a result
    assert is_tiles(out / "component-1" / "tiles")
    (out / "component-1" / "tiles" / "more.glb").write_text("")
    with pytest.raises(OutputError, match="component-1"):
        OutputFolder(out, overwrite=True)


def test_overview_is_as_fine_as_size_limit_allows(tmp_path, small_limits) -> None:
    tiled: TilingSummary = write_tiles(waves(), np.eye(3), tmp_path)
    write_glb(
        tmp_path / "o.glb",
        GeometryRecord(tiled.overview.vertices, tiled.overview.faces, color=None),
    )
    size = 32 * len(tiled.overview) + 12 * len(tiled.overview.faces)
    assert 300_000 < size <= 600_000
    assert max(path.stat().st_size for path in tmp_path.glob("0-*.glb")) < 600_000
    # For small surfaces it is the surface itself.
    assert write_tiles(small := waves(50), np.eye(3), tmp_path / "s").overview is small
