"""Readers of bags of RealSense's and Orbbec's viewers: ROS containers with their own messages."""

from __future__ import annotations

import re
import struct
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import DISTORTION_ORDER, BrownConrady, Camera, Pinhole, RayTable
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import quaternion, se3
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file, lenses
from tofuse.formats.sources import Reader, ReaderOptions, Sniff, bags


def topics(path: Path) -> frozenset[str]:
    """Return the topics of a bag, none if it can't be opened."""
    try:
        status = path.stat()
    except OSError:
        return frozenset()
    return _topics_of(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=4)
def _topics_of(path: Path, changed_ns: int, size: int) -> frozenset[str]:
    """See `topics`; cached, as several readers call it and opening a large bag is slow."""
    try:
        kind = bags.bag_kind(path)
        if kind in (None, "mcap"):  # in which no maker's viewer records
            return frozenset()
        bag = bags.open_container(path) if kind == "ros1" else bags.open_bag(path)
    except InputError:
        return frozenset()
    with closing(bag):
        return frozenset(c.topic for c in bag.connections)


class MakerBagSource(bags.BagSource):
    """A source over a bag whose topics and messages are those of a maker."""

    def find_streams(self, options: ReaderOptions) -> None:
        """See `BagSource.find_streams`."""
        self.find_tracks()
        if options.camera is None:
            self.camera = self.lens()
        else:
            self.use_camera(options.camera)
        self._find_color()
        self.set_timestamps()
        self.metadata |= {"depth_unit_m": self.unit, "depth_kind": self.kind}

    def find_tracks(self) -> None:
        """Set `unit` and `depth`, and `amplitude` and `color` if the bag has them."""
        raise NotImplementedError

    def lens(self) -> Camera:
        """Return the camera of the depth images."""
        raise NotImplementedError

    def color_lens(self) -> camera_file.ColorCamera:
        """Return the camera of the colour images; raise InputError if it is unknown."""
        raise NotImplementedError

    def _find_color(self) -> None:
        if self.color is None or self.color_camera is not None:
            return
        try:
            self.color_camera = self.color_lens()
        except InputError as error:
            self.warnings.append(f"colour is ignored: {error}")
            self.color = None

    def track(self, topic: str | None) -> bags.Track | None:
        """Return the messages of a topic; None if there are none."""
        for connection in self.bag.connections:
            if connection.topic == topic:
                track = bags.Track(self.bag, connection)
                return track if len(track) else None
        return None

    def required_track(self, topic: str, noun: str) -> bags.Track:
        """Return the messages of a topic, called `noun` in the error if there are none."""
        track = self.track(topic)
        if track is None:
            raise InputError(
                f"has no {noun} ({topic})", where=self.path, remedy="record the depth stream"
            )
        return track


