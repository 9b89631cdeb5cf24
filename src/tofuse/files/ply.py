"""PLY: clouds and meshes (Turk 1994), ASCII and binary in, binary little endian out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofuse.arrays import Float32, Float64, Int32, UInt8
from tofuse.errors import InputError
from tofuse.files.atomic import replacing
from tofuse.files.reading import read_bytes

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
_AT_ONCE = 1 << 18  # rows of a file that are packed at a time
_COPY_AGAIN = "copy or export the file again"


@dataclass(frozen=True, eq=False)
class Ply:
    """What a PLY file holds.

    Attributes
    ----------
    vertex
        Columns of the vertices by name, each (N,), in the type of the file.
    faces
        (M, 3) int32 vertex indices (polygons are cut into fans), or None if there are none.
    comments
        Comment and obj_info lines.
    """

    vertex: dict[str, NDArray[np.generic]]
    faces: Int32 | None = None
    comments: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(next(iter(self.vertex.values()), ()))

    @property
    def points(self) -> Float32:
        """(N, 3) float32."""
        return self._columns(("x", "y", "z"), np.float32)

    @property
    def coordinates(self) -> Float64:
        """(N, 3) float64, for coordinates that float32 can't hold."""
        return self._columns(("x", "y", "z"), np.float64)

    @property
    def normals(self) -> Float32 | None:
        """(N, 3) float32, or None."""
        names = ("nx", "ny", "nz")
        return self._columns(names, np.float32) if self._has(names) else None

    @property
    def color(self) -> UInt8 | None:
        """(N, 3) uint8 RGB, or None; colours stored as floats are taken to be 0 to 1."""
        for names in (("red", "green", "blue"), ("r", "g", "b"), _diffuse):
            if self._has(names):
                values = self._columns(names, float)
                if all(self.vertex[n].dtype.kind == "f" for n in names):
                    values = values * 255 if np.nanmax(values, initial=0) <= 1 else values
                return np.clip(np.nan_to_num(np.rint(values)), 0, 255).astype(np.uint8)
        return None

    @property
    def amplitude(self) -> Float32 | None:
        """(N,) float32 of a column called amplitude or intensity (also scalar_...), or None."""
        for name in (
            "amplitude",
            "intensity",
            "scalar_amplitude",
            "scalar_intensity",
            "scalar_Intensity",
        ):
            if name in self.vertex:
                return self.vertex[name].astype(np.float32)
        return None

    def _has(self, names: tuple[str, ...]) -> bool:
        return all(name in self.vertex for name in names)

    def _columns(self, names: tuple[str, ...], dtype: type) -> NDArray[Any]:
        return np.stack([self.vertex[n] for n in names], -1).astype(dtype)


_diffuse = ("diffuse_red", "diffuse_green", "diffuse_blue")


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


def read_ply(path: str | Path) -> Ply:
    """Read the vertices and faces of a PLY file; other elements are passed over.

    Raises
    ------
    InputError
        If it is no PLY, is cut off, promises more than it holds, or has no vertices with x, y, z.
    """
    data = read_bytes(path)
    kind, elements, comments, body = _read_header(data, path)
    columns: dict[str, dict[str, NDArray[np.generic]]] = {}
    reader = (
        _Ascii(data[body:], path) if kind == "ascii" else _Binary(data, body, _FORMATS[kind], path)
    )
    for element in elements:
        columns[element.name] = reader.element(element)
        if element.name == "face" or ("vertex" in columns and not _has_later(elements, element)):
            break
    vertex = columns.get("vertex", {})
    if not all(name in vertex for name in "xyz"):
        raise InputError(
            "has no vertices with x, y and z", where=path, remedy="export a cloud or a mesh"
        )
    faces = columns.get("face", {})
    indices = next((faces[n] for n in ("vertex_indices", "vertex_index") if n in faces), None)
    if indices is not None:
        indices = _checked_faces(indices, len(vertex["x"]), path)
    return Ply(vertex, indices, tuple(comments))


def _has_later(elements: list[_Element], element: _Element) -> bool:
    """Whether the faces come after this element."""
    return any(e.name == "face" for e in elements[elements.index(element) + 1 :])


def _read_header(data: bytes, path: str | Path) -> tuple[str, list[_Element], list[str], int]:
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r"):
        raise InputError(
            "is empty" if not data else "is no PLY file (it doesn't begin with 'ply')",
            where=path,
            remedy=_COPY_AGAIN,
        )
    at = data.find(b"end_header", 0, _HEADER_LIMIT)
    line_end = data.find(b"\n", at) if at >= 0 else -1
    if at < 0 or (line_end < 0 and not data.endswith(b"end_header")):
        raise InputError("has no end of its PLY header", where=path, remedy=_COPY_AGAIN)
    kind = ""
    elements: list[_Element] = []
    comments: list[str] = []
    for line in data[3:at].decode("latin-1").splitlines():
        words = line.split()
        try:
            match words:
                case []:
                    pass
                case ["comment" | "obj_info", *rest]:
                    comments.append(" ".join(rest))
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
                f"has a PLY header line that can't be understood: {line[:60]!r}",
                where=path,
                remedy=_COPY_AGAIN,
            ) from error
        names = [p.name for e in elements[-1:] for p in e.properties]
        if len(set(names)) != len(names):
            raise InputError(f"declares {names[-1]!r} twice", where=path, remedy=_COPY_AGAIN)
    if kind not in _FORMATS:
        raise InputError(f"has the PLY format {kind!r}", where=path, remedy=_COPY_AGAIN)
    return kind, elements, comments, line_end + 1 if line_end >= 0 else len(data)


