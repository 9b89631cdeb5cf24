"""ROS bags, written by rosbags' own writers where it is installed."""

from __future__ import annotations

import gc
import importlib
import struct
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from test_recordings_fuzz import damage
from test_recordings_fuzz_cameras import read_through
from tofuse.errors import InputError
from tofuse.files.images import png_bytes
from tofuse.geometry import quaternion
from tofuse.geometry.cameras import BrownConrady, Fisheye, Pinhole, Rational
from tofuse.geometry.se3 import exp, inverse, log
from tofuse.recordings import bags
from tofuse.recordings.frames import CloudFrame, RangeFrame
from tofuse.recordings.open import open_recording
from tofuse.recordings.readers import ros
from tofuse.recordings.readers.realsense_bag import RealSenseSource

RNG = np.random.default_rng(100)
COUNTS = RNG.integers(300, 5000, (3, 12, 16)).astype(np.uint16)
KINDS = ("ros1", "ros2", "mcap")
TOPIC = "/camera/depth/image_rect_raw"
DEPTH_LENS = Pinhole(16, 12, 20.0, 21.0, 7.5, 5.5)


class Bag:
    """Writes messages to a bag of a kind."""

    def __init__(self, folder: Path, kind: str) -> None:
        pytest.importorskip("rosbags", reason="the package rosbags is not installed")
        self.kind = kind
        self.store = importlib.import_module("rosbags.typesys").get_typestore(
            importlib.import_module("rosbags.typesys").Stores[
                "ROS1_NOETIC" if kind == "ros1" else "ROS2_HUMBLE"
            ]
        )
        if kind == "ros1":
            self.path = folder / "a.bag"
            self.writer = importlib.import_module("rosbags.rosbag1").Writer(self.path)
        else:
            rosbag2 = importlib.import_module("rosbags.rosbag2")
            self.path = folder / "a"
            plugin = rosbag2.StoragePlugin["MCAP" if kind == "mcap" else "SQLITE3"]
            self.writer = rosbag2.Writer(self.path, version=9, storage_plugin=plugin)
        self.writer.open()
        self.connections: dict[str, Any] = {}
        if "tf2_msgs/msg/TFMessage" not in self.store.types:
            parse = importlib.import_module("rosbags.typesys").get_types_from_msg
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(parse(text, "tf2_msgs/msg/TFMessage"))

    def make(self, name: str, *values: Any) -> Any:
        return self.store.types[name](*values)

    def header(self, time: float, frame: str = "depth") -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", int(time), round(time % 1 * 1e9))
        first = (7,) if self.kind == "ros1" else ()
        return self.make("std_msgs/msg/Header", *first, stamp, frame)

    def tf(self, topic: str, time: float, parent: str, child: str, T: np.ndarray) -> None:
        q = quaternion.from_matrix(T[:3, :3])
        vector = self.make("geometry_msgs/msg/Vector3", *map(float, T[:3, 3]))
        turn = self.make("geometry_msgs/msg/Quaternion", *map(float, q))
        motion = self.make("geometry_msgs/msg/Transform", vector, turn)
        kind = "geometry_msgs/msg/TransformStamped"
        stamped = self.make(kind, self.header(time, parent), child, motion)
        name = "tf2_msgs/msg/TFMessage"
        self.write(topic, name, time, self.make(name, [stamped]))

    def write(self, topic: str, kind: str, time: float, message: Any) -> None:
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        turn = self.store.serialize_ros1 if self.kind == "ros1" else self.store.serialize_cdr
        # The message arrives 5 ms after it was taken.
        stamp = round((time + 0.005) * 1e9)
        self.writer.write(self.connections[topic], stamp, turn(message, kind))

    def image(
        self,
        topic: str,
        time: float,
        image: np.ndarray,
        encoding: str,
        pad: int = 0,
        width: int | None = None,
        frame: str = "depth",
    ) -> None:
        height, width = len(image), width or image.shape[1]
        rows = np.ascontiguousarray(image).view(np.uint8).reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, pad)))
        self.write(
            topic,
            ros.IMAGE,
            time,
            self.make(
                ros.IMAGE, self.header(time, frame), height, width, encoding, 0, rows.shape[1],
                rows.ravel(),
            ),
        )  # fmt: skip

    def compressed(
        self, topic: str, time: float, data: bytes, format_: str, frame: str = "depth"
    ) -> None:
        content = np.frombuffer(data, np.uint8)
        message = self.make(ros.COMPRESSED, self.header(time, frame), format_, content)
        self.write(topic, ros.COMPRESSED, time, message)

    def transform(self, topic: str, T: np.ndarray) -> None:
        q = quaternion.from_matrix(T[:3, :3])
        vector = self.make("geometry_msgs/msg/Vector3", *map(float, T[:3, 3]))
        turn = self.make("geometry_msgs/msg/Quaternion", *map(float, q))
        kind = "geometry_msgs/msg/Transform"
        self.write(topic, kind, 1.0, self.make(kind, vector, turn))

    def info(
        self,
        topic: str,
        model: str = "plumb_bob",
        D: tuple[float, ...] = (0.1, 0.02),
        lens: Pinhole = DEPTH_LENS,
    ) -> None:
        K = np.array([lens.fx, 0, lens.cx, 0, lens.fy, lens.cy, 0, 0, 1])
        roi = self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        D = (*D, *(0.0,) * (5 - len(D)))
        size = (lens.height, lens.width)
        values = (*size, model, np.array(D), K, np.eye(3).ravel(), np.zeros(12), 0, 0, roi)
        self.write(topic, ros.INFO, 10.0, self.make(ros.INFO, self.header(10.0), *values))

    def cloud(
        self, topic: str, time: float, points: np.ndarray, light: np.ndarray, height: int = 1
    ) -> None:
        field = "sensor_msgs/msg/PointField"
        names = ("x", "y", "z", "intensity")
        fields = [self.make(field, n, 4 * k, 7, 1) for k, n in enumerate(names)]
        data = np.concatenate([points, light[:, None]], 1).astype("<f4")
        content = np.frombuffer(data.tobytes(), np.uint8)
        message = self.make(
            ros.CLOUD, self.header(time), height, len(data) // height, fields, False, 16,
            16 * len(data) // height,
            content, True,
        )  # fmt: skip
        self.write(topic, ros.CLOUD, time, message)

    def close(self) -> Path:
        self.writer.close()
        # Its writer of MCAP leaves a file to the garbage collector.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)
            del self.writer
            gc.collect()
        return self.path


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
    assert (recording.format, len(recording)) == ("ros", 3)
    np.testing.assert_allclose(recording.timestamps, [10, 10.1, 10.2], atol=1e-6)
    assert recording.metadata["topic"] == TOPIC
    assert any("/camera/color/depth_like" in line for line in recording.warnings)
    for k in (0, 1, 2, 1):  # in order, and back
        frame = recording[k]
        assert isinstance(frame, RangeFrame)
        assert frame.camera == BrownConrady(16, 12, 20.0, 21.0, 7.5, 5.5, k1=0.1, k2=0.02)
        np.testing.assert_allclose(frame.z, COUNTS[k] / 1000, rtol=1e-6)
        assert frame.timestamp == recording.timestamps[k]


