"""The common content of the file formats of meshes and point clouds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Float32, Float64, Int32, UInt8
from tofuse.engine.errors import InputError
from tofuse.engine.frames import map_shift

_AMPLITUDES = (
    "amplitude",
    "intensity",
    "i",
    "scalar_amplitude",
    "scalar_intensity",
    "scalar_Intensity",
)


@dataclass(frozen=True, eq=False)
class GeometryRecord:
    """A mesh or a point cloud as files store it. Each format stores the fields that it supports.

    Attributes
    ----------
    points
        (N, 3) in m, float32 or float64.
    faces
        (M, 3) int32 vertex indices, counter-clockwise from outside; None for a cloud.
    normals
        (N, 3) unit normals.
    color
        (N, 3) uint8 sRGB.
    uv
        (N, 2) texture coordinates, 0 to 1, from the upper left corner of the texture.
    texture
        Content of a PNG or JPEG file.
    scalars
        Further columns by name, (N,); (N, C) where a PCD field has several values.
    comments
        Comment lines of a PLY header.
    """

    points: NDArray[np.floating]
    faces: Int32 | None = None
    normals: NDArray[np.floating] | None = None
    color: UInt8 | None = None
    uv: NDArray[np.floating] | None = None
    texture: bytes | None = None
    scalars: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    comments: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.points)

    @property
    def amplitude(self) -> Float32 | None:
        """(N,) float32: the scalar that is named like an amplitude or intensity, or None."""
        for name in _AMPLITUDES:
            if name in self.scalars and self.scalars[name].ndim == 1:
                return self.scalars[name].astype(np.float32)
        return None

    def check(self, path: str | Path) -> None:
        """Check that all columns belong to the same points, and the faces to them.

        Raises
        ------
        InputError
            If they do not; it names `path`.
        """
        n = len(self.points)
        columns = {"normals": (self.normals, 3), "color": (self.color, 3), "uv": (self.uv, 2)}
        shapes: list[tuple[str, NDArray[Any], tuple[int, ...]]] = [("points", self.points, (n, 3))]
        shapes += [
            (k, values, (n, width)) for k, (values, width) in columns.items() if values is not None
        ]
        shapes += [(name, values, (n,)) for name, values in self.scalars.items()]
        for name, values, shape in shapes:
            if np.shape(values) != shape:
                raise InputError(
                    f"{name} of shape {np.shape(values)} for {n} points",
                    where=path,
                    remedy=f"pass an array of shape {shape}",
                )
        faces = self.faces
        if faces is None:
            return
        if faces.ndim != 2 or faces.shape[1] != 3 or (faces.size and faces.max() >= n):
            raise InputError(
                f"faces of shape {faces.shape} don't fit {n} points",
                where=path,
                remedy="pass (M, 3) vertex indices",
            )

    def written_points(self) -> NDArray[np.floating]:
        """Return the points as files hold them: "<f8" for map coordinates in float64, or "<f4"."""
        double = self.points.dtype == np.float64 and bool(map_shift(self.points).any())
        return np.asarray(self.points, "<f8" if double else "<f4")

    def shifted(self, shift: Float64) -> GeometryRecord:
        """Return the record with points plus a shift (3,) in m: float64, unless it is zero."""
        if not shift.any():
            return self
        return replace(self, points=self.points.astype(np.float64) + shift)


# Imported by name on use: nothing else of the engine knows a file format.
_WRITERS = "tofuse.formats.export"


class Exportable:
    """Geometry that can be saved, and converted to the types of other packages."""

    def record(self) -> GeometryRecord:
        """Return points in the world frame, with faces and columns."""
        raise NotImplementedError

    def save(self, path: str | Path) -> None:
        """Write a file in the format of its suffix.

        Meshes: .glb, .gltf, .ply, .obj, .stl; clouds: .ply, .pcd, .las, .laz, .e57.
        """
        import_module(_WRITERS).exchange.save(self.record(), path)

    def to_trimesh(self) -> Any:
        """Return a `trimesh.Trimesh` or `trimesh.PointCloud` in the world frame."""
        return import_module(_WRITERS).exchange.to_trimesh(self.record())

    def to_open3d(self) -> Any:
        """Return an Open3D `TriangleMesh` or `PointCloud` in the world frame."""
        return import_module(_WRITERS).exchange.to_open3d(self.record())
