"""OpenEXR images, written here according to the specification."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from made_phones import exr_bytes
from tofuse.engine.errors import InputError
from tofuse.formats.images.exr import parse_exr

IMAGE = np.random.default_rng(1).uniform(0, 5, (37, 21)).astype(np.float32)
SMOOTH = np.linspace(0, 5, 37 * 21, dtype=np.float32).reshape(37, 21)


@pytest.mark.parametrize("image", [IMAGE, SMOOTH], ids=["rough", "smooth"])
@pytest.mark.parametrize(("compression", "lines"), [(0, 1), (2, 1), (3, 16)])
@pytest.mark.parametrize("kind", [1, 2])
def test_values_round_trip(image: np.ndarray, compression: int, lines: int, kind: int) -> None:
    data = exr_bytes(image, compression, kind, "Z", lines)
    channels = parse_exr(data, "a.exr")
    assert list(channels) == ["Z"]
    kept = image.astype(np.float16).astype(np.float32) if kind == 1 else image
    np.testing.assert_array_equal(channels["Z"], kept)


def test_integers_round_trip() -> None:
    image = np.arange(37 * 21).reshape(37, 21)
    np.testing.assert_array_equal(parse_exr(exr_bytes(image, 3, 0), "a.exr")["R"], image)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.05, 0.1, 0.5, 0.99, 0.9999])
def test_truncated_file_is_rejected(share: float) -> None:
    data = exr_bytes(IMAGE)
    with pytest.raises(InputError, match=r"^a\.exr: "):
        parse_exr(data[: int(share * len(data))], "a.exr")


def test_unsupported_compressions_and_sizes_are_rejected() -> None:
    with pytest.raises(InputError, match="compressed by PIZ; write it with ZIP"):
        parse_exr(exr_bytes(IMAGE, 4), "a.exr")
    data = exr_bytes(IMAGE)
    box = struct.pack("<4i", 0, 0, 20, 36)
    huge = data.replace(box, struct.pack("<4i", 0, 0, 1 << 20, 1 << 20), 1)
    with pytest.raises(InputError, match="declares"):
        parse_exr(huge, "a.exr")
    with pytest.raises(InputError, match="tiles"):
        parse_exr(data[:4] + struct.pack("<I", 0x202) + data[8:], "a.exr")