@pytest.mark.parametrize("kind", KINDS)
def test_metres_and_a_fisheye(tmp_path: Path, kind: str) -> None:
    bag = Bag(tmp_path, kind)
    bag.info("/tof/depth/camera_info", "equidistant", (0.1, 0.01, 0.001, 0.0001))
    image = (COUNTS[0] / 1000).astype(np.float32)
    image[0, 0] = np.nan
    bag.image("/tof/depth/image_raw", 10, image, "32FC1")
    frame = open_recording(bag.close())[0]
    assert isinstance(frame, RangeFrame)
    assert isinstance(frame.camera, Fisheye)
    assert frame.camera.k2 == 0.01
    assert not frame.valid[0, 0]
    np.testing.assert_array_equal(frame.z[1:], image[1:])


def test_compressed_depth(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "ros2")
    bag.info("/a/depth/camera_info")
    topic = "/a/depth/image_rect/compressedDepth"
    head = struct.pack("<Iff", 0, 0, 0)
    bag.compressed(topic, 10, head + png_bytes(COUNTS[0]), "16UC1; compressedDepth png")
    recording = open_recording(bag.close())
    frame = recording[0]
    assert isinstance(frame, RangeFrame)
    np.testing.assert_allclose(frame.z, COUNTS[0] / 1000, rtol=1e-6)
    # Floats are stored as a / depth + b.
    a, b = 4000.0, -10.0
    second = Bag(tmp_path / "second", "ros1") if (tmp_path / "second").mkdir() is None else None
    assert second is not None
    second.info("/a/depth/camera_info")
    data = struct.pack("<Iff", 0, a, b) + png_bytes(COUNTS[1])
    second.compressed(topic, 10, data, "32FC1; compressedDepth png")
    frame = open_recording(second.close())[0]
    assert isinstance(frame, RangeFrame)
    np.testing.assert_allclose(frame.z, a / (COUNTS[1] - b), rtol=1e-5)


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


