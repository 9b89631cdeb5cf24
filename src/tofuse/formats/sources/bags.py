"""ROS bags by the package rosbags: topics, messages, and the tf tree."""

from __future__ import annotations

import errno
import struct
import tempfile
import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Float32, Float64, Intp, UInt8
from tofuse.engine.cameras import DISTORTION_ORDER, MODELS, Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.frames import Frame, depth_counts
from tofuse.engine.fusion import GeometryRecord
from tofuse.engine.geometry import quaternion, se3
from tofuse.engine.times import partners
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading
from tofuse.formats.geometry import unpacked_color
from tofuse.formats.images import as_color, parse_image
from tofuse.formats.poses import interpolated_poses
from tofuse.formats.sources.file_source import FileSource
from tofuse.formats.sources.imu import ACCELERATION
from tofuse.formats.sources.pixels import finite_float32, sampled_color
from tofuse.formats.sources.reader import ReaderOptions

REMEDY = "check the bag, or repair it by `mcap recover` or `rosbag reindex`"
MAX_GAP_S = 0.02  # between the images of one frame
_PROFILE = 21  # of MCAP's header: after magic, record type, and two lengths
_MAGIC = {"ros1": b"#ROSBAG V2", "mcap": b"\x89MCAP0\r\n"}


def bag_kind(path: Path) -> str | None:
    """Return "folder" for that of a ROS 2 bag, "ros1", "mcap" or "db3" for such files, or None."""
    if reading.is_folder(path):
        is_bag = reading.is_file(path / "metadata.yaml") and reading.files_with(
            path, ".db3", ".mcap", ".zstd"
        )
        return "folder" if is_bag else None
    head = reading.read_head(path, 16)
    if head.startswith(b"SQLite format 3"):
        return "db3" if path.suffix.lower() == ".db3" else None
    return next((kind for kind, magic in _MAGIC.items() if head.startswith(magic)), None)


def open_bag(path: Path) -> Any:
    """Open a bag; the caller has to ``close`` it.

    Raises
    ------
    InputError
        If rosbags is missing, or can't open it.
    """
    highlevel = reading.required_package("rosbags.highlevel", "ros", path)
    typesys = reading.required_package("rosbags.typesys", "ros", path)
    if reading.is_folder(path):
        for entry in reading.list_folder(path):
            if not reading.is_file(entry) and not reading.is_folder(
                entry
            ):  # rosbags would wait for a pipe
                raise InputError(
                    "is not a regular file", where=entry, remedy="remove it from the bag"
                )
    _check_profile(path)
    types = typesys.get_typestore(typesys.Stores.LATEST)
    return _opened(path, lambda: highlevel.AnyReader([path], default_typestore=types))


def _check_profile(path: Path) -> None:
    """Refuse MCAP files of other programs than ROS 2, which its header names."""
    head = reading.read_head(path, 64) if reading.is_file(path) else b""
    if len(head) < _PROFILE or not head.startswith(_MAGIC["mcap"]):
        return
    (length,) = struct.unpack_from("<I", head, _PROFILE - 4)
    profile = head[_PROFILE : _PROFILE + length].decode("utf-8", "replace")
    if profile != "ros2":
        raise InputError(
            f"contains no messages of ROS 2 (its profile is {profile!r:.40})",
            where=path,
            remedy="convert it to a ROS bag, or save its images as .npz (docs/formats.md)",
        )


def open_container(path: Path) -> Any:
    """Open a ROS 1 bag without decoding its messages; else as `open_bag`.

    The message definitions in the bags of some makers are incomplete.
    """
    rosbag1 = reading.required_package("rosbags.rosbag1", "ros", path)
    return _opened(path, lambda: rosbag1.Reader(path))


def _opened(path: Path, reader: Callable[[], Any]) -> Any:
    with reading.library_errors(path, REMEDY):
        try:
            bag = reader()
            bag.open()
        except OSError as error:
            if error.errno != errno.ENOSPC:
                raise
            raise InputError(
                "has no space for the decompressed files of a bag",
                where=tempfile.gettempdir(),
                remedy="free some space, or set TMPDIR to another folder",
            ) from error
        return bag


