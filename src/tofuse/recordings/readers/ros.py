"""Reader of ROS 1 bags, ROS 2 bags and MCAP files, by the package rosbags."""

from __future__ import annotations

import importlib
import struct
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import InputError
from tofuse.files.images import parse_image
from tofuse.files.reading import files_with, is_file, is_folder, read_head
from tofuse.geometry.cameras import BrownConrady, Camera, Fisheye, Pinhole, Rational
from tofuse.parts import part
from tofuse.recordings.camera_file import checked_lens, load_camera
from tofuse.recordings.frames import CloudFrame, DepthKind, Float32, Frame, RangeFrame
from tofuse.recordings.reader import ReaderOptions, Sniff
from tofuse.recordings.sources import FARTHEST_M, FileSource, cloud_frame

Float64 = NDArray[np.float64]

MISSING = "give `pip install 'tofuse[ros]'`, which brings rosbags"

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_INFO, _CLOUD = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/PointCloud2"
_MAGIC = {b"#ROSBAG V2": ".bag", b"\x89MCAP0\r\n": ".mcap"}
_ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
# Depth in whole numbers is in mm by convention (REP 118).
_UNIT_M = {"u": 0.001, "f": 1.0}
_PNG = b"\x89PNG\r\n\x1a\n"
_COMPRESSED_HEAD = 12
_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_AMPLITUDES = ("intensity", "amplitude", "i")


@part("reader", "ros")
@dataclass(frozen=True)
class Ros:
    """A .bag, .db3 or .mcap file, or the folder of a ROS 2 bag, with depth images or clouds."""

    joinable: ClassVar[bool] = False

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        try:
            if is_folder(path):
                if is_file(path / "metadata.yaml") and files_with(path, ".db3", ".mcap"):
                    return Sniff(1.0, "metadata.yaml and a bag")
                return None
            head = read_head(path, 16)
        except InputError:
            return None
        if any(head.startswith(magic) for magic in _MAGIC):
            return Sniff(1.0, "a bag")
        if path.suffix.lower() == ".db3" and head.startswith(b"SQLite format 3"):
            return Sniff(1.0, "a bag")
        return None

    def open(self, path: Path, options: ReaderOptions) -> RosSource:
        """See `Reader.open`."""
        return RosSource(path, options)