def test_organised_clouds_are_images(tmp_path: Path) -> None:
    """Clouds in rows and columns that lie on a camera's rays keep the grid, and get the camera."""
    bag = Bag(tmp_path, "ros2")
    z = RNG.uniform(1, 3, (4, 12, 16)).astype(np.float32)
    z[:, 2, 3] = np.nan
    v, u = np.mgrid[:12, :16].astype(np.float32)
    light = RNG.uniform(size=(4, 192)).astype(np.float32)
    for k in range(4):
        points = np.stack([(u - 7.5) / 20 * z[k], (v - 5.5) / 21 * z[k], z[k]], -1)
        bag.cloud("/tof/points", 10 + k, points.reshape(-1, 3), light[k], height=12)
    recording = open_recording(bag.close())
    for k in (0, 3):
        frame = recording[k]
        assert isinstance(frame, RangeFrame)
        np.testing.assert_allclose(frame.z[frame.valid], z[k][np.isfinite(z[k])], rtol=1e-6)
        assert frame.valid.sum() == 191
        np.testing.assert_allclose(frame.camera.rays()[4, 9], (1.5 / 20, -1.5 / 21), atol=1e-5)
        np.testing.assert_array_equal(frame.amplitude_image, light[k].reshape(12, 16))


def test_infrared_of_the_same_pixels_is_the_amplitude(tmp_path: Path) -> None:
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
        frame = recording[k]
        assert isinstance(frame, RangeFrame)
        np.testing.assert_array_equal(frame.amplitude_image, expected)


def test_the_topic_can_be_chosen(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "mcap")
    bag.info("/a/depth/camera_info")
    bag.info("/b/depth/camera_info")
    bag.image("/a/depth/image_raw", 10, COUNTS[0], "16UC1")
    bag.image("/b/depth/image_raw", 10, COUNTS[1], "16UC1")
    path = bag.close()
    assert open_recording(path).metadata["topic"] == "/a/depth/image_raw"
    recording = open_recording(path, topic="/b/depth/image_raw")
    assert recording.warnings == []
    frame = recording[0]
    assert isinstance(frame, RangeFrame)
    np.testing.assert_allclose(frame.z, COUNTS[1] / 1000, rtol=1e-6)
    with pytest.raises(InputError, match=r"has no images or clouds at /c .*/a/depth/image_raw"):
        open_recording(path, topic="/c")


# Colour beside depth: places of both from a reference, and an image that tells its pixels apart.
T_DEPTH = exp([0.01, 0.02, -0.005, 0.02, -0.03, 0.01])
T_COLOR = exp([-0.06, 0.01, 0.004, 0.01, 0.12, -0.05])
COLOR_LENS = Pinhole(48, 40, 40.0, 41.0, 23.0, 20.0)
COLOR_V, COLOR_U = np.mgrid[:40, :48]
COLORS = np.stack([5 * COLOR_U, 6 * COLOR_V, 0 * COLOR_U + 200], -1).astype(np.uint8)
STEP = np.full((12, 16), 8000, np.uint16)  # a wall at 2 m, and a box at 1 m before it
STEP[4:8, 6:10] = 4000


