"""Readers of ifm's O3R heads: PCIC buffers, and .h5 recordings by the package h5py."""

from __future__ import annotations

import struct
import threading
import weakref
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.cameras import RayTable
from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading
from tofuse.formats.sources import FileSource, Reader, ReaderOptions, Sniff, inputs, pixels

DISTANCE, AMPLITUDE, NOISE, CONFIDENCE, INFO = 100, 101, 105, 300, 420
_IMAGES = {"flags": CONFIDENCE, "noise": NOISE, "amplitude": AMPLITUDE}
_MAX_BYTES = 2 << 30


@part("reader", "ifm-o3r", label="validated")
class IfmO3r(Reader):
    """A .data, .pcic or .bin file of ifm O3R's frames: range, noise, amplitude, intrinsics."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        file = inputs.file_of(path, ".data", ".pcic", ".bin")
        matches = file is not None and BEGIN in reading.read_head(file, 64)
        return Sniff(1.0, "a PCIC stream") if matches else None

    def open(self, path: Path, options: ReaderOptions) -> IfmO3rSource:
        """See `Reader.open`."""
        inputs.refuse_camera(options, "ifm-o3r")
        return IfmO3rSource(inputs.required_file(path, ".data", ".pcic", ".bin"))


class IfmO3rSource(FileSource):
    """Frames of radial range with the camera's noise estimate and intrinsics."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = reading.read_bytes(path, limit=_MAX_BYTES)
        self.frames = pcic_frames(self.data, path)
        super().__init__(_times(self.frames))
        self.metadata |= {"sensor": "ifm O3R (ToF)", "depth_kind": "range", "amplitude_kind": "raw"}
        for k, chunks in enumerate(self.frames):
            if not isinstance(chunks, InputError) and INFO in chunks:
                try:
                    info = _info(self.data, chunks[INFO], f"{path}: frame {k}")
                except InputError:
                    continue  # raised when this frame is read
                self.metadata["depth_unit_m"] = info.distance_unit_m
                if NOISE in chunks:
                    self.metadata["sigma_unit_m"] = info.distance_unit_m
                break
        if (np.diff(self.timestamps) < 0).any():
            self.warnings.append("time decreases; frames stay in the order of the file")

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        chunks = self.frames[index]
        where = self.where(index)
        if isinstance(chunks, InputError):
            raise chunks
        for kind, name in ((DISTANCE, "radial distance"), (INFO, "lens")):
            if kind not in chunks:
                raise InputError(
                    f"has no {name} (chunk {kind})",
                    remedy="record with the chunks 100 (distance) and 420 (information)",
                )
        info = _info(self.data, chunks[INFO], where)
        counts = chunk_image(self.data, chunks[DISTANCE], where)
        images = {
            name: self._image(chunks[kind], counts.shape, where)
            for name, kind in _IMAGES.items()
            if kind in chunks
        }
        time = float(self.timestamps[index])
        return head_frame(index, time, info, str(self.path), counts, **images)

    def _image(self, chunk: Chunk, shape: tuple[int, ...], where: str) -> NDArray[Any]:
        image: NDArray[Any] = chunk_image(self.data, chunk, where)
        if image.shape != shape:
            raise InputError(
                f"chunk {chunk.kind} is {image.shape[1]} x {image.shape[0]}, distance "
                f"{shape[1]} x {shape[0]}",
                where=where,
            )
        return image


def _info(data: bytes, chunk: Chunk, where: str) -> HeadInfo:
    return read_info(data[chunk.start : chunk.end], f"{where}: chunk {INFO}")


def _times(frames: list[dict[int, Chunk] | InputError]) -> Float64:
    """Timestamps (N,) in s, interpolated for damaged frames."""
    times = np.full(len(frames), np.nan)
    for k, chunks in enumerate(frames):
        if not isinstance(chunks, InputError) and chunks:
            times[k] = next(iter(chunks.values())).time
    if not np.isfinite(times).any():
        return np.arange(len(times), dtype=float)
    return inputs.interpolated(times)


BOUGUET, FISHEYE = 0, 2
# version, units of distance and amplitude, 3 factors, 6 of the mounting, model and parameters.
_INFO = struct.Struct("<I2f3f6fI32f")
_PARAMETERS = 10
_INVALID = 1  # bit of the flags


