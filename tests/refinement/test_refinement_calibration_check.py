"""Views that determine the calibration error of their camera, and views that don't."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from aligned_surfaces import OPTIONS, SHARP, path, surfaces
from corner_views import BARREL, CAMERA, corner
from tofuse.engine.geometry import se3
from tofuse.engine.quality.trajectory_errors import displacement
from tofuse.engine.refinement import calibration_check
from tofuse.engine.refinement.calibration_check import (
    CalibrationCheck,
    check_calibration,
)
from tofuse.engine.refinement.camera_response import SECTIONS, Linearised, Response, significance_of
from tofuse.engine.refinement.joint_alignment import (
    Priors,
    Refined,
    RefinedViews,
    align_views,
    mean_support,
    refine,
)
from tofuse.engine.refinement.loop_drift import COARSE_TO_FINE, Gap, Loop, longest_loop
from tofuse.engine.stored_views import pair_equation_kernels as kernels
from tofuse.engine.stored_views.pair_equations import Round
from tofuse.engine.stored_views.view_store import SampledView
from tofuse.engine.views import prepare_view


def kept(offset: float, views: int = 12) -> tuple[list[SampledView], Refined]:
    """Views of a camera whose ranges are short by `offset`, refined as if they were correct."""
    truth = path(12)[:views]
    views = [SampledView.of(s, 1500) for s in surfaces(truth, noise=0.003, offset=offset)]
    return views, refine(views, truth, OPTIONS)


def response(views: list[SampledView], refined: Refined) -> Response:
    """Response of refined views to the errors that they share."""
    linearised = Linearised.of(views, refined.poses, refined.pairs, OPTIONS, Priors.none())
    return linearised.response_to_errors()


@pytest.mark.nightly_part
def test_range_offset_raises_alarm():
    views, refined = kept(0.06)
    found = check_calibration(RefinedViews(views, refined, OPTIONS))
    assert found.alarm
    assert found.errors["offset"] == pytest.approx(0.06, abs=0.015)
    assert found.sigmas["offset"] < 0.01
    assert found.gap is not None
    assert (found.gap.i, found.gap.j) == (0, 11)
    # The offset does not bend this trajectory.
    assert found.gap.before[0] < 0.01
    assert found.moved == pytest.approx(displacement(path(12), refined.poses), rel=0.3)
    assert found.gap.closes
    assert found.support is not None
    assert found.support[1] > found.support[0]


@pytest.mark.nightly_part
def test_odometry_contradicts_errors_that_lead_away_from_it():
    wrong = replace(CAMERA, fx=1.06 * CAMERA.fx, fy=1.06 * CAMERA.fy)
    truth = path(12)
    frames = [replace(corner(T), index=k, camera=wrong) for k, T in enumerate(truth)]
    views = [SampledView.of(prepare_view(frame, SHARP), 1500) for frame in frames]
    refined = refine(views, truth, OPTIONS)

    def check(poses: np.ndarray, *runs: slice, verified: bool = True) -> CalibrationCheck:
        rows = [np.arange(len(poses))[run] for run in runs or (slice(None),)]
        witness = [(run, se3.inverse(poses[run[0]]) @ poses[run]) for run in rows]
        priors = replace(Priors.none(), witness=witness, verified=verified)
        return check_calibration(RefinedViews(views, refined, OPTIONS, priors))

    confirmed, contradicted = check(truth), check(refined.poses)
    assert confirmed.alarm
    assert not confirmed.contradicted
    assert contradicted.contradicted
    assert contradicted.errors["focal"] == pytest.approx(0.06, abs=0.01)
    assert not contradicted.alarm
    assert not contradicted.is_likely
    # Also by odometry with a gap.
    assert not check(truth, slice(6), slice(6, None)).contradicted
    assert check(refined.poses, slice(6), slice(6, None)).contradicted
    # Of odometry whose errors are unknown, as of a few frames, it remains possible.
    doubted = check(refined.poses, verified=False)
    assert not doubted.alarm
    assert not doubted.contradicted
    assert doubted.unconfirmed["focal"] == contradicted.errors["focal"]
    assert check(truth, verified=False).alarm


def test_sections_that_disagree_raise_no_alarm(monkeypatch):
    monkeypatch.setattr(calibration_check, "_in_all_sections", lambda *_: False)
    views, refined = kept(0.06)
    found = check_calibration(RefinedViews(views, refined, OPTIONS))
    assert not found.alarm
    assert found.errors["offset"] == pytest.approx(0.06, abs=0.015)
    assert found.is_likely  # the bound includes it


def test_correct_camera_raises_no_alarm():
    views, refined = kept(0.0)
    found = check_calibration(RefinedViews(views, refined, OPTIONS))
    assert not found.alarm
    assert found.gap is None
    # What the views estimate still counts: less than the uncertainty of the estimate.
    assert 0 < found.moved[0] < 3 * found.focal_sigma * found.motion["focal"][0]


def test_sections_of_the_images_tell_whether_an_error_is_of_the_camera():
    """Ranges 6 cm short: in the whole image, or in its right half as by multipath in a corner."""
    found = []
    for parts in (np.s_[:], np.s_[30:]):
        rng, views = np.random.default_rng(3), []
        for k, T in enumerate(path(12)):
            frame = replace(corner(T), index=k)
            depth = frame.depth + 0.003 * rng.standard_normal(frame.depth.shape)
            depth[:, parts] += (corner(T, offset=0.06).depth - frame.depth)[:, parts]
            frame = replace(frame, depth=depth.astype(np.float32))
            views.append(SampledView.of(prepare_view(frame, SHARP), 1500))
        refined = refine(views, path(12), OPTIONS)
        linearised = Linearised.of(views, refined.poses, refined.pairs, OPTIONS, Priors.none())
        whole, sections = linearised.response_to_errors(), linearised.response_of_sections()
        error, by_sections = (of.estimate()[kernels.OFFSET] for of in (whole, sections))
        assert by_sections == pytest.approx(error, rel=0.3)
        found.append((error, sections.sigma_by_rows()[kernels.OFFSET]))
    (everywhere, small), (in_part, large) = found
    limit = significance_of(SECTIONS)
    assert everywhere > limit * small
    assert 0.01 < in_part < limit * large


@pytest.mark.parametrize(("remaining_m", "alarm"), [(0.004, False), (0.006, True)])
def test_drift_that_a_usual_focal_length_explains_better_is_no_offset(
    monkeypatch, remaining_m, alarm
):
    """Both close the loop, and the views confirm both: 0.3 % of the focal length, or 5 cm."""
    errors, gaps = {kernels.FOCAL: 0.003, kernels.OFFSET: 0.05}, {0.003: remaining_m, 0.05: 0.005}

    class ToldLoop(Loop):
        def aligned(self, steps, errors):
            return 0.02

        def closing_error(self, uncorrected, error_index, step):
            return errors[error_index], errors[error_index]

        def gap(self, before, after):
            return Gap(0, 11, (before, 0.0), (gaps.get(after, before), 0.0), 1.5)

        def estimate_by_views(self, steps, error_index, error):
            return SimpleNamespace(errors={error_index: error})

    monkeypatch.setattr(calibration_check, "Loop", ToldLoop)
    monkeypatch.setattr(calibration_check, "_in_all_sections", lambda *_: True)
    views, refined = kept(0.0)
    found = check_calibration(RefinedViews(views, refined, OPTIONS))
    assert found.alarm == alarm
    assert found.errors == ({"offset": 0.05} if alarm else {})


def test_few_views_determine_nothing_and_say_what_it_would_do():
    views, refined = kept(0.0, views=5)
    found = check_calibration(RefinedViews(views, refined, OPTIONS))
    assert found.undetermined
    assert not found.estimates
    assert not found.alarm
    assert found.motion["focal"][0] > 0


def test_significant_error_counts_however_large_its_sigma():
    """A distortion that was left out, of views that determine it less well than usual cameras."""
    truth = path(12)
    rng = np.random.default_rng(0)
    views = []
    for k, T in enumerate(truth):
        frame = corner(T, camera=BARREL)
        depth = frame.depth + rng.normal(0, 0.003, frame.depth.shape)
        frame = replace(frame, index=k, camera=CAMERA, depth=depth.astype(np.float32))
        views.append(SampledView.of(prepare_view(frame, SHARP), 1500))
    found = check_calibration(RefinedViews(views, refine(views, truth, OPTIONS), OPTIONS))
    error, sigma = found.estimates["distortion"]
    assert not found.determines("distortion")
    assert error > found.significance * sigma
    assert found.moved[0] >= 0.99 * error * found.motion["distortion"][0]


def test_focal_length_without_rotation_is_undetermined():
    # Without rotation a wrong focal length widens everything alike: the views still agree.
    truth = path(12)
    truth[:, :3, :3] = np.eye(3)
    views = [SampledView.of(s, 1500) for s in surfaces(truth, noise=0.01)]
    turned = [SampledView.of(s, 1500) for s in surfaces(path(12), noise=0.01)]

    def sigma(views: list[SampledView], poses: np.ndarray) -> float:
        refined = refine(views, poses, OPTIONS)
        responses = response(views, replace(refined, poses=poses))
        return float(responses.sigma(refined.pairs, len(views))[kernels.FOCAL])

    assert sigma(views, truth) > 0.1
    assert sigma(turned, path(12)) < 0.02


def test_single_step_estimates_whole_error() -> None:
    """Although it weights residuals robustly; reweighted least squares finds 0.7 of it."""

    def step(offset: float) -> float:
        views, refined = kept(offset)
        return float(response(views, refined).estimate()[kernels.OFFSET])

    assert step(0.02) - step(0.005) == pytest.approx(0.015, rel=0.2)


def test_focal_length_error_scales_sideways_motion() -> None:
    truth = path(12)
    truth[:, :3, :3] = np.eye(3)
    views = [SampledView.of(s, 1500) for s in surfaces(truth, noise=0.003)]
    found = check_calibration(RefinedViews(views, refine(views, truth, OPTIONS), OPTIONS))
    assert found.undetermined
    sideways = truth[:, :2, 3] - truth[:, :2, 3].mean(0)
    expected = 0.01 * np.sqrt((sideways**2).sum(1).mean())
    assert 0.01 * found.motion["focal"][0] == pytest.approx(expected, rel=0.05)


@pytest.mark.nightly
def test_estimate_converges_in_errors_too() -> None:
    """Poses may rest while the error still changes."""
    views, refined = kept(0.06)
    found = check_calibration(RefinedViews(views, refined, OPTIONS))
    rounds = (*COARSE_TO_FINE[:-1], Round(100, 0.0, 0.0))
    options = replace(OPTIONS, rounds=rounds, convergence=1e-4, shared=0.0)
    converged = refine(
        views, refined.poses, options, calibrate=[kernels.OFFSET], pairs=refined.pairs
    )
    assert found.errors["offset"] == pytest.approx(converged.errors[kernels.OFFSET], abs=1e-4)


def test_support_of_an_estimate_is_that_of_the_joint_alignment() -> None:
    views, refined = kept(0.06)
    options = replace(OPTIONS, rounds=(Round(2, 0.0, 0.0),), shared=0.0)
    known = {"calibrate": [kernels.OFFSET], "pairs": refined.pairs}
    joint = refine(views, refined.poses, options, **known)
    aligned = align_views(views, refined.poses, options, **known)
    expected = [float(s.of_views(len(views)).mean()) for s in (joint.before, joint.after)]
    before, after = mean_support(aligned, refined.poses)
    # By the same kernel: that for known errors is exact to first order only.
    assert after == pytest.approx(expected[1], rel=1e-9)
    assert before == pytest.approx(expected[0], abs=1e-3)
    assert after > before


def test_few_views_need_larger_error() -> None:
    # Student's t with 7 degrees of freedom, one-sided probability 3.17e-5.
    assert significance_of(8) == pytest.approx(8.47, abs=0.01)
    assert significance_of(100_000) == pytest.approx(4.0, abs=0.01)
    assert CalibrationCheck(
        errors={"offset": 0.05}, sigmas={"offset": 0.01}, significance=significance_of(100)
    ).large
    assert not CalibrationCheck(
        errors={"offset": 0.05}, sigmas={"offset": 0.01}, significance=significance_of(8)
    ).large


def test_correction_must_close_the_loop():
    assert Gap(0, 9, (0.3, 0.2), (0.1, 0.19)).closes
    assert not Gap(0, 9, (0.3, 0.2), (0.2, 0.15)).closes  # less than half closed
    assert not Gap(0, 9, (0.09, 0.048), (0.17, 0.059)).closes
    assert not Gap(0, 9, (0.3, 0.02), (0.1, 0.04)).closes  # the rotation opens instead
    # For a rotation on the spot the angle counts, not a few centimetres.
    assert Gap(0, 9, (0.047, 0.18), (0.063, 0.046), 2.5).closes
    assert not Gap(0, 9, (0.047, 0.18), (0.063, 0.16), 2.5).closes
    assert not Gap(0, 9, (0.005, 0.001), (0.05, 0.001)).closes


def test_unclosed_gap_contradicts_errors() -> None:
    changed, hardly = (0.12, 0.05), (0.02, 0.01)
    assert Gap(0, 9, (0.2, 0.05), (0.2, 0.04), 1.5, changed).contradicts
    assert not Gap(0, 9, (0.2, 0.05), (0.2, 0.04), 1.5, (0.12, 0.01)).contradicts
    assert not Gap(0, 9, (0.2, 0.05), (0.19, 0.05), 1.5, hardly).contradicts
    assert Gap(0, 9, (0.2, 0.05), (0.23, 0.05), 1.5, hardly).contradicts  # wider
    assert not Gap(0, 9, (0.2, 0.05), (0.08, 0.02), 1.5, changed).contradicts  # closed
    assert not Gap(0, 9, (0.009, 0.008), (0.009, 0.008), 1.5, changed).contradicts  # no gap


def test_gap_that_noise_leaves_confirms_errors_by_which_it_shrinks() -> None:
    """Independent of the change, noise leaves as much as it adds: 0.5^2 = 0.4^2 + 0.3^2."""
    assert Gap(0, 9, (0.5, 0.0), (0.4, 0.0), 1.5, (0.3, 0.0)).confirms
    assert not Gap(0, 9, (0.5, 0.0), (0.47, 0.0), 1.5, (0.3, 0.0)).confirms
    assert not Gap(0, 9, (0.5, 0.0), (0.58, 0.0), 1.5, (0.3, 0.0)).confirms
    assert not Gap(0, 9, (0.5, 0.0), (0.49, 0.0), 1.5, (0.05, 0.0)).confirms  # says nothing
    assert Gap(0, 9, (0.5, 0.0), (0.1, 0.0), 1.5, (0.4, 0.0)).confirms  # closed
    assert Gap(0, 9, (0.5, 0.0), (0.51, 0.0), 1.5, (0.3, 0.0)).grows
    assert not Gap(0, 9, (0.5, 0.0), (0.49, 0.0), 1.5, (0.3, 0.0)).grows


@pytest.mark.parametrize("true", [0.0, 0.06])
def test_views_keep_only_true_error_of_loop(true):
    views, refined = kept(true)
    loop = Loop.longest(RefinedViews(views, refined, OPTIONS))
    assert loop is not None
    steps = loop.steps(refined.poses)
    estimate = loop.estimate_by_views(steps, kernels.OFFSET, 0.06)
    assert estimate.errors[kernels.OFFSET] == pytest.approx(true, abs=0.02)


def test_longest_loop_uses_consecutive_views_only():
    pairs = np.array([(0, 1), (1, 2), (0, 2), (3, 4), (4, 5), (0, 5), (3, 5)])
    assert longest_loop(pairs) == (0, 2)  # 2 and 3 are not connected, so 0 to 5 is no loop
    joined = np.concatenate([pairs, [(2, 3)]])
    assert longest_loop(joined) == (0, 5)
    assert longest_loop(pairs[[0, 1]]) is None
    assert longest_loop(pairs[:0]) is None


@pytest.mark.nightly
def test_kinect_loop_raises_alarm(shared_data):
    """Its intrinsics are wrong by 5 %, as box corners of 87 degrees confirm."""
    from tofuse.engine.mapping.config import changed
    from tofuse.engine.mapping.methods import from_method
    from tofuse.engine.mapping.reconstructing import reconstruct
    from tofuse.engine.mapping.self_calibration import self_calibrated
    from tofuse.engine.progress import Silent
    from tofuse.formats.recordings.open import open_recording

    recording = open_recording(shared_data / "kinectv2_loop" / "recording")
    # Only the poses matter: the model is coarse.
    changes = {"self_calibration": False, "fusion": {"voxel_m": 0.1}}
    config = changed(from_method("default"), changes, where="test")
    result = reconstruct(recording, config)
    assert "calibration_alarm" in {r.code for r in result.diagnostics.reasons}
    refinement = result.diagnostics.refinement
    assert refinement is not None
    found = refinement.calibration_check
    assert found is not None
    assert found.errors["focal"] == pytest.approx(-0.05, abs=0.015)
    assert found.gap is not None
    assert found.gap.before[0] > 0.25
    assert found.gap.after[0] < 0.5 * found.gap.before[0]
    # Only a proposal: nothing was changed.
    assert refinement.errors == {}
    assert se3.angle(result.trajectory[0]) == pytest.approx(0, abs=1e-12)
    # The correction itself is kept.
    calibrated = self_calibrated(
        result, config, partial(reconstruct, recording), Silent()
    ).diagnostics
    assert calibrated.calibrated is not None
    assert calibrated.calibrated.focal == pytest.approx(-0.05, abs=0.015)
    assert calibrated.accuracy.position_m < 0.1 * result.diagnostics.accuracy.position_m
