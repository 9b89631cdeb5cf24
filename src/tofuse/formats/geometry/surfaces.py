"""Meshes of any program as points, spread evenly over their surface."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.fusion import GeometryRecord
from tofuse.engine.geometry import se3, triangles
from tofuse.formats.files import reading
from tofuse.formats.geometry.ply import read_ply

# Formats of meshes that are read by trimesh. A PLY file may be a cloud as well.
_SUFFIXES = (".obj", ".stl", ".glb", ".gltf", ".off")
_PLY_FACES = re.compile(rb"^element (face|tristrips) +[1-9]", re.MULTILINE)
_PLY_HEADER = 4096  # bytes in which these are declared
_POINTS = 100_000


def is_surface(path: Path) -> bool:
    """Whether a file is of a mesh: by its suffix, and a PLY file if it has faces."""
    if not path.is_file():
        return False
    if path.suffix.lower() != ".ply":
        return path.suffix.lower() in _SUFFIXES
    with path.open("rb") as file:
        return _PLY_FACES.search(file.read(_PLY_HEADER).split(b"end_header")[0]) is not None


def read_surface(path: Path) -> GeometryRecord:
    """Read the triangles of a file, or the points of one without any, in its coordinates.

    Raises
    ------
    InputError
        If it is damaged, or trimesh is needed and missing.
    """
    if path.suffix.lower() == ".ply":
        return read_ply(path)
    trimesh = reading.required_package("trimesh", None, path)
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
        if len(mesh.faces):
            return GeometryRecord(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32))
        return GeometryRecord(_vertices(trimesh.load(path, force="scene", process=False)))
    except Exception as error:  # trimesh has no exception of its own
        raise InputError(f"is no readable mesh ({error})", where=path) from error


def _vertices(scene: Any) -> Float64:
    """The vertices (N, 3) of all parts of a scene of trimesh, which a cloud has without faces."""
    parts = [np.zeros((0, 3))]
    for node in scene.graph.nodes_geometry:
        T, name = scene.graph[node]
        parts.append(se3.transform(T, np.asarray(scene.geometry[name].vertices, np.float64)))
    return np.concatenate(parts)


def surface_points(mesh: GeometryRecord, where: str | Path, count: int = _POINTS) -> Float64:
    """Return points (count, 3) of a mesh, spread evenly over the area of its faces, m.

    Each face gets its share of the points to within one, at random places. If the mesh has no
    faces, its vertices.

    Raises
    ------
    InputError
        If the faces have no area, or don't fit the vertices; it names `where`.
    """
    points = mesh.points.astype(np.float64)
    if mesh.faces is None or not len(mesh.faces):
        return points
    mesh.check(where)
    corners = points[mesh.faces]
    total = np.cumsum(np.nan_to_num(triangles.areas(corners), posinf=0.0))
    if not total[-1] > 0:
        raise InputError("has faces without area", where=where, remedy="use a mesh of a surface")
    face = np.searchsorted(total, (np.arange(count) + 0.5) / count * total[-1])
    return triangles.points_in(corners[face], np.random.default_rng(0))
