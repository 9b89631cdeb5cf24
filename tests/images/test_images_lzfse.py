"""LZFSE: a stream of Apple's own encoder, and damaged streams."""

from __future__ import annotations

import base64
import sys

import numpy as np
import pytest

from made_phones import lzfse_raw
from tofuse.engine.errors import InputError
from tofuse.formats.readers.record3d import lzfse_decompress

# `CONTENT` compressed by Apple's reference encoder.
STREAM = base64.b64decode(
    "YnZ4MigjAABEADACAD0AMBck8YUjPAAgnAAAADu08A/8CQACAAAgAAAg8AbwCPDkDAAAAAAAAAAAAAAAAAAAAHgS"
    "3gAA4Cv4CgCAJ+FJAAAAAPgKvgIAAAAAAAAAAHgSXhAA4Cv4CgAAAAAAAAAA4El4EgAAAACehCcBAPgKvgIAAAAA"
    "AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAABAsrtZjPGduH1sf3wYX+2fJwJg641jrHWVuH1sf3wYXw0AAAAAAAAA"
    "AAAABC/gBLyAU3AKTsEpOAWn4BScglNwCk7BKTgFp+AUnIJTcApOwSk4BafgFJyCU3AKgwNidngk"
)
_K = np.arange(9000)
CONTENT = ((_K // 300) ** 2 % 17 * 9 + (_K % 300 > 280)).astype(np.uint8).tobytes()


pytest.importorskip("lzfse")


def test_reference_stream_is_decompressed() -> None:
    assert lzfse_decompress(STREAM, len(CONTENT), "x") == CONTENT


def test_concatenated_and_stored_blocks_are_decompressed() -> None:
    joined = lzfse_raw(b"abc")[:-4] + STREAM
    assert lzfse_decompress(joined, 3 + len(CONTENT), "x") == b"abc" + CONTENT


def test_wrong_size_is_rejected() -> None:
    for size in (8999, 9001):
        with pytest.raises(InputError, match=f"decompresses to 9000 bytes, not {size}"):
            lzfse_decompress(STREAM, size, "x")


def test_streams_of_many_blocks_are_not_decompressed(monkeypatch) -> None:
    """Each could expand to 24 MB, and the package has no limit."""
    monkeypatch.setattr("lzfse.decompress", lambda _: pytest.fail("it was decompressed"))
    for data in ((STREAM[:-4]) * 20, bytes(100_000)):
        with pytest.raises(InputError, match="has more than 9000 bytes"):
            lzfse_decompress(data, 9000, "x")


def test_damaged_streams_are_rejected_or_keep_size() -> None:
    for size in range(len(STREAM)):
        with pytest.raises(InputError):
            lzfse_decompress(STREAM[:size], len(CONTENT), "x")
    rng = np.random.default_rng(3)
    refused = 0
    for _ in range(3000):
        data = bytearray(STREAM)
        for at in rng.integers(0, len(data), 1 + rng.integers(3)):
            data[at] ^= 1 << int(rng.integers(8))
        try:
            assert len(lzfse_decompress(bytes(data), len(CONTENT), "x")) == len(CONTENT)
        except InputError:
            refused += 1
    assert 1000 < refused < 3000


def test_missing_package_is_named(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "lzfse", None)
    with pytest.raises(
        InputError, match=r"needs the package lzfse; pip install 'tofuse\[phones\]'"
    ):
        lzfse_decompress(STREAM, 9000, "x")
