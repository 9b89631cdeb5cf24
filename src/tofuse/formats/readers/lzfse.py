"""LZFSE streams (Apple's codec), in which Record3D stores depth."""

from __future__ import annotations

from pathlib import Path

from tofuse.engine.errors import InputError
from tofuse.formats.files import reading

# Each block begins with these letters. It has at most 40,000 literals and 10,000 copies of up to
# 2359 bytes, and the encoder fills it with at least a few kilobytes.
_MAGIC = b"bvx"
_MIN_BLOCK_BYTES, _MORE_BLOCKS, _HEADERS = 8192, 8, 1024


def lzfse_decompress(data: bytes, size: int, path: str | Path) -> bytes:
    """Decompress a stream of exactly `size` bytes; `path` names it in errors.

    Raises
    ------
    InputError
        If it is damaged, cut off, or of another size, or the package `lzfse` is not installed.
    """
    lzfse = reading.required_package("lzfse", "phones", path)
    # The package has no limit of the size.
    if (
        len(data) > 2 * size + _HEADERS
        or data.count(_MAGIC) > _MORE_BLOCKS + size // _MIN_BLOCK_BYTES
    ):
        raise InputError(f"has more than {size} bytes", where=path, remedy="copy it again")
    try:
        out: bytes = lzfse.decompress(data)
    except (lzfse.error, MemoryError) as error:
        raise InputError(
            "is a damaged or cut off LZFSE stream", where=path, remedy="copy it again"
        ) from error
    if len(out) != size:
        raise InputError(
            f"decompresses to {len(out)} bytes, not {size}", where=path, remedy="copy it again"
        )
    return out
