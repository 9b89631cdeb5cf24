"""Frames as the SDKs of Arducam and Analog Devices save them, by their published sources."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from made_phones import DEPTH, HEIGHT, WIDTH
from tofuse.engine.cameras.cameras import Pinhole, Rational
from tofuse.engine.geometry.rays import homogeneous
from written import camera_json


def make_arducam(folder: Path) -> None:
    """What Arducam's C++ example saves by the key s: depth in mm, confidence a few ms later."""
    folder.mkdir(parents=True)
    for k in range(3):
        depth = (1000 * DEPTH[k]).astype("<f4")
        depth[0, :4] = (np.nan, np.inf, -5, 1e38)
        depth.view("<u4")[0, 0] = 0x7FA00000  # a signalling NaN
        time = 1_700_000_000_000 + 100 * k
        size = f"{WIDTH}_{HEIGHT}_f32"
        (folder / f"depth_{size}_{time}.raw").write_bytes(depth.tobytes())
        confidence = np.full((HEIGHT, WIDTH), 40.0 + k, "<f4")
        confidence[1, :3] = (np.nan, 300, -1)
        (folder / f"confidence_{size}_{time + 3}.raw").write_bytes(confidence.tobytes())
    camera_json(folder / "camera.json", Pinhole(WIDTH, HEIGHT, 30.0, 30.5, 15.5, 11.5))


# Of an ADTF3175 at 512 x 512, of which the frames are a part.
ADI_LENS = Rational(
    64, 48, 47.0, 47.2, 31.1, 23.4, 0.35, -0.12, 0.0007, -0.0004, 0.05, 0.6, -0.2, 0.01
)


def adi_frame(
    k: int,
    *,
    points: bool = True,
    confidence: bool = True,
    stated: bool = True,
    clock: bool = True,
    lens: Rational = ADI_LENS,
) -> bytes:
    """A frame as FrameHandler of Analog Devices' ToF SDK saves it, of a slanted wall."""
    rays = homogeneous(lens.rays())
    z = (1.8 + 0.1 * k) / (1 + 0.3 * rays[..., 0] + 0.1 * rays[..., 1])
    depth = np.rint(1000 * z * np.linalg.norm(rays, axis=-1))
    depth[2:5, 2:9] = 0
    xyz = rays / np.linalg.norm(rays, axis=-1, keepdims=True) * depth[..., None]
    time = (77, 5000 * k, 1_700_000_000, 250_000 * k) if clock else (0, 0, 0, 0)
    head = struct.pack(
        "<2H4BH2BI4B2I2i4Q", lens.width, lens.height, 7, 16, 16, 8 * confidence, 0, 0, 3, k, 3, 9,
        3, points and stated, 0, 0, 30, 31, *time,
    )  # fmt: skip
    data = head.ljust(128, b"\0") + depth.astype("<u2").tobytes()
    data += (depth // 3).astype("<u2").tobytes()
    if confidence:
        data += np.full(depth.shape, 0.5, "<f4").tobytes()
    if points:
        data += np.floor(xyz + 0.5).astype("<i2").tobytes()
    return data


def make_aditof(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(adi_frame(k) for k in range(3)))
