"""What people register, as views: frames, results, meshes, clouds, arrays, and files of these."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from tofuse.apps.results import folders, read_cloud
from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.clouds import MIN_POINTS, scaled
from tofuse.engine.errors import InputError
from tofuse.engine.frames import CloudFrame, Frame, RangeFrame
from tofuse.engine.fusion import Mesh
from tofuse.engine.geometry import se3
from tofuse.engine.results import Reconstruction
from tofuse.formats.geometry import surface_points
from tofuse.formats.recordings import ReadingOptions, SingleView, open_view


@runtime_checkable
class HasPoints(Protocol):
    """A `Cloud`, or one of another package, such as Open3D."""

    @property
    def points(self) -> ArrayLike:
        """(N, 3) m."""


View: TypeAlias = Frame | Reconstruction | Mesh | HasPoints | ArrayLike | str | os.PathLike[str]


def view_of(view: View, name: str, factor: float | None = None) -> Frame:
    """Return what has points as a view.

    Parameters
    ----------
    view
        See `register`.
    name
        Of the argument, for errors.
    factor
        Of its unit in that of the result.

    Raises
    ------
    InputError
        If it has fewer than ten finite points, or is nothing of that kind.
    """
    if isinstance(view, str | os.PathLike):
        return named_view(os.fspath(view), ReadingOptions(factor=factor)).frame
    if isinstance(view, RangeFrame | CloudFrame):
        return at_factor(view, factor)
    points: ArrayLike
    if isinstance(view, Reconstruction):
        points = view.cloud.points + view.shift
    elif isinstance(view, Mesh):
        points = surface_points(view.record(), name)
    else:
        points = view.points if isinstance(view, HasPoints) else view
    return at_factor(CloudFrame.of(_checked(points, name)), factor)


def at_factor(view: Frame, factor: float | None) -> Frame:
    """Return a view in another unit: its points times a factor; itself for None."""
    return view if factor is None else scaled(view, factor)


def named_view(name: str, options: ReadingOptions | None = None) -> SingleView:
    """Read the view called `name`: the cloud of a result, or see `open_view`."""
    options = options or ReadingOptions()
    folder = Path(name)
    if options.format is None and folders.named_result(folder):
        frame = CloudFrame.of(_checked(read_cloud(folder).points, name))
        return SingleView(name, name, "result", 0, at_factor(frame, options.factor))
    return open_view(name, options, file_axes=True)


def _checked(points: ArrayLike, name: str) -> Float64:
    """Return the finite points of an array (n, 3)."""
    try:
        if isinstance(points, np.ma.MaskedArray) and points.ndim == 2:
            points = points.data[~np.ma.getmaskarray(points).any(1)]
        array = np.asarray(points)
    except ValueError as error:
        raise InputError("is not an array", where=name, remedy="pass (N, 3) numbers") from error
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        kind = f" of shape {array.shape} and type {array.dtype}" if array.ndim else ""
        raise InputError(
            f"is {quantities.one(type(points).__name__)}{kind}",
            where=name,
            remedy="pass a frame (recording[0]), a result, a mesh, (N, 3) numbers in metres, or "
            "the path of one of these",
        )
    finite = array[np.isfinite(array).all(1)].astype(np.float64)
    if len(finite) < MIN_POINTS:
        raise InputError(
            f"has {len(finite)} finite points", where=name, remedy=f"use {MIN_POINTS} or more"
        )
    if np.abs(finite).max() > se3.MAX_COORDINATE_M:
        raise InputError(
            f"has coordinates up to {np.abs(finite).max():.0e} m", where=name, remedy="use metres"
        )
    return finite
