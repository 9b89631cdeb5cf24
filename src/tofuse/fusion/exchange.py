"""Meshes and clouds for other programs: files by their suffix, Open3D's and trimesh's objects."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tofuse._version import __version__
from tofuse.arrays import Float32, Float64, Int32, UInt8
from tofuse.errors import InputError
from tofuse.files.e57 import write_e57
from tofuse.files.glb import write_glb, write_gltf
from tofuse.files.las import write_las, write_laz
from tofuse.files.obj import write_obj
from tofuse.files.pcd import write_pcd
from tofuse.files.ply import write_ply
from tofuse.files.stl import write_stl
from tofuse.files.usdz import write_usdz
from tofuse.fusion.colors import seen_colors

# From x right, y down, z forward into glTF's x right, y up, z towards the viewer.
_R_GLTF_WORLD = np.diag([1.0, -1.0, -1.0])
_GENERATOR = f"tofuse {__version__}"
_SCALARS = {"views": "frames that saw the point", "sigma": "standard deviation in m"}


@dataclass(frozen=True, eq=False)
class Shape:
    """Points of a model in the world frame, with what is known of them.

    `faces` (M, 3) is None for a cloud; `scalars` are columns (N,) by name. With a `texture`, a PNG
    or JPEG file, and places in it `uv` (N, 2), from its upper left corner, 0 to 1, the formats that
    know textures leave `color` out.
    """

    points: Float64 | Float32
    normals: Float32 | None
    color: UInt8 | None
    scalars: Mapping[str, ArrayLike]
    faces: Int32 | None = None
    uv: Float32 | None = None
    texture: bytes | None = None

    def save(self, path: str | Path, R_up_world: Float64 = _R_GLTF_WORLD) -> None:
        """Write it in the format of the suffix.

        Parameters
        ----------
        R_up_world
            (3, 3) from the world into axes with y up, in which glTF, OBJ, STL and USDZ stand; those
            of the first camera unless given.

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
        write(self, path, R_up_world)

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

    def turned(self, R: Float64) -> dict[str, Any]:
        """Arrays of the mesh in other axes, as writers of meshes that are looked at take them."""
        painted = {"uv": self.uv, "texture": self.texture}
        color = None if self.color is None else seen_colors(self.color)
        return {
            "points": self.points @ R.T,
            "faces": self.faces,
            "normals": None if self.normals is None else self.normals @ R.T,
            **({"color": color} if self.texture is None else painted),
        }


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError("is not installed", where=name, remedy=f"pip install {name}") from error


def _ply(shape: Shape, path: str | Path, _: Float64) -> None:
    write_ply(
        path,
        shape.points,
        normals=shape.normals,
        color=shape.color,
        scalars=shape.scalars,
        faces=shape.faces,
    )


def _stl(shape: Shape, path: str | Path, R: Float64) -> None:
    turned = shape.turned(R)
    write_stl(path, turned["points"], turned["faces"])


def _las(shape: Shape, path: str | Path, _: Float64) -> None:
    scalars = {name: (np.asarray(v), _SCALARS[name]) for name, v in shape.scalars.items()}
    if shape.normals is not None:
        scalars |= {
            f"normal {a}": (shape.normals[:, k], "away from the surface")
            for k, a in enumerate("xyz")
        }
    write = write_laz if Path(path).suffix.lower() == ".laz" else write_las
    write(path, shape.points, color=shape.color, scalars=scalars, software=_GENERATOR)


def _pcd(shape: Shape, path: str | Path, _: Float64) -> None:
    scalars = {name: np.asarray(v) for name, v in shape.scalars.items()}
    write_pcd(path, shape.points, normals=shape.normals, color=shape.color, scalars=scalars)


def _e57(shape: Shape, path: str | Path, _: Float64) -> None:
    scalars = {name: np.asarray(v) for name, v in shape.scalars.items()}
    write_e57(path, shape.points, normals=shape.normals, color=shape.color, scalars=scalars)


_Write = Callable[[Shape, str | Path, Float64], None]
_MESHES: dict[str, _Write] = {
    ".glb": lambda shape, path, R: write_glb(path, **shape.turned(R), generator=_GENERATOR),
    ".gltf": lambda shape, path, R: write_gltf(path, **shape.turned(R), generator=_GENERATOR),
    ".ply": _ply,
    ".obj": lambda shape, path, R: write_obj(path, **shape.turned(R)),
    ".usdz": lambda shape, path, R: write_usdz(path, **shape.turned(R), generator=_GENERATOR),
    ".stl": _stl,
}
_CLOUDS: dict[str, _Write] = {".ply": _ply, ".pcd": _pcd, ".las": _las, ".laz": _las, ".e57": _e57}
