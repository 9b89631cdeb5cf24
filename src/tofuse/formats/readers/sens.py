"""Reader of ScanNet's .sens files (version 4)."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64, UInt8, UInt16
from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame, depth_counts
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading
from tofuse.formats.images import as_color, parse_image
from tofuse.formats.sources import FileSource, Reader, ReaderOptions, Sniff, inputs, pixels

VERSION = 4
RAW, ZLIB, OCCI = 0, 1, 2  # compression of depth
_COLORS = {0: "raw", 1: "png", 2: "jpeg"}
_FRAME = struct.Struct("<16f4Q")
_SHAPES = struct.Struct("<2i4IfQ")
_MAX_SIDE = 8192
_MAX_NAME = 4096
_TIMES_PER_S = 1e6
_RATE_HZ = 30.0


@part("reader", "sens")
class Sens(Reader):
    """ScanNet: a .sens file (version 4): depth, colour, both intrinsics, and poses."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        matches = inputs.begins_with(inputs.file_of(path, ".sens"), struct.pack("<I", VERSION))
        return Sniff(1.0, "a .sens file") if matches else None

    def open(self, path: Path, options: ReaderOptions) -> SensSource:
        """See `Reader.open`."""
        return SensSource(inputs.required_file(path, ".sens"), options)


@dataclass(frozen=True)
class _Entry:
    """A frame: offsets and sizes of its images in the file."""

    start: int
    color: int
    depth: int


class SensSource(FileSource):
    """Frames located in one pass over the file, and read on demand."""

    remedy = "copy the file again"

    def __init__(self, path: Path, options: ReaderOptions) -> None:
        self.path = path
        super().__init__(np.zeros(0))
        with reading.readable(path), path.open("rb") as file:
            self._size = file.seek(0, 2)
            file.seek(0)
            count = self._read_header(file)
            frames = list(self._locate_frames(file, count))
        if not frames:
            raise self._error("contains no complete frame", "copy the file again")
        self.entries = [entry for entry, _, _ in frames]
        times = np.array([time for _, time, _ in frames]) / _TIMES_PER_S
        self.timestamps = times if times.any() else np.arange(len(frames)) / _RATE_HZ
        inputs.check_timestamps(self.timestamps, path, self.warnings)
        if len(frames) < count:
            self.warnings.append(f"{path}: cut off after {len(frames)} of {count} frames")
        # The format stores minus infinity where tracking was lost.
        self.reference = inputs.poses_of(
            self,
            range(len(frames)),
            lambda k: inputs.read_matrix_pose(frames[k][2], f"{path}: pose of frame {k}"),
        )
        if options.camera is not None:
            self.use_camera(options.camera, self.depth_size)
        self.metadata |= {
            "sensor": self.sensor,
            "depth_unit_m": self.unit,
            "depth_kind": self.kind,
            "frame_rate_hz": _RATE_HZ,
        }

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        entry, where = self.entries[index], f"{self.path}: frame {index}"
        data = reading.read_part(self.path, entry.start, entry.color + entry.depth)
        packed_color, packed_depth = data[: entry.color], data[entry.color :]
        counts = self._depth(packed_depth)
        frame = self.image(index, depth_counts.depth_from_counts(counts, self.unit))
        if not packed_color or self.color_camera is None:
            return frame
        where = f"{where}: colour"

        def read_color() -> UInt8:
            image = self._color(packed_color, where)
            return pixels.sampled_color(frame, image, self.color_camera, where)

        return replace(frame, color_image=self.color_if_readable(index, read_color))

    def _read_header(self, file: BinaryIO) -> int:
        version, length = struct.unpack("<IQ", self._take(file, 12))
        if version != VERSION or length > _MAX_NAME:
            raise self._error(f"isn't a .sens file of version {VERSION}", "export it again")
        self.sensor = self._take(file, length).decode("utf-8", "replace")[:200] or "ScanNet"
        matrices = np.frombuffer(self._take(file, 256), "<f4").reshape(4, 4, 4).astype(float)
        shapes = _SHAPES.unpack(self._take(file, _SHAPES.size))
        self.color_packing, self.depth_packing = shapes[:2]
        color_size, self.depth_size = (shapes[2], shapes[3]), (shapes[4], shapes[5])
        counts_per_metre, count = shapes[6], int(shapes[7])
        if not all(1 < side <= _MAX_SIDE for side in self.depth_size):
            raise self._error(f"has depth images of {self.depth_size}", "export it again")
        if self.depth_packing not in (RAW, ZLIB):
            raise self._error(
                f"has depth compressed by method {self.depth_packing}", "export it with zlib"
            )
        if not 1 <= counts_per_metre <= 1e6:
            raise self._error(f"has {counts_per_metre} counts to a metre", "export it again")
        self.unit = 1.0 / counts_per_metre
        color_lens, T_device_color, depth_lens, T_device_depth = matrices
        self.camera = camera_file.checked_pinhole(
            depth_lens, self.depth_size, f"{self.path}: depth lens"
        )
        if all(1 < side <= _MAX_SIDE for side in color_size) and self.color_packing in _COLORS:
            self.color_camera = camera_file.ColorCamera(
                camera_file.checked_pinhole(color_lens, color_size, f"{self.path}: color lens"),
                inputs.color_from_depth(self.warnings, T_device_color, T_device_depth, self.path),
            )
        return count

    def _locate_frames(self, file: BinaryIO, count: int) -> Iterator[tuple[_Entry, int, Float64]]:
        """Locate frames until the end of the file; a truncated one is skipped."""
        offset = file.tell()
        for _ in range(count):
            file.seek(offset)
            head = file.read(_FRAME.size)
            if len(head) < _FRAME.size:
                return
            *pose, _, time, color, depth = _FRAME.unpack(head)
            start = offset + _FRAME.size
            offset = start + color + depth
            if offset > self._size:
                return
            yield _Entry(start, color, depth), time, np.array(pose).reshape(4, 4)

    def _depth(self, data: bytes) -> UInt16:
        width, height = self.depth_size
        expected = 2 * width * height
        if self.depth_packing == ZLIB:
            decompressor = zlib.decompressobj()
            try:
                data = decompressor.decompress(data, expected + 1)
            except zlib.error as error:
                raise InputError(f"has damaged depth ({error})") from error
        if len(data) != expected:
            raise InputError(f"has {quantities.count(len(data), 'byte')} of depth, not {expected}")
        return np.frombuffer(data, "<u2").reshape(height, width)

    def _color(self, data: bytes, where: str) -> UInt8:
        assert self.color_camera is not None
        size = (self.color_camera.camera.width, self.color_camera.camera.height)
        if self.color_packing != RAW:
            return as_color(parse_image(data, where, size=size))
        if len(data) != 3 * size[0] * size[1]:
            raise InputError(f"has {quantities.count(len(data), 'byte')}", where=where)
        return np.frombuffer(data, np.uint8).reshape(size[1], size[0], 3)

    def _take(self, file: BinaryIO, count: int) -> bytes:
        data = file.read(count)
        if len(data) < count:
            raise self._error("is cut off", "copy the file again")
        return data

    def _error(self, problem: str, remedy: str) -> InputError:
        return InputError(problem, where=self.path, remedy=remedy)
