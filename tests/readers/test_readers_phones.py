"""Phones: exports of the apps, generated and real."""

from __future__ import annotations

import json
import shutil
import struct
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

import made_phones as made
from phone_checks import check_frames
from refused import refused
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.engine.quality.map_agreement import map_consistency
from tofuse.formats.geometry.ply import write_ply
from tofuse.formats.images.images import write_png
from tofuse.formats.images.video import Video
from tofuse.formats.recordings.open import open_recording


def test_scanner_app_derives_image_size_from_projection(tmp_path: Path) -> None:
    made.make_scanner_app(tmp_path / "scan")
    for path in (tmp_path / "scan").glob("frame_*.json"):
        facts = json.loads(path.read_text())
        facts["intrinsics"] = [v / 2 for v in facts["intrinsics"]]
        facts["projectionMatrix"] = made.projection(made.FX).ravel().tolist()
        path.write_text(json.dumps(facts))
    frame = open_recording(tmp_path / "scan")[0]
    assert isinstance(frame.camera, Pinhole)
    assert frame.camera.fx == pytest.approx(made.FX / 60)


def test_scanner_app_without_metadata_says_what_is_missing(tmp_path: Path) -> None:
    made.make_scanner_app(tmp_path / "scan")
    for path in (tmp_path / "scan").glob("frame_*.json"):
        path.unlink()
    says = r"3 depth_\*\.png without frame_\*\.json; .*share 'All data' from 3d Scanner App again"
    refused(says, tmp_path / "scan")


def test_scanner_app_without_some_metadata(tmp_path: Path) -> None:
    """Times go on before the first known one, and after the last."""
    made.make_scanner_app(tmp_path / "scan")
    for k in (0, 1):
        facts = json.loads((tmp_path / "scan" / "frame_00002.json").read_text())
        facts["time"] = 10.0 + k
        (tmp_path / "scan" / f"frame_{k + 2:05d}.json").write_text(json.dumps(facts))
        (tmp_path / "scan" / f"frame_{k:05d}.json").unlink()
    for k in (3, 4):
        write_png(tmp_path / "scan" / f"depth_{k:05d}.png", made.millimetres(made.DEPTH[0]))
    np.testing.assert_allclose(open_recording(tmp_path / "scan").timestamps, [8, 9, 10, 11, 12])


def test_stray_has_gravity_of_the_phone(tmp_path: Path) -> None:
    """x of the camera is y of the phone, and z is reversed."""
    made.make_stray(tmp_path / "scan")
    recording = open_recording(tmp_path / "scan")
    imu = recording.source.imu
    assert [imu[name].tolist() for name in ("ax", "ay", "az", "wz")] == [[-9.8], [0], [0], [-0.5]]
    assert recording.gravity is not None  # but there are no samples at the times of the frames
    assert not np.isfinite(recording.gravity).any()


def test_stray_of_early_version(tmp_path: Path) -> None:
    made.make_stray(tmp_path / "scan")
    for k, path in enumerate(sorted((tmp_path / "scan" / "depth").iterdir())):
        path.unlink()
        np.save(path.with_suffix(".npy"), made.millimetres(made.DEPTH[k]))
    check_frames(open_recording(tmp_path / "scan"))


