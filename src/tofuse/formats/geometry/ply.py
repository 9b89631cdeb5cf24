"""PLY: clouds and meshes (Turk 1994); reads ASCII and binary, writes binary little-endian."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Float32, Int32, UInt8
from tofuse.engine.errors import InputError
from tofuse.engine.fusion import GeometryRecord
from tofuse.formats.files import atomic, reading

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
    kind, elements, comments, body = _read_header(data, path)
    columns: dict[str, _Columns] = {}
    reader = (
        _Ascii(data[body:], path) if kind == "ascii" else _Binary(data, body, _FORMATS[kind], path)
    )
    for element in elements:
        columns[element.name] = reader.element(element)
        if element.name == "face" or ("vertex" in columns and not _has_later(elements, element)):
            break
    vertex = columns.get("vertex", {})
    if not all(name in vertex for name in _POINTS):
        raise InputError(
            "has no vertices with x, y and z", where=path, remedy="export a cloud or a mesh"
        )
    faces = columns.get("face", {})
    indices = next((faces[n] for n in ("vertex_indices", "vertex_index") if n in faces), None)
    if indices is not None:
        indices = _checked_faces(indices, len(vertex["x"]), path)
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


def _read_header(data: bytes, path: str | Path) -> tuple[str, list[_Element], list[str], int]:
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r"):
        raise InputError(
            "is empty" if not data else "is not a PLY file (it doesn't begin with 'ply')",
            where=path,
            remedy=_COPY_AGAIN,
        )
    header_end = data.find(b"end_header", 0, _HEADER_LIMIT)
    line_end = data.find(b"\n", header_end) if header_end >= 0 else -1
    if header_end < 0 or (line_end < 0 and not data.endswith(b"end_header")):
        raise InputError("has a PLY header without an end", where=path, remedy=_COPY_AGAIN)
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
            raise InputError(
                f"has an invalid PLY header line: {line[:60]!r}",
                where=path,
                remedy=_COPY_AGAIN,
            ) from error
        names = [p.name for e in elements[-1:] for p in e.properties]
        if len(set(names)) != len(names):
            raise InputError(f"declares {names[-1]!r} twice", where=path, remedy=_COPY_AGAIN)
    if kind not in _FORMATS:
        raise InputError(f"has the unknown PLY format {kind!r}", where=path, remedy=_COPY_AGAIN)
    return kind, elements, comments, line_end + 1 if line_end >= 0 else len(data)


def _truncated(element: _Element, path: str | Path) -> InputError:
    return InputError(
        f"is cut off: its header declares {element.count} of {element.name!r}, "
        "more than it contains",
        where=path,
        remedy=_COPY_AGAIN,
    )


class _Binary:
    """Reads elements sequentially from the body of a binary file."""

    def __init__(self, data: bytes, offset: int, order: str, path: str | Path) -> None:
        self.data, self.offset, self.order, self.path = data, offset, order, path

    def element(self, element: _Element) -> _Columns:
        if not element.has_list:
            dtype = np.dtype([(p.name, self.order + p.dtype) for p in element.properties])
            rows = self._rows(dtype, element)
            return {p.name: _native(rows[p.name]) for p in element.properties}
        if len(element.properties) == 1:
            return self._equal_lists(element) or self._lists(element)
        return self._lists(element)

    def _rows(self, dtype: np.dtype, element: _Element) -> NDArray[np.void]:
        size = dtype.itemsize * element.count
        if self.offset + size > len(self.data):
            raise _truncated(element, self.path)
        rows = np.frombuffer(self.data, dtype, element.count, self.offset)
        self.offset += size
        return rows

    def _equal_lists(self, element: _Element) -> _Columns | None:
        """Read lists that all have the length of the first, vectorised; None if they don't."""
        (p,) = element.properties
        count_dtype = np.dtype(self.order + str(p.count_dtype))
        if element.count == 0:
            return {p.name: np.zeros((0, 3), np.int32)}
        if self.offset + count_dtype.itemsize > len(self.data):
            raise _truncated(element, self.path)
        n = int(np.frombuffer(self.data, count_dtype, 1, self.offset)[0])
        if not 1 <= n <= 64:
            return None
        dtype = np.dtype([("n", count_dtype), ("items", self.order + p.dtype, (n,))])
        size = dtype.itemsize * element.count
        if self.offset + size > len(self.data):
            return None
        rows = np.frombuffer(self.data, dtype, element.count, self.offset)
        if (rows["n"] != n).any():
            return None
        self.offset += size
        return {p.name: _fans(rows["items"])}

    def _lists(self, element: _Element) -> _Columns:
        """Read lists of any lengths, row by row; other properties are skipped."""
        polygons: dict[str, list[NDArray[np.generic]]] = {
            p.name: [] for p in element.properties if p.count_dtype
        }
        for _ in range(element.count):
            for p in element.properties:
                n = 1
                if p.count_dtype:
                    n = int(self._take(np.dtype(self.order + p.count_dtype), 1, element)[0])
                items = self._take(np.dtype(self.order + p.dtype), n, element)
                if p.count_dtype:
                    polygons[p.name].append(items)
        return {name: _triangulated(rows) for name, rows in polygons.items()}

    def _take(self, dtype: np.dtype, n: int, element: _Element) -> NDArray[np.generic]:
        size = dtype.itemsize * n
        if n < 0 or self.offset + size > len(self.data):
            raise _truncated(element, self.path)
        items = np.frombuffer(self.data, dtype, n, self.offset)
        self.offset += size
        return items


