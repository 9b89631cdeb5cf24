from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from tofuse.engine.errors import InputError
from tofuse.formats.images.images import read_color, read_header, read_image, write_png


def _depth(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 65536, (48, 64), np.uint16)


def test_png_round_trips(tmp_path: Path) -> None:
    image = _depth(np.random.default_rng(1))
    write_png(tmp_path / "a.png", image)
    back = read_image(tmp_path / "a.png", size=(64, 48), dtype="uint16")
    assert back.dtype == np.uint16
    np.testing.assert_array_equal(back, image)
    header = read_header(tmp_path / "a.png")
    assert (header.width, header.height, header.channels, header.bits) == (64, 48, 1, 16)


def test_jpeg_size_is_read_from_header(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.jpg"), np.full((30, 50, 3), 90, np.uint8))
    header = read_header(tmp_path / "a.jpg")
    assert (header.width, header.height, header.channels, header.bits) == (50, 30, 3, 8)
    assert read_color(tmp_path / "a.jpg").shape == (30, 50, 3)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9, 0.999])
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_truncated_images_are_rejected(tmp_path: Path, share: float, suffix: str) -> None:
    rng = np.random.default_rng(2)
    cv2.imwrite(str(tmp_path / f"a{suffix}"), rng.integers(0, 256, (48, 64, 3), np.uint8))
    data = (tmp_path / f"a{suffix}").read_bytes()
    (tmp_path / f"a{suffix}").write_bytes(data[: int(len(data) * share)])
    with pytest.raises(InputError, match=f"a{suffix}"):
        read_image(tmp_path / f"a{suffix}")


def test_flipped_bit_in_png_is_detected(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", _depth(np.random.default_rng(3)))
    data = bytearray((tmp_path / "a.png").read_bytes())
    data[len(data) // 2] ^= 16
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(InputError, match="damaged"):
        read_image(tmp_path / "a.png")


def _png_of(width: int, height: int) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return (
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        )

    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(bytes(1000)))
        + chunk(b"IEND", b"")
    )


def test_claimed_size_is_limited_before_decoding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bomb.png").write_bytes(_png_of(60000, 60000))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("must not be decoded"))
    with pytest.raises(InputError, match="60000 x 60000"):
        read_image(tmp_path / "bomb.png")


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((48, 64), np.uint8), "8 bits; store one channel of uint16"),
        (np.zeros((48, 64, 3), np.uint8), "3 channels"),
        (np.zeros((40, 64), np.uint16), "64 x 40 pixels, the camera 64 x 48"),
    ],
)
def test_wrong_type_or_size_is_rejected(tmp_path: Path, image: np.ndarray, words: str) -> None:
    write_png(tmp_path / "a.png", image)
    with pytest.raises(InputError, match=words):
        read_image(tmp_path / "a.png", size=(64, 48), dtype="uint16")


def test_other_files_are_rejected_as_images(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text("hello")
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "loop.png").symlink_to(tmp_path / "loop.png")
    for name in ("a.png", "folder.png", "loop.png", "missing.png"):
        with pytest.raises(InputError, match=name):
            read_image(tmp_path / name)
