"""glTF 2.0 in one file (Khronos Group, 2021): a mesh with normals and colours or a texture."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofuse.arrays import Float64, UInt8, UInt16
from tofuse.files.atomic import write_bytes, write_text
from tofuse.files.geometry_record import GeometryRecord
from tofuse.files.reading import damage_reported, read_bytes

_FLOAT, _USHORT, _UINT = 5126, 5123, 5125
_VERTICES, _INDICES = 34962, 34963
_LINEAR, _CLAMP = 9729, 33071


def write_glb(
    path: str | Path,
    mesh: GeometryRecord,
    *,
    T_scene_node: ArrayLike | None = None,
    name: str = "model",
    generator: str = "tofuse",
) -> None:
    """Write a mesh; without faces, a file with an empty scene.

    Parameters
    ----------
    path
        The file; see `replacing` for errors.
    mesh
        In axes x right, y up, z towards the viewer. Colours are written as linear light, scalars as
        float32 in application-specific attributes `_NAME`.
    T_scene_node
        (4, 4) from the frame of the points to that of the scene; identity unless given.
    name, generator
        Name of the mesh and of the writing program, as the file states them.

    Raises
    ------
    InputError
        If the shapes disagree.
    """
    write_bytes(path, *_binary(*_document(path, mesh, T_scene_node, name, generator)))


def unlit_glb(points: ArrayLike, faces: ArrayLike, color: ArrayLike) -> bytes:
    """Return a mesh as a .glb file whose colours are shown without shading, back faces culled.

    Uses the extension KHR_materials_unlit.

    Parameters
    ----------
    points, faces
        (N, 3) and (M, 3), see `GeometryRecord`.
    color
        (N, 3) uint8 sRGB, or float32 linear light.
    """
    mesh = GeometryRecord(np.asarray(points), np.asarray(faces))
    colors = np.asarray(color)
    if colors.dtype != np.float32:
        colors = linear(colors.astype(np.uint8))
    document, body = _document("a mesh", mesh, None, "model", "tofuse", colors)
    for material in document.get("materials", ()):
        material |= {"doubleSided": False, "extensions": {"KHR_materials_unlit": {}}}
        document["extensionsUsed"] = ["KHR_materials_unlit"]
    return b"".join(_binary(document, body))


def _binary(document: dict[str, Any], body: bytearray) -> list[bytes | bytearray]:
    """The header and the chunks of a .glb file with a document and its buffer."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks: list[bytes | bytearray] = [struct.pack("<I4s", len(text), b"JSON"), text]
    if body:
        chunks += [struct.pack("<I4s", len(body), b"BIN\0"), body]
    size = 12 + sum(len(chunk) for chunk in chunks)
    return [struct.pack("<4sII", b"glTF", 2, size), *chunks]


