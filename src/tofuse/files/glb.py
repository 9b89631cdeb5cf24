"""glTF 2.0 in one file (Khronos Group, 2021): a mesh with normals and colours or a texture."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofuse.arrays import Float32, Int32, UInt8, UInt16
from tofuse.errors import InputError
from tofuse.files.atomic import write_bytes, write_text
from tofuse.files.reading import read_bytes

_FLOAT, _USHORT, _UINT = 5126, 5123, 5125
_VERTICES, _INDICES = 34962, 34963
_LINEAR, _CLAMP = 9729, 33071


def write_glb(
    path: str | Path,
    points: ArrayLike,
    faces: ArrayLike,
    *,
    normals: ArrayLike | None = None,
    color: ArrayLike | None = None,
    uv: ArrayLike | None = None,
    texture: bytes | None = None,
    T_scene_node: ArrayLike | None = None,
    scalars: Mapping[str, ArrayLike] | None = None,
    name: str = "model",
    generator: str = "tofuse",
) -> None:
    """Write a mesh; without faces, a file with an empty scene.

    Parameters
    ----------
    path
        The file; see `replacing` for errors.
    points
        (N, 3) in m: x right, y up, z towards the viewer.
    faces
        (M, 3) rows of points, counter-clockwise seen from outside.
    normals
        (N, 3) unit normals.
    color
        (N, 3) uint8 RGB as shown on a screen (sRGB); the file holds linear light.
    uv
        (N, 2) places in the texture, from its upper left corner, 0 to 1.
    texture
        A PNG or JPEG file.
    T_scene_node
        (4, 4) from the frame of the points into the scene; the points are in the scene's axes
        without one.
    scalars
        More (N,) columns by name, kept as float32 in attributes of the application: `_NAME`.

    Raises
    ------
    InputError
        If the shapes disagree.
    """
    document, body = _document(
        path,
        points,
        faces,
        normals,
        color,
        uv,
        texture,
        T_scene_node,
        scalars or {},
        name,
        generator,
    )
    write_bytes(path, *_packed(document, body))


def unlit_glb(points: ArrayLike, faces: ArrayLike, color: ArrayLike) -> bytes:
    """Return a mesh as `write_glb` writes it, seen from outside only, in colours no light changes.

    By the extension KHR_materials_unlit. Colours (N, 3) are uint8 sRGB, or float32 linear light.
    """
    document, body = _document(
        "a mesh", points, faces, None, color, None, None, None, {}, "model", "tofuse"
    )
    for material in document.get("materials", ()):
        material |= {"doubleSided": False, "extensions": {"KHR_materials_unlit": {}}}
        document["extensionsUsed"] = ["KHR_materials_unlit"]
    return b"".join(_packed(document, body))


def _packed(document: dict[str, Any], body: bytearray) -> list[bytes | bytearray]:
    """The parts of the file of a document and its buffer."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks: list[bytes | bytearray] = [struct.pack("<I4s", len(text), b"JSON"), text]
    if body:
        chunks += [struct.pack("<I4s", len(body), b"BIN\0"), body]
    size = 12 + sum(len(chunk) for chunk in chunks)
    return [struct.pack("<4sII", b"glTF", 2, size), *chunks]


