"""Projection onto a downsampled image, by a table of any camera model."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64
from tofuse.engine.cameras import Camera, lens


@dataclass(frozen=True, eq=False)
class Projection:
    """Rays of a grid of pixels, and the projection of rays onto it, for any camera model.

    Attributes
    ----------
    rays
        (H, W, 2) float32 ray coordinates x/z, y/z of the pixels.
    lookup
        (A, B, 2) float32 pixel (u, v) of each node of a grid over ray coordinates; far outside the
        image for rays that the camera does not see.
    frame
        (4,) origin and inverse spacing of the nodes: x0, y0, 1/dx, 1/dy.
    """

    rays: Float32
    lookup: Float32
    frame: Float64
    _subsampled: dict[int, Projection] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        # Read-only like a camera's own rays, so that each kernel is compiled for one type of them.
        self.rays.flags.writeable = False

    @cached_property
    def unknown(self) -> Bool | None:
        """(H, W) mask of pixels whose ray is unknown; None if there are none."""
        unknown: Bool = np.isnan(self.lengths2)
        return unknown if unknown.any() else None

    @cached_property
    def lengths2(self) -> Float32:
        """(H, W) squared ratio of the range to z."""
        return np.float32(1) + (self.rays * self.rays).sum(-1)

    @cached_property
    def ray_bounds(self) -> tuple[Float32, Float32]:
        """Smallest and largest (2,) x/z, y/z of the pixels."""
        return np.nanmin(self.rays, (0, 1)), np.nanmax(self.rays, (0, 1))

    @cached_property
    def pitch(self) -> float:
        """Typical difference of x/z between neighbouring pixels."""
        return float(np.nanmedian(np.abs(np.diff(self.rays[..., 0], axis=1))))

    @cached_property
    def lens(self) -> Float32:
        """(5,) radial distortion of the lens, see `cameras.lens.fitted`."""
        return lens.fitted(self.rays)

    @classmethod
    def of(cls, camera: Camera, step: int, spacing: float = 4.0) -> Projection:
        """Return the projection of a camera whose images are downsampled by `step`.

        `spacing` is the distance between nodes, in pixels of the full image.
        """
        rays = camera.rays()
        low = np.nanmin(rays, axis=(0, 1)).astype(float)
        high = np.nanmax(rays, axis=(0, 1)).astype(float)
        shape = np.maximum(
            np.ceil(np.array([camera.width, camera.height]) / spacing).astype(int), 4
        )
        margin = (high - low) / shape
        low, high = low - margin, high + margin
        x, y = (np.linspace(a, b, n + 3) for a, b, n in zip(low, high, shape, strict=True))
        nodes = np.stack([*np.meshgrid(x, y), np.ones((len(y), len(x)))], -1)
        pixels = (camera.project(nodes) + 0.5) / step - 0.5
        lookup = np.where(np.isfinite(pixels), pixels, -1e6).astype(np.float32)
        scale = np.array([x[0], y[0], 1 / (x[1] - x[0]), 1 / (y[1] - y[0])])
        return cls(_halve_rays(rays, step), lookup, scale)

    def pixels(self, rays: Float64) -> Float64:
        """Return the pixels (M, 2), u and v, of ray coordinates (M, 2); NaN beyond the table."""
        x0, y0, per_x, per_y = self.frame
        u, v = (rays[:, 0] - x0) * per_x, (rays[:, 1] - y0) * per_y
        rows, columns = self.lookup.shape[:2]
        outside = ~((u >= 0) & (v >= 0) & (u < columns - 1) & (v < rows - 1))
        u[outside] = v[outside] = 0
        found = interpolated(self.lookup, np.stack([u, v], 1))
        found[outside] = np.nan
        return found

    def subsampled(self, step: int) -> Projection:
        """Return the projection of every `step`-th pixel, one object for all views."""
        if step not in self._subsampled:
            first = step // 2
            rays = np.ascontiguousarray(self.rays[first::step, first::step])
            lookup = (self.lookup - np.float32(first)) / np.float32(step)
            self._subsampled[step] = Projection(rays, lookup, self.frame)
        return self._subsampled[step]


def interpolated(table: Float32, pixels: Float64) -> Float64:
    """Interpolate a table (H, W, C) bilinearly at its pixels (M, 2); linearly beyond its border."""
    rows, columns, channels = table.shape
    u, v = pixels.T
    i = np.clip(np.floor(v), 0, rows - 2).astype(np.intp)
    j = np.clip(np.floor(u), 0, columns - 2).astype(np.intp)
    a, b, first = (u - j)[:, None], (v - i)[:, None], i * columns + j
    # By one index, which is faster than by two.
    nodes = table.reshape(-1, channels)
    upper = (1 - a) * nodes[first] + a * nodes[first + 1]
    lower = (1 - a) * nodes[first + columns] + a * nodes[first + columns + 1]
    return np.asarray((1 - b) * upper + b * lower, np.float64)


_projections: WeakKeyDictionary[Camera, dict[int, Projection]] = WeakKeyDictionary()


def projection_of(camera: Camera, step: int) -> Projection:
    """Return the projection of a camera downsampled by `step`, one object for all its images."""
    cached = _projections.setdefault(camera, {})
    if step not in cached:
        cached[step] = Projection.of(camera, step)
    return cached[step]


def _halve_rays(rays: Float32, step: int) -> Float32:
    while step > 1:
        rows, columns = rays.shape[0] // 2, rays.shape[1] // 2
        rays = rays[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2, 2).mean((1, 3))
        step //= 2
    return np.ascontiguousarray(rays)