def write_gltf(path: str | Path, mesh: GeometryRecord, *, generator: str = "tofuse") -> None:
    """Write a mesh as `write_glb` does, as one JSON file with all data embedded as base64."""
    document, body = _document(path, mesh, None, "model", generator)
    for buffer in document.get("buffers", ()):
        text = base64.b64encode(body).decode()
        buffer["uri"] = f"data:application/octet-stream;base64,{text}"
    write_text(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def _document(
    path: str | Path,
    mesh: GeometryRecord,
    T_scene_node: ArrayLike | None,
    name: str,
    generator: str,
    linear_colors: NDArray[Any] | None = None,
) -> tuple[dict[str, Any], bytearray]:
    """The JSON document of a mesh, and its buffer; `linear_colors` if the mesh has no colours."""
    mesh.check(path)
    points = np.asarray(mesh.points, np.float32)
    faces = np.zeros((0, 3), np.int32) if mesh.faces is None else mesh.faces
    columns: dict[str, NDArray[np.generic]] = {"POSITION": points}
    if mesh.normals is not None:
        columns["NORMAL"] = np.asarray(mesh.normals, np.float32)
    if mesh.color is not None:
        linear_colors = linear(np.asarray(mesh.color, np.uint8))
    if linear_colors is not None:
        columns["COLOR_0"] = linear_colors
    if mesh.uv is not None:
        columns["TEXCOORD_0"] = np.asarray(mesh.uv, np.float32)
    for scalar, column in mesh.scalars.items():
        columns[f"_{scalar.upper()}"] = np.asarray(column, np.float32).reshape(-1, 1)
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": generator},
        "scene": 0,
        "scenes": [{}],
    }
    if len(faces) == 0:
        return document, bytearray()
    body = bytearray()
    views: list[dict[str, Any]] = []
    accessors = []

    def append(data: bytes, **properties: int) -> None:
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": len(data), **properties})
        body.extend(data + b"\0" * (-len(data) % 4))

    parts = [*columns.values(), faces.astype("<u4").reshape(-1, 1)]
    for k, values in enumerate(parts):
        append(
            np.ascontiguousarray(values).tobytes(),
            target=_INDICES if k == len(columns) else _VERTICES,
        )
        accessors.append(_accessor(k, values))
    # Required by the standard for positions.
    accessors[0] |= {"min": points.min(0).tolist(), "max": points.max(0).tolist()}
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    if mesh.texture is not None:
        append(mesh.texture)
        kind = "image/png" if mesh.texture.startswith(b"\x89PNG") else "image/jpeg"
        document["images"] = [{"bufferView": len(views) - 1, "mimeType": kind}]
        document["samplers"] = [
            {"magFilter": _LINEAR, "minFilter": _LINEAR, "wrapS": _CLAMP, "wrapT": _CLAMP}
        ]
        document["textures"] = [{"source": 0, "sampler": 0}]
        surface["baseColorTexture"] = {"index": 0}
    attributes = {attribute: k for k, attribute in enumerate(columns)}
    primitive = {"attributes": attributes, "indices": len(columns), "material": 0, "mode": 4}
    node: dict[str, Any] = {"mesh": 0, "name": name}
    if T_scene_node is not None:  # stored in column-major order
        node["matrix"] = np.asarray(T_scene_node, float).T.ravel().tolist()
    document |= {
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "materials": [{"name": "surface", "doubleSided": True, "pbrMetallicRoughness": surface}],
        "meshes": [{"name": name, "primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }
    return document, body


def _accessor(view: int, values: NDArray[np.generic]) -> dict[str, Any]:
    component = {"f": _FLOAT, "u2": _USHORT, "u4": _UINT}
    code = values.dtype.kind if values.dtype.kind == "f" else f"u{values.dtype.itemsize}"
    accessor: dict[str, Any] = {
        "bufferView": view,
        "componentType": component[code],
        "count": len(values),
        "type": {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[values.shape[1]],
    }
    if code == "u2":
        accessor["normalized"] = True
    return accessor


def linear_of_srgb() -> Float64:
    """Return the linear light (256,), 0 to 1, of sRGB values 0 to 255 (IEC 61966-2-1)."""
    s = np.arange(256) / 255
    return np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)


def _rounded_linear() -> UInt16:
    """(256,) `linear_of_srgb` as 16 bits, ascending."""
    return np.round(65535 * linear_of_srgb()).astype("<u2")


def linear(color: UInt8) -> UInt16:
    """Return linear light and opacity (N, 4), 16 bits, of (N, 3) sRGB colours."""
    out = np.full((*color.shape[:-1], 4), 65535, "<u2")
    out[..., :3] = _rounded_linear()[color]
    return out


def read_glb(path: str | Path) -> GeometryRecord:
    """Read the mesh of a file that `write_glb` wrote: float32 columns, int32 faces, no texture.

    Raises
    ------
    InputError
        If it can't be read, is damaged, or was written by another program.
    """
    data = read_bytes(path)
    with damage_reported(path, "a mesh"):
        document, body = _chunks(data)
        if "meshes" not in document:
            return GeometryRecord(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
        primitive = document["meshes"][0]["primitives"][0]
        columns = {
            name: _column(document, body, int(k)) for name, k in primitive["attributes"].items()
        }
        points = columns["POSITION"].astype(np.float32)
        faces = _column(document, body, int(primitive["indices"])).reshape(-1, 3)
        if points.shape[1:] != (3,) or any(len(c) != len(points) for c in columns.values()):
            raise ValueError("its columns differ in length")
        if faces.size and (faces.min() < 0 or faces.max() >= len(points)):
            raise ValueError("a face refers to a vertex that does not exist")
        normals, light = columns.get("NORMAL"), columns.get("COLOR_0")
        color = None
        if light is not None:
            color = np.searchsorted(_rounded_linear(), light[:, :3]).clip(0, 255).astype(np.uint8)
        return GeometryRecord(
            points,
            faces.astype(np.int32),
            None if normals is None else normals.astype(np.float32),
            color,
            scalars={
                name[1:].lower(): values[:, 0].astype(np.float32)
                for name, values in columns.items()
                if name.startswith("_")
            },
        )


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON document and the buffer of a file."""
    magic, version, length = struct.unpack_from("<4sII", data)
    if (magic, version, length) != (b"glTF", 2, len(data)):
        raise ValueError("invalid header")
    offset, chunks = 12, {b"BIN\0": b""}
    while offset < length:
        size, kind = struct.unpack_from("<I4s", data, offset)
        chunks[kind] = data[offset + 8 : offset + 8 + size]
        offset += 8 + size
    return json.loads(chunks[b"JSON"]), chunks[b"BIN\0"]


def _column(document: Mapping[str, Any], body: bytes, number: int) -> NDArray[Any]:
    """The (N, width) values of an accessor."""
    accessor = document["accessors"][number]
    view = document["bufferViews"][accessor["bufferView"]]
    dtype = np.dtype({_FLOAT: "<f4", _USHORT: "<u2", _UINT: "<u4"}[accessor["componentType"]])
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    count = int(accessor["count"]) * width
    return np.frombuffer(body, dtype, count, int(view["byteOffset"])).reshape(-1, width)
