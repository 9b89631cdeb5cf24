"""The factory correction of a ToF camera's range: a curve over range and an offset per pixel."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.errors import InputError
from tofuse.formats.files.atomic import replacing
from tofuse.formats.files.npz import read_npz

_MAX_BYTES = 1 << 30
KEYS = ("range_m", "bias_m", "pixel_bias_m")


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

    def save(self, path: str | Path) -> None:
        """Write an .npz with the keys range_m, bias_m and, where known, pixel_bias_m."""
        path = Path(path)
        arrays: dict[str, NDArray[np.floating]] = {"range_m": self.range_m, "bias_m": self.bias_m}
        if self.pixel_bias_m is not None:
            arrays["pixel_bias_m"] = self.pixel_bias_m
        with replacing(path) as part, part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> DepthCorrection:
        """Read what `save` writes.

        Raises
        ------
        InputError
            If the file can't be read, or a key is missing or has an invalid array.
        """
        try:
            arrays = read_npz(path, limit=_MAX_BYTES, names=frozenset(KEYS))
        except InputError as error:
            raise InputError(
                error.problem,
                where=path,
                remedy="write it by DepthCorrection.save, or delete it to go without",
            ) from error
        for key in KEYS[:2]:
            if key not in arrays:
                raise InputError(f"has no {key}", where=path, remedy=f"use the keys {list(KEYS)}")
        try:
            return cls(arrays["range_m"], arrays["bias_m"], arrays.get("pixel_bias_m"))
        except InputError as error:
            raise InputError(error.problem, where=path, remedy=error.remedy) from error


def _check_numbers(name: str, array: NDArray[np.generic]) -> None:
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name} holds {array.dtype}", where="correction", remedy="use numbers")
    if not np.isfinite(array).all():
        raise InputError(
            f"{name} contains a number that is not finite",
            where="correction",
            remedy="use 0 where nothing is known",
        )
