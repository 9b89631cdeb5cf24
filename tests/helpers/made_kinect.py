"""Matroska recordings of an Azure Kinect, written by RFC 8794, RFC 9559 and the recorder's docs."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np

from made_phones import jpeg

# Intrinsics of a real device, relative to the size of the whole image.
DEPTH_LENS = [
    0.51296979, 0.51692354, 0.49278089, 0.49290284, 0.54793977, -0.02097137, -0.00265223,
    0.88967907, 0.08613021, -0.01391038, 0, 0, -7.21041578e-5, 2.05575342e-5,
]  # fmt: skip
COLOR_LENS = [
    0.49984714, 0.50661760, 0.47796511, 0.63742393, 0.33012130, -2.48939657, 1.45367085,
    0.20891207, -2.30291509, 1.37512755, 0, 0, -1.29445252e-4, -1.61782445e-4,
]  # fmt: skip
BASELINE = [-0.032, -0.002, 0.004]


def element(name: int, content: bytes, size: bytes | None = None) -> bytes:
    """One element; its size as eight bytes, unless the bytes are given."""
    head = name.to_bytes((name.bit_length() + 7) // 8, "big")
    return head + (size or (1 << 56 | len(content)).to_bytes(8, "big")) + content


def number(name: int, value: int) -> bytes:
    return element(name, value.to_bytes(max(1, (value.bit_length() + 7) // 8), "big"))


def text(name: int, value: str) -> bytes:
    return element(name, value.encode())


def track(
    index: int, name: str, size: tuple[int, int], fourcc: bytes, duration_ns: int = 33_333_333
) -> bytes:
    bitmap = struct.pack("<IiiHH4sI", 40, *size, 1, 16, fourcc, 0) + bytes(16)
    video = number(0xB0, size[0]) + number(0xBA, size[1])
    content = number(0xD7, index) + number(0x83, 1) + text(0x86, "V_MS/VFW/FOURCC")
    content += text(0x536E, name) + element(0x63A2, bitmap) + number(0x23E383, duration_ns)
    return element(0xAE, content + element(0xE0, video))


def block(index: int, time: int, data: bytes, *, group: bool) -> bytes:
    content = bytes([0x80 | index]) + struct.pack(">hB", time, 0x80) + data
    return element(0xA0, element(0xA1, content)) if group else element(0xA3, content)


def tag(name: str, value: str) -> bytes:
    simple = element(0x67C8, text(0x45A3, name) + text(0x4487, value))
    return element(0x7373, element(0x63C0, b"") + simple)


def calibration(model: str = "BrownConrady", radius: float = 1.74) -> dict[str, object]:
    def camera(place: str, lens: list[float], t: list[float], radius: float) -> dict[str, object]:
        return {
            "Location": f"CALIBRATION_CameraLocation{place}",
            "Intrinsics": {
                "ModelParameters": lens,
                "ModelType": f"CALIBRATION_LensDistortionModel{model}",
            },
            "MetricRadius": radius,
            "Rt": {"Rotation": np.eye(3).ravel().tolist(), "Translation": t},
        }

    cameras = [camera("D0", DEPTH_LENS, [0, 0, 0], radius), camera("PV0", COLOR_LENS, BASELINE, 0)]
    return {"CalibrationInformation": {"Cameras": cameras}}


def make_mkv(
    path: Path,
    depth: np.ndarray,
    *,
    mode: str | None = "NFOV_2X2BINNED",
    infrared: np.ndarray | None = None,
    color: np.ndarray | None = None,
    lens: dict[str, object] | None = None,
    unknown_sizes: bool = False,
    without: str = "",
) -> None:
    """Write (N, H, W) depth in counts, with one cluster per timestamp."""
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = depth.shape[1:]
    images: dict[str, list[bytes]] = {"DEPTH": [d.astype(">u2").tobytes() for d in depth]}
    tracks = [track(1, "DEPTH", (width, height), b"b16g")]
    if infrared is not None:
        images["IR"] = [i.astype(">u2").tobytes() for i in infrared]
        tracks.append(track(2, "IR", (width, height), b"b16g"))
    if color is not None:
        images["COLOR"] = [jpeg(c) for c in color]
        tracks.append(track(3, "COLOR", (color.shape[2], color.shape[1]), b"MJPG"))
    tracks = [t for t in tracks if not without or without.encode() not in t]
    open_end = b"\x01" + b"\xff" * 7 if unknown_sizes else None
    body = element(0x1549A966, number(0x2AD7B1, 1000))
    body += element(0x1654AE6B, b"".join(tracks))
    names = [("K4A_START_OFFSET_NS", "5000000000"), ("K4A_CALIBRATION_FILE", "calibration.json")]
    names += [("K4A_DEPTH_MODE", mode)] if mode else []
    body += element(0x1254C367, b"".join(tag(*pair) for pair in names))
    content = json.dumps(lens or calibration()).encode() + b"\0"
    attached = text(0x466E, "calibration.json") + element(0x465C, content)
    body += element(0x1941A469, element(0x61A7, attached)) if without != "calibration" else b""
    for k in range(len(depth)):
        blocks = number(0xE7, 33_333 * k)
        for index, name in ((1, "DEPTH"), (2, "IR"), (3, "COLOR")):
            if name in images and name != without:
                blocks += block(index, 7, images[name][k], group=bool(k % 2))
        body += element(0x1F43B675, blocks, open_end)
    head = element(0x1A45DFA3, text(0x4282, "matroska"))
    path.write_bytes(head + element(0x18538067, body, open_end))


def small_counts(count: int = 3) -> np.ndarray:
    """Depth in mm of the smallest mode."""
    return np.random.default_rng(60).integers(0, 4000, (count, 288, 320)).astype(np.uint16)


def make_small_mkv(path: Path) -> None:
    depth = small_counts(2)
    color = np.full((2, 720, 1280, 3), 90, np.uint8)
    make_mkv(path, depth, infrared=depth // 3, color=color)