class _Ascii:
    """Reads elements sequentially from the lines of a text body."""

    def __init__(self, body: bytes, path: str | Path) -> None:
        self.lines = [line for line in body.decode("latin-1").splitlines() if line.strip()]
        self.offset, self.path = 0, path

    def element(self, element: _Element) -> _Columns:
        lines = self.lines[self.offset : self.offset + element.count]
        if len(lines) < element.count:
            raise _truncated(element, self.path)
        self.offset += element.count
        try:
            if element.has_list:
                return self._lists(element, lines)
            width = len(element.properties)
            table = np.loadtxt(lines, ndmin=2) if lines else np.zeros((0, width))
            if table.shape[1] < width:
                raise ValueError(f"{table.shape[1]} numbers per row, not {width}")
            with np.errstate(invalid="ignore", over="ignore"):
                return {
                    p.name: table[:, k].astype(p.dtype) for k, p in enumerate(element.properties)
                }
        except (ValueError, IndexError, OverflowError) as error:
            raise InputError(
                f"has damaged data of element {element.name!r} ({error})",
                where=self.path,
                remedy=_COPY_AGAIN,
            ) from error

    def _lists(self, element: _Element, lines: list[str]) -> _Columns:
        polygons: dict[str, list[NDArray[np.generic]]] = {
            p.name: [] for p in element.properties if p.count_dtype
        }
        for line in lines:
            cells = line.split()
            position = 0
            for p in element.properties:
                n = 1
                if p.count_dtype:
                    n, position = int(cells[position]), position + 1
                if n < 0 or position + n > len(cells):
                    raise ValueError("a row is too short")
                if p.count_dtype:
                    polygons[p.name].append(
                        np.array([float(w) for w in cells[position : position + n]])
                    )
                position += n
        return {name: _triangulated(rows) for name, rows in polygons.items()}


def _native(column: NDArray[np.generic]) -> NDArray[np.generic]:
    return column.astype(column.dtype.newbyteorder("="))


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


def _triangulated(polygons: list[NDArray[np.generic]]) -> Int32:
    """Triangles (K, 3) of polygons with any number of corners each."""
    triangles = [_fans(polygon[None]) for polygon in polygons]
    return np.concatenate([np.zeros((0, 3), np.int32), *triangles])


def _checked_faces(faces: NDArray[np.generic], vertices: int, path: str | Path) -> Int32:
    if faces.size and (faces.min() < 0 or faces.max() >= vertices):
        raise InputError(
            f"has faces with vertex indices outside 0 to {vertices - 1}",
            where=path,
            remedy=_COPY_AGAIN,
        )
    return faces.astype(np.int32)


def write_ply(path: str | Path, record: GeometryRecord, *, double: bool = False) -> None:
    """Write a cloud or a mesh, binary little-endian, without its texture.

    Normals are written as float nx ny nz, colours as uchar red green blue, scalars in their own
    type (64-bit integers as int, booleans as uchar).

    Parameters
    ----------
    path
        The file; see `replacing` for errors.
    record
        The cloud or mesh.
    double
        Whether to write the points as float64 instead of float32, as map coordinates require.

    Raises
    ------
    InputError
        If the shapes disagree.
    """
    record.check(path)
    points = np.asarray(record.points, np.float64 if double else np.float32)
    columns: dict[str, tuple[NDArray[Any], str]] = {}
    groups: list[tuple[NDArray[Any] | None, str, tuple[str, ...]]] = [
        (points, "<f8" if double else "<f4", _POINTS),
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
