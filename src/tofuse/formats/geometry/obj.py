"""OBJ (Wavefront): meshes with normals and vertex colours, or a texture in separate files."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.fusion import GeometryRecord
from tofuse.formats.files import atomic


def write_obj(path: str | Path, mesh: GeometryRecord) -> None:
    """Write a mesh; with a texture also an .mtl and the image, under the same name.

    Colours are appended to the coordinates, as MeshLab and others read them.

    Parameters
    ----------
    path
        The .obj file; see `replacing` for errors.
    mesh
        In the axes of the file, usually y up.

    Raises
    ------
    InputError
        If the shapes disagree.
    """
    mesh.check(path)
    path = Path(path)
    normals, color, uv, texture = mesh.normals, mesh.color, mesh.uv, mesh.texture
    table = np.asarray(mesh.points, np.float32).astype(float)
    lines, files = [], {}
    if texture is not None:
        image = path.with_suffix(".png" if texture.startswith(b"\x89PNG") else ".jpg")
        material = path.with_suffix(".mtl")
        surface = f"newmtl surface\nKa 1 1 1\nKd 1 1 1\nillum 1\nmap_Kd {image.name}\n"
        files = {image: texture, material: surface.encode()}
        lines += [f"mtllib {material.name}", "usemtl surface"]
    if color is not None:
        table = np.column_stack([table, np.asarray(color, float) / 255])
    lines += _rows("v", table, "%.5f" if color is None else "%.5f %.5f %.5f %.4g %.4g %.4g")
    if uv is not None:
        flipped_uv = np.asarray(uv, float) * [1, -1] + [0, 1]  # from the lower left corner
        lines += _rows("vt", flipped_uv, "%.5f")
    if normals is not None:
        lines += _rows("vn", np.asarray(normals, float), "%.3f")
    corner = {(False, False): "%d", (True, False): "%d/%d", (False, True): "%d//%d"}.get(
        (uv is not None, normals is not None), "%d/%d/%d"
    )
    repeat = corner.count("%")
    faces = np.zeros((0, 3), int) if mesh.faces is None else mesh.faces
    indices = np.repeat(np.asarray(faces, np.int64) + 1, repeat, axis=1)
    lines += _rows("f", indices, " ".join([corner] * 3))
    files[path] = ("\n".join(lines) + "\n").encode()
    with ExitStack() as stack:  # all are written before any is replaced
        for file, data in files.items():
            stack.enter_context(atomic.replacing(file)).write_bytes(data)


def _rows(keyword: str, table: NDArray[Any], number_format: str) -> Sequence[str]:
    """One line per row: the keyword and the numbers, in a format per number or for all of them."""
    if number_format.count("%") < table.shape[1]:
        number_format = " ".join([number_format] * table.shape[1])
    line = f"{keyword} {number_format}"
    return [line % tuple(row) for row in table.tolist()]
