"""Wrapped pixels are excluded from the model; dark and near ones are kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import SATURATED_AMPLITUDE, RangeFrame
from tofuse.engine.sensor.wrapped import Wrapped

PERIOD = 5.0
CAMERA = Pinhole(176, 144, 229.0, 229.0, 87.5, 71.5)


def image(radial: np.ndarray, albedo: np.ndarray | float) -> RangeFrame:
    """Measurement of surfaces at these ranges (H, W) by a camera with this period."""
    light = 3000.0 * albedo / radial**2
    return RangeFrame(
        0,
        0.0,
        CAMERA,
        np.mod(radial, PERIOD).astype(np.float32),
        "range",
        np.broadcast_to(light, radial.shape).astype(np.float32),
        amplitude_kind="raw",
        ambiguity_m=PERIOD,
    )


def corridor(length: float) -> np.ndarray:
    """(H, W) ranges in a corridor 3 m wide and 2.4 m high, its end so far away."""
    x, y = np.moveaxis(CAMERA.rays().astype(float), -1, 0)
    with np.errstate(divide="ignore"):
        z = np.minimum(1.5 / np.abs(x), 1.2 / np.abs(y))
    return np.minimum(z, length) * np.sqrt(1 + x * x + y * y)


def test_wrapped_pixels_are_removed() -> None:
    radial = corridor(6.2)
    rng = np.random.default_rng(1)
    noisy = radial + rng.normal(0, 0.01, radial.shape)
    keep = Wrapped().mask(image(noisy, rng.uniform(0.4, 0.6, radial.shape)), ())
    assert (radial > PERIOD).mean() > 0.2
    assert not keep[radial > PERIOD + 0.05].any()
    assert keep[radial < PERIOD - 0.05].mean() > 0.999


@pytest.mark.parametrize("amplitude", [0.0, SATURATED_AMPLITUDE])
def test_pixels_without_an_amplitude_are_not_dark(amplitude: float) -> None:
    """Next to wrapped ones, a sign or a lamp that saturates, and pixels of unknown amplitude."""
    radial = corridor(6.2)
    frame = image(radial, 0.5)
    light = frame.amplitude_image.copy()
    light[130:140, 60:90] = amplitude
    keep = Wrapped().mask(replace(frame, amplitude_image=light), ())
    assert not keep[radial > PERIOD + 0.05].any()
    assert keep[130:140, 60:90].all()


@pytest.mark.parametrize("albedo", [0.04, 0.08])
def test_dark_surfaces_within_period_are_kept(albedo: float) -> None:
    radial = corridor(4.5)
    albedos = np.full(radial.shape, 0.6)
    albedos[80:] = albedo  # a dark floor
    albedos[50:80, 60:90] = albedo
    assert Wrapped().mask(image(radial, albedos), ()).all()