@part("reader", "realsense-bag")
class RealSenseBag(Reader):
    """A .bag or .db3 of RealSense's SDK: depth, colour, infrared of the L515 (extra `ros`)."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        if any(re.fullmatch(_REALSENSE_DEPTH, topic) for topic in topics(path)):
            return Sniff(1.0, "a bag of RealSense's SDK")
        return None

    def open(self, path: Path, options: ReaderOptions) -> RealSenseSource:
        """See `Reader.open`."""
        return RealSenseSource(path, options)


_REALSENSE_DEPTH = r"/device_\d+/sensor_\d+/Depth_\d+/image/data"


class RealSenseSource(MakerBagSource):
    """See `RealSenseBag`."""

    def find_tracks(self) -> None:
        """See `MakerBagSource.find_tracks`."""
        topic = self._first(_REALSENSE_DEPTH)
        if topic is None:
            raise InputError("has no depth of a RealSense", where=self.path, remedy="record it")
        self.stream = topic.removesuffix("/image/data")
        sensor = self.stream.rsplit("/", 1)[0]
        device = sensor.rsplit("/", 1)[0]
        self.depth = self.required_track(topic, "depth")
        self.unit = self._unit(sensor)
        name = self._name(device)
        self.metadata["sensor"] = name
        if "L5" in name:  # a stereo camera's infrared is another view
            self.amplitude = self.track(self._first(rf"{sensor}/Infrared_\d+/image/data"))
        self.color = self.track(self._first(rf"{device}/sensor_\d+/Color_\d+/image/data"))

    def _first(self, pattern: str) -> str | None:
        """The first topic, by name, that matches a pattern."""
        topics_of_bag = (c.topic for c in self.bag.connections)
        return min((t for t in topics_of_bag if re.fullmatch(pattern, t)), default=None)

    def lens(self) -> Camera:
        """See `MakerBagSource.lens`."""
        return self._lens(self.stream)

    def color_lens(self) -> camera_file.ColorCamera:
        """See `MakerBagSource.color_lens`."""
        assert self.color is not None
        stream = self.color.connection.topic.removesuffix("/image/data")
        lens = self._lens(stream)
        if isinstance(lens, RayTable):
            lens = lenses.forward_brown(lens, self._brown(stream))
        assert isinstance(lens, Pinhole)
        depth, color = self._extrinsics(self.stream), self._extrinsics(stream)
        common = sorted(depth.keys() & color.keys())
        if not common:
            raise InputError("has no pose relative to depth", where=f"{self.path}: {stream}")
        return camera_file.ColorCamera(lens, color[common[0]] @ se3.inverse(depth[common[0]]))

    def _extrinsics(self, stream: str) -> dict[str, Float64]:
        """Return transforms (4, 4) into a stream's frame, by the number of their reference.

        ROS 1 bags store transforms; later versions text: a column-major rotation and a translation.
        """
        out = {}
        for connection in self.bag.connections:
            if not re.fullmatch(re.escape(stream) + r"/tf/\d+", connection.topic):
                continue
            message = bags.first_message(self.bag, connection.topic)
            where = f"{self.path}: {connection.topic}"
            T = np.eye(4)
            try:
                if hasattr(message, "data"):
                    text = dict(p.partition("=")[::2] for p in str(message.data).split(";"))
                    R = _numbers(text["rotation"]).reshape(3, 3).T
                    T = se3.pose(R, _numbers(text["translation"]))
                elif message is not None:
                    q, t = message.rotation, message.translation
                    T = quaternion.to_pose([q.x, q.y, q.z, q.w], [t.x, t.y, t.z])
            except (AttributeError, KeyError, ValueError) as error:
                raise InputError(f"can't be read ({error})", where=where) from error
            out[connection.topic.rsplit("/", 1)[1]] = se3.orthonormalise(
                se3.check_pose(T, where=where)
            )
        return out

    def _lens(self, stream: str) -> Camera:
        info, where = self._info(stream), f"{self.path}: {stream}"
        if not any(info.coefficients):
            return camera_file.checked_lens(Pinhole, info.size, info.values, where)
        brown = self._brown(stream)
        model = info.model.lower().replace("_", " ")
        if model.startswith("inverse brown"):
            return lenses.inverse_brown(brown)
        if model.startswith("brown"):
            return brown
        raise InputError(
            f"has the distortion model {info.model!r:.40}", where=where, remedy="use --camera"
        )

    def _brown(self, stream: str) -> BrownConrady:
        info = self._info(stream)
        k = dict(zip(DISTORTION_ORDER["brown"], info.coefficients, strict=False))
        lens = camera_file.checked_lens(
            BrownConrady, info.size, info.values | k, f"{self.path}: {stream}"
        )
        assert isinstance(lens, BrownConrady)
        return lens

    def _info(self, stream: str) -> bags.Info:
        where = f"{self.path}: {stream}"
        message = bags.first_message(self.bag, f"{stream}/info/camera_info")
        # Newer versions write text.
        return (
            self._info_from_text(stream, where)
            if message is None
            else bags.camera_info(message, where)
        )

    def _info_from_text(self, stream: str, where: str) -> bags.Info:
        text = bags.first_message(self.bag, f"{stream}/camera_info")
        if text is None:
            raise InputError("has no camera_info", where=where, remedy="use --camera")
        fields = dict(p.partition("=")[::2] for p in str(text.data).split(";"))
        keys = {"fx": "fx", "fy": "fy", "cx": "ppx", "cy": "ppy"}
        try:
            return bags.Info(
                (int(fields["width"]), int(fields["height"])),
                {name: float(fields[key]) for name, key in keys.items()},
                fields.get("model", ""),
                [float(d) for d in fields.get("coeffs", "").split(",") if d],
            )
        except (KeyError, ValueError) as error:
            raise InputError(
                f"has a camera_info that can't be read ({error})", where=where
            ) from error

    def _unit(self, sensor: str) -> float:
        message = bags.first_message(self.bag, f"{sensor}/option/Depth_Units/value")
        try:
            unit = float(message.data) if message is not None else 0.0
        except ValueError:
            unit = 0.0
        if not 1e-6 < unit < 0.1:
            self.warnings.append(f"{self.path}: no depth unit is given; 1 mm is assumed")
            return 0.001
        return float(np.float32(unit))

    def _name(self, device: str) -> str:
        """Return the camera's name, from the (key, value) messages."""
        for connection in self.bag.connections:
            if connection.topic != f"{device}/info":
                continue
            for _, _, raw in self.bag.messages(connections=[connection]):
                message = self.bag.deserialize(raw, connection.msgtype)
                if getattr(message, "key", "") == "Name":
                    return str(message.value)[:200]
        return "RealSense"


def _numbers(text: str) -> Float64:
    return np.array([float(cell) for cell in text.split(",")])


# The order in which Orbbec writes them.
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


