"""A source over files with one cloud each."""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.frames import CloudFrame, Frame
from tofuse.engine.geometry import quaternion
from tofuse.engine.parts import name_of
from tofuse.formats.files import reading, tables
from tofuse.formats.sources import inputs
from tofuse.formats.sources.file_source import FileSource
from tofuse.formats.sources.inputs import Reader, ReaderOptions, Sniff
from tofuse.formats.sources.organised import Deprojection, find_deprojection, samples

# The resolution of float32 is coarser than half a millimetre beyond.
MAP_COORDINATES_M = 8192.0

_STEP_M = 1000.0  # map coordinates are shifted by whole kilometres

F = TypeVar("F", bound=Frame)
LoadFrame = Callable[[Path, int, float], Frame]
LoadShifted = Callable[[Path, int, float, Float64], Frame]


class CloudFileSource(FileSource):
    """One view per file; timestamps.txt and pose files in the folder are read as for native ones.

    Parameters
    ----------
    path
        A file, or the folder of `files`.
    files
        In the order of frames.
    load_frame
        Reads a file, given its index and timestamp.
    load_shifted
        Reads in double precision and subtracts a shift (3,) from the coordinates, as map
        coordinates don't fit into float32. The shift is determined from the first readable file,
        and is `shift_m` in `metadata`.
    """

    def __init__(
        self,
        path: Path,
        files: list[Path],
        load_frame: LoadFrame,
        load_shifted: LoadShifted | None = None,
    ) -> None:
        super().__init__(np.arange(len(files), dtype=float))
        self.files = files
        self.load_frame, self.load_shifted = load_frame, load_shifted
        self._warned_rounding = False
        self._cached: dict[int, Frame] = {}  # read to determine shift and camera
        self._deprojection: Deprojection | None = None
        if reading.is_folder(path):
            self.read_sidecars(path)
            if self.reference is None and reading.is_file(path / "poses.txt"):
                self.reference = self._numbered_poses(path / "poses.txt")
        self._shift = np.zeros(3)
        if load_shifted is not None:
            self._shift, self._cached = find_shift(self._read, len(files))
            note_shift(self, path, self._shift)
            self._deprojection = self._find_deprojection()
            if self._deprojection is not None:
                self.metadata["depth_kind"] = "z"

    def where(self, index: int) -> str:
        """See `FileSource.where`."""
        return str(self.files[index])

    def load(self, index: int) -> Frame:
        """See `FileSource.load`."""
        cached = self._cached.pop(index, None)
        frame = self._read(index) if cached is None else cached
        if self._deprojection is not None and isinstance(frame, CloudFrame):
            return self._deprojection.image(frame)
        farthest = float(np.abs(frame.points).max(initial=0))
        if farthest > MAP_COORDINATES_M and not self._warned_rounding:
            self._warned_rounding = True
            step = float(np.spacing(np.float32(farthest)))
            self.warnings.append(
                f"{self.files[index]}: coordinates of up to {farthest:.3g} m are rounded to "
                f"{step:.2g} m; move the clouds near the origin"
            )
        return frame

    def _read(self, index: int) -> Frame:
        file, time = self.files[index], float(self.timestamps[index])
        if self.load_shifted is not None and self._shift.any():
            return self.load_shifted(file, index, time, self._shift)
        return self.load_frame(file, index, time)

    def _find_deprojection(self) -> Deprojection | None:
        """The camera from which all clouds were deprojected, determined from a few of them."""
        if self._shift.any():
            return None
        clouds: list[CloudFrame] = []
        candidate: Deprojection | None = None
        for frame in samples(len(self.files), lambda k: self._cached.get(k) or self._read(k)):
            if not isinstance(frame, CloudFrame):
                return None
            clouds.append(frame)
            if candidate is None:
                candidate = find_deprojection(clouds)
                if candidate is None:  # as for most clouds: one is sufficient to tell
                    return None
        return find_deprojection(clouds) if len(clouds) > 1 else candidate

    def _numbered_poses(self, path: Path) -> Float64 | None:
        """Read lines 'index x y z qw qx qy qz' with the number in the file name as index."""
        table = tables.read_numbers(path)
        fits = table.ndim == 2 and table.shape[1] == 8 and np.isfinite(table).all()
        if not fits or (table[:, 0] != np.rint(table[:, 0])).any():
            self.warnings.append(
                f"{path}: not 'index x y z qw qx qy qz', ignored; use groundtruth.txt (TUM)"
            )
            return None
        norms = quaternion.length(table[:, 4:])
        if (np.abs(norms - 1) > 0.1).any():
            raise InputError(
                "contains quaternions that are not of unit length",
                where=path,
                remedy="write 'index x y z qw qx qy qz'",
            )
        by_number = {int(row[0]): row for row in table}
        out = np.full((len(self.files), 4, 4), np.nan)
        for k, file in enumerate(self.files):
            digits = re.findall(r"[0-9]+", file.stem)
            row = by_number.get(int(digits[-1])) if digits else None
            if row is not None:
                out[k] = quaternion.to_pose(row[[5, 6, 7, 4]], row[1:4])
        self.warnings.append(f"{path}: read as index x y z qw qx qy qz, used only as reference")
        return out


