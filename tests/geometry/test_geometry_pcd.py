from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

import tofuse
from tofuse.engine.errors import InputError
from tofuse.formats.geometry.lzf_kernels import lzf_decompress
from tofuse.formats.geometry.pcd import read_pcd


def lzf_compress(data: bytes) -> bytes:
    """Greedy and slow, but with literals, short and long references, and overlapping ones."""
    out = bytearray()
    literals = bytearray()

    def flush() -> None:
        for k in range(0, len(literals), 32):
            run = literals[k : k + 32]
            out.append(len(run) - 1)
            out.extend(run)
        literals.clear()

    i = 0
    while i < len(data):
        best, where = 0, 0
        for back in range(1, min(i, 600) + 1):
            n = 0
            while n < 264 and i + n < len(data) and data[i + n] == data[i - back + n]:
                n += 1
            if n > best:
                best, where = n, back
        if best < 3:
            literals.append(data[i])
            i += 1
            continue
        flush()
        length, offset = best - 2, where - 1
        if length < 7:
            out += bytes([(length << 5) | (offset >> 8), offset & 255])
        else:
            out += bytes([(7 << 5) | (offset >> 8), length - 7, offset & 255])
        i += best
    flush()
    return bytes(out)


def test_lzf_kernel_stays_in_bounds() -> None:
    rng = np.random.default_rng(6)
    for _ in range(300):
        packed = rng.integers(0, 256, rng.integers(0, 40), np.uint8)
        guarded = np.full(96, 99, np.uint8)
        assert -1 <= lzf_decompress(packed, guarded[16:80]) <= 64
        assert (guarded[:16] == 99).all()
        assert (guarded[80:] == 99).all()


FIELDS = ["x", "y", "z", "rgb", "intensity", "label", "histogram"]


def _rows() -> np.ndarray:
    rng = np.random.default_rng(7)
    dtype = [(n, "<f4") for n in ("x", "y", "z")]
    dtype += [("rgb", "<u4"), ("intensity", "<f4"), ("label", "<i2"), ("histogram", "<f4", (3,))]
    rows = np.zeros(12, dtype)
    for name in ("x", "y", "z", "intensity"):
        rows[name] = rng.normal(size=12).astype(np.float32)
    rows["rgb"] = rng.integers(0, 1 << 24, 12)
    rows["label"] = rng.integers(-500, 500, 12)
    rows["histogram"] = rng.normal(size=(12, 3))
    rows["x"][4] = np.nan
    return rows


def _header(kind: str, rgb_type: str = "U") -> bytes:
    return (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb intensity label histogram\n"
        f"SIZE 4 4 4 4 4 2 4\nTYPE F F F {rgb_type} F I F\nCOUNT 1 1 1 1 1 1 3\n"
        f"WIDTH 4\nHEIGHT 3\nVIEWPOINT 1 2 3 1 0 0 0\nPOINTS 12\nDATA {kind}\n"
    ).encode()


def _ascii(rows: np.ndarray) -> bytes:
    lines = [
        " ".join(repr(float(v)) if k != 3 else str(int(v)) for k, v in enumerate(values))
        for values in (
            [r["x"], r["y"], r["z"], r["rgb"], r["intensity"], r["label"], *r["histogram"]]
            for r in rows
        )
    ]
    return "\n".join(lines).encode() + b"\n"


