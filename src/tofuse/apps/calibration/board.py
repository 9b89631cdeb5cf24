"""Detection of the inner corners of a checkerboard in an image."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np

from tofuse.engine.arrays import Float32, Float64, UInt8
from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame

# Small images are enlarged to this width, by at most this factor, as the detector needs large
# squares.
_COLUMNS = 640
_MAX_SCALE = 4
_BLACK_PERCENTILE, _WHITE_PERCENTILE = 1.0, 99.0  # mapped to black and white
# Size of the window of local contrast, relative to the image's width.
_WINDOW = 0.25


@dataclass(frozen=True)
class Board:
    """A checkerboard.

    Attributes
    ----------
    columns, rows
        Inner corners along the board and across it.
    square_m
        Side of a square in m.
    """

    columns: int
    rows: int
    square_m: float

    def __post_init__(self) -> None:
        if not (3 <= self.columns <= 100 and 3 <= self.rows <= 100):
            raise InputError(
                f"has {self.columns} x {self.rows} inner corners",
                where="--board",
                remedy="count the corners where four squares meet, 3 x 3 at least",
            )
        if not 1e-4 <= self.square_m <= 10:
            raise InputError(
                f"has squares of {self.square_m} m",
                where="--board",
                remedy="set the side of a square in m",
            )

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read "8x6:0.1": inner corners along and across, side of a square in m.

        Raises
        ------
        InputError
            If the text has another form.
        """
        match = re.fullmatch(r"\s*(\d{1,3})\s*x\s*(\d{1,3})\s*:\s*([\d.eE+-]{1,20})\s*", text)
        try:
            if match:
                return cls(int(match[1]), int(match[2]), float(match[3]))
        except ValueError:
            pass
        raise InputError(
            f"is {text!r:.60}",
            where="--board",
            remedy="use inner corners and metres of a square, such as 8x6:0.1",
        )

    @property
    def points(self) -> Float32:
        """(N, 3) corners in m in the board's frame: z is 0, x along it, row by row."""
        y, x = np.mgrid[0 : self.rows, 0 : self.columns]
        flat = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
        return (flat * self.square_m).astype(np.float32)

    @property
    def outline(self) -> Float64:
        """(4, 2) outer corners of the squares in m, in order around the board."""
        right, low = self.columns * self.square_m, self.rows * self.square_m
        left = -self.square_m
        return np.array([[left, left], [right, left], [right, low], [left, low]])


def board_image(frame: RangeFrame, channel: str) -> Float32 | None:
    """Return the image (H, W) of a frame to detect a board in, "amplitude" or "color", or None.

    Colour that is not registered to depth is from another lens and is not used.
    """
    if channel == "color":
        image = frame.color_image
        if image is None or image.shape[:2] != frame.depth.shape:
            return None
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
        return np.asarray(grey, np.float32)
    return None if frame.amplitude_image is None else frame.amplitude_image.astype(np.float32)


def find_corners(image: Float32, board: Board) -> Float64 | None:
    """Return the pixel coordinates (N, 2) of the inner corners in an image (H, W), or None.

    The contrast is stretched between percentiles, or normalised locally if that fails; the image is
    enlarged and searched by the detector of Duda and Frese (2018), which refines corners to a
    fraction of a pixel.
    """
    scale = int(np.clip(np.ceil(_COLUMNS / image.shape[1]), 1, _MAX_SCALE))
    for stretched in (_stretch_contrast(image), _stretch_contrast(_flatten_illumination(image))):
        large = cv2.resize(stretched, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        found, corners = cv2.findChessboardCornersSB(
            large,
            (board.columns, board.rows),
            flags=cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY,
        )
        if found:
            # Pixel centres of the enlarged image, between those of the small one.
            return (corners.reshape(-1, 2).astype(float) + 0.5) / scale - 0.5
    return None


def _stretch_contrast(image: Float32) -> UInt8:
    valid = image[np.isfinite(image) & (image > 0)]
    if valid.size == 0:
        return np.zeros(image.shape, np.uint8)
    low, high = np.percentile(valid, [_BLACK_PERCENTILE, _WHITE_PERCENTILE])
    level = (np.nan_to_num(image) - low) / max(high - low, 1e-9)
    return (np.clip(level, 0, 1) * 255).astype(np.uint8)


def _flatten_illumination(image: Float32) -> Float32:
    """Divide by the local mean, which compensates the falloff of the illumination."""
    bright = np.maximum(np.nan_to_num(image), 0) + 1.0
    local_mean = cv2.GaussianBlur(bright, (0, 0), _WINDOW * image.shape[1] / 2)
    return np.asarray(bright / local_mean, np.float32)
