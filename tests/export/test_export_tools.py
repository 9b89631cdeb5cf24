"""Results for Rerun, Foxglove, OctoMap and planners, read back by these programs."""

from __future__ import annotations

import base64
import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from cli_calls import printed, refuses
from posed_results import DISTANCE, NORMAL, POSED, POSES, made_result, plane
from tofuse.apps.export import exporting
from tofuse.apps.export.exporting import export
from tofuse.apps.export.mcap_file import write_mcap
from tofuse.apps.export.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tofuse.apps.export.scene import Scene
from tofuse.apps.results.folders import OutputFolder
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.engine.geometry import quaternion, se3
from tofuse.engine.geometry.rays import homogeneous
from tofuse.formats.export.octomap import write_octomap
from tofuse.formats.geometry.ply import read_ply, write_ply
from written_run_json import change_run

CAMERA = Pinhole(48, 36, 40.0, 41.0, 23.0, 18.0)
UP = se3.exp(np.array([0, 0, 0, 2.6, 0.4, -0.3]))
FORMATS = ["occupancy", "esdf", "octomap"]


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """Images of a plane, of which the first alone are used by `every=4`; its points, and sigma."""
    folder = made_result(tmp_path, CAMERA)
    z = plane(CAMERA, 0)
    points = (homogeneous(CAMERA.rays()) * z[..., None])[z > 0].astype(np.float32)
    color = np.tile(np.uint8([200, 100, 50]), (len(points), 1))
    sigma = np.linspace(0.001, 0.01, len(points), dtype=np.float32)
    write_ply(folder / "cloud.ply", GeometryRecord(points, color=color, scalars={"sigma": sigma}))
    faces = np.array([[0, 1, 48], [1, 49, 48]], np.int32)
    write_ply(folder / "mesh.ply", GeometryRecord(points, faces=faces, color=color))
    change_run(folder, T_up_world=UP.tolist())
    return folder


def along_ray(distance: float, u: int, v: int) -> np.ndarray:
    """The point at a distance from the plane along the ray of a pixel of the first frame."""
    ray = np.array([*CAMERA.rays()[v, u], 1.0])
    return ray * ((DISTANCE + distance) / (ray @ NORMAL))


def state_in_octree(tree: Any, point: np.ndarray) -> int:
    node = tree.search(point)
    if node is None:
        return UNKNOWN
    return OCCUPIED if tree.isNodeOccupied(node) else FREE


def test_planners_know_what_is_free(result: Path) -> None:
    pyoctomap = pytest.importorskip("pyoctomap", reason="pip install pyoctomap")
    paths = export(result, FORMATS, every=4, voxel_m=0.05)
    grid, esdf = (dict(np.load(path)) for path in paths[:2])
    assert grid["voxel_m"] == 0.05
    np.testing.assert_array_equal(grid["states"], esdf["states"])
    tree = pyoctomap.OcTree(1.0)
    assert tree.readBinary(str(paths[2]))
    assert tree.getResolution() == 0.05

    def state(point: np.ndarray) -> int:
        index = np.floor((point - grid["origin"]) / 0.05).astype(int)
        found = grid["states"][tuple(index)]
        assert found == state_in_octree(tree, point)
        return int(found)

    for u, v in ((10, 8), (23, 18), (40, 25), (12, 25)):
        assert state(along_ray(0.0, u, v)) == OCCUPIED
        for distance in (-0.1, -0.5, -1.0, -1.6):
            assert state(along_ray(distance, u, v)) == FREE
        assert state(along_ray(0.15, u, v)) == UNKNOWN
    assert state(along_ray(-0.5, 1, 1)) == UNKNOWN  # no depth in this corner
    # Each view counts once: a hit, or a miss.
    assert set(np.unique(grid["log_odds"])) == set(np.float32([-0.4, 0, 0.85]))
    # From the world to axes with z up.
    upright = grid["T_zup_world"][:3, :3] @ UP[:3, :3].T
    np.testing.assert_allclose(upright @ [0, 1, 0], [0, 0, 1], atol=1e-12)


