"""Readers of scans: LAS and LAZ by laspy, E57 by pye57 (the extra `scan`)."""

from __future__ import annotations

import os
import re
import struct
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.frames import CloudFrame
from tofuse.engine.fusion import GeometryRecord
from tofuse.engine.geometry import quaternion
from tofuse.engine.parts import part
from tofuse.formats.files import reading
from tofuse.formats.sources import FileSource, Reader, ReaderOptions, Sniff, cloud_files, inputs

MAX_POINTS = 100_000_000
_E57 = b"ASTM-E57"
_MAX_COMPRESSION = 1000  # of LAZ; scans reach 4 to 15
# GeoTIFF's key of the unit of projected coordinates, its codes of feet, and their names in WKT.
_LINEAR_UNIT, _SURVEY_FOOT = 3076, 9003
_FEET = {9002, _SURVEY_FOOT}
_WKT_FEET = re.compile(r"UNIT\s*\[\s*\"[^\"]*(foot|feet|ft)", re.IGNORECASE)
_COPY = "copy the file again, or export it again"


@part("reader", "las")
class LasScans(cloud_files.CloudReader):
    """A .las or .laz file, or a folder of them; metres."""

    suffixes = (".las", ".laz")

    def source(self, path: Path, files: list[Path]) -> cloud_files.CloudFileSource:
        """See `CloudReader.source`."""
        return cloud_files.CloudFileSource(path, files, _las_frame)

    def open(self, path: Path, options: ReaderOptions) -> cloud_files.CloudFileSource:
        """See `Reader.open`."""
        source = super().open(path, options)
        if options.factor is not None:
            source.load_frame = partial(_las_frame, any_unit=True)
        return source


def _las_header(path: Path) -> Any:
    with reading.about(path, _COPY):
        return _checked_header(path)


def _checked_header(path: Path) -> Any:
    import laspy

    head = reading.read_head(path, 375)
    if head[:4] != b"LASF":
        raise InputError("isn't a LAS file")
    _check_records(head, path)
    with reading.library_errors(path, _COPY), laspy.open(path) as file:
        header = file.header
    count, size = int(header.point_count), int(header.point_format.size)
    file_size = path.stat().st_size
    compressed = bool(getattr(header, "are_points_compressed", False))
    if count > MAX_POINTS or count * size > file_size * (_MAX_COMPRESSION if compressed else 1):
        raise InputError(f"point count: {count} points don't fit into {file_size} bytes")
    if compressed and count:
        with reading.library_errors(path, _COPY):
            _check_chunks(path, header)
    return header


def _check_records(head: bytes, path: Path) -> None:
    """Reject a record count that exceeds the file size: laspy tries to read each record."""
    count = int.from_bytes(head[100:104], "little")
    extended = int.from_bytes(head[243:247], "little") if head[25:26] >= b"\x04" else 0
    if 54 * count + 60 * extended > path.stat().st_size:  # header sizes in bytes
        raise InputError(
            f"header: {count + extended} variable-length records don't fit into the file"
        )


def _check_chunks(path: Path, header: Any) -> None:
    """Reject a chunk table that is inconsistent with the file.

    lazrs allocates the declared size, and aborts the process if that fails. The table
    consists of its version, the number of chunks and their compressed sizes. Its offset precedes
    the chunks or, if unknown at that time, is in the last 8 bytes (specification of LASzip 2.2).
    """
    import lazrs

    size, start = path.stat().st_size, int(header.offset_to_point_data)
    layout = lazrs.LazVlr(header.vlrs[header.vlrs.index("LasZipVlr")].record_data)
    if layout.item_size() != header.point_format.size:
        raise InputError(
            f"LASzip record: a point has {layout.item_size()} bytes, in the header"
            f" {header.point_format.size}"
        )
    with path.open("rb") as file:
        file.seek(start)
        (table,) = struct.unpack("<q", file.read(8))
        if table <= start:
            file.seek(-8, os.SEEK_END)
            (table,) = struct.unpack("<q", file.read(8))
        if not start + 8 <= table <= size - 8:
            raise InputError(f"chunk table: offset {table} is outside the point data")
        file.seek(table)
        _, count = struct.unpack("<II", file.read(8))
        # Each chunk begins with an uncompressed point.
        if count * layout.item_size() > table - start:
            raise InputError(f"chunk table: {count} chunks don't fit into {table - start} bytes")
        file.seek(start)
        chunks = lazrs.read_chunk_table(file, layout)
    points, compressed = (sum(column) for column in zip(*chunks, strict=True)) if chunks else (0, 0)
    if compressed > table - start or points < header.point_count:
        raise InputError(
            f"chunk table: {points} points in {compressed} bytes, while the file has"
            f" {header.point_count} in {table - start}"
        )


