"""Colour images at their full resolution: distinctive patches with the planes that they lie on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from tofuse.engine.arrays import Float64, UInt8
from tofuse.engine.cameras import Camera
from tofuse.engine.color import patch_kernels as kernels
from tofuse.engine.frames import RangeFrame
from tofuse.engine.geometry import homogeneous
from tofuse.engine.views import interpolated

# Patches of a view, and the pixels of its image: of a larger one every n-th.
POINTS, _PIXELS = 300, 1_000_000
# Each level of an image has half the width of the one before.
_LEVELS = 4
# Of every n-th patch, the score by chance is computed as well.
_EVERY_BY_CHANCE = 4
# Weakest corner relative to the strongest. Weak ones are matched or not, see `color_pairs`.
_WEAKEST = 1e-3
# A plane is fitted to so many depth pixels around a patch, as a fraction of the width of the image.
_WINDOW, _HALF = 1 / 64, 4
_MIN_VALID = 0.6  # of them
_MAX_STRETCH = 5.0  # of areas by the motion


@dataclass(frozen=True)
class Search:
    """Levels of the images, coarse ones first, and that every n-th patch is looked for.

    The coarsest level limits the error of the prediction.
    """

    levels: tuple[int, ...]
    every: int


# The first search finds the motion, the second all patches.
SEARCHES = Search((3, 2, 1, 0), 3), Search((1, 0), 1)


@dataclass(frozen=True, eq=False)
class ColorView:
    """Patches of a colour image.

    With inverse depth, a plane is linear in the ray coordinates.

    Attributes
    ----------
    index
        Of the frame in its recording.
    camera
        The depth camera, at whose pixels the colour is registered.
    image
        (H, W) grey; its pixels are finer than those of depth by the same factor in both directions.
    pixels, rays
        (N, 2) centres in the image, and their ray coordinates x/z and y/z.
    inverse_depth, slope, sigma
        (N,) 1/m, (N, 2) its slopes by the ray coordinates, (N,) standard deviation about the plane:
        large at edges.
    speed
        Of the camera, m/s and rad/s.
    """

    index: int
    camera: Camera
    image: UInt8
    pixels: Float64
    rays: Float64
    inverse_depth: Float64
    slope: Float64
    sigma: Float64
    speed: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of(
        cls, frame: RangeFrame, color: UInt8, speed: tuple[float, float] = (0.0, 0.0)
    ) -> ColorView:
        """Select the patches of a frame with colour (H, W, 3) of any resolution."""
        camera = frame.camera
        image = np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), np.uint8)
        step = int(np.ceil(np.sqrt(image.size / _PIXELS)))
        if step > 1:
            size = (image.shape[1] // step, image.shape[0] // step)
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        distance = 0.5 * np.sqrt(image.size / POINTS)
        corners = cv2.goodFeaturesToTrack(image, POINTS, _WEAKEST, distance)
        pixels = np.zeros((0, 2)) if corners is None else corners.reshape(-1, 2).astype(np.float64)
        table = camera.rays()
        rays = interpolated(table, (pixels + 0.5) * camera.width / image.shape[1] - 0.5)
        grid = np.arange(-_HALF, _HALF + 1) * max(1, round(_WINDOW * camera.width / _HALF / 2))
        offsets = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2)
        centre = np.round((pixels + 0.5) * camera.width / image.shape[1] - 0.5).astype(np.intp)
        u, v = np.moveaxis(centre[:, None] + offsets, 2, 0)
        inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        u, v = u.clip(0, camera.width - 1), v.clip(0, camera.height - 1)
        z = frame.z[v, u].astype(np.float64)
        relative = table[v, u] - rays[:, None]
        valid = inside & (z > 0) & np.isfinite(relative).all(2)
        ones = np.ones((*valid.shape, 1))
        B = np.where(valid[..., None], np.concatenate([relative, ones], 2), 0.0)
        inverse = np.where(valid, 1 / np.maximum(z, 1e-3), 0.0)
        Bt = np.swapaxes(B, 1, 2)
        plane = np.linalg.solve(Bt @ B + 1e-9 * np.eye(3), Bt @ inverse[..., None])
        residual = inverse - (B @ plane)[..., 0]
        degrees = np.maximum(valid.sum(1) - 3, 1)
        sigma = np.sqrt((residual**2).sum(1) / degrees)
        kept = (valid.mean(1) >= _MIN_VALID) & (plane[:, 2, 0] > 3 * sigma)
        kept &= np.isfinite(rays).all(1)
        return cls(
            frame.index, camera, image, pixels[kept], rays[kept],
            plane[kept, 2, 0], plane[kept, :2, 0], sigma[kept], speed,
        )  # fmt: skip

    @cached_property
    def levels(self) -> tuple[UInt8, ...]:
        """The image and its reductions."""
        images = [self.image]
        for _ in range(_LEVELS - 1):
            images.append(np.asarray(cv2.pyrDown(images[-1]), np.uint8))
        return tuple(images)

    @cached_property
    def focal(self) -> float:
        """Pixels of the image per unit of the ray coordinates, about."""
        x = self.camera.rays()[self.camera.height // 2, :, 0]
        return float(np.isfinite(x).sum() * self._zoom / (np.nanmax(x) - np.nanmin(x)))

    def thinned(self, every: int) -> ColorView:
        """Return the view with every n-th patch."""
        if every == 1:
            return self
        columns = ("pixels", "rays", "inverse_depth", "slope", "sigma")
        thin = replace(self, **{name: getattr(self, name)[::every] for name in columns})
        vars(thin).update(levels=self.levels, focal=self.focal)
        return thin

    @property
    def points(self) -> Float64:
        """(N, 3) in m, in the camera's frame."""
        return np.asarray(homogeneous(self.rays) / self.inverse_depth[:, None], np.float64)

    def rays_at(self, pixels: Float64) -> Float64:
        """Return the ray coordinates (M, 2) at pixels (M, 2)."""
        return interpolated(self.camera.rays(), (pixels + 0.5) / self._zoom - 0.5)

    def project(self, points: Float64) -> Float64:
        """Return the pixels (M, 2) of points (M, 3); NaN behind the camera."""
        return np.asarray((self.camera.project(points) + 0.5) * self._zoom - 0.5, np.float64)

    def shows(self, pixels: Float64) -> Float64:
        """Return 1.0 for each of the pixels (M, 2) inside the image, else 0.0."""
        inside = (pixels >= 0) & (pixels < self.image.shape[::-1])
        return np.asarray(inside.all(1), np.float64)

    @property
    def _zoom(self) -> float:
        return self.image.shape[1] / self.camera.width


