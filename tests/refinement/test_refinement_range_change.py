"""Cameras whose range changes, and cameras that don't."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aligned_surfaces import OPTIONS, path, surfaces
from corner_views import SHARP, corner
from tofuse.engine.geometry import se3
from tofuse.engine.refinement.calibration_check import (
    CalibrationCheck,
    check_calibration,
    combine_checks,
)
from tofuse.engine.refinement.camera_response import Response
from tofuse.engine.refinement.joint_alignment import RefinedViews, refine
from tofuse.engine.refinement.range_change import RangeChange
from tofuse.engine.stored_views.view_store import SampledView
from tofuse.engine.views.prepared_view import prepare_view

VIEWS = 24


@pytest.fixture(scope="module")
def right() -> list[SampledView]:
    return [SampledView.of(s, 1500) for s in surfaces(path(VIEWS), noise=0.003)]


def checked(views: list[SampledView], factors: np.ndarray, recordings: int = 1) -> CalibrationCheck:
    """Check views whose depth is scaled, of recordings that are joined."""
    scaled = [
        replace(view.scaled(factor), recording=k * recordings // VIEWS)
        for k, (view, factor) in enumerate(zip(views, factors, strict=True))
    ]
    refined = refine(scaled, path(VIEWS), OPTIONS)
    return check_calibration(RefinedViews(scaled, refined, OPTIONS))


@pytest.mark.parametrize(("factor", "start"), [(1.04, 12), (0.97, 15)])
def test_step_of_range_is_found(right: list[SampledView], factor: float, start: int) -> None:
    check = checked(right, np.where(np.arange(VIEWS) >= start, factor, 1.0))
    found = check.range_change
    assert found is not None
    assert found.change == pytest.approx(factor - 1, abs=0.003)
    assert found.frame == start
    assert found.in_words() == f"changes by {100 * found.change:+.1f} % at about frame {start}"
    # What such views say about the calibration is void.
    assert not check.alarm
    assert not check.errors


def test_drift_of_range_is_found(right: list[SampledView]) -> None:
    found = checked(right, np.linspace(1.0, 1.08, VIEWS)).range_change
    assert found is not None
    assert found.frame is None
    assert found.change == pytest.approx(0.08, abs=0.01)
    assert "drifts" in found.in_words()


def warmed(at_start: float, drift: float) -> CalibrationCheck:
    """Check views whose range grows by a distance, m."""
    offsets = at_start + np.linspace(0.0, drift, VIEWS)
    farther = surfaces(path(VIEWS), noise=0.02, bias=offsets[:, None, None])
    views = [SampledView.of(surface, 1500) for surface in farther]
    return check_calibration(RefinedViews(views, refine(views, path(VIEWS), OPTIONS), OPTIONS))


@pytest.mark.parametrize("at_start", [0.0, 0.03])
def test_warming_up_is_found(at_start: float) -> None:
    """Also if an offset, which the views show too, explains the mean of the drift."""
    check = warmed(at_start, 0.1)
    found = check.range_change
    assert found is not None
    assert found.frame is None
    assert found.in_metres
    assert found.change == pytest.approx(0.1, rel=0.3)
    assert "drifts by about" in found.in_words()
    assert not check.alarm


def test_warming_up_that_may_be_chance_counts_in_the_accuracy() -> None:
    check = warmed(0.0, 0.03)
    assert check.range_change is None
    assert check.changed[0] > 0.004
    assert not check.change_confirmed
    assert warmed(0.0, 0.0).changed == (0.0, 0.0)


@pytest.mark.parametrize("scales", [(1.0, 1.03), (1.03, 1.0)])
def test_recording_of_another_scale_is_found(right: list[SampledView], scales) -> None:
    found = checked(right, np.repeat(scales, VIEWS // 2), recordings=2).range_change
    assert found is not None
    assert found.change == pytest.approx(scales[1] / scales[0] - 1, abs=0.003)
    by = f"{100 * found.change:+.1f} %"
    assert (
        found.in_words() == f"differs by {by} in frames 12 to 23 from that of the first recording"
    )


def test_only_the_recording_between_others_differs(right: list[SampledView]) -> None:
    factors = np.repeat([1.0, 1.03, 1.0], VIEWS // 3)
    assert checked(right, factors).changed[0] == 0  # neither a step nor a drift
    assert checked(right, factors, recordings=3).changed[0] > 0.01


def test_drift_of_one_recording_is_found(right: list[SampledView]) -> None:
    factors = np.append(np.linspace(1.0, 1.06, VIEWS // 2), np.ones(VIEWS // 2))
    found = checked(right, factors, recordings=2).range_change
    assert found is not None
    assert found.change == pytest.approx(0.06, abs=0.01)
    assert f"drifts by {100 * found.change:+.1f} % over frames 0 to 11" == found.in_words()


def test_trend_over_recordings_is_no_drift(right: list[SampledView]) -> None:
    """They have no order in time."""
    factors = np.repeat([0.988, 0.994, 1.0, 1.006, 1.012, 1.018], VIEWS // 6)
    assert "drifts" in checked(right, factors).range_change.in_words()
    assert checked(right, factors, recordings=6).range_change is None
    assert checked(right, np.ones(VIEWS), recordings=6).changed[0] == 0


def test_errors_that_differ_from_room_to_room_are_no_change(right: list[SampledView]) -> None:
    check = checked(right, np.repeat([1.0, 1.01, 1.03, 1.02], VIEWS // 4))
    assert check.range_change is None
    # Poses follow nevertheless: a part of that counts.
    assert check.changed[0] > 0
    assert not check.change_confirmed


def test_error_of_the_camera_that_differs_over_the_image_is_no_change() -> None:
    # Whatever enters the view on one side, leaves it on the other: steady motion, steady drift.
    angles = np.linspace(-0.45, 0.45, VIEWS)
    poses = se3.exp(np.outer(angles, np.eye(6)[4]))
    y, x = np.meshgrid(np.linspace(-1, 1, 48), np.linspace(-1, 1, 60), indexing="ij")
    twisted = (1 + 0.04 * x * y).astype(np.float32)
    noise = 0.003 * np.random.default_rng(3).standard_normal((VIEWS, 48, 60), np.float32)
    views = []
    for k, T in enumerate(poses):
        frame = corner(T)
        depth = np.where(frame.depth < 15, frame.depth, 0) * twisted + noise[k]
        views.append(prepare_view(replace(frame, index=k, depth=depth), SHARP))
    sampled = [SampledView.of(view, 1500) for view in views]
    check = check_calibration(RefinedViews(sampled, refine(sampled, poses, OPTIONS), OPTIONS))
    assert check.range_change is None
    # Poses follow it nevertheless; whether successive views differ enough to confirm it, is chance.
    assert check.changed[0] > 0.004


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_sigma_of_serial_errors(correlation: float) -> None:
    # Any two views that share a pair have its error: there are two equal series.
    count, draws = 100, 300
    e = np.random.default_rng(0).normal(size=(count, draws))
    for k in range(1, count):
        e[k] += correlation * e[k - 1]
    pairs = np.stack([np.arange(count), count + np.arange(count)], 1)
    response = Response(e, np.ones_like(e), np.zeros((draws, 2 * count, 6)))
    sigma, independent = response.serial(pairs, 2 * count)
    plain = response.sigma(pairs, 2 * count)
    # The sandwich estimator counts each pair twice.
    actual = np.sqrt(2) * response.estimate().std()
    assert 0.6 < np.median(sigma) / actual < 1.15
    if correlation:
        assert np.median(plain) < 0.4 * actual
        assert np.median(independent) < 0.3 * 2 * count
    else:
        assert np.median(sigma / plain) == pytest.approx(1, abs=0.1)
        assert np.median(independent) == pytest.approx(2 * count, rel=0.3)


@pytest.mark.parametrize("factor", [1.0, 1.1])
def test_constant_scale_is_no_change(right: list[SampledView], factor: float) -> None:
    scaled = [view.scaled(factor) for view in right]
    poses = path(VIEWS)
    poses[:, :3, 3] *= factor
    refined = refine(scaled, poses, OPTIONS)
    assert check_calibration(RefinedViews(scaled, refined, OPTIONS)).range_change is None


def test_change_of_one_submap_is_that_of_the_recording() -> None:
    small, large = (
        CalibrationCheck(range_change=RangeChange(c, 0.001, 7, 5.0)) for c in (0.02, -0.05)
    )
    assert combine_checks([CalibrationCheck(), small, large]) is large
    assert combine_checks([CalibrationCheck(), CalibrationCheck()]).range_change is None
