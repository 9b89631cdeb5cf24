"""OBJ (Wavefront): meshes with normals and colours, or a texture in files beside."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofuse.files.atomic import write_bytes, write_text


def write_obj(
    path: str | Path,
    points: ArrayLike,
    faces: ArrayLike,
    *,
    normals: ArrayLike | None = None,
    color: ArrayLike | None = None,
    uv: ArrayLike | None = None,
    texture: bytes | None = None,
) -> None:
    """Write a mesh; with a texture also an .mtl and the image, under the same name.

    Parameters
    ----------
    path
        The .obj file; see `replacing` for errors.
    points
        (N, 3).
    faces
        (M, 3) rows of points.
    normals
        (N, 3).
    color
        (N, 3) uint8 RGB, written behind the points as MeshLab and others read it.
    uv
        (N, 2) places in the texture, from its upper left corner, 0 to 1.
    texture
        A PNG or JPEG file.
    """
    path = Path(path)
    table = np.asarray(points, np.float32).astype(float)
    lines = []
    if texture is not None:
        image = path.with_suffix(".png" if texture.startswith(b"\x89PNG") else ".jpg")
        material = path.with_suffix(".mtl")
        write_bytes(image, texture)
        write_text(material, f"newmtl surface\nKa 1 1 1\nKd 1 1 1\nillum 1\nmap_Kd {image.name}\n")
        lines += [f"mtllib {material.name}", "usemtl surface"]
    if color is not None:
        table = np.column_stack([table, np.asarray(color, float) / 255])
    lines += _rows("v", table, "%.5f" if color is None else "%.5f %.5f %.5f %.4g %.4g %.4g")
    if uv is not None:
        places = np.asarray(uv, float) * [1, -1] + [0, 1]  # from the lower left corner
        lines += _rows("vt", places, "%.5f")
    if normals is not None:
        lines += _rows("vn", np.asarray(normals, float), "%.3f")
    corner = {(False, False): "%d", (True, False): "%d/%d", (False, True): "%d//%d"}.get(
        (uv is not None, normals is not None), "%d/%d/%d"
    )
    repeat = corner.count("%")
    ends = np.repeat(np.asarray(faces, np.int64).reshape(-1, 3) + 1, repeat, axis=1)
    lines += _rows("f", ends, " ".join([corner] * 3))
    write_text(path, "\n".join(lines) + "\n")


def _rows(word: str, table: NDArray[Any], style: str) -> Sequence[str]:
    """Lines of a word and the numbers of each row, in a style for each number or for the row."""
    if style.count("%") < table.shape[1]:
        style = " ".join([style] * table.shape[1])
    line = f"{word} {style}"
    return [line % tuple(row) for row in table.tolist()]