class Track:
    """The messages of one topic, with sequential and random access.

    Attributes
    ----------
    connection
        A connection of rosbags, with ``topic`` and ``msgtype``. A topic has another one for each
        publisher, such as for a driver that was restarted.
    times
        (N,) s, from the message headers, or else of their arrival.
    """

    def __init__(self, bag: Any, connection: Any) -> None:
        self.bag, self.connection = bag, connection
        kind = (connection.topic, connection.msgtype)
        self._connections = [c for c in bag.connections if (c.topic, c.msgtype) == kind]
        times_of_messages = [
            (t, header_time(raw, getattr(bag, "is2", False))) for _, t, raw in self._messages()
        ]
        self._arrival_times = [arrival for arrival, _ in times_of_messages]
        self.times: Float64 = np.array([stamp or t / 1e9 for t, stamp in times_of_messages])
        self._iterator: Iterator[tuple[Any, int, Any]] | None = None
        self._next = 0

    def __len__(self) -> int:
        return len(self._arrival_times)

    def raw(self, index: int) -> Any:
        """Return the bytes of a message; reading in order needs no search."""
        if self._iterator is None or index != self._next:
            # Skip earlier messages with the same arrival time.
            time = self._arrival_times[index]
            self._iterator = self._messages(time)
            for _ in range(index - self._arrival_times.index(time)):
                next(self._iterator)
        self._next = index + 1
        try:
            return next(self._iterator)[2]
        except BaseException:
            self._iterator = None
            raise

    def message(self, index: int) -> Any:
        """Return a message, decoded by rosbags."""
        raw = self.raw(index)
        try:
            return self.bag.deserialize(raw, self.connection.msgtype)
        except BaseException:
            self._iterator = None
            raise

    def nearest(self, time: float, limit: float) -> int | None:
        """Return the index of the message nearest to `time`, or None beyond `limit`, both in s."""
        if not len(self.times):
            return None
        k = int(np.argmin(np.abs(self.times - time)))
        return k if abs(self.times[k] - time) <= limit else None

    def _messages(self, start: int | None = None) -> Iterator[tuple[Any, int, Any]]:
        messages: Iterator[tuple[Any, int, Any]] = self.bag.messages(
            connections=self._connections, start=start
        )
        return messages


