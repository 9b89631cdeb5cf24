"""Results in other formats, read back by libraries that are not ours."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tofuse.cli import main
from tofuse.cli.parser import EXPORTS
from tofuse.errors import InputError
from tofuse.files.ply import read_ply, write_ply
from tofuse.files.trajectory import write_tum
from tofuse.geometry import se3
from tofuse.results.export import FORMATS, export

TIMES, POSES = np.array([0.1, 0.2, 0.5]), se3.exp(np.random.default_rng(1).normal(size=(3, 6)))
POSES[0] = np.eye(4)


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """A result of three poses, frame 3 of the recording being lost, and a small bent surface."""
    folder = tmp_path / "result"
    folder.mkdir()
    frames = [{"index": k, "timestamp": t} for k, t in ((1, 0.1), (2, 0.2), (3, 0.3), (5, 0.5))]
    text = json.dumps({"schema": 1, "version": "0", "verdict": "good", "frames": frames})
    (folder / "run.json").write_text(text)
    write_tum(folder / "trajectory.txt", TIMES, POSES)
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(6.0), np.arange(5.0))
    points = np.stack([x, y, 2 + 0.1 * x * x], -1).reshape(-1, 3) / 10
    normals = rng.normal(size=(30, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    a = (np.arange(5) + 6 * np.arange(4)[:, None]).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + 6], 1), np.stack([a + 1, a + 7, a + 6], 1)])
    columns = {
        "normals": normals,
        "color": rng.integers(0, 256, (30, 3), np.uint8),
        "scalars": {
            "views": rng.integers(1, 900, 30).astype(np.int32),
            "sigma": rng.uniform(0.001, 0.02, 30).astype(np.float32),
        },
    }
    write_ply(folder / "cloud.ply", points, **columns)
    write_ply(folder / "mesh.ply", points, faces=faces, **columns)
    return folder


@pytest.fixture
def expected(result: Path) -> SimpleNamespace:
    ply = read_ply(result / "cloud.ply")
    return SimpleNamespace(
        points=ply.points,
        normals=ply.normals,
        color=ply.color,
        views=ply.vertex["views"],
        sigma=ply.vertex["sigma"],
        faces=read_ply(result / "mesh.ply").faces,
    )


def test_ply_of_a_run(result: Path, expected) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.load(result / "mesh.ply", process=False)
    np.testing.assert_array_equal(mesh.vertices, expected.points)
    np.testing.assert_array_equal(mesh.faces, expected.faces)
    np.testing.assert_array_equal(mesh.visual.vertex_colors[:, :3], expected.color)
    columns = mesh.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(columns["views"].ravel(), expected.views)
    np.testing.assert_array_equal(columns["sigma"].ravel(), expected.sigma)
    for k, name in enumerate(("nx", "ny", "nz")):
        np.testing.assert_array_equal(columns[name].ravel(), expected.normals[:, k])


def test_pcd(result: Path, expected) -> None:
    pypcd4 = pytest.importorskip("pypcd4")
    (path,) = export(result, ["pcd"])
    cloud = pypcd4.PointCloud.from_path(path)
    xyz = cloud.numpy(("x", "y", "z", "normal_x", "normal_y", "normal_z", "sigma", "views"))
    np.testing.assert_array_equal(xyz[:, :3], expected.points)
    np.testing.assert_array_equal(xyz[:, 3:6], expected.normals)
    np.testing.assert_array_equal(xyz[:, 6], expected.sigma)
    np.testing.assert_array_equal(xyz[:, 7], expected.views)
    rgb = pypcd4.PointCloud.decode_rgb(cloud.pc_data["rgb"])
    np.testing.assert_array_equal(rgb, expected.color)


def test_las(result: Path, expected) -> None:
    laspy = pytest.importorskip("laspy")
    (path,) = export(result, ["las"])
    las = laspy.read(path)
    assert str(las.header.version) == "1.4"
    assert las.header.point_format.id == 7
    assert las.header.generating_software.startswith("tofuse")
    np.testing.assert_allclose(las.xyz, expected.points, atol=0.51e-4)
    np.testing.assert_allclose(las.header.mins, expected.points.min(0), atol=1e-6)
    np.testing.assert_allclose(las.header.maxs, expected.points.max(0), atol=1e-6)
    rgb = np.stack([las.red, las.green, las.blue], -1)
    np.testing.assert_array_equal(rgb // 256, expected.color)
    np.testing.assert_array_equal(las["views"], expected.views)
    np.testing.assert_array_equal(las["sigma"], expected.sigma)
    normals = np.stack([las[f"normal {a}"] for a in "xyz"], -1)
    np.testing.assert_array_equal(normals, expected.normals)


def test_e57(result: Path, expected) -> None:
    pye57 = pytest.importorskip("pye57")
    (path,) = export(result, ["e57"])
    file = pye57.E57(str(path))
    try:
        assert file.scan_count == 1
        header = file.get_header(0)
        assert header.point_count == len(expected.points)
        data = file.read_scan(0, colors=True, ignore_missing_fields=True)
        image = file.image_file
        assert image.extensionsLookupPrefix("tofuse", "") is not None
        more = ("nor:normalX", "nor:normalY", "nor:normalZ", "tofuse:views", "tofuse:sigma")
        assert set(more) <= set(header.point_fields)
        buffers, arrays = pye57.libe57.VectorSourceDestBuffer(), {}
        for name in more:
            arrays[name] = np.zeros(30)
            buffers.append(pye57.libe57.SourceDestBuffer(image, name, arrays[name], 30, True, True))
        assert header.points.reader(buffers).read() == 30
    finally:
        file.close()
    xyz = np.stack([data[f"cartesian{a}"] for a in "XYZ"], -1)
    np.testing.assert_array_equal(xyz.astype(np.float32), expected.points)
    rgb = np.stack([data[f"color{c}"] for c in ("Red", "Green", "Blue")], -1)
    np.testing.assert_array_equal(rgb, expected.color)
    normals = np.stack([arrays[name] for name in more[:3]], -1)
    np.testing.assert_array_equal(normals.astype(np.float32), expected.normals)
    np.testing.assert_array_equal(arrays["tofuse:views"], expected.views)
    np.testing.assert_array_equal(arrays["tofuse:sigma"].astype(np.float32), expected.sigma)


@pytest.mark.parametrize("name", ["obj", "gltf"])
def test_meshes_stand_upright(name: str, result: Path, expected) -> None:
    trimesh = pytest.importorskip("trimesh")
    (path,) = export(result, [name])
    (mesh,) = trimesh.load_scene(path, process=False, maintain_order=True).geometry.values()
    # The first camera's y points down, and it looks along z; up is the mean of the cameras'.
    assert (
        np.linalg.norm(mesh.vertices, axis=1) - np.linalg.norm(expected.points, axis=1)
    ).max() < 1e-5
    R = np.linalg.lstsq(expected.points.astype(float), mesh.vertices, rcond=None)[0].T
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-4)
    up = -POSES[:, :3, 1].mean(0)
    np.testing.assert_allclose(R @ up / np.linalg.norm(up), [0, 1, 0], atol=1e-3)
    np.testing.assert_array_equal(mesh.faces, expected.faces)
    np.testing.assert_allclose(mesh.vertex_normals, expected.normals @ R.T, atol=1e-3)
    if name == "obj":  # what glTF holds is linear light, and is read back elsewhere
        found = mesh.visual.vertex_colors[:, :3].astype(int)
        np.testing.assert_allclose(found, expected.color, atol=1)


def test_kitti(result: Path) -> None:
    (path,) = export(result, ["kitti"])
    rows = np.loadtxt(path)
    np.testing.assert_allclose(rows.reshape(3, 3, 4), POSES[:, :3], atol=1e-15)


def test_log_tum_and_kitti_by_open3d(result: Path) -> None:
    open3d = pytest.importorskip("open3d", reason="open3d is not installed")
    (log,) = export(result, ["log"])
    for path in (log, result / "trajectory.txt"):
        read = open3d.io.read_pinhole_camera_trajectory(str(path))
        found = [np.linalg.inv(p.extrinsic) for p in read.parameters]
        np.testing.assert_allclose(found, POSES, atol=1e-9)


def test_log_has_the_numbers_of_the_frames(result: Path) -> None:
    (path,) = export(result, ["log"])
    lines = path.read_text().splitlines()
    assert [lines[k] for k in (0, 5, 10)] == ["1 1 2", "2 2 3", "5 5 6"]
    block = np.array([line.split() for line in lines[6:10]], float)
    np.testing.assert_allclose(block, POSES[1], atol=1e-15)


def test_by_the_command_line(result: Path, tmp_path: Path, capsys) -> None:
    assert set(EXPORTS) == set(FORMATS)
    out = tmp_path / "new" / "files"
    assert main(["export", str(result), "las", "kitti", "--out", str(out)]) == 0
    assert capsys.readouterr().out.split() == [
        str(out / "cloud.las"),
        str(out / "trajectory.kitti.txt"),
    ]
    before = (out / "cloud.las").read_bytes()
    (out / "cloud.las").write_bytes(b"mine")
    assert main(["export", str(result), "las", "--out", str(out)]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main(["export", str(result), "las", "--out", str(out), "--overwrite"]) == 0
    assert (out / "cloud.las").read_bytes() == before
    assert main(["export", str(tmp_path), "las"]) == 2
    assert "holds no result" in capsys.readouterr().err
    assert main(["export", str(result), "doc"]) == 2
    assert "use one of" in capsys.readouterr().err


def test_what_is_not_there(result: Path, monkeypatch) -> None:
    (result / "mesh.ply").unlink()
    with pytest.raises(InputError, match="clouds without a camera make no surface"):
        export(result, ["obj"])
    monkeypatch.setitem(__import__("sys").modules, "pye57", None)
    with pytest.raises(InputError, match=r"needs the package pye57; pip install 'tofuse\[scan\]'"):
        export(result, ["e57"])
    assert not (result / "cloud.e57").exists()


def test_an_empty_cloud(result: Path) -> None:
    write_ply(result / "cloud.ply", np.zeros((0, 3)))
    laspy = pytest.importorskip("laspy")
    pypcd4 = pytest.importorskip("pypcd4")
    las, pcd = export(result, ["las", "pcd"])
    assert len(laspy.read(las).points) == 0
    assert pypcd4.PointCloud.from_path(pcd).points == 0
    with pytest.raises(InputError, match="there are no points"):
        export(result, ["e57"])
