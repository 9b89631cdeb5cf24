"""Reader of frames saved by Analog Devices' ToF SDK (ADTF3175 and others)."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Float32, Float64, UInt16
from tofuse.engine.cameras import RayTable
from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame, depth_counts, evenly_spaced
from tofuse.engine.geometry import unit_rays
from tofuse.engine.parts import part
from tofuse.formats.files import reading
from tofuse.formats.sources import FileSource, Reader, ReaderOptions, Sniff, inputs

HEADER_BYTES = 128
# Width, height, kind of output, bits of depth, of brightness and of confidence, 11 other bytes,
# whether points follow, 16 other bytes, monotonic time in s and us, wall clock in s and us.
_HEADER = struct.Struct("<2H4B11xB16x4Q")
_SIDES = range(2, 4097)
_MAX_BITS = 32
SENSOR = "Analog Devices (ToF)"
# Number of frames whose points determine the rays, and degree in either axis of the polynomial of
# the pixel's position that is fitted to them: it smooths the rounding of the points to whole mm.
_SAMPLES = 16
_DEGREE = 7
_MAX_FITTED_PIXELS = 20_000  # pixels
_ROUNDING_MM = 0.5  # the largest error of a coordinate from rounding
_REMEDY = "pass the lens with --camera camera.json, or save frames with XYZ"


@dataclass(frozen=True)
class Layout:
    """A frame's metadata: its size, the bytes per pixel of its channels (0: none), and its time.

    The channels follow the metadata in this order: depth (2 bytes), active brightness, confidence,
    points. The time is in s; 0 if it is not recorded.
    """

    width: int
    height: int
    brightness: int
    confidence: int
    points: int
    time: float

    @property
    def length(self) -> int:
        """Bytes of the frame, including the metadata."""
        channels = 2 + self.brightness + self.confidence + self.points
        return HEADER_BYTES + channels * self.width * self.height

    @classmethod
    def of(cls, data: bytes) -> Layout | None:
        """Read the metadata; None if there are none."""
        if len(data) < HEADER_BYTES:
            return None
        width, height, _, depth, brightness, confidence, points, *clocks = _HEADER.unpack_from(data)
        plausible = width in _SIDES and height in _SIDES and 0 < depth <= 16 and points in (0, 1)
        if not plausible or max(brightness, confidence) > _MAX_BITS:
            return None
        times = [s + us / 1e6 for s, us in (clocks[2:], clocks[:2]) if 0 < s < 1 << 40]
        return cls(
            width,
            height,
            2 * (brightness > 0),
            4 * (confidence > 0),
            6 * points,
            times[0] if times else 0.0,
        )


@dataclass(frozen=True)
class _FrameLocation:
    """Location of a frame in a file."""

    path: Path
    offset: int
    layout: Layout


@dataclass(frozen=True, eq=False)
class _Images:
    """The channels (H, W) of a frame, and its points (H, W, 3) in mm; None if missing."""

    depth: UInt16
    brightness: UInt16 | None
    points: NDArray[np.int16] | None


@part("reader", "aditof", label="experimental")
class AdiTof(Reader):
    """A .bin file of frames of Analog Devices' ToF SDK, or a folder of them."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        files = _files(path)
        frames, complete = _frames_in(files[0]) if files else ([], False)
        if len(frames) > 1 or (frames and complete):
            return Sniff(1.0, "frames of Analog Devices' ToF SDK")
        return None

    def open(self, path: Path, options: ReaderOptions) -> AdiTofSource:
        """See `Reader.open`."""
        return AdiTofSource(path, options)


