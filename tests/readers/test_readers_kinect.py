"""Azure Kinect: containers written here, a real capture, and OpenCV's lens model as the oracle."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import made_kinect as made
from refused import refused
from tofuse.engine.cameras.cameras import Pinhole, RayTable
from tofuse.engine.geometry.rays import homogeneous
from tofuse.formats.cameras.camera_file import ColorCamera
from tofuse.formats.recordings.open import open_recording
from written import camera_json

SIZES = {
    "NFOV_2X2BINNED": (320, 288, 512, 96, 90),
    "NFOV_UNBINNED": (640, 576, 1024, 192, 180),
    "WFOV_2X2BINNED": (512, 512, 512, 0, 0),
    "WFOV_UNBINNED": (1024, 1024, 1024, 0, 0),
}


def opencv_lens(mode: str, lens: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """K and distortion in OpenCV's order, by the definition of the calibration."""
    _, _, whole, left, top = SIZES[mode]
    cx, cy, fx, fy, *k = lens
    center = (cx * whole - left - 0.5, cy * whole - top - 0.5)
    K = np.array([[fx * whole, 0, center[0]], [0, fy * whole, center[1]], [0, 0, 1]])
    return K, np.array([k[0], k[1], k[9], k[8], k[2], k[3], k[4], k[5]])


@pytest.mark.nightly
@pytest.mark.parametrize("mode", SIZES)
def test_rays_match_opencv_in_every_mode(tmp_path: Path, mode: str) -> None:
    width, height, *_ = SIZES[mode]
    made.make_mkv(tmp_path / "a.mkv", np.full((1, height, width), 1500, np.uint16), mode=mode)
    frame = open_recording(tmp_path / "a.mkv")[0]
    K, distortion = opencv_lens(mode, made.DEPTH_LENS)
    v, u = np.mgrid[:height:17, :width:17]
    rays = frame.camera.rays()[v, u].astype(float)
    seen = np.isfinite(rays).all(-1)
    pixels = np.stack([u, v], -1)[seen].astype(float)
    # Both ways: our rays project to the pixels, and OpenCV's rays of the pixels equal ours.
    points = homogeneous(rays[seen])
    landed = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, distortion)[0][:, 0]
    assert np.abs(landed - pixels).max() < 1e-3
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-10)
    undistort = getattr(cv2, "undistortPointsIter", None)
    near = np.hypot(*rays[seen].T) < 0.8  # where OpenCV's fixed point iteration converges
    args = (pixels[near][:, None], K, distortion)
    if undistort is not None:
        expected = undistort(*args, None, None, stop)
    else:
        expected = cv2.undistortPoints(*args, criteria=stop)
    error = (expected[:, 0] - rays[seen][near]) * (K[0, 0], K[1, 1])
    assert np.abs(error).max() < 0.1
    # The corners of the wide modes are outside the valid range of the calibration.
    share = np.isfinite(frame.camera.rays()).all(-1).mean()
    assert share == 1 if mode.startswith("N") else 0.7 < share < 0.85
    assert np.hypot(*rays[seen].T).max() <= 1.74
    np.testing.assert_array_equal(frame.valid, np.isfinite(frame.camera.rays()).all(-1))
    np.testing.assert_allclose(frame.z[frame.valid], 1.5)