def expected_colors(z: np.ndarray, T: np.ndarray, lens: Pinhole = COLOR_LENS) -> np.ndarray:
    """Colour (12, 16, 3) of each depth pixel, black where nearer points cover it, one by one."""
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
    """Where both say a colour, it is the same; most of what is seen is coloured, hidden parts not.

    What is hidden depends on how wide a point is taken to be, so single pixels may differ there.
    """
    assert found is not None
    both = found.any(-1) & expected.any(-1)
    assert np.abs(found[both].astype(int) - expected[both]).max() <= off
    assert both.sum() > 0.8 * expected.any(-1).sum()
    seen_behind = found.any(-1) & ~expected.any(-1)
    assert seen_behind.sum() < 8
    assert (~found.any(-1)).sum() > 5


def real_sense(
    folder: Path,
    kind: str,
    model: str,
    *,
    name: str,
    color: str = "",
    distortion: tuple[float, ...] = (0.0,) * 5,
) -> Path:
    """A bag as RealSense's SDK writes it: .bag with CameraInfo, newer .db3 with text."""
    bag = Bag(folder, kind)
    stream = "/device_0/sensor_0/Depth_0"
    D = (0.1, 0.02, 0.001, -0.002, 0.01)
    text, number = "std_msgs/msg/String", "std_msgs/msg/Float32"
    if kind == "ros1":
        bag.info(f"{stream}/info/camera_info", model, D if model != "None" else (0.0,))
        bag.write("/device_0/sensor_0/option/Depth_Units/value", number, 1.0,
                  bag.make(number, 0.00025))  # fmt: skip
        if color:
            bag.info(COLOR_STREAM + "/info/camera_info", "Brown Conrady", distortion, COLOR_LENS)
            for part, T in ((stream, T_DEPTH), (COLOR_STREAM, T_COLOR)):
                bag.transform(f"{part}/tf/0", T)
    else:
        coeffs = ",".join(map(str, D if model != "None" else (0,) * 5))
        lens = f"width=16;height=12;fx=20;ppx=7.5;fy=21;ppy=5.5;model={model};coeffs={coeffs}"
        bag.write(f"{stream}/camera_info", text, 1.0, bag.make(text, lens))
        if color:
            coeffs = ",".join(map(str, distortion))
            lens = "width=48;height=40;fx=40;ppx=23;fy=41;ppy=20;model=Inverse Brown Conrady;"
            bag.write(
                COLOR_STREAM + "/camera_info", text, 1.0, bag.make(text, f"{lens}coeffs={coeffs}")
            )
            for part, T in ((stream, T_DEPTH), (COLOR_STREAM, T_COLOR)):
                told = "rotation=" + ",".join(map(str, T[:3, :3].T.ravel()))  # by columns
                told += ";translation=" + ",".join(map(str, T[:3, 3]))
                bag.write(f"{part}/tf/0", text, 1.0, bag.make(text, told))
        bag.write("/device_0/sensor_0/option/Depth_Units/value", text, 1.0,
                  bag.make(text, "0.000250"))  # fmt: skip
    pair = "diagnostic_msgs/msg/KeyValue"
    for key, value in (("Serial Number", "f0001"), ("Name", name)):
        bag.write("/device_0/info", pair, 1.0, bag.make(pair, key, value))
    for k in range(3):
        bag.image(f"{stream}/image/data", 10 + k / 30, STEP if color else COUNTS[k], "mono16")
        if color and k != 1:
            image = packed(COLORS, color)
            bag.image(COLOR_STREAM + "/image/data", 10.004 + k / 30, image, color, width=48)
        infrared = (COUNTS[k] % 250).astype(np.uint8)
        bag.image("/device_0/sensor_0/Infrared_0/image/data", 10 + k / 30, infrared, "mono8")
    return bag.close()


