"""Views that determine the calibration error of their camera, and views that don't."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from aligned_surfaces import OPTIONS, SHARP, path, surfaces
from corner_views import CAMERA, corner
from tofuse.engine.geometry import se3
from tofuse.engine.quality.trajectory_errors import displacement
from tofuse.engine.refinement import calibration_check
from tofuse.engine.refinement.calibration_check import USUAL, CalibrationCheck, check_calibration
from tofuse.engine.refinement.camera_response import Linearised, SharedErrors, significance_of
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


def shared_errors(views: list[SampledView], refined: Refined, *errors: int) -> SharedErrors:
    linearised = Linearised.of(views, refined.poses, refined.pairs, OPTIONS, Priors.none())
    return linearised.shared_errors(errors)


def estimate(
    views: list[SampledView], refined: Refined, *errors: int, usual: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Joint estimate of errors of the camera by refined views, and their standard deviations."""
    found = shared_errors(views, refined, *errors).posterior(np.full(len(errors), usual))
    return found.errors, np.sqrt(np.diag(found.covariance))


@pytest.mark.nightly_part
def test_range_offset_raises_alarm():
    views, refined = kept(0.06)
    found = check_calibration(RefinedViews(views, refined, OPTIONS))
    assert found.alarm
    assert found.errors["offset"] == pytest.approx(0.06, abs=0.015)
    assert found.sigma("offset") < 0.01
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


def test_error_that_may_be_usual_raises_no_alarm(monkeypatch):
    monkeypatch.setattr(calibration_check, "_CERTAIN", 100.0)
    views, refined = kept(0.06)
    found = check_calibration(RefinedViews(views, refined, OPTIONS))
    assert not found.alarm
    assert found.errors["offset"] == pytest.approx(0.06, abs=0.015)
    assert found.is_likely  # the bound includes it


@pytest.mark.nightly_part
def test_of_models_about_as_likely_the_one_by_which_views_agree_best_counts(monkeypatch):
    views, refined = kept(0.06)
    likely = property(lambda self: ["distortion", "focal", "offset"])
    monkeypatch.setattr(calibration_check._Estimate, "likely", likely)
    found = check_calibration(RefinedViews(views, refined, OPTIONS))
    assert found.errors == {"offset": pytest.approx(0.06, abs=0.015)}


def test_correct_camera_raises_no_alarm():
    views, refined = kept(0.0)
    found = check_calibration(RefinedViews(views, refined, OPTIONS))
    assert not found.alarm
    assert found.gap is None
    # What the views estimate still counts: not much more than the uncertainty of the estimate.
    assert 0 < found.moved[0] < 3 * found.spread[0]


def test_error_of_a_part_of_the_images_is_worth_less():
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
        (error,), (sigma,) = estimate(views, refined, kernels.OFFSET)
        found.append((error, sigma))
    (everywhere, small), (in_part, large) = found
    assert everywhere == pytest.approx(0.06, abs=0.01)
    assert in_part / large < 0.5 * everywhere / small


def test_sections_of_the_images_have_exposures_of_their_own() -> None:
    views, refined = kept(0.0)
    linearised = Linearised.of(views, refined.poses, refined.pairs, OPTIONS, Priors.none())
    before = linearised.state.exposure.copy()
    first, second = (linearised.shared_errors([kernels.OFFSET]) for _ in range(2))
    np.testing.assert_array_equal(linearised.state.exposure, before)
    assert first.dispersion == second.dispersion


def test_errors_that_resemble_each_other_are_told_apart_together():
    """Rays 1 % too narrow and ranges 3 cm short."""
    narrow = replace(CAMERA, fx=1.01 * CAMERA.fx, fy=1.01 * CAMERA.fy)
    rng, views = np.random.default_rng(3), []
    for k, T in enumerate(path(12)):
        seen = corner(T, offset=0.03)
        depth = seen.depth + 0.003 * rng.standard_normal(seen.depth.shape)
        frame = replace(seen, index=k, camera=narrow, depth=depth.astype(np.float32))
        views.append(SampledView.of(prepare_view(frame, SHARP), 1500))
    refined = refine(views, path(12), OPTIONS)
    (offset, focal), _ = estimate(views, refined, kernels.OFFSET, kernels.FOCAL)
    assert offset == pytest.approx(0.03, abs=0.006)
    assert focal == pytest.approx(0.01, abs=0.003)


def test_one_unusual_error_is_likelier_than_several() -> None:
    """Two errors have nearly the same effect, and the views show their sum."""
    effect = np.array([[1.0, 0.99], [0.99, 1.0]]) / 0.003**2
    motion, serial = np.zeros((2, 1, 6)), (np.full(2, 0.003), np.ones(2))
    shared = SharedErrors(np.zeros(2), effect @ [-0.03, -0.02], effect, 1.0, motion, *serial)
    usual = np.full(2, USUAL)
    both, first, second = (
        shared.posterior(np.where(np.arange(2) == k, 0.1, usual)) for k in (-1, 0, 1)
    )
    assert min(both.errors) > 0.02
    assert first.errors == pytest.approx([0.05, 0.0], abs=0.005)
    assert second.errors == pytest.approx([0.0, 0.05], abs=0.005)
    assert min(first.evidence, second.evidence) > both.evidence + 2
    # With a dispersion, the views tell as much less.
    doubtful = replace(shared, dispersion=100.0).posterior(usual)
    assert doubtful.covariance[0, 0] > 1.5 * both.covariance[0, 0]


