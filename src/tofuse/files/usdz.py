"""USDZ (OpenUSD; Pixar's "Usdz File Format Specification" 1.3): a mesh for phones and headsets.

An archive without compression in which the content of each file begins at a multiple of 64 bytes.
The first file is the scene, as text.
"""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.files.atomic import write_bytes
from tofuse.files.geometry_record import GeometryRecord
from tofuse.files.glb import linear

_ALIGNMENT = 64  # bytes
_HEADER_BYTES = 30  # of an archive member, before its name
_PADDING_TAG = 0x1986  # of the extra field used as padding, as in OpenUSD's own packages
_DATE = (1980, 1, 1, 0, 0, 0)

_SCENE = """#usda 1.0
(
    defaultPrim = "model"
    doc = "{generator}"
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "model" (
    kind = "component"
)
{{
    def Mesh "surface" (
        prepend apiSchemas = ["MaterialBindingAPI"]
    )
    {{
        uniform bool doubleSided = 1
        float3[] extent = [{low}, {high}]
        int[] faceVertexCounts = [{counts}]
        int[] faceVertexIndices = [{faces}]
        rel material:binding = </model/material>
        point3f[] points = [{points}]
{columns}        uniform token subdivisionScheme = "none"
    }}

    def Material "material"
    {{
        token outputs:surface.connect = </model/material/shader.outputs:surface>

        def Shader "shader"
        {{
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor.connect = </model/material/{reader}>
            float inputs:metallic = 0
            float inputs:roughness = 1
            token outputs:surface
        }}

{shaders}    }}
}}
"""
_TEXTURED = """        def Shader "place"
        {{
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }}

        def Shader "picture"
        {{
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @{image}@
            token inputs:sourceColorSpace = "sRGB"
            float2 inputs:st.connect = </model/material/place.outputs:result>
            token inputs:wrapS = "clamp"
            token inputs:wrapT = "clamp"
            float3 outputs:rgb
        }}
"""
_COLORED = """        def Shader "color"
        {{
            uniform token info:id = "UsdPrimvarReader_float3"
            string inputs:varname = "displayColor"
            float3 outputs:result
        }}
"""


def write_usdz(path: str | Path, mesh: GeometryRecord, *, generator: str = "tofuse") -> None:
    """Write a mesh; see `write_glb` for the parameters, errors and axes.

    Vertex colours, in linear light as USD requires, are shown by few programs; prefer a texture.
    """
    mesh.check(path)
    texture = mesh.texture
    p = np.asarray(mesh.points, np.float32)
    f = np.zeros((0, 3), int) if mesh.faces is None else mesh.faces
    texts = []
    if mesh.normals is not None:
        texts.append(("normal3f[] normals", _tuples(np.asarray(mesh.normals, float), "%.4f")))
    image = "texture.png" if texture is not None and texture[:4] == b"\x89PNG" else "texture.jpg"
    if texture is not None:
        flipped_uv = np.asarray(mesh.uv, float) * [1, -1] + [0, 1]  # from the lower left corner
        texts.append(("texCoord2f[] primvars:st", _tuples(flipped_uv, "%.5f")))
    elif mesh.color is not None:
        light = linear(np.asarray(mesh.color, np.uint8))[:, :3] / 65535
        texts.append(("color3f[] primvars:displayColor", _tuples(light, "%.4f")))
    shaders, reader = _COLORED, "color.outputs:result"
    if texture is not None:
        shaders, reader = _TEXTURED, "picture.outputs:rgb"
    low, high = (p.min(0), p.max(0)) if len(p) else (np.zeros(3), np.zeros(3))
    scene = _SCENE.format(
        generator=generator,
        low=_tuples(low[None], "%.5f"),
        high=_tuples(high[None], "%.5f"),
        counts=", ".join(["3"] * len(f)),
        faces=", ".join(map(str, f.ravel().tolist())),
        points=_tuples(p, "%.5f"),
        columns="".join(
            f'        {primvar} = [{text}] (\n            interpolation = "vertex"\n        )\n'
            for primvar, text in texts
        ),
        reader=reader,
        shaders=shaders.format(image=image),
    )
    files = [("model.usda", scene.encode())]
    if texture is not None:
        files.append((image, texture))
    write_bytes(path, _package(files))


def _tuples(table: NDArray[Any], number_format: str) -> str:
    row = "(" + ", ".join([number_format] * table.shape[1]) + ")"
    return ", ".join([row % tuple(values) for values in table.tolist()])


def _package(files: Iterable[tuple[str, bytes]]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files:
            info = zipfile.ZipInfo(name, _DATE)
            # The content follows the header, the name, and an extra field of 4 bytes plus padding.
            begin = out.tell() + _HEADER_BYTES + len(name.encode()) + 4
            padding = -begin % _ALIGNMENT
            info.extra = struct.pack("<HH", _PADDING_TAG, padding) + bytes(padding)
            archive.writestr(info, content)
    return out.getvalue()
