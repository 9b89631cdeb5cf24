"""PLY: clouds and meshes (Turk 1994); reads ASCII and binary, writes binary little-endian."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine import quantities
from tofuse.engine.arrays import Float32, Int32, UInt8
from tofuse.engine.errors import InputError
from tofuse.engine.fusion import GeometryRecord
from tofuse.formats.files import atomic, reading, tables

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint",
          "f4": "float", "f8": "double"}  # fmt: skip
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_HEADER_LIMIT = 1 << 16
_BLOCK_ROWS = 1 << 18  # written at a time
_COPY_AGAIN = "copy or export the file again"
_POINTS, _NORMALS = ("x", "y", "z"), ("nx", "ny", "nz")
_COLORS = (
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)

_Columns = dict[str, NDArray[Any]]
_Take = Callable[[str, int], NDArray[Any]]  # from the type and the number of values


@dataclass
class _Property:
    name: str
    dtype: str
    count_dtype: str | None = None


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    @property
    def has_list(self) -> bool:
        return any(p.count_dtype for p in self.properties)


def read_ply(path: str | Path) -> GeometryRecord:
    """Read the vertices and faces of a PLY file; other elements are ignored.

    Points are float64 where float32 can't represent the columns of the file. Polygons are split
    into triangle fans. Floating-point colours are taken to be 0 to 1 if none is above 1. The lines
    called comment and obj_info become `comments`.

    Raises
    ------
    InputError
        If it is not a PLY file, is cut off, declares more than it contains, or has no vertices with
        x, y and z.
    """
    data = reading.read_bytes(path)
    with reading.about(path, _COPY_AGAIN):
        return _parsed(data)


def _parsed(data: bytes) -> GeometryRecord:
    kind, elements, comments, body = _read_header(data)
    columns: dict[str, _Columns] = {}
    reader = _Ascii(data[body:]) if kind == "ascii" else _Binary(data, body, _FORMATS[kind])
    for element in elements:
        if element.name == "vertex" and element.has_list:
            raise InputError(
                "has vertices with lists", remedy="export it without further attributes"
            )
        columns[element.name] = reader.element(element)
        if element.name == "face" or ("vertex" in columns and not _has_later(elements, element)):
            break
    vertex = columns.get("vertex", {})
    if not all(name in vertex for name in _POINTS):
        raise InputError("has no vertices with x, y and z", remedy="export a cloud or a mesh")
    faces = columns.get("face", {})
    indices = next((faces[n] for n in ("vertex_indices", "vertex_index") if n in faces), None)
    if indices is not None:
        if indices.size and (indices.min() < 0 or indices.max() >= len(vertex["x"])):
            raise InputError(f"has faces with vertex indices outside 0 to {len(vertex['x']) - 1}")
        indices = indices.astype(np.int32)
    points = stacked(vertex, _POINTS)
    normals: Float32 | None = None
    if all(name in vertex for name in _NORMALS):
        normals = stacked(vertex, _NORMALS).astype(np.float32)
    color = None
    for names in _COLORS:
        if color is None and all(name in vertex for name in names):
            color = _color([vertex.pop(name) for name in names])
    return GeometryRecord(points, indices, normals, color, scalars=vertex, comments=tuple(comments))


def _color(columns: list[NDArray[Any]]) -> UInt8:
    """(N, 3) colours of three columns (N,)."""
    if all(column.dtype == np.uint8 for column in columns):
        return np.stack(columns, -1)
    values = np.stack(columns, -1).astype(float)
    if all(column.dtype.kind == "f" for column in columns):
        values = values * 255 if np.nanmax(values, initial=0) <= 1 else values
    return np.clip(np.nan_to_num(np.rint(values)), 0, 255).astype(np.uint8)


def _has_later(elements: list[_Element], element: _Element) -> bool:
    """Whether the faces come after this element."""
    return any(e.name == "face" for e in elements[elements.index(element) + 1 :])


def _read_header(data: bytes) -> tuple[str, list[_Element], list[str], int]:
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r"):
        raise InputError("is not a PLY file (it doesn't begin with 'ply')" if data else "is empty")
    header_end = data.find(b"end_header", 0, _HEADER_LIMIT)
    line_end = data.find(b"\n", header_end) if header_end >= 0 else -1
    if header_end < 0 or (line_end < 0 and not data.endswith(b"end_header")):
        raise InputError("has a PLY header without an end")
    kind = ""
    elements: list[_Element] = []
    comments: list[str] = []
    for line in data[3:header_end].decode("latin-1").splitlines():
        cells = line.split()
        try:
            match cells:
                case []:
                    pass
                case ["comment" | "obj_info", *text]:
                    comments.append(" ".join(text))
                case ["format", kind, *_]:
                    pass
                case ["element", name, count]:
                    elements.append(_Element(name, int(count)))
                    if elements[-1].count < 0:
                        raise ValueError
                case ["property", "list", count_type, item_type, name]:
                    elements[-1].properties.append(
                        _Property(name, _TYPES[item_type], _TYPES[count_type])
                    )
                case ["property", item_type, name]:
                    elements[-1].properties.append(_Property(name, _TYPES[item_type]))
                case _:
                    raise ValueError
        except (ValueError, KeyError, IndexError) as error:
            raise InputError(f"has an invalid PLY header line: {line[:60]!r}") from error
        names = [p.name for e in elements[-1:] for p in e.properties]
        if len(set(names)) != len(names):
            raise InputError(f"declares {names[-1]!r} twice")
    if kind not in _FORMATS:
        raise InputError(f"has the unknown PLY format {kind!r}")
    return kind, elements, comments, line_end + 1 if line_end >= 0 else len(data)


def _truncated(element: _Element) -> InputError:
    declared = f"{element.count} of {element.name!r}"
    return InputError(f"is cut off: its header declares {declared}, more than it contains")


def _lists(element: _Element, rows: Iterable[_Take]) -> _Columns:
    """Read lists of any lengths, by functions that take values of each row; skip other columns."""
    triangles: dict[str, list[Int32]] = {p.name: [] for p in element.properties if p.count_dtype}
    for take in rows:
        for p in element.properties:
            items = take(p.dtype, int(take(p.count_dtype, 1)[0]) if p.count_dtype else 1)
            if p.count_dtype:
                triangles[p.name].append(_fans(items[None]))
    none = np.zeros((0, 3), np.int32)
    return {name: np.concatenate([none, *rows]) for name, rows in triangles.items()}


class _Binary:
    """Reads elements sequentially from the body of a binary file."""

    def __init__(self, data: bytes, offset: int, order: str) -> None:
        self.data, self.offset, self.order = data, offset, order

    def element(self, element: _Element) -> _Columns:
        if not element.has_list:
            dtype = np.dtype([(p.name, self.order + p.dtype) for p in element.properties])
            rows = self._take(dtype, element.count, element)
            native = {p.name: np.dtype(p.dtype) for p in element.properties}
            return {name: rows[name].astype(kind) for name, kind in native.items()}
        columns = self._equal_lists(element) if len(element.properties) == 1 else None
        if columns is None:

            def take(kind: str, n: int) -> NDArray[Any]:
                return self._take(self._dtype(kind), n, element)

            columns = _lists(element, itertools.repeat(take, element.count))
        return columns

    def _dtype(self, kind: str) -> np.dtype:
        return np.dtype(self.order + kind)

    def _equal_lists(self, element: _Element) -> _Columns | None:
        """Read lists that all have the length of the first, vectorised; None if they don't."""
        (p,) = element.properties
        count_dtype, start = self._dtype(str(p.count_dtype)), self.offset
        if element.count == 0:
            return {p.name: np.zeros((0, 3), np.int32)}
        n = int(self._take(count_dtype, 1, element)[0])
        self.offset = start
        if not 1 <= n <= 64:
            return None
        dtype = np.dtype([("n", count_dtype), ("items", self._dtype(p.dtype), (n,))])
        if start + dtype.itemsize * element.count > len(self.data):
            return None
        rows = self._take(dtype, element.count, element)
        if (rows["n"] == n).all():
            return {p.name: _fans(rows["items"])}
        self.offset = start
        return None

    def _take(self, dtype: np.dtype, n: int, element: _Element) -> NDArray[Any]:
        size = dtype.itemsize * n
        if n < 0 or self.offset + size > len(self.data):
            raise _truncated(element)
        items = np.frombuffer(self.data, dtype, n, self.offset)
        self.offset += size
        return items


