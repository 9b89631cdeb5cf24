"""Pooling of estimates that differ by more than their noise."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.mapping.trial import pooled


def test_variance_of_equal_estimates_follows_their_spread() -> None:
    rng = np.random.default_rng(0)
    off, stated = [], []
    for _ in range(200):
        mean, deviation = pooled(rng.normal(0.3, 0.1, 12), np.ones(12))
        off.append(mean - 0.3)
        stated.append(deviation)
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(0.1 / np.sqrt(12), rel=0.15)
    covered = np.abs(off) < 1.96 * np.array(stated)
    assert 0.90 < covered.mean() <= 1.0


def test_precise_estimates_weigh_more_if_only_noise_differs() -> None:
    rng = np.random.default_rng(1)
    information = np.repeat([1.0, 400.0], 8)
    off = []
    for _ in range(100):
        mean, _ = pooled(0.2 + rng.normal(0, 1, 16) / np.sqrt(information), information)
        off.append(mean - 0.2)
    alone = 1 / np.sqrt(8 * 400)
    assert np.sqrt(np.mean(np.square(off))) < 1.5 * alone


def test_precise_estimates_do_not_weigh_more_if_estimates_truly_differ() -> None:
    """An estimate with sixty times the information is still one draw of the population."""
    rng = np.random.default_rng(2)
    information = np.array([60.0, *[1.0] * 11])
    off = [pooled(rng.normal(0.3, 0.2, 12), information)[0] - 0.3 for _ in range(100)]
    assert np.sqrt(np.mean(np.square(off))) < 0.5 * 0.2  # weighted by information: nearly 0.2


@pytest.mark.parametrize("wild", [-4.0, 50.0])
def test_outlier_hardly_changes_estimate(wild: float) -> None:
    good = np.random.default_rng(3).normal(0.3, 0.05, 11)
    mean, deviation = pooled(np.r_[good, wild], np.ones(12))
    assert mean == pytest.approx(good.mean(), abs=0.02)
    assert deviation < 0.04


def test_identical_estimates() -> None:
    assert pooled(np.full(5, 0.4), np.ones(5)) == (0.4, 0.0)
    assert pooled(np.zeros(5), np.ones(5)) == (0.0, 0.0)
    mean, deviation = pooled(np.array([0.4, 0.4, 0.4, 0.4, 0.9]), np.ones(5))
    assert 0.4 <= mean < 0.5
    assert 0 < deviation < 0.3
