"""PCIC streams of an O3R head, in the manufacturer's layout."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np

WIDTH, HEIGHT = 24, 18
UNIT = 0.00015
RNG = np.random.default_rng(80)
COUNTS = RNG.integers(2000, 20000, (3, HEIGHT, WIDTH)).astype(np.uint16)
NOISE = RNG.integers(10, 90, (3, HEIGHT, WIDTH)).astype(np.uint16)
AMPLITUDE = RNG.integers(1, 60000, (3, HEIGHT, WIDTH)).astype(np.uint16)
FLAGS = RNG.integers(0, 128, (3, HEIGHT, WIDTH)).astype(np.uint8)
# fx, fy, mx, my, skew, then k1 to k5 (Bouguet), or k1 to k4 and the largest angle (fisheye).
BOUGUET = (20.0, 21.0, 12.25, 8.5, 0.01, 0.31, -0.14, 0.002, -0.003, 0.187)
FISHEYE = (10.5, 10.4, 12.0, 9.0, 0.0, 0.05, -0.01, 0.002, -0.0003, 1.4)


def chunk(kind: int, content: bytes, size: tuple[int, int], format_: int, k: int) -> bytes:
    about = json.dumps({"Version": "0.0.1"}).encode() + b"\0"
    head = 48 + len(about)
    times = (100 * k, k, 0, 1000, 50_000_000 * k)
    words = struct.pack("<12I", kind, head + len(content), head, 3, *size, format_, *times)
    return words + about + content


def head_info(unit: float = UNIT, model: int = 0, numbers: tuple[float, ...] = BOUGUET) -> bytes:
    """Chunk 420: metadata of a frame."""
    info = struct.pack("<I2f3f6fI32f", 1, unit, 1e-8, 1, 1, 1, *([0.0] * 6), model,
                       *numbers, *([0.0] * 22))  # fmt: skip
    return info + bytes(4 + 128)  # the inverse distortion model, which isn't used


def frame(k: int, model: int = 0, numbers: tuple[float, ...] = BOUGUET) -> bytes:
    size = (WIDTH, HEIGHT)
    data = chunk(100, COUNTS[k].astype("<u2").tobytes(), size, 2, k)
    data += chunk(105, NOISE[k].astype("<u2").tobytes(), size, 2, k)
    data += chunk(101, AMPLITUDE[k].astype("<u2").tobytes(), size, 2, k)
    data += chunk(300, FLAGS[k].tobytes(), size, 0, k)
    data += chunk(420, head_info(model=model, numbers=numbers), size, 0, k)
    return b"0000L%09d\r\n0000star" % (len(data) + 14) + data + b"stop\r\n"


def make_h5(path: Path, *, model: int = 0, heads: int = 1) -> None:
    """As the manufacturer's recorder writes it: one record per frame."""
    import h5py

    path.parent.mkdir(parents=True, exist_ok=True)
    size = (HEIGHT, WIDTH)
    images = ("distance", "distanceNoise", "amplitude", "confidence")
    dtype = [("_data_timestamp", "<u8"), *((name, "<u2", size) for name in images)]
    dtype += [("width", "<u2"), ("height", "<u2"), ("distanceResolution", "<f4")]
    dtype += [("timestamp_ns", "<u8", (3,)), ("intrinsicCalibModelID", "<u4")]
    dtype += [("intrinsicCalibModelParameters", "<f4", (32,))]
    rows = np.zeros(3, dtype)
    rows["distance"], rows["distanceNoise"], rows["amplitude"] = COUNTS, NOISE, AMPLITUDE
    rows["confidence"], rows["distanceResolution"] = FLAGS, UNIT
    rows["timestamp_ns"] = 1_700_000_000_000_000_000 + 50_000_000 * np.arange(3)[:, None]
    rows["intrinsicCalibModelID"] = model
    numbers = BOUGUET if model == 0 else FISHEYE
    rows["intrinsicCalibModelParameters"][:, : len(numbers)] = numbers
    with h5py.File(path, "w") as file:
        for head in range(heads):
            file.create_group("streams") if not head else None
            file["streams"].create_dataset(f"o3r_tof_{head}", data=rows, chunks=(1,))
            rows["distance"] //= 2


def make_o3r(path: Path, model: int = 0, numbers: tuple[float, ...] = BOUGUET) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(frame(k, model, numbers) for k in range(3)))