def write_gltf(
    path: str | Path,
    points: ArrayLike,
    faces: ArrayLike,
    *,
    normals: ArrayLike | None = None,
    color: ArrayLike | None = None,
    uv: ArrayLike | None = None,
    texture: bytes | None = None,
    T_scene_node: ArrayLike | None = None,
    name: str = "model",
    generator: str = "tofuse",
) -> None:
    """Write a mesh as `write_glb` does, as one file of JSON with all data inside as base64."""
    document, body = _document(
        path, points, faces, normals, color, uv, texture, T_scene_node, {}, name, generator
    )
    for buffer in document.get("buffers", ()):
        text = base64.b64encode(body).decode()
        buffer["uri"] = f"data:application/octet-stream;base64,{text}"
    write_text(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def _document(
    path: str | Path,
    points: ArrayLike,
    faces: ArrayLike,
    normals: ArrayLike | None,
    color: ArrayLike | None,
    uv: ArrayLike | None,
    texture: bytes | None,
    T_scene_node: ArrayLike | None,
    scalars: Mapping[str, ArrayLike],
    name: str,
    generator: str,
) -> tuple[dict[str, Any], bytearray]:
    """What glTF says of a mesh, and its buffer."""
    points, faces = np.asarray(points, np.float32), np.asarray(faces)
    columns: dict[str, NDArray[np.generic]] = {"POSITION": points}
    if normals is not None:
        columns["NORMAL"] = np.asarray(normals, np.float32)
    if color is not None:
        light = np.asarray(color)
        columns["COLOR_0"] = light if light.dtype == np.float32 else linear(light.astype(np.uint8))
    if uv is not None:
        columns["TEXCOORD_0"] = np.asarray(uv, np.float32)
    for scalar, column in scalars.items():
        columns[f"_{scalar.upper()}"] = np.asarray(column, np.float32).reshape(-1, 1)
    check_mesh(path, points, faces, columns)
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

    def keep(data: bytes, **more: int) -> None:
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": len(data), **more})
        body.extend(data + b"\0" * (-len(data) % 4))

    parts = [*columns.values(), faces.astype("<u4").reshape(-1, 1)]
    for k, values in enumerate(parts):
        keep(
            np.ascontiguousarray(values).tobytes(),
            target=_INDICES if k == len(columns) else _VERTICES,
        )
        accessors.append(_accessor(k, values))
    # Asked for by the standard, for positions.
    accessors[0] |= {"min": points.min(0).tolist(), "max": points.max(0).tolist()}
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    if texture is not None:
        keep(texture)
        kind = "image/png" if texture.startswith(b"\x89PNG") else "image/jpeg"
        document["images"] = [{"bufferView": len(views) - 1, "mimeType": kind}]
        document["samplers"] = [
            {"magFilter": _LINEAR, "minFilter": _LINEAR, "wrapS": _CLAMP, "wrapT": _CLAMP}
        ]
        document["textures"] = [{"source": 0, "sampler": 0}]
        surface["baseColorTexture"] = {"index": 0}
    attributes = {what: k for k, what in enumerate(columns)}
    primitive = {"attributes": attributes, "indices": len(columns), "material": 0, "mode": 4}
    node: dict[str, Any] = {"mesh": 0, "name": name}
    if T_scene_node is not None:  # stored column by column
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


def check_mesh(
    path: str | Path, points: ArrayLike, faces: ArrayLike, columns: Mapping[str, ArrayLike]
) -> None:
    """Raise InputError, naming the file, unless columns (N, ...) and faces fit points (N, 3)."""
    points, faces = np.asarray(points), np.asarray(faces)
    for what, values in {"points": points, **columns}.items():
        shape = np.shape(values)
        if shape[:1] != points.shape[:1] or len(shape) != 2 or points.shape[1:] != (3,):
            raise InputError(
                f"{what} has shape {shape}", where=path, remedy=f"give {len(points)} rows"
            )
    if faces.ndim != 2 or faces.shape[1] != 3 or (faces.size and faces.max() >= len(points)):
        raise InputError(
            f"faces of shape {faces.shape} don't fit {len(points)} points",
            where=path,
            remedy="give (M, 3) rows of points",
        )


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


def _light_of_screen() -> UInt16:
    """(256,) linear light of sRGB values (IEC 61966-2-1), ascending."""
    s = np.arange(256) / 255
    light = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    return np.round(65535 * light).astype("<u2")


def linear(color: UInt8) -> UInt16:
    """Linear light and opacity (N, 4) of sRGB colours."""
    out = np.full((*color.shape[:-1], 4), 65535, "<u2")
    out[..., :3] = _light_of_screen()[color]
    return out


@dataclass(frozen=True, eq=False)
class Glb:
    """A mesh as `write_glb` takes it; see there."""

    points: Float32
    faces: Int32
    normals: Float32 | None
    color: UInt8 | None
    scalars: Mapping[str, Float32]


def read_glb(path: str | Path) -> Glb:
    """Read a file of one mesh that `write_glb` wrote; without a texture, if it has one.

    Raises
    ------
    InputError
        If it can't be read, is damaged, or is no such file.
    """
    data = read_bytes(path)
    try:
        document, body = _chunks(data)
        if "meshes" not in document:
            nothing = np.zeros((0, 3))
            return Glb(nothing.astype(np.float32), nothing.astype(np.int32), None, None, {})
        primitive = document["meshes"][0]["primitives"][0]
        columns = {
            name: _column(document, body, int(k)) for name, k in primitive["attributes"].items()
        }
        points = columns["POSITION"].astype(np.float32)
        faces = _column(document, body, int(primitive["indices"])).reshape(-1, 3)
        if points.shape[1:] != (3,) or any(len(c) != len(points) for c in columns.values()):
            raise ValueError("its columns disagree")
        if faces.size and (faces.min() < 0 or faces.max() >= len(points)):
            raise ValueError("a face names no vertex")
        normals, light = columns.get("NORMAL"), columns.get("COLOR_0")
        color = None
        if light is not None:
            color = np.searchsorted(_light_of_screen(), light[:, :3]).clip(0, 255).astype(np.uint8)
        return Glb(
            points,
            faces.astype(np.int32),
            None if normals is None else normals.astype(np.float32),
            color,
            {
                name[1:].lower(): values[:, 0].astype(np.float32)
                for name, values in columns.items()
                if name.startswith("_")
            },
        )
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, struct.error) as error:
        raise InputError(
            f"is no mesh of ours, or damaged ({error})", where=path, remedy="copy or make it again"
        ) from error


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The document and the buffer of a file."""
    magic, version, length = struct.unpack_from("<4sII", data)
    if (magic, version, length) != (b"glTF", 2, len(data)):
        raise ValueError("its header is wrong")
    at, found = 12, {b"BIN\0": b""}
    while at < length:
        size, kind = struct.unpack_from("<I4s", data, at)
        found[kind] = data[at + 8 : at + 8 + size]
        at += 8 + size
    return json.loads(found[b"JSON"]), found[b"BIN\0"]


def _column(document: Mapping[str, Any], body: bytes, number: int) -> NDArray[Any]:
    """The values of an accessor, one row for each."""
    accessor = document["accessors"][number]
    view = document["bufferViews"][accessor["bufferView"]]
    dtype = np.dtype({_FLOAT: "<f4", _USHORT: "<u2", _UINT: "<u4"}[accessor["componentType"]])
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    count = int(accessor["count"]) * width
    return np.frombuffer(body, dtype, count, int(view["byteOffset"])).reshape(-1, width)
