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
from tofuse.recordings.ifm_lens import HeadInfo, head_frame, read_info
from tofuse.recordings.reader import Reader, ReaderOptions, Sniff, refuse_camera
from tofuse.recordings.single_files import file_of, required_file
from tofuse.recordings.sources import FileSource, interpolated

DISTANCE, AMPLITUDE, NOISE, CONFIDENCE, INFO = 100, 101, 105, 300, 420
_IMAGES = {"flags": CONFIDENCE, "noise": NOISE, "amplitude": AMPLITUDE}
_MAX_BYTES = 2 << 30


@part("reader", "ifm-o3r", label="validated")
@dataclass(frozen=True)
class IfmO3r(Reader):
    """A .data, .pcic or .bin file of ifm O3R's frames: range, noise, amplitude, intrinsics."""

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
    return interpolated(times)