@pytest.mark.parametrize("kind", ["ros1", "ros2"])
def test_realsense_bags(tmp_path: Path, kind: str) -> None:
    recording = open_recording(real_sense(tmp_path, kind, "None", name="Intel RealSense L515"))
    assert (recording.format, len(recording)) == ("realsense-bag", 3)
    assert recording.metadata["sensor"] == "Intel RealSense L515"
    for k in (0, 2, 1):
        frame = recording[k]
        assert isinstance(frame, RangeFrame)
        assert frame.camera == Pinhole(16, 12, 20.0, 21.0, 7.5, 5.5)
        np.testing.assert_allclose(frame.z, COUNTS[k] * 0.00025, rtol=1e-6)
        np.testing.assert_array_equal(frame.amplitude_image, COUNTS[k] % 250)


@pytest.mark.parametrize("kind", ["ros1", "ros2"])
def test_realsense_stereo_and_lenses(tmp_path: Path, kind: str) -> None:
    path = real_sense(tmp_path, kind, "Inverse Brown Conrady", name="Intel RealSense D435")
    frame = open_recording(path)[0]
    assert isinstance(frame, RangeFrame)
    assert frame.amplitude_image is None  # infrared of another viewpoint
    brown = BrownConrady(16, 12, 20.0, 21.0, 7.5, 5.5, 0.1, 0.02, 0.001, -0.002, 0.01)
    straight = np.array([(3 - 7.5) / 20, (9 - 5.5) / 21, 1.0])
    u, v = brown.project(straight)
    expected = ((u - 7.5) / 20, (v - 5.5) / 21)
    np.testing.assert_allclose(frame.camera.rays()[9, 3], expected, atol=1e-6)
    with pytest.raises(InputError, match="--topic"):
        open_recording(path, topic="/device_0/sensor_0/Depth_0/image/data")


COLOR_STREAM = "/device_0/sensor_1/Color_0"


def packed(image: np.ndarray, encoding: str) -> np.ndarray:
    """Rows of bytes of an RGB image."""
    if encoding == "rgb8":
        return image.reshape(len(image), -1)
    if encoding == "bgra8":
        alpha = np.full((*image.shape[:2], 1), 255, np.uint8)
        return np.concatenate([image[..., ::-1], alpha], -1).reshape(len(image), -1)
    assert encoding == "yuyv"
    y, cr, cb = np.moveaxis(cv2.cvtColor(image, cv2.COLOR_RGB2YCrCb).astype(float), -1, 0)
    y, cb, cr = 16 + y * 219 / 255, 128 + (cb - 128) * 224 / 255, 128 + (cr - 128) * 224 / 255
    rows = np.empty((len(image), 2 * image.shape[1]), np.uint8)
    rows[:, 0::2], rows[:, 1::4], rows[:, 3::4] = y, cb[:, ::2], cr[:, ::2]
    return rows


def jpeg_bytes(image: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 99])[1])


@pytest.mark.parametrize(("kind", "encoding", "off"), [
    ("ros1", "rgb8", 0), ("ros1", "bgra8", 0), ("ros1", "yuyv", 12), ("ros2", "rgb8", 0),
])  # fmt: skip
def test_realsense_color_is_that_of_each_point(
    tmp_path: Path, kind: str, encoding: str, off: int
) -> None:
    path = real_sense(tmp_path, kind, "None", name="Intel RealSense D435", color=encoding)
    recording = open_recording(path)
    assert recording.warnings == []
    expected = expected_colors(STEP * 0.00025, T_COLOR @ inverse(T_DEPTH))
    for k in (0, 2):
        frame = recording[k]
        assert isinstance(frame, RangeFrame)
        check_colors(frame.color_image, expected, off)
    without = recording[1]
    assert isinstance(without, RangeFrame)
    assert without.color_image is None