class _Ascii:
    """Reads elements sequentially from the lines of a text body."""

    def __init__(self, body: bytes) -> None:
        text = tables.plain_nan(body.decode("latin-1"))
        self.lines = [line for line in text.splitlines() if line.strip()]
        self.offset = 0

    def element(self, element: _Element) -> _Columns:
        lines = self.lines[self.offset : self.offset + element.count]
        if len(lines) < element.count:
            raise _truncated(element)
        self.offset += element.count
        try:
            if element.has_list:
                return _lists(element, map(_taking, lines))
            width = len(element.properties)
            table = np.loadtxt(lines, ndmin=2) if lines else np.zeros((0, width))
            if table.shape[1] < width:
                raise ValueError(
                    f"{quantities.count(table.shape[1], 'number')} per row, not {width}"
                )
            with np.errstate(invalid="ignore", over="ignore"):
                return {
                    p.name: table[:, k].astype(p.dtype) for k, p in enumerate(element.properties)
                }
        except (ValueError, IndexError, OverflowError) as error:
            raise InputError(f"has damaged data of element {element.name!r} ({error})") from error


def _taking(line: str) -> _Take:
    cells = iter(line.split())

    def take(_kind: str, n: int) -> NDArray[Any]:
        values = [float(cell) for cell in itertools.islice(cells, n)]
        if len(values) < n:
            raise ValueError("a row is too short")
        return np.array(values)

    return take


