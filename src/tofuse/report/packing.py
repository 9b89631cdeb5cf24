"""Arrays as text for the pages' scripts: small, and decoded there by `bytes.js`."""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import Float64, Int8, UInt16

_LEVEL = 6  # of zlib: higher ones take three times as long, for 3 %


def squeezed(array: NDArray[Any]) -> str:
    """Return an array (N,) or (N, C), compressed without loss.

    Rows that follow each other are alike, as are vertices and faces of one place: of each column
    the differences are kept, their lowest bytes first, all together, and then deflated.
    """
    if not array.size:
        return base64.b64encode(zlib.compress(b"")).decode()
    columns = np.ascontiguousarray(array).reshape(len(array), -1)
    words = columns.view(f"u{columns.itemsize}")
    steps = words.copy()
    steps[1:] -= words[:-1]
    low_first = steps.astype(steps.dtype.newbyteorder("<"), copy=False)
    planes = low_first.view(np.uint8).reshape(*steps.shape, steps.itemsize).transpose(1, 2, 0)
    packed = zlib.compress(np.ascontiguousarray(planes).tobytes(), _LEVEL)
    return base64.b64encode(packed).decode()


def unsqueezed(text: str, dtype: str, columns: int) -> NDArray[Any]:
    """Return the array (N, C) that `squeezed` packed, as the page's script does."""
    kind = np.dtype(dtype)
    raw = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8)
    planes = raw.reshape(columns, kind.itemsize, -1).transpose(2, 0, 1)
    steps = np.ascontiguousarray(planes).view(f"<u{kind.itemsize}")[..., 0]
    words = np.cumsum(steps, axis=0, dtype=f"u{kind.itemsize}")
    return np.ascontiguousarray(words).view(kind)


def steps_of(points: Float64, low: Float64, extent: Float64) -> UInt16:
    """Return points (N, 3) as steps of a 65535th of a box."""
    return np.round((points - low) / extent * 65535).astype("<u2")


def normal_bytes(normals: NDArray[Any]) -> Int8:
    """Return unit normals (N, 3) as bytes; zeros where there is none."""
    return np.round(np.nan_to_num(normals.astype(float)) * 127).astype(np.int8)
