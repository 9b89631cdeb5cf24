"""glTF 2.0 in one file (Khronos Group, 2021): a mesh with normals and colours or a texture."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofuse.engine.arrays import UInt8, UInt16
from tofuse.engine.fusion import GeometryRecord
from tofuse.formats.files import atomic

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
    atomic.write_bytes(path, *_binary(*_document(path, mesh, T_scene_node, name, generator)))


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
    atomic.write_text(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def _document(
    path: str | Path,
    mesh: GeometryRecord,
    T_scene_node: ArrayLike | None,
    name: str,
    generator: str,
) -> tuple[dict[str, Any], bytearray]:
    """The JSON document of a mesh, and its buffer."""
    mesh.check(path)
    points = np.asarray(mesh.points, np.float32)
    faces = np.zeros((0, 3), np.int32) if mesh.faces is None else mesh.faces
    columns: dict[str, NDArray[np.generic]] = {"POSITION": points}
    if mesh.normals is not None:
        columns["NORMAL"] = np.asarray(mesh.normals, np.float32)
    if mesh.color is not None:
        columns["COLOR_0"] = linear(np.asarray(mesh.color, np.uint8))
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


def read_textured_glb(path: Path) -> tuple[GeometryRecord, bool] | None:
    """Read the mesh of a .glb file of `write_glb` if it has a texture; None for any other file.

    Also returns whether the file turns it by a node, so that it is in the frame of the world.
    """
    try:
        data = path.read_bytes()
        length = struct.unpack_from("<I", data, 12)[0]
        document = json.loads(data[20 : 20 + length])
        body = memoryview(data)[28 + length :]
        parts = [body[v["byteOffset"] :][: v["byteLength"]] for v in document["bufferViews"]]
        primitive = document["meshes"][0]["primitives"][0]
        image = bytes(parts[document["images"][0]["bufferView"]])
        faces = np.frombuffer(parts[primitive["indices"]], "<u4").reshape(-1, 3).astype(np.int32)
        columns = [
            np.frombuffer(parts[primitive["attributes"][name]], "<f4").reshape(-1, width)
            for name, width in (("POSITION", 3), ("NORMAL", 3), ("TEXCOORD_0", 2))
        ]
        points, normals, uv = columns
        record = GeometryRecord(points, faces, normals=normals, uv=uv, texture=image)
        return record, "matrix" in document["nodes"][0]
    except (OSError, ValueError, LookupError, TypeError, struct.error):
        return None


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


def linear(color: UInt8) -> UInt16:
    """Return linear light and opacity (N, 4), 16 bits, of (N, 3) sRGB colours (IEC 61966-2-1)."""
    s = np.arange(256) / 255
    light = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    out = np.full((*color.shape[:-1], 4), 65535, "<u2")
    out[..., :3] = np.round(65535 * light).astype("<u2")[color]
    return out
