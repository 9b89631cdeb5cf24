"""LZFSE: a stream of Apple's own encoder, and damaged streams."""

from __future__ import annotations

import base64

import numpy as np
import pytest

from made_phones import lzfse_raw
from tofuse.errors import InputError
from tofuse.files.lzfse import lzfse_decompress

# What Apple's reference encoder makes of `CONTENT`.
STREAM = base64.b64decode(
    "YnZ4MigjAABEADACAD0AMBck8YUjPAAgnAAAADu08A/8CQACAAAgAAAg8AbwCPDkDAAAAAAAAAAAAAAAAAAAAHgS"
    "3gAA4Cv4CgCAJ+FJAAAAAPgKvgIAAAAAAAAAAHgSXhAA4Cv4CgAAAAAAAAAA4El4EgAAAACehCcBAPgKvgIAAAAA"
    "AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAABAsrtZjPGduH1sf3wYX+2fJwJg641jrHWVuH1sf3wYXw0AAAAAAAAA"
    "AAAABC/gBLyAU3AKTsEpOAWn4BScglNwCk7BKTgFp+AUnIJTcApOwSk4BafgFJyCU3AKgwNidngk"
)
_K = np.arange(9000)
CONTENT = ((_K // 300) ** 2 % 17 * 9 + (_K % 300 > 280)).astype(np.uint8).tobytes()


def test_a_stream_of_the_reference_encoder() -> None:
    assert lzfse_decompress(STREAM, len(CONTENT), "x") == CONTENT


def test_blocks_follow_each_other_and_may_be_stored() -> None:
    joined = lzfse_raw(b"abc")[:-4] + STREAM
    assert lzfse_decompress(joined, 3 + len(CONTENT), "x") == b"abc" + CONTENT


def test_another_size_or_kind_is_refused() -> None:
    with pytest.raises(InputError, match="decompresses to 9000 bytes, not 9001"):
        lzfse_decompress(STREAM, 9001, "x")
    with pytest.raises(InputError, match="damaged or cut off"):
        lzfse_decompress(STREAM, 8999, "x")
    with pytest.raises(InputError, match="uses LZVN, which is not supported"):
        lzfse_decompress(b"bvxn" + bytes(8), 10, "x")


def test_damage_is_refused_or_harmless() -> None:
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
