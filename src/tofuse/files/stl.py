"""STL, binary: triangles for 3D printing, without colour and without a unit (metres here)."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from tofuse.files.atomic import write_bytes
from tofuse.files.geometry_record import GeometryRecord

_TRIANGLE = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])


def write_stl(path: str | Path, mesh: GeometryRecord) -> None:
    """Write the triangles of a mesh with their own normals; see `replacing` for errors.

    Raises
    ------
    InputError
        If the shapes disagree.
    """
    mesh.check(path)
    faces = np.zeros((0, 3), np.intp) if mesh.faces is None else np.asarray(mesh.faces, np.intp)
    corners = np.asarray(mesh.points, np.float64)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    out = np.zeros(len(corners), _TRIANGLE)
    out["normal"] = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    out["corners"] = corners
    # A header beginning with "solid" would be taken for the text format.
    write_bytes(path, b"binary STL, metres".ljust(80, b"\0"), struct.pack("<I", len(out)), out.data)