class BagSource(FileSource):
    """A source over depth images of a bag, with amplitude and colour of other topics.

    Attributes
    ----------
    depth, amplitude, color
        The messages of each topic; None where the bag has none.
    """

    amplitude_kind = "ir"
    depth: Track
    amplitude: Track | None = None
    color: Track | None = None

    def __init__(self, path: Path, options: ReaderOptions) -> None:
        self.path = path
        self.bag = self.open_bag(path)
        weakref.finalize(self, self.bag.close)
        super().__init__(np.zeros(0))
        with reading.library_errors(path, REMEDY):
            self.find_streams(options)

    @staticmethod
    def open_bag(path: Path) -> Any:
        """Open the bag, so that its messages can be decoded."""
        return open_bag(path)

    def find_streams(self, options: ReaderOptions) -> None:
        """Set the attributes of the streams, and those of `FileSource`."""
        raise NotImplementedError

    def set_timestamps(self) -> None:
        """Take the timestamps of `depth`."""
        self.timestamps = self.depth.times
        if (np.diff(self.timestamps) <= 0).any():
            self.warnings.append("time decreases or repeats; frames stay in the order of the bag")

    def load(self, index: int) -> Frame:
        """See `FileSource.load`."""
        where = self.where(index)
        with reading.library_errors(where, REMEDY):
            return self.read_frame(index, where)

    def read_frame(self, index: int, where: str) -> Frame:
        """Read a frame, which `where` names in errors."""
        time = float(self.timestamps[index])
        depth = self.read_depth(index, where)
        frame = self.image(index, depth, amplitude_image=self._amplitude_at(time, where))
        message = self._color_messages[index]
        if self.color is None or message < 0:
            return frame
        track, where = self.color, f"{where}, colour"

        def read_color() -> UInt8:
            with reading.library_errors(where, REMEDY):
                color = self.read_color(track, message, where)
            return sampled_color(frame, color, self.color_camera, where)

        return replace(frame, color_image=self.color_if_readable(index, read_color))

    def has_color(self, index: int) -> bool:
        """See `FileSource.has_color`."""
        return bool(self._color_messages[index] >= 0)

    @cached_property
    def _color_messages(self) -> Intp:
        """The message (N,) with the colour of each frame, or -1."""
        times = () if self.color is None else self.color.times
        return partners(self.timestamps, times, MAX_GAP_S)

    def read_depth(self, index: int, where: str) -> Float32:
        """Return the depth (H, W) of a frame in m."""
        counts = image(self.message(self.depth, index), where, ENCODINGS)
        camera_file.check_size(counts, self.camera, where)
        return depth_counts.depth_from_counts(counts.astype(np.uint16), self.unit)

    def read_color(self, track: Track, index: int, where: str) -> UInt8:
        """Return an image (H, W, 3) of a track."""
        return color_image(self.message(track, index), where)

    def message(self, track: Track, index: int) -> Any:
        """Return a message of a track."""
        return track.message(index)

    def _amplitude_at(self, time: float, where: str) -> Float32 | None:
        """The amplitude (H, W) within `MAX_GAP_S` of a time in s; zeros if there is none."""
        if self.amplitude is None:
            return None
        k = self.amplitude.nearest(time, MAX_GAP_S)
        if k is None:
            return np.zeros((self.camera.height, self.camera.width), np.float32)
        where = f"{where}, amplitude"
        counts = image(self.message(self.amplitude, k), where, GREY)
        camera_file.check_size(counts, self.camera, where)
        return finite_float32(counts)


def first_message(bag: Any, topic: str) -> Any:
    """Return the first message of a topic, or None if there is none."""
    connections = [c for c in bag.connections if c.topic == topic]
    if connections:
        for connection, _, raw in bag.messages(connections=connections):
            return bag.deserialize(raw, connection.msgtype)
    return None


ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
GREY = {"mono8": "u1", "8UC1": "u1", **ENCODINGS}
# Bytes per pixel, and the channels that are red, green and blue, or the packing of YUV.
_COLOR_LAYOUTS: dict[str, tuple[int, list[int] | str]] = {
    "rgb8": (3, [0, 1, 2]),
    "bgr8": (3, [2, 1, 0]),
    "rgba8": (4, [0, 1, 2]),
    "bgra8": (4, [2, 1, 0]),
    "mono8": (1, [0, 0, 0]),
    **dict.fromkeys(("yuv422", "uyvy"), (2, "uyvy")),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, "yuyv")),
}
COLORS = frozenset(_COLOR_LAYOUTS) - {"mono8"}
_JPEG = b"\xff\xd8"
_PNG = b"\x89PNG\r\n\x1a\n"
_COMPRESSED_HEAD = 12
_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_AMPLITUDES = ("intensity", "amplitude", "i")
_MAX_SIDE = 16384


def header_time(raw: Any, is2: bool) -> float:
    """Return the timestamp in s of the header at the beginning of a message; 0 if it is not set.

    After four bytes (ROS 1: the sequence number; ROS 2: the encoding) come seconds and nanoseconds.
    """
    head = bytes(raw[:12])
    if len(head) < 12:
        return 0.0
    big_endian = is2 and not head[1] & 1
    seconds, nanoseconds = struct.unpack_from(">II" if big_endian else "<II", head, 4)
    return seconds + nanoseconds / 1e9 if nanoseconds < 10**9 else 0.0


def image(message: Any, where: str, encodings: dict[str, str] = ENCODINGS) -> NDArray[Any]:
    """Return the (H, W) image of a message, without the padding of its rows.

    Raises
    ------
    InputError
        If it has another encoding, or is cut off.
    """
    if message.encoding not in encodings:
        raise InputError(f"has the encoding {message.encoding!r:.40}", where=where)
    order = ">" if message.is_bigendian else "<"
    dtype = np.dtype(order + encodings[message.encoding])
    return np.ascontiguousarray(_rows(message, dtype.itemsize, where)).view(dtype)


