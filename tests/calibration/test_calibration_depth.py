"""Depth errors from planes: synthetic, simulated and real."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cli_calls import printed, refuses
from refused import refused
from tofuse.apps.calibration.board import Board
from tofuse.apps.calibration.depth import DepthFit, calibrate_depth
from tofuse.apps.calibration.plane_views import PlaneView, board_planes, scene_planes
from tofuse.apps.cli.program import main
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.recording import Recording
from tofuse.engine.geometry.rays import unit_rays
from tofuse.formats.cameras.calibration_files import read_correction
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.scenes import checkerboard
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import camera_model
from tofuse.lab.simulation.record import simulate_recording
from tofuse.lab.simulation.sensor import factory_correction
from written import record

BOARD = Board(checkerboard.COLUMNS, checkerboard.ROWS, checkerboard.SQUARE_M)
CAMERA = Pinhole(48, 36, 45.0, 45.0, 23.5, 17.5)
NOISE_M = 0.008


def wiggle(r: np.ndarray) -> np.ndarray:
    """20 mm rms, four periods to 5 m."""
    return 0.020 * np.sqrt(2) * np.sin(2 * np.pi * r / 1.25 + 0.4)


def own_offsets() -> np.ndarray:
    rng = np.random.default_rng(6)
    ramp = np.linspace(-0.01, 0.01, 48) + np.zeros((36, 1))
    return ramp + rng.normal(0, 0.003, (36, 48))


def made_views(*, known: bool, constant: float = 0.0) -> list[PlaneView]:
    """Planes from 0.8 to 4 m, tilted in all directions."""
    rng = np.random.default_rng(7)
    directions = unit_rays(CAMERA.rays().reshape(-1, 2))
    views = []
    for k, distance in enumerate(np.linspace(0.8, 4.0, 40)):
        tilt, around = rng.uniform(0.1, 0.7), rng.uniform(0, 2 * np.pi)
        normal = [np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), np.cos(tilt)]
        plane = np.array(normal) / distance
        true = 1 / (directions @ plane)
        measured = true + constant + wiggle(true) + own_offsets().ravel()
        measured = measured + rng.normal(0, NOISE_M, true.shape)
        information = np.eye(3) * (1e10 if known else 1e-12)
        start = plane * (1 if known else 1.02) + (0 if known else rng.normal(0, 0.003, 3))
        seen = np.flatnonzero((true > 0.7) & (true < 4.5))
        sigma = np.full(len(seen), NOISE_M)
        views.append(
            PlaneView(k, start, information, seen, measured[seen], sigma, directions[seen])
        )
    return views


def curve_error(fit: DepthFit, constant: float = 0.0) -> np.ndarray:
    """In m, over the ranges that were seen; the curve is over the measured range."""
    true = np.linspace(0.9, 4.2, 300)
    measured = true + constant + wiggle(true)
    found = np.interp(measured, fit.correction.range_m, fit.correction.bias_m)
    return found - constant - wiggle(true)


def bent(error: np.ndarray) -> np.ndarray:
    """The part of the error that is neither constant nor proportional to range."""
    r = np.linspace(0, 1, len(error))
    return error - np.polyval(np.polyfit(r, error, 1), r)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.nightly_part
def test_known_planes_constrain_curve_constant_and_offsets() -> None:
    fit = calibrate_depth(made_views(known=True, constant=0.03), CAMERA)
    assert rms(curve_error(fit, 0.03)) < 0.001
    offsets = fit.correction.pixel_bias_m
    assert offsets is not None
    apart = offsets - (own_offsets() - own_offsets().mean())
    assert rms(apart) < 0.0016  # of 6.6 mm; the noise of a mean of 40 is 1.3 mm
    assert fit.constant_sigma_m < 0.0005
    assert fit.scale_sigma < 0.0005
    assert fit.after_m == pytest.approx(NOISE_M, rel=0.05)
    assert fit.bias_before_m > 5 * fit.bias_after_m
    assert not any("scale" in warning for warning in fit.warnings)


@pytest.mark.nightly
def test_unknown_planes_constrain_all_but_constant_and_scale() -> None:
    fit = calibrate_depth(made_views(known=False), CAMERA)
    assert rms(bent(curve_error(fit))) < 0.001
    assert rms(curve_error(fit)) < 0.005
    offsets = fit.correction.pixel_bias_m
    assert offsets is not None
    assert rms(offsets - (own_offsets() - own_offsets().mean())) < 0.002
    assert "scale" in fit.warnings[0]


@pytest.mark.nightly
def test_unconstrained_constant_is_not_corrected() -> None:
    error = curve_error(calibrate_depth(made_views(known=False, constant=0.03), CAMERA), 0.03)
    assert rms(bent(error)) < 0.002
    assert abs(error.mean()) > 0.01


@pytest.mark.nightly
def test_fit_is_robust_to_outliers() -> None:
    rng = np.random.default_rng(9)
    views = []
    for view in made_views(known=True):
        count = len(view.pixels)
        wild = rng.random(count) < 0.05
        # Of one sign: errors of both signs would cancel without robust weights.
        measured = view.measured_m + wild * rng.uniform(0, 0.3, count)
        views.append(replace(view, measured_m=measured))
    assert rms(curve_error(calibrate_depth(views, CAMERA))) < 0.0015


def test_pixels_beyond_the_ends_of_the_curve_do_not_bend_it() -> None:
    views = []
    for view in made_views(known=True)[::2]:
        true = 1 / (view.directions @ view.plane)
        measured = 0.01 + 1.004 * true
        views.append(replace(view, information=np.eye(3) * 1e6, measured_m=measured))
    correction = calibrate_depth(views, CAMERA).correction
    error = correction.bias_m - (correction.range_m - (correction.range_m - 0.01) / 1.004)
    assert np.abs(error).max() < 5e-5


@pytest.mark.parametrize("size", [1.0, 0.97])
def test_wrong_size_of_the_board_is_suspected(size: float) -> None:
    """Planes of a board whose squares are said to be larger are too far: ranges seem too short."""
    views = [
        replace(view, plane=view.plane * size) for view in made_views(known=True, constant=0.01)
    ]
    warnings = calibrate_depth(views, CAMERA).warnings
    found = re.findall(r"ranges are (.*) % too short, .*: measure a square", "\n".join(warnings))
    assert [float(percent) for percent in found] == pytest.approx([3] * (size != 1), abs=0.5)


def test_single_distance_is_rejected() -> None:
    views = [
        replace(view, measured_m=1.0 + 0.01 * view.measured_m) for view in made_views(known=True)
    ]
    refused("several distances", views, CAMERA, by=calibrate_depth)


EFFECTS = Effects(wiggling=2.6, thermal_drift=0.0).without("multipath", "mixed_pixels")


@pytest.fixture(scope="module")
def views() -> Recording:
    """A simulated SR4000 with a wiggling error of 20 mm (peak), facing a board on a wall."""
    return simulate_recording("checkerboard", frames=20, effects=EFFECTS, correction=False)


def simulated_error(fit: DepthFit) -> tuple[float, float]:
    """Residual and original error of the curve, rms in m."""
    true = factory_correction(camera_model("sr4000"), EFFECTS)
    assert true.pixel_bias_m is not None
    r = np.linspace(*fit.range_m, 300)
    bias = np.interp(r, true.range_m, true.bias_m) + true.pixel_bias_m.mean()
    found = np.interp(r, fit.correction.range_m, fit.correction.bias_m)
    return rms(found - bias), rms(bias)


@pytest.mark.nightly
def test_board_on_wall_reduces_wiggling_below_2_mm(views: Recording) -> None:
    views = views.select(end=12)  # finding the corners takes most of the time
    fit = calibrate_depth(*board_planes(views, BOARD, "amplitude", wall=True))
    after, before = simulated_error(fit)
    assert before > 0.010
    assert after < 0.002
    assert fit.bias_after_m < 0.4 * fit.bias_before_m
    alone = calibrate_depth(*board_planes(views, BOARD, "amplitude", wall=False))
    assert simulated_error(alone)[0] < 0.0035


@pytest.mark.nightly
def test_wall_at_unknown_poses_reduces_wiggling_below_3_mm(views: Recording) -> None:
    assert simulated_error(calibrate_depth(*scene_planes(views, 1, 0)))[0] < 0.003


@pytest.mark.nightly_part
def test_command_writes_correction_that_is_applied(views, tmp_path, capsys) -> None:
    folder = tmp_path / "rec"
    seen = [replace(f, timestamp=float(k)) for k, f in enumerate(views.select(end=12))]
    record(folder, seen, depth_unit_m=0.0001, amplitude_kind="range_compensated")
    before = open_recording(folder)[0]
    out = folder / "correction.npz"
    command = ["calibrate", "depth", str(folder), "--planes", "1", "--out", str(out)]
    assert "planes in" in printed(capsys, *command)
    first = read_correction(out)
    after = open_recording(folder)
    assert after.metadata["corrected"] is True
    moved = (after[0].radial_range - before.radial_range)[before.valid]
    assert 0.003 < np.abs(moved).mean() < 0.03
    # Calibrating again adds little; both corrections are composed into one.
    refuses(capsys, *command, says="--overwrite")
    assert main([*command, "--overwrite"]) == 0
    again = read_correction(out)
    r = np.linspace(1.2, 3.2, 50)
    change = np.interp(r, again.range_m, again.bias_m) - np.interp(r, first.range_m, first.bias_m)
    assert rms(change) < 0.004
    refuses(capsys, "calibrate", "depth", folder, "--wall", says="--board")


@pytest.mark.nightly
def test_real_sr4000_from_two_places_is_rejected(shared_data: Path) -> None:
    """Planes are found, but from two places in a corridor they do not determine the curve."""
    found, camera = scene_planes(open_recording(shared_data / "sr4000_corridor"), 4, 0)
    assert len(found) >= 16
    ranges = [float(np.median(view.measured_m)) for view in found]
    # The end of the corridor is nearer by 0.3 m from the second place.
    far = {view.frame // 4: r for view, r in zip(found, ranges, strict=True) if r > 4}
    assert far[0] - far[1] == pytest.approx(0.31, abs=0.04)
    refused("20 places", found, camera, by=calibrate_depth)