def _compressed(rows: np.ndarray) -> bytes:
    data = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in FIELDS)
    packed = lzf_compress(data)
    return struct.pack("<II", len(packed), len(data)) + packed


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_all_encodings_are_equivalent(tmp_path: Path, kind: str) -> None:
    rows = _rows()
    body = {"ascii": _ascii, "binary": lambda r: r.tobytes(), "binary_compressed": _compressed}
    (tmp_path / "a.pcd").write_bytes(_header(kind) + body[kind](rows))
    pcd = read_pcd(tmp_path / "a.pcd")
    assert pcd.organised
    assert (pcd.width, pcd.height) == (4, 3)
    cloud = pcd.cloud
    np.testing.assert_array_equal(cloud.points, np.stack([rows[name] for name in "xyz"], -1))
    for name in ("intensity", "label", "histogram"):
        np.testing.assert_array_equal(cloud.scalars[name], rows[name])
    assert np.isnan(cloud.points[4, 0])
    packed = int(rows["rgb"][0])
    assert cloud.color is not None
    assert cloud.color[0].tolist() == [packed >> 16, packed >> 8 & 255, packed & 255]
    np.testing.assert_array_equal(cloud.amplitude, rows["intensity"])
    np.testing.assert_array_equal(pcd.viewpoint, [1, 2, 3, 1, 0, 0, 0])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (b"DATA binary\n", b"", "not a PCD"),
        (b"DATA binary\n", b"DATA telegraph\n", "kind 'telegraph'"),
        (b"POINTS 12", b"POINTS 13", "13 points in 4 x 3"),
        (b"WIDTH 4\nHEIGHT 3", b"WIDTH 12000000\nHEIGHT 1", "points in"),
        (b"WIDTH 4\nHEIGHT 3\nV", b"WIDTH 4000\nHEIGHT 30000\nPOINTS 120000000\nV", "points"),
        (b"SIZE 4 4 4", b"SIZE 4 4 3", "invalid PCD header"),
        (b"SIZE 4 4 4 4", b"SIZE 4 4 4", "different lengths"),
        (b"FIELDS x y z", b"FIELDS x y w", "store x y z"),
        (b"COUNT 1 1 1 1 1 1 3", b"COUNT 1 1 1 1 1 1 -3", "declares"),
    ],
)
def test_bad_headers_are_rejected(tmp_path: Path, old: bytes, new: bytes, words: str) -> None:
    data = _header("binary") + _rows().tobytes()
    assert old in data
    (tmp_path / "a.pcd").write_bytes(data.replace(old, new, 1))
    with pytest.raises(InputError, match=words):
        read_pcd(tmp_path / "a.pcd")


def test_oversized_headers_are_rejected(tmp_path: Path) -> None:
    huge = _header("binary").replace(b"WIDTH 4\nHEIGHT 3", b"WIDTH 4000\nHEIGHT 3000")
    huge = huge.replace(b"POINTS 12", b"POINTS 12000000")
    for kind in (b"binary", b"binary_compressed", b"ascii"):
        data = huge.replace(b"DATA binary", b"DATA " + kind)
        body = struct.pack("<II", 20, 12000000 * 34) + bytes(20)
        (tmp_path / "a.pcd").write_bytes(data + body)
        with pytest.raises(InputError, match="cut off"):
            read_pcd(tmp_path / "a.pcd")


def test_damaged_compressed_data_is_rejected(tmp_path: Path) -> None:
    body = bytearray(_compressed(_rows()))
    body[8] = 255  # a reference before the beginning
    (tmp_path / "a.pcd").write_bytes(_header("binary_compressed") + bytes(body))
    with pytest.raises(InputError, match="damaged"):
        read_pcd(tmp_path / "a.pcd")
    (tmp_path / "a.pcd").write_bytes(_header("binary_compressed") + bytes(body[:-9]))
    with pytest.raises(InputError, match="cut off"):
        read_pcd(tmp_path / "a.pcd")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("size", [4, 8])
def test_damaged_floats_are_dropped_without_a_warning(tmp_path: Path, size: int) -> None:
    """Numbers beyond float32, and NaN whose conversion signals."""
    good = struct.pack("<3f" if size == 4 else "<3d", 1.0, 2.0, 3.0)
    signalling = bytes([1, 0, 0, 0, 0, 0, 0xF0, 0x7F] if size == 8 else [1, 0, 0x80, 0x7F])
    huge = struct.pack("<d", 1e300) if size == 8 else struct.pack("<f", 3e38)
    zeros = bytes(2 * size)
    head = (
        "VERSION .7\nFIELDS x y z\n" + f"SIZE {size} {size} {size}\n" + "TYPE F F F\nCOUNT 1 1 1\n"
        "WIDTH 3\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA binary\n"
    )
    path = tmp_path / "a.pcd"
    path.write_bytes(head.encode() + good + signalling + zeros + huge + zeros)
    assert tofuse.open(path)[0].points.tolist() == [[1.0, 2.0, 3.0]]