def _rows(message: Any, pixel_bytes: int, where: str) -> UInt8:
    """(H, W * pixel_bytes) content of a message, without the padding of its rows."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(message.data, np.uint8)
    if not (0 < width <= _MAX_SIDE and 0 < height <= _MAX_SIDE) or step < width * pixel_bytes:
        raise InputError(f"declares {width} x {height} pixels of {step} bytes per row", where=where)
    if len(data) < step * height:
        raise InputError("is cut off", where=where, remedy="check the bag")
    return data[: step * height].reshape(height, step)[:, : width * pixel_bytes]


def color_image(message: Any, where: str) -> UInt8:
    """Return the (H, W, 3) RGB image of a message.

    Raises
    ------
    InputError
        If it has another encoding, is cut off or damaged.
    """
    height, width = int(message.height), int(message.width)
    data = bytes(message.data)
    if data.startswith(_JPEG):
        return as_color(parse_image(data, where, size=(width, height)))
    encoding = str(message.encoding).lower()
    if encoding not in _COLOR_LAYOUTS:
        raise InputError(f"has the encoding {message.encoding!r:.40}", where=where)
    channels, order = _COLOR_LAYOUTS[encoding]
    pixels = _rows(message, channels, where).reshape(height, width, channels)
    if isinstance(order, str):
        if width % 2:
            raise InputError(f"is {width} pixels wide and {encoding}", where=where)
        import cv2

        code = {"uyvy": cv2.COLOR_YUV2RGB_UYVY, "yuyv": cv2.COLOR_YUV2RGB_YUY2}[order]
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), code), np.uint8)
    return np.ascontiguousarray(pixels[..., order])


def decompressed(message: Any, where: str) -> NDArray[Any]:
    """Return the image of compressed_depth_image_transport: PNG, of inverse depth for floats."""
    data = bytes(message.data)
    start = data.find(_PNG, 0, 64)
    if start < 0:
        raise InputError("isn't compressed as PNG", where=where, remedy="record it as PNG or raw")
    counts = parse_image(data[start:], where, dtype="uint16")
    if not str(message.format).startswith("32FC1"):
        return counts
    if start < _COMPRESSED_HEAD:
        raise InputError("lacks the parameters of its depth", where=where)
    a, b = np.frombuffer(data, "<f4", 2, start - 8)
    with np.errstate(all="ignore"):
        depth = np.float32(a) / (counts.astype(np.float32) - np.float32(b))
    return np.where(counts > 0, depth, np.float32(np.nan)).astype(np.float32)


def decompressed_color(message: Any, where: str) -> UInt8:
    """Return the (H, W, 3) RGB image of compressed_image_transport: JPEG or PNG."""
    return as_color(parse_image(bytes(message.data), where))


@dataclass(frozen=True)
class Info:
    """A CameraInfo: size, focal lengths and centre by name, model and coefficients of the lens."""

    size: tuple[int, int]
    values: dict[str, float]
    model: str
    coefficients: list[float]


def camera_info(message: Any, where: str) -> Info:
    """Read a CameraInfo; its matrices are called k and d in ROS 2, K and D in ROS 1.

    Raises
    ------
    InputError
        If it has no matrix K.
    """
    K = np.asarray(getattr(message, "k", getattr(message, "K", ())), float)
    D = [float(v) for v in getattr(message, "d", getattr(message, "D", ()))]
    if K.shape != (9,):
        raise InputError("has no 3x3 matrix K", where=where, remedy="use --camera camera.json")
    values = {"fx": float(K[0]), "fy": float(K[4]), "cx": float(K[2]), "cy": float(K[5])}
    return Info((int(message.width), int(message.height)), values, str(message.distortion_model), D)


def lens(message: Any, where: str, *, rectified: bool = False) -> Pinhole:
    """Return the lens of a CameraInfo, or, if `rectified`, that of the images made from it: of P.

    Raises
    ------
    InputError
        If its model is none of ROS's own, or it has more coefficients than the model.
    """
    info = camera_info(message, where)
    model, D = info.model, info.coefficients
    P = np.asarray(getattr(message, "p", getattr(message, "P", ())), float)
    if rectified and P.shape == (12,) and P[0] > 0 and P[5] > 0:
        return camera_file.checked_pinhole(P.reshape(3, 4), info.size, where)
    if info.values["fx"] == 0:  # by ROS's convention
        raise InputError(
            "is of a camera that is not calibrated (K is zero)",
            where=where,
            remedy="pass the depth camera with --camera camera.json",
        )
    name = "pinhole"
    if any(D):
        if model in ("equidistant", "fisheye"):
            name = "fisheye"
        elif model == "plumb_bob" or (not model and len(D) == 5):
            name = "brown"
        elif model == "rational_polynomial":
            name = "rational"
        else:
            raise InputError(
                f"has the distortion model {model!r:.40}",
                where=where,
                remedy="use --camera camera.json",
            )
        if any(D[len(DISTORTION_ORDER[name]) :]):
            raise InputError(
                f"has {len(D)} coefficients for {model}", where=where, remedy="use --camera"
            )
    coefficients = dict(zip(DISTORTION_ORDER[name], D, strict=False))
    return camera_file.checked_lens(MODELS[name], info.size, info.values | coefficients, where)


FITS = 2


def info_rank(message: Any, where: str, size: tuple[int, int] | None) -> int:
    """Return `FITS` for the lens of images of a size, 1 for another lens, 0 for zeros."""
    if camera_info(message, where).values["fx"] == 0:
        return 0
    return FITS if size in (None, *_sizes(message)) else 1


def _sizes(message: Any) -> tuple[tuple[int, int], tuple[int, int]]:
    """Width and height that a CameraInfo states, and those of its binned region of interest."""
    whole, roi = (int(message.width), int(message.height)), message.roi
    width, height = roi.width or whole[0], roi.height or whole[1]
    return whole, (width // max(message.binning_x, 1), height // max(message.binning_y, 1))


def shown_part(lens: Pinhole, message: Any, size: tuple[int, int]) -> Pinhole:
    """Return the lens of images of a size (width, height) from that of a CameraInfo.

    Unless they have its size, they are the region of interest that it states, or binned.
    """
    whole, (width, height) = _sizes(message)
    if size == whole or size != (width, height):
        return lens
    roi, binning = message.roi, (max(message.binning_x, 1), max(message.binning_y, 1))
    fx, cx = lens.fx / binning[0], (lens.cx - roi.x_offset) / binning[0]
    fy, cy = lens.fy / binning[1], (lens.cy - roi.y_offset) / binning[1]
    return replace(lens, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def cloud(message: Any, where: str) -> GeometryRecord:
    """Read points, amplitude and colour of a PointCloud2.

    Raises
    ------
    InputError
        If it lacks coordinates, or is cut off.
    """
    order = ">" if message.is_bigendian else "<"
    fields = {f.name: f for f in message.fields if f.datatype in _FIELD_TYPES}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise InputError(f"has no field {missing[0]!r}", where=where, remedy="record x, y and z")
    width, height, step = int(message.width), int(message.height), int(message.point_step)
    data, row = np.frombuffer(message.data, np.uint8), width * step
    if step < 1 or height * row > len(data):
        raise InputError("is cut off", where=where, remedy="check the bag")
    # Rows may be padded; not all drivers state their length.
    stated = int(message.row_step)
    stride = stated if row < stated <= len(data) // max(height, 1) else row
    rows = data[: height * stride].reshape(height, stride)[:, :row].reshape(-1, step)

    def column(name: str) -> NDArray[Any]:
        field = fields[name]
        dtype = np.dtype(order + _FIELD_TYPES[field.datatype])
        start = int(field.offset)
        if start + dtype.itemsize > step:
            raise InputError(f"has its field {name!r} outside of a point", where=where)
        values = np.ascontiguousarray(rows[:, start : start + dtype.itemsize]).view(dtype)[:, 0]
        return values.astype(dtype.newbyteorder("="), copy=False)

    xyz = [column(name) for name in "xyz"]
    with np.errstate(invalid="ignore"):  # signalling NaN
        points = np.stack(xyz, 1).astype(np.result_type(np.float32, *(c.dtype for c in xyz)))
    amplitude = next((name for name in _AMPLITUDES if name in fields), None)
    scalars = {} if amplitude is None else {"amplitude": column(amplitude)}
    color = unpacked_color({name: column(name) for name in ("rgb", "rgba") if name in fields})
    return GeometryRecord(points, color=color, scalars=scalars)


_TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")  # of ROS 2 and 1
_ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
_STATIC = "static"  # in the name of the topic
_MAX_DEPTH = 64


@dataclass(frozen=True, eq=False)
class _Edge:
    """The pose of a frame in its parent: T_parent_child (N, 4, 4) at ascending times (N,).

    If `static`, the last one applies at all times. Early publishers of static transforms repeat
    them on /tf.
    """

    parent: str
    times: Float64
    T: Float64
    static: bool

    def at(self, times: Float64) -> Float64:
        """Return T_parent_child (M, 4, 4) at times (M,), NaN where unknown."""
        if self.static:
            return np.broadcast_to(self.T[-1], (len(times), 4, 4))
        return interpolated_poses(times, self.times, self.T)


class Transforms:
    """The tf tree of a bag, with the motions that only messages of odometry state.

    Attributes
    ----------
    odometry_topics
        Topics of these messages, by the fixed frame of their poses.
    """

    def __init__(self, edges: dict[str, _Edge]) -> None:
        self._edges = edges
        self.odometry_topics: dict[str, str] = {}

    @classmethod
    def read(cls, bag: Any) -> Transforms:
        """Read all transforms of a bag, except those that are not rigid motions."""
        rows: dict[str, list[_Row]] = {}
        static: set[str] = set()
        for topic, message in _messages(bag, *_TF_TYPES):
            for transform in message.transforms:
                child = frame_name(transform.child_frame_id)
                motion = transform.transform
                row = _row(transform.header, motion.translation, motion.rotation)
                if row is None:
                    continue
                rows.setdefault(child, []).append(row)
                if _STATIC in topic:
                    static.add(child)
        return cls({child: _edge(found, child in static) for child, found in rows.items()})

    def add_odometry(self, bag: Any) -> None:
        """Add the poses of messages of odometry, where tf does not state the motion itself."""
        rows: dict[tuple[str, str], list[_Row]] = {}
        for topic, message in _messages(bag, _ODOMETRY_TYPE):
            pose, child = message.pose.pose, frame_name(message.child_frame_id)
            row = _row(message.header, pose.position, pose.orientation)
            if row is not None and child:
                rows.setdefault((topic, child), []).append(row)
        for (topic, child), found in sorted(rows.items()):
            root = self.ancestors(child)[-1]
            T_child_root = self.static_transform(child, root)
            if T_child_root is None:  # it moves already: in tf, or by another topic
                continue
            edge = _edge([(time, parent, T @ T_child_root) for time, parent, T in found], False)
            if root not in self.ancestors(edge.parent):
                self._edges[root] = edge
                self.odometry_topics[edge.parent] = topic

    def __bool__(self) -> bool:
        return bool(self._edges)

    def ancestors(self, frame: str) -> list[str]:
        """Return the frame and its ancestors, up to the root."""
        frames = [frame]
        while frames[-1] in self._edges and len(frames) < _MAX_DEPTH:
            parent = self._edges[frames[-1]].parent
            if parent in frames:
                break
            frames.append(parent)
        return frames

    @property
    def any_moves(self) -> bool:
        """Whether any frame moves relative to its parent."""
        return any(not edge.static for edge in self._edges.values())

    def moves(self, ancestor: str, frame: str) -> bool:
        """Whether a frame moves relative to one of its ancestors."""
        return any(not self._edges[child].static for child in self._between(ancestor, frame))

    def poses(self, ancestor: str, frame: str, times: Float64) -> Float64:
        """Return T_ancestor_frame (N, 4, 4) at times (N,), NaN where unknown."""
        T = np.broadcast_to(np.eye(4), (len(times), 4, 4))
        for child in self._between(ancestor, frame):
            T = self._edges[child].at(times) @ T
        return np.array(T)

    def static_transform(self, target: str, frame: str) -> Float64 | None:
        """Return T_target_frame (4, 4) if the frames are fixed to each other, else None."""
        common = next(
            (name for name in self.ancestors(frame) if name in self.ancestors(target)), None
        )
        if common is None or self.moves(common, frame) or self.moves(common, target):
            return None
        time = np.zeros(1)
        T_common_frame, T_common_target = (
            self.poses(common, name, time)[0] for name in (frame, target)
        )
        return np.asarray(se3.inverse(T_common_target) @ T_common_frame, np.float64)

    def _between(self, ancestor: str, frame: str) -> Iterator[str]:
        for name in self.ancestors(frame):
            if name == ancestor:
                return
            yield name


def frame_name(name: Any) -> str:
    """Return the name of a frame without the leading slash of early ROS 1."""
    return str(name).lstrip("/")


IMU_TYPE = "sensor_msgs/msg/Imu"
# Lengths of the acceleration at rest, m/s^2 or g; without gravity it is not as long.
_AT_REST = ((9.81 / 1.2, 9.81 * 1.2), (1 / 1.2, 1.2))


def accelerations(bag: Any, topic: str) -> tuple[str, dict[str, Float64]] | None:
    """Return the frame of an accelerometer, and what it measures; None if that is not gravity.

    Columns by name: `timestamp` (s), and `ax`, `ay`, `az` in its own axes.
    """
    connections = [c for c in bag.connections if (c.topic, c.msgtype) == (topic, IMU_TYPE)]
    frame, rows = "", []
    for _, _, raw in bag.messages(connections=connections):
        message = bag.deserialize(raw, IMU_TYPE)
        if message.linear_acceleration_covariance[0] == -1:  # it has none
            return None
        a, stamp = message.linear_acceleration, message.header.stamp
        frame = frame_name(message.header.frame_id)
        rows.append((stamp.sec + stamp.nanosec / 1e9, a.x, a.y, a.z))
    columns = np.array(rows, float).reshape(-1, 4)
    length = np.median(np.linalg.norm(columns[:, 1:], axis=1)) if rows else 0.0
    if not any(low < length < high for low, high in _AT_REST):
        return None
    return frame, dict(zip(("timestamp", *ACCELERATION), columns.T, strict=True))


def _messages(bag: Any, *kinds: str) -> Iterator[tuple[str, Any]]:
    """Topic and content of all messages of some types."""
    connections = [c for c in bag.connections if c.msgtype in kinds]
    for connection, _, raw in bag.messages(connections=connections) if connections else ():
        yield connection.topic, bag.deserialize(raw, connection.msgtype)


_Row = tuple[float, str, Float64]


def _row(header: Any, t: Any, q: Any) -> _Row | None:
    """Time, parent and T_parent_child (4, 4) of a pose; None if it is not a rigid motion."""
    values = np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w], float)
    if not np.isfinite(values).all() or abs(quaternion.length(values[3:]) - 1) > 0.01:
        return None
    try:
        T = se3.check_pose(quaternion.to_pose(values[3:], values[:3]), where="tf")
    except InputError:
        return None
    stamp = header.stamp
    return float(stamp.sec) + float(stamp.nanosec) / 1e9, frame_name(header.frame_id), T


def _edge(rows: Sequence[_Row], static: bool) -> _Edge:
    parent = rows[-1][1]
    rows = sorted((row for row in rows if row[1] == parent), key=lambda row: row[0])
    times = np.array([row[0] for row in rows])
    T = np.array([row[2] for row in rows])
    is_last = np.append(np.diff(times) > 0, True)
    static |= len(T) > 1 and bool((T[0] == T).all())
    return _Edge(parent, times[is_last], T[is_last], static)