@dataclass(frozen=True)
class HeadInfo:
    """Unit of the distances in m, and model and parameters of the lens."""

    distance_unit_m: float
    model: int
    parameters: tuple[float, ...]

    def metres(self, image: NDArray[Any]) -> Float32:
        """Convert distances or their noise to m: integers are counts, floats are in m already."""
        out = image.astype(np.float32)
        return out if image.dtype.kind == "f" else out * np.float32(self.distance_unit_m)


def read_info(data: bytes, where: str) -> HeadInfo:
    """Read the head's information on a frame (chunk 420): unit of distance and lens.

    Raises
    ------
    InputError
        If it is cut off or implausible.
    """
    if len(data) < _INFO.size:
        raise InputError("is cut off", where=where, remedy="copy the file again")
    _, unit, *values = _INFO.unpack_from(data)
    model, parameters = values[10], tuple(values[11:21])
    return checked_info(float(unit), int(model), parameters, where)


def checked_info(unit: float, model: int, parameters: tuple[float, ...], where: str) -> HeadInfo:
    """Return the information with a unit in m, a lens model and its first ten parameters.

    Raises
    ------
    InputError
        If they are implausible.
    """
    if not 1e-6 < unit < 1 or len(parameters) != _PARAMETERS or not np.isfinite(parameters).all():
        raise InputError("has implausible calibration values", where=where, remedy="copy it again")
    return HeadInfo(unit, model, parameters)


def head_frame(
    index: int,
    timestamp: float,
    info: HeadInfo,
    where: str,
    distance: NDArray[Any],
    *,
    flags: NDArray[Any] | None = None,
    noise: NDArray[Any] | None = None,
    amplitude: NDArray[Any] | None = None,
) -> RangeFrame:
    """Return a frame of a head.

    Parameters
    ----------
    index, timestamp
        Of the frame, s.
    info
        Unit and lens.
    where
        The recording or camera, for errors.
    distance, noise
        (H, W) radial distance and its standard deviation, see `HeadInfo.metres`.
    flags
        (H, W) bits for each pixel, which mark invalid ones.
    amplitude
        (H, W) counts.

    Raises
    ------
    InputError
        If the flags are not integers, or the lens is implausible.
    """
    depth = info.metres(distance)
    if flags is not None:
        if flags.dtype.kind not in "ui":
            raise InputError("has flags that are not integers", where=where)
        depth = np.where(flags & _INVALID, np.float32(0), depth)
    if amplitude is not None:
        amplitude = pixels.finite_float32(amplitude)
    return RangeFrame(
        index,
        timestamp,
        head_camera(info, distance.shape[1], distance.shape[0], where),
        depth,
        "range",
        amplitude,
        sigma_image=None if noise is None else pixels.finite_float32(info.metres(noise)),
    )


@lru_cache(maxsize=16)
def head_camera(info: HeadInfo, width: int, height: int, where: str) -> RayTable:
    """Return the rays (H, W) of a lens by the maker's back-projection model.

    Unlike OpenCV's, its polynomials map pixels to rays, and pixel coordinates start at corners.
    """
    model = info.model
    if model not in (BOUGUET, FISHEYE):
        raise InputError(f"has the lens model {model}, not 0 or 2", where=where)
    fx, fy, cx, cy, skew, *k = info.parameters
    if not (1 < fx < 1e5 and 1 < fy < 1e5):
        raise InputError(f"has focal lengths of {fx:g} and {fy:g} pixels", where=where)
    v, u = np.mgrid[:height, :width] + 0.5
    y = (v - cy) / fy
    x = (u - cx) / fx - skew * y
    with np.errstate(all="ignore"):
        rays = _bouguet(x, y, k) if model == BOUGUET else _fisheye(x, y, k)
        rays[~(np.abs(rays) < camera_file.MAX_SLOPE).all(-1)] = np.nan
    return RayTable(rays.astype(np.float32))


def _bouguet(x: Float64, y: Float64, k: list[float]) -> Float64:
    r2 = x * x + y * y
    radial = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    return np.stack(
        [
            radial * x + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x),
            radial * y + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y,
        ],
        -1,
    )