def _fans(polygons: NDArray[np.generic]) -> Int32:
    """Split (M, n) polygons into (M (n - 2), 3) triangles."""
    with np.errstate(invalid="ignore"):
        p = polygons.astype(np.int64)
    n = p.shape[1]
    if n < 3:
        return np.zeros((0, 3), np.int32)
    triangles = np.stack(
        [np.stack([p[:, 0], p[:, k], p[:, k + 1]], -1) for k in range(1, n - 1)], 1
    )
    return np.clip(triangles.reshape(-1, 3), -1, 2**31 - 1).astype(np.int32)


def write_ply(path: str | Path, record: GeometryRecord) -> None:
    """Write a cloud or a mesh, binary little-endian, without its texture.

    Points are written as float, and as double where they are map coordinates in float64.
    Normals are written as float nx ny nz, colours as uchar red green blue, scalars in their own
    type (64-bit integers as int, booleans as uchar).

    Parameters
    ----------
    path
        The file; see `replacing` for errors.
    record
        The cloud or mesh.

    Raises
    ------
    InputError
        If the shapes disagree.
    """
    record.check(path)
    points = record.written_points()
    columns: dict[str, tuple[NDArray[Any], str]] = {}
    groups: list[tuple[NDArray[Any] | None, str, tuple[str, ...]]] = [
        (points, points.dtype.str, _POINTS),
        (record.normals, "<f4", _NORMALS),
        (record.color, "u1", _COLORS[0]),
    ]
    for values, dtype, names in groups:
        if values is not None:
            columns |= {name: (values[:, k], dtype) for k, name in enumerate(names)}
    for name, values in record.scalars.items():
        columns[name] = values, _stored(values.dtype)
    row = np.dtype([(name, dtype) for name, (_, dtype) in columns.items()])
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment {' '.join(c.split())}" for c in record.comments]
    header += [f"element vertex {len(points)}"]
    header += [
        f"property {_NAMES[np.dtype(dtype).str[1:]]} {name}" for name, (_, dtype) in columns.items()
    ]
    faces = record.faces
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header.append("end_header\n")
    with atomic.replacing(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode())
        for block in _blocks(len(points)):
            rows = np.empty(block.stop - block.start, row)
            for name, (column, _) in columns.items():
                rows[name] = column[block]
            file.write(rows.view(np.uint8).data)
        for block in _blocks(0 if faces is None else len(faces)):
            assert faces is not None
            polygon = np.empty(block.stop - block.start, [("n", "u1"), ("items", "<i4", (3,))])
            polygon["n"], polygon["items"] = 3, faces[block]
            file.write(polygon.view(np.uint8).data)


def _blocks(count: int) -> Iterator[slice]:
    """Split `count` rows into blocks that are written sequentially."""
    return (slice(a, min(a + _BLOCK_ROWS, count)) for a in range(0, count, _BLOCK_ROWS))


def _stored(dtype: np.dtype) -> str:
    code = dtype.kind + str(dtype.itemsize)
    if code in _NAMES:
        return dtype.newbyteorder("<").str
    return {"b": "u1", "i": "<i4", "u": "<u4"}.get(dtype.kind, "<f4")


def stacked(columns: dict[str, NDArray[Any]], names: Sequence[str]) -> NDArray[np.floating]:
    """Remove named columns (N,), and return them as (N, C) float32 or float64."""
    removed = [columns.pop(name) for name in names]
    dtype = np.result_type(np.float32, *(column.dtype for column in removed))
    with np.errstate(invalid="ignore"):  # damaged data can contain signalling NaNs
        return np.stack(removed, -1).astype(dtype, copy=False)
