"""Small recordings as NumPy archives and Pico Zense folders."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.engine.geometry.se3 import exp
from tofuse.formats.images.images import write_png

RNG = np.random.default_rng(90)
COUNTS = RNG.integers(300, 5000, (3, 12, 16)).astype(np.uint16)
COUNTS[:, 0, 0] = 0
COUNTS[:, 0, 1] = 65535
K = np.array([[20.0, 0, 7.5], [0, 21.0, 5.5], [0, 0, 1]])
POSES = exp(RNG.normal(size=(3, 6)))


def arrays(**changes: Any) -> dict[str, Any]:
    rng = copy.deepcopy(RNG)  # the same in every test
    out: dict[str, Any] = {
        "depth": COUNTS,
        "depth_unit_m": 0.001,
        "depth_kind": "range",
        "K": K,
        "distortion": np.array([0.1, -0.05]),
        "timestamps": np.array([5.0, 5.1, 5.3]),
        "amplitude": rng.uniform(1, 100, COUNTS.shape).astype(np.float32),
        "confidence": rng.integers(0, 8, COUNTS.shape).astype(np.uint8),
        "sigma": rng.uniform(0.001, 0.1, COUNTS.shape),
        "color": rng.integers(0, 256, (*COUNTS.shape, 3)).astype(np.uint8),
        "reference": POSES,
        "odometry": POSES,
        "sensor": "My camera (ToF)",
        "confidence_max": 7,
        "ambiguity_m": 7.5,
    }
    return {name: value for name, value in (out | changes).items() if value is not None}


def make_npz(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **arrays())


def make_zense(folder: Path) -> None:
    folder.mkdir(parents=True)
    for k in range(3):
        write_png(folder / f"depth_{k:04d}.png", COUNTS[k])
    (folder / "camera.toml").write_text(
        "[Camera]\nimage_width = 16\nimage_height = 12\ncapture_fps = 15\n\n"
        "[Debug]\ncamera_fx = 20.0\ncamera_fy = 21.0\ncamera_cx = 7.5\ncamera_cy = 5.5\n"
    )