def test_distances_are_those_of_brute_force(result: Path) -> None:
    (path,) = export(result, ["esdf"], voxel_m=0.2)
    esdf = np.load(path)
    occupied = esdf["states"] == OCCUPIED
    centres = np.argwhere(np.ones_like(occupied)) * 0.2
    is_occupied = occupied.ravel()
    for own, others, sign in ((~is_occupied, is_occupied, 1), (is_occupied, ~is_occupied, -1)):
        gaps = centres[own][:, None] - centres[others][None]
        nearest = sign * np.sqrt((gaps**2).sum(-1).min(1))
        np.testing.assert_allclose(esdf["distance_m"].ravel()[own], nearest, atol=1e-5)


def test_evidence_of_views_adds_up() -> None:
    corners = np.array([[-1.0, -1, -1], [1, 1, 3]])
    grid = OccupancyGrid.around(corners, 0.1)
    wall = np.array([[0.05, 0.05, 2.05]])
    for view in range(1, 4):
        grid.add(np.repeat(wall, 9, 0), np.full(3, 0.05), view)
    cell = tuple(np.floor((wall[0] - grid.origin) / 0.1).astype(int))
    assert grid.log_odds[cell] == pytest.approx(3 * 0.85)
    in_front = (*cell[:2], cell[2] - 3)
    assert grid.log_odds[in_front] == pytest.approx(-1.2)
    # What is behind is seen after the wall has gone; an end outside of the grid clears its way.
    for view in range(4, 12):
        grid.add(wall + np.array([0, 0, 7.0]), np.full(3, 0.05), view)
    assert grid.states[cell] == FREE
    assert grid.states[(*cell[:2], cell[2] + 5)] == FREE
    assert grid.log_odds.min() == np.float32(-2.0)
    grid.add(np.zeros((0, 3)), np.zeros(3), 12)
    with pytest.raises(InputError, match=r"voxel: of 0\.001 m makes 16060 million voxels"):
        OccupancyGrid.around(corners, 0.001)


def test_octree_has_every_voxel(tmp_path: Path) -> None:
    pyoctomap = pytest.importorskip("pyoctomap", reason="pip install pyoctomap")
    states = np.random.default_rng(0).choice([UNKNOWN, FREE, OCCUPIED], (20, 13, 31))
    states[:8, :8, :8], states[8:16, :8, 8:16] = FREE, OCCUPIED  # which are single leaves
    first = np.array([-8, 0, -48])
    path = tmp_path / "map.bt"
    write_octomap(path, states == FREE, states == OCCUPIED, first, 0.05)
    tree = pyoctomap.OcTree(1.0)
    assert tree.readBinary(str(path))
    assert tree.getNumLeafNodes() <= (states != UNKNOWN).sum() - 2 * 511
    for index in np.ndindex(states.shape):
        centre = (np.array(index) + first + 0.5) * 0.05
        assert state_in_octree(tree, centre) == states[index]
    write_octomap(path, states > 999, states > 999, first, 0.05)
    assert pyoctomap.OcTree(1.0).readBinary(str(path))
    with pytest.raises(InputError, match="more than 32768 voxels from the origin"):
        write_octomap(path, states == FREE, states == OCCUPIED, first + 32768, 0.05)


