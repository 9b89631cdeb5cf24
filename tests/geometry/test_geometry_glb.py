"""glTF binary, read back by an independent parser."""

from __future__ import annotations

import numpy as np
import pytest

from parsed_glb import parse
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.formats.geometry.glb import write_glb


def test_mesh_round_trips(tmp_path) -> None:
    points = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    color = np.array([[0, 127, 255]] * 7, np.uint8)
    faces = np.array([[0, 1, 2], [2, 3, 6], [4, 5, 0]])
    path = tmp_path / "m.glb"
    write_glb(path, GeometryRecord(points, faces, normals=normals, color=color))
    document, arrays = parse(path)
    assert document["asset"]["version"] == "2.0"
    node = document["nodes"][document["scenes"][document["scene"]]["nodes"][0]]
    primitive = document["meshes"][node["mesh"]]["primitives"][0]
    assert primitive["mode"] == 4
    where = primitive["attributes"]
    np.testing.assert_array_equal(arrays[where["POSITION"]], points)
    np.testing.assert_allclose(arrays[where["NORMAL"]], normals, atol=1e-7)
    np.testing.assert_array_equal(arrays[primitive["indices"]].reshape(-1, 3), faces)
    accessor = document["accessors"][where["POSITION"]]
    np.testing.assert_array_equal(np.float32(accessor["min"]), points.min(0))
    np.testing.assert_array_equal(np.float32(accessor["max"]), points.max(0))
    # The standard's colours are linear: half of the way on a screen is a fifth of the light.
    light = arrays[where["COLOR_0"]][0] / 65535
    np.testing.assert_allclose(light, [0, 0.2122, 1, 1], atol=1e-3)
    assert document["accessors"][where["COLOR_0"]]["normalized"] is True
    assert primitive["material"] == 0


def test_mesh_without_faces_is_empty_scene(tmp_path) -> None:
    path = tmp_path / "m.glb"
    write_glb(path, GeometryRecord(np.zeros((0, 3)), np.zeros((0, 3), int)))
    document, arrays = parse(path)
    assert arrays == []
    # Empty lists are not allowed.
    assert all(value != [] for value in document.values())
    assert document["scenes"] == [{}]


def test_node_transform_places_mesh(tmp_path) -> None:
    trimesh = pytest.importorskip("trimesh")
    rng = np.random.default_rng(4)
    points, faces = rng.normal(0, 1, (9, 3)).astype(np.float32), np.arange(9).reshape(3, 3)
    T = np.eye(4)
    T[:3] = [[0, 1, 0, 0.5], [-1, 0, 0, 0], [0, 0, 1, -2]]
    write_glb(tmp_path / "m.glb", GeometryRecord(points, faces), T_scene_node=T)
    scene = trimesh.load_scene(tmp_path / "m.glb", process=False, maintain_order=True)
    (mesh,) = scene.geometry.values()
    np.testing.assert_array_equal(mesh.vertices, points)  # in the node's frame
    found, _ = scene.graph[scene.graph.nodes_geometry[0]]
    np.testing.assert_allclose(found, T, atol=1e-12)
