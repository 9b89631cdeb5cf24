"""Phones: exports of the apps, generated and real."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import made_phones as made
from phone_checks import check_frames, check_lens
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.quality.map_agreement import map_consistency
from tofuse.formats.recordings.open import open_recording


def test_scanner_app(tmp_path: Path) -> None:
    made.make_scanner_app(tmp_path / "scan")
    recording = open_recording(tmp_path / "scan")
    assert recording.format == "3dscannerapp"
    np.testing.assert_allclose(recording.timestamps, [1000.5, 1000.7, 1000.9])
    check_frames(recording)
    for k, frame in enumerate(recording):
        check_lens(frame, made.FX + k, made.CX, made.CY)
        assert (frame.color_image is not None) == (k == 1)
    assert recording.warnings == ["only 1 of 3 frames have colour"]


def test_scanner_app_derives_image_size_from_projection(tmp_path: Path) -> None:
    made.make_scanner_app(tmp_path / "scan")
    for path in (tmp_path / "scan").glob("frame_*.json"):
        facts = json.loads(path.read_text())
        facts["intrinsics"] = [v / 2 for v in facts["intrinsics"]]
        facts["projectionMatrix"] = np.diag([2 * made.FX / 1920, 2 * made.FX / 1440, -1, 0])
        facts["projectionMatrix"] = facts["projectionMatrix"].ravel().tolist()
        path.write_text(json.dumps(facts))
    frame = open_recording(tmp_path / "scan")[0]
    assert isinstance(frame.camera, Pinhole)
    assert frame.camera.fx == pytest.approx(made.FX / 60)


def test_stray(tmp_path: Path) -> None:
    made.make_stray(tmp_path / "scan")
    recording = open_recording(tmp_path / "scan")
    assert recording.format == "stray"
    np.testing.assert_allclose(recording.timestamps, 100 + np.arange(3) / 60)
    check_frames(recording)
    assert recording.warnings == ["rgb.mp4 is missing: there is no colour"]
    frame = recording[0]
    assert isinstance(frame, RangeFrame)
    check_lens(frame, made.FX, made.CX, made.CY)
    # x of the camera is y of the phone, and z is reversed.
    imu = recording.source.imu
    assert [imu[name].tolist() for name in ("ax", "ay", "az", "wz")] == [[-9.8], [0], [0], [-0.5]]
    assert recording.gravity is not None  # but there are no samples at the times of the frames
    assert not np.isfinite(recording.gravity).any()


def test_stray_with_video_and_lens_of_each_frame(tmp_path: Path) -> None:
    made.make_stray(tmp_path / "scan", lenses=True)
    size = (320, 240)
    path = str(tmp_path / "scan" / "rgb.mp4")
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"mp4v"), 60, size)
    if not writer.isOpened():
        pytest.skip("OpenCV writes no video here")
    for k in range(3):
        writer.write(np.ascontiguousarray(made.color_image(k, *size)[..., ::-1]))
    writer.release()
    recording = open_recording(tmp_path / "scan")
    check_frames(recording)
    for k in (2, 0, 1):  # in any order
        frame = recording[k]
        assert abs(int(frame.color_image[5, 5, 0]) - (100 + 40 * k)) < 12
        assert isinstance(frame.camera, Pinhole)
        assert frame.camera.fx == pytest.approx((made.FX + k) * made.WIDTH / 320)
    assert recording.warnings == []
    data = Path(path).read_bytes()
    Path(path).write_bytes(data[: len(data) // 2])
    assert any("colour is ignored" in line for line in open_recording(tmp_path / "scan").warnings)


def test_record3d_folder(tmp_path: Path) -> None:
    made.make_record3d(tmp_path / "scan")
    recording = open_recording(tmp_path / "scan")
    assert recording.format == "record3d"
    np.testing.assert_allclose(recording.timestamps, np.arange(3) / 60)
    check_frames(recording, turned=True, exact=2e-3)  # half floats
    frame = recording[0]
    assert isinstance(frame, RangeFrame)
    check_lens(frame, made.FX, made.CY, made.CX)


def test_r3d_archive(tmp_path: Path) -> None:
    made.make_r3d(tmp_path / "scan.r3d")
    recording = open_recording(tmp_path / "scan.r3d")
    assert recording.format == "record3d"
    check_frames(recording, turned=True, exact=0)
    assert recording[1].color is not None
    whole = (tmp_path / "scan.r3d").read_bytes()
    (tmp_path / "scan.r3d").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="damaged archive"):
        open_recording(tmp_path / "scan.r3d")


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("name", "format_", "count", "size", "every", "others"),
    [
        ("iphone_chair_3dscannerapp", "3dscannerapp", 70, (256, 192), 10, 0.65),
        ("iphone_stray", "stray", 200, (256, 192), 33, 0.6),
        ("iphone_record3d", "record3d", 30, (192, 256), 9, 0.96),
    ],
)
def test_real_recordings_agree_with_their_own_poses(
    shared_data: Path,
    name: str,
    format_: str,
    count: int,
    size: tuple[int, int],
    every: int,
    others: float,
) -> None:
    recording = open_recording(shared_data / name)
    assert (recording.format, len(recording)) == (format_, count)
    assert recording.metadata["sensor"].startswith("iPhone")
    few = recording.select(every=every)
    frame = few[0]
    assert (frame.camera.width, frame.camera.height) == size
    poses = map_consistency(few, few.reference)
    still = map_consistency(few, np.tile(np.eye(4), (len(few), 1, 1)))
    mirrored = map_consistency(few, few.reference @ made.ARKIT)
    turn = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    turned = map_consistency(few, few.reference @ turn)
    assert poses.inlier_ratio > others
    for other in (still, mirrored, turned):
        # Under wrong poses the views overlap less, or are less consistent.
        assert 2 * other.pairs < poses.pairs or poses.rms_m < 0.85 * other.rms_m


def test_real_depth_is_registered_to_colour(shared_data: Path) -> None:
    """Edges of depth and colour correlate best without a shift."""
    recording = open_recording(shared_data / "iphone_chair_3dscannerapp")

    def edges(image: np.ndarray) -> np.ndarray:
        size = np.hypot(cv2.Sobel(image, -1, 1, 0), cv2.Sobel(image, -1, 0, 1))
        return np.minimum(size, np.percentile(size, 98))

    for k in (0, 27):
        frame = recording[k]
        depth = edges(np.log(frame.depth + 1))[10:-10, 10:-10]
        grey = edges(frame.color_image.mean(-1).astype(np.float32))
        scores = {
            (dx, dy): np.corrcoef(
                depth.ravel(), grey[10 + dy : 182 + dy, 10 + dx : 246 + dx].ravel()
            )[0, 1]
            for dx in range(-6, 7, 2)
            for dy in range(-6, 7, 2)
        }
        assert max(scores, key=lambda shift: scores[shift]) == (0, 0)
