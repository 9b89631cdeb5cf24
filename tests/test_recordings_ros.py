"""ROS bags, written by rosbags' own writers where it is installed."""

from __future__ import annotations

import gc
import importlib
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from test_recordings_fuzz import damage
from test_recordings_fuzz_cameras import read_through
from tofuse.errors import InputError
from tofuse.files.images import png_bytes
from tofuse.geometry.cameras import BrownConrady, Fisheye
from tofuse.recordings.frames import CloudFrame, RangeFrame
from tofuse.recordings.open import open_recording
from tofuse.recordings.readers import ros

RNG = np.random.default_rng(100)
COUNTS = RNG.integers(300, 5000, (3, 12, 16)).astype(np.uint16)
KINDS = ("ros1", "ros2", "mcap")
TOPIC = "/camera/depth/image_rect_raw"


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

    def make(self, name: str, *values: Any) -> Any:
        return self.store.types[name](*values)

    def header(self, time: float) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", int(time), round(time % 1 * 1e9))
        first = (7,) if self.kind == "ros1" else ()
        return self.make("std_msgs/msg/Header", *first, stamp, "depth")

    def write(self, topic: str, kind: str, time: float, message: Any) -> None:
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        turn = self.store.serialize_ros1 if self.kind == "ros1" else self.store.serialize_cdr
        # The message arrives 5 ms after it was taken.
        stamp = round((time + 0.005) * 1e9)
        self.writer.write(self.connections[topic], stamp, turn(message, kind))

    def image(
        self, topic: str, time: float, image: np.ndarray, encoding: str, pad: int = 0
    ) -> None:
        height, width = image.shape
        rows = np.ascontiguousarray(image).view(np.uint8).reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, pad)))
        self.write(
            topic,
            ros._IMAGE,
            time,
            self.make(
                ros._IMAGE, self.header(time), height, width, encoding, 0, rows.shape[1],
                rows.ravel(),
            ),
        )  # fmt: skip

    def compressed(self, topic: str, time: float, data: bytes, format_: str) -> None:
        content = np.frombuffer(data, np.uint8)
        message = self.make(ros._COMPRESSED, self.header(time), format_, content)
        self.write(topic, ros._COMPRESSED, time, message)

    def info(
        self, topic: str, model: str = "plumb_bob", D: tuple[float, ...] = (0.1, 0.02)
    ) -> None:
        K = np.array([20.0, 0, 7.5, 0, 21.0, 5.5, 0, 0, 1])
        roi = self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        D = (*D, *(0.0,) * (5 - len(D)))
        values = (12, 16, model, np.array(D), K, np.eye(3).ravel(), np.zeros(12), 0, 0, roi)
        self.write(topic, ros._INFO, 10.0, self.make(ros._INFO, self.header(10.0), *values))

    def cloud(self, topic: str, time: float, points: np.ndarray, light: np.ndarray) -> None:
        field = "sensor_msgs/msg/PointField"
        names = ("x", "y", "z", "intensity")
        fields = [self.make(field, n, 4 * k, 7, 1) for k, n in enumerate(names)]
        data = np.concatenate([points, light[:, None]], 1).astype("<f4")
        content = np.frombuffer(data.tobytes(), np.uint8)
        message = self.make(
            ros._CLOUD, self.header(time), 1, len(data), fields, False, 16, 16 * len(data),
            content, True,
        )  # fmt: skip
        self.write(topic, ros._CLOUD, time, message)

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


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "ros1")
    bag.image(TOPIC, 10, COUNTS[0], "16UC1")
    with pytest.raises(InputError, match=r"has no CameraInfo beside .*; give .* --camera"):
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

    monkeypatch.setattr(ros.importlib, "import_module", missing)
    with pytest.raises(InputError, match=r"is a ROS bag; give `pip install 'tofuse\[ros\]'`"):
        open_recording(tmp_path / "a.bag")
