"""Readers of the .bag files of RealSense's and Orbbec's viewers: ROS containers, own messages."""

from __future__ import annotations

import re
import struct
import weakref
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np

from tofuse.errors import InputError
from tofuse.files.reading import files_with, is_file, is_folder, read_head
from tofuse.geometry.cameras import DISTORTION_ORDER, BrownConrady, Camera, Pinhole
from tofuse.parts import part
from tofuse.recordings.bags import (
    ROS1_MAGIC,
    Track,
    amplitude_beside,
    damaged,
    first_message,
    open_bag,
    open_container,
)
from tofuse.recordings.camera_file import checked_lens, load_camera
from tofuse.recordings.frames import DepthKind, RangeFrame
from tofuse.recordings.lenses import inverse_brown, plainest_lens
from tofuse.recordings.native import depth_from_counts
from tofuse.recordings.reader import ReaderOptions, Sniff
from tofuse.recordings.ros_messages import (
    ENCODINGS,
    GREY,
    Info,
    camera_info,
    check_size,
    image,
)
from tofuse.recordings.sources import FileSource

# The order in which Orbbec writes them.
_ORBBEC = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


def _topics(path: Path) -> frozenset[str]:
    """Return the topics of a bag, none if it can't be opened."""
    try:
        now = path.stat()
    except OSError:
        return frozenset()
    return _topics_of(path, now.st_mtime_ns, now.st_size)


@lru_cache(maxsize=4)
def _topics_of(path: Path, changed_ns: int, size: int) -> frozenset[str]:
    """As `_topics`; both readers ask, and opening a large bag takes a while."""
    try:
        if is_folder(path):
            whole = is_file(path / "metadata.yaml") and bool(files_with(path, ".db3", ".mcap"))
            old = False
        else:
            head = read_head(path, 16)
            old = head.startswith(ROS1_MAGIC)
            whole = old or (path.suffix == ".db3" and head.startswith(b"SQLite format 3"))
        if not whole:
            return frozenset()
        bag = open_container(path) if old else open_bag(path)
    except InputError:
        return frozenset()
    try:
        return frozenset(c.topic for c in bag.connections)
    finally:
        bag.close()


class _BagSource(FileSource):
    """Depth images of one track, and amplitude of another."""

    camera: Camera
    unit: float
    kind: DepthKind = "z"
    depth: Track
    amplitude: Track | None = None

    def __init__(self, path: Path, options: ReaderOptions) -> None:
        self.path = path
        if options.topic is not None:
            raise InputError(
                "means nothing for this maker's bags",
                where="--topic",
                remedy="leave it out, or give --format ros",
            )
        self.bag = self.open_bag(path)
        weakref.finalize(self, self.bag.close)
        super().__init__(np.zeros(0))
        try:
            self.find()
            if options.camera is not None:
                about, self.camera = load_camera(options.camera)
                self.unit, self.kind = about.depth_unit_m, about.depth_kind
        except InputError:
            raise
        except Exception as error:
            raise damaged(error, path) from error
        self.timestamps = self.depth.times
        if (np.diff(self.timestamps) <= 0).any():
            self.warnings.append("time goes back or repeats; frames stay in the order of the bag")
        self.metadata |= {"depth_unit_m": self.unit, "depth_kind": self.kind}

    @staticmethod
    def open_bag(path: Path) -> Any:
        """Open the bag, so that its messages can be decoded."""
        return open_bag(path)

    def find(self) -> None:
        """Set `camera`, `unit`, `depth` and `amplitude`."""
        raise NotImplementedError

    def message(self, track: Track, index: int) -> Any:
        """Return an image message of a track."""
        return track.message(index)

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        where = f"{self.path}: frame {index}"
        time = float(self.timestamps[index])
        try:
            counts = image(self.message(self.depth, index), where, ENCODINGS)
            check_size(counts, self.camera, where)
            return RangeFrame(
                index,
                time,
                self.camera,
                depth_from_counts(counts.astype(np.uint16), self.unit),
                self.kind,
                amplitude_beside(self.amplitude, time, self.camera, where, self.message),
                amplitude_kind="ir",
            )
        except InputError:
            raise
        except Exception as error:
            raise damaged(error, where) from error

    def track(self, topic: str) -> Track | None:
        """Return the messages of a topic, None if there are none."""
        for connection in self.bag.connections:
            if connection.topic == topic:
                found = Track(self.bag, connection)
                return found if len(found) else None
        return None

    def needed(self, topic: str, what: str) -> Track:
        """Return the messages of a topic that must be there."""
        found = self.track(topic)
        if found is None:
            raise InputError(
                f"has no {what} ({topic})", where=self.path, remedy="record the depth stream"
            )
        return found