def test_mcap_read_by_its_reader(result: Path) -> None:
    reader = pytest.importorskip("mcap.reader", reason="pip install mcap")
    (path,) = export(result, ["mcap"])
    messages: dict[str, list[tuple[str, dict]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in reader.make_reader(file).iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            data = json.loads(message.data)
            assert set(data) == set(json.loads(schema.data)["properties"])
            assert message.log_time == data["timestamp"]["sec"] * 10**9 + data["timestamp"]["nsec"]
            messages.setdefault(channel.topic, []).append((schema.name, data))
    kinds = {
        (topic, name.removeprefix("foxglove.")) for topic in messages for name, _ in messages[topic]
    }
    assert kinds == {
        ("/tf", "FrameTransform"), ("/pose", "PoseInFrame"), ("/trajectory", "PosesInFrame"),
        ("/cloud", "PointCloud"), ("/depth/calibration", "CameraCalibration"),
        ("/depth/image", "RawImage"), ("/color/calibration", "CameraCalibration"),
        ("/color/image", "CompressedImage"),
    }  # fmt: skip
    poses = [data for _, data in messages["/pose"]]
    assert len(poses) == len(POSED)
    for k, data in zip(POSED, poses, strict=True):
        assert data["timestamp"] == {"sec": 0, "nsec": k * 100_000_000}
        assert data["frame_id"] == "world"
        np.testing.assert_allclose(matrix(**data["pose"]), POSES[k], atol=1e-6)
    up, *moving = [data for _, data in messages["/tf"]]
    assert (up["parent_frame_id"], up["child_frame_id"]) == ("map", "world")
    for k, data in zip(POSED, moving, strict=True):
        assert (data["parent_frame_id"], data["child_frame_id"]) == ("world", "camera")
        T = matrix(position=data["translation"], orientation=data["rotation"])
        np.testing.assert_allclose(T, POSES[k], atol=1e-6)
    [(_, cloud)] = messages["/cloud"]
    kinds = {1: "u1", 7: "<f4"}
    described = [(f["name"], kinds[f["type"]], f["offset"]) for f in cloud["fields"]]
    layout = dict(zip(("names", "formats", "offsets"), zip(*described, strict=True), strict=True))
    columns = np.dtype(layout | {"itemsize": cloud["point_stride"]})
    points, expected = np.frombuffer(base64.b64decode(cloud["data"]), columns), cloud_of(result)
    np.testing.assert_array_equal(np.stack([points[a] for a in "xyz"], 1), expected.points)
    np.testing.assert_array_equal(points["sigma"], expected.scalars["sigma"])
    assert (points["red"] == 200).all()
    assert (points["alpha"] == 255).all()
    depth = messages["/depth/image"][1][1]
    counts = np.frombuffer(base64.b64decode(depth["data"]), "<u2").reshape(36, 48)
    np.testing.assert_array_equal(counts, np.round(plane(CAMERA, 1) * 1000))
    K = np.reshape(messages["/depth/calibration"][1][1]["K"], (3, 3))
    np.testing.assert_array_equal(K, [[40, 0, 23], [0, 41, 18], [0, 0, 1]])
    jpeg = np.frombuffer(base64.b64decode(messages["/color/image"][1][1]["data"]), np.uint8)
    assert cv2.imdecode(jpeg, cv2.IMREAD_COLOR).shape == (36, 48, 3)


def test_mcap_of_times_that_are_negative_and_out_of_order(result: Path) -> None:
    reader = pytest.importorskip("mcap.reader", reason="pip install mcap")
    scene = Scene.read(result, 4)
    path = result / "scene.mcap"
    write_mcap(replace(scene, times=-0.5 - 0.1 * np.arange(len(scene.times))), path)
    with path.open("rb") as file:
        found = [
            (channel.topic, message.log_time)
            for _, channel, message in reader.make_reader(file).iter_messages()
        ]
    times = sorted(time for topic, time in found if topic == "/pose")
    assert times == [k * 100_000_000 for k in range(len(scene.times))]
    assert dict(found)["/cloud"] == 0


def matrix(position: dict[str, float], orientation: dict[str, float]) -> np.ndarray:
    return se3.pose(
        quaternion.to_matrix(np.array([orientation[a] for a in "xyzw"])),
        [position[a] for a in "xyz"],
    )


def cloud_of(result: Path) -> GeometryRecord:
    return read_ply(result / "cloud.ply")


def test_rerun_read_by_its_reader(result: Path) -> None:
    pytest.importorskip("rerun", reason="pip install rerun-sdk")
    from rerun.chunk import RrdReader

    (path,) = export(result, ["rerun"])
    (entry,) = RrdReader(path).recordings()
    # Another result of the same name is another recording in the viewer.
    assert re.fullmatch(rf"{result.name}-[0-9a-f]{{12}}", entry.recording_id)
    columns: dict[tuple[str, str], list[Any]] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for name, values in zip(batch.schema.names, batch.columns, strict=True):
            if not name.startswith(("rerun.", "RecordingInfo")):
                columns.setdefault((chunk.entity_path, name), []).extend(values.to_pylist())

    def column(entity: str, name: str) -> np.ndarray:
        return np.array([row[0] for row in columns[f"/world{entity}", name]])

    T = np.tile(np.eye(4), (len(POSED), 1, 1))
    T[:, :3, :3] = quaternion.to_matrix(column("/camera", "Transform3D:quaternion").astype(float))
    T[:, :3, 3] = column("/camera", "Transform3D:translation")
    np.testing.assert_allclose(T, POSES[POSED], atol=1e-6)
    assert columns["/world/camera", "frame"] == POSED
    times = [each.total_seconds() for each in columns["/world/camera", "time"]]
    np.testing.assert_allclose(times, 0.1 * np.array(POSED))
    (points,) = columns["/world/cloud", "Points3D:positions"]
    np.testing.assert_array_equal(np.float32(points), cloud_of(result).points)
    (colors,) = columns["/world/cloud", "Points3D:colors"]
    assert set(colors) == {0xC86432FF}
    (faces,) = columns["/world/mesh", "Mesh3D:triangle_indices"]
    assert faces == [[0, 1, 48], [1, 49, 48]]
    (path_drawn,) = columns["/world/trajectory", "LineStrips3D:strips"]
    np.testing.assert_allclose(path_drawn[0], POSES[POSED, :3, 3], atol=1e-6)
    for k, row in zip(POSED, columns["/world/camera/depth", "DepthImage:buffer"], strict=True):
        image = np.frombuffer(bytes(row[0]), np.float32).reshape(36, 48)
        np.testing.assert_allclose(image, plane(CAMERA, k), atol=1e-6)
    K = column("/camera/depth", "Pinhole:image_from_camera").reshape(-1, 3, 3)[0].T
    # In Rerun the centre of the first pixel is at (0.5, 0.5).
    np.testing.assert_allclose(K, [[40, 0, 23.5], [0, 41, 18.5], [0, 0, 1]])
    assert len(columns["/world/camera/image", "EncodedImage:blob"]) == len(POSED)


@pytest.mark.parametrize(
    ("name", "package", "extra"),
    [
        ("rerun", "rerun", "'tofuse[rerun]'"),
        ("mcap", "mcap.writer", "'tofuse[mcap]'"),
        ("e57", "pye57", "'tofuse[scan]'"),
        ("stl", "trimesh", "trimesh"),
    ],
)
def test_missing_package_is_named_before_any_work(
    result: Path, name: str, package: str, extra: str, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setattr(exporting, "_Result", None)
    says = f"export {name}: needs the package {package}; pip install {extra}"
    refuses(capsys, "export", result, "pcd", name, says=says)


def test_command_writes_grids_that_belong_to_the_result(result: Path, capsys) -> None:
    words = ("export", result, *FORMATS, "--voxel", "0.1m", "--every", "2")
    names = ["occupancy.npz", "esdf.npz", "octomap.bt"]
    assert [Path(line).name for line in printed(capsys, *words).split()] == names
    with OutputFolder(result, overwrite=True):
        pass
    words = ("export", result, "esdf", "--voxel", "1mm", "--overwrite")
    refuses(capsys, *words, says="--voxel: of 0.001 m makes")
