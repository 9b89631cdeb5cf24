"""Reader of PTX: laser scans as text, by Cyclone of Leica and other programs."""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.frames import CloudFrame
from tofuse.engine.fusion import GeometryRecord
from tofuse.engine.parts import part
from tofuse.formats.files import reading, tables
from tofuse.formats.sources import cloud_files, inputs

# The columns and rows of the grid, position and axes of the scanner, and the 4 rows of its pose.
_HEADER_LINES, _POSE = 10, slice(6, 10)
_MAX_POINTS = 100_000_000


@part("reader", "ptx")
class PtxScans(cloud_files.CloudReader):
    """A .ptx file, or a folder of them: one view per scan, in its frame; poses as reference."""

    suffixes = (".ptx",)

    def source(self, path: Path, files: list[Path]) -> cloud_files.CloudFileSource:
        """See `CloudReader.source`."""
        scans = [scan for file in files for scan in _scans(file)]
        source = cloud_files.CloudFileSource(
            path, [s.file for s in scans], lambda _, index, time: scans[index].frame(index, time)
        )
        if source.reference is None:
            source.reference = inputs.poses_of(source, scans, _Scan.pose)
        return source


@dataclass(frozen=True)
class _Scan:
    """One scan: where its points are in a file, how many, and the text of its pose."""

    file: Path
    start: int
    stop: int
    count: int
    pose_text: str

    def pose(self) -> Float64:
        """T_world_scan (4, 4), which the file states for row vectors."""
        where = f"{self.file}: byte {self.start}"
        return inputs.read_matrix_pose(tables.parse_numbers(self.pose_text, where).T, where)

    def frame(self, index: int, timestamp: float) -> CloudFrame:
        """Read the points: x y z intensity, maybe r g b; zeros where nothing was measured."""
        with reading.readable(self.file), self.file.open("rb") as file:
            file.seek(self.start)
            text = file.read(self.stop - self.start).decode("ascii", "replace")
        table = tables.parse_numbers(text, self.file)
        if len(table) != self.count or table.shape[1] not in (4, 7):
            raise InputError(
                f"has {quantities.count(len(table), 'line')} of {table.shape[1]} numbers, "
                f"not {self.count} of 4 or 7",
                where=self.file,
                remedy="copy or export the file again",
            )
        points, color = table[:, :3], None
        points[(points == 0).all(1)] = np.nan
        if table.shape[1] == 7:
            color = np.nan_to_num(table[:, 4:]).clip(0, 255).astype(np.uint8)
        scalars = {"intensity": cloud_files.to_float32(table[:, 3])}
        cloud = GeometryRecord(points, color=color, scalars=scalars)
        pose = None
        with suppress(InputError):  # reported when the file is opened
            pose = self.pose()
        return cloud_files.cloud_frame(index, timestamp, cloud, up=cloud_files.up_in_scan(pose))


def _scans(path: Path) -> list[_Scan]:
    """The scans of a file, which follow each other."""
    scans: list[_Scan] = []
    reading.read_head(path, 0)  # refuses what has no end: pipes, devices
    with reading.readable(path), path.open("rb") as file:
        lines = (line for line in file if line.strip())
        while (head := list(islice(lines, _HEADER_LINES))) or not scans:
            try:
                columns, rows = int(head[0]), int(head[1])
                is_whole = len(head) == _HEADER_LINES and min(columns, rows) >= 1
                if not is_whole or columns * rows > _MAX_POINTS:
                    raise ValueError
            except (IndexError, ValueError) as error:
                raise InputError(
                    f"has no header of a PTX scan before byte {file.tell()}",
                    where=path,
                    remedy="copy or export the file again",
                ) from error
            start = file.tell()
            deque(islice(file, columns * rows), maxlen=0)
            pose = b"".join(head[_POSE]).decode("ascii", "replace")
            scans.append(_Scan(path, start, file.tell(), columns * rows, pose))
    return scans
