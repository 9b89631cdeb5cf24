"""USDZ (Pixar and Apple, 2018): a textured mesh that phones show in the room by a tap."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.errors import InputError
from tofuse.engine.fusion import GeometryRecord
from tofuse.formats.files import atomic

# Alignment of the data of each file in the archive, by an extra field in its header.
_ALIGNMENT, _HEADER_BYTES, _PADDING_ID = 64, 30, 0x1986

_STAGE = """#usda 1.0
(
    defaultPrim = "Model"
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "Model" (kind = "component")
{
    def Mesh "Surface" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        uniform bool doubleSided = 1
        uniform token subdivisionScheme = "none"
        float3[] extent = [%(extent)s]
        int[] faceVertexCounts = [%(counts)s]
        int[] faceVertexIndices = [%(faces)s]
        point3f[] points = [%(points)s]
        texCoord2f[] primvars:st = [%(uv)s] (interpolation = "vertex")
        rel material:binding = </Model/Material>
    }

    def Material "Material"
    {
        token outputs:surface.connect = </Model/Material/Shader.outputs:surface>

        def Shader "Shader"
        {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor.connect = </Model/Material/Texture.outputs:rgb>
            float inputs:metallic = 0
            float inputs:roughness = 1
            token outputs:surface
        }

        def Shader "Texture"
        {
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @%(image)s@
            float2 inputs:st.connect = </Model/Material/Reader.outputs:result>
            token inputs:sourceColorSpace = "sRGB"
            token inputs:wrapS = "clamp"
            token inputs:wrapT = "clamp"
            float3 outputs:rgb
        }

        def Shader "Reader"
        {
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }
    }
}
"""


def write_usdz(path: str | Path, mesh: GeometryRecord) -> None:
    """Write a mesh with a texture, in axes x right, y up, z towards the viewer.

    Raises
    ------
    InputError
        If it has no faces or no texture, or the shapes disagree.
    """
    mesh.check(path)
    if mesh.faces is None or mesh.texture is None or mesh.uv is None:
        raise InputError("needs a surface with a texture", where=path, remedy="use .glb")
    points = np.asarray(mesh.points, float)
    kind = "png" if mesh.texture.startswith(b"\x89PNG") else "jpg"
    image = f"texture.{kind}"
    stage = _STAGE % {
        "extent": _rows(np.stack([points.min(0), points.max(0)]), 4),
        "counts": ", ".join(["3"] * len(mesh.faces)),
        "faces": ", ".join(map(str, np.asarray(mesh.faces).ravel().tolist())),
        "points": _rows(points, 4),
        # From the lower left corner.
        "uv": _rows(np.asarray(mesh.uv, float) * [1, -1] + [0, 1], 5),
        "image": image,
    }
    atomic.write_bytes(path, _package({"model.usda": stage.encode(), image: mesh.texture}))


def _rows(values: NDArray[np.floating], digits: int) -> str:
    template = "(" + ", ".join([f"%.{digits}f"] * values.shape[1]) + ")"
    return ", ".join(template % tuple(row) for row in values.tolist())


def _package(files: dict[str, bytes]) -> bytes:
    """Return an archive without compression, the data of each file aligned."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files.items():
            member = zipfile.ZipInfo(name)  # of 1980, so that the same model gives the same file
            start = out.tell() + _HEADER_BYTES + len(name) + 4
            padding = -start % _ALIGNMENT
            member.extra = (
                _PADDING_ID.to_bytes(2, "little") + padding.to_bytes(2, "little") + bytes(padding)
            )
            archive.writestr(member, data)
    return out.getvalue()
