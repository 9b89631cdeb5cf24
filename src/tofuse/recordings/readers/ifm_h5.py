"""Reader of ifm's .h5 recordings of O3R heads (ifm Vision Assistant), by the package h5py."""

from __future__ import annotations

import threading
import weakref
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.files.reading import required_package
from tofuse.parts import part
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.ifm_lens import HeadInfo, checked_info, head_frame
from tofuse.recordings.reader import Reader, ReaderOptions, Sniff, refuse_camera
from tofuse.recordings.single_files import begins_with, file_of, required_file
from tofuse.recordings.sources import FileSource

_MAGIC = b"\x89HDF\r\n\x1a\n"
_STREAM = "o3r_tof_"
_REQUIRED = (
    "distance",
    "distanceResolution",
    "intrinsicCalibModelID",
    "intrinsicCalibModelParameters",
)
_IMAGES = {"flags": "confidence", "noise": "distanceNoise", "amplitude": "amplitude"}
_MAX_FRAMES, _MAX_BYTES = 1_000_000, 1 << 26  # per file, and per frame
_LENS_PARAMETERS = 10


@part("reader", "ifm-h5", label="experimental")
@dataclass(frozen=True)
class IfmH5(Reader):
    """A .h5 or .hdf5 of ifm's Vision Assistant: range, noise, amplitude, lens (extra `hdf5`)."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        matches = begins_with(file_of(path, ".h5", ".hdf5"), _MAGIC)
        return Sniff(0.95, "an HDF5 file") if matches else None

    def open(self, path: Path, options: ReaderOptions) -> IfmH5Source:
        """See `Reader.open`."""
        refuse_camera(options, "ifm-h5")
        return IfmH5Source(required_file(path, ".h5", ".hdf5"), options.topic)


class IfmH5Source(FileSource):
    """Radial range of one head, with the camera's noise estimate and intrinsics."""

    def __init__(self, path: Path, stream: str | None) -> None:
        self.path = path
        h5py = required_package("h5py", "hdf5", path)
        self._lock = threading.Lock()
        try:
            file = h5py.File(path, "r")
            weakref.finalize(self, file.close)
            self._find(file, stream)
            times = self._times()
        except InputError:
            raise
        except Exception as error:  # any exception of h5py for a damaged file
            raise self._damaged(error) from error
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
        if not 0 < len(self.rows) <= _MAX_FRAMES or self.rows.dtype.itemsize > _MAX_BYTES:
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

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        where = f"{self.path}: {self.name}, frame {index}"
        try:
            with self._lock:
                row = self.rows[index]
            return self._frame(row, index, where)
        except InputError:
            raise
        except Exception as error:
            raise self._damaged(error, where) from error

    def _frame(self, row: Any, index: int, where: str) -> RangeFrame:
        counts = self._image(row, "distance", where)
        stored = np.asarray(row["intrinsicCalibModelParameters"], float).ravel()
        unit, model = float(row["distanceResolution"]), int(row["intrinsicCalibModelID"])
        parameters = tuple(stored[:_LENS_PARAMETERS].tolist())
        info: HeadInfo = checked_info(unit, model, parameters, where)
        images = {
            name: self._image(row, field, where, counts.shape)
            for name, field in _IMAGES.items()
            if field in self.fields
        }
        time = float(self.timestamps[index])
        return head_frame(index, time, info, str(self.path), counts, **images)

    def _image(
        self, row: Any, name: str, where: str, shape: tuple[int, ...] | None = None
    ) -> NDArray[Any]:
        image = np.asarray(row[name])
        if image.ndim != 2 or min(image.shape) < 2 or image.dtype.kind not in "uif":
            raise InputError(f"{name} is of shape {image.shape}", where=where)
        if shape is not None and image.shape != shape:
            raise InputError(f"{name} is of shape {image.shape}, distance {shape}", where=where)
        return image

    def _damaged(self, error: Exception, where: str | None = None) -> InputError:
        line = " ".join(str(error).split())[:200]
        return InputError(
            f"can't be read ({type(error).__name__}: {line})",
            where=where or self.path,
            remedy="copy the file again",
        )
