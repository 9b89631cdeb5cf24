"""What `tofuse.register` takes, and the accuracy that it states."""

from __future__ import annotations

import json
import re
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

import tofuse
from cli_calls import call
from registration_scenes import error, stone, turn
from tofuse.apps.pairs import pair_json, register_files
from tofuse.apps.pairs.views import view_of
from tofuse.engine.errors import InputError
from tofuse.engine.fusion import Cloud, GeometryRecord, Mesh
from tofuse.engine.geometry import se3
from tofuse.formats.export import exchange
from tofuse.formats.geometry import read_ply, write_ply
from tofuse.lab.world import mesh as meshes

T_TRUE = turn([1, 2, 0.5], 5)


def bench(step_m: float = 0.6) -> GeometryRecord:
    """A bench without symmetry: three boxes, of few large triangles."""
    made = meshes.joined(
        [
            meshes.box((0.9, 0.4, 0.05), (0, 0, 2.0)),
            meshes.box((0.1, step_m, 0.5), (-0.3, 0.1, 2.25)),
            meshes.box((0.2, 0.1, 0.3), (0.35, -0.1, 1.85)),
        ]
    )
    return GeometryRecord(made.vertices, made.faces.astype(np.int32))


def seen(record: GeometryRecord) -> Mesh:
    """The mesh in the frame of the source."""
    moved = se3.transform(se3.inverse(T_TRUE), record.points.astype(float))
    return Mesh.of(GeometryRecord(moved.astype(np.float32), record.faces))


def near(found) -> None:
    metres, degrees = error(found, T_TRUE)
    assert metres < 0.005
    assert degrees < 0.5


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".glb"])
def test_mesh_files_are_sampled_over_their_area(suffix, tmp_path) -> None:
    """Of the few vertices of a bench no pose could be estimated."""
    path = tmp_path / f"target{suffix}"
    exchange.save(bench(), path, np.eye(3))
    near(tofuse.register(seen(bench()), path, guess=np.eye(4)))
    near(tofuse.register(seen(bench()), str(path), guess=np.eye(4)))
    twice = view_of(path, "source", 2.0).points
    np.testing.assert_allclose(twice, 2 * view_of(path, "source").points, rtol=1e-6)


def test_meshes_clouds_and_frames_are_taken() -> None:
    near(tofuse.register(seen(bench()), Mesh.of(bench()), guess=np.eye(4)))
    source, target = stone(3000, 1), stone(3000, 0)
    cloud = Cloud(target.astype(np.float32), None, None, np.ones(3000, np.int32))
    by_array = tofuse.register(source, target)
    for view in (cloud, SimpleNamespace(points=target)):  # the other is as one of Open3D
        by_cloud = tofuse.register(source, view)
        np.testing.assert_array_equal(by_array.T_target_source, by_cloud.T_target_source)


def test_result_is_its_cloud(room_result, capfd) -> None:
    result = tofuse.load(room_result)
    T = turn([0, 1, 0], 10) @ se3.exp([0.1, 0, 0, 0, 0, 0])
    source = se3.transform(se3.inverse(T), result.cloud.points.astype(float))
    found = tofuse.register(source, result)
    assert found.believed
    np.testing.assert_allclose(found.T_target_source, T, atol=2e-3)
    of_folder = tofuse.register(source, room_result)
    np.testing.assert_array_equal(of_folder.T_target_source, found.T_target_source)
    assert call("register", room_result, room_result / "cloud.ply", "--json") == 0
    data = json.loads(capfd.readouterr().out)
    assert data["source"]["format"] == "result"
    np.testing.assert_allclose(data["T_target_source"], np.eye(4), atol=1e-3)


@pytest.mark.parametrize("method", ["icp", "ndt"])
def test_methods_have_names(method, tmp_path, capfd) -> None:
    for name, seed in (("source", 1), ("target", 0)):
        write_ply(tmp_path / f"{name}.ply", GeometryRecord(stone(1500, seed)))
    words = ("register", tmp_path / "source.ply", tmp_path / "target.ply")
    assert call(*words, "--method", method, "--json") == 3  # can't be verified
    of_command = json.loads(capfd.readouterr().out)
    found = tofuse.register(words[1], words[2], method=method)
    np.testing.assert_array_equal(of_command["T_target_source"], found.T_target_source)
    assert call(*words, "--method", "ecp") == 2
    assert "method: is 'ecp'; use one of any-pair, cicp, coarse-to-fine" in capfd.readouterr().err
    assert call(*words, "--method", "features") == 2
    assert "method: features takes no cloud views" in capfd.readouterr().err


