"""The typical quality of fit of a camera's views."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.alignment.projective import Aligned
from tofuse.engine.search.verification import FitStatistics, comparable, usual_tolerances


def aligned(outliers=0.1, in_front=0.01, noise=2.0, albedo=0.04, compared=2000, rms_m=0.01):
    """An alignment with these fractions of outliers and of free-space violations."""
    return Aligned(
        np.eye(4),
        True,
        5,
        np.eye(6),
        np.eye(6),
        np.zeros((0, 6)),
        compared,
        compared,
        compared,
        round((1 - outliers) * compared),
        round(in_front * compared),
        rms_m,
        min(noise, 3.0),
        albedo,
        0.8,
        photometric=albedo > 0,
        noise_scale=noise,
    )


def taught(count=60, seed=0, spread=0.15, **usual):
    """Usual fit of a camera whose views have these statistics, with some spread."""
    rng = np.random.default_rng(seed)
    known = FitStatistics()
    for _ in range(count):
        several = {
            name: value * np.exp(spread * rng.standard_normal()) for name, value in usual.items()
        }
        known.learn(aligned(**several), 2.0)
    return known


# Usual fit of a camera's views


@pytest.mark.parametrize(
    "fit",
    [
        {},
        {"outliers": 0.0, "in_front": 0.0, "noise": 0.5, "albedo": 0.005},
        {"outliers": 0.35},
        {"in_front": 0.08},
        {"noise": 30.0},
        {"albedo": 0.1},
        {"albedo": 0.0},
    ],
)
def test_unknown_camera_tolerates_moderate_fits(fit):
    found = FitStatistics().assess(aligned(**fit))
    assert found.is_usual
    assert found.excess == 0
    assert found.reason == ""


@pytest.mark.parametrize(
    ("fit", "words"),
    [
        ({"outliers": 0.8}, "80 % outliers, usually"),
        ({"in_front": 0.5}, "50 % free-space violations, usually"),
        ({"noise": 10000.0}, "noise 2500.0 times as large as usual"),
        ({"albedo": 3.0}, "albedo differences 60.0 times as large as usual"),
    ],
)
def test_unknown_camera_rejects_extreme_fits(fit, words):
    found = FitStatistics().assess(aligned(**fit))
    assert not found.is_usual
    assert words in found.reason
    assert 0 < found.excess < np.inf


def test_too_few_inliers_determine_no_pose():
    found = FitStatistics().assess(aligned(compared=30, outliers=0.0))
    assert not found.is_usual
    assert "30 inliers are too few" in found.reason
    assert found.excess == np.inf
    assert FitStatistics().assess(aligned(compared=100, outliers=0.0)).is_usual


def test_usual_fit_is_learned_per_camera():
    """A third of outliers is usual for one camera, and unusual for another."""
    many, few = taught(outliers=0.3), taught(outliers=0.03)
    third = aligned(outliers=0.3)
    assert many.assess(third).is_usual
    assert not few.assess(third).is_usual
    assert "30 % outliers, usually" in few.assess(third).reason
    for known in (many, few):
        assert known.assess(aligned(outliers=0.03)).is_usual
        assert not known.assess(aligned(outliers=0.85)).is_usual


@pytest.mark.parametrize(
    ("usual", "twice", "far"),
    [
        ({"in_front": 0.01}, {"in_front": 0.02}, {"in_front": 0.3}),
        ({"noise": 2.0}, {"noise": 4.0}, {"noise": 40.0}),
        ({"albedo": 0.05}, {"albedo": 0.1}, {"albedo": 1.0}),
    ],
)
def test_each_statistic_has_its_own_range(usual, twice, far):
    known = taught(**usual)
    assert known.assess(aligned(**twice)).is_usual
    assert not known.assess(aligned(**far)).is_usual


def test_few_outlier_views_do_not_change_usual_fit():
    """Location and spread are medians."""
    known = taught(outliers=0.05)
    for _ in range(15):
        known.learn(aligned(outliers=0.7), 2.0)
    assert not known.assess(aligned(outliers=0.7)).is_usual
    # The order is irrelevant.
    other = FitStatistics()
    for _ in range(15):
        other.learn(aligned(outliers=0.7), 2.0)
    assert not all(other.assess(aligned(outliers=x)).is_usual for x in (0.05, 0.9))


def test_noise_scale_is_learned_from_alignments():
    known = FitStatistics()
    assert known.noise_scale == 0
    assert known.rms_fraction == 0
    known.learn(aligned(noise=8.0), 2.0)
    assert known.noise_scale == 0
    known = taught(150, noise=8.0, spread=0.1)
    assert known.noise_scale == pytest.approx(8.0, rel=0.1)
    assert known.rms_fraction == pytest.approx(0.005)
    # Statistics that cannot be measured are not learned.
    for noise in (0.0, np.inf):
        known.learn(aligned(noise=noise, rms_m=np.inf), 2.0)
    assert known.noise_scale == pytest.approx(8.0, rel=0.1)
    assert known.rms_fraction == pytest.approx(0.005)


def test_tolerance_of_agreement_follows_rms_of_camera():
    fine, coarse = usual_tolerances(FitStatistics()), FitStatistics()
    for _ in range(10):
        coarse.learn(aligned(rms_m=0.1), 2.0)
    assert usual_tolerances(coarse).floor_fraction == pytest.approx(0.1)
    assert usual_tolerances(coarse).floor_fraction > fine.floor_fraction


def test_views_of_different_scale_are_not_comparable():
    assert comparable(2.0, 2.0)
    assert comparable(2.0, 5.0)
    assert not comparable(2.0, 20.0)
    assert not comparable(20.0, 2.0)