def find_shift(read: Callable[[int], F], count: int) -> tuple[Float64, dict[int, F]]:
    """Return the shift (3,) in m to subtract from all coordinates, from the first readable frame.

    Also that frame by its index if the shift is zero, so that it need not be read again.
    """
    for index in range(count):
        try:
            frame = read(index)
        except InputError:
            continue
        if len(frame):
            shift = map_shift(frame.points.min(0), frame.points.max(0))
            return shift, {} if shift.any() else {index: frame}
    return np.zeros(3), {}


def map_shift(low: ArrayLike, high: ArrayLike) -> Float64:
    """Return the shift (3,) in m that brings coordinates in a box into the precision of float32.

    `low` and `high` (3,) are the corners of the box. Zero except for map coordinates.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    if max(np.abs(low).max(), np.abs(high).max()) <= MAP_COORDINATES_M:
        return np.zeros(3)
    return np.round((low + high) / 2 / _STEP_M) * _STEP_M


def describe_shift(shift: Float64) -> str:
    """Return the note on a shift (3,) of coordinates."""
    text = ", ".join(f"{value:.0f}" for value in shift)
    return f"coordinates are those of the files minus ({text}) m"


def note_shift(source: FileSource, path: Path, shift: Float64) -> None:
    """Record a shift (3,) of coordinates in a source, and apply it to its poses."""
    if not shift.any():
        return
    source.metadata["shift_m"] = shift.tolist()
    source.warnings.append(f"{path}: {describe_shift(shift)}")
    T_file_frame = np.eye(4)
    T_file_frame[:3, 3] = shift
    source.reference = None if source.reference is None else source.reference @ T_file_frame
    source.odometry = None if source.odometry is None else source.odometry @ T_file_frame


class CloudReader(Reader):
    """A reader of files with one cloud each: a file with one of the `suffixes`, or a folder."""

    suffixes: ClassVar[tuple[str, ...]]

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        files = inputs.files_at(path, *self.suffixes)
        if not files:
            return None
        if reading.is_folder(path) and reading.is_file(path / "run.json"):
            return Sniff(0.1, "a result of tofuse, not a recording", "pass the recording itself")
        kinds = sorted({f.suffix.lower() for f in files})
        evidence = f"{len(files)} {' and '.join(kinds)} file{'s'[: len(files) > 1]}"
        return Sniff(Sniff.CERTAIN, evidence)

    def open(self, path: Path, options: ReaderOptions) -> CloudFileSource:
        """See `Reader.open`."""
        inputs.refuse_camera(options, name_of(self))
        return self.source(path, required_files(path, *self.suffixes))

    @abstractmethod
    def source(self, path: Path, files: list[Path]) -> CloudFileSource:
        """Return the source of the files at a path, which is one of them or their folder."""


def required_files(path: Path, *suffixes: str) -> list[Path]:
    """Return the files at a path, see `inputs.files_at`; InputError if there are none."""
    return inputs.required(inputs.files_at(path, *suffixes), f"{suffixes[0]} files", path)