class RosSource(FileSource):
    """Messages of the topic that looks most like depth, read in order or one by one."""

    def __init__(self, path: Path, options: ReaderOptions) -> None:
        self.path = path
        self.bag = _open(path)
        weakref.finalize(self, self.bag.close)
        try:
            self._read(options)
        except InputError:
            raise
        except Exception as error:
            raise self._damaged(error) from error

    def _read(self, options: ReaderOptions) -> None:
        self.connection = self._choose()
        found = [(t, _taken(raw, self.bag.is2)) for _, t, raw in self._messages()]
        if not found:
            raise InputError(f"has no message of {self.connection.topic}", where=self.path)
        self.stamps = [arrived for arrived, _ in found]
        super().__init__(np.array([taken or t / 1e9 for t, taken in found]))
        if (np.diff(self.timestamps) <= 0).any():
            self.warnings.append("time goes back or repeats; frames stay in the order of the bag")
        self._running: Iterator[tuple[Any, int, Any]] | None = None
        self._next = 0
        self.kind: DepthKind = "z"
        self.unit: float | None = None
        self.camera: Camera | None = None
        if self.connection.msgtype != _CLOUD:
            self._read_camera(options)
        elif options.camera is not None:
            raise InputError("means nothing for clouds", where="--camera", remedy="leave it out")
        self.metadata |= {"topic": self.connection.topic}
        others = sorted({c.topic for c in self._candidates()} - {self.connection.topic})
        if others:
            self.warnings.append(
                f"the topic {self.connection.topic} is read; there are also {', '.join(others)}"
            )

    def _messages(self, start: int | None = None) -> Iterator[tuple[Any, int, Any]]:
        found: Iterator[tuple[Any, int, Any]] = self.bag.messages(
            connections=[self.connection], start=start
        )
        return found

    def load(self, index: int) -> Frame:
        """See `FileSource.load`."""
        try:
            message = self._message(index)
            time = float(self.timestamps[index])
            if self.connection.msgtype == _CLOUD:
                return _cloud(message, index, time, self._where(index))
            depth = self._depth(message, index)
            assert self.camera is not None
            return RangeFrame(index, time, self.camera, depth, self.kind)
        except InputError:
            raise
        except Exception as error:
            raise self._damaged(error, index) from error

    def _where(self, index: int) -> str:
        return f"{self.path}: {self.connection.topic}, message {index}"

    def _damaged(self, error: Exception, index: int | None = None) -> InputError:
        """Return our own error for whatever rosbags says of a damaged bag."""
        where = str(self.path) if index is None else self._where(index)
        return InputError(
            f"can't be read ({type(error).__name__}: {str(error)[:200]})",
            where=where,
            remedy="check the bag, or reindex it",
        )

    def _candidates(self) -> list[Any]:
        """Return the connections that may hold depth, the likeliest first."""
        return sorted(
            (c for c in self.bag.connections if _rank(c) is not None),
            key=lambda c: (_rank(c), c.topic),
        )

    def _choose(self) -> Any:
        for connection in self._candidates():
            if connection.msgtype != _IMAGE:
                return connection
            for _, _, raw in self.bag.messages(connections=[connection]):
                if self.bag.deserialize(raw, connection.msgtype).encoding in _ENCODINGS:
                    return connection
                break
        topics = ", ".join(sorted({c.topic for c in self.bag.connections}))
        raise InputError(
            f"has no topic of depth images or clouds (there are: {topics[:300] or 'none'})",
            where=self.path,
            remedy="record 16UC1 or 32FC1 images with camera_info, or PointCloud2",
        )

    def _read_camera(self, options: ReaderOptions) -> None:
        if options.camera is not None:
            about, self.camera = load_camera(options.camera)
            self.kind, self.unit = about.depth_kind, about.depth_unit_m
            return
        folder = self.connection.topic.rsplit("/", 1)[0]
        infos = [c for c in self.bag.connections if c.msgtype == _INFO]
        near = [c for c in infos if c.topic.rsplit("/", 1)[0] in (folder, folder.rsplit("/", 1)[0])]
        chosen = near or [c for c in infos if "depth" in c.topic] or infos[: len(infos) == 1]
        if not chosen:
            raise InputError(
                f"has no CameraInfo beside {self.connection.topic}",
                where=self.path,
                remedy="give the depth camera by --camera camera.json",
            )
        where = f"{self.path}: {chosen[0].topic}"
        for _, _, raw in self.bag.messages(connections=[chosen[0]]):
            self.camera = _lens(self.bag.deserialize(raw, chosen[0].msgtype), where)
            return
        raise InputError("has no message", where=where, remedy="give --camera camera.json")

    def _message(self, index: int) -> Any:
        """Return a message; the next one follows the last without a search."""
        if self._running is None or index != self._next:
            # Of messages of one time, the one that is meant is so many further on.
            time = self.stamps[index]
            self._running = self._messages(time)
            for _ in range(index - self.stamps.index(time)):
                next(self._running)
        self._next = index + 1
        try:
            _, _, raw = next(self._running)
            return self.bag.deserialize(raw, self.connection.msgtype)
        except BaseException:
            self._running = None
            raise

    def _depth(self, message: Any, index: int) -> Float32:
        where = self._where(index)
        if self.connection.msgtype == _COMPRESSED:
            counts = _decompressed(message, where)
        else:
            counts = _image(message, where)
        camera = self.camera
        if camera is not None and counts.shape != (camera.height, camera.width):
            raise InputError(
                f"is {counts.shape[1]} x {counts.shape[0]} pixels, its camera "
                f"{camera.width} x {camera.height}",
                where=where,
                remedy="give the camera of these images by --camera",
            )
        unit = self.unit if self.unit and counts.dtype.kind == "u" else _UNIT_M[counts.dtype.kind]
        with np.errstate(all="ignore"):
            depth = counts.astype(np.float32) * np.float32(unit)
        if counts.dtype.kind == "u":
            depth[counts == 65535] = 0
        return np.where(np.abs(depth) < FARTHEST_M, depth, np.float32(0))


def _open(path: Path) -> Any:
    try:
        highlevel = importlib.import_module("rosbags.highlevel")
        typesys = importlib.import_module("rosbags.typesys")
    except ImportError as error:
        raise InputError("is a ROS bag", where=path, remedy=MISSING) from error
    try:
        store = typesys.get_typestore(typesys.Stores.LATEST)
        bag = highlevel.AnyReader([path], default_typestore=store)
        bag.open()
        return bag
    except Exception as error:
        raise InputError(
            f"can't be opened as a bag ({type(error).__name__}: {str(error)[:200]})",
            where=path,
            remedy="check the bag, or reindex it; for RealSense's and Orbbec's own .bag, export it",
        ) from error


def _rank(connection: Any) -> int | None:
    """Return how likely a topic holds depth, 0 the most; None if it can't."""
    topic, kind = connection.topic.lower(), connection.msgtype
    if kind == _IMAGE and "depth" in topic:
        # Depth as the depth camera sees it comes before what was moved into another view.
        moved = any(word in topic for word in ("align", "regist", "_to_", "color", "rgb"))
        return 1 if moved else 0
    if kind == _COMPRESSED and topic.endswith("compresseddepth"):
        return 2
    if kind == _IMAGE and any(word in topic for word in ("distance", "range")):
        return 3
    return 4 if kind == _CLOUD else None