class AdiTofSource(FileSource):
    """Radial range in mm with active brightness; the rays are those of the stored points."""

    concurrent = True
    kind = "range"
    amplitude_kind = "ir"

    def __init__(self, path: Path, options: ReaderOptions) -> None:
        self.locations: list[_FrameLocation] = []
        truncated = []
        for file in _files(path):
            frames, complete = _frames_in(file)
            self.locations += frames
            truncated += [] if complete else [file]
        if not self.locations:
            raise InputError(
                "contains no whole frame of Analog Devices' ToF SDK",
                where=path,
                remedy="pass a .bin file that data_collect or FrameHandler saved",
            )
        first = self.locations[0].layout
        self.size = first.width, first.height
        sensor, rate = SENSOR, 1.0
        if options.camera is not None:
            description = self.use_camera(options.camera, self.size)
            sensor, rate = description.sensor or sensor, description.frame_rate_hz or rate
        else:
            self.camera = self._camera_of_points(path)
        times = np.array([place.layout.time for place in self.locations])
        super().__init__(times if times.all() else np.arange(len(times)) / rate)
        self.metadata |= {
            "sensor": sensor,
            "depth_kind": self.kind,
            "depth_unit_m": self.unit,
            "amplitude_kind": "ir",
        }
        self.warnings += [
            f"{file} is cut off or damaged: its end is left out" for file in truncated
        ]

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        images = self._images(index)
        amplitude = None if images.brightness is None else images.brightness.astype(np.float32)
        depth = depth_counts.depth_from_counts(images.depth, self.unit)
        return self.image(index, depth, amplitude_image=amplitude)

    def _images(self, index: int) -> _Images:
        place = self.locations[index]
        layout = place.layout
        if (layout.width, layout.height) != self.size:
            raise InputError(
                f"is {layout.width} x {layout.height} pixels, the first frame "
                f"{self.size[0]} x {self.size[1]}",
                where=f"{place.path}: frame {index}",
                remedy="pass frames of one mode",
            )
        data = reading.read_part(
            place.path, place.offset + HEADER_BYTES, layout.length - HEADER_BYTES
        )
        if len(data) < layout.length - HEADER_BYTES:
            raise InputError("is cut off", where=f"{place.path}: frame {index}")
        shape, count = (layout.height, layout.width), layout.width * layout.height
        offset = 2 * count
        depth = np.frombuffer(data, "<u2", count).reshape(shape)
        brightness = points = None
        if layout.brightness:
            brightness = np.frombuffer(data, "<u2", count, offset).reshape(shape)
        if layout.points:
            offset += (layout.brightness + layout.confidence) * count
            points = np.frombuffer(data, "<i2", 3 * count, offset).reshape(*shape, 3)
        return _Images(depth, brightness, points)

    def _camera_of_points(self, path: Path) -> RayTable:
        """The camera of the points in evenly spaced frames."""
        samples = []
        for k in evenly_spaced(np.arange(len(self.locations)), _SAMPLES):
            try:
                images = self._images(int(k))
            except InputError:
                continue  # reported when it is read
            if images.points is not None:
                samples.append((images.depth.astype(float), images.points.astype(float)))
        if not samples:
            raise InputError("has no points (XYZ), and so no lens", where=path, remedy=_REMEDY)
        rays = _rays(samples)
        if rays is None:
            raise InputError(
                "has points (XYZ) that are not at the depth along the rays of a camera",
                where=path,
                remedy=_REMEDY,
            )
        with reading.named(f"{path}: XYZ", _REMEDY):
            return RayTable(rays)


def _files(path: Path) -> list[Path]:
    return [file for file in inputs.files_at(path, ".bin") if reading.is_file(file)]


def _frames_in(path: Path) -> tuple[list[_FrameLocation], bool]:
    """The complete frames of a file, and whether it contains nothing else."""
    frames: list[_FrameLocation] = []
    with reading.readable(path):
        size = path.stat().st_size
        with path.open("rb") as file:
            offset = 0
            while layout := _layout_at(file, offset, size):
                frames.append(_FrameLocation(path, offset, layout))
                offset += layout.length
    return frames, offset == size


def _layout_at(file: BinaryIO, offset: int, size: int) -> Layout | None:
    """The layout of the frame at an offset of a file of `size` bytes; None if it is incomplete.

    SDKs before 6 store points without declaring them: the start of the next frame shows whether
    they are present.
    """

    def is_complete(layout: Layout) -> bool:
        file.seek(offset + layout.length)
        following = Layout.of(file.read(HEADER_BYTES))
        same_size = following is not None and (following.width, following.height) == (
            layout.width,
            layout.height,
        )
        return same_size or offset + layout.length == size

    file.seek(offset)
    layout = Layout.of(file.read(HEADER_BYTES))
    if layout is None:
        return None
    with_points = replace(layout, points=6)
    if not layout.points and is_complete(with_points) and not is_complete(layout):
        layout = with_points
    return layout if offset + layout.length <= size else None


def _rays(samples: Sequence[tuple[Float64, Float64]]) -> Float32 | None:
    """Rays (H, W, 2) of the pixels with points in samples of depth (H, W) and points (H, W, 3), mm.

    None if they are not those of the points, within the rounding to whole mm.
    """
    shape = samples[0][0].shape
    weight, slopes = np.zeros(shape), np.zeros((*shape, 2))
    masks = []
    for depth, points in samples:
        measured = (depth > 0) & (points[..., 2] > 0)
        error = np.abs(np.linalg.norm(points, axis=-1) - depth)
        consistent = measured & (error <= _ROUNDING_MM * np.sqrt(3))
        if consistent.sum() < 0.5 * measured.sum():
            return None
        masks.append(consistent)
        z = np.where(consistent, points[..., 2], 0.0)
        weight += z**2
        slopes += points[..., :2] * z[..., None]
    has_ray = weight > 0
    row, column = np.nonzero(has_ray)
    subset = slice(None, None, 1 + len(row) // _MAX_FITTED_PIXELS)
    row, column = row[subset], column[subset]
    y, x = (np.linspace(-1, 1, side) for side in shape)
    basis = np.polynomial.legendre.legvander2d(y[row], x[column], [_DEGREE, _DEGREE])
    if len(row) < 4 * basis.shape[-1]:
        return None
    sqrt_weight = np.sqrt(weight[row, column])[:, None]
    fit = np.linalg.lstsq(sqrt_weight * basis, slopes[row, column] / sqrt_weight, rcond=None)[0]
    coefficients = fit.reshape(_DEGREE + 1, _DEGREE + 1, 2)
    rays = np.moveaxis(np.polynomial.legendre.leggrid2d(y, x, coefficients), 0, -1)
    rays[~has_ray] = np.nan
    directions = unit_rays(rays)
    error = [
        (points - directions * depth[..., None])[mask]
        for (depth, points), mask in zip(samples, masks, strict=True)
    ]
    if np.sqrt(np.mean(np.concatenate(error) ** 2)) > _ROUNDING_MM:
        return None
    return rays.astype(np.float32)
