"""Calibration files of other programs, as tests write them."""

from __future__ import annotations

from pathlib import Path

OPENCV = """{{
 "image_size": [64, 48],
 "camera_matrix": [[50.0, 0, 31.0], [0, 51.0, 23.0], [0, 0, 1]],
 "dist_coeffs": [{k}]
}}"""


def written(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name
