"""The model: stored views, fused once poses are final."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.compute import Spill
from tofuse.engine.errors import InputError
from tofuse.engine.frames import CloudFrame, Frame
from tofuse.engine.fusion.cloud import Cloud, CloudBuilder, as_cloud, choose_voxel
from tofuse.engine.fusion.mesh import Mesh
from tofuse.engine.fusion.options import Fusion
from tofuse.engine.fusion.range_view import CameraCorrection, RangeView, StoredViews
from tofuse.engine.fusion.tsdf import fitting_voxel, fuse_surface
from tofuse.engine.refinement import fixed_pattern, without_errors
from tofuse.engine.stopwatch import timing
from tofuse.engine.views import PreparedView

_SKETCH_VIEWS, _SKETCH_PIXELS = 60, 6000  # views in a sketch, and approximate pixels of each


@dataclass(frozen=True, eq=False)
class Model:
    """The model of a run.

    Attributes
    ----------
    cloud
        For range images the vertices of the surface, or without a surface the means of voxels; for
        clouds the means of voxels.
    mesh
        None for clouds: without a camera free space is unknown.
    """

    cloud: Cloud
    mesh: Mesh | None


class ModelBuilder:
    """Stores reduced views, and fuses them at their final poses.

    Parameters
    ----------
    options
        How views are fused.
    spill
        The store of views; by default a tenth of the memory for voxels, the others on disk.
    surface
        Whether range images make a surface; otherwise the model is a sketch.
    """

    def __init__(
        self, options: Fusion, spill: Spill[Any] | None = None, *, surface: bool = True
    ) -> None:
        self._options, self.surface = options, surface
        if spill is None:
            spill = Spill(options.memory_mb * 1_000_000 // 10)
        self._ranges = StoredViews(spill)
        self._spill = spill
        self._clouds: list[tuple[int, int]] = []  # of the frame, and in the store
        self._voxel_m = 0.01  # of clouds

    def add(self, frame: Frame, surface: PreparedView | None, max_points: int) -> None:
        """Store a (filtered) view.

        Parameters
        ----------
        frame
            The filtered view.
        surface
            The same image prepared for tracking, if it was.
        max_points
            Maximum number of points of a cloud.
        """
        if isinstance(frame, CloudFrame):
            if not self._clouds:
                self._voxel_m = self._options.voxel_m or choose_voxel(frame)
            self._clouds.append((frame.index, self._spill.put(as_cloud(frame, max_points))))
            return
        self._ranges.add(RangeView.of(frame, surface))

    @property
    def views(self) -> int:
        """Number of stored views."""
        return len(self._ranges) + len(self._clouds)

    def fuse(
        self,
        poses: Mapping[int, Float64],
        advance: Callable[[], None] | None = None,
        errors: Mapping[str, float] = MappingProxyType({}),
        pattern: fixed_pattern.FixedPattern = fixed_pattern.NONE,
    ) -> Model:
        """Make the model.

        Parameters
        ----------
        poses
            T_world_camera (4, 4) by frame index; views of other frames are left out.
        advance
            Called after each view.
        errors, pattern
            Errors of the camera to correct; see `Refinement`.
        """
        if not self.surface:
            return Model(self.sketch(poses), None)
        if len(self._clouds) or not len(self._ranges):
            clouds = (
                replace(c, points=without_errors(c.points, errors)) if errors else c
                for c in self._clouds_of(poses)
            )
            return Model(self._average(clouds, poses, self._voxel_m, advance), None)
        views = self._ranges.of(poses)
        correction = CameraCorrection(errors, pattern)
        if correction:
            views = views.corrected(correction)
        T_world_camera = np.array([poses[summary.index] for summary in views.summaries], float)
        mesh = fuse_surface(views, T_world_camera, self._options, advance)
        if len(mesh):
            with timing("meshing"):
                return Model(mesh.cloud(), at_most(mesh, self._options.faces))
        clouds = (view.as_cloud() for view in views)
        return Model(self._average(clouds, poses, self._range_voxel), mesh)

    def sketch(self, poses: Mapping[int, Float64]) -> Cloud:
        """Return a cloud at other poses for display, without normals for images.

        It consists of evenly spaced images, and of evenly spaced pixels of each.
        """
        if len(self._clouds):
            return self._average(self._clouds_of(poses), poses, self._voxel_m)
        ranges = self._ranges.of(poses)
        sampled = range(0, len(ranges), max(1, -(-len(ranges) // _SKETCH_VIEWS)))
        voxel = self._range_voxel
        clouds = (ranges[k].as_cloud(_SKETCH_PIXELS) for k in sampled)
        return self._average(clouds, poses, voxel, normals=False)

    def _clouds_of(self, frames: Container[int]) -> Iterator[CloudFrame]:
        return (self._spill.get(number) for index, number in self._clouds if index in frames)

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


def at_most(mesh: Mesh, faces: int) -> Mesh:
    """Return the mesh of at most so many triangles (0: all), or more where these leave nothing."""
    while 0 < faces < len(mesh.faces):
        with suppress(InputError):
            return mesh.decimated(faces)
        faces *= 2
    return mesh
