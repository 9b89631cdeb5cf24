"""View frusta: which views can affect a box of space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64
from tofuse.engine.compute import run_chunks
from tofuse.engine.fusion.stored_views import Views
from tofuse.engine.fusion.tsdf_kernels import max_informative_depth
from tofuse.engine.geometry import se3

_CHUNKS = 16
_ROUNDING = 1.001  # margin for single precision


@dataclass(frozen=True, eq=False)
class Frusta:
    """The pyramids of space that views affect, up to the truncation behind their surfaces.

    Attributes
    ----------
    T_camera_world
        (N, 4, 4).
    spans
        (N, 4) minimum x/z and y/z, and maximum.
    far
        (N,) maximum z that a view affects, m; 0 for empty views.
    """

    T_camera_world: Float64
    spans: Float64
    far: Float64

    @classmethod
    def of(cls, views: Views, poses: Float64, free_space_limits: Float32) -> Frusta:
        """Return frusta of views at poses (N, 4, 4); limits as for `max_informative_depth`."""
        spans, far = np.empty((len(views), 4)), np.empty(len(views))

        def measure(a: int, b: int) -> None:
            for k in range(a, b):
                view = views[k]
                projection = view.projection
                low, size = projection.frame[:2], np.array(projection.lookup.shape[1::-1]) - 1
                spans[k] = [*low, *(low + size / projection.frame[2:])]
                far[k] = max_informative_depth(view.stored, free_space_limits)

        run_chunks(measure, len(views), _CHUNKS)
        T = np.array([se3.inverse(pose) for pose in poses]).reshape(-1, 4, 4)
        return cls(T, spans, _ROUNDING * far)

    def touching(self, low: Float64, high: Float64) -> Bool:
        """Return which views (N,) may affect the box from `low` to `high` (3,), m.

        The test is conservative: no such view is missed.
        """
        R, t = self.T_camera_world[:, :3, :3], self.T_camera_world[:, :3, 3]
        centre, half_size = R @ (0.5 * (low + high)) + t, 0.5 * (high - low)
        min_z = centre[:, 2] - np.abs(R[:, 2]) @ half_size
        touching = (self.far > 0) & (min_z <= self.far)
        ones = np.ones(len(touching))
        for axis in range(2):
            for side, sign in ((0, -1.0), (2, 1.0)):
                # Points outside of a side plane have n . p > 0.
                n = np.zeros((len(touching), 3))
                n[:, axis], n[:, 2] = sign * ones, -sign * self.spans[:, side + axis]
                radius = np.abs(np.einsum("ni,nij->nj", n, R)) @ half_size
                touching &= np.einsum("ni,ni->n", n, centre) <= radius
        # Nothing behind the camera is visible.
        return touching & (centre[:, 2] + np.abs(R[:, 2]) @ half_size > 0)
