"""Poses at which the colours of images agree on the surface (Zhou and Koltun 2014, rigid part)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64, Int16, Intp, UInt8
from tofuse.engine.compute import run_all
from tofuse.engine.geometry import se3
from tofuse.engine.views import Projection

# Points on the surface, and those that a view must share with others.
_MAX_POINTS, _MIN_POINTS = 20_000, 50
_MAX_SIDE = 480  # pixels of the compared images
# Blur of the images in pixels, and iterations at each; the width of the neighbourhood in which
# contrast is equalised, in blurs; and the contrast of noise, in grey levels.
_BLURS, _ITERATIONS, _NEIGHBOURHOOD, _NOISE = (3.0, 1.0), 5, 8, 3.0
_UNIT = 1000.0  # of contrast in whole numbers
_ROBUST_LIMIT = 1.0  # of differences between images of unit contrast
# Expected corrections in m and radians: of poses that were estimated from depth. Those of more
# than `_MAX_SIGMAS` are not made.
_SIGMA, _MAX_SIGMAS = np.repeat([0.01, 0.01], 3), 4.0


class Shown(NamedTuple):
    """What a view shows of a surface.

    Attributes
    ----------
    image
        (h, w, 3) uint8 RGB.
    projection
        Projection of points into the depth image of the same field of view.
    visible
        (N,) whether it shows each point.
    pixels
        (N, 2) column and row of the visible points in the depth image.
    """

    image: UInt8
    projection: Projection
    visible: Bool
    pixels: Float32


def aligned_poses(points: Float32, poses: Float64, shown: Sequence[Shown]) -> Float64:
    """Correct the poses of views so that their images agree on a surface.

    Each image is aligned with the mean of the others at the points of the surface, from coarse to
    fine, in contrast relative to that around a pixel, so that neither exposure nor shadows
    matter. A correction is made only if the image then agrees better at points that were left out.

    Parameters
    ----------
    points
        (N, 3) of the surface, in the world.
    poses
        (V, 4, 4) T_world_camera.
    shown
        What each of the views shows.
    """
    chosen = np.arange(0, len(points), -(-len(points) // _MAX_POINTS))
    views = run_all(
        [
            partial(_View.of, points, T, view, chosen)
            for T, view in zip(se3.inverse(poses), shown, strict=True)
        ]
    )
    tested = np.arange(len(chosen)) % 4 == 3
    xi = np.zeros((len(views), 6))
    signals: list[Int16] = []
    for blur in _BLURS:
        signals.clear()  # before there are others: they take 1 MB a view
        signals += run_all([partial(view.signal, blur) for view in views])
        for _ in range(_ITERATIONS):
            for k, (row, error, slope) in enumerate(_differences(views, signals, xi, ~tested)):
                if len(row) >= _MIN_POINTS:
                    xi[k] += _step(error, slope, xi[k])
    before, after = (
        np.array([np.abs(e).mean() if len(e) >= _MIN_POINTS else 0.0 for _, e, _ in differences])
        for differences in (
            _differences(views, signals, np.zeros_like(xi), tested),
            _differences(views, signals, xi, tested),
        )
    )
    better = (after < before) & (np.abs(xi / _SIGMA) < _MAX_SIGMAS).all(1)
    return np.asarray(poses @ se3.exp(np.where(better[:, None], xi, 0)))


@dataclass(frozen=True, eq=False)
class _View:
    """A view of the chosen points.

    Attributes
    ----------
    grey
        (h, w) its image.
    rows
        (K,) those points that it shows.
    pixels, slope
        (K, 2) where they are in the image at the initial pose, and (K, 2, 6) the derivatives by a
        perturbation of the pose.
    """

    grey: Float32
    rows: Intp
    pixels: Float64
    slope: Float64

    @classmethod
    def of(cls, points: Float32, T_camera_world: Float64, shown: Shown, chosen: Intp) -> _View:
        rays = shown.projection.rays
        rows = np.flatnonzero(shown.visible[chosen])
        pixels = shown.pixels[chosen[rows]].astype(float)
        column, row = np.rint(pixels).astype(int).T
        across = (rays[row, column + 1] - rays[row, column - 1]) / 2
        down = (rays[row + 1, column] - rays[row - 1, column]) / 2
        by_pixel = np.stack([across, down], -1).astype(float)
        known = np.abs(np.linalg.det(by_pixel)) > 0  # False where a ray is unknown
        rows, pixels, by_pixel = rows[known], pixels[known], by_pixel[known]
        p = se3.transform(T_camera_world, points[chosen[rows]].astype(float))
        z = p[:, 2:]
        by_point = np.concatenate([np.tile(np.eye(2), (len(p), 1, 1)), -(p / z)[:, :2, None]], -1)
        slope = np.linalg.inv(by_pixel) @ (by_point / z[..., None]) @ -se3.point_jacobian(p)
        scale = min(1.0, _MAX_SIDE / max(shown.image.shape))
        size = [max(1, round(n * scale)) for n in shown.image.shape[1::-1]]
        small = cv2.resize(shown.image, size, interpolation=cv2.INTER_AREA)
        grey = np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), np.float32)
        factor = np.array(size) / rays.shape[1::-1]
        return cls(grey, rows, (pixels + 0.5) * factor - 0.5, slope * factor[:, None])

    def signal(self, blur: float) -> Int16:
        """(h, w, 3) times `_UNIT`: the blurred image by the contrast around it, and its slopes."""
        image = cv2.GaussianBlur(self.grey, (0, 0), blur)
        size = (round(_NEIGHBOURHOOD * blur) + 1,) * 2
        mean = cv2.blur(image, size)
        variance = np.maximum(cv2.blur(image * image, size) - mean * mean, 0)
        unit = (image - mean) * (_UNIT / np.sqrt(variance + _NOISE**2))
        slopes = (cv2.Scharr(unit, cv2.CV_32F, *axis, scale=1 / 32) for axis in ((1, 0), (0, 1)))
        # Half the memory: no pixel differs by more than the edge of the neighbourhood in contrasts.
        return np.asarray(np.rint(cv2.merge([unit, *slopes])), np.int16)

    def sampled(self, signal: Int16, twist: Float64, used: Bool) -> tuple[Intp, Float64, Float64]:
        """Return the used points (K,), and there `signal` (K, 3) and the derivatives (K, 2, 6)."""
        own = used[self.rows]
        rows, slope = self.rows[own], self.slope[own]
        if not len(rows):
            return rows, np.zeros((0, 3)), slope
        u, v = (self.pixels[own] + slope @ twist).astype(np.float32).T
        values = cv2.remap(signal, u, v, cv2.INTER_LINEAR)
        return rows, values.reshape(-1, 3).astype(float) / _UNIT, slope


def _differences(
    views: Sequence[_View], signals: Sequence[Int16], xi: Float64, used: Bool
) -> list[tuple[Intp, Float64, Float64]]:
    """Return the used points (K,) of each view that others show too, and how these differ.

    The difference (K,) is from the mean of the others, with its derivatives (K, 6).
    """
    sampled = run_all(
        [
            partial(view.sampled, signal, twist, used)
            for view, signal, twist in zip(views, signals, xi, strict=True)
        ]
    )
    total, count = np.zeros(len(used)), np.zeros(len(used), int)
    for rows, values, _ in sampled:
        total[rows] += values[:, 0]
        count[rows] += 1
    out = []
    for rows, values, slope in sampled:
        shared = count[rows] > 1
        rows, values, slope = rows[shared], values[shared], slope[shared]
        mean = (total[rows] - values[:, 0]) / (count[rows] - 1)
        derivative = values[:, 1:2] * slope[:, 0] + values[:, 2:] * slope[:, 1]
        out.append((rows, values[:, 0] - mean, derivative))
    return out


def _step(error: Float64, slope: Float64, xi: Float64) -> Float64:
    """Return the step (6,) of Gauss and Newton, with a robust weight and the prior of `_SIGMA`."""
    weighted = slope * np.minimum(1, _ROBUST_LIMIT / np.maximum(np.abs(error), 1e-9))[:, None]
    A = weighted.T @ slope + np.diag(_SIGMA**-2.0)
    return np.asarray(np.linalg.solve(A, -weighted.T @ error - xi / _SIGMA**2))
