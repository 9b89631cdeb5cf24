"""Compressed arrays as text for the scripts of pages, where `bytes.js` decodes them."""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Float64, Int8, UInt16

_LEVEL = 6  # of zlib: higher ones take three times as long and save 3 %


def pack(array: NDArray[Any]) -> str:
    """Return an array (N,) or (N, C), losslessly compressed.

    Consecutive rows are similar, as neighbouring vertices and faces are: the differences of each
    column are stored as byte planes, lowest bytes first, and deflated.
    """
    if not array.size:
        return base64.b64encode(zlib.compress(b"")).decode()
    columns = np.ascontiguousarray(array).reshape(len(array), -1)
    words = columns.view(f"u{columns.itemsize}")
    differences = words.copy()
    differences[1:] -= words[:-1]
    low_first = differences.astype(differences.dtype.newbyteorder("<"), copy=False)
    planes = (
        low_first.view(np.uint8)
        .reshape(*differences.shape, differences.itemsize)
        .transpose(1, 2, 0)
    )
    packed = zlib.compress(np.ascontiguousarray(planes).tobytes(), _LEVEL)
    return base64.b64encode(packed).decode()


def quantized(points: Float64, low: Float64, extent: Float64) -> UInt16:
    """Quantise points (N, 3) to 16 bits in a box with corner `low` (3,) and size `extent` (3,)."""
    return np.round((points - low) / extent * 65535).astype("<u2")


def normal_bytes(normals: NDArray[Any]) -> Int8:
    """Return unit normals (N, 3) as bytes; zeros where there is none."""
    return np.round(np.nan_to_num(normals.astype(float)) * 127).astype(np.int8)