def test_stray_with_video_and_lens_of_each_frame(tmp_path: Path) -> None:
    """The video was downscaled; the lens remains that of the images of ARKit."""
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
        assert frame.camera.fx == pytest.approx((made.FX + k) * made.WIDTH / 1920)
    assert recording.warnings == []
    data = Path(path).read_bytes()
    Path(path).write_bytes(data[: len(data) // 2])
    assert any("colour is ignored" in line for line in open_recording(tmp_path / "scan").warnings)


@pytest.mark.parametrize("turn", [(-1, 0, 0, -1, 320, 240), (0, 1, -1, 0, 240, 0)])
def test_video_is_not_turned_as_it_states(tmp_path: Path, turn: tuple[int, ...]) -> None:
    """By 180 degrees colour would have the size of depth, and another view."""
    path = tmp_path / "rgb.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 60, (320, 240))
    if not writer.isOpened():
        pytest.skip("OpenCV writes no video here")
    image = np.zeros((240, 320, 3), np.uint8)
    image[:120] = 200
    writer.write(image)
    writer.release()
    data = bytearray(path.read_bytes())
    a, b, c, d, x, y = turn
    matrix = struct.pack(">9i", a << 16, b << 16, 0, c << 16, d << 16, 0, x << 16, y << 16, 1 << 30)
    start = data.index(b"tkhd") + 44  # of the matrix, in version 0 of the header of a track
    data[start : start + 36] = matrix
    path.write_bytes(data)
    read = Video(path).read(0)
    assert read.shape == image.shape
    np.testing.assert_allclose(read[::239, ::319], image[::239, ::319], atol=12)


def test_arkitscenes_with_bounding_boxes(tmp_path: Path) -> None:
    """In the layout of that subset, beside a mesh."""
    made.make_arkitscenes(tmp_path / "41048190" / "41048190_frames")
    write_ply(tmp_path / "41048190" / "41048190_3dod_mesh.ply", GeometryRecord(np.ones((3, 3))))
    recording = open_recording(tmp_path / "41048190")
    assert recording.format == "arkitscenes"
    check_frames(recording)


def test_unpacked_r3d_archive(tmp_path: Path) -> None:
    """Also renamed to .zip, as users do to look inside, and alone in a folder."""
    made.make_r3d(tmp_path / "one" / "scan.r3d")
    with zipfile.ZipFile(tmp_path / "one" / "scan.r3d") as archive:
        archive.extractall(tmp_path / "scan")
    shutil.copy(tmp_path / "one" / "scan.r3d", tmp_path / "scan.zip")
    for name in ("scan", "scan.zip", "one"):
        recording = open_recording(tmp_path / name)
        assert recording.format == "record3d"
        check_frames(recording, turned=True, exact=0)


@pytest.mark.parametrize("size", [(192, 256), (480, 640)], ids=["LiDAR", "TrueDepth"])
def test_r3d_of_old_version(tmp_path: Path, size: tuple[int, int]) -> None:
    """Without the size of depth, times and poses."""
    depth = np.full(size[::-1], 1.5, "<f4")
    facts = {"w": 480, "h": 640, "K": [580.0, 0, 0, 0, 580.0, 0, 239.5, 319.5, 1], "fps": 30}
    with zipfile.ZipFile(tmp_path / "a.r3d", "w") as archive:
        archive.writestr("metadata", json.dumps(facts | {"poses": []}))
        archive.writestr("rgbd/0.depth", b"damaged")
        archive.writestr("rgbd/1.depth", made.lzfse_raw(depth.tobytes()))
    recording = open_recording(tmp_path / "a.r3d")
    assert recording.reference is None
    frame = recording[1]
    np.testing.assert_array_equal(frame.depth, depth)
    assert frame.camera == Pinhole(
        *size, *[580 * size[0] / 480] * 2, size[0] / 2 - 0.5, size[1] / 2 - 0.5
    )


def test_record3d_lens_of_each_frame(tmp_path: Path) -> None:
    """Autofocus moves the lens."""
    made.make_record3d(tmp_path / "scan")
    facts = made.record3d_metadata()
    facts["perFrameIntrinsicCoeffs"] = [[made.FX + 10 * k, made.FX, made.CY, 960] for k in range(2)]
    (tmp_path / "scan" / "metadata.json").write_text(json.dumps(facts))
    cameras = [frame.camera for frame in open_recording(tmp_path / "scan")]
    assert [camera.fx * 60 for camera in cameras] == pytest.approx([made.FX, made.FX + 10, made.FX])
    assert [(c.cy + 0.5) * 60 - 0.5 for c in cameras] == pytest.approx([960, 960, made.CX])


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