def _fisheye(x: Float64, y: Float64, k: list[float]) -> Float64:
    """Rays of a fisheye: the angle is a polynomial in the radius, which k[4] limits."""
    radius = np.hypot(x, y)
    s = np.minimum(radius, k[4]) ** 2
    theta = radius * (1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))))
    scale = np.where(radius > 0, np.tan(theta) / np.where(radius > 0, radius, 1), 1.0)
    scale[~((theta >= 0) & (theta < np.pi / 2))] = np.nan
    return np.stack([x * scale, y * scale], -1)


_MAGIC = b"\x89HDF\r\n\x1a\n"
_STREAM = "o3r_tof_"
_REQUIRED = (
    "distance",
    "distanceResolution",
    "intrinsicCalibModelID",
    "intrinsicCalibModelParameters",
)
_FIELDS = {"flags": "confidence", "noise": "distanceNoise", "amplitude": "amplitude"}
_MAX_FRAMES, _MAX_ROW_BYTES = 1 << 20, 1 << 26  # per file, and per frame


@part("reader", "ifm-h5", label="experimental")
class IfmH5(Reader):
    """A .h5 or .hdf5 of ifm's Vision Assistant: range, noise, amplitude, lens (extra `hdf5`)."""

    has_topics = True

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        matches = inputs.begins_with(inputs.file_of(path, ".h5", ".hdf5"), _MAGIC)
        return Sniff(0.95, "an HDF5 file") if matches else None

    def open(self, path: Path, options: ReaderOptions) -> IfmH5Source:
        """See `Reader.open`."""
        inputs.refuse_camera(options, "ifm-h5")
        return IfmH5Source(inputs.required_file(path, ".h5", ".hdf5"), options.topic)


class IfmH5Source(FileSource):
    """Radial range of one head, with the camera's noise estimate and intrinsics."""

    def __init__(self, path: Path, stream: str | None) -> None:
        self.path = path
        h5py = reading.required_package("h5py", "hdf5", path)
        self._lock = threading.Lock()
        with reading.library_errors(path):
            file = h5py.File(path, "r")
            weakref.finalize(self, file.close)
            self._find(file, stream)
            times = self._times()
        super().__init__(times)
        self.metadata |= {"sensor": "ifm O3R (ToF)", "depth_kind": "range", "amplitude_kind": "raw"}
        if len(self.names) > 1 and stream is None:
            others = ", ".join(self.names[1:])
            self.warnings.append(
                f"the stream {self.names[0]} is read; others are {others}: choose with --topic"
            )
        if (np.diff(self.timestamps) < 0).any():
            self.warnings.append("time decreases; frames stay in the order of the file")

    def _find(self, file: Any, stream: str | None) -> None:
        streams = file.get("streams", {})
        self.names = sorted(name for name in streams if name.startswith(_STREAM))
        if not self.names or (stream is not None and stream not in self.names):
            raise InputError(
                f"has no stream {stream or _STREAM + '0'} "
                f"(there are: {', '.join(streams)[:300] or 'none'})",
                where=self.path,
                remedy="record the heads' ToF data",
            )
        self.name = stream or self.names[0]
        self.rows = streams[self.name]
        self.fields = self.rows.dtype.names or ()
        for name in _REQUIRED:
            if name not in self.fields:
                raise InputError(f"has no {name}", where=f"{self.path}: {self.name}")
        if not 0 < len(self.rows) <= _MAX_FRAMES or self.rows.dtype.itemsize > _MAX_ROW_BYTES:
            raise InputError(
                f"contains {len(self.rows)} frames of {self.rows.dtype.itemsize} bytes",
                where=f"{self.path}: {self.name}",
                remedy="check the file",
            )

    def _times(self) -> Float64:
        """Timestamps (N,) in s of the first exposure or acquisition; else frame numbers."""
        for name, unit in (("timestamp_ns", 1e-9), ("_data_timestamp", 1e-6)):
            if name in self.fields:
                ticks = np.asarray(self.rows[name], float).reshape(len(self.rows), -1)[:, 0]
                if np.isfinite(ticks).all() and (len(ticks) == 1 or np.ptp(ticks) > 0):
                    return ticks * unit
        return np.arange(len(self.rows), dtype=float)

    def where(self, index: int) -> str:
        """See `FileSource.where`."""
        return f"{self.path}: {self.name}, frame {index}"

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        with reading.library_errors(self.where(index)):
            with self._lock:
                row = self.rows[index]
            return self._frame(row, index)

    def _frame(self, row: Any, index: int) -> RangeFrame:
        counts = self._image(row, "distance")
        stored = np.asarray(row["intrinsicCalibModelParameters"], float).ravel()
        unit, model = float(row["distanceResolution"]), int(row["intrinsicCalibModelID"])
        info = checked_info(unit, model, tuple(stored[:_PARAMETERS].tolist()), self.where(index))
        images = {
            name: self._image(row, field, counts.shape)
            for name, field in _FIELDS.items()
            if field in self.fields
        }
        time = float(self.timestamps[index])
        return head_frame(index, time, info, str(self.path), counts, **images)

    def _image(self, row: Any, name: str, shape: tuple[int, ...] | None = None) -> NDArray[Any]:
        image = np.asarray(row[name])
        if image.ndim != 2 or min(image.shape) < 2 or image.dtype.kind not in "uif":
            raise InputError(f"{name} is of shape {image.shape}")
        if shape is not None and image.shape != shape:
            raise InputError(f"{name} is of shape {image.shape}, distance {shape}")
        return image


