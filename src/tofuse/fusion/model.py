"""The model: what is kept of each view until poses are final, and what is made of it then."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from tofuse.fusion.cloud import Cloud, CloudBuilder, as_cloud, choose_voxel
from tofuse.fusion.mesh import Mesh
from tofuse.fusion.options import Fusion
from tofuse.fusion.tsdf import fitting_voxel, fuse_surface
from tofuse.fusion.views import RangeView, without_camera_errors
from tofuse.maps.surface_map import SurfaceMap
from tofuse.posegraph.refinement import without_errors
from tofuse.recordings.frames import CloudFrame, Frame, RangeFrame

Float64 = NDArray[np.float64]

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
    """Keeps views, small and of bounded size, and fuses them at the poses they get in the end."""

    def __init__(self, options: Fusion) -> None:
        self._options = options
        self._ranges: list[RangeView] = []
        self._clouds: list[CloudFrame] = []
        self._step = 1  # every so-many-th range image is kept
        self._count = 0
        self._bytes = 0
        self._voxel_m = 0.01  # of clouds

    def add(self, frame: Frame, surface: SurfaceMap | None, most_points: int) -> None:
        """Keep a (filtered) view.

        Parameters
        ----------
        surface
            The same image made ready for tracking, where that has been done.
        most_points
            So many points are kept of a cloud.
        """
        if isinstance(frame, CloudFrame):
            if not self._clouds:
                self._voxel_m = self._options.voxel_m or choose_voxel(frame)
            self._clouds.append(as_cloud(frame, most_points))
            return
        if self._count % self._step == 0:
            self._keep(frame, surface)
        self._count += 1

    def _keep(self, frame: RangeFrame, surface: SurfaceMap | None) -> None:
        view = RangeView.of(frame, surface)
        self._ranges.append(view)
        self._bytes += view.nbytes
        while self._bytes > self._options.memory_mb * 500_000 and len(self._ranges) > 1:
            self._ranges = self._ranges[::2]
            self._step *= 2
            self._bytes = sum(kept.nbytes for kept in self._ranges)

    @property
    def views(self) -> int:
        """How many views are kept."""
        return len(self._ranges) + len(self._clouds)

    @property
    def nbytes(self) -> int:
        """Bytes that the images of these views take."""
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
        if self._clouds or not self._ranges:
            clouds = [
                replace(c, points=without_errors(c.points, errors)) if errors else c
                for c in self._clouds
                if c.index in poses
            ]
            return Model(self._average(clouds, poses, self._voxel_m, advance), None)
        ranges = [view for view in self._ranges if view.index in poses]
        views = without_camera_errors(ranges, errors)
        at = np.array([poses[view.index] for view in views], float)
        mesh = fuse_surface(views, at, self._options, advance)
        if len(mesh):
            return Model(mesh.cloud(), self._finished(mesh))
        clouds = [view.as_cloud() for view in views]
        return Model(self._average(clouds, poses, self._range_voxel), mesh)

    def _finished(self, mesh: Mesh) -> Mesh:
        """The surface without its small holes, and with as many triangles as asked for."""
        if self._options.holes_m:
            mesh = mesh.without_holes(self._options.holes_m)
        return mesh.decimated(self._options.faces) if self._options.faces else mesh

    def sketch(self, poses: Mapping[int, Float64]) -> Cloud:
        """Return points of the model at other poses, to be looked at: without normals for images.

        Of many images some are taken, evenly, and of each some pixels.
        """
        if self._clouds:
            clouds = [c for c in self._clouds if c.index in poses]
            return self._average(clouds, poses, self._voxel_m)
        ranges = [view for view in self._ranges if view.index in poses]
        some = ranges[:: max(1, -(-len(ranges) // _SKETCHED))]
        voxel = self._range_voxel
        sketched = [view.as_cloud(_SKETCHED_PIXELS) for view in some]
        return self._average(sketched, poses, voxel, normals=False)

    @property
    def _range_voxel(self) -> float:
        return self._options.voxel_m or fitting_voxel(self._ranges)

    def _average(
        self,
        views: list[CloudFrame],
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