def test_accuracy_is_that_of_the_command(tmp_path, capfd) -> None:
    """Also in map coordinates, about a point of the source."""
    source = se3.transform(se3.inverse(T_TRUE), stone(3000, 1, noise=0.002))
    target, far = stone(3000, 0, noise=0.002), np.array([500_000.0, 4_000_000.0, 100.0])
    stated = []
    for shift in (np.zeros(3), far):
        for name, points in (("source", source), ("target", target)):
            write_ply(tmp_path / f"{name}.ply", GeometryRecord(points + shift))
        found = tofuse.register(source + shift, target + shift)
        words = ("register", tmp_path / "source.ply", tmp_path / "target.ply", "--json")
        assert call(*words) == 0
        data = json.loads(capfd.readouterr().out)
        np.testing.assert_allclose(found.covariance.ravel(), data["covariance"], rtol=1e-6)
        np.testing.assert_allclose(found.sigma, (data["sigma_m"], data["sigma_rad"]), rtol=1e-6)
        np.testing.assert_allclose(found.reference_point, data["reference_point_m"])
        np.testing.assert_allclose(found.covariance @ found.information, np.eye(6), atol=1e-6)
        stated.append(found.sigma)
        assert 1e-6 < found.sigma[0] < 0.01
        assert 1e-6 < found.sigma[1] < 0.01
    np.testing.assert_allclose(stated[0], stated[1], rtol=10)


def test_unbounded_accuracy_is_none() -> None:
    xy = np.random.default_rng(0).uniform(-1, 1, (2, 4000, 2))
    walls = [np.column_stack([p, np.full(4000, 2.0)]) for p in xy]
    found = tofuse.register(*walls, guess=np.eye(4))
    assert len(found.unobservable) == 3
    assert found.covariance is None
    assert 0 < found.sigma[0] < 0.01


@pytest.mark.nightly_part
def test_command_writes_the_scale(tmp_path, capfd) -> None:
    source, target = stone(3000, 1, 0.001), stone(3000, 0, 0.001)
    for name, points in (("source", 3 * source), ("target", target)):
        write_ply(tmp_path / f"{name}.ply", GeometryRecord(points))
    words = ("register", tmp_path / "source.ply", tmp_path / "target.ply", "--scale")
    call(*words, "--out", tmp_path / "out")
    assert re.search(r"scale +0\.333\d* ± ", capfd.readouterr().out)
    data = json.loads((tmp_path / "out" / "registration.json").read_text())
    assert data["scale"] == pytest.approx(1 / 3, rel=0.003)
    assert 0 < data["scale_sigma"] < 0.003
    similarity = np.loadtxt(tmp_path / "out" / "transform.txt")
    moved = 3 * source @ similarity[:3, :3].T + similarity[:3, 3]
    np.testing.assert_allclose(moved, source, atol=0.02)
    aligned = read_ply(tmp_path / "out" / "aligned.ply").points
    np.testing.assert_allclose(aligned, moved, atol=1e-5)


