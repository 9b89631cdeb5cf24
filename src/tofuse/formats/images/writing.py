"""PNG and JPEG images, encoded and written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import UInt8
from tofuse.engine.errors import InputError
from tofuse.formats.files import atomic


def png_bytes(image: NDArray[np.generic]) -> bytes:
    """Encode (H, W) uint8 or uint16, or (H, W, 3) uint8 RGB, as PNG."""
    import cv2

    image = np.asarray(image)
    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3):
        raise InputError(
            f"is an array of shape {image.shape} and type {image.dtype}",
            where="image",
            remedy="pass (H, W) uint8 or uint16, or (H, W, 3) uint8",
        )
    if image.ndim == 3:
        image = np.ascontiguousarray(image[..., ::-1])
    pixels: NDArray[Any] = image
    ok, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not ok:
        raise InputError(f"of shape {image.shape} can't be encoded as PNG", where="image")
    return bytes(data)


def jpeg_bytes(image: UInt8, quality: int = 92) -> bytes:
    """Encode (H, W, 3) uint8 RGB as JPEG."""
    import cv2

    pixels: NDArray[Any] = np.ascontiguousarray(np.asarray(image, np.uint8)[..., ::-1])
    ok, data = cv2.imencode(
        ".jpg",
        pixels,
        [
            *(cv2.IMWRITE_JPEG_QUALITY, quality),
            *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
        ],
    )
    if not ok:
        raise InputError(f"of shape {image.shape} can't be encoded as JPEG", where="image")
    return bytes(data)


def write_png(path: str | Path, image: NDArray[np.generic]) -> None:
    """Write (H, W) uint8 or uint16, or (H, W, 3) uint8 RGB; see `replacing` for errors."""
    atomic.write_bytes(path, png_bytes(image))