@part("reader", "realsense-bag")
@dataclass(frozen=True)
class RealSenseBag:
    """A .bag (or .db3) of RealSense's viewer or SDK: depth, and infrared of the L515."""

    joinable: ClassVar[bool] = False

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        if any(re.fullmatch(_REALSENSE_DEPTH, topic) for topic in _topics(path)):
            return Sniff(1.0, "a bag of RealSense's SDK")
        return None

    def open(self, path: Path, options: ReaderOptions) -> RealSenseSource:
        """See `Reader.open`."""
        return RealSenseSource(path, options)


_REALSENSE_DEPTH = r"/device_\d+/sensor_\d+/Depth_\d+/image/data"


class RealSenseSource(_BagSource):
    """See `RealSenseBag`."""

    def find(self) -> None:
        """See `_BagSource.find`."""
        topics = sorted(
            c.topic for c in self.bag.connections if re.fullmatch(_REALSENSE_DEPTH, c.topic)
        )
        if not topics:
            raise InputError("has no depth of a RealSense", where=self.path, remedy="record it")
        stream = topics[0].removesuffix("/image/data")
        sensor = stream.rsplit("/", 1)[0]
        self.depth = self.needed(topics[0], "depth")
        self.camera = self._lens(stream)
        self.unit = self._unit(sensor)
        name = self._name(sensor.rsplit("/", 1)[0])
        self.metadata["sensor"] = name
        if "L5" in name:  # of stereo cameras infrared is another view
            found = [
                c.topic
                for c in self.bag.connections
                if re.fullmatch(re.escape(sensor) + r"/Infrared_\d+/image/data", c.topic)
            ]
            if found:
                self.amplitude = self.track(sorted(found)[0])

    def _lens(self, stream: str) -> Camera:
        where = f"{self.path}: {stream}"
        message = first_message(self.bag, f"{stream}/info/camera_info")
        # Newer versions write it as text.
        info = self._as_text(stream, where) if message is None else camera_info(message, where)
        if not any(info.coefficients):
            return checked_lens(Pinhole, info.size, info.values, where)
        k = dict(zip(DISTORTION_ORDER["brown"], info.coefficients, strict=False))
        brown = checked_lens(BrownConrady, info.size, info.values | k, where)
        words = info.model.lower().replace("_", " ")
        if words.startswith("inverse brown"):
            assert isinstance(brown, BrownConrady)
            return inverse_brown(brown)
        if words.startswith("brown"):
            return brown
        raise InputError(
            f"has the distortion model {info.model!r:.40}", where=where, remedy="give --camera"
        )

    def _as_text(self, stream: str, where: str) -> Info:
        text = first_message(self.bag, f"{stream}/camera_info")
        if text is None:
            raise InputError("has no camera_info", where=where, remedy="give --camera")
        fields = dict(p.partition("=")[::2] for p in str(text.data).split(";"))
        names = {"fx": "fx", "fy": "fy", "cx": "ppx", "cy": "ppy"}
        try:
            return Info(
                (int(fields["width"]), int(fields["height"])),
                {ours: float(fields[theirs]) for ours, theirs in names.items()},
                fields.get("model", ""),
                [float(d) for d in fields.get("coeffs", "").split(",") if d],
            )
        except (KeyError, ValueError) as error:
            raise InputError(
                f"has a camera_info that can't be read ({error})", where=where
            ) from error

    def _unit(self, sensor: str) -> float:
        message = first_message(self.bag, f"{sensor}/option/Depth_Units/value")
        try:
            unit = float(message.data) if message is not None else 0.0
        except ValueError:
            unit = 0.0
        if not 1e-6 < unit < 0.1:
            self.warnings.append(f"{self.path}: no depth unit is told; 1 mm is taken")
            return 0.001
        return float(np.float32(unit))

    def _name(self, device: str) -> str:
        """Return the camera's name, which is a message (key, value) among others."""
        for connection in self.bag.connections:
            if connection.topic != f"{device}/info":
                continue
            for _, _, raw in self.bag.messages(connections=[connection]):
                message = self.bag.deserialize(raw, connection.msgtype)
                if getattr(message, "key", "") == "Name":
                    return str(message.value)[:200]
        return "RealSense"


