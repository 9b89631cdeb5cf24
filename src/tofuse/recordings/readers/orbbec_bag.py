"""Reader of bags written by Orbbec's viewer and SDK."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.geometry.cameras import Camera, Pinhole
from tofuse.geometry.se3 import check_pose, orthonormalise
from tofuse.parts import part
from tofuse.recordings.bags import Track, open_container
from tofuse.recordings.camera_file import ColorCamera
from tofuse.recordings.lenses import simplest_lens
from tofuse.recordings.maker_bags import MakerBagSource, topics
from tofuse.recordings.reader import Reader, ReaderOptions, Sniff
from tofuse.recordings.ros_messages import GREY

# The order in which Orbbec writes them.
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


@part("reader", "orbbec-bag")
@dataclass(frozen=True)
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
        return simplest_lens(self.size, self.values, self.k, where)


class OrbbecSource(MakerBagSource):
    """See `OrbbecBag`; its messages extend those of ROS, and are decoded here."""

    @staticmethod
    def open_bag(path: Path) -> Any:
        """See `BagSource.open_bag`."""
        return open_container(path)

    def find_tracks(self) -> None:
        """See `MakerBagSource.find_tracks`."""
        self.depth = self.required_track(_ORBBEC_DEPTH, "depth")
        self.profile = self._profile(_ORBBEC_DEPTH_PROFILE)
        self.unit = 0.001
        self.metadata |= {"sensor": "Orbbec", "frame_rate_hz": float(self.profile.rate)}
        infrared = self.track(_ORBBEC_INFRARED)
        if infrared is not None:
            first = self.message(infrared, 0)
            if (first.width, first.height) == self.profile.size and first.encoding in GREY:
                self.amplitude = infrared
        self.color = self.track(_ORBBEC_COLOR)

    def lens(self) -> Camera:
        """See `MakerBagSource.lens`."""
        return self.profile.lens(f"{self.path}: {_ORBBEC_DEPTH_PROFILE}")

    def color_lens(self) -> ColorCamera:
        """See `MakerBagSource.color_lens`."""
        where = f"{self.path}: {_ORBBEC_DEPTH_PROFILE}"
        lens = self._profile(_ORBBEC_COLOR_PROFILE).lens(f"{self.path}: {_ORBBEC_COLOR_PROFILE}")
        R = self.profile.rotation
        # Single precision, and not orthonormalised.
        if not (np.abs(R @ R.T - np.eye(3)).max() < 0.05 and np.linalg.det(R) > 0):
            raise InputError("has no pose relative to colour", where=where)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, self.profile.translation_m
        return ColorCamera(lens, check_pose(orthonormalise(T), where=where))

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

    def message(self, track: Track, index: int) -> Any:
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
