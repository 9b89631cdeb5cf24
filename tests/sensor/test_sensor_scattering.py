"""Lens scattering: its removal, and its estimation from motion in front of a static background."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.sensor.scattering import Scattering, blur, estimate_fractions

ROWS, COLUMNS = 60, 88
V, U = np.mgrid[:ROWS, :COLUMNS]
WIDTHS = (0.05, 0.25)


def slowly_blurred(image: np.ndarray, width: float) -> np.ndarray:
    """The sum over all pixels of a Gaussian, without a coarse grid."""
    sigma = width * COLUMNS
    g_rows = np.exp(-0.5 * (np.subtract.outer(np.arange(ROWS), np.arange(ROWS)) / sigma) ** 2)
    g_cols = np.exp(-0.5 * (np.subtract.outer(np.arange(COLUMNS), np.arange(COLUMNS)) / sigma) ** 2)
    return g_rows @ image @ g_cols / (2 * np.pi * sigma**2)


def own_light(k: int = 0) -> np.ndarray:
    """A bright disc at phase 1 that moves before a dim wall at phase 3, with texture."""
    rng = np.random.default_rng(5)
    wall = (20 + 8 * rng.random((ROWS, COLUMNS))) * np.exp(3j)
    disc = (V - 30) ** 2 + (U - 44 - 8 * np.sin(k)) ** 2 < 150
    return np.where(disc, (400 + 100 * np.cos(1.7 * k)) * np.exp(1j), wall)


def measured(own: np.ndarray, fractions: tuple[float, ...]) -> np.ndarray:
    parts = (s * slowly_blurred(own, w) for w, s in zip(WIDTHS, fractions, strict=True))
    return own + sum(parts)


def frames(fractions: tuple[float, ...], sigma: float, count: int = 14) -> np.ndarray:
    noise = np.random.default_rng(1).normal(0, sigma, (2, count, ROWS, COLUMNS))
    clean = np.stack([measured(own_light(k), fractions) for k in range(count)])
    return clean + noise[0] + 1j * noise[1]


SOURCE = ((V - 30) ** 2 < 200) & ((U - 44) ** 2 < 26**2)
STILL = ~(((V - 30) ** 2 < 300) & ((U - 44) ** 2 < 30**2))


@pytest.mark.parametrize("width", [0.04, 0.1, 0.3])
def test_coarse_blur_matches_exact_blur(width: float) -> None:
    light = own_light()
    expected = slowly_blurred(light, width)
    off = np.abs(blur(light, width) - expected)
    assert off.max() < 0.04 * np.abs(expected).max()
    assert off.mean() < 0.01 * np.abs(expected).mean()


def test_scattered_light_is_removed() -> None:
    own = own_light()
    light = measured(own, (0.03, 0.04))
    before = np.abs(np.angle(light * own.conj()))
    after = np.abs(np.angle(Scattering(WIDTHS, (0.03, 0.04)).without_scatter(light) * own.conj()))
    wall = np.abs(own) < 100
    assert np.median(before[wall]) > 0.04
    assert np.median(after[wall]) < 0.03 * np.median(before[wall])


def test_fractions_are_estimated_from_moving_light() -> None:
    fractions = estimate_fractions(frames((0.012, 0.02), 0.5), SOURCE, STILL, WIDTHS)
    assert fractions == pytest.approx((0.012, 0.02), rel=0.1)


def test_a_fraction_that_would_be_negative_leaves_the_others_the_best() -> None:
    """They are those of an estimate without it."""
    light = frames((-0.003, 0.02), 0.5)
    narrow, wide = estimate_fractions(light, SOURCE, STILL, WIDTHS)
    assert narrow == 0
    assert wide == pytest.approx(estimate_fractions(light, SOURCE, STILL, WIDTHS[1:])[0], rel=1e-6)


def test_exposure_and_temperature_are_not_scattering() -> None:
    light = frames((0.012, 0.02), 0.5)
    rng = np.random.default_rng(8)
    changes = (1 + 0.1 * rng.normal(size=len(light))) * np.exp(0.02j * rng.normal(size=len(light)))
    fractions = estimate_fractions(light * changes[:, None, None], SOURCE, STILL, WIDTHS)
    assert fractions == pytest.approx((0.012, 0.02), rel=0.2)


def test_fractions_are_zero_without_evidence() -> None:
    assert not estimate_fractions(frames((0.0, 0.0), 0.5), SOURCE, STILL, WIDTHS).any()
    light = frames((0.012, 0.02), 0.5)
    assert not estimate_fractions(light, SOURCE, STILL & (U < 3), WIDTHS).any()  # too few pixels
    assert not estimate_fractions(light[:2], SOURCE, STILL, WIDTHS).any()
    assert not estimate_fractions(light, np.zeros_like(SOURCE), STILL, WIDTHS).any()
    # Scattering below the noise.
    assert not estimate_fractions(frames((0.0002, 0.0), 20.0), SOURCE, STILL, WIDTHS).any()
    # Too large: a third of the light is not scattered in a lens.
    assert not estimate_fractions(frames((0.3, 0.1), 0.5), SOURCE, STILL, WIDTHS).any()
