"""STL, binary: triangles for 3D printers, without colour and without a unit (here metres)."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from tofuse.files.atomic import write_bytes

_TRIANGLE = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])


def write_stl(path: str | Path, points: ArrayLike, faces: ArrayLike) -> None:
    """Write a mesh: points (N, 3) in m, and faces (M, 3), rows of them; see `replacing` for errors.

    Normals are those of the triangles.
    """
    corners = np.asarray(points, np.float64)[np.asarray(faces, np.intp).reshape(-1, 3)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    out = np.zeros(len(corners), _TRIANGLE)
    out["normal"] = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    out["corners"] = corners
    # A header that began with "solid" would be taken for the text form.
    write_bytes(path, b"binary STL, metres".ljust(80, b"\0"), struct.pack("<I", len(out)), out.data)
