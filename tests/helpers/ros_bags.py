"""ROS bags as camera drivers write them."""

from __future__ import annotations

import gc
import importlib
import struct
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.geometry import quaternion
from tofuse.engine.geometry.se3 import exp
from tofuse.formats.readers import ros

RNG = np.random.default_rng(100)


COUNTS = RNG.integers(300, 5000, (3, 12, 16)).astype(np.uint16)


TOPIC = "/camera/depth/image_rect_raw"


DEPTH_LENS = Pinhole(16, 12, 20.0, 21.0, 7.5, 5.5)


@cache
def typestore(name: str) -> Any:
    """The message types of a ROS version, which take a while to make, and those of tf2."""
    typesys = importlib.import_module("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores[name])
    if "tf2_msgs/msg/TFMessage" not in store.types:
        text = "geometry_msgs/TransformStamped[] transforms"
        store.register(typesys.get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
    return store


class Bag:
    """Writes messages to a bag of a kind."""

    def __init__(self, folder: Path, kind: str, compression: str | None = None) -> None:
        pytest.importorskip("rosbags", reason="the package rosbags is not installed")
        self.kind = kind
        self.store = typestore("ROS1_NOETIC" if kind == "ros1" else "ROS2_HUMBLE")
        if kind == "ros1":
            self.path = folder / "a.bag"
            self.writer = importlib.import_module("rosbags.rosbag1").Writer(self.path)
        else:
            rosbag2 = importlib.import_module("rosbags.rosbag2")
            self.path = folder / "a"
            plugin = rosbag2.StoragePlugin["MCAP" if kind == "mcap" else "SQLITE3"]
            self.writer = rosbag2.Writer(self.path, version=9, storage_plugin=plugin)
        if compression is not None and kind == "ros1":
            self.writer.set_compression(self.writer.CompressionFormat[compression])
        elif compression is not None:
            mode = rosbag2.CompressionMode[compression]
            self.writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
        self.writer.open()
        self.connections: dict[str, Any] = {}

    def make(self, name: str, *values: Any) -> Any:
        return self.store.types[name](*values)

    def header(self, time: float, frame: str = "depth") -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", int(time), round(time % 1 * 1e9))
        first = (7,) if self.kind == "ros1" else ()
        return self.make("std_msgs/msg/Header", *first, stamp, frame)

    def vector(self, kind: str, values: Any) -> Any:
        return self.make(f"geometry_msgs/msg/{kind}", *map(float, values))

    def motion(self, T: np.ndarray) -> tuple[Any, Any]:
        turn = self.vector("Quaternion", quaternion.from_matrix(T[:3, :3]))
        return self.vector("Vector3", T[:3, 3]), turn

    def tf(self, topic: str, time: float, parent: str, child: str, T: np.ndarray) -> None:
        motion = self.make("geometry_msgs/msg/Transform", *self.motion(T))
        kind = "geometry_msgs/msg/TransformStamped"
        stamped = self.make(kind, self.header(time, parent), child, motion)
        self.write(topic, "tf2_msgs/msg/TFMessage", time, [stamped])

    def imu(
        self, topic: str, time: float, frame: str, acceleration: np.ndarray, known: float = 0.0
    ) -> None:
        zero, covariance = np.zeros(9), np.array([known, *np.zeros(8)])
        speed, turn = self.motion(np.eye(4))
        values = (turn, zero, speed, zero, self.vector("Vector3", acceleration), covariance)
        self.write(topic, "sensor_msgs/msg/Imu", time, self.header(time, frame), *values)

    def odometry(self, topic: str, time: float, parent: str, child: str, T: np.ndarray) -> None:
        still = self.vector("Vector3", np.zeros(3))
        parts = {
            "Pose": (self.vector("Point", T[:3, 3]), self.motion(T)[1]),
            "Twist": (still, still),
        }
        values = (
            self.make(f"{name}WithCovariance", self.make(name, *part), np.zeros(36))
            for name, part in ((f"geometry_msgs/msg/{n}", part) for n, part in parts.items())
        )
        header = self.header(time, parent)
        self.write(topic, "nav_msgs/msg/Odometry", time, header, child, *values)

    def write(self, topic: str, kind: str, time: float, *values: Any) -> None:
        message = self.make(kind, *values)
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        turn = self.store.serialize_ros1 if self.kind == "ros1" else self.store.serialize_cdr
        # The message is recorded 5 ms after its timestamp.
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
        size = (height, width, encoding, 0, rows.shape[1])
        self.write(topic, ros.IMAGE, time, self.header(time, frame), *size, rows.ravel())

    def depth(self, topic: str = TOPIC, count: int = 1, **lens: Any) -> None:
        """Depth images 0.1 s apart, and the lens beside them."""
        self.info(f"{topic.rpartition('/')[0]}/camera_info", **{"D": (), **lens})
        for k in range(count):
            self.image(topic, 10 + 0.1 * k, COUNTS[k], "16UC1")

    def compressed(
        self, topic: str, time: float, data: bytes, format_: str, frame: str = "depth"
    ) -> None:
        content = np.frombuffer(data, np.uint8)
        self.write(topic, ros.COMPRESSED, time, self.header(time, frame), format_, content)

    def transform(self, topic: str, T: np.ndarray) -> None:
        self.write(topic, "geometry_msgs/msg/Transform", 1.0, *self.motion(T))

    def info(
        self,
        topic: str,
        model: str = "plumb_bob",
        D: tuple[float, ...] = (0.1, 0.02),
        lens: Pinhole = DEPTH_LENS,
        P: np.ndarray | None = None,
        binning: tuple[int, int] = (0, 0),
        roi: tuple[int, int, int, int] = (0, 0, 0, 0),
    ) -> None:
        """With `roi` x, y, height and width."""
        K = np.array([lens.fx, 0, lens.cx, 0, lens.fy, lens.cy, 0, 0, 1])
        window = self.make("sensor_msgs/msg/RegionOfInterest", *roi, False)
        D = (*D, *(0.0,) * (5 - len(D)))
        size = (lens.height, lens.width)
        values = (*size, model, np.array(D), K, np.eye(3).ravel())
        values = (*values, np.zeros(12) if P is None else P.ravel(), *binning, window)
        self.write(topic, ros.INFO, 10.0, self.header(10.0), *values)

    def cloud(
        self,
        topic: str,
        time: float,
        points: np.ndarray,
        light: np.ndarray,
        height: int = 1,
        dtype: str = "<f4",
        color: np.ndarray | None = None,
        pad: int = 0,
    ) -> None:
        """With packed `color` (N, 3), and with `pad` more points' bytes at the end of each row."""
        field = "sensor_msgs/msg/PointField"
        names, size = ("x", "y", "z", "intensity"), np.dtype(dtype).itemsize
        kind = {"f4": 7, "f8": 8}[dtype[1:]]
        fields = [self.make(field, n, size * k, kind, 1) for k, n in enumerate(names)]
        data = np.concatenate([points, light[:, None]], 1).astype(dtype)
        if color is not None:
            fields.append(self.make(field, "rgb", 4 * size, 7, 1))
            packed = np.c_[color[:, ::-1], np.zeros(len(color))].astype("u1").view(dtype)
            data = np.concatenate([data, packed], 1)
        rows = data.reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, pad * len(fields))), constant_values=9)
        content = np.frombuffer(rows.tobytes(), np.uint8)
        values = (height, len(data) // height, fields, dtype[0] == ">", len(fields) * size)
        header = self.header(time)
        self.write(topic, ros.CLOUD, time, header, *values, len(content) // height, content, True)

    def close(self) -> Path:
        self.writer.close()
        # Its MCAP writer leaves a file open until garbage collection.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)
            del self.writer
            gc.collect()
        return self.path


# Colour with depth: poses of both cameras in a common frame, and an image with distinct pixels.
T_DEPTH = exp([0.01, 0.02, -0.005, 0.02, -0.03, 0.01])


T_COLOR = exp([-0.06, 0.01, 0.004, 0.01, 0.12, -0.05])


COLOR_LENS = Pinhole(48, 40, 40.0, 41.0, 23.0, 20.0)


COLOR_V, COLOR_U = np.mgrid[:40, :48]


COLORS = np.stack([5 * COLOR_U, 6 * COLOR_V, 0 * COLOR_U + 200], -1).astype(np.uint8)


STEP = np.full((12, 16), 8000, np.uint16)  # a wall at 2 m, and a box at 1 m in front of it


STEP[4:8, 6:10] = 4000


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
        bag.write("/device_0/sensor_0/option/Depth_Units/value", number, 1.0, 0.00025)
        if color:
            bag.info(COLOR_STREAM + "/info/camera_info", "Brown Conrady", distortion, COLOR_LENS)
            for part, T in ((stream, T_DEPTH), (COLOR_STREAM, T_COLOR)):
                bag.transform(f"{part}/tf/0", T)
    else:
        coeffs = ",".join(map(str, D if model != "None" else (0,) * 5))
        lens = f"width=16;height=12;fx=20;ppx=7.5;fy=21;ppy=5.5;model={model};coeffs={coeffs}"
        bag.write(f"{stream}/camera_info", text, 1.0, lens)
        if color:
            coeffs = ",".join(map(str, distortion))
            lens = "width=48;height=40;fx=40;ppx=23;fy=41;ppy=20;model=Inverse Brown Conrady;"
            bag.write(f"{COLOR_STREAM}/camera_info", text, 1.0, f"{lens}coeffs={coeffs}")
            for part, T in ((stream, T_DEPTH), (COLOR_STREAM, T_COLOR)):
                extrinsics = "rotation=" + ",".join(map(str, T[:3, :3].T.ravel()))  # by columns
                extrinsics += ";translation=" + ",".join(map(str, T[:3, 3]))
                bag.write(f"{part}/tf/0", text, 1.0, extrinsics)
        bag.write("/device_0/sensor_0/option/Depth_Units/value", text, 1.0, "0.000250")
    pair = "diagnostic_msgs/msg/KeyValue"
    for key, value in (("Serial Number", "f0001"), ("Name", name)):
        bag.write("/device_0/info", pair, 1.0, key, value)
    for k in range(3):
        bag.image(f"{stream}/image/data", 10 + k / 30, STEP if color else COUNTS[k], "mono16")
        if color and k != 1:
            image = packed(COLORS, color)
            bag.image(COLOR_STREAM + "/image/data", 10.004 + k / 30, image, color, width=48)
        infrared = (COUNTS[k] % 250).astype(np.uint8)
        bag.image("/device_0/sensor_0/Infrared_0/image/data", 10 + k / 30, infrared, "mono8")
    return bag.close()


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


def orbbec(
    folder: Path, distortion: tuple[float, ...], *, color: str = "", R: np.ndarray | None = None
) -> Path:
    """A bag as Orbbec's SDK writes it: ROS images with fields appended, and profiles of its own."""
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
