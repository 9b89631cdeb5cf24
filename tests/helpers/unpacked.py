"""The inverse of `tofuse.apps.report.packing.pack`."""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray


def unpack(text: str, dtype: str, columns: int) -> NDArray[Any]:
    """Return the array (N, C) that `pack` packed, as the page's script does."""
    kind = np.dtype(dtype)
    raw = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8)
    planes = raw.reshape(columns, kind.itemsize, -1).transpose(2, 0, 1)
    differences = np.ascontiguousarray(planes).view(f"<u{kind.itemsize}")[..., 0]
    words = np.cumsum(differences, axis=0, dtype=f"u{kind.itemsize}")
    return np.ascontiguousarray(words).view(kind)