def _cut_off(element: _Element, path: str | Path) -> InputError:
    return InputError(
        f"is cut off: its header promises {element.count} of {element.name!r}, more than it holds",
        where=path,
        remedy=_COPY_AGAIN,
    )


class _Binary:
    """Reads elements one after the other from the body of a binary file."""

    def __init__(self, data: bytes, at: int, order: str, path: str | Path) -> None:
        self.data, self.at, self.order, self.path = data, at, order, path

    def element(self, element: _Element) -> dict[str, NDArray[np.generic]]:
        if not element.has_list:
            dtype = np.dtype([(p.name, self.order + p.dtype) for p in element.properties])
            rows = self._rows(dtype, element)
            return {p.name: _native(rows[p.name]) for p in element.properties}
        if len(element.properties) == 1:
            return self._even_list(element) or self._any_lists(element)
        return self._any_lists(element)

    def _rows(self, dtype: np.dtype, element: _Element) -> NDArray[np.void]:
        size = dtype.itemsize * element.count
        if self.at + size > len(self.data):
            raise _cut_off(element, self.path)
        rows = np.frombuffer(self.data, dtype, element.count, self.at)
        self.at += size
        return rows

    def _even_list(self, element: _Element) -> dict[str, NDArray[np.generic]] | None:
        """Read lists that all have the length of the first, at once; None if they don't."""
        (p,) = element.properties
        count_dtype = np.dtype(self.order + str(p.count_dtype))
        if element.count == 0:
            return {p.name: np.zeros((0, 3), np.int32)}
        if self.at + count_dtype.itemsize > len(self.data):
            raise _cut_off(element, self.path)
        n = int(np.frombuffer(self.data, count_dtype, 1, self.at)[0])
        if not 1 <= n <= 64:
            return None
        dtype = np.dtype([("n", count_dtype), ("items", self.order + p.dtype, (n,))])
        size = dtype.itemsize * element.count
        if self.at + size > len(self.data):
            return None
        rows = np.frombuffer(self.data, dtype, element.count, self.at)
        if (rows["n"] != n).any():
            return None
        self.at += size
        return {p.name: _fans(rows["items"])}

    def _any_lists(self, element: _Element) -> dict[str, NDArray[np.generic]]:
        """Read rows one by one; only the polygons of the first list are kept."""
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
        return {name: _uneven_fans(rows) for name, rows in polygons.items()}

    def _take(self, dtype: np.dtype, n: int, element: _Element) -> NDArray[np.generic]:
        size = dtype.itemsize * n
        if n < 0 or self.at + size > len(self.data):
            raise _cut_off(element, self.path)
        items = np.frombuffer(self.data, dtype, n, self.at)
        self.at += size
        return items


class _Ascii:
    """Reads elements one after the other from the lines of a text body."""

    def __init__(self, body: bytes, path: str | Path) -> None:
        self.lines = [line for line in body.decode("latin-1").splitlines() if line.strip()]
        self.at, self.path = 0, path

    def element(self, element: _Element) -> dict[str, NDArray[np.generic]]:
        lines = self.lines[self.at : self.at + element.count]
        if len(lines) < element.count:
            raise _cut_off(element, self.path)
        self.at += element.count
        try:
            if element.has_list:
                return self._lists(element, lines)
            width = len(element.properties)
            table = np.loadtxt(lines, ndmin=2) if lines else np.zeros((0, width))
            if table.shape[1] < width:
                raise ValueError(f"{table.shape[1]} numbers in a row, not {width}")
            with np.errstate(invalid="ignore", over="ignore"):
                return {
                    p.name: table[:, k].astype(p.dtype) for k, p in enumerate(element.properties)
                }
        except (ValueError, IndexError, OverflowError) as error:
            raise InputError(
                f"has a damaged list of {element.name!r} ({error})",
                where=self.path,
                remedy=_COPY_AGAIN,
            ) from error

    def _lists(self, element: _Element, lines: list[str]) -> dict[str, NDArray[np.generic]]:
        polygons: dict[str, list[NDArray[np.generic]]] = {
            p.name: [] for p in element.properties if p.count_dtype
        }
        for line in lines:
            words = line.split()
            at = 0
            for p in element.properties:
                n = 1
                if p.count_dtype:
                    n, at = int(words[at]), at + 1
                if n < 0 or at + n > len(words):
                    raise ValueError("a row is too short")
                if p.count_dtype:
                    polygons[p.name].append(np.array([float(w) for w in words[at : at + n]]))
                at += n
        return {name: _uneven_fans(rows) for name, rows in polygons.items()}