@part("reader", "orbbec-bag")
@dataclass(frozen=True)
class OrbbecBag:
    """A .bag of Orbbec's viewer or SDK: depth, and infrared of the same pixels."""

    joinable: ClassVar[bool] = False

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        if _ORBBEC_DEPTH in _topics(path):
            return Sniff(1.0, "a bag of Orbbec's SDK")
        return None

    def open(self, path: Path, options: ReaderOptions) -> OrbbecSource:
        """See `Reader.open`."""
        return OrbbecSource(path, options)


_ORBBEC_DEPTH = "/cam/sensor_3/frameType_3"
_ORBBEC_DEPTH_PROFILE = "/cam/streamProfileType_3"
_ORBBEC_INFRARED = "/cam/sensor_1/frameType_1"
_PROFILE = struct.Struct("<2B9f3f3H4f8fB")


class OrbbecSource(_BagSource):
    """See `OrbbecBag`. Its messages have more fields than ROS's own, so they are read here."""

    @staticmethod
    def open_bag(path: Path) -> Any:
        """See `_BagSource.open_bag`."""
        return open_container(path)

    def find(self) -> None:
        """See `_BagSource.find`."""
        self.depth = self.needed(_ORBBEC_DEPTH, "depth")
        profile = self.needed(_ORBBEC_DEPTH_PROFILE, "profile of the depth stream")
        where = f"{self.path}: {_ORBBEC_DEPTH_PROFILE}"
        raw = bytes(profile.raw(0))
        at = _header_end(raw, where)
        if len(raw) < at + _PROFILE.size:
            raise InputError("is cut off", where=where, remedy="check the bag")
        fields = _PROFILE.unpack_from(raw, at)
        size, rate = (fields[14], fields[15]), fields[16]
        values = dict(zip(("fx", "fy", "cx", "cy"), fields[17:21], strict=True))
        k = dict(zip(_ORBBEC, fields[21:29], strict=True))
        self.camera = plainest_lens(size, values, k, where)
        self.unit = 0.001
        self.metadata |= {"sensor": "Orbbec", "frame_rate_hz": float(rate)}
        infrared = self.track(_ORBBEC_INFRARED)
        if infrared is not None:
            first = self.message(infrared, 0)
            if (first.width, first.height) == size and first.encoding in GREY:
                self.amplitude = infrared

    def message(self, track: Track, index: int) -> Any:
        """Read the part of an image message that is as in ROS 1."""
        raw = bytes(track.raw(index))
        where = f"{self.path}: {track.connection.topic}, message {index}"
        at = _header_end(raw, where)
        try:
            height, width, length = struct.unpack_from("<3I", raw, at)
            at += 12
            encoding = raw[at : at + length].decode("ascii", "replace")
            at += length
            big, step, count = struct.unpack_from("<BII", raw, at)
        except struct.error as error:
            raise InputError("is cut off", where=where, remedy="check the bag") from error
        data = raw[at + 9 : at + 9 + count]
        return SimpleNamespace(
            height=height, width=width, encoding=encoding, is_bigendian=big, step=step, data=data
        )


def _header_end(raw: bytes, where: str) -> int:
    """Return where a ROS 1 header (counter, time, name of the frame) ends."""
    if len(raw) < 16:
        raise InputError("is cut off", where=where, remedy="check the bag")
    return 16 + int.from_bytes(raw[12:16], "little")
