"""Reader of the PCIC buffers of ifm's O3R heads."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.files.pcic import BEGIN, Chunk, chunk_image, pcic_frames
from tofuse.files.reading import read_bytes, read_head
from tofuse.parts import part
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.ifm_lens import HeadInfo, head_camera, read_info
from tofuse.recordings.reader import Reader, ReaderOptions, Sniff, refuse_camera
from tofuse.recordings.single_files import file_of, required_file
from tofuse.recordings.sources import FileSource, interpolated

DISTANCE, AMPLITUDE, NOISE, CONFIDENCE, INFO = 100, 101, 105, 300, 420
INVALID = 1  # bit of the confidence

_MAX_BYTES = 2 << 30


@part("reader", "ifm-o3r", label="validated")
@dataclass(frozen=True)
class IfmO3r(Reader):
    """A .data or .pcic file of the O3R's frames: range, noise, amplitude, intrinsics."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        file = file_of(path, ".data", ".pcic", ".bin")
        matches = file is not None and BEGIN in read_head(file, 64)
        return Sniff(1.0, "a PCIC stream") if matches else None

    def open(self, path: Path, options: ReaderOptions) -> IfmO3rSource:
        """See `Reader.open`."""
        refuse_camera(options, "ifm-o3r")
        return IfmO3rSource(required_file(path, ".data", ".pcic", ".bin"))


class IfmO3rSource(FileSource):
    """Frames of radial range with the camera's noise estimate and intrinsics."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = read_bytes(path, limit=_MAX_BYTES)
        self.frames = pcic_frames(self.data, path)
        super().__init__(_times(self.frames))
        self.metadata |= {
            "sensor": "ifm O3R (ToF)",
            "depth_kind": "range",
            "amplitude_kind": "raw",
        }
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
        where = f"{self.path}: frame {index}"
        if isinstance(chunks, InputError):
            raise chunks
        for kind, name in ((DISTANCE, "radial distance"), (INFO, "lens")):
            if kind not in chunks:
                raise InputError(
                    f"has no {name} (chunk {kind})",
                    where=where,
                    remedy="record with the chunks 100 (distance) and 420 (information)",
                )
        info = _info(self.data, chunks[INFO], where)
        counts = chunk_image(self.data, chunks[DISTANCE], where)
        distance = info.metres(counts)
        if CONFIDENCE in chunks:
            flags = self._image(chunks[CONFIDENCE], counts.shape, where)
            if flags.dtype.kind not in "ui":
                raise InputError("has flags that are not integers", where=where)
            distance = np.where(flags & INVALID, np.float32(0), distance)
        noise = amplitude = None
        if NOISE in chunks:
            noise_counts = self._image(chunks[NOISE], counts.shape, where)
            noise = np.nan_to_num(info.metres(noise_counts), posinf=0, neginf=0)
        if AMPLITUDE in chunks:
            amplitude = self._image(chunks[AMPLITUDE], counts.shape, where).astype(np.float32)
            amplitude = np.nan_to_num(amplitude, posinf=0, neginf=0)
        return RangeFrame(
            index,
            float(self.timestamps[index]),
            head_camera(info, counts.shape[1], counts.shape[0], str(self.path)),
            distance,
            "range",
            amplitude,
            sigma_image=noise,
        )

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
    return interpolated(times)