def test_known_factor_of_the_unit_is_exact(tmp_path, capfd) -> None:
    target = stone(3000, 0)
    source = se3.transform(se3.inverse(T_TRUE), stone(3000, 1))
    for name, points in (("source", 1000 * source), ("target", target)):
        write_ply(tmp_path / f"{name}.ply", GeometryRecord(points.astype(np.float32)))
    words = ("register", tmp_path / "source.ply", tmp_path / "target.ply")
    # The message names the option that makes the pair fit.
    assert call(*words) == 3
    says = r"check its unit; the source at that scale \(--factor (\S+);"
    factor = re.search(says, capfd.readouterr().out)[1]
    assert call(*words, "--factor", factor, "--out", tmp_path / "pair") == 0
    assert "0.001, factor of the source's points" in capfd.readouterr().out
    moved = se3.transform(np.loadtxt(tmp_path / "pair" / "transform.txt"), 1000 * source)
    np.testing.assert_allclose(moved, se3.transform(T_TRUE, source), atol=0.005)
    found = tofuse.register(1000 * source, target, scale=0.001)
    assert found.believed
    near(found)
    assert (found.scale, found.scale_sigma) == (0.001, 0.0)
    # It is known, so a guess may be as well.
    near(tofuse.register(1000 * source, target, scale=0.001, guess=T_TRUE))
    assert call(*words, "--factor", "0.001", "--scale") == 2
    assert "exclusive" in capfd.readouterr().err
    with pytest.raises(InputError, match="scale"):
        tofuse.register(source, target, scale=-1.0)
    unscaled = tofuse.register(source, target, scale=np.False_)  # of NumPy: no factor
    assert unscaled.scale_sigma is None


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_mesh_formats_may_hold_a_cloud(suffix, tmp_path) -> None:
    trimesh = pytest.importorskip("trimesh")
    target = stone(3000, 0)
    path = tmp_path / f"cloud{suffix}"
    if suffix == ".obj":
        path.write_text("".join(f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in target))
    else:
        trimesh.Scene(trimesh.PointCloud(target)).export(path)
    source = se3.transform(se3.inverse(T_TRUE), stone(3000, 1))
    near(tofuse.register(source, path, guess=np.eye(4)))


def test_large_clouds_may_be_in_mm(tmp_path, capfd) -> None:
    for name, seed in (("source", 1), ("target", 0)):
        for factor, unit in ((1, "m"), (1000, "mm")):
            points = factor * stone(1000, seed, 0.001)
            write_ply(tmp_path / f"{name}-{unit}.ply", GeometryRecord(points))
    for unit, says in (("m", False), ("mm", True)):
        call("register", tmp_path / f"source-{unit}.ply", tmp_path / f"target-{unit}.ply")
        assert ("if the files are in mm" in capfd.readouterr().out) == says


def test_unit_does_not_matter() -> None:
    metres, large = (
        tofuse.register(scale * stone(3000, 1), scale * stone(3000, 0)) for scale in (1.0, 1e6)
    )
    assert metres.believed
    assert large.believed
    moved = large.T_target_source.copy()
    moved[:3, 3] /= 1e6
    assert error(metres, moved)[0] < 0.01


@pytest.mark.parametrize(
    ("view", "says"),
    [
        ({"a": 1}, "source: is a dict; pass a frame"),
        ("none.ply", "none.ply: doesn't exist"),
        (Mesh.of(GeometryRecord(np.zeros((20, 3)), np.zeros((4, 3), np.int32))), "without area"),
        (Mesh.of(GeometryRecord(np.eye(3))), "source: has 3 finite points; use 10 or more"),
    ],
)
def test_other_things_are_refused(view, says, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(tofuse.InputError) as raised:
        tofuse.register(view, stone(1500, 0))
    assert says in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".glb", ".ply"])
def test_damaged_meshes_are_refused(suffix, tmp_path) -> None:
    path = tmp_path / f"bad{suffix}"
    path.write_bytes(b"ply\nformat ascii 1.0\nelement face 3\nend_header\n" + b"\xff" * 40)
    with pytest.raises(tofuse.InputError) as raised:
        tofuse.register(path, stone(1500, 0))
    assert str(raised.value).startswith(str(path))
    assert "\n" not in str(raised.value)


def test_pose_is_accepted_at_a_stated_risk() -> None:
    source, target = stone(3000, 1), stone(3000, 0)
    found = tofuse.register(source, target)
    assert found.believed
    assert 0.9 <= found.probability < 1
    wrong = 1 - found.probability
    assert tofuse.register(source, target, risk=1.01 * wrong).believed
    rejected = tofuse.register(source, target, risk=0.99 * wrong)
    assert not rejected.believed
    assert "above the accepted" in rejected.reason
    np.testing.assert_array_equal(rejected.T_target_source, found.T_target_source)
    with pytest.raises(tofuse.TofuseError, match=r"risk: is 0\.2"):
        tofuse.register(source, target, risk=0.2)


def test_warning_of_a_recording_is_stated_once_for_both_frames(room_recording, tmp_path) -> None:
    shutil.copytree(room_recording, tmp_path / "room")
    path = tmp_path / "room" / "camera.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"colour_of_case": "grey"}))
    found = pair_json(register_files(f"{path.parent}#1", f"{path.parent}#0"))
    assert len(found["warnings"]) == 1
    assert "colour_of_case" in found["warnings"][0]
