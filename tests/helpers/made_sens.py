"""A .sens file, written by the layout of ScanNet's SensorData (version 4)."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT = 40, 30
COLOR_WIDTH, COLOR_HEIGHT = 80, 60
RNG = np.random.default_rng(90)
DEPTH = (RNG.integers(0, 9, (3, HEIGHT, WIDTH)) + 1500 + 5 * np.arange(WIDTH)).astype(np.uint16)
DEPTH[1, 4, 5] = 0
COLORS = np.array([[200, 30, 20], [20, 190, 40], [30, 40, 210]], np.uint8)
BASELINE_M = 0.05


def lens(fx: float, cx: float, cy: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[0, 0] = matrix[1, 1] = fx
    matrix[0, 2], matrix[1, 2] = cx, cy
    return matrix


def pose(k: int) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = (0.1 * k, 0.0, 0.02)
    return T


def make_sens(path: Path, *, depth: str = "zlib", color: str = "jpeg") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    name = b"StructureSensor"
    place = np.eye(4)
    place[0, 3] = BASELINE_M  # the colour camera is to the right
    data = struct.pack("<IQ", 4, len(name)) + name
    for matrix in (lens(70.0, 39.5, 29.5), place, lens(35.0, 19.5, 14.5), np.eye(4)):
        data += matrix.astype("<f4").tobytes()
    codes = {"raw": 0, "png": 1, "jpeg": 2}[color], {"raw": 0, "zlib": 1, "occi": 2}[depth]
    data += struct.pack("<2i4IfQ", *codes, COLOR_WIDTH, COLOR_HEIGHT, WIDTH, HEIGHT, 1000.0, 3)
    for k in range(3):
        T = np.full((4, 4), -np.inf) if k == 1 else pose(k)  # as the format marks lost frames
        image = np.empty((COLOR_HEIGHT, COLOR_WIDTH, 3), np.uint8)
        image[:] = COLORS[k]
        packed = image.tobytes()
        if color != "raw":
            packed = cv2.imencode(f".{color}", image[..., ::-1])[1].tobytes()
        counts = DEPTH[k].astype("<u2").tobytes()
        counts = zlib.compress(counts) if depth == "zlib" else counts
        data += T.astype("<f4").tobytes()
        data += struct.pack("<4Q", 33_333 * k, 33_333 * k + 10, len(packed), len(counts))
        data += packed + counts
    path.write_bytes(data + struct.pack("<Q", 0))  # no IMU data


def make_scannet(folder: Path) -> None:
    """The same recording, as ScanNet's tools export it."""
    for name in ("depth", "color", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    place = np.eye(4)
    place[0, 3] = BASELINE_M
    np.savetxt(folder / "intrinsic" / "intrinsic_depth.txt", lens(35.0, 19.5, 14.5))
    np.savetxt(folder / "intrinsic" / "extrinsic_depth.txt", np.eye(4))
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", lens(70.0, 39.5, 29.5))
    np.savetxt(folder / "intrinsic" / "extrinsic_color.txt", place)
    for k in range(3):
        image = np.full((COLOR_HEIGHT, COLOR_WIDTH, 3), COLORS[k])
        cv2.imwrite(str(folder / "depth" / f"{k}.png"), DEPTH[k])
        cv2.imwrite(str(folder / "color" / f"{k}.jpg"), image[..., ::-1])
        T = np.full((4, 4), -np.inf) if k == 1 else pose(k)
        np.savetxt(folder / "pose" / f"{k}.txt", T)
