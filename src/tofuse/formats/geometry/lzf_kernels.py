"""LZF decompression (liblzf, Marc Lehmann), as PCD files use it."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import UInt8
from tofuse.engine.compute import kernel


@kernel
def lzf_decompress(source: UInt8, out: UInt8) -> int:
    """Decompress `source` (N,) into `out` (M,).

    Returns the number of bytes written, or -1 if the stream is damaged: it ends within a token,
    refers to bytes before the beginning, or contains more than M bytes.
    """
    size, capacity = source.size, out.size
    i = 0
    o = 0
    while i < size:
        control = np.int64(source[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > size or o + length > capacity:
                return -1
            for _ in range(length):
                out[o] = source[i]
                i += 1
                o += 1
            continue
        length = control >> 5
        if length == 7:
            if i >= size:
                return -1
            length += np.int64(source[i])
            i += 1
        if i >= size:
            return -1
        match = o - ((control & 31) << 8) - np.int64(source[i]) - 1
        i += 1
        length += 2
        if match < 0 or o + length > capacity:
            return -1
        # Byte by byte: the copy may overlap what it writes.
        for _ in range(length):
            out[o] = out[match]
            o += 1
            match += 1
    return o