def test_realsense_color_through_an_inverse_lens(tmp_path: Path) -> None:
    """The lens is told from pixels to rays; it must bring each ray back to its pixel."""
    k = (0.12, -0.05, 0.002, -0.001, 0.01)
    name = "Intel RealSense D455"
    path = real_sense(tmp_path, "ros2", "None", name=name, color="rgb8", distortion=k)
    source = open_recording(path).source
    assert isinstance(source, RealSenseSource)
    assert source.color_camera is not None
    lens = source.color_camera.camera
    told = BrownConrady(48, 40, 40.0, 41.0, 23.0, 20.0, k[0], k[1], k[2], k[3], k[4])
    slopes = np.stack([(COLOR_U - 23.0) / 40, (COLOR_V - 20.0) / 41, 0.0 * COLOR_U + 1], -1)
    rays = (told.project(slopes) - (23.0, 20.0)) / (40.0, 41.0)
    points = np.concatenate([rays, np.ones((40, 48, 1))], -1)
    np.testing.assert_allclose(lens.project(points), np.stack([COLOR_U, COLOR_V], -1), atol=0.1)


def test_color_without_its_place_is_left_out(tmp_path: Path) -> None:
    recording = open_recording(orbbec(tmp_path, (0.0,) * 8, color="jpeg", R=np.zeros((3, 3))))
    frame = recording[0]
    assert isinstance(frame, RangeFrame)
    assert frame.color_image is None
    assert ["colour is ignored" in line for line in recording.warnings] == [True]


@pytest.mark.parametrize(("encoding", "off"), [("jpeg", 14), ("rgb8", 0)])
def test_orbbec_color_is_that_of_each_point(tmp_path: Path, encoding: str, off: int) -> None:
    R = T_COLOR[:3, :3] * 0.999  # as it is stored
    frame = open_recording(orbbec(tmp_path, (0.0,) * 8, color=encoding, R=R))[2]
    assert isinstance(frame, RangeFrame)
    check_colors(frame.color_image, expected_colors(STEP * 0.00025, T_COLOR), off)