@part("reader", "orbbec-bag")
class OrbbecBag(Reader):
    """A .bag of Orbbec's viewer or SDK: depth, aligned infrared, and colour (extra `ros`)."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        if _ORBBEC_DEPTH in topics(path):
            return Sniff(1.0, "a bag of Orbbec's SDK")
        return None

    def open(self, path: Path, options: ReaderOptions) -> OrbbecSource:
        """See `Reader.open`."""
        return OrbbecSource(path, options)


_ORBBEC_DEPTH = "/cam/sensor_3/frameType_3"
_ORBBEC_DEPTH_PROFILE = "/cam/streamProfileType_3"
_ORBBEC_COLOR = "/cam/sensor_2/frameType_2"
_ORBBEC_COLOR_PROFILE = "/cam/streamProfileType_2"
_ORBBEC_INFRARED = "/cam/sensor_1/frameType_1"
_PROFILE = struct.Struct("<2B9f3f3H4f8fB")


@dataclass(frozen=True, eq=False)
class _Profile:
    """Size, frame rate (Hz), intrinsics of a stream, and its transform into the colour frame."""

    size: tuple[int, int]
    rate: int
    values: dict[str, float]
    k: dict[str, float]
    rotation: Float64
    translation_m: Float64

    def lens(self, where: str) -> Pinhole:
        return lenses.simplest_lens(self.size, self.values, self.k, where)


class OrbbecSource(MakerBagSource):
    """See `OrbbecBag`; its messages extend those of ROS, and are decoded here."""

    @staticmethod
    def open_bag(path: Path) -> Any:
        """See `BagSource.open_bag`."""
        return bags.open_container(path)

    def find_tracks(self) -> None:
        """See `MakerBagSource.find_tracks`."""
        self.depth = self.required_track(_ORBBEC_DEPTH, "depth")
        self.profile = self._profile(_ORBBEC_DEPTH_PROFILE)
        self.unit = 0.001
        self.metadata |= {"sensor": "Orbbec", "frame_rate_hz": float(self.profile.rate)}
        infrared = self.track(_ORBBEC_INFRARED)
        if infrared is not None:
            first = self.message(infrared, 0)
            if (first.width, first.height) == self.profile.size and first.encoding in bags.GREY:
                self.amplitude = infrared
        self.color = self.track(_ORBBEC_COLOR)

    def lens(self) -> Camera:
        """See `MakerBagSource.lens`."""
        return self.profile.lens(f"{self.path}: {_ORBBEC_DEPTH_PROFILE}")

    def color_lens(self) -> camera_file.ColorCamera:
        """See `MakerBagSource.color_lens`."""
        where = f"{self.path}: {_ORBBEC_DEPTH_PROFILE}"
        lens = self._profile(_ORBBEC_COLOR_PROFILE).lens(f"{self.path}: {_ORBBEC_COLOR_PROFILE}")
        R = self.profile.rotation
        # Single precision, and not orthonormalised.
        if not (np.abs(R @ R.T - np.eye(3)).max() < 0.05 and np.linalg.det(R) > 0):
            raise InputError("has no pose relative to colour", where=where)
        T = se3.pose(R, self.profile.translation_m)
        return camera_file.ColorCamera(lens, se3.check_pose(se3.orthonormalise(T), where=where))

    def _profile(self, topic: str) -> _Profile:
        where = f"{self.path}: {topic}"
        raw = bytes(self.required_track(topic, "profile of the stream").raw(0))
        offset = _header_end(raw, where)
        if len(raw) < offset + _PROFILE.size:
            raise InputError("is cut off", where=where, remedy="check the bag")
        fields = _PROFILE.unpack_from(raw, offset)
        return _Profile(
            (fields[14], fields[15]),
            fields[16],
            dict(zip(("fx", "fy", "cx", "cy"), fields[17:21], strict=True)),
            dict(zip(_COEFFICIENTS, fields[21:29], strict=True)),
            np.reshape(fields[2:11], (3, 3)),
            np.array(fields[11:14]) / 1000,
        )

    def message(self, track: bags.Track, index: int) -> Any:
        """Read the part of an image message that is identical to ROS 1."""
        raw = bytes(track.raw(index))
        where = f"{self.path}: {track.connection.topic}, message {index}"
        offset = _header_end(raw, where)
        try:
            height, width, length = struct.unpack_from("<3I", raw, offset)
            offset += 12
            encoding = raw[offset : offset + length].decode("ascii", "replace")
            offset += length
            big_endian, step, count = struct.unpack_from("<BII", raw, offset)
        except struct.error as error:
            raise InputError("is cut off", where=where, remedy="check the bag") from error
        data = raw[offset + 9 : offset + 9 + count]
        return SimpleNamespace(
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=big_endian,
            step=step,
            data=data,
        )


def _header_end(raw: bytes, where: str) -> int:
    """The end offset of a ROS 1 header (counter, time, name of the frame)."""
    if len(raw) < 16:
        raise InputError("is cut off", where=where, remedy="check the bag")
    return 16 + int.from_bytes(raw[12:16], "little")
