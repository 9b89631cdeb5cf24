"""Meshes and clouds for other programs: files by their suffix, Open3D's and trimesh's objects."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofuse.errors import InputError
from tofuse.files.e57 import write_e57
from tofuse.files.glb import write_glb, write_gltf
from tofuse.files.las import write_las
from tofuse.files.obj import write_obj
from tofuse.files.pcd import write_pcd
from tofuse.files.ply import write_ply
from tofuse.files.stl import write_stl

Float64 = NDArray[np.float64]

# From x right, y down, z forward into glTF's x right, y up, z towards the viewer.
_R_GLTF_WORLD = np.diag([1.0, -1.0, -1.0])
_SCALARS = {"views": "frames that saw the point", "sigma": "standard deviation in m"}


@dataclass(frozen=True, eq=False)
class Shape:
    """Points of a model in the world frame, with what is known of them.

    `faces` (M, 3) is None for a cloud; `scalars` are columns (N,) by name.
    """

    points: Float64
    normals: NDArray[np.float32] | None
    color: NDArray[np.uint8] | None
    scalars: Mapping[str, ArrayLike]
    faces: NDArray[np.int32] | None = None

    def save(self, path: str | Path) -> None:
        """Write it in the format of the suffix; glTF and STL stand with y up.

        Raises
        ------
        InputError
            If the suffix is of no format for such a shape.
        OutputError
            If the file can't be written.
        """
        formats = _CLOUDS if self.faces is None else _MESHES
        write = formats.get(Path(path).suffix.lower())
        if write is None:
            raise InputError(
                f"has the suffix {Path(path).suffix!r}",
                where=path,
                remedy=f"use one of {', '.join(formats)}",
            )
        write(self, path)

    def to_trimesh(self) -> Any:
        """Return a `trimesh.Trimesh` or `trimesh.PointCloud`, in the world frame."""
        trimesh = _library("trimesh")
        if self.faces is None:
            return trimesh.PointCloud(self.points, colors=self.color)
        return trimesh.Trimesh(
            self.points,
            self.faces,
            vertex_normals=self.normals,
            vertex_colors=self.color,
            process=False,
        )

    def to_open3d(self) -> Any:
        """Return an Open3D `TriangleMesh` or `PointCloud`, in the world frame."""
        o3d = _library("open3d")
        vector = o3d.utility.Vector3dVector
        if self.faces is None:
            out = o3d.geometry.PointCloud(vector(self.points))
            prefix = ""
        else:
            triangles = o3d.utility.Vector3iVector(self.faces)
            out = o3d.geometry.TriangleMesh(vector(self.points), triangles)
            prefix = "vertex_"
        if self.normals is not None:
            setattr(out, f"{prefix}normals", vector(self.normals.astype(float)))
        if self.color is not None:
            setattr(out, f"{prefix}colors", vector(self.color / 255.0))
        return out

    def _upright(self) -> dict[str, Any]:
        normals = None if self.normals is None else self.normals @ _R_GLTF_WORLD
        return {
            "points": self.points @ _R_GLTF_WORLD,
            "faces": self.faces,
            "normals": normals,
            "color": self.color,
        }


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError("is not installed", where=name, remedy=f"pip install {name}") from error


def _ply(shape: Shape, path: str | Path) -> None:
    write_ply(
        path,
        shape.points,
        normals=shape.normals,
        color=shape.color,
        scalars=shape.scalars,
        faces=shape.faces,
    )


def _stl(shape: Shape, path: str | Path) -> None:
    upright = shape._upright()
    write_stl(path, upright["points"], upright["faces"])


def _las(shape: Shape, path: str | Path) -> None:
    scalars = {name: (np.asarray(v), _SCALARS[name]) for name, v in shape.scalars.items()}
    write_las(path, shape.points, color=shape.color, scalars=scalars)


def _pcd(shape: Shape, path: str | Path) -> None:
    scalars = {name: np.asarray(v) for name, v in shape.scalars.items()}
    write_pcd(path, shape.points, normals=shape.normals, color=shape.color, scalars=scalars)


def _e57(shape: Shape, path: str | Path) -> None:
    scalars = {name: np.asarray(v) for name, v in shape.scalars.items()}
    write_e57(path, shape.points, normals=shape.normals, color=shape.color, scalars=scalars)


_Write = Callable[[Shape, str | Path], None]
_MESHES: dict[str, _Write] = {
    ".glb": lambda shape, path: write_glb(path, **shape._upright()),
    ".gltf": lambda shape, path: write_gltf(path, **shape._upright()),
    ".ply": _ply,
    ".obj": lambda shape, path: write_obj(path, **shape._upright()),
    ".stl": _stl,
}
_CLOUDS: dict[str, _Write] = {".ply": _ply, ".pcd": _pcd, ".las": _las, ".e57": _e57}
