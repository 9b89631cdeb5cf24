"""Clouds of files as frames without invalid points, and sources over files with one cloud each."""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.errors import InputError
from tofuse.engine.frames import CloudFrame, Frame
from tofuse.engine.fusion import GeometryRecord
from tofuse.engine.geometry import quaternion
from tofuse.engine.parts import name_of
from tofuse.formats.files import reading, tables
from tofuse.formats.geometry import read_ply
from tofuse.formats.sources import inputs
from tofuse.formats.sources.file_source import FileSource
from tofuse.formats.sources.organised import Deprojection, find_deprojection, samples
from tofuse.formats.sources.reader import Reader, ReaderOptions, Sniff


def ply_frame(path: Path, index: int, timestamp: float) -> CloudFrame:
    """Read a PLY cloud; non-finite points are dropped."""
    return cloud_frame(index, timestamp, read_ply(path))


def to_float32(values: NDArray[Any]) -> Float32:
    """Return numbers of a file as float32: infinite beyond its range, NaN for signalling NaN."""
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(np.float32, copy=False)


def cloud_frame(
    index: int,
    timestamp: float,
    cloud: GeometryRecord,
    *,
    origin: Float64 | None = None,
    up: Float64 | None = None,
) -> CloudFrame:
    """Return a cloud of a file as a view, without invalid points; see `CloudFrame.of`."""
    return CloudFrame.of(
        cloud.points,
        index=index,
        timestamp=timestamp,
        origin=origin,
        up=up,
        normals=cloud.normals,
        amplitude=cloud.amplitude,
        color=cloud.color,
    )


def up_in_scan(T_map_scan: Float64 | None = None) -> Float64:
    """Return the unit vector (3,) upwards in a scan of a format of surveyors: z of the map is up.

    Scanners stand upright: without a pose (4, 4), it is z of the scan.
    """
    if T_map_scan is None or not np.isfinite(T_map_scan).all():
        return np.array([0.0, 0.0, 1.0])
    return T_map_scan[2, :3]


LoadFrame = Callable[[Path, int, float], Frame]


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
    deproject
        Whether clouds that were deprojected from images become images again.
    """

    def __init__(
        self, path: Path, files: list[Path], load_frame: LoadFrame, *, deproject: bool = False
    ) -> None:
        super().__init__(np.arange(len(files), dtype=float))
        self.files = files
        self.load_frame = load_frame
        self._cached: dict[int, Frame] = {}  # read to determine the camera
        if reading.is_folder(path):
            self.read_sidecars(path)
            if self.reference is None and reading.is_file(path / "poses.txt"):
                self.reference = self._numbered_poses(path / "poses.txt")
        self._deprojection = self._find_deprojection() if deproject else None
        if self._deprojection is not None:
            self.metadata["depth_kind"] = "z"
            if self._deprojection.turned:
                self.metadata["stored_axes"] = "x right, y up, z backwards"
                self.warnings.append(
                    f"{path}: y is up and z backwards, as in files of the RealSense Viewer: turned "
                    "to the camera's axes, y down and z forward"
                )

    def where(self, index: int) -> str:
        """See `FileSource.where`."""
        return str(self.files[index])

    def load(self, index: int) -> Frame:
        """See `FileSource.load`."""
        cached = self._cached.pop(index, None)
        frame = self._read(index) if cached is None else cached
        if self._deprojection is not None and isinstance(frame, CloudFrame):
            return self._deprojection.image(frame)
        return frame

    def _read(self, index: int) -> Frame:
        return self.load_frame(self.files[index], index, float(self.timestamps[index]))

    def _find_deprojection(self) -> Deprojection | None:
        """The camera from which all clouds were deprojected, determined from a few of them."""
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
        if (np.abs(quaternion.length(table[:, 4:]) - 1) > 0.1).any():
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
    """Return the files at a path, see `inputs.files_at`; InputError if there are none.

    A file that the user passes for one of a format is that, whatever it is called.
    """
    if reading.is_file(path):
        return [path]
    return inputs.required(inputs.files_at(path, *suffixes), f"{suffixes[0]} files", path)
