"""Conversion of makers' lens models."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tofuse.engine.cameras import DISTORTION_ORDER, MODELS, BrownConrady, Pinhole, RayTable
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import homogeneous
from tofuse.formats.cameras.camera_file import checked_lens


def inverse_brown(lens: BrownConrady) -> RayTable:
    """Return librealsense's "inverse Brown-Conrady" camera: `lens` maps its pixels to rays."""
    focal, centre = np.array([lens.fx, lens.fy]), np.array([lens.cx, lens.cy])
    v, u = np.mgrid[: lens.height, : lens.width]
    slopes = (np.stack([u, v], axis=-1) - centre) / focal
    points = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
    return RayTable(((lens.project(points) - centre) / focal).astype(np.float32))


def forward_brown(table: RayTable, lens: BrownConrady) -> BrownConrady:
    """Return the Brown-Conrady lens that is equivalent to `inverse_brown(lens)`, which is `table`.

    Focal lengths and centre are those of `lens`; the coefficients are fitted to the table's rays.

    Raises
    ------
    InputError
        If the error of the fit exceeds half a pixel anywhere.
    """
    focal, centre = np.array([lens.fx, lens.fy]), np.array([lens.cx, lens.cy])
    step = max(1, lens.width // 64)
    rays = table.rays()[::step, ::step].reshape(-1, 2).astype(float)
    v, u = np.mgrid[: lens.height : step, : lens.width : step]
    slopes = (np.stack([u, v], axis=-1).reshape(-1, 2) - centre) / focal
    known = np.isfinite(rays).all(-1)
    rays, slopes = rays[known], slopes[known]
    x, y = rays.T
    r2 = x * x + y * y
    radial = np.stack([r2, r2**2, r2**3], axis=-1)
    tangential = np.stack(
        [
            np.stack([2 * x * y, r2 + 2 * x * x], axis=-1),
            np.stack([r2 + 2 * y * y, 2 * x * y], axis=-1),
        ]
    )
    rows = np.concatenate(
        [
            np.concatenate([rays[:, axis : axis + 1] * radial, tangential[axis]], axis=-1)
            for axis in (0, 1)
        ]
    )
    k1, k2, k3, p1, p2 = np.linalg.lstsq(rows, (slopes - rays).T.ravel(), rcond=None)[0]
    fitted = replace(lens, k1=float(k1), k2=float(k2), k3=float(k3), p1=float(p1), p2=float(p2))
    if not np.abs(fitted.project(homogeneous(rays)) - slopes * focal - centre).max() < 0.5:
        raise InputError("has too much distortion to be inverted", where="lens")
    return fitted


def simplest_lens(
    size: tuple[int, int], values: dict[str, float], k: dict[str, float], where: str
) -> Pinhole:
    """Return the simplest lens with these coefficients: pinhole, Brown-Conrady or rational.

    Parameters
    ----------
    size
        Width and height in pixels.
    values, k
        Focal lengths and centre in pixels, and the coefficients of the rational model, by name.
    where
        For errors, see `checked_lens`.
    """
    brown = DISTORTION_ORDER["brown"]
    name = "pinhole"
    if any(value for key, value in k.items() if key not in brown):
        name = "rational"
    elif any(k.values()):
        name = "brown"
    coefficients = {key: k[key] for key in DISTORTION_ORDER[name]}
    return checked_lens(MODELS[name], size, values | coefficients, where)