def _check_unit(header: Any, path: Path) -> None:
    """Refuse coordinates in feet, as the coordinate system of the file states them."""
    with reading.library_errors(path, _COPY):
        keys = [
            key.value_offset
            for record in header.vlrs
            for key in getattr(record, "geo_keys", ())
            if key.id == _LINEAR_UNIT
        ]
        text = " ".join(str(getattr(record, "string", "")) for record in header.vlrs)
    named = _WKT_FEET.search(text)
    if _FEET & set(keys) or named:
        is_survey = _SURVEY_FOOT in keys or (named and re.search(r"us|survey", named[0], re.I))
        option = f"--factor {'0.3048006096' if is_survey else '0.3048'}"
        raise InputError(
            "has coordinates in feet",
            where=path,
            remedy=f"convert it to m by {option} (`tofuse convert`), pdal or CloudCompare",
        )


def read_las(path: Path, *, any_unit: bool = False) -> Any:
    """Return the `laspy.LasData` of a file, whose header is checked first.

    Raises
    ------
    InputError
        If it is damaged, or in feet, unless it may be in `any_unit`.
    """
    import laspy

    header = _las_header(path)
    if not any_unit:
        _check_unit(header, path)
    with reading.library_errors(path, _COPY):
        return laspy.read(path)


def _las_frame(path: Path, index: int, timestamp: float, *, any_unit: bool = False) -> CloudFrame:
    points = read_las(path, any_unit=any_unit)
    with reading.library_errors(path, _COPY):
        xyz = np.stack([np.asarray(points[axis], float) for axis in "xyz"], 1)
        names = set(points.point_format.dimension_names)
        intensity = np.asarray(points["intensity"], np.float32)
        color = None
        if {"red", "green", "blue"} <= names:
            values = np.stack([np.asarray(points[c]) for c in ("red", "green", "blue")], 1)
            # The standard uses 16 bits; many programs write 8-bit values.
            color = (values >> 8 if values.max(initial=0) > 255 else values).astype(np.uint8)
    color = color if color is not None and color.any() else None
    scalars = {"intensity": intensity} if intensity.any() else {}
    cloud = GeometryRecord(xyz, color=color, scalars=scalars)
    return cloud_files.cloud_frame(index, timestamp, cloud, up=cloud_files.up_in_scan())


@part("reader", "e57")
class E57Scans(Reader):
    """A .e57 file: one view per scan, in its frame; poses as reference (extra `scan`)."""

    joinable = True

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        return (
            Sniff(1.0, "an E57 file")
            if inputs.begins_with(inputs.file_of(path, ".e57"), _E57)
            else None
        )

    def open(self, path: Path, options: ReaderOptions) -> E57Source:
        """See `Reader.open`."""
        inputs.refuse_camera(options, "e57")
        return E57Source(inputs.required_file(path, ".e57"))


class E57Source(FileSource):
    """Scans of a file, read on demand."""

    def __init__(self, path: Path) -> None:
        self.path = path
        if reading.read_head(path, 8) != _E57:
            raise InputError("isn't an E57 file", where=path, remedy="check the file")
        self._pye57 = reading.required_package("pye57", "scan", path)
        with reading.library_errors(path, _COPY), closing(self._pye57.E57(str(path))) as file:
            headers = [file.get_header(k) for k in range(file.scan_count)]
            self.counts = [int(header.point_count) for header in headers]
            poses = [self._pose(header) for header in headers]
        if not self.counts:
            raise InputError(
                "contains no scan", where=path, remedy="export scans, not only pictures"
            )
        super().__init__(np.arange(len(self.counts), dtype=float))
        self.reference = inputs.poses_of(
            self,
            range(len(poses)),
            lambda k: inputs.read_matrix_pose(poses[k], f"{path}: scan {k}"),
        )

    def load(self, index: int) -> CloudFrame:
        """See `FileSource.load`."""
        where = f"{self.path}: scan {index}"
        if self.counts[index] > MAX_POINTS:
            raise InputError(
                f"point count: {self.counts[index]} is more than the limit of {MAX_POINTS}",
                where=where,
                remedy="export the scan with fewer points",
            )
        with reading.library_errors(where, _COPY), closing(self._pye57.E57(str(self.path))) as file:
            data = file.read_scan(
                index, intensity=True, colors=True, ignore_missing_fields=True, transform=False
            )
            points = np.stack([np.asarray(data[f"cartesian{a}"], float) for a in "XYZ"], 1)
        color = None
        if all(f"color{c}" in data for c in ("Red", "Green", "Blue")):
            color = np.stack([np.asarray(data[f"color{c}"]) for c in ("Red", "Green", "Blue")], 1)
            color = color.astype(np.uint8)
        scalars = {"intensity": data["intensity"]} if "intensity" in data else {}
        cloud = GeometryRecord(points, color=color, scalars=scalars)
        pose = None if self.reference is None else self.reference[index]
        up = cloud_files.up_in_scan(pose)
        return cloud_files.cloud_frame(index, float(index), cloud, up=up)

    def _pose(self, header: Any) -> Float64:
        if not header.has_pose():
            return np.eye(4)
        w, x, y, z = (float(value) for value in header.rotation)
        return quaternion.to_pose([x, y, z, w], header.translation)