def matched(
    source: ColorView, target: ColorView, T_target_source: Float64, search: Search
) -> tuple[Float64, Float64, Float64]:
    """Find the patches of a view in another one, near where the motion predicts them.

    Parameters
    ----------
    source, target, T_target_source
        The views and their approximate relative pose (4, 4).
    search
        Levels of the images.

    Returns
    -------
    found (N, 2) pixels of the target, score (N,), see `align_patches`, and chance (M,), the scores
    of some patches where others are expected.
    """

    def projected(rays: Float64, inverse_depth: Float64) -> Float64:
        R, t = T_target_source[:3, :3], T_target_source[:3, 3]
        return target.project(homogeneous(rays) @ R.T + inverse_depth[:, None] * t)

    predicted = projected(source.rays, source.inverse_depth)
    step = kernels.HALF / source.focal
    moved = [
        projected(source.rays + step * axis, source.inverse_depth + step * source.slope @ axis)
        for axis in np.eye(2)
    ]
    maps = np.stack([(m - predicted) / kernels.HALF for m in moved], 2)
    usable = np.isfinite(predicted).all(1) & np.isfinite(maps).all((1, 2))
    maps[~usable] = np.eye(2)
    stretch = np.abs(np.linalg.det(maps))
    usable &= (stretch > 1 / _MAX_STRETCH) & (stretch < _MAX_STRETCH)

    def aligned(found: Float64, every: int) -> tuple[Float64, Float64]:
        found = found[::every].copy()
        possible = usable[::every] & np.isfinite(found).all(1)
        score = np.where(possible, kernels.UNKNOWN, kernels.FAILED)
        for level in search.levels:
            images = source.levels[level], target.levels[level]
            patches = source.pixels[::every].copy(), maps[::every].copy()
            kernels.align_patches(*images, *patches, 2.0**level, found, score)
        return found, score

    found, score = aligned(predicted, 1)
    _, chance = aligned(np.roll(predicted, len(predicted) // 2, 0), _EVERY_BY_CHANCE)
    return found, score, chance
