"""Detection of the inner corners of a checkerboard in an image, and its pose."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np

from tofuse.engine.arrays import Float32, Float64, UInt8
from tofuse.engine.cameras import Camera
from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame, Recording
from tofuse.engine.geometry import se3

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


def search_board(
    recording: Recording, board: Board, channel: str, max_frames: int
) -> Iterator[tuple[RangeFrame, Float64 | None]]:
    """Yield evenly spaced frames of a recording, each with the corners of the board, or None.

    Parameters
    ----------
    recording
        Depth images with amplitude, or with colour that is registered to depth.
    board
        The checkerboard.
    channel
        The image in which it is searched: "amplitude" or "color".
    max_frames
        Their maximum number.

    Raises
    ------
    InputError
        If a frame has no such image.
    """
    for frame in recording.images(max_frames):
        image = frame.color_image if channel == "color" else frame.amplitude_image
        # Colour that is not registered to depth is from another lens.
        if image is None or image.shape[:2] != frame.depth.shape:
            other = "color" if channel == "amplitude" else "amplitude"
            raise InputError(
                f"frame {frame.index} has no {channel} on the pixels of its depth",
                where=recording.path,
                remedy=f"use --image {other}, or record it",
            )
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
        yield frame, find_corners(np.asarray(grey, np.float32), board)


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


def board_pose(camera: Camera, corners: Float64, board: Board) -> tuple[Float64, float] | None:
    """Return T_camera_board (4, 4) from corners (N, 2) in pixels, and their rms error in pixels.

    By infinitesimal plane-based pose estimation (Collins and Bartoli 2014), refined by
    Levenberg-Marquardt. None if corners lie outside the valid area of the lens.
    """
    rays = cv2.remap(
        np.asarray(camera.rays(), np.float32),
        corners[:, 0].astype(np.float32),
        corners[:, 1].astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).reshape(-1, 2)
    if not np.isfinite(rays).all():
        return None
    points = board.points.astype(float)
    observed = rays.astype(float)
    try:
        found, rvec, tvec = cv2.solvePnP(points, observed, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
        if not found:
            return None
        rvec, tvec = cv2.solvePnPRefineLM(points, observed, np.eye(3), None, rvec, tvec)
    except cv2.error:
        return None
    T = se3.pose(cv2.Rodrigues(rvec)[0], tvec.ravel())
    errors = camera.project(se3.transform(T, points)) - corners
    rms = float(np.sqrt((errors**2).sum(1).mean()))
    return (T, rms) if np.isfinite(rms) else None
