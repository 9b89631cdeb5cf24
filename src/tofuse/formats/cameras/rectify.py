"""Rectification of images of any camera to a pinhole camera."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Bool, Float32, Float64, Intp
from tofuse.engine.cameras import Camera, Pinhole
from tofuse.engine.frames import RangeFrame
from tofuse.engine.geometry import homogeneous

# Beyond this slope of a ray (60 degrees off the axis) a pinhole image is mostly stretched rim.
MAX_SLOPE = 1.75
_INNER = 0.5  # central fraction of the image that determines the focal length


def pinhole_of(camera: Camera) -> Pinhole:
    """Return a pinhole camera of the same size, and of the same resolution in the image centre.

    The rim of a wide-angle lens, beyond 60 degrees off the axis, may be outside of its image.
    """
    if type(camera) is Pinhole:
        return camera
    rays = camera.rays().astype(float)
    height, width = rays.shape[:2]
    rows, columns = (
        slice(int(n * (1 - _INNER) / 2), int(np.ceil(n * (1 + _INNER) / 2)) + 1)
        for n in (height, width)
    )
    dx = np.nanmedian(np.diff(rays[rows, columns, 0], axis=1))
    dy = np.nanmedian(np.diff(rays[rows, columns, 1], axis=0))
    within_limit = np.nan_to_num(np.hypot(rays[..., 0], rays[..., 1]), nan=np.inf) < MAX_SLOPE
    x, y = rays[within_limit].T
    # Covers the camera's field of view, at no finer resolution.
    fx = min(1 / dx, (width - 1) / float(np.ptp(x)))
    fy = min(1 / dy, (height - 1) / float(np.ptp(y)))
    cx = (width - 1) / 2 - fx * float(x.min() + x.max()) / 2
    cy = (height - 1) / 2 - fy * float(y.min() + y.max()) / 2
    return Pinhole(width, height, float(fx), float(fy), cx, cy)


def _nearest_pixels(camera: Camera, pinhole: Pinhole) -> tuple[Intp, Bool]:
    """Row and column (H, W, 2) of the pixel nearest to each pinhole ray, and whether it exists."""
    uv = np.rint(camera.project(homogeneous(pinhole.rays())))
    inside = np.asarray(
        np.isfinite(uv).all(-1)
        & (uv >= 0).all(-1)
        & (uv[..., 0] < camera.width)
        & (uv[..., 1] < camera.height)
    )
    return np.where(inside[..., None], uv, 0).astype(np.intp)[..., ::-1], inside


class Rectifier:
    """Rectifies frames to a pinhole camera by nearest-neighbour sampling.

    Depth is evaluated at the pinhole ray, on the local plane of the nearest pixel, so that planes
    stay planar.
    """

    def __init__(self, pinhole: Pinhole) -> None:
        self.pinhole = pinhole
        self._camera: Camera | None = None
        self._mapping: tuple[Intp, Bool] | None = None

    def __call__(self, frame: RangeFrame) -> RangeFrame:
        """Return a frame with z depth of the pinhole camera."""
        if frame.camera == self.pinhole:
            return _as_z(frame)
        if self._mapping is None or frame.camera != self._camera:
            self._camera, self._mapping = frame.camera, _nearest_pixels(frame.camera, self.pinhole)
        return _resampled(frame, self.pinhole, *self._mapping)


def _as_z(frame: RangeFrame) -> RangeFrame:
    return replace(frame, depth=frame.z, depth_kind="z")


def _resampled(frame: RangeFrame, pinhole: Pinhole, pixels: Intp, inside: Bool) -> RangeFrame:
    rows, columns = pixels[..., 0], pixels[..., 1]

    def sampled(image: NDArray[Any] | None) -> NDArray[Any] | None:
        if image is None:
            return None
        mask = inside if image.ndim == 2 else inside[..., None]
        return np.where(mask, image[rows, columns], np.zeros((), image.dtype))

    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(frame.valid, 1 / frame.z, np.nan)
        slopes = _slopes(inverse, frame.camera.rays())
        offset = pinhole.rays() - frame.camera.rays()[rows, columns]
        inverse_at_ray = inverse[rows, columns] + (slopes[rows, columns] * offset).sum(-1)
        z = np.where(inside & (inverse_at_ray > 0), 1 / inverse_at_ray, 0)
    return RangeFrame(
        frame.index,
        frame.timestamp,
        pinhole,
        np.nan_to_num(z, posinf=0.0).astype(np.float32),
        "z",
        sampled(frame.amplitude_image),
        sampled(frame.confidence_image),
        sampled(frame.color_image),
        sampled(frame.sigma_image),
        amplitude_kind=frame.amplitude_kind,
        ambiguity_m=frame.ambiguity_m,
    )


def _slopes(inverse: Float32, rays: Float32) -> Float32:
    """Gradient (H, W, 2) of inverse depth over the ray's x and y; 0 next to jumps and holes."""
    along_u, along_v = (_smaller_step(inverse, rays, axis) for axis in (1, 0))
    # With distortion a step to the next pixel changes both slopes of the ray.
    (du, xu, yu), (dv, xv, yv) = along_u, along_v
    det = xu * yv - xv * yu
    with np.errstate(divide="ignore", invalid="ignore"):
        out = np.stack([(du * yv - dv * yu) / det, (dv * xu - du * xv) / det], axis=-1)
    return np.nan_to_num(out, nan=0.0, posinf=0.0, neginf=0.0).astype(np.float32)


def _smaller_step(inverse: Float32, rays: Float32, axis: int) -> tuple[Float64, Float64, Float64]:
    """Differences of inverse depth, x and y to the neighbour with the smaller depth difference.

    On a surface both differences are similar; at a jump that neighbour is on the same surface.
    """
    values = np.concatenate([inverse[..., None], rays], axis=-1).astype(np.float64)
    step = np.diff(values, axis=axis)
    shape = list(values.shape)
    shape[axis] = 1
    gap = np.full(shape, np.nan)
    before = np.concatenate([gap, step], axis=axis)
    after = np.concatenate([step, gap], axis=axis)
    size_before, size_after = (
        np.nan_to_num(np.abs(s[..., 0]), nan=np.inf) for s in (before, after)
    )
    smaller = np.where((size_before < size_after)[..., None], before, after)
    return smaller[..., 0], smaller[..., 1], smaller[..., 2]
