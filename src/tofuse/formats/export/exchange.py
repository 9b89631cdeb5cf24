"""Meshes and clouds for other programs: files by suffix, and objects of Open3D and trimesh."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tofuse._version import __version__
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.fusion import GeometryRecord, drawing
from tofuse.formats.files import atomic, reading
from tofuse.formats.geometry import (
    write_e57,
    write_glb,
    write_gltf,
    write_las,
    write_obj,
    write_pcd,
    write_ply,
    write_usdz,
)

# From x right, y down, z forward into glTF's x right, y up, z towards the viewer.
_R_GLTF_WORLD = np.diag([1.0, -1.0, -1.0])
_GENERATOR = f"tofuse {__version__}"
_DESCRIPTIONS = {
    "views": "frames that saw the point",
    "sigma": "standard deviation in m",
    **{f"normal {axis}": "away from the surface" for axis in "xyz"},
}


def save(record: GeometryRecord, path: str | Path, R_up_world: Float64 = _R_GLTF_WORLD) -> None:
    """Write a mesh or a cloud in the format of the suffix.

    Parameters
    ----------
    record
        In the world frame; a cloud if it has no faces.
    path
        The file.
    R_up_world
        (3, 3) rotation from the world to axes with y up, used for glTF, OBJ and STL; by
        default the axes of the first camera.

    Raises
    ------
    InputError
        If the suffix is of no format for such geometry.
    OutputError
        If the file can't be written.
    """
    formats = _CLOUDS if record.faces is None else _MESHES
    suffixes = ", ".join(formats)
    file = reading.path_of(path, "path", f"pass the path of a file that ends in one of {suffixes}")
    write = formats.get(file.suffix.lower())
    if write is None:
        raise InputError(
            f"has the suffix {file.suffix!r}", where=file, remedy=f"use one of {suffixes}"
        )
    write(record, file, R_up_world)


def to_trimesh(record: GeometryRecord) -> Any:
    """Return a `trimesh.Trimesh` or `trimesh.PointCloud`, in the frame of the record."""
    trimesh = reading.required_package("trimesh", None, "to_trimesh")
    if record.faces is None:
        return trimesh.PointCloud(record.points, colors=record.color)
    return trimesh.Trimesh(
        record.points,
        record.faces,
        vertex_normals=record.normals,
        vertex_colors=record.color,
        process=False,
    )


def to_open3d(record: GeometryRecord) -> Any:
    """Return an Open3D `TriangleMesh` or `PointCloud`, in the frame of the record."""
    o3d = reading.required_package("open3d", None, "to_open3d")
    vector = o3d.utility.Vector3dVector
    if record.faces is None:
        geometry = o3d.geometry.PointCloud(vector(record.points.astype(float)))
        prefix = ""
    else:
        triangles = o3d.utility.Vector3iVector(record.faces)
        geometry = o3d.geometry.TriangleMesh(vector(record.points.astype(float)), triangles)
        prefix = "vertex_"
    if record.normals is not None:
        setattr(geometry, f"{prefix}normals", vector(record.normals.astype(float)))
    if record.color is not None:
        setattr(geometry, f"{prefix}colors", vector(record.color / 255.0))
    return geometry


def _for_display(mesh: GeometryRecord, R: Float64) -> GeometryRecord:
    """A mesh in other axes, with its texture or else its display colours."""
    return GeometryRecord(
        mesh.points @ R.T,
        mesh.faces,
        None if mesh.normals is None else mesh.normals @ R.T,
        None
        if mesh.color is None or mesh.texture is not None
        else drawing.display_colors(mesh.color),
        mesh.uv,
        mesh.texture,
    )


def _ply(record: GeometryRecord, path: str | Path, _: Float64) -> None:
    write_ply(path, record)


def _las(record: GeometryRecord, path: str | Path, _: Float64) -> None:
    columns = dict(record.scalars)
    if record.normals is not None:
        columns |= {f"normal {a}": record.normals[:, k] for k, a in enumerate("xyz")}
    write_las(
        path,
        GeometryRecord(record.points, color=record.color, scalars=columns),
        descriptions=_DESCRIPTIONS,
        software=_GENERATOR,
    )


def _stl(mesh: GeometryRecord, path: str | Path, R: Float64) -> None:
    atomic.write_bytes(path, to_trimesh(_for_display(mesh, R)).export(file_type="stl"))


_Write = Callable[[GeometryRecord, str | Path, Float64], None]
_MESHES: dict[str, _Write] = {
    ".glb": lambda mesh, path, R: write_glb(path, _for_display(mesh, R), generator=_GENERATOR),
    ".gltf": lambda mesh, path, R: write_gltf(path, _for_display(mesh, R), generator=_GENERATOR),
    ".usdz": lambda mesh, path, R: write_usdz(path, _for_display(mesh, R)),
    ".ply": _ply,
    ".obj": lambda mesh, path, R: write_obj(path, _for_display(mesh, R)),
    ".stl": _stl,
}
_CLOUDS: dict[str, _Write] = {
    ".ply": _ply,
    ".pcd": lambda cloud, path, _: write_pcd(path, cloud),
    ".las": _las,
    ".laz": _las,
    ".e57": lambda cloud, path, _: write_e57(path, cloud),
}
