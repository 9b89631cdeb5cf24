"""Real recordings open without options, and their points match the vectors in the data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tofuse.apps.inspection.inspect import inspect_recording
from tofuse.engine.cameras.cameras import Pinhole, RayTable
from tofuse.engine.frames.frames import CloudFrame, RangeFrame
from tofuse.engine.frames.recording import Recording
from tofuse.engine.geometry.se3 import inverse, transform
from tofuse.formats.recordings.open import open_recording


def sr4000_blocks(path: Path) -> list[np.ndarray]:
    """Parse the export literally."""
    blocks: list[list[list[float]]] = []
    for line in path.read_text().splitlines():
        if line.startswith("%"):
            blocks.append([])
        else:
            blocks[-1].append([float(w) for w in line.split()])
    return [np.array(b) for b in blocks]


def overlap(recording: Recording, a: int, b: int, T_a_b: np.ndarray, near: float) -> float:
    """Fraction of points of frame b that are near points of frame a."""
    tree = cKDTree(recording[a].points)
    return float((tree.query(transform(T_a_b, recording[b].points[::20]))[0] < near).mean())


def test_sr4000_corridor(shared_data: Path) -> None:
    recording = open_recording(shared_data / "sr4000_corridor")
    assert (recording.format, len(recording)) == ("sr4000", 8)
    assert (np.diff(recording.timestamps) > 0.02).all()
    boxes = []
    for k, frame in enumerate(recording):
        assert isinstance(frame.camera, RayTable)
        station, number = divmod(k, 4)
        path = shared_data / "sr4000_corridor" / f"Y{station + 1}" / f"frm_{number + 1:04d}.dat"
        z, x, y, amplitude, confidence, _ = sr4000_blocks(path)
        assert frame.valid.mean() > 0.99
        truth = np.stack([-x, -y, z], -1)[frame.valid]
        assert np.abs(frame.points - truth).max() < 0.001
        np.testing.assert_array_equal(frame.amplitude_image, amplitude)
        np.testing.assert_array_equal(frame.confidence_image, confidence)
        boxes.append(np.median(frame.z[42:64, 52:72]))
    # The second station stands 305 mm further along the optical axis.
    step = np.median(boxes[:4]) - np.median(boxes[4:])
    assert step == pytest.approx(0.305, abs=0.03)


def test_kinectv2_clouds_match_images(shared_data: Path) -> None:
    native = open_recording(shared_data / "kinectv2_loop" / "recording")
    clouds = open_recording(shared_data / "kinectv2_loop" / "pcd")
    assert (native.format, len(native)) == ("native", 17)
    assert (clouds.format, len(clouds)) == ("pcd", 2)
    assert clouds.reference is not None
    for k in range(2):
        image, cloud = native[k], clouds[k]
        assert isinstance(image, RangeFrame)
        assert isinstance(cloud.camera, Pinhole)
        np.testing.assert_array_equal(image.valid, cloud.valid)
        assert np.abs(image.points - cloud.points).max() < 0.001
        np.testing.assert_array_equal(image.color, cloud.color)
        assert cloud.camera.fx == pytest.approx(365.7449, abs=0.01)


@pytest.mark.nightly
def test_slam6d_scans(shared_data: Path) -> None:
    recording = open_recording(shared_data / "slam6d_scans")
    assert (recording.format, len(recording)) == ("slam6d", 3)
    assert recording.odometry is not None
    first = np.loadtxt(shared_data / "slam6d_scans" / "scan000.3d", max_rows=4) / 100
    frame = recording[0]
    assert isinstance(frame, CloudFrame)
    np.testing.assert_allclose(frame.points[:4], first * [1, -1, 1], atol=1e-6)
    for k in range(2):
        T = inverse(recording.odometry[k]) @ recording.odometry[k + 1]
        turned = T.copy()
        turned[:3, :3] = T[:3, :3].T
        with_pose = overlap(recording, k, k + 1, T, 0.1)
        assert with_pose > 0.75
        assert with_pose > overlap(recording, k, k + 1, np.eye(4), 0.1) + 0.1
        assert with_pose > overlap(recording, k, k + 1, turned, 0.1)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("name", "format_", "sensor"),
    [
        ("sr4000_corridor", "sr4000", "SR4000"),
        ("kinectv2_loop/recording", "native", None),
        ("kinectv2_loop/pcd", "pcd", None),
        ("sevenscenes_kitchen", "7scenes", "Kinect v1"),
        ("iphone_chair_3dscannerapp", "3dscannerapp", "iPhone"),
        ("iphone_stray", "stray", "iPhone"),
        ("iphone_record3d", "record3d", "iPhone"),
        ("azure_kinect_mkv", "azure-kinect", "Azure Kinect"),
        ("ifm_o3r", "ifm-o3r", "ifm O3R"),
        ("pico_zense_static", "zense", "Pico Zense"),
        ("open3d_rgbd5", "redwood", None),
        ("pcl_pairwise", "pcd", None),
        ("lidar_pair_gt", "ply", None),
        ("slam6d_scans", "slam6d", None),
    ],
)
def test_every_folder_opens_without_options_and_is_described(
    shared_data: Path, name: str, format_: str, sensor: str | None
) -> None:
    recording = open_recording(shared_data / name)
    assert recording.format == format_
    facts = inspect_recording(recording.select(end=3), quick=True).facts
    assert facts["format"] == format_
    if sensor is not None:
        assert sensor in facts["sensor"]
    # Metres: the typical depth is between a hand's breadth and a large hall.
    assert 0.2 < float(facts["depth"].rsplit(" ", 2)[1]) < 30
    if format_ not in ("ply", "slam6d"):
        assert facts["kind of depth"] == ("radial range" if format_ == "ifm-o3r" else "z")