def orbbec(
    folder: Path,
    distortion: tuple[float, ...],
    *,
    color: str = "",
    R: np.ndarray | None = None,
) -> Path:
    """A bag as Orbbec's SDK writes it: ROS's images with more fields behind, an own profile."""
    bag = Bag(folder, "ros1")
    header = struct.pack("<4I", 0, 10, 0, 3) + b"cam"
    R = np.eye(3) if R is None else R
    profile = header + struct.pack(
        "<2B9f3f3H4f8fB", 3, 10, *R.ravel(), *(1000 * T_COLOR[:3, 3]), 16, 12, 15, 20, 21, 7.5,
        5.5, *distortion, 1,
    )  # fmt: skip
    color_profile = header + struct.pack(
        "<2B9f3f3H4f8fB", 2, 5, *np.zeros(12), 48, 40, 15, 40, 41, 23, 20, *np.zeros(8), 1
    )
    kinds = {
        "/cam/streamProfileType_3": "custom_msg/msg/OBStreamProfileInfo",
        "/cam/sensor_3/frameType_3": "sensor_msgs/msg/Image",
        "/cam/sensor_1/frameType_1": "sensor_msgs/msg/Image",
    }
    if color:
        kinds["/cam/streamProfileType_2"] = "custom_msg/msg/OBStreamProfileInfo"
        kinds["/cam/sensor_2/frameType_2"] = "sensor_msgs/msg/Image"
    definition = "Header header\nuint8 streamType\n"
    connections = {
        topic: bag.writer.add_connection(topic, kind, msgdef=definition, md5sum="0" * 32)
        for topic, kind in kinds.items()
    }
    bag.writer.write(connections["/cam/streamProfileType_3"], 10**10, profile)
    if color:
        bag.writer.write(connections["/cam/streamProfileType_2"], 10**10, color_profile)
    depth = np.stack([STEP // 4] * 3) if color else COUNTS
    data = COLORS.tobytes() if color == "rgb8" else jpeg_bytes(COLORS)
    for k in range(3):
        images = {
            "/cam/sensor_3/frameType_3": ((12, 16), b"mono16", 32, depth[k].tobytes()),
            "/cam/sensor_1/frameType_1": ((12, 16), b"mono16", 32, (COUNTS[k] // 2).tobytes()),
        }
        if color:
            images["/cam/sensor_2/frameType_2"] = ((40, 48), color.encode(), 3 * 48, data)
        for topic, (size, encoding, step, content) in images.items():
            time = 10 + k / 15
            head = struct.pack("<4I", k, int(time), round(time % 1 * 1e9), 3) + b"cam"
            body = struct.pack("<3I", *size, len(encoding)) + encoding
            body += struct.pack("<BII", 0, step, len(content)) + content
            raw = head + body + struct.pack("<QQ", 5, 6)
            bag.writer.write(connections[topic], round(time * 1e9), raw)
    return bag.close()


def test_orbbec_bags(tmp_path: Path) -> None:
    k = (0.5, -2.6, 1.4, 0.4, -2.4, 1.4, 0.0001, -0.0002)  # k1 to k6, then p1 and p2
    recording = open_recording(orbbec(tmp_path, k))
    assert (recording.format, len(recording)) == ("orbbec-bag", 3)
    assert np.diff(recording.timestamps) == pytest.approx(1 / 15, abs=1e-6)
    for index in (0, 2, 1):
        frame = recording[index]
        assert isinstance(frame, RangeFrame)
        assert isinstance(frame.camera, Rational)
        assert (frame.camera.k3, frame.camera.p1) == pytest.approx((1.4, 0.0001))
        np.testing.assert_allclose(frame.z, COUNTS[index] / 1000, rtol=1e-6)
        np.testing.assert_array_equal(frame.amplitude_image, COUNTS[index] // 2)


@pytest.mark.parametrize("maker", ["realsense", "orbbec"])
def test_damaged_bags_of_makers(tmp_path: Path, maker: str) -> None:
    if maker == "realsense":
        path = real_sense(tmp_path, "ros1", "None", name="Intel RealSense L515", color="yuyv")
    else:
        path = orbbec(tmp_path, (0.0,) * 8, color="jpeg", R=T_COLOR[:3, :3])
    content, seen = path.read_bytes(), np.zeros(3, int)
    for k in range(40):
        damage([path], np.random.default_rng([102, k]))
        seen += read_through(path, f"{maker}-bag")
        if path.is_dir():
            path.rmdir()
        path.write_bytes(content)
    assert seen[1] + seen[2] > 0


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "ros1")
    bag.image(TOPIC, 10, COUNTS[0], "16UC1")
    with pytest.raises(InputError, match=r"has no CameraInfo for .*; give .* --camera"):
        open_recording(bag.close())
    (tmp_path / "b").mkdir()
    bag = Bag(tmp_path / "b", "ros1")
    bag.image("/camera/color/image", 10, COUNTS[0], "mono16")
    with pytest.raises(
        InputError, match=r"no topic of depth images or clouds .*/camera/color/image"
    ):
        open_recording(bag.close())


@pytest.mark.parametrize("kind", KINDS)
def test_damage_gives_only_our_errors(tmp_path: Path, kind: str) -> None:
    bag = Bag(tmp_path, kind)
    bag.info("/camera/depth/camera_info")
    for k in range(3):
        bag.image(TOPIC, 10 + k, COUNTS[k], "16UC1")
    path = bag.close()
    files = sorted(p for p in tmp_path.rglob("*") if p.is_file())
    contents = [p.read_bytes() for p in files]
    seen = np.zeros(3, int)
    for k in range(40):
        damage(files, np.random.default_rng([101, k]))
        seen += read_through(path, "ros")
        for file, content in zip(files, contents, strict=True):
            if file.is_dir():
                file.rmdir()
            file.write_bytes(content)
    assert seen[2] + seen[1] > 0


def test_without_rosbags_it_is_said_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(4096))

    found = importlib.import_module

    def missing(name: str) -> Any:
        if name.startswith("rosbags"):
            raise ImportError(name)
        return found(name)

    monkeypatch.setattr(bags.importlib, "import_module", missing)
    with pytest.raises(InputError, match=r"is a ROS bag; run `pip install 'tofuse\[ros\]'`"):
        open_recording(tmp_path / "a.bag")


COLOR_TOPIC = "/camera/color/image_raw"
RGB_LENS = Pinhole(32, 24, 40.0, 42.0, 15.5, 11.5)
T_RIG_DEPTH, T_RIG_COLOR = exp(
    np.array([[0.1, 0.2, 0.3, 0.1, 0.2, 0.3], [0.12, 0.2, 0.3, 0, 0, 0]])
)
T_WORLD_RIG = exp(np.random.default_rng(101).normal(size=(3, 6)) * 0.1)


def depth_bag(bag: Bag) -> None:
    bag.info("/camera/depth/camera_info", D=())
    for k in range(3):
        bag.image(TOPIC, 10 + 0.1 * k, COUNTS[k], "16UC1")


def color_at(k: int) -> np.ndarray:
    """The column and the row as red and green, the number of the frame as blue."""
    v, u = np.mgrid[0:24, 0:32]
    return np.stack([8 * u, 10 * v, np.full_like(u, 50 + k)], -1).astype(np.uint8)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("compressed", [False, True])
def test_colour_of_a_camera_beside(tmp_path: Path, kind: str, compressed: bool) -> None:
    """By tf_static, with frames between; each point takes the colour of where it lands."""
    bag = Bag(tmp_path, kind)
    depth_bag(bag)
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
        assert isinstance(frame, RangeFrame)
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


def test_colour_at_the_pixels_of_depth(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "ros2")
    topic = "/camera/aligned_depth_to_color/image_raw"
    bag.info("/camera/aligned_depth_to_color/camera_info", D=())
    bag.image(topic, 10.0, COUNTS[0], "16UC1")
    image = np.ascontiguousarray(color_at(0)[:12, :16])
    bag.image(COLOR_TOPIC, 10.0, image, "rgb8", frame="color", width=16)
    frame = open_recording(bag.close())[0]
    assert isinstance(frame, RangeFrame)
    np.testing.assert_array_equal(frame.color_image, image)


def test_colour_without_a_place_is_left_out(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "ros2")
    depth_bag(bag)
    bag.image(COLOR_TOPIC, 10.0, color_at(0), "rgb8", frame="color", width=32)
    recording = open_recording(bag.close())
    frame = recording[0]
    assert isinstance(frame, RangeFrame)
    assert frame.color_image is None
    assert any(f"colour is ignored: the relation of {COLOR_TOPIC}" in w for w in recording.warnings)


@pytest.mark.parametrize("kind", KINDS)
def test_poses_by_tf(tmp_path: Path, kind: str) -> None:
    """Odometry below a map that corrects it; between two messages a frame moves evenly."""
    bag = Bag(tmp_path, kind)
    depth_bag(bag)
    slash = "/" if kind == "ros1" else ""
    bag.tf("/tf_static", 9.0, f"{slash}base_link", f"{slash}depth", T_RIG_DEPTH)
    T_MAP_ODOM = exp(np.array([1.0, 2.0, 0.5, 0.0, 0.0, 0.4]))
    for k, T in enumerate(T_WORLD_RIG):  # at 9.95, 10.05, 10.15: halfway; the last frame has none
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


def test_transforms_that_make_no_sense(tmp_path: Path) -> None:
    """A loop of frames, a quaternion of no length, and a still tree: no poses, and no trouble."""
    bag = Bag(tmp_path, "ros2")
    depth_bag(bag)
    bag.tf("/tf", 10.0, "depth", "a", np.eye(4))
    bag.tf("/tf", 10.0, "a", "depth", np.eye(4))
    bag.tf("/tf_static", 10.0, "world", "b", np.eye(4))
    broken = bag.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 0.0)
    vector = bag.make("geometry_msgs/msg/Vector3", float("nan"), 0.0, 0.0)
    motion = bag.make("geometry_msgs/msg/Transform", vector, broken)
    stamped = bag.make(
        "geometry_msgs/msg/TransformStamped", bag.header(10.0, "map"), "odom", motion
    )
    name = "tf2_msgs/msg/TFMessage"
    bag.write("/tf", name, 10.0, bag.make(name, [stamped]))
    recording = open_recording(bag.close())
    assert len(list(recording)) == 3
    assert recording.odometry is None