def _taken(raw: Any, is2: bool) -> float:
    """Seconds at which a message was taken, by the header that it begins with; 0 if not told.

    After four bytes (ROS 1: the sequence number; ROS 2: the encoding) come seconds and nanoseconds.
    """
    head = bytes(raw[:12])
    if len(head) < 12:
        return 0.0
    big_endian = is2 and not head[1] & 1
    seconds, nanoseconds = struct.unpack_from(">II" if big_endian else "<II", head, 4)
    return seconds + nanoseconds / 1e9 if nanoseconds < 10**9 else 0.0


def _image(message: Any, where: str) -> NDArray[Any]:
    """Return the (H, W) image of a message, with the padding of its rows left out."""
    if message.encoding not in _ENCODINGS:
        raise InputError(f"has the encoding {message.encoding!r:.40}", where=where)
    order = ">" if message.is_bigendian else "<"
    kind = np.dtype(order + _ENCODINGS[message.encoding])
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(message.data, np.uint8)
    if not (0 < width <= 16384 and 0 < height <= 16384) or step < width * kind.itemsize:
        raise InputError(f"claims {width} x {height} pixels of {step} bytes a row", where=where)
    if len(data) < step * height:
        raise InputError("is cut off", where=where, remedy="check the bag")
    rows = data[: step * height].reshape(height, step)[:, : width * kind.itemsize]
    return np.ascontiguousarray(rows).view(kind)


def _decompressed(message: Any, where: str) -> NDArray[Any]:
    """Return the image of compressed_depth_image_transport: PNG, of inverse depth for floats."""
    data = bytes(message.data)
    at = data.find(_PNG, 0, 64)
    if at < 0:
        raise InputError("isn't compressed as PNG", where=where, remedy="record it as PNG or raw")
    counts = parse_image(data[at:], where, dtype="uint16")
    if not str(message.format).startswith("32FC1"):
        return counts
    if at < _COMPRESSED_HEAD:
        raise InputError("lacks the parameters of its depth", where=where)
    a, b = np.frombuffer(data, "<f4", 2, at - 8)
    with np.errstate(all="ignore"):
        depth = np.float32(a) / (counts.astype(np.float32) - np.float32(b))
    return np.where(counts > 0, depth, np.float32(np.nan)).astype(np.float32)


def _lens(info: Any, where: str) -> Pinhole:
    """Return the lens of a CameraInfo; rows 1 and 2 are called k and d in ROS 2, K and D in 1."""
    K = np.asarray(getattr(info, "k", getattr(info, "K", ())), float)
    D = [float(v) for v in getattr(info, "d", getattr(info, "D", ()))]
    if K.shape != (9,):
        raise InputError("has no 3x3 matrix K", where=where, remedy="give --camera camera.json")
    values = {"fx": K[0], "fy": K[4], "cx": K[2], "cy": K[5]}
    model = str(info.distortion_model)
    cls: type[Pinhole] = Pinhole
    names: tuple[str, ...] = ()
    if any(D):
        if model in ("equidistant", "fisheye"):
            cls, names = Fisheye, ("k1", "k2", "k3", "k4")
        elif model == "plumb_bob" or (not model and len(D) == 5):
            cls, names = BrownConrady, ("k1", "k2", "p1", "p2", "k3")
        elif model == "rational_polynomial":
            cls, names = Rational, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        else:
            raise InputError(
                f"has the distortion model {model!r:.40}",
                where=where,
                remedy="give --camera camera.json",
            )
        if any(D[len(names) :]):
            raise InputError(
                f"has {len(D)} coefficients for {model}", where=where, remedy="give --camera"
            )
    values |= dict(zip(names, D, strict=False))
    numbers = {name: float(v) for name, v in values.items()}
    return checked_lens(cls, (int(info.width), int(info.height)), numbers, where)


def _cloud(message: Any, index: int, time: float, where: str) -> CloudFrame:
    """Return the points of a PointCloud2, with its intensity."""
    order = ">" if message.is_bigendian else "<"
    fields = {f.name: f for f in message.fields if f.datatype in _FIELD_TYPES}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise InputError(f"has no field {missing[0]!r}", where=where, remedy="record x, y and z")
    count, step = int(message.width) * int(message.height), int(message.point_step)
    data = np.frombuffer(message.data, np.uint8)
    if step < 1 or count * step > len(data):
        raise InputError("is cut off", where=where, remedy="check the bag")
    rows = data[: count * step].reshape(count, step)

    def column(name: str) -> Float32:
        field = fields[name]
        kind = np.dtype(order + _FIELD_TYPES[field.datatype])
        start = int(field.offset)
        if start + kind.itemsize > step:
            raise InputError(f"has its field {name!r} outside of a point", where=where)
        values = np.ascontiguousarray(rows[:, start : start + kind.itemsize]).view(kind)[:, 0]
        with np.errstate(all="ignore"):
            return values.astype(np.float32)

    points = np.stack([column(name) for name in "xyz"], 1)
    amplitude = next((column(name) for name in _AMPLITUDES if name in fields), None)
    return cloud_frame(index, time, points, amplitude=amplitude)