BEGIN, END = b"star", b"stop"
_HEAD = 36
_TYPES = ("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<f4", "<u8", "<f8")
_MAX_SIDE = 8192


@dataclass(frozen=True)
class Chunk:
    """One chunk of a frame: its header, and the range of its bytes in the stream."""

    kind: int
    width: int
    height: int
    format: int
    time_us: int
    seconds: int
    nanoseconds: int
    start: int
    end: int

    @property
    def time(self) -> float:
        """Timestamp in s of the camera's clock."""
        if self.seconds or self.nanoseconds:
            return self.seconds + self.nanoseconds / 1e9
        return self.time_us / 1e6


def pcic_frames(data: bytes, path: str | Path) -> list[dict[int, Chunk] | InputError]:
    """Find the frames of a stream: for each its chunks by kind, or the error if it is damaged.

    Raises
    ------
    InputError
        If there are no frames.
    """
    frames: list[dict[int, Chunk] | InputError] = []
    offset = data.find(BEGIN)
    while offset >= 0 and len(frames) < _MAX_FRAMES:
        offset += len(BEGIN)
        try:
            chunks, offset = _chunks(data, offset, f"{path}: frame {len(frames)}")
            frames.append(chunks)
        except InputError as error:
            frames.append(error)
        offset = data.find(BEGIN, offset)
    if not frames:
        raise InputError("is not a PCIC stream", where=path, remedy="check the file")
    return frames


def _chunks(data: bytes, offset: int, where: str) -> tuple[dict[int, Chunk], int]:
    chunks: dict[int, Chunk] = {}
    while data[offset : offset + 4] != END:
        if offset + _HEAD > len(data):
            raise InputError("is cut off", where=where, remedy="copy the file again")
        words = struct.unpack_from("<9I", data, offset)
        kind, size, header_size, version, width, height, format_, time_us = words[:8]
        if not _HEAD <= header_size <= size or offset + size > len(data):
            raise InputError(f"is cut off or damaged in chunk {kind}", where=where)
        seconds = nanoseconds = 0
        if version >= 2 and header_size >= 48:
            seconds, nanoseconds = struct.unpack_from("<2I", data, offset + 40)
        chunks[kind] = Chunk(
            kind,
            width,
            height,
            format_,
            time_us,
            seconds,
            nanoseconds,
            offset + header_size,
            offset + size,
        )
        offset += size
    return chunks, offset + 4


def chunk_image(data: bytes, chunk: Chunk, where: str) -> NDArray[Any]:
    """Return the image (H, W) of a chunk, which may be followed by other bytes.

    Raises
    ------
    InputError
        If it is not an image, or is cut off.
    """
    if chunk.format >= len(_TYPES) or not (
        1 <= chunk.width <= _MAX_SIDE and 1 <= chunk.height <= _MAX_SIDE
    ):
        raise InputError(
            f"chunk {chunk.kind} is not an image ({chunk.width} x {chunk.height}, "
            f"format {chunk.format})",
            where=where,
        )
    kind = np.dtype(_TYPES[chunk.format])
    count = chunk.width * chunk.height
    if chunk.end - chunk.start < count * kind.itemsize:
        raise InputError(f"chunk {chunk.kind} is cut off", where=where, remedy="copy it again")
    return np.frombuffer(data, kind, count, chunk.start).reshape(chunk.height, chunk.width)