def test_images_timestamps_and_metadata(tmp_path: Path) -> None:
    depth = made.small_counts()
    made.make_mkv(tmp_path / "rec" / "a.mkv", depth, infrared=depth // 2)
    recording = open_recording(tmp_path / "rec")  # a folder that holds one
    np.testing.assert_allclose(recording.timestamps, 5 + 7e-6 + 0.033333 * np.arange(3))
    for k, frame in enumerate(recording):
        np.testing.assert_allclose(frame.z, depth[k] / 1000, atol=1e-6)
        np.testing.assert_array_equal(frame.amplitude_image, depth[k] // 2)
        assert frame.amplitude_kind == "ir"
    assert recording.metadata["sensor"] == "Azure Kinect (ToF)"
    assert recording.metadata["depth_mode"] == "NFOV_2X2BINNED"
    assert recording.metadata["frame_rate_hz"] == pytest.approx(30, abs=0.01)
    assert recording.warnings == []


def test_unknown_sizes_and_missing_mode(tmp_path: Path) -> None:
    depth = made.small_counts()
    made.make_mkv(tmp_path / "a.mkv", depth, mode=None, unknown_sizes=True)
    recording = open_recording(tmp_path / "a.mkv")
    assert len(recording) == 3
    assert recording.metadata["depth_mode"] == "NFOV_2X2BINNED"
    for k, frame in enumerate(recording):
        np.testing.assert_allclose(frame.z, depth[k] / 1000, atol=1e-6)


def test_color_is_registered_and_occluded_points_have_none(tmp_path: Path) -> None:
    """A near strip occludes, in the colour camera, points that the depth camera sees next to it."""
    depth = np.full((1, 288, 320), 2000, np.uint16)
    depth[:, :, 150:170] = 500
    v, u = np.mgrid[:720, :1280]
    color = np.stack([u // 8, v // 4, 200 + 0 * u], -1)[None].astype(np.uint8)
    made.make_mkv(tmp_path / "a.mkv", depth, color=color)
    frame = open_recording(tmp_path / "a.mkv")[0]
    assert frame.color_image is not None
    points = frame.point_image.reshape(-1, 3).astype(float)
    cx, cy, fx, fy, *_ = made.COLOR_LENS
    K = np.array([[fx * 1280, 0, cx * 1280 - 0.5], [0, fy * 960, cy * 960 - 120.5], [0, 0, 1]])
    _, distortion = opencv_lens("NFOV_UNBINNED", made.COLOR_LENS)
    uv = cv2.projectPoints(points, np.zeros(3), np.array(made.BASELINE), K, distortion)[0]
    uv = uv.reshape(288, 320, 2)
    seen = frame.color_image[..., 2] > 150
    inside = (uv > -0.51).all(-1) & (uv < (1279.51, 719.51)).all(-1)
    assert not seen[~inside].any()
    expected = np.stack([uv[..., 0] / 8, uv[..., 1] / 4], -1)[seen]
    assert np.abs(frame.color_image[..., :2][seen] - expected).max() < 5
    # 32 mm to the right, the colour camera sees behind the strip's right side, not its left.
    rows = slice(100, 180)
    assert seen[rows, 150:170].all()
    assert not seen[rows, 140:148].any()
    assert seen[rows, 175:200].all()
    assert seen[inside].mean() > 0.85


def test_older_tangential_form(tmp_path: Path) -> None:
    lens = made.calibration("Rational6KT")
    cameras = lens["CalibrationInformation"]["Cameras"]
    cameras[0]["Intrinsics"]["ModelParameters"] = [*made.DEPTH_LENS[:12], 2e-3, 1e-3]
    made.make_mkv(tmp_path / "a.mkv", made.small_counts(1), lens=lens)
    frame = open_recording(tmp_path / "a.mkv")[0]
    assert isinstance(frame.camera, RayTable)
    K, _ = opencv_lens("NFOV_2X2BINNED", made.DEPTH_LENS)
    k1, k2, k3, k4, k5, k6 = made.DEPTH_LENS[4:10]
    x, y = np.moveaxis(frame.camera.rays().astype(float), -1, 0)
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    p2, p1 = 2e-3, 1e-3
    u = K[0, 0] * (x * radial + (r2 + 2 * x * x) * p2 + x * y * p1) + K[0, 2]
    v = K[1, 1] * (y * radial + (r2 + 2 * y * y) * p1 + x * y * p2) + K[1, 2]
    rows, columns = np.mgrid[:288, :320]
    assert np.abs(u - columns).max() < 1e-3
    assert np.abs(v - rows).max() < 1e-3


def test_missing_tracks_and_calibration_are_named(tmp_path: Path) -> None:
    depth = made.small_counts(2)
    path = tmp_path / "a.mkv"
    made.make_mkv(path, depth, infrared=depth, without="DEPTH")
    refused("only infrared", path)
    made.make_mkv(path, depth, without="calibration")
    refused(r"calibration\.json: is missing; pass .* with camera=camera\.json", path)
    camera = camera_json(tmp_path / "camera.json", Pinhole(320, 288, 250, 250, 160, 144))
    assert len(open_recording(path, camera=camera)[0]) > 1000
    made.make_mkv(path, depth[:, :100])
    refused("320 x 100 pixels, of no known mode", path)


def test_real_capture(shared_data: Path) -> None:
    folder = shared_data / "azure_kinect_mkv"
    recording = open_recording(folder)
    assert (recording.format, len(recording)) == ("azure-kinect", 1)
    assert recording.metadata["depth_mode"] == "NFOV_UNBINNED"
    frame = recording[0]
    assert frame.depth.shape == (576, 640)
    # The attachment equals the file beside it, with whose lens OpenCV projects.
    data = json.loads((folder / "calibration.json").read_text())
    parameters = data["CalibrationInformation"]["Cameras"][0]["Intrinsics"]["ModelParameters"]
    K, distortion = opencv_lens("NFOV_UNBINNED", parameters)
    points = frame.points[::50].astype(float)
    landed = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, distortion)[0][:, 0]
    rows, columns = np.nonzero(frame.valid)
    assert np.abs(landed - np.stack([columns, rows], -1)[::50]).max() < 1e-2
    # The back wall is flat, which it would not be with a wrong lens.
    wall = frame.point_image[395:450:2, 420:560:2].reshape(-1, 3).astype(float)
    wall = wall[wall[:, 2] > 0]
    normal = np.linalg.svd(wall - wall.mean(0), full_matrices=False)[2][2]
    assert np.abs((wall - wall.mean(0)) @ normal).mean() < 0.006
    # Most pixels have colour.
    assert isinstance(recording.source.color_camera, ColorCamera)
    assert frame.color_image[frame.valid].any(-1).mean() > 0.85
