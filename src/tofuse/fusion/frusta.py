"""Which views can say anything of a box of space at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Bool, Float32, Float64
from tofuse.fusion.kept import Views
from tofuse.geometry import se3
from tofuse.kernels.threads import run_chunks
from tofuse.kernels.tsdf import max_informative_depth

_CHUNKS = 16
_ROUNDING = 1.001  # of single precision, with plenty to spare


@dataclass(frozen=True, eq=False)
class Frusta:
    """The pyramids of space that views speak of, cut off where nothing is told any more.

    Attributes
    ----------
    T_camera_world
        (N, 4, 4).
    spans
        (N, 4) least x/z and y/z, and largest.
    far
        (N,) z up to which a view tells something, m; 0 for views that tell nothing.
    """

    T_camera_world: Float64
    spans: Float64
    far: Float64

    @classmethod
    def of(cls, views: Views, poses: Float64, backs: Float32) -> Frusta:
        """Look at views at their poses (N, 4, 4); `backs` as for `max_informative_depth`."""
        spans, far = np.empty((len(views), 4)), np.empty(len(views))

        def look(a: int, b: int) -> None:
            for k in range(a, b):
                view = views[k]
                projection = view.projection
                low, size = projection.frame[:2], np.array(projection.lookup.shape[1::-1]) - 1
                spans[k] = [*low, *(low + size / projection.frame[2:])]
                far[k] = max_informative_depth(
                    view.z, view.unit, view.normals, view.strength, projection.rays, backs
                )

        run_chunks(look, len(views), _CHUNKS)
        T = np.array([se3.inverse(pose) for pose in poses]).reshape(-1, 4, 4)
        return cls(T, spans, _ROUNDING * far)

    def touching(self, low: Float64, high: Float64) -> Bool:
        """Which views (N,) may say something of the box from `low` to `high` (3,), m.

        Some that do not are among them; none that does is missing.
        """
        R, t = self.T_camera_world[:, :3, :3], self.T_camera_world[:, :3, 3]
        middle, half = R @ (0.5 * (low + high)) + t, 0.5 * (high - low)
        ahead = middle[:, 2] - np.abs(R[:, 2]) @ half
        out = (self.far > 0) & (ahead <= self.far)
        one = np.ones(len(out))
        for axis in range(2):
            for side, sign in ((0, -1.0), (2, 1.0)):
                # Outside of a side plane is where n . p > 0.
                n = np.zeros((len(out), 3))
                n[:, axis], n[:, 2] = sign * one, -sign * self.spans[:, side + axis]
                reach = np.abs(np.einsum("ni,nij->nj", n, R)) @ half
                out &= np.einsum("ni,ni->n", n, middle) <= reach
        # Nothing is seen from behind.
        return out & (middle[:, 2] + np.abs(R[:, 2]) @ half > 0)
