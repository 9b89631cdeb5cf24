"""PCD: point clouds of PCL, version 0.5 to 0.7; ascii, binary and binary_compressed."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine import quantities
from tofuse.engine.arrays import Float32, Float64, UInt8
from tofuse.engine.errors import InputError
from tofuse.engine.fusion import GeometryRecord
from tofuse.formats.files import atomic, reading, tables
from tofuse.formats.geometry.ply import stacked

MAX_POINTS = 1 << 28
_NORMALS = ("normal_x", "normal_y", "normal_z")
_HEADER_LIMIT = 1 << 16
_COPY_AGAIN = "copy or export the file again"
_TYPES = {
    ("F", 4): "<f4", ("F", 8): "<f8",
    ("I", 1): "<i1", ("I", 2): "<i2", ("I", 4): "<i4", ("I", 8): "<i8",
    ("U", 1): "<u1", ("U", 2): "<u2", ("U", 4): "<u4", ("U", 8): "<u8",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Pcd:
    """The content of a PCD file.

    Attributes
    ----------
    cloud
        Points are not finite where nothing was measured.
    width, height
        As declared; an organised cloud has height > 1 and N = width x height, in row-major order.
    viewpoint
        (7,) tx ty tz qw qx qy qz of the sensor, as declared. The points are not transformed by it.
    """

    cloud: GeometryRecord
    width: int
    height: int
    viewpoint: Float64

    @property
    def organised(self) -> bool:
        """Whether the points form an image."""
        return self.height > 1 and self.width > 1

    @property
    def image(self) -> NDArray[np.floating]:
        """(H, W, 3) points of an organised cloud."""
        return self.cloud.points.reshape(self.height, self.width, 3)


@dataclass(frozen=True)
class _Header:
    names: list[str]
    dtypes: list[str]
    counts: list[int]
    width: int
    height: int
    points: int
    viewpoint: tuple[float, ...]
    kind: str
    body: int

    @property
    def stride(self) -> int:
        return sum(np.dtype(t).itemsize * c for t, c in zip(self.dtypes, self.counts, strict=True))


def read_pcd(path: str | Path) -> Pcd:
    """Read a PCD file.

    Raises
    ------
    InputError
        If it is not a PCD file, is cut off or damaged, declares more than it contains, or lacks
        x, y or z.
    """
    data = reading.read_bytes(path)
    with reading.about(path, _COPY_AGAIN):
        return _parsed(data)


def _parsed(data: bytes) -> Pcd:
    header = _read_header(data)
    if not all(name in header.names for name in "xyz"):
        raise InputError(f"has the fields {' '.join(header.names)}", remedy="store x y z")
    columns = _COLUMNS[header.kind](memoryview(data)[header.body :], header)
    fields: dict[str, NDArray[Any]] = {}
    for name, column in zip(header.names, columns, strict=True):
        if name != "_" and name not in fields:
            fields[name] = column
    for name in "xyz":
        if fields[name].ndim != 1:
            raise InputError(f"has several values of {name!r} per point")
    color = unpacked_color(fields)
    points = stacked(fields, ("x", "y", "z"))
    normals: Float32 | None = None
    if all(name in fields for name in _NORMALS):
        normals = stacked(fields, _NORMALS).astype(np.float32)
    cloud = GeometryRecord(points, normals=normals, color=color, scalars=fields)
    return Pcd(cloud, header.width, header.height, np.array(header.viewpoint, float))


def unpacked_color(fields: dict[str, NDArray[Any]]) -> UInt8 | None:
    """Remove a packed rgb or rgba field of PCL, and return it as (N, 3); None if there is none."""
    for name in ("rgb", "rgba"):
        packed = fields.get(name)
        if packed is not None and packed.ndim == 1 and packed.dtype.itemsize == 4:
            bits = np.ascontiguousarray(fields.pop(name)).view(np.uint32)
            return np.stack([bits >> 16 & 255, bits >> 8 & 255, bits & 255], -1).astype(np.uint8)
    return None


def _read_header(data: bytes) -> _Header:
    values: dict[str, list[str]] = {}
    offset = 0
    while "DATA" not in values:
        end = data.find(b"\n", offset, _HEADER_LIMIT)
        if end < 0:
            raise InputError(
                "is not a PCD file (its header has no DATA line)" if data else "is empty"
            )
        cells = data[offset:end].decode("latin-1").split("#", 1)[0].split()
        offset = end + 1
        if cells:
            values[cells[0].upper()] = cells[1:]
    try:
        names = values["FIELDS"] if "FIELDS" in values else values["COLUMNS"]
        sizes = [int(v) for v in values["SIZE"]]
        counts = [int(v) for v in values.get("COUNT", ["1"] * len(names))]
        kinds = [v.upper() for v in values["TYPE"]]
        if not len(names) == len(sizes) == len(counts) == len(kinds):
            raise ValueError("FIELDS, SIZE, TYPE and COUNT have different lengths")
        dtypes = [_TYPES[kind, size] for kind, size in zip(kinds, sizes, strict=True)]
        width = int(values["WIDTH"][0])
        height = int(values.get("HEIGHT", ["1"])[0])
        points = int(values.get("POINTS", [str(width * height)])[0])
        viewpoint = tuple(float(v) for v in values.get("VIEWPOINT", []))
        kind = values["DATA"][0].lower()
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(f"has an invalid PCD header ({error})") from error
    if kind not in _COLUMNS:
        raise InputError(f"has PCD data of the kind {kind!r}")
    if points != width * height or width < 0 or height < 0 or any(c < 1 for c in counts):
        raise InputError(f"declares {points} points in {width} x {height}")
    if points > MAX_POINTS or max(counts, default=1) > 65536:
        raise InputError(f"declares {points} points")
    if len(viewpoint) != 7 or not all(map(math.isfinite, viewpoint)):
        viewpoint = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    return _Header(names, dtypes, counts, width, height, points, viewpoint, kind, offset)


def _truncated(header: _Header) -> InputError:
    return InputError(
        f"is cut off: its header declares {header.points} points, more than it contains"
    )


def _binary(body: memoryview, header: _Header) -> list[NDArray[Any]]:
    if header.points * header.stride > len(body):
        raise _truncated(header)
    formats = zip(header.dtypes, ((c,) if c > 1 else () for c in header.counts), strict=True)
    dtype = np.dtype([(f"f{k}", *kind_shape) for k, kind_shape in enumerate(formats)])
    rows = np.frombuffer(body, dtype, header.points)
    return [rows[name] for name in dtype.names or ()]


def _compressed(body: memoryview, header: _Header) -> list[NDArray[Any]]:
    from tofuse.formats.geometry.lzf_kernels import lzf_decompress

    if len(body) < 8:
        raise _truncated(header)
    compressed, size = struct.unpack_from("<II", body)
    expected = header.points * header.stride
    # LZF expands by at most a factor of 88: 264 bytes from 3.
    if compressed > len(body) - 8 or size != expected or size > 88 * compressed + 264:
        raise InputError(
            f"is cut off or damaged: {len(body) - 8} of {compressed} bytes for {expected}"
        )
    out = np.empty(size, np.uint8)
    source = np.frombuffer(body, np.uint8, compressed, 8)
    if lzf_decompress(source, out) != size:
        raise InputError("contains damaged compressed data")
    columns: list[NDArray[Any]] = []
    offset = 0
    for dtype, count in zip(header.dtypes, header.counts, strict=True):
        column = np.frombuffer(out, dtype, header.points * count, offset)
        columns.append(column.reshape(-1, count) if count > 1 else column)
        offset += column.nbytes
    return columns


def _ascii(body: memoryview, header: _Header) -> list[NDArray[Any]]:
    text = tables.plain_nan(bytes(body).decode("latin-1"))
    lines = [line for line in text.splitlines() if line.strip()]
    if len(lines) < header.points:
        raise _truncated(header)
    total = sum(header.counts)
    try:
        table = np.loadtxt(lines[: header.points], ndmin=2, comments=None)
        if header.points and table.shape[1] != total:
            raise ValueError(f"{quantities.count(table.shape[1], 'number')} per row, not {total}")
    except (ValueError, OverflowError) as error:
        reason = str(error).split("; use")[0]
        raise InputError(f"contains damaged points ({reason})") from error
    table = table.reshape(header.points, total)
    columns: list[NDArray[Any]] = []
    first = 0
    with np.errstate(invalid="ignore", over="ignore"):
        for dtype, count in zip(header.dtypes, header.counts, strict=True):
            column = table[:, first : first + count].astype(dtype)
            columns.append(column if count > 1 else column[:, 0])
            first += count
    return columns


_COLUMNS = {"ascii": _ascii, "binary": _binary, "binary_compressed": _compressed}


def write_pcd(path: str | Path, cloud: GeometryRecord) -> None:
    """Write an unorganised cloud, version 0.7, binary; see `replacing` for errors.

    Points are written as float, and as double where they are map coordinates in float64; normals as
    float, colours as PCL does (packed into the bits of a float
    called rgb), integer scalars with 32 bits, and other scalars as float32.

    Raises
    ------
    InputError
        If the shapes disagree.
    """
    cloud.check(path)
    columns: dict[str, NDArray[Any]] = {}
    normals = None if cloud.normals is None else np.asarray(cloud.normals, "<f4")
    for names, values in ((("x", "y", "z"), cloud.written_points()), (_NORMALS, normals)):
        if values is not None:
            columns |= {name: values[:, k] for k, name in enumerate(names)}
    if cloud.color is not None:
        r, g, b = np.asarray(cloud.color, np.uint32).T
        columns["rgb"] = (r << 16 | g << 8 | b).astype("<u4").view("<f4")
    for name, column in cloud.scalars.items():
        columns[name] = column.astype({"i": "<i4", "u": "<u4"}.get(column.dtype.kind, "<f4"))
    count = len(columns["x"])
    rows = np.empty(count, [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    kinds = [column.dtype.kind.upper() for column in columns.values()]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(columns)}",
        f"SIZE {' '.join(str(column.dtype.itemsize) for column in columns.values())}",
        f"TYPE {' '.join(kinds)}",
        f"COUNT {' '.join('1' for _ in columns)}",
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        "DATA binary\n",
    ]
    atomic.write_bytes(path, "\n".join(header).encode() + rows.tobytes())
