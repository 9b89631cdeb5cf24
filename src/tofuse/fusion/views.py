"""Range images as fusion keeps them: small, until the poses are final."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import Bool, Float32, Int8, UInt8, UInt16
from tofuse.geometry.cameras import ray_lengths
from tofuse.kernels.median import median
from tofuse.kernels.tsdf import mark_jumps, pack_view, shrink_to_planes
from tofuse.recordings.frames import CloudFrame, RangeFrame
from tofuse.registration.prepared_view import (
    PreparedView,
    Projection,
    SurfaceOptions,
    prepare_view,
    with_extended_planes,
)

# Weights, in 1/m^2, are kept as logarithms: six steps an octave, from 2^-14 on.
_STEPS, _LEAST = 6.0, -14.0
DECODED = np.r_[0.0, 2.0 ** (np.arange(255) / _STEPS + _LEAST)].astype(np.float32)
# Below this cosine of the incidence a pixel's light comes from too much of the surface.
_LEAST_COSINE = 0.1
# Size of what surfaces have of relief within a window of a few pixels, as a share of the depth.
_DETAIL = 0.002
# Two neighbours differ by more than so many sigmas only where there are two surfaces.
_JUMP_SIGMAS = 4.0
# Pixels near a jump count so many times: they are wanted where nothing else was seen.
_RIM = 0.1
# Sigmas within which a pixel measured a plane. A filter that thins out a noisy surface is overruled
# there, next to what it left; what it cuts off stays away.
_ON_PLANE = 3.0
# Planes where the tracker has none: of windows that may be less full, and less even.
_FILL, _OFFSET = 0.4, 1.0


@dataclass(frozen=True, eq=False)
class RangeView:
    """What fusion needs of a range image, at most 320 columns, 8 to 10 bytes a pixel.

    Attributes
    ----------
    index, timestamp
        Of the frame.
    projection
        Rays of the pixels, and where points land.
    z
        (H, W) uint16, z in counts of `unit` m, 0 where there is none.
    normals
        (H, W, 3) int8, 127 times the unit normals away from the camera.
    strength
        (H, W) uint8 code of the weight, see `weights`; 0 where nothing is to be believed.
    light
        (H, W) float16, root of the albedo in the recording's counts times m^2; or (H, W, 3) uint8
        RGB; None where neither is known.
    sigma_m
        Typical standard deviation of z.
    """

    index: int
    timestamp: float
    projection: Projection
    z: UInt16
    unit: float
    normals: Int8
    strength: UInt8
    light: NDArray[np.float16] | UInt8 | None
    sigma_m: float

    @classmethod
    def of(
        cls,
        frame: RangeFrame,
        surface: PreparedView | None = None,
        options: SurfaceOptions | None = None,
    ) -> RangeView:
        """Keep what of `frame` is valid; `surface` is the same image before filters, if there is.

        A pixel's weight is one over the variance of the distance from its plane: that of its depth
        times the squared cosine of the incidence. It is 0 next to jumps in depth, where light of
        both sides mixes, unless the pixel measured the plane of its neighbours. Its depth is drawn
        towards its plane, the more the noisier it is.
        """
        options = options or SurfaceOptions()
        if surface is None:
            surface = prepare_view(frame, options)
        surface = with_extended_planes(surface, frame, replace(options, fill=_FILL, offset=_OFFSET))
        shape = surface.z.shape
        smoothed, variance = np.empty(shape, np.float32), np.empty(shape, np.float32)
        measured, jump = np.empty(shape, bool), np.zeros(shape, np.uint8)
        shrink_to_planes(
            surface.z, surface.sigma, surface.planes, surface.plane_variance, _DETAIL, _ON_PLANE,
            smoothed, variance, measured,
        )  # fmt: skip
        mark_jumps(surface.z, surface.sigma, options.edge_jump, _JUMP_SIGMAS, jump)
        valid = _reduced(frame.valid.astype(np.float32), shape) >= 0.5
        valid |= measured & _widened(valid.view(np.uint8), 1) & (jump == 0)
        z = np.where(valid, smoothed, np.float32(0))
        good = (z > 0) & (surface.sigma > 0) & ((jump == 0) | (surface.planes[..., 3] > 0))
        normals = np.empty((*shape, 3), np.int8)
        weight = np.empty(shape, np.float32)
        pack_view(
            surface.planes,
            surface.rays,
            surface.projection.lengths2,
            variance,
            good,
            _LEAST_COSINE,
            normals,
            weight,
        )
        weight[_widened(jump, options.edge_margin)] *= _RIM
        good = weight > 0
        farthest = float(z.max(initial=0.0))
        unit = max(farthest, 1e-3) / 65535
        return cls(
            frame.index,
            frame.timestamp,
            surface.projection,
            np.round(z / unit).astype(np.uint16),
            unit,
            normals,
            _encoded(weight),
            _light(frame, shape),
            _typical_sigma(variance, good),
        )

    @property
    def nbytes(self) -> int:
        """Bytes that the view's own images take."""
        light = 0 if self.light is None else self.light.nbytes
        return self.z.nbytes + self.normals.nbytes + self.strength.nbytes + light

    @property
    def depth(self) -> float:
        """Median z in m, of every fourth pixel if any of these is valid; 0 where nothing is."""
        for step in (2, 1):
            some = self.z[::step, ::step]
            known = some[some > 0]
            if len(known):
                return float(median(known.astype(np.float32))) * self.unit
        return 0.0

    @property
    def pitch(self) -> float:
        """Typical difference of x/z between neighbouring pixels."""
        return self.projection.pitch

    @property
    def channels(self) -> int:
        """3 for colour, 1 for albedo, else 0."""
        if self.light is None:
            return 0
        return 3 if self.light.ndim == 3 else 1

    def as_cloud(self, pixels: int | None = None) -> CloudFrame:
        """Return the valid pixels as a cloud; its amplitude falls with the square of the range.

        Of an image with more than so many pixels every n-th of every n-th row is taken.
        """
        valid = (self.z > 0) & np.isfinite(self.projection.rays).all(-1)
        if pixels is not None:
            step = max(1, round(np.sqrt(self.z.size / pixels)))
            some = np.zeros_like(valid)
            some[step // 2 :: step, step // 2 :: step] = True
            valid &= some
        z = self.z[valid].astype(np.float32) * np.float32(self.unit)
        rays = self.projection.rays[valid]
        points = np.concatenate([rays * z[:, None], z[:, None]], 1)
        color = amplitude = None
        if self.channels == 3:
            assert self.light is not None
            color = self.light[valid].astype(np.uint8)
        elif self.light is not None:
            square = np.einsum("ni,ni->n", points, points)
            amplitude = self.light[valid].astype(np.float32) ** 2 / np.maximum(square, 1e-6)
        return CloudFrame(self.index, self.timestamp, points, color=color, amplitude=amplitude)


def _typical_sigma(variance: Float32, good: Bool) -> float:
    """Of every fourth pixel, or of all if none of these is good."""
    for step in (2, 1):
        some = variance[::step, ::step][good[::step, ::step]]
        if len(some):
            return float(np.sqrt(median(some)))
    return 0.0


def _widened(mask: UInt8, margin: int) -> Bool:
    size = 2 * margin + 1
    return cv2.dilate(mask, np.ones((size, size), np.uint8)) > 0


def without_camera_errors(
    views: Iterable[RangeView], errors: Mapping[str, float]
) -> Iterator[RangeView]:
    """Views as they would be, did the camera not err like this; see `Refinement.errors`."""
    stretch = 1 + errors.get("focal", 0.0)
    straight: dict[int, Projection] = {}  # shared, as it was before
    for view in views:
        old = view.projection
        if id(old) not in straight:
            frame = old.frame * [stretch, stretch, 1 / stretch, 1 / stretch]
            straight[id(old)] = Projection(
                np.asarray(old.rays * np.float32(stretch)), old.lookup, frame
            )
        z = view.z * np.float32(view.unit)
        z = z * np.float32(1 + errors.get("scale", 0.0)) + np.where(
            z > 0, np.float32(errors.get("offset", 0.0)) / np.sqrt(old.lengths2), 0
        )
        z = np.maximum(np.nan_to_num(z), 0)
        unit = max(float(z.max(initial=0.0)), 1e-3) / 65535
        counts = np.round(z / unit).astype(np.uint16)
        yield replace(view, z=counts, unit=unit, projection=straight[id(old)])


def _encoded(weight: Float32) -> UInt8:
    known = weight > 0
    code = 1 + np.round(_STEPS * (np.log2(np.where(known, weight, 1)) - _LEAST))
    return np.where(known, np.clip(code, 1, 255), 0).astype(np.uint8)


def _light(frame: RangeFrame, shape: tuple[int, ...]) -> NDArray[np.float16] | UInt8 | None:
    if frame.color_image is not None:
        return np.round(_reduced(frame.color_image.astype(np.float32), shape)).astype(np.uint8)
    if frame.amplitude_image is None:
        return None
    amplitude = frame.amplitude_image
    if frame.amplitude_kind != "range_compensated":
        # Light falls off with the square of the range: this is nearly the surface's albedo.
        amplitude = amplitude * np.square(frame.z * ray_lengths(frame.camera))
    light = np.sqrt(np.maximum(_reduced(np.nan_to_num(amplitude), shape), 0))
    return np.minimum(light, 65000).astype(np.float16)


def _reduced(image: Float32, shape: tuple[int, ...]) -> Float32:
    """Means over the blocks of pixels that make the (H, W) of a reduced image."""
    step = image.shape[1] // shape[1]
    if step == 1:
        return image
    whole = np.ascontiguousarray(image[: step * shape[0], : step * shape[1]])
    means = cv2.resize(whole, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)
    return np.asarray(means, np.float32)
