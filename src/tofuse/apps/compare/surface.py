"""What is compared, as points with normals and errors: results, meshes, clouds and their files."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from tofuse.apps.pairs import named_view
from tofuse.apps.results import folders, load_result
from tofuse.engine import quantities
from tofuse.engine.arrays import Bool, Float64, Int32
from tofuse.engine.errors import InputError
from tofuse.engine.frames import CloudFrame
from tofuse.engine.fusion import Cloud, GeometryRecord, Mesh
from tofuse.engine.geometry import KdTree, triangles, unit_vectors
from tofuse.engine.icp import extent, surface_shape
from tofuse.engine.normal import OF_95_PERCENT
from tofuse.engine.results import Reconstruction
from tofuse.formats.files import reading
from tofuse.formats.geometry import is_surface, read_surface

UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
# Files in mm and models in m differ by 1000 in extent; a part and the room around it by less.
_MIN_MM_RATIO = 30.0
_MIN_POINTS = 50
# Views that confirm a surface.
_CONFIRMED = 2
# Points at which the density is measured, and neighbours that it is measured by.
_DENSITY_POINTS, _DENSITY_NEIGHBOURS = 3000, 12
Comparable: TypeAlias = Reconstruction | Mesh | Cloud | Float64 | str | os.PathLike[str]


@dataclass(frozen=True, eq=False)
class Surface:
    """A surface, measured or nominal.

    Attributes
    ----------
    name
        For display.
    points, normals
        (N, 3) m, and unit normals; zeros where unknown.
    faces
        (M, 3) indices of the points, counter-clockwise from outside; None for a cloud.
    oriented
        Whether the sides of the normals are known.
    sigma
        (N,) standard deviations, m; None where not known.
    shared_m
        Standard deviation along the normal of errors that neighbouring points share, m: inf if they
        are not bounded, None if nothing is known of them.
    is_result
        Whether it is a result, whose unit is known.
    unit
        Unit of its file.
    eyes
        (E, 3) m, where the cameras were; none where not known.
    R_shown
        (3, 3), to axes with y down, in which a result is shown upright.
    left_out
        Fraction of a fused surface that is left out, as only one view saw it.
    """

    name: str
    points: Float64
    normals: Float64
    faces: Int32 | None = None
    oriented: bool = True
    sigma: Float64 | None = None
    shared_m: float | None = None
    is_result: bool = False
    unit: str = "m"
    eyes: Float64 = field(default_factory=lambda: np.zeros((0, 3)))
    R_shown: Float64 = field(default_factory=lambda: np.eye(3))
    left_out: float = 0.0

    @property
    def extent(self) -> float:
        """Diagonal of the middle 90 % of the points, m."""
        return extent(self.points)

    def in_unit(self, unit: str) -> Surface:
        """Return a surface whose file is in this unit."""
        sigma = None if self.sigma is None else self.sigma * UNITS_M[unit]
        return replace(self, points=self.points * UNITS_M[unit], sigma=sigma, unit=unit)


def surface_of(given: Comparable, name: str = "") -> Surface:
    """Return a result, mesh, cloud, or the file of one, as a surface.

    Raises
    ------
    InputError
        If it can't be read, or has no surface.
    """
    if isinstance(given, Reconstruction):
        return _of_result(given, name or "result")
    if isinstance(given, Mesh | Cloud):
        return _of_model(given, name or type(given).__name__.lower())
    if isinstance(given, np.ndarray):
        CloudFrame.of(given)  # checks them
        return _of_record(GeometryRecord(given), name or "points")
    remedy = "pass a result, a mesh, a cloud, (N, 3) points, or the path of one"
    path = reading.path_of(given, name or "surface", remedy)
    if folders.named_result(path):
        return _of_result(load_result(path), str(path))
    if is_surface(path):
        return _of_record(read_surface(path), str(path))
    view = named_view(os.fspath(given))
    frame = view.frame
    if not isinstance(frame, CloudFrame):
        raise InputError("is an image", where=view.name, remedy="pass a result of it: `tofuse run`")
    points = frame.points.astype(np.float64) + frame.shift
    return _of_record(GeometryRecord(points, normals=frame.normals), str(path))


def _of_result(result: Reconstruction, name: str) -> Surface:
    model = result.cloud if result.mesh is None or not len(result.mesh) else result.mesh
    surface = _of_model(model, name, result.shift)
    eyes = result.trajectory[result.has_pose, :3, 3] + result.shift
    R_shown = np.diag([1.0, -1.0, -1.0]) @ result.T_up_world[:3, :3]
    return replace(
        surface, shared_m=_shared_sigma(result), is_result=True, eyes=eyes, R_shown=R_shown
    )


def _of_model(model: Mesh | Cloud, name: str, shift: Float64 | None = None) -> Surface:
    """Return a model as a surface, without that which only one of its views saw.

    What is wrong in one view, such as depth that a phone guesses, or all of a bad frame, is in no
    sigma, and no other view averages it out. Unless most of the model is seen once: then there is
    nothing better.
    """
    left_out, record = 0.0, model.record()
    record.check(name)
    if isinstance(model, Mesh) and len(model.faces) and np.median(model.views) >= _CONFIRMED:
        confirmed: Bool = np.all((model.views >= _CONFIRMED)[model.faces], axis=1)
        left_out = float(1 - confirmed.mean())
        record = model.rows(confirmed).record()
    if shift is not None:
        record = record.shifted(shift)
    return replace(_of_record(record, name), left_out=left_out)


def _shared_sigma(result: Reconstruction) -> float:
    """Return the standard deviation along one axis of what the poses do to the surface, m.

    The bounds are on the rms length of errors in three dimensions; rotations act at the depth.
    """
    bounds = result.diagnostics.accuracy
    depths = [f.mean_depth_m for f in result.diagnostics.frames if f.mean_depth_m]
    if len(result.trajectory) == 1:
        return 0.0
    lever = float(np.median(depths)) if depths else 0.0
    length = float(np.hypot(bounds.position_m, bounds.rotation_rad * lever))
    return length / OF_95_PERCENT / 3**0.5


def _of_record(record: GeometryRecord, name: str) -> Surface:
    points = record.points.astype(np.float64)
    faces = record.faces if record.faces is not None and len(record.faces) else None
    sigma = record.scalars.get("sigma")
    normals: Float64 | None
    if faces is not None:
        record.check(name)
        if not np.isfinite(points).all():
            raise InputError("has vertices that are not finite", where=name)
        normals = vertex_normals(points, faces)
    else:
        finite = np.isfinite(points).all(1)
        points = points[finite]
        sigma = None if sigma is None else sigma[finite]
        normals = None if record.normals is None else record.normals[finite].astype(float)
    if sigma is not None and not sigma.any():
        sigma = None
    if len(points) < (_MIN_POINTS if faces is None else 3):
        raise InputError(
            f"has {quantities.count(len(points), 'point')} and no triangles",
            where=name,
            remedy=f"use a mesh, or {_MIN_POINTS} points or more",
        )
    if not np.ptp(points, axis=0).any():
        raise InputError("has points at one place only", where=name)
    oriented = normals is not None
    if normals is None:
        view = CloudFrame.of(points)
        normals = np.nan_to_num(surface_shape.normals_at(view, np.arange(len(points))))
    return Surface(
        name, points, normals, faces, oriented, None if sigma is None else sigma.astype(np.float64)
    )


def vertex_normals(points: Float64, faces: Int32) -> Float64:
    """Return the normals (N, 3) of vertices, weighted by the area of their faces."""
    area = triangles.crosses(points[faces])
    normals = np.stack(
        [
            np.bincount(faces.ravel(), np.repeat(area[:, k], 3), minlength=len(points))
            for k in range(3)
        ],
        axis=1,
    )
    return unit_vectors(normals.astype(np.float64))


def in_metres(
    measured: Surface, reference: Surface, unit: str | None = None
) -> tuple[Surface, Surface, str]:
    """Return both surfaces in m, and a sentence if a unit was recognised.

    A file whose extent is much larger than that of the other surface is in mm.

    Parameters
    ----------
    measured, reference
        As they are stored.
    unit
        Of the reference's file; recognised unless given.
    """
    said = ""
    if unit is not None:
        reference = reference.in_unit(unit)
    ratio = reference.extent / max(measured.extent, 1e-12)
    if unit is None and ratio > _MIN_MM_RATIO and not reference.is_result:
        reference = reference.in_unit("mm")
        said = f"{reference.name} is taken to be in mm: it would be {ratio:.0f} times as large"
    if ratio < 1 / _MIN_MM_RATIO and not measured.is_result:
        measured = measured.in_unit("mm")
        said = f"{measured.name} is taken to be in mm: it would be {1 / ratio:.0f} times as large"
    return measured, reference, said


def spacing_of(points: Float64) -> float:
    """Return the edge of the square of surface that each of some points (N, 3) has, m."""
    sampled = points[:: max(1, len(points) // _DENSITY_POINTS)]
    k = min(_DENSITY_NEIGHBOURS, len(points) - 1)
    if k < 1:
        return 1e-6
    radius2 = np.median(KdTree(points).neighbours(sampled, k + 1)[1][:, k])
    return max(float(np.sqrt(np.pi * radius2 / k)), 1e-6)
