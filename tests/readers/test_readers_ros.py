"""ROS bags, written by rosbags' own writers where it is installed."""

from __future__ import annotations

import gc
import shutil
import struct
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from refused import refused
from ros_bags import (
    COLOR_LENS,
    COLOR_U,
    COLOR_V,
    COLORS,
    COUNTS,
    DEPTH_LENS,
    RNG,
    STEP,
    T_COLOR,
    T_DEPTH,
    TOPIC,
    Bag,
    jpeg_bytes,
    orbbec,
    real_sense,
)
from tofuse.engine.cameras.cameras import BrownConrady, Pinhole, Rational
from tofuse.engine.errors import InputError
from tofuse.engine.frames.frames import CloudFrame
from tofuse.engine.geometry.rays import homogeneous
from tofuse.engine.geometry.se3 import exp, inverse, log
from tofuse.formats.images.images import png_bytes
from tofuse.formats.readers.maker_bags import RealSenseSource
from tofuse.formats.recordings.open import open_recording

KINDS = ("ros1", "ros2", "mcap")
UNKNOWN = SimpleNamespace(width=16, height=12, fx=0, fy=0, cx=0, cy=0)


@pytest.mark.parametrize("kind", KINDS)
def test_depth_images(tmp_path: Path, kind: str) -> None:
    bag = Bag(tmp_path, kind)
    bag.info("/camera/color/camera_info", D=(0.5,))
    bag.info("/camera/depth/camera_info")
    for k in range(3):
        color = np.zeros((12, 16), np.uint16)
        bag.image("/camera/color/depth_like", 10 + k / 10, color, "16UC1")
        bag.image(TOPIC, 10 + k / 10, COUNTS[k], "16UC1", pad=6)
    recording = open_recording(bag.close())
    np.testing.assert_allclose(recording.timestamps, [10, 10.1, 10.2], atol=1e-6)
    assert recording.metadata["topic"] == TOPIC
    assert any("/camera/color/depth_like" in line for line in recording.warnings)
    for k in (0, 1, 2, 1):  # in order, and back
        frame = recording[k]
        assert frame.camera == BrownConrady(16, 12, 20.0, 21.0, 7.5, 5.5, k1=0.1, k2=0.02)
        np.testing.assert_allclose(frame.z, COUNTS[k] / 1000, rtol=1e-6)
        assert frame.timestamp == recording.timestamps[k]


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("/a/depth/image_rect", True),
        ("/a/depth/image_rect_raw/compressedDepth", True),
        ("/a/depth/image_raw", False),
        ("/direct/depth/image_raw", False),
    ],
)
def test_lens_of_rectified_images(tmp_path: Path, topic: str, rectified: bool) -> None:
    """It is P of CameraInfo, without the distortion of the images that were rectified."""
    bag = Bag(tmp_path, "ros2")
    P = np.array([[18.0, 0, 7.25, 0], [0, 19.0, 5.25, 0], [0, 0, 1, 0]])
    bag.info(f"{topic.split('/image')[0]}/camera_info", P=P)
    if topic.endswith("compressedDepth"):
        data = bytes(12) + png_bytes(COUNTS[0])
        bag.compressed(topic, 10, data, "16UC1; compressedDepth png")
    else:
        bag.image(topic, 10, COUNTS[0], "16UC1")
    camera = open_recording(bag.close())[0].camera
    raw = BrownConrady(16, 12, 20.0, 21.0, 7.5, 5.5, k1=0.1, k2=0.02)
    assert camera == (Pinhole(16, 12, 18.0, 19.0, 7.25, 5.25) if rectified else raw)


@pytest.mark.parametrize(
    ("topic", "own", "other"),
    [
        ("/camera/depth/image_raw", "/camera/depth/camera_info", "/camera/camera_info"),
        ("/depth_image", "/depth_camera_info", "/color_camera_info"),
    ],
)
def test_lens_is_that_of_the_topic_of_like_name(tmp_path, topic, own, other) -> None:
    bag = Bag(tmp_path, "mcap")
    bag.info(other, D=(), lens=Pinhole(16, 12, 30.0, 30.0, 8.0, 6.0))
    bag.info(own, D=())
    bag.image(topic, 10.0, COUNTS[0], "16UC1")
    assert open_recording(bag.close())[0].camera == DEPTH_LENS


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_lens_of_binned_part_of_images(tmp_path: Path, kind: str) -> None:
    """As image_proc's crop_decimate describes its images; other sizes remain errors of frames."""
    whole = Pinhole(64, 48, 40.0, 42.0, 31.0, 23.0)
    bag = Bag(tmp_path, kind)
    bag.info("/a/depth/camera_info", D=(), lens=whole, binning=(2, 2), roi=(16, 8, 24, 32))
    bag.image("/a/depth/image", 10, COUNTS[0], "16UC1")
    bag.image("/a/depth/image", 11, COUNTS[0][1:], "16UC1")
    recording = open_recording(bag.close())
    assert recording[0].camera == Pinhole(16, 12, 20.0, 21.0, 7.5, 7.5)
    with pytest.raises(InputError, match="16 x 11"):
        recording[1]


