"""The factory correction of a ToF camera's range: a curve over range and an offset per pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.errors import InputError


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
