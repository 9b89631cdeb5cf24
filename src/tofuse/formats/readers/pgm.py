"""PGM (Netpbm): binary grey images of 8 or 16 bits."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from tofuse.engine.arrays import UInt8, UInt16
from tofuse.engine.errors import InputError
from tofuse.formats.files import reading

_SPACE = rb"(?:\s+(?:#[^\n]*\n)?)+"
_HEADER = re.compile(rb"P5" + (_SPACE + rb"(\d{1,5})") * 3 + rb"\s")


def parse_pgm(data: bytes, where: str | Path) -> UInt8 | UInt16:
    """Decode (H, W) uint8 or uint16.

    Raises
    ------
    InputError
        Naming `where`, if it is not such an image, or is cut off.
    """
    with reading.about(where, "copy the file again"):
        return _parsed(data)


def _parsed(data: bytes) -> UInt8 | UInt16:
    header = _HEADER.match(data)
    if header is None:
        raise InputError("is not a binary PGM image")
    width, height, max_value = (int(text) for text in header.groups())
    if not (width and height and 0 < max_value < 65536):
        raise InputError(f"declares {width} x {height} pixels with values up to {max_value}")
    dtype = np.dtype(">u2" if max_value > 255 else "u1")
    size = width * height * dtype.itemsize
    if len(data) < header.end() + size:
        raise InputError("is cut off before its end")
    image = np.frombuffer(data, dtype, width * height, header.end()).reshape(height, width)
    return image.astype(dtype.newbyteorder("="))