def test_depth_of_depthai(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "mcap")
    bag.depth("/oak/stereo/image_raw")
    frame = open_recording(bag.close())[0]
    np.testing.assert_allclose(frame.z, COUNTS[0] / 1000, rtol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_file_of_bag_alone_in_a_folder(tmp_path: Path, kind: str) -> None:
    """Copied without the metadata.yaml of ROS 2, or into a folder with notes."""
    (tmp_path / "bag").mkdir()
    bag = Bag(tmp_path / "bag", kind)
    bag.depth()
    bag.close()
    (file,) = (p for p in (tmp_path / "bag").rglob("a.*") if p.suffix in (".bag", ".db3", ".mcap"))
    (tmp_path / "copy").mkdir()
    (tmp_path / "copy" / "notes.txt").write_text("")
    shutil.copy(file, tmp_path / "copy")
    assert len(open_recording(tmp_path / "copy")) == 1
    shutil.copy(file, tmp_path / "copy" / f"b{file.suffix}")
    refused(r"several recordings: a\.\w+ \(ros\), b\.\w+ \(ros\)", tmp_path / "copy")
    file.write_bytes(b"")
    refused(r"a\.\w+: is empty", file)


def test_mcap_of_another_program_is_refused_by_its_profile(tmp_path: Path) -> None:
    profile = b"protobuf"
    header = struct.pack("<I", len(profile)) + profile + struct.pack("<I", 0)
    record = b"\x01" + struct.pack("<Q", len(header)) + header
    (tmp_path / "a.mcap").write_bytes(b"\x89MCAP0\r\n" + record + bytes(100))
    refused(r"no messages of ROS 2 \(its profile is 'protobuf'\)", tmp_path / "a.mcap")


@pytest.mark.parametrize(("kind", "encoding", "a"), [("ros2", "16UC1", 0), ("ros1", "32FC1", 4e3)])
def test_compressed_depth(tmp_path: Path, kind: str, encoding: str, a: float) -> None:
    """Floats are stored as a / depth + b."""
    bag = Bag(tmp_path, kind)
    bag.info("/a/depth/camera_info")
    data = struct.pack("<Iff", 0, a, -10.0 if a else 0) + png_bytes(COUNTS[0])
    topic = "/a/depth/image_rect/compressedDepth"
    bag.compressed(topic, 10, data, f"{encoding}; compressedDepth png")
    frame = open_recording(bag.close())[0]
    expected = a / (COUNTS[0] + 10.0) if a else COUNTS[0] / 1000
    np.testing.assert_allclose(frame.z, expected, rtol=1e-5)


def test_depth_compressed_as_any_image(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "ros2")
    bag.info("/a/depth/camera_info")
    color = jpeg_bytes(np.zeros((12, 16, 3), np.uint8))
    bag.compressed("/a/color_to_depth/compressed", 10, color, "rgb8; jpeg compressed bgr8")
    topic = "/a/depth/image/compressed"
    bag.compressed(topic, 10, png_bytes(COUNTS[0]), "16UC1; png compressed ")
    recording = open_recording(bag.close())
    assert recording.metadata["topic"] == topic
    assert not [line for line in recording.warnings if "is read; others are" in line]
    np.testing.assert_allclose(recording[0].z, COUNTS[0] / 1000, rtol=1e-6)


def test_lens_and_size_once_the_driver_has_settled(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "mcap")
    topic = f"{TOPIC.rpartition('/')[0]}/camera_info"
    coarse = Pinhole(8, 6, 10.0, 10.5, 3.5, 2.5)
    for lens in (UNKNOWN, coarse, DEPTH_LENS):
        bag.info(topic, D=(), lens=lens)
    for k in range(4):
        counts = COUNTS[0][::2, ::2] if k == 0 else COUNTS[0]
        bag.image(TOPIC, 10 + k / 10, np.ascontiguousarray(counts), "16UC1")
    recording = open_recording(bag.close())
    assert [frame.camera for frame in recording.readable(4)] == [DEPTH_LENS] * 3


def test_lens_of_another_namespace_by_frame_and_size(tmp_path: Path) -> None:
    for name, second in (("a", DEPTH_LENS), ("b", COLOR_LENS)):
        (tmp_path / name).mkdir()
        bag = Bag(tmp_path / name, "ros1")
        bag.info("/a/info", D=(), lens=COLOR_LENS)
        bag.info("/b/info", D=(), lens=second)
        bag.image("/driver/tof/depth", 10, COUNTS[0], "16UC1")
        path = bag.close()
        if second is DEPTH_LENS:
            assert open_recording(path)[0].camera == DEPTH_LENS
        else:
            refused(r"no CameraInfo for .*, but for others \(/a/info, /b/i", path)


def test_clouds(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "mcap")
    points = RNG.normal(size=(50, 3)).astype(np.float32)
    points[7] = np.nan
    light = RNG.uniform(size=50).astype(np.float32)
    bag.cloud("/points", 10, points, light)
    frame = open_recording(bag.close())[0]
    assert isinstance(frame, CloudFrame)
    keep = np.arange(50) != 7
    np.testing.assert_array_equal(frame.points, points[keep])
    np.testing.assert_array_equal(frame.amplitude, light[keep])


@pytest.mark.parametrize("order", "<>")
def test_clouds_in_map_coordinates(tmp_path: Path, order: str) -> None:
    bag = Bag(tmp_path, "ros2")
    points = RNG.normal((4e5, 5e6, 100), size=(50, 3))
    bag.cloud("/points", 10, points, np.ones(50), dtype=f"{order}f8")
    frame = open_recording(bag.close())[0]
    np.testing.assert_allclose(frame.points + frame.shift, points, rtol=0, atol=1e-5)


def test_organised_clouds_become_images(tmp_path: Path) -> None:
    """Organised clouds on the rays of a camera keep the grid, and get the camera."""
    bag = Bag(tmp_path, "ros2")
    z = RNG.uniform(1, 3, (4, 12, 16)).astype(np.float32)
    z[:, 2, 3] = np.nan
    v, u = np.mgrid[:12, :16].astype(np.float32)
    light = RNG.uniform(size=(4, 192)).astype(np.float32)
    color = RNG.integers(0, 256, (192, 3)).astype(np.uint8)
    for k in range(4):
        points = np.stack([(u - 7.5) / 20 * z[k], (v - 5.5) / 21 * z[k], z[k]], -1)
        bag.cloud("/tof/points", 10 + k, points.reshape(-1, 3), light[k], 12, color=color, pad=k)
    recording = open_recording(bag.close())
    for k in (0, 3):
        frame = recording[k]
        np.testing.assert_allclose(frame.z[frame.valid], z[k][np.isfinite(z[k])], rtol=1e-6)
        assert frame.valid.sum() == 191
        np.testing.assert_allclose(frame.camera.rays()[4, 9], (1.5 / 20, -1.5 / 21), atol=1e-5)
        np.testing.assert_array_equal(frame.amplitude_image, light[k].reshape(12, 16))
        np.testing.assert_array_equal(frame.color_image, color.reshape(12, 16, 3))


def test_infrared_of_same_pixels_is_the_amplitude(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "ros1")
    bag.info("/camera/depth/camera_info")
    bright = RNG.integers(0, 4000, (3, 12, 16)).astype(np.uint16)
    for k in range(3):
        bag.image(TOPIC, 10 + k / 10, COUNTS[k], "16UC1")
        bag.image("/camera/infra_wide/image", 10 + k / 10, np.zeros((12, 20), np.uint16), "mono16")
        if k != 1:
            bag.image("/camera/ir/image_raw", 10.002 + k / 10, bright[k], "mono16")
    recording = open_recording(bag.close())
    assert recording.metadata["amplitude_topic"] == "/camera/ir/image_raw"
    for k, expected in ((0, bright[0]), (1, np.zeros((12, 16))), (2, bright[2])):
        np.testing.assert_array_equal(recording[k].amplitude_image, expected)


def test_driver_restarted_during_recording(tmp_path: Path) -> None:
    """A ROS 1 bag has one connection per publisher of a topic."""
    bag = Bag(tmp_path, "ros1")
    bag.depth(count=2)
    bag.connections[TOPIC] = bag.writer.add_connection(
        TOPIC, "sensor_msgs/msg/Image", typestore=bag.store, callerid="/restarted"
    )
    bag.image(TOPIC, 10.2, COUNTS[2], "16UC1")
    recording = open_recording(bag.close())
    np.testing.assert_allclose([f.z for f in recording], COUNTS / 1000, rtol=1e-6)
    np.testing.assert_allclose(recording[1].z, COUNTS[1] / 1000, rtol=1e-6)


def test_amplitude_and_colour_are_of_the_same_camera(tmp_path: Path) -> None:
    """Of several equal cameras of a robot."""
    bag = Bag(tmp_path, "mcap")
    for k, name in enumerate(("front", "rear")):
        bag.info(f"/{name}/depth/camera_info", D=())
        bag.image(f"/{name}/depth/image_raw", 10, COUNTS[k], "16UC1", frame=name)
        bag.image(f"/{name}/ir/image_raw", 10, COUNTS[k], "mono16", frame=name)
        color = np.full((12, 16, 3), 50 + k, np.uint8)
        bag.image(f"/{name}/color/image_raw", 10, color, "rgb8", frame=name, width=16)
        bag.info(f"/{name}/color/camera_info", D=())
        bag.tf("/tf_static", 9.0, "base", name, np.eye(4))
    path = bag.close()
    for k, name in enumerate(("front", "rear")):
        frame = open_recording(path, topic=f"/{name}/depth/image_raw")[0]
        np.testing.assert_array_equal(frame.amplitude_image, COUNTS[k])
        assert frame.color_image.max() == 50 + k


def test_topic_can_be_chosen(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "mcap")
    bag.depth("/a/depth/image_raw")
    bag.depth("/b/depth/image_raw", count=2)
    path = bag.close()
    assert open_recording(path).metadata["topic"] == "/a/depth/image_raw"
    recording = open_recording(path, topic="/b/depth/image_raw")
    assert recording.warnings == []
    np.testing.assert_allclose(recording[1].z, COUNTS[1] / 1000, rtol=1e-6)
    refused(r"has no images or clouds at /c .*/a/depth/image_raw", path, topic="/c")


def expected_colors(z: np.ndarray, T: np.ndarray, lens: Pinhole = COLOR_LENS) -> np.ndarray:
    """Colour (12, 16, 3) of each depth pixel, black where occluded, pixel by pixel."""
    v, u = np.mgrid[:12, :16]
    points = np.stack([(u - 7.5) / 20 * z, (v - 5.5) / 21 * z, z], -1) @ T[:3, :3].T + T[:3, 3]
    uv = np.nan_to_num(lens.project(points), nan=-1)
    pixel = np.rint(uv).astype(int)
    out = np.zeros((12, 16, 3), np.uint8)
    for i in range(12):
        for j in range(16):
            a, b = pixel[i, j]
            if 0 <= a < 48 and 0 <= b < 40:
                near = np.abs(uv - uv[i, j]).max(-1) < 2
                if not (points[near, 2] < 0.9 * points[i, j, 2]).any():
                    out[i, j] = COLORS[b, a]
    return out


def check_colors(found: np.ndarray | None, expected: np.ndarray, off: int = 0) -> None:
    """Colours that both have are equal; most visible pixels have colour, occluded ones do not.

    Occlusion depends on the assumed size of points, so single pixels may differ.
    """
    both = found.any(-1) & expected.any(-1)
    assert np.abs(found[both].astype(int) - expected[both]).max() <= off
    assert both.sum() > 0.8 * expected.any(-1).sum()
    seen_behind = found.any(-1) & ~expected.any(-1)
    assert seen_behind.sum() < 8
    assert (~found.any(-1)).sum() > 5


@pytest.mark.parametrize("kind", ["ros1", "ros2"])
def test_realsense_bags(tmp_path: Path, kind: str) -> None:
    recording = open_recording(real_sense(tmp_path, kind, "None", name="Intel RealSense L515"))
    assert (recording.format, len(recording)) == ("realsense-bag", 3)
    assert recording.metadata["sensor"] == "Intel RealSense L515"
    for k in (0, 2, 1):
        frame = recording[k]
        assert frame.camera == Pinhole(16, 12, 20.0, 21.0, 7.5, 5.5)
        np.testing.assert_allclose(frame.z, COUNTS[k] * 0.00025, rtol=1e-6)
        np.testing.assert_array_equal(frame.amplitude_image, COUNTS[k] % 250)


def test_realsense_stereo_and_lenses(tmp_path: Path) -> None:
    path = real_sense(tmp_path, "ros2", "Inverse Brown Conrady", name="Intel RealSense D435")
    frame = open_recording(path)[0]
    assert frame.amplitude_image is None  # infrared of another viewpoint
    brown = BrownConrady(16, 12, 20.0, 21.0, 7.5, 5.5, 0.1, 0.02, 0.001, -0.002, 0.01)
    straight = np.array([(3 - 7.5) / 20, (9 - 5.5) / 21, 1.0])
    u, v = brown.project(straight)
    expected = ((u - 7.5) / 20, (v - 5.5) / 21)
    np.testing.assert_allclose(frame.camera.rays()[9, 3], expected, atol=1e-6)
    refused(r"^topic: does not apply", path, topic="/device_0/sensor_0/Depth_0/image/data")


@pytest.mark.parametrize(("kind", "encoding", "off"), [
    ("ros1", "rgb8", 0), ("ros1", "bgra8", 0), ("ros1", "yuyv", 12), ("ros2", "rgb8", 0),
])  # fmt: skip
def test_realsense_color_matches_points(tmp_path: Path, kind: str, encoding: str, off: int) -> None:
    path = real_sense(tmp_path, kind, "None", name="Intel RealSense D435", color=encoding)
    recording = open_recording(path)
    assert recording.warnings == []
    expected = expected_colors(STEP * 0.00025, T_COLOR @ inverse(T_DEPTH))
    for k in (0, 2):
        frame = recording[k]
        check_colors(frame.color_image, expected, off)
    assert recording[1].color_image is None


def test_realsense_color_with_inverse_distortion(tmp_path: Path) -> None:
    """The lens maps pixels to rays; projection must map each ray back to its pixel."""
    k = (0.12, -0.05, 0.002, -0.001, 0.01)
    name = "Intel RealSense D455"
    path = real_sense(tmp_path, "ros2", "None", name=name, color="rgb8", distortion=k)
    source = open_recording(path).source
    assert isinstance(source, RealSenseSource)
    lens = source.color_camera.camera
    stated = BrownConrady(48, 40, 40.0, 41.0, 23.0, 20.0, k[0], k[1], k[2], k[3], k[4])
    slopes = np.stack([(COLOR_U - 23.0) / 40, (COLOR_V - 20.0) / 41, 0.0 * COLOR_U + 1], -1)
    rays = (stated.project(slopes) - (23.0, 20.0)) / (40.0, 41.0)
    np.testing.assert_allclose(
        lens.project(homogeneous(rays)), np.stack([COLOR_U, COLOR_V], -1), atol=0.1
    )


@pytest.mark.parametrize(("encoding", "off"), [("jpeg", 14), ("rgb8", 0)])
def test_orbbec_color_matches_points(tmp_path: Path, encoding: str, off: int) -> None:
    R = T_COLOR[:3, :3] * 0.999  # as stored
    frame = open_recording(orbbec(tmp_path, (0.0,) * 8, color=encoding, R=R))[2]
    check_colors(frame.color_image, expected_colors(STEP * 0.00025, T_COLOR), off)


def test_orbbec_bags(tmp_path: Path) -> None:
    k = (0.5, -2.6, 1.4, 0.4, -2.4, 1.4, 0.0001, -0.0002)  # k1 to k6, then p1 and p2
    recording = open_recording(orbbec(tmp_path, k))
    assert (recording.format, len(recording)) == ("orbbec-bag", 3)
    assert np.diff(recording.timestamps) == pytest.approx(1 / 15, abs=1e-6)
    for index in (0, 2, 1):
        frame = recording[index]
        assert isinstance(frame.camera, Rational)
        assert (frame.camera.k3, frame.camera.p1) == pytest.approx((1.4, 0.0001))
        np.testing.assert_allclose(frame.z, COUNTS[index] / 1000, rtol=1e-6)
        np.testing.assert_array_equal(frame.amplitude_image, COUNTS[index] // 2)


@pytest.mark.parametrize(
    ("topic", "lens", "says"),
    [
        (TOPIC, None, r"has no CameraInfo for .*; pass .* with camera=camera\.json"),
        (TOPIC, UNKNOWN, r"not calibrated \(K is zero\); pass .* with camera=camera\.json"),
        ("/rgb/image", None, r"no topic of depth images or clouds .*/rgb/image"),
    ],
    ids=["lens", "calibration", "depth"],
)
def test_what_is_missing_is_named(tmp_path, topic, lens, says) -> None:
    bag = Bag(tmp_path, "ros1")
    bag.image(topic, 10, COUNTS[0], "16UC1" if topic == TOPIC else "mono16")
    if lens is not None:
        bag.info(f"{topic.rpartition('/')[0]}/camera_info", lens=lens)
    refused(says, bag.close())


@pytest.mark.parametrize(
    ("kind", "packed"),
    [("ros1", "BZ2"), ("ros1", "LZ4"), ("mcap", "STORAGE"), ("mcap", "MESSAGE"),
     ("ros2", "MESSAGE"), ("ros2", "FILE"), ("mcap", "FILE")],
)  # fmt: skip
def test_compressed_bags(tmp_path: Path, kind: str, packed: str, monkeypatch) -> None:
    """Compressed files are decompressed into a temporary folder, which is removed."""
    (temporary := tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    bag = Bag(tmp_path, kind, packed)
    bag.depth(count=3)
    recording = open_recording(bag.close())
    np.testing.assert_allclose(recording[2].z, COUNTS[2] / 1000, rtol=1e-6)
    del recording
    gc.collect()
    assert list(temporary.iterdir()) == []


def test_missing_rosbags_is_reported_with_remedy(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(4096))

    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    refused(r"needs the package rosbags.*pip install 'tofuse\[ros\]'", tmp_path / "a.bag")


COLOR_TOPIC = "/camera/color/image_raw"
RGB_LENS = Pinhole(32, 24, 40.0, 42.0, 15.5, 11.5)
T_RIG_DEPTH, T_RIG_COLOR = exp(
    np.array([[0.1, 0.2, 0.3, 0.1, 0.2, 0.3], [0.12, 0.2, 0.3, 0, 0, 0]])
)
T_WORLD_RIG = exp(np.random.default_rng(101).normal(size=(3, 6)) * 0.1)


def color_at(k: int) -> np.ndarray:
    """The column and the row as red and green, the frame index as blue."""
    v, u = np.mgrid[0:24, 0:32]
    return np.stack([8 * u, 10 * v, np.full_like(u, 50 + k)], -1).astype(np.uint8)


@pytest.mark.parametrize(("kind", "compressed"), [("ros1", False), ("ros2", True), ("mcap", False)])
def test_colour_of_separate_camera(tmp_path: Path, kind: str, compressed: bool) -> None:
    """Posed by tf_static, over intermediate frames; each point has the colour at its projection."""
    bag = Bag(tmp_path, kind)
    bag.depth(count=3)
    bag.info("/camera/color/camera_info", D=(), lens=RGB_LENS)
    bag.tf("/tf_static", 9.0, "rig", "middle", T_RIG_DEPTH)
    bag.tf("/tf_static", 9.0, "middle", "depth", np.eye(4))
    bag.tf("/tf_static", 9.0, "rig", "color", T_RIG_COLOR)
    for k in range(2):  # the third frame has none
        image, time = color_at(k), 10.005 + 0.1 * k
        if compressed:
            name = f"{COLOR_TOPIC}/compressed"
            bag.compressed(name, time, png_bytes(image), "rgb8; png", frame="color")
        else:
            swapped = np.ascontiguousarray(image[..., ::-1])
            bag.image(COLOR_TOPIC, time, swapped, "bgr8", frame="color", width=32)
    recording = open_recording(bag.close())
    assert recording.metadata["color_topic"].startswith(COLOR_TOPIC)
    T = inverse(T_RIG_COLOR) @ T_RIG_DEPTH
    for k, frame in enumerate(recording):
        np.testing.assert_allclose(frame.depth, COUNTS[k] / 1000, atol=1e-6)
        assert (frame.color_image is None) == (k == 2)
        if frame.color_image is None:
            continue
        seen = frame.color_image.any(-1)
        assert seen.sum() > 30
        points = frame.point_image[seen] @ T[:3, :3].T + T[:3, 3]
        uv = np.rint(RGB_LENS.project(points))
        np.testing.assert_array_equal(frame.color_image[seen][:, 0], 8 * uv[:, 0])
        np.testing.assert_array_equal(frame.color_image[seen][:, 1], 10 * uv[:, 1])
        assert (frame.color_image[seen][:, 2] == 50 + k).all()


def test_colour_that_the_azure_kinect_driver_registers(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "ros1")
    bag.depth("/depth/image_raw")
    image = np.dstack([color_at(0)[:12, :16, ::-1], np.full((12, 16), 255, np.uint8)])
    bag.image("/rgb_to_depth/image_raw", 10.0, image, "bgra8", width=16)
    frame = open_recording(bag.close())[0]
    np.testing.assert_array_equal(frame.color_image, color_at(0)[:12, :16])


def test_no_image_is_the_colour_of_two_frames(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "mcap")
    bag.info("/camera/depth/camera_info", D=())
    for time in (10.0, 10.011, 10.022):  # 90 frames per second
        bag.image(TOPIC, time, COUNTS[0], "16UC1")
    image = np.ascontiguousarray(color_at(0)[:12, :16])
    bag.image(COLOR_TOPIC, 10.01, image, "rgb8", width=16)
    recording = open_recording(bag.close())
    assert [frame.color_image is None for frame in recording] == [True, False, True]
    assert [recording.source.has_color(k) for k in range(3)] == [False, True, False]


def test_static_transforms_of_early_publishers(tmp_path: Path) -> None:
    """They repeat them on /tf, which makes neither poses nor a camera that moves."""
    bag = Bag(tmp_path, "ros1")
    bag.depth(count=3)
    bag.info("/camera/color/camera_info", D=(), lens=RGB_LENS)
    for time in (9.0, 9.1, 10.1):
        bag.tf("/tf", time, "rig", "depth", T_RIG_DEPTH)
        bag.tf("/tf", time, "rig", "color", T_RIG_COLOR)
    bag.image(COLOR_TOPIC, 10.0, color_at(0), "rgb8", frame="color", width=32)
    recording = open_recording(bag.close())
    assert recording.reference is None
    assert recording[0].color_image is not None


def test_colour_registered_to_depth(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "ros2")
    bag.depth("/camera/aligned_depth_to_color/image_raw")
    image = np.ascontiguousarray(color_at(0)[:12, :16])
    bag.image(COLOR_TOPIC, 10.0, image, "rgb8", frame="color", width=16)
    np.testing.assert_array_equal(open_recording(bag.close())[0].color_image, image)


Add = Callable[[Bag, float, np.ndarray], None]
UNRELATED: dict[str, tuple[Add, str]] = {
    "colour": (
        lambda bag, time, _: bag.image(COLOR_TOPIC, time, color_at(0), "rgb8", 0, 32, "color"),
        f"colour is ignored: the relation of {COLOR_TOPIC}",
    ),
    "odometry": (
        lambda bag, time, T: bag.odometry("/odom", time, "odom", "base", T),
        "odometry has frames that move",
    ),
    "gravity": (
        lambda bag, time, _: bag.imu("/imu", time, "elsewhere", np.array([0.0, 0.0, 9.8])),
        "gravity in /imu is ignored: the relation",
    ),
    "another clock": (
        lambda bag, time, T: bag.tf("/tf", 1e9 + time, "odom", "depth", T),
        "moves, but at no time of an image",
    ),
    # The robot moves, and nothing says where the camera is.
    "no latched tf": (
        lambda bag, time, T: bag.tf("/tf", time, "odom", "base_link", T),
        "/tf_static was not recorded",
    ),
}


@pytest.mark.parametrize("what", UNRELATED)
def test_what_nothing_relates_to_depth_is_named_and_ignored(tmp_path: Path, what: str) -> None:
    add, says = UNRELATED[what]
    bag = Bag(tmp_path, "mcap")
    bag.depth(count=3)
    for k, T in enumerate(T_WORLD_RIG):
        add(bag, 10 + 0.1 * k, T)
    recording = open_recording(bag.close())
    assert any(says in line for line in recording.warnings)
    assert recording.odometry is recording.gravity is recording[0].color_image is None


@pytest.mark.parametrize("kind", ["ros1", "ros2"])  # names with and without a slash
def test_poses_from_tf(tmp_path: Path, kind: str) -> None:
    """Odometry below a map that corrects it; poses are interpolated between messages."""
    bag = Bag(tmp_path, kind)
    bag.depth(count=3)
    slash = "/" if kind == "ros1" else ""
    bag.tf("/tf_static", 9.0, f"{slash}base_link", f"{slash}depth", T_RIG_DEPTH)
    T_MAP_ODOM = exp(np.array([1.0, 2.0, 0.5, 0.0, 0.0, 0.4]))
    for k, T in enumerate(T_WORLD_RIG):  # at 9.95, 10.05, 10.15: interpolated; the last has none
        bag.tf("/tf", 9.95 + 0.1 * k, "odom", "base_link", T)
        bag.tf("/tf", 9.95 + 0.1 * k, "map", "odom", T_MAP_ODOM)
    recording = open_recording(bag.close())
    assert recording.odometry is not None
    assert recording.reference is not None
    for k in range(2):
        A, B = T_WORLD_RIG[k], T_WORLD_RIG[k + 1]
        half = A @ exp(log(inverse(A) @ B) / 2)
        np.testing.assert_allclose(recording.odometry[k], half @ T_RIG_DEPTH, atol=1e-6)
        expected = T_MAP_ODOM @ half @ T_RIG_DEPTH
        np.testing.assert_allclose(recording.reference[k], expected, atol=1e-6)
    assert np.isnan(recording.reference[2]).all()
    assert np.isnan(recording.odometry[2]).all()


@pytest.mark.parametrize("kind", ["ros1", "ros2"])
def test_poses_of_odometry_messages(tmp_path: Path, kind: str) -> None:
    """Of a frame that tf attaches below the root of the camera's tree."""
    bag = Bag(tmp_path, kind)
    bag.depth(count=3)
    T_BASE_IMU = exp(np.array([0.3, 0.0, 0.1, 0.0, 0.0, 1.0]))
    bag.tf("/tf_static", 9.0, "base", "depth", T_RIG_DEPTH)
    bag.tf("/tf_static", 9.0, "base", "imu", T_BASE_IMU)
    for k, T in enumerate(T_WORLD_RIG):
        bag.odometry("/vio/state", 10 + 0.1 * k, "start", "imu", T @ T_BASE_IMU)
        bag.odometry("/wheels", 10 + 0.1 * k, "other", "base", np.eye(4))
    recording = open_recording(bag.close())
    assert recording.reference is None
    np.testing.assert_allclose(recording.odometry, T_WORLD_RIG @ T_RIG_DEPTH, atol=1e-6)
    assert recording.metadata["odometry_topic"] == "/vio/state"


def test_tf_precedes_odometry_messages(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "mcap")
    bag.depth(count=3)
    bag.tf("/tf_static", 9.0, "base", "depth", T_RIG_DEPTH)
    for k, T in enumerate(T_WORLD_RIG):
        bag.tf("/tf", 10 + 0.1 * k, "odom", "base", T)
        bag.odometry("/raw", 10 + 0.1 * k, "odom", "base", np.eye(4))
    recording = open_recording(bag.close())
    np.testing.assert_allclose(recording.odometry, T_WORLD_RIG @ T_RIG_DEPTH, atol=1e-6)
    assert "odometry_topic" not in recording.metadata


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_gravity_of_an_accelerometer(tmp_path: Path, kind: str) -> None:
    """It measures g upwards at rest, in its own axes; a gyroscope measures none."""
    bag = Bag(tmp_path, kind)
    bag.depth(count=3)
    T_DEPTH_IMU = exp(np.array([0.3, 0.0, 0.1, 0.4, -1.2, 2.0]))
    bag.tf("/tf_static", 9.0, "depth", "imu", T_DEPTH_IMU)
    down = np.array([[0.0, 1.0, 0.0], [0.6, 0.8, 0.0], [0.0, 0.8, 0.6]])  # in each image
    for k, direction in enumerate(down):
        up = -9.81 * T_DEPTH_IMU[:3, :3].T @ direction
        bag.imu("/a/gyro", 10 + 0.1 * k, "imu", np.zeros(3), known=-1.0)
        bag.imu("/b/compensated", 10 + 0.1 * k, "imu", 0.02 * up)
        bag.imu("/c/accel", 10 + 0.1 * k, "imu", up)
    recording = open_recording(bag.close())
    assert recording.gravity is not None
    np.testing.assert_allclose(recording.gravity[:, :3], down, atol=1e-6)
    assert recording.metadata["imu_topic"] == "/c/accel"
