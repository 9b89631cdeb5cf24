"""Known errors of a camera and their correction.

`DepthCorrection` is that of the factory, a curve over the range and an offset per pixel, applied
when a recording is read. `CameraErrors` corrects intrinsics and range as found by calibration.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.cameras import Camera, Pinhole, RayTable, lens, ray_lengths
from tofuse.engine.errors import InputError
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.parts import part
from tofuse.engine.sensor.base import Correction, Corrector


@dataclass(frozen=True, eq=False)
class DepthCorrection:
    """The bias to subtract from the measured radial range.

    The bias of a pixel is a function of the measured range, the same for all pixels, plus a
    constant of the pixel: the two systematic errors of a modulated camera that remain on a plain
    wall, wiggling and the delay along the read-out chain (Lindner and Kolb 2006).

    Attributes
    ----------
    range_m
        (K,) float64 ascending knots of measured radial range in m.
    bias_m
        (K,) float64 bias there in m; linear in between, constant outside.
    pixel_bias_m
        (H, W) float32 offset of each pixel in m, or None.

    Raises
    ------
    InputError
        If the shapes disagree, a number is not finite, or the knots do not ascend.
    """

    range_m: Float64
    bias_m: Float64
    pixel_bias_m: Float32 | None = None

    def __post_init__(self) -> None:
        knots, bias = np.asarray(self.range_m), np.asarray(self.bias_m)
        if knots.ndim != 1 or len(knots) == 0 or knots.shape != bias.shape:
            raise InputError(
                f"range_m has shape {knots.shape} and bias_m {bias.shape}",
                where="correction",
                remedy="use one bias for each knot",
            )
        for name, array in (("range_m", knots), ("bias_m", bias)):
            _check_numbers(name, array)
        if (np.diff(knots) <= 0).any():
            raise InputError("range_m does not ascend", where="correction", remedy="sort the knots")
        object.__setattr__(self, "range_m", knots.astype(float))
        object.__setattr__(self, "bias_m", bias.astype(float))
        if self.pixel_bias_m is not None:
            pixel = np.asarray(self.pixel_bias_m)
            if pixel.ndim != 2:
                raise InputError(
                    f"pixel_bias_m has shape {pixel.shape}",
                    where="correction",
                    remedy="use one offset for each pixel, (H, W)",
                )
            _check_numbers("pixel_bias_m", pixel)
            object.__setattr__(self, "pixel_bias_m", pixel.astype(np.float32))

    def correct(self, radial_range: ArrayLike) -> Float32:
        """Return the corrected radial range (H, W) in m of the measured one; 0 stays 0.

        Pixels whose corrected range is not positive become invalid (0).

        Raises
        ------
        InputError
            If the image is not of the size of the offsets per pixel.
        """
        measured = np.asarray(radial_range, np.float32)
        bias = np.interp(measured, self.range_m, self.bias_m)
        if self.pixel_bias_m is not None:
            if measured.shape != self.pixel_bias_m.shape:
                raise InputError(
                    f"is for {self.pixel_bias_m.shape[1]} x {self.pixel_bias_m.shape[0]} pixels, "
                    f"the image has shape {measured.shape}",
                    where="correction",
                    remedy="use the correction of this camera",
                )
            bias = bias + self.pixel_bias_m
        out = np.where(measured > 0, measured - bias, 0)
        return np.maximum(out, 0).astype(np.float32)


def _check_numbers(name: str, array: NDArray[np.generic]) -> None:
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name} holds {array.dtype}", where="correction", remedy="use numbers")
    if not np.isfinite(array).all():
        raise InputError(
            f"{name} contains a number that is not finite",
            where="correction",
            remedy="use 0 where nothing is known",
        )


# Options of each error and of its standard deviation, by the names of the calibration check.
ERROR_OPTIONS = {
    "focal": ("focal", "focal_sigma"),
    "offset": ("offset_m", "offset_sigma_m"),
    "center_x": ("center_x", "center_x_sigma"),
    "center_y": ("center_y", "center_y_sigma"),
    "distortion": ("distortion", "distortion_sigma"),
}


@part("correction", "camera-errors")
@dataclass(frozen=True)
class CameraErrors(Bounded, Correction):
    """Correct focal length, principal point, radial distortion and range offset of a camera.

    Attributes
    ----------
    focal
        Relative correction of distorted rays: the true focal length is 1 / (1 + focal) of the
        stated one.
    offset_m
        Added to all ranges, m.
    center_x, center_y
        Added to the x / z and y / z of distorted rays: by so many true focal lengths the true
        principal point is further left and up.
    distortion
        Times the squared distance from the axis, a relative correction of the rays.
    focal_sigma, offset_sigma_m, center_x_sigma, center_y_sigma, distortion_sigma
        Standard deviations of these, which the stated accuracy of poses includes.
    """

    # Larger values indicate a wrong camera, not an error.
    focal: Annotated[float, Bounds(-0.5, 0.5)] = 0.0
    offset_m: Annotated[float, Bounds(-1, 1)] = 0.0
    center_x: Annotated[float, Bounds(-0.5, 0.5)] = 0.0
    center_y: Annotated[float, Bounds(-0.5, 0.5)] = 0.0
    distortion: Annotated[float, Bounds(-0.5, 0.5)] = 0.0
    focal_sigma: Annotated[float, Bounds(0, 0.5)] = 0.0
    offset_sigma_m: Annotated[float, Bounds(0, 1)] = 0.0
    center_x_sigma: Annotated[float, Bounds(0, 0.5)] = 0.0
    center_y_sigma: Annotated[float, Bounds(0, 0.5)] = 0.0
    distortion_sigma: Annotated[float, Bounds(0, 0.5)] = 0.0

    def start(self) -> Corrector:
        """See `Correction.start`."""
        return _Corrector(self)

    def and_then(self, other: CameraErrors) -> CameraErrors:
        """Return the composition of this correction with `other`, to first order.

        The standard deviations are those of the last estimate of each error.
        """
        return CameraErrors(
            self.focal + other.focal + self.focal * other.focal,
            self.offset_m + other.offset_m,
            self.center_x * (1 + other.focal) + other.center_x,
            self.center_y * (1 + other.focal) + other.center_y,
            self.distortion + other.distortion,
            **{
                sigma: getattr(other if getattr(other, error) else self, sigma)
                for error, sigma in ERROR_OPTIONS.values()
            },
        )

    @property
    def errors(self) -> dict[str, float]:
        """The errors by name, as in `ERROR_OPTIONS`."""
        return {name: getattr(self, error) for name, (error, _) in ERROR_OPTIONS.items()}

    @property
    def sigmas(self) -> dict[str, float]:
        """Their standard deviations by name."""
        return {name: getattr(self, sigma) for name, (_, sigma) in ERROR_OPTIONS.items()}

    @classmethod
    def made_with(cls, config: Mapping[str, Any]) -> tuple[Corrector, ...]:
        """Return the camera corrections in a result's configuration (plain data).

        They are the only corrections that change the rays of pixels.
        """
        return tuple(
            cls(**{error: item.get(error, 0.0) for error, _ in ERROR_OPTIONS.values()}).start()
            for item in config.get("corrections", ())
            if item["part"] == "camera-errors"
        )

    def camera(self, stated: Camera) -> Camera:
        """Return the true camera."""
        if isinstance(stated, Pinhole):
            fx, fy = stated.fx / (1 + self.focal), stated.fy / (1 + self.focal)
            cx, cy = stated.cx - self.center_x * fx, stated.cy - self.center_y * fy
            camera: Camera = replace(stated, fx=fx, fy=fy, cx=cx, cy=cy)
        else:
            rays = lens.moved_rays(stated.rays(), self.focal, (self.center_x, self.center_y))
            camera = RayTable(rays)
        if not self.distortion:
            return camera
        squares = (np.asarray(stated.rays(), np.float64) ** 2).sum(-1, keepdims=True)
        rays = camera.rays() + self.distortion * squares * stated.rays()
        return RayTable(rays.astype(np.float32))


@dataclass(eq=False)
class _Corrector(Corrector):
    options: CameraErrors
    # The last camera as stated and as it is: frames share theirs, and what is worked out for it.
    _cameras: tuple[Camera, Camera] | None = None

    def apply(self, frame: Frame, T_world_camera: Float64 | None = None) -> Frame:
        """See `Corrector.apply`; clouds have no camera."""
        if not isinstance(frame, RangeFrame):
            return frame
        options = self.options
        if options.focal or options.center_x or options.center_y or options.distortion:
            cameras = self._cameras
            if cameras is None or cameras[0] != frame.camera:
                cameras = self._cameras = (frame.camera, options.camera(frame.camera))
            frame = replace(frame, camera=cameras[1])
        if options.offset_m:
            # What is valid stays valid.
            least = np.float32(1e-3)
            longer = np.maximum(frame.radial_range + np.float32(options.offset_m), least)
            if frame.depth_kind == "z":
                longer /= ray_lengths(frame.camera).astype(np.float32)
            frame = replace(frame, depth=np.where(frame.depth > 0, longer, np.float32(0)))
        return frame

    def is_independent(self, frame: Frame) -> bool:
        """See `Corrector.is_independent`."""
        return True
