"""Images with poses for nerfstudio and COLMAP, by an independent reading of their conventions.

nerfstudio and COLMAP have the corner of the first pixel at (0, 0), so its centre at (0.5, 0.5).
nerfstudio's cameras look along -z with y up.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from cli_calls import refuses
from posed_results import BROWN, DISTANCE, NORMAL, POSED, POSES, SIZE, made_result, plane
from refused import refused
from tofuse.apps.export.exporting import export
from tofuse.apps.results.run_json import read_run_json
from tofuse.engine.cameras.cameras import BrownConrady, Camera, Fisheye, Pinhole, Rational, RayTable
from tofuse.engine.errors import OutputError
from tofuse.engine.geometry.rays import homogeneous
from tofuse.formats.geometry.ply import read_ply
from tofuse.formats.poses.trajectory import read_tum, write_tum
from tofuse.formats.poses.trajectory_formats import read_poses
from tofuse.formats.readers.native import NativeSource
from written_run_json import change_run

PLAIN = Pinhole(*SIZE, 40.0, 41.0, 23.0, 18.0)
BENT = BrownConrady(*SIZE, 40.0, 41.0, 23.0, 18.0, k1=-0.1, k2=0.02, k3=0.01)
RATIO = Rational(*SIZE, 40.0, 41.0, 23.0, 18.0, k1=0.2, k2=-0.1, k4=0.3, k5=-0.1)
WIDE = Fisheye(*SIZE, 30.0, 30.0, 23.0, 18.0, k1=0.02, k2=-0.003)
TABLE = RayTable(np.array(BROWN.rays()))


def opencv_rays(data: dict[str, float]) -> np.ndarray:
    """x/z and y/z (H, W, 2) of a lens by OpenCV, from the numbers in transforms.json."""
    w, h = int(data["w"]), int(data["h"])
    K = np.array([[data["fl_x"], 0, data["cx"]], [0, data["fl_y"], data["cy"]], [0, 0, 1]])
    v, u = np.mgrid[0:h, 0:w] + 0.5
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
    if data["camera_model"] == "OPENCV_FISHEYE":
        bent = np.array([data.get(f"k{i}", 0.0) for i in (1, 2, 3, 4)])
        rays = cv2.fisheye.undistortPoints(pixels, K, bent)
    else:
        assert data["camera_model"] == "OPENCV"
        bent = np.array([data.get(n, 0.0) for n in ("k1", "k2", "p1", "p2", "k3")])
        ends = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
        rays = cv2.undistortPoints(pixels, K, bent, criteria=ends)
    return rays.reshape(h, w, 2)


@pytest.mark.parametrize("camera", [PLAIN, BROWN, BENT, WIDE, RATIO, TABLE])
def test_nerfstudio_depth_and_poses_reproduce_points(tmp_path: Path, camera: Camera) -> None:
    result = made_result(tmp_path, camera)
    (folder,) = export(result, ["nerfstudio"])
    data = json.loads((folder / "transforms.json").read_text())
    kept = camera in (PLAIN, BROWN, BENT, WIDE)
    assert len(data["frames"]) == len(POSED)
    for k, frame in zip(POSED, data["frames"], strict=True):
        depth, sigma = (
            cv2.imread(str(folder / frame[f"{kind}_file_path"]), cv2.IMREAD_UNCHANGED)
            for kind in ("depth", "sigma")
        )
        assert depth.dtype == sigma.dtype == np.uint16
        z = depth * data["depth_unit_scale_factor"]
        T = np.array(frame["transform_matrix"])
        seen = z > 0
        assert seen.mean() > (0.9 if kept else 0.7)
        # From OpenGL's axes to the world; then the plane is where the camera measured it.
        local = homogeneous(opencv_rays(data)) * z[..., None] * [1, -1, -1]
        world = local[seen] @ T[:3, :3].T + T[:3, 3]
        camera_axes = (world - POSES[k, :3, 3]) @ POSES[k, :3, :3]
        off = np.abs(camera_axes @ NORMAL - DISTANCE - 0.1 * k)
        assert off.max() < (1.2e-3 if kept else 2e-3)  # depth in whole mm, rounded twice
        assert (sigma[seen] > 0).all()
        assert (sigma[~seen] == 0).all()
        assert np.median(sigma) * data["sigma_unit_scale_factor"] < 0.05
        image = cv2.imread(str(folder / frame["file_path"]))[..., ::-1]
        assert (image[image.any(-1)][:, 0] == 10 + k).all()
        assert frame["timestamp"] == pytest.approx(0.1 * k)
        covariance = frame.get("pose_covariance")
        assert (covariance is None) == (k == 1)
        if covariance is not None:
            np.testing.assert_array_equal(np.reshape(covariance, (6, 6)), np.eye(6) * k)
    if kept:
        np.testing.assert_array_equal(image[0, :, 1], np.arange(48))
    points = read_ply(folder / data["ply_file_path"])
    np.testing.assert_array_equal(points.points, read_ply(result / "cloud.ply").points)
    assert (points.color == 77).all()
    masked = [frame.get("mask_path") for frame in data["frames"]]
    assert len({path is None for path in masked}) == 1
    # Our own reader of trajectories agrees, too.
    np.testing.assert_allclose(read_poses(folder).poses, POSES[POSED], atol=1e-9)


def test_colmap_text_files(tmp_path: Path) -> None:
    """The text files, for machines without pycolmap."""
    (folder,) = export(made_result(tmp_path, BROWN), ["colmap"], every=2)
    text = (folder / "sparse" / "0" / "cameras.txt").read_text().splitlines()[1]
    assert text == "1 OPENCV 48 36 40.0 41.0 23.5 18.5 -0.1 0.02 0.002 -0.001"
    lines = (folder / "sparse" / "0" / "images.txt").read_text().split("\n")
    assert [line.split()[-1] for line in lines[1:-1:2]] == ["frame_000000.png", "frame_000003.png"]
    assert lines[2] == ""
    found = read_poses(folder / "sparse" / "0" / "images.txt")
    np.testing.assert_allclose(found.poses, POSES[[0, 3]], atol=1e-9)
    names = ["frame_000000.png", "frame_000003.png"]
    assert sorted(p.name for p in (folder / "images").iterdir()) == names


def test_colour_keeps_its_recorded_resolution(tmp_path: Path, monkeypatch) -> None:
    full = np.random.default_rng(6).integers(1, 255, (72, 96, 3)).astype(np.uint8)
    monkeypatch.setattr(NativeSource, "full_resolution_color", lambda _self, _index: full)
    (folder,) = export(made_result(tmp_path, PLAIN), ["nerfstudio"])
    data = json.loads((folder / "transforms.json").read_text())
    assert [data[name] for name in ("w", "h", "fl_x", "cx")] == [96, 72, 80.0, 47.0]
    frame = data["frames"][1]
    np.testing.assert_array_equal(cv2.imread(str(folder / frame["file_path"]))[..., ::-1], full)
    assert cv2.imread(str(folder / frame["depth_file_path"]), -1).shape == (36, 48)


def test_corrected_camera_is_written(tmp_path: Path) -> None:
    config = {"corrections": [{"part": "camera-errors", "focal": 0.05, "offset_m": 0.1}]}
    (folder,) = export(made_result(tmp_path, PLAIN, config=config), ["nerfstudio"])
    data = json.loads((folder / "transforms.json").read_text())
    assert data["fl_x"] == pytest.approx(40.0 / 1.05)
    z = cv2.imread(str(folder / data["frames"][0]["depth_file_path"]), cv2.IMREAD_UNCHANGED)
    assert z[18, 23] == pytest.approx(1000 * plane(PLAIN, 0)[18, 23] + 100, abs=1)


def _nearer(result: Path) -> list[dict[str, object]]:
    frames = read_run_json(result / "run.json")["frames"]
    return [frame | {"mean_depth_m": 0.123} for frame in frames]


def _longer(result: Path) -> None:
    frames = read_run_json(result / "run.json")["frames"]
    times, poses = read_tum(result / "trajectory.txt")
    write_tum(result / "trajectory.txt", times + 1.0, poses)
    change_run(result, frames=[frame | {"timestamp": frame["timestamp"] + 1.0} for frame in frames])


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda result: shutil.rmtree(result.parent / "scan"), "which doesn't exist"),
        (_longer, "does not match the frames"),
        (lambda result: change_run(result, frames=_nearer(result)), "frame 0, which has changed"),
        (lambda result: change_run(result, input=None), "is damaged"),
        (lambda result: change_run(result, config={"corrections": [3]}), "is damaged"),
    ],
    ids=["gone", "longer", "other image", "no input", "invalid corrections"],
)
def test_impossible_exports_are_refused(tmp_path, spoil, says, capsys) -> None:
    result = made_result(tmp_path, PLAIN)
    spoil(result)
    for name in ("nerfstudio", "colmap"):
        refuses(capsys, "export", result, name, says=says)
    assert sorted(p.name for p in result.iterdir()) == ["cloud.ply", "run.json", "trajectory.txt"]


def test_only_own_folders_are_replaced(tmp_path: Path) -> None:
    result = made_result(tmp_path, PLAIN)
    (folder,) = export(result, ["colmap"])
    refused("pass overwrite", result, ["colmap"], by=export, error=OutputError)
    (folder / "images" / "frame_000001.png").unlink()
    export(result, ["colmap"], overwrite=True)
    assert (folder / "images" / "frame_000001.png").is_file()
    (folder / "trained.ckpt").write_text("mine")
    with pytest.raises(OutputError, match=r"contains trained\.ckpt"):
        export(result, ["colmap"], overwrite=True)
    assert (folder / "trained.ckpt").read_text() == "mine"
    assert not [p for p in result.iterdir() if p.name.startswith(".")]