def _native(column: NDArray[np.generic]) -> NDArray[np.generic]:
    return column.astype(column.dtype.newbyteorder("="))


def _fans(polygons: NDArray[np.generic]) -> Int32:
    """Cut (M, n) polygons into (M (n - 2), 3) triangles."""
    with np.errstate(invalid="ignore"):
        p = polygons.astype(np.int64)
    n = p.shape[1]
    if n < 3:
        return np.zeros((0, 3), np.int32)
    triangles = np.stack(
        [np.stack([p[:, 0], p[:, k], p[:, k + 1]], -1) for k in range(1, n - 1)], 1
    )
    return np.clip(triangles.reshape(-1, 3), -1, 2**31 - 1).astype(np.int32)


def _uneven_fans(rows: list[NDArray[np.generic]]) -> Int32:
    parts = [_fans(row[None]) for row in rows]
    return np.concatenate([np.zeros((0, 3), np.int32), *parts])


def _checked_faces(faces: NDArray[np.generic], vertices: int, path: str | Path) -> Int32:
    if faces.size and (faces.min() < 0 or faces.max() >= vertices):
        raise InputError(
            f"has faces that name vertices other than 0 to {vertices - 1}",
            where=path,
            remedy=_COPY_AGAIN,
        )
    return faces.astype(np.int32)


def write_ply(
    path: str | Path,
    points: ArrayLike,
    *,
    normals: ArrayLike | None = None,
    color: ArrayLike | None = None,
    scalars: Mapping[str, ArrayLike] | None = None,
    faces: ArrayLike | None = None,
    comments: tuple[str, ...] = (),
    double: bool = False,
) -> None:
    """Write a cloud or a mesh, binary little endian.

    Parameters
    ----------
    path
        The file; see `replacing` for errors.
    points
        (N, 3), written as float32, or float64 if `double`.
    normals
        (N, 3), written as float32 nx ny nz.
    color
        (N, 3) RGB, written as uchar red green blue.
    scalars
        More (N,) columns by name, after the others, in their own type (64-bit integers as int,
        booleans as uchar).
    faces
        (M, 3) vertex indices.
    comments
        Lines for the header.
    double
        For coordinates that float32 can't hold, as those of maps.

    Raises
    ------
    InputError
        If the shapes disagree.
    """
    points = np.asarray(points, np.float64 if double else np.float32)
    columns: dict[str, tuple[NDArray[np.generic], str]] = {}
    groups: list[tuple[str, ArrayLike | None, str, tuple[str, ...]]] = [
        ("points", points, "<f8" if double else "<f4", ("x", "y", "z")),
        ("normals", normals, "<f4", ("nx", "ny", "nz")),
        ("color", color, "u1", ("red", "green", "blue")),
    ]
    for what, values, dtype, names in groups:
        if values is not None:
            array = np.asarray(values)
            _check_shape(path, what, array, (len(points), 3))
            columns |= {name: (array[:, k], dtype) for k, name in enumerate(names)}
    for name, values in (scalars or {}).items():
        array = np.asarray(values)
        _check_shape(path, name, array, (len(points),))
        columns[name] = array, _stored(array.dtype)
    row = np.dtype([(name, dtype) for name, (_, dtype) in columns.items()])
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment {' '.join(c.split())}" for c in comments]
    header += [f"element vertex {len(points)}"]
    header += [
        f"property {_NAMES[np.dtype(dtype).str[1:]]} {name}" for name, (_, dtype) in columns.items()
    ]
    triangles = None
    if faces is not None:
        triangles = np.asarray(faces)
        _check_shape(path, "faces", triangles, (len(triangles), 3))
        header += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
    header.append("end_header\n")
    with replacing(path) as beside, beside.open("wb") as file:
        file.write("\n".join(header).encode())
        for part in _parts(len(points)):
            rows = np.empty(part.stop - part.start, row)
            for name, (column, _) in columns.items():
                rows[name] = column[part]
            file.write(rows.view(np.uint8).data)
        for part in _parts(0 if triangles is None else len(triangles)):
            assert triangles is not None
            polygon = np.empty(part.stop - part.start, [("n", "u1"), ("items", "<i4", (3,))])
            polygon["n"], polygon["items"] = 3, triangles[part]
            file.write(polygon.view(np.uint8).data)


def _parts(count: int) -> Iterator[slice]:
    """Cut so many rows into parts that are packed and written one after the other."""
    return (slice(a, min(a + _AT_ONCE, count)) for a in range(0, count, _AT_ONCE))


def _stored(dtype: np.dtype) -> str:
    code = dtype.kind + str(dtype.itemsize)
    if code in _NAMES:
        return dtype.newbyteorder("<").str
    return {"b": "u1", "i": "<i4", "u": "<u4"}.get(dtype.kind, "<f4")


def _check_shape(
    path: str | Path, what: str, array: NDArray[np.generic], shape: tuple[int, ...]
) -> None:
    if array.shape != shape:
        raise InputError(
            f"{what} have shape {array.shape}", where=path, remedy=f"give an array of shape {shape}"
        )
