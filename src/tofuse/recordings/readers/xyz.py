"""Reader of clouds as plain text."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tofuse.arrays import Float32, Float64
from tofuse.errors import InputError
from tofuse.files.tables import read_numbers
from tofuse.parts import part
from tofuse.recordings.cloud_files import CloudFileSource, required_files, sniff_clouds
from tofuse.recordings.frames import CloudFrame
from tofuse.recordings.reader import Reader, ReaderOptions, Sniff, refuse_camera
from tofuse.recordings.sources import cloud_frame

_SUFFIXES = (".xyz", ".xyzn", ".xyzrgb")


@part("reader", "xyz")
@dataclass(frozen=True)
class XyzClouds(Reader):
    """A .xyz, .xyzn or .xyzrgb file, or a folder of them; metres.

    The fourth column of four is an amplitude. Columns four to six are normals in .xyzn, and where
    all have length 1; colours in .xyzrgb (0 to 1), and where all are integers up to 255. Other
    columns are ignored.
    """

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        return sniff_clouds(path, *_SUFFIXES)

    def open(self, path: Path, options: ReaderOptions) -> CloudFileSource:
        """See `Reader.open`."""
        refuse_camera(options, "xyz")
        return CloudFileSource(path, required_files(path, *_SUFFIXES), xyz_frame, xyz_frame)


def xyz_frame(path: Path, index: int, timestamp: float, shift: Float64 | None = None) -> CloudFrame:
    """Read one file; `shift` (3,) in m is subtracted from the coordinates."""
    table = read_numbers(path)
    if table.shape[1] < 3:
        raise InputError(f"has {table.shape[1]} numbers per line", where=path, remedy="write x y z")
    points = _float32(table[:, :3]) if shift is None else table[:, :3]
    amplitude = normals = color = None
    if table.shape[1] == 4:
        amplitude = _float32(table[:, 3])
    elif table.shape[1] >= 6:
        columns = table[:, 3:6]
        if path.suffix.lower() == ".xyzrgb":
            color = np.clip(np.rint(np.nan_to_num(columns) * 255), 0, 255).astype(np.uint8)
        elif path.suffix.lower() == ".xyzn" or _are_unit(columns):
            normals = _float32(columns)
        elif ((columns >= 0) & (columns <= 255) & (columns == np.rint(columns))).all():
            color = columns.astype(np.uint8)
    return cloud_frame(
        index, timestamp, points, normals, amplitude=amplitude, color=color, shift=shift
    )


def _float32(values: Float64) -> Float32:
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def _are_unit(vectors: Float64) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):
        return bool((np.abs(np.sqrt((vectors**2).sum(1)) - 1) < 1e-3).all())