def test_an_error_that_views_leave_open_is_that_of_usual_cameras():
    """Without rotation a wrong focal length widens everything alike: the views still agree."""
    truth = path(12)
    truth[:, :3, :3] = np.eye(3)
    views = [SampledView.of(s, 1500) for s in surfaces(truth, noise=0.01)]
    refined = replace(refine(views, truth, OPTIONS), poses=truth)
    (focal,), (sigma,) = estimate(views, refined, kernels.FOCAL, usual=USUAL)
    assert sigma == pytest.approx(USUAL, rel=0.05)
    assert abs(focal) < 0.2 * USUAL


def tell_of_loop(monkeypatch, remaining_m: float = 0.006, lengths: float = 1.0) -> None:
    """A focal length 0.3 % off, or an offset of 5 cm, close the loop; the views confirm both.

    With these, `lengths` are multiples of those without.
    """
    errors, gaps = {kernels.FOCAL: 0.003, kernels.OFFSET: 0.05}, {0.003: remaining_m, 0.05: 0.005}

    class ToldLoop(Loop):
        def aligned(self, steps, errors):
            return 0.02

        def closing_error(self, uncorrected, error_index, step):
            return errors[error_index], errors[error_index]

        def gap(self, before, after):
            return Gap(0, 11, (before, 0.0), (gaps.get(after, before), 0.0), 1.5)

        def estimate_by_views(self, steps, error_index, error):
            poses = self.of.refined.poses[self.i : self.j + 1].copy()
            poses[:, :3, 3] *= lengths
            return SimpleNamespace(errors={error_index: error}, poses=poses)

    monkeypatch.setattr(calibration_check, "Loop", ToldLoop)
    found = SimpleNamespace(covariance=np.full((1, 1), 1e-8))
    told = SimpleNamespace(posterior=lambda sigmas: found)
    linearised = SimpleNamespace(shared_errors=lambda errors: told)
    monkeypatch.setattr(calibration_check, "_linearised", lambda *_: linearised)


@pytest.mark.parametrize(("remaining_m", "alarm"), [(0.004, False), (0.006, True)])
def test_drift_that_a_usual_focal_length_explains_better_is_no_offset(
    monkeypatch, remaining_m, alarm
):
    tell_of_loop(monkeypatch, remaining_m)
    views, refined = kept(0.0)
    found = check_calibration(RefinedViews(views, refined, OPTIONS))
    assert found.alarm == alarm
    assert found.errors == ({"offset": 0.05} if alarm else {})


@pytest.mark.parametrize(("lengths", "alarm"), [(1.0, True), (1.3, False)])
def test_odometry_contradicts_errors_that_close_a_loop(monkeypatch, lengths, alarm):
    tell_of_loop(monkeypatch, lengths=lengths)
    views, refined = kept(0.0)
    runs = [np.arange(3), np.arange(3, 12)]
    witness = [(run, se3.inverse(refined.poses[run[0]]) @ refined.poses[run]) for run in runs]
    priors = replace(Priors.none(), witness=witness)
    assert check_calibration(RefinedViews(views, refined, OPTIONS, priors)).alarm == alarm
    assert check_calibration(RefinedViews(views, refined, OPTIONS)).alarm


def test_views_that_do_not_overlap_show_no_wrong_calibration() -> None:
    truth = path(12)
    views = [SampledView.of(s, 1500) for s in surfaces(truth, noise=0.003)]
    apart = truth.copy()
    apart[:, 0, 3] += 100.0 * np.arange(12)
    assert not calibration_check.is_wrong(views, apart, OPTIONS, Priors.none())


def test_few_views_determine_nothing_and_say_what_it_would_do():
    views, refined = kept(0.0, views=5)
    found = check_calibration(RefinedViews(views, refined, OPTIONS))
    assert found.undetermined
    assert not found.estimates
    assert not found.alarm
    assert found.motion["focal"][0] > 0


def test_single_step_estimates_whole_error() -> None:
    """Although it weights residuals robustly; reweighted least squares finds 0.7 of it."""

    def step(offset: float) -> float:
        views, refined = kept(offset)
        return float(estimate(views, refined, kernels.OFFSET)[0][0])

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
    """Poses may rest while the errors still change."""
    views, refined = kept(0.06)
    known = {"calibrate": [kernels.OFFSET], "pairs": refined.pairs}
    rounds = COARSE_TO_FINE[-1:]
    options = replace(OPTIONS, rounds=rounds, error_convergence=0.05, shared=0.0)
    found = align_views(views, refined.poses, options, **known)
    longer = replace(options, rounds=(Round(100, 0.0, 0.0),), convergence=1e-4)
    converged = align_views(views, refined.poses, replace(longer, error_convergence=0.0), **known)
    assert found.errors == pytest.approx(converged.errors, abs=5e-4)


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


def test_certain_error_exceeds_the_tolerance_by_more_than_its_uncertainty() -> None:
    certain, possible = (
        CalibrationCheck(errors={"offset": 0.05}, estimates={"offset": (0.05, sigma)})
        for sigma in (0.01, 0.02)
    )
    assert certain.unconfirmed == {"offset": 0.05}
    assert possible.is_likely
    assert not possible.unconfirmed
    # A lens of another model needs many errors at once.
    assert not replace(certain, estimates=certain.estimates | {"center_x": (0.03, 0.01)}).certain
    usual = replace(possible, errors={})
    assert not usual.is_likely
    assert replace(usual, support=(0.8, 0.81)).is_likely


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
    estimate = loop.estimate_by_views(loop.steps(refined.poses), kernels.OFFSET, 0.06)
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
    assert calibrated.accuracy.position_m < 0.7 * result.diagnostics.accuracy.position_m
