"""Results in other formats, read back by third-party libraries."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cli_calls import printed, refuses
from parsed_glb import parse
from refused import refused
from tofuse.apps.cli.options import Export
from tofuse.apps.cli.program import main
from tofuse.apps.export.exporting import FORMATS, export
from tofuse.apps.results.folders import OutputFolder
from tofuse.engine.errors import InputError, OutputError
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.engine.geometry import se3
from tofuse.formats.geometry import las
from tofuse.formats.geometry.ply import read_ply, write_ply
from tofuse.formats.poses.trajectory import write_tum
from written_run_json import change_run, write_run

TIMES, POSES = np.array([0.1, 0.2, 0.5]), se3.exp(np.random.default_rng(1).normal(size=(3, 6)))
POSES[0] = np.eye(4)
T_UP_WORLD = se3.exp(np.array([0, 0, 0, 2.6, 0.4, -0.3]))


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """A result of three poses, with frame 3 of the recording lost, and a small curved surface."""
    folder = tmp_path / "result"
    folder.mkdir()
    frames = [{"index": k, "timestamp": t} for k, t in ((1, 0.1), (2, 0.2), (3, 0.3), (5, 0.5))]
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
        # Smooth, so that a texture has only rounding errors.
        "color": np.round(60 + 40 * points @ [[3, 0, 1], [0, 3, 1], [5, 0, 0]]).astype(np.uint8),
        "scalars": {
            "views": rng.integers(1, 900, 30).astype(np.int32),
            "sigma": rng.uniform(0.001, 0.02, 30).astype(np.float32),
        },
    }
    write_ply(folder / "cloud.ply", GeometryRecord(points, **columns))
    write_ply(folder / "mesh.ply", GeometryRecord(points, faces=faces, **columns))
    write_run(folder, T_up_world=T_UP_WORLD.tolist(), frames=frames)
    return folder


@pytest.fixture
def expected(result: Path) -> SimpleNamespace:
    ply, faces = read_ply(result / "cloud.ply"), read_ply(result / "mesh.ply").faces
    columns = {name: getattr(ply, name) for name in ("points", "normals", "color")}
    return SimpleNamespace(**columns, **ply.scalars, faces=faces)


def test_ply_read_by_trimesh(result: Path, expected) -> None:
    mesh = pytest.importorskip("trimesh").load(result / "mesh.ply", process=False)
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
    found = cloud.numpy(("x", "y", "z", "normal_x", "normal_y", "normal_z", "sigma", "views"))
    columns = [expected.points, expected.normals, expected.sigma, expected.views]
    np.testing.assert_array_equal(found, np.column_stack(columns))
    rgb = pypcd4.PointCloud.decode_rgb(cloud.pc_data["rgb"])
    np.testing.assert_array_equal(rgb, expected.color)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_las(result: Path, expected, suffix: str) -> None:
    laspy = pytest.importorskip("laspy")
    if suffix == "laz":
        pytest.importorskip("lazrs")
    (path,) = export(result, [suffix])
    found = laspy.read(path)
    assert found.header.are_points_compressed == (suffix == "laz")
    assert str(found.header.version) == "1.4"
    assert found.header.point_format.id == 7
    assert found.header.generating_software.startswith("tofuse")
    np.testing.assert_allclose(found.xyz, expected.points, atol=0.51e-4)
    np.testing.assert_allclose(found.header.mins, expected.points.min(0), atol=1e-6)
    np.testing.assert_allclose(found.header.maxs, expected.points.max(0), atol=1e-6)
    rgb = np.stack([found.red, found.green, found.blue], -1)
    np.testing.assert_array_equal(rgb // 256, expected.color)
    np.testing.assert_array_equal(found["views"], expected.views)
    np.testing.assert_array_equal(found["sigma"], expected.sigma)
    normals = np.stack([found[f"normal {a}"] for a in "xyz"], -1)
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


@pytest.fixture
def upright(expected) -> SimpleNamespace:
    """The surface in its upright orientation, as stated in `run.json`."""
    R = T_UP_WORLD[:3, :3]
    return SimpleNamespace(
        points=expected.points @ R.T,
        normals=expected.normals @ R.T,
        color=expected.color.astype(float),
        corners=np.sort((expected.points @ R.T)[expected.faces].reshape(-1, 9).round(4), 0),
    )


def check_surface(upright, points, faces, normals, color, *, exact: float = 2e-5) -> None:
    """What another program read equals what was written, whatever vertices are doubled at seams."""
    points = np.asarray(points, float)
    distance = np.linalg.norm(points[:, None] - upright.points[None], axis=2)
    near = distance.argmin(1)
    assert distance.min(1).max() < exact
    assert distance.min(0).max() < exact
    corners = np.sort(points[np.asarray(faces)].reshape(-1, 9).round(4), 0)
    np.testing.assert_allclose(corners, upright.corners, atol=2e-4)
    if normals is not None:
        np.testing.assert_allclose(normals, upright.normals[near], atol=0.01)
    if color is not None:
        assert np.abs(np.asarray(color, float) - upright.color[near]).max() <= 0.01 * 255 + 1


@pytest.mark.parametrize("name", ["glb", "gltf", "obj", "stl"])
def test_surfaces_read_by_trimesh(name: str, result: Path, upright) -> None:
    trimesh = pytest.importorskip("trimesh")
    (path,) = export(result, [name])
    (mesh,) = trimesh.load_scene(path, process=False, maintain_order=True).geometry.values()
    plain = name == "stl"
    color = None if plain else mesh.visual.to_color().vertex_colors[:, :3]
    check_surface(upright, mesh.vertices, mesh.faces, None if plain else mesh.vertex_normals, color)


def test_large_meshes_have_vertex_colours(result: Path, upright, monkeypatch) -> None:
    trimesh = pytest.importorskip("trimesh")
    monkeypatch.setattr("tofuse.apps.export.exporting._MAX_TEXTURED_FACES", 10)
    glb, obj = export(result, ["glb", "obj"])
    (mesh,) = trimesh.load_scene(obj, process=False, maintain_order=True).geometry.values()
    color = mesh.visual.vertex_colors[:, :3]
    check_surface(upright, mesh.vertices, mesh.faces, mesh.vertex_normals, color)
    document, arrays = parse(glb)
    (primitive,) = document["meshes"][0]["primitives"]
    found = arrays[primitive["attributes"]["COLOR_0"]][:, :3] / 65535
    # glTF stores linear light, by the inverse of sRGB.
    s = upright.color / 255
    light = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(found, light, atol=1e-4)


@pytest.mark.parametrize("name", ["glb", "stl"])
def test_a_surface_without_triangles_is_refused(name: str, result: Path) -> None:
    refused("faces: 1 are too few", result, [name], by=export, faces=1)
    mesh = read_ply(result / "mesh.ply")
    write_ply(result / "mesh.ply", replace(mesh, faces=np.zeros((0, 3), np.int32)))
    change_run(result)
    refused(r"mesh\.ply: has no triangles", result, [name], by=export)


@pytest.mark.parametrize(
    ("option", "name"),
    [
        ({"faces": 4}, "pcd"),
        ({"every": 2}, "glb"),
        ({"pinhole": True}, "stl"),
        ({"voxel_m": 1}, "las"),
    ],
)
def test_an_option_without_effect_is_refused(option: dict, name: str, result: Path) -> None:
    with pytest.raises(InputError, match=rf"has no effect on {name}; leave it out; it is for"):
        export(result, [name], **option)
    assert not (result / FORMATS[name][0]).exists()


def test_files_of_the_result_itself_are_not_replaced(result: Path, tmp_path: Path) -> None:
    export(result, ["glb"])
    change_run(result)  # seals the file as one that the run wrote
    written = (result / "mesh.glb").read_bytes()
    with pytest.raises(OutputError, match="a file of the result itself"):
        export(result, ["glb"], faces=4, overwrite=True)
    assert (result / "mesh.glb").read_bytes() == written
    (path,) = export(result, ["glb"], tmp_path / "other", faces=4)
    assert path.is_file()


def test_laz_is_reproducible_and_written_in_blocks(result: Path, monkeypatch) -> None:
    laspy = pytest.importorskip("laspy")
    (path,) = export(result, ["laz"])
    first = path.read_bytes()
    export(result, ["laz"], overwrite=True)
    assert path.read_bytes() == first
    monkeypatch.setattr(las, "_BLOCK_POINTS", 7)
    export(result, ["laz", "las"], overwrite=True)
    np.testing.assert_array_equal(
        laspy.read(path).points.array, laspy.read(result / "cloud.las").points.array
    )


def test_kitti(result: Path) -> None:
    (path,) = export(result, ["kitti"])
    np.testing.assert_allclose(np.loadtxt(path).reshape(3, 3, 4), POSES[:, :3], atol=1e-15)


def test_export_command(result: Path, tmp_path: Path, capsys) -> None:
    assert ", ".join(FORMATS) in " ".join((Export.__doc__ or "").split())
    out = tmp_path / "new" / "files"
    names = [str(out / name) for name in ("cloud.las", "trajectory.kitti.txt")]
    assert printed(capsys, "export", result, "las", "kitti", "--out", out).split() == names
    before = (out / "cloud.las").read_bytes()
    (out / "cloud.las").write_bytes(b"mine")
    refuses(capsys, "export", result, "las", "--out", out, says="--overwrite")
    assert main(["export", str(result), "las", "--out", str(out), "--overwrite"]) == 0
    assert (out / "cloud.las").read_bytes() == before
    (result / "mesh.ply").unlink()
    (out / "mine.txt").write_text("mine")
    kept = sorted(out.iterdir())
    for folder in (tmp_path / "fresh", out):  # the cloud comes first
        words = ("export", result, "pcd", "log", "stl", "--out", folder)
        refuses(capsys, *words, says="mesh.ply: doesn't exist")
    assert not (tmp_path / "fresh").exists()
    assert sorted(out.iterdir()) == kept
    refuses(capsys, "export", tmp_path, "las", says="is not a result")
    refuses(capsys, "export", result, "doc", says="use one of")


def test_only_one_process_writes_to_a_result(result: Path, tmp_path: Path) -> None:
    with OutputFolder(result, overwrite=True):
        with pytest.raises(OutputError, match="is being written by another process"):
            export(result, ["kitti"])
        assert export(result, ["kitti"], tmp_path / "other")[0].exists()  # the old result
    seen: list[OutputError] = []

    def during(_result: object, _path: Path) -> None:
        with pytest.raises(OutputError, match="is being written by another process") as caught:
            OutputFolder(result, overwrite=True)
        seen.append(caught.value)

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(FORMATS, "log", ("trajectory.log", during))
        export(result, ["log"])
    assert len(seen) == 1
    assert not list(result.parent.glob(".tofuse-*"))


def test_result_replaced_during_export_is_refused(result: Path, tmp_path: Path) -> None:
    def during(_result: object, _path: Path) -> None:
        os.utime(result / "run.json", ns=(1, 1))

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(FORMATS, "log", ("trajectory.log", during))
        with pytest.raises(InputError, match="was replaced by another run while it was read"):
            export(result, ["log"], tmp_path / "other")
