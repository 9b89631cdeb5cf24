"""LZFSE: a stream of Apple's own encoder, and damaged streams."""

from __future__ import annotations

import base64

import numpy as np
import pytest

from made_phones import lzfse_raw
from tofuse.errors import InputError
from tofuse.files.lzfse import lzfse_decompress

# `CONTENT` compressed by Apple's reference encoder.
STREAM = base64.b64decode(
    "YnZ4MigjAABEADACAD0AMBck8YUjPAAgnAAAADu08A/8CQACAAAgAAAg8AbwCPDkDAAAAAAAAAAAAAAAAAAAAHgS"
    "3gAA4Cv4CgCAJ+FJAAAAAPgKvgIAAAAAAAAAAHgSXhAA4Cv4CgAAAAAAAAAA4El4EgAAAACehCcBAPgKvgIAAAAA"
    "AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAABAsrtZjPGduH1sf3wYX+2fJwJg641jrHWVuH1sf3wYXw0AAAAAAAAA"
    "AAAABC/gBLyAU3AKTsEpOAWn4BScglNwCk7BKTgFp+AUnIJTcApOwSk4BafgFJyCU3AKgwNidngk"
)
_K = np.arange(9000)
CONTENT = ((_K // 300) ** 2 % 17 * 9 + (_K % 300 > 280)).astype(np.uint8).tobytes()


@pytest.mark.slow
def test_reference_stream_is_decompressed() -> None:
    assert lzfse_decompress(STREAM, len(CONTENT), "x") == CONTENT


def test_concatenated_and_stored_blocks_are_decompressed() -> None:
    joined = lzfse_raw(b"abc")[:-4] + STREAM
    assert lzfse_decompress(joined, 3 + len(CONTENT), "x") == b"abc" + CONTENT


def test_wrong_size_or_kind_is_rejected() -> None:
    with pytest.raises(InputError, match="decompresses to 9000 bytes, not 9001"):
        lzfse_decompress(STREAM, 9001, "x")
    with pytest.raises(InputError, match="damaged or cut off"):
        lzfse_decompress(STREAM, 8999, "x")
    with pytest.raises(InputError, match="uses LZVN, which is not supported"):
        lzfse_decompress(b"bvxn" + bytes(8), 10, "x")


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
