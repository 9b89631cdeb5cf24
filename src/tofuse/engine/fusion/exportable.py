"""Conversions that meshes and clouds offer, for convenience, by the writers of file formats."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from tofuse.engine.fusion.geometry_record import GeometryRecord

# Imported by name on use: nothing else of the engine knows a file format.
_WRITERS = "tofuse.formats.export"


class Exportable:
    """Geometry that can be saved, and converted to the types of other packages."""

    def record(self) -> GeometryRecord:
        """Return points, faces and columns in the world frame, float64."""
        raise NotImplementedError

    def save(self, path: str | Path) -> None:
        """Write a file in the format of its suffix.

        Meshes: .glb, .gltf, .ply, .obj, .stl; clouds: .ply, .pcd, .las, .laz, .e57.
        """
        import_module(_WRITERS).save(self.record(), path)

    def to_trimesh(self) -> Any:
        """Return a `trimesh.Trimesh` or `trimesh.PointCloud` in the world frame."""
        return import_module(_WRITERS).to_trimesh(self.record())

    def to_open3d(self) -> Any:
        """Return an Open3D `TriangleMesh` or `PointCloud` in the world frame."""
        return import_module(_WRITERS).to_open3d(self.record())
