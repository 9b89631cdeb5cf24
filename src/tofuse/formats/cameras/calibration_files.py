"""The correction.npz of a recording, and its application to depth images."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Float32
from tofuse.engine.cameras import Camera, depth_conversion
from tofuse.engine.errors import InputError
from tofuse.engine.frames import DepthKind
from tofuse.engine.noise import NoiseModel
from tofuse.engine.sensor import DepthCorrection
from tofuse.formats.files import atomic, npz, reading

_MAX_BYTES = 1 << 30


KEYS = ("range_m", "bias_m", "pixel_bias_m")


def write_correction(path: str | Path, correction: DepthCorrection) -> None:
    """Write an .npz with the keys range_m, bias_m and, where known, pixel_bias_m."""
    arrays: dict[str, NDArray[np.floating]] = {
        "range_m": correction.range_m,
        "bias_m": correction.bias_m,
    }
    if correction.pixel_bias_m is not None:
        arrays["pixel_bias_m"] = correction.pixel_bias_m
    with atomic.replacing(path) as part, part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def read_correction(path: str | Path) -> DepthCorrection:
    """Read what `write_correction` writes; InputError if it is invalid or absurdly large."""
    with reading.named(path, "write it again, or delete it to go without"):
        arrays = npz.read_npz(path, limit=_MAX_BYTES, names=frozenset(KEYS))
    for key in KEYS[:2]:
        if key not in arrays:
            raise InputError(f"has no {key}", where=path, remedy=f"use the keys {list(KEYS)}")
    with reading.named(path):
        return DepthCorrection(arrays["range_m"], arrays["bias_m"], arrays.get("pixel_bias_m"))


def corrected_depth(
    correction: DepthCorrection, camera: Camera, depth: Float32, kind: DepthKind
) -> Float32:
    """Return depth (H, W) in m of the given kind, after correction of its radial range."""
    if kind == "range":
        return correction.correct(depth)
    return depth_conversion.z_from_range(
        camera, correction.correct(depth_conversion.range_from_z(camera, depth))
    )


def write_noise(path: str | Path, model: NoiseModel) -> None:
    """Write a noise.json; raise OutputError if that's impossible."""
    atomic.write_text(path, json.dumps(model.to_dict(), indent=1) + "\n")


def read_noise(path: str | Path) -> NoiseModel:
    """Read a noise.json; raise InputError if it can't be read, or is invalid."""
    return NoiseModel.from_dict(reading.read_json(path), where=str(path))
