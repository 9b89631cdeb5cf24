"""The model: what is kept of each view until poses are final, and what is made of it then."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from tofuse.arrays import Float64
from tofuse.files.spill import Spill
from tofuse.fusion.cloud import Cloud, CloudBuilder, as_cloud, choose_voxel
from tofuse.fusion.kept import KeptClouds, KeptViews
from tofuse.fusion.mesh import Mesh
from tofuse.fusion.options import Fusion
from tofuse.fusion.tsdf import fitting_voxel, fuse_surface
from tofuse.fusion.views import RangeView
from tofuse.posegraph.refinement import without_errors
from tofuse.recordings.frames import CloudFrame, Frame
from tofuse.registration.prepared_view import PreparedView

_SKETCHED, _SKETCHED_PIXELS = 60, 6000  # views in a sketch, and about so many pixels of each


@dataclass(frozen=True, eq=False)
class Model:
    """What a run makes of its views.

    Attributes
    ----------
    cloud
        Of range images the vertices of the surface, or if there is none, the means of voxels;
        of clouds the means of voxels.
    mesh
        None for clouds: without a camera nothing is known of the space in front of a point.
    """

    cloud: Cloud
    mesh: Mesh | None


class ModelBuilder:
    """Keeps views, small, and fuses them at the poses they get in the end.

    Parameters
    ----------
    options
        How.
    spill
        Where views are kept; unless given, half as many bytes of them as there may be of voxels
        stay in memory.
    """

    def __init__(self, options: Fusion, spill: Spill[Any] | None = None) -> None:
        self._options = options
        if spill is None:
            spill = Spill(options.memory_mb * 500_000)
        self._ranges = KeptViews(spill)
        self._clouds = KeptClouds(spill)
        self._bytes = 0
        self._voxel_m = 0.01  # of clouds

    def add(self, frame: Frame, surface: PreparedView | None, most_points: int) -> None:
        """Keep a (filtered) view.

        Parameters
        ----------
        surface
            The same image made ready for tracking, where that has been done.
        most_points
            So many points are kept of a cloud.
        """
        if isinstance(frame, CloudFrame):
            if not len(self._clouds):
                self._voxel_m = self._options.voxel_m or choose_voxel(frame)
            self._clouds.add(as_cloud(frame, most_points))
            return
        view = RangeView.of(frame, surface)
        self._ranges.add(view)
        self._bytes += view.nbytes

    @property
    def views(self) -> int:
        """How many views are kept."""
        return len(self._ranges) + len(self._clouds)

    @property
    def nbytes(self) -> int:
        """Bytes that the images of these views take, in memory or on disk."""
        return self._bytes

    def fuse(
        self,
        poses: Mapping[int, Float64],
        advance: Callable[[], None] | None = None,
        errors: Mapping[str, float] = MappingProxyType({}),
    ) -> Model:
        """Make the model.

        Parameters
        ----------
        poses
            T_world_camera (4, 4) by index of the frame; views of other frames are left out.
        advance
            Called after each view.
        errors
            Of the camera, which are taken out; see `Refinement.errors`.
        """
        if len(self._clouds) or not len(self._ranges):
            clouds = (
                replace(c, points=without_errors(c.points, errors)) if errors else c
                for c in self._clouds.of(poses)
            )
            return Model(self._average(clouds, poses, self._voxel_m, advance), None)
        views = self._ranges.of(poses)
        wrong = any(errors.values())
        if wrong:
            views = views.corrected(errors)
        at = np.array([poses[each.index] for each in views.about], float)
        mesh = fuse_surface(views, at, self._options, advance)
        if len(mesh):
            model = Model(mesh.cloud(), self._finished(mesh))
        else:
            clouds = (view.as_cloud() for view in views)
            model = Model(self._average(clouds, poses, self._range_voxel), mesh)
        if wrong:
            views.forget()
        return model

    def _finished(self, mesh: Mesh) -> Mesh:
        """The surface without its small holes, and with as many triangles as asked for."""
        if self._options.holes_m:
            mesh = mesh.without_holes(self._options.holes_m)
        return mesh.decimated(self._options.faces) if self._options.faces else mesh

    def sketch(self, poses: Mapping[int, Float64]) -> Cloud:
        """Return points of the model at other poses, to be looked at: without normals for images.

        Of many images some are taken, evenly, and of each some pixels.
        """
        if len(self._clouds):
            return self._average(self._clouds.of(poses), poses, self._voxel_m)
        ranges = self._ranges.of(poses)
        some = range(0, len(ranges), max(1, -(-len(ranges) // _SKETCHED)))
        voxel = self._range_voxel
        sketched = (ranges[k].as_cloud(_SKETCHED_PIXELS) for k in some)
        return self._average(sketched, poses, voxel, normals=False)

    @property
    def _range_voxel(self) -> float:
        return self._options.voxel_m or fitting_voxel(self._ranges)

    def _average(
        self,
        views: Iterable[CloudFrame],
        poses: Mapping[int, Float64],
        voxel_m: float,
        advance: Callable[[], None] | None = None,
        *,
        normals: bool = True,
    ) -> Cloud:
        builder = CloudBuilder(self._options, voxel_m)
        for view in views:
            builder.add(view, poses[view.index])
            if advance is not None:
                advance()
        return builder.finish(normals=normals)
