"""The robustness benchmark: definitions of wrong poses, marked poses and wrong joins; its cases."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from paths import BENCHMARKS
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3


@pytest.fixture
def scoring(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import scoring

    return scoring


@pytest.fixture
def stress(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import stress

    monkeypatch.setattr(stress, "OUT", tmp_path / "robustness")
    return stress


def walk(count=30):
    """Poses (N, 4, 4) of a walk with rotations."""
    steps = np.tile([0.0, 0.0, 0.08, 0.0, 0.05, 0.0], (count, 1))
    steps[:, 0] = 0.03 * np.sin(np.arange(count))
    poses = [np.eye(4)]
    for step in steps[1:]:
        poses.append(poses[-1] @ se3.exp(step))
    return np.array(poses)


def moved(poses, *twist):
    return poses @ se3.exp(np.array(twist, float))


def record(index, status="tracked", covariance=None, unobservable=()):
    directions = np.array(unobservable, float).reshape(-1, 6)
    return SimpleNamespace(
        index=index, status=status, covariance=covariance, unobservable=directions
    )


def part(scoring, poses, reasons=(), **options):
    return scoring.Part(
        poses, tuple(record(k) for k in range(len(poses))), tuple(reasons), **options
    )


def compare(scoring, poses, truth, reasons=(), groups=None):
    whole = np.zeros(len(truth), np.intp) if groups is None else np.array(groups)
    return scoring.score([part(scoring, poses, reasons)], scoring.Truth(truth, whole))


ANYWHERE = se3.exp(np.array([3.0, -1.0, 0.5, 0.4, -1.2, 0.3]))


def test_score_is_invariant_to_world_frame(scoring) -> None:
    truth = walk()
    score = compare(scoring, ANYWHERE @ truth, truth)
    assert (score.wrong, score.unmarked, score.joins) == (0, 0, 0)
    assert score.main == score.covered == score.frames == 30
    assert score.ate_m == pytest.approx(0, abs=1e-9)


def test_alignment_is_robust_to_outliers(scoring) -> None:
    truth = walk()
    estimate = ANYWHERE @ truth
    estimate[4] = moved(estimate[4], 0.06, 0, 0, 0, 0, 0)
    estimate[5] = moved(estimate[5], 0.04, 0, 0, 0, 0, 0)
    estimate[6] = moved(estimate[6], 0, 0, 0, 0, np.radians(3.5), 0)
    estimate[20:25] = se3.exp(np.array([0, 0, 9.0, 0, 0, 0])) @ estimate[20:25]
    score = compare(scoring, estimate, truth)
    assert score.wrong == score.unmarked == 1 + 1 + 5
    assert score.joins == 1  # five frames that belong together, 9 m off


def test_lost_frames_reduce_coverage_only(scoring) -> None:
    truth = walk()
    estimate = truth.copy()
    estimate[10:] = np.nan
    score = compare(scoring, estimate, truth, groups=[0] * 20 + [-1] * 10)
    assert (score.main, score.wrong) == (10, 0)
    assert (score.covered, score.overlapping) == (10, 20)
    nothing = compare(scoring, np.full_like(truth, np.nan), truth)
    assert (nothing.main, nothing.covered, nothing.wrong) == (0, 0, 0)
    assert np.isnan(nothing.ate_m)


@pytest.mark.parametrize(
    ("change", "mark"),
    [
        ({}, None),
        ({"status": "predicted"}, "status"),
        ({"covariance": np.diag([0.04**2] * 3 + [1e-6] * 3)}, "covariance"),
        ({"covariance": np.diag([0.02**2] * 3 + [1e-6] * 3)}, None),
        ({"unobservable": [1, 0, 0, 0, 0, 0]}, "unobservable"),
        ({"unobservable": [0, 1, 0, 0, 0, 0]}, None),
    ],
)
def test_wrong_pose_is_marked_by_status_or_uncertainty(scoring, change, mark) -> None:
    """One pose has an error of 10 cm along x."""
    truth = walk()
    estimate = truth.copy()
    estimate[12] = moved(estimate[12], 0.10, 0, 0, 0, 0, 0)
    records = [record(k) for k in range(30)]
    records[12] = record(12, **change)
    found = scoring.score(
        [scoring.Part(estimate, tuple(records))], scoring.Truth(truth, np.zeros(30, np.intp))
    )
    assert found.wrong == 1
    assert found.unmarked == (mark is None)
    error = np.array([0.10, 0, 0, 0, 0, 0])
    one = scoring.Part(estimate, tuple(records))
    assert scoring.marks(one, 12, error, scoring.Tolerance()) == ({mark} if mark else set())


def test_reasons_mark_their_frames(scoring) -> None:
    truth = walk()
    estimate = truth.copy()
    estimate[[3, 12, 25]] = moved(estimate[[3, 12, 25]], 0, 0.2, 0, 0, 0, 0)
    for frames, unmarked in (((10, 14), 2), (((0, 4), (20, 29)), 1), ((0, 29), 0)):
        score = compare(scoring, estimate, truth, [SimpleNamespace(frames=frames)])
        assert (score.wrong, score.unmarked, score.by_reason) == (3, unmarked, 3 - unmarked)


def test_stated_break_marks_later_part(scoring) -> None:
    truth = walk()
    estimate = truth.copy()
    estimate[10:] = se3.exp(np.array([0.5, 0, 0, 0, 0, 0])) @ truth[10:]
    unsure = np.diag([0.3**2] * 3 + [0.1**2] * 3)
    for stated, unmarked in ((range(10, 30), 0), (range(15, 30), 5), (range(0), 10)):
        records = tuple(record(k, covariance=unsure if k in stated else None) for k in range(30))
        score = scoring.score(
            [scoring.Part(estimate, records)], scoring.Truth(truth, np.zeros(30, np.intp))
        )
        assert score.unmarked == unmarked
        assert score.unmarked_strict == 10  # the first ten state no uncertainty
        assert score.joins == 1


def test_discontinuity_is_wrong_join_but_drift_is_not(scoring) -> None:
    truth = walk(60)
    drifting = np.array([T @ se3.exp([0.01 * k, 0, 0, 0, 0, 0]) for k, T in enumerate(truth)])
    assert compare(scoring, drifting, truth).joins == 0
    assert compare(scoring, drifting, truth).wrong > 30
    for off, joins in (((0.15, 0, 0, 0, 0, 0), 0), ((0.3, 0, 0, 0, 0, 0), 1)):
        torn = truth.copy()
        torn[40:] = se3.exp(np.array(off, float)) @ torn[40:]
        assert compare(scoring, torn, truth).joins == joins
    turned = truth.copy()
    turned[40:] = (
        truth[40] @ se3.exp([0, 0, 0, 0, np.radians(12), 0]) @ (se3.inverse(truth[40]) @ truth[40:])
    )
    assert compare(scoring, turned, truth).joins == 1
    few = truth.copy()
    few[40:42] = se3.exp(np.array([0.5, 0, 0, 0, 0, 0])) @ few[40:42]
    assert compare(scoring, few, truth).joins == 0  # two frames are too few for one side of a join
    three = truth.copy()
    three[20:40] = se3.exp(np.array([0.5, 0, 0, 0, 0, 0])) @ three[20:40]
    three[40:] = se3.exp(np.array([0, 0.8, 0, 0, 0, 0])) @ three[40:]
    assert compare(scoring, three, truth).joins == 2
    # The order of the frames does not matter.
    order = np.random.default_rng(0).permutation(60)
    assert compare(scoring, three[order], truth[order]).joins == 2


def result(poses, indices, reasons=(), components=None):
    found = SimpleNamespace(
        trajectory=poses,
        diagnostics=SimpleNamespace(frames=[record(k) for k in indices], reasons=tuple(reasons)),
    )
    if components is not None:
        found.components = components
    return found


def component(frames, T=None, joined=None, own=None):
    return SimpleNamespace(frames=frames, T_main_component=T, joined=joined, result=own)


def test_result_without_components_is_one_part(scoring) -> None:
    poses = walk(5)
    (one,) = scoring.parts_of(result(poses, range(10, 15)), range(10, 16))
    np.testing.assert_array_equal(one.posed, [True] * 5 + [False])
    np.testing.assert_array_equal(one.poses[:5], poses)
    assert one.records[5] is None
    assert not one.by_motion


@pytest.mark.parametrize("counted_from", [20, 0])
def test_unconnected_components_are_separate_parts(scoring, counted_from) -> None:
    """Frames 0 to 9 are the main one, 10 to 19 are joined to it, 20 to 24 are not."""
    truth = walk(25)
    main = truth.copy()
    main[20:] = np.nan
    own = result(ANYWHERE @ truth[20:], range(counted_from, counted_from + 5))
    found = result(
        main,
        range(25),
        components=(
            component(((0, 9),), np.eye(4)),
            component(((10, 19),), np.eye(4), "motion"),
            component(((20, 24),), None, None, own),
        ),
    )
    parts = scoring.parts_of(found, range(25))
    assert [int(p.posed.sum()) for p in parts] == [20, 5]
    assert parts[0].by_motion
    whole = np.array([0] * 20 + [1] * 5)
    score = scoring.score(parts, scoring.Truth(truth, whole))
    assert (score.main, score.covered, score.wrong, score.joins) == (20, 25, 0, 0)
    # Where all could be connected, unconnected frames are not covered.
    score = scoring.score(parts, scoring.Truth(truth, np.zeros(25, np.intp)))
    assert score.covered == 20


# ---- Cases ---------------------------------------------------------------------------------------


def flat_wall(k):
    """A wall 2 m away, 0.1 s after the previous frame; looks the same from any place along it."""
    camera = Pinhole(40, 30, 40.0, 40.0, 19.5, 14.5)
    depth = np.full((30, 40), 2.0, np.float32)
    light = np.full((30, 40), 1000.0, np.float32)
    return RangeFrame(k, 0.1 * k, camera, depth, amplitude_image=light)


def made_take(stress, count=40, step=0.02):
    frames = tuple(flat_wall(k) for k in range(count))
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = step * np.arange(count)
    return stress.Take(frames, poses, {})


def test_groups_are_overlapping_frames(stress) -> None:
    took = made_take(stress, 12)
    assert (stress.groups(took.frames, took.poses) == 0).all()
    poses = took.poses.copy()
    poses[6:, 0, 3] += 1.6  # of the 2 m in view
    np.testing.assert_array_equal(stress.groups(took.frames, poses), [0] * 6 + [1] * 6)
    found = stress.groups(took.frames, poses, unusable=[2, 3])
    np.testing.assert_array_equal(found, [0, 0, -1, -1, 0, 0] + [1] * 6)
    poses[11, 0, 3] += 50
    assert stress.groups(took.frames, poses)[11] == -1


@pytest.mark.parametrize("how", ["lid", "hand"])
def test_covered_lens_hides_scene(stress, how) -> None:
    took = made_take(stress)
    rng = np.random.default_rng(1)
    covered, bad = stress.hidden(took, 1.0, how, rng)
    assert len(bad) == 10
    assert bad == list(range(bad[0], bad[0] + 10))
    assert 0 < bad[0] < bad[-1] < 39
    for k, frame in enumerate(covered.frames):
        same = (frame.depth == 2.0).mean()
        assert same == 1 if k not in bad else same < 0.12
        if k in bad:
            assert frame.depth.max() == 0 if how == "lid" else np.median(frame.depth) < 0.2
    case = stress.as_case("wall", how, covered, unusable=bad)
    np.testing.assert_array_equal(case.truth.groups >= 0, [k not in bad for k in range(40)])
    assert [frame.index for frame in case.recording] == list(range(40))


def test_brightness_and_range_offset_are_applied(stress) -> None:
    frame = flat_wall(0)
    bright = stress.brighter(frame, 4.0)
    np.testing.assert_array_equal(bright.amplitude_image, 4000.0)
    np.testing.assert_array_equal(bright.depth, frame.depth)
    far = stress.farther(frame, 0.05)
    length = np.sqrt(1 + (frame.camera.rays() ** 2).sum(-1))
    np.testing.assert_allclose((far.depth - frame.depth) * length, 0.05, atol=1e-5)
    holed = replace(frame, depth=frame.depth * (np.arange(40) % 2))
    assert (stress.farther(holed, 0.05).depth[:, ::2] == 0).all()
    radial = replace(frame, depth_kind="range")
    np.testing.assert_allclose(stress.farther(radial, 0.05).depth, 2.05, atol=1e-6)


def test_falloff_is_corrected_in_raw_amplitude_only(stress) -> None:
    frame = flat_wall(0)
    frame.amplitude_image[0, 0] = 65535
    transmission = np.full((30, 40), 0.5)
    even = stress.evenly_lit(frame, transmission).amplitude_image
    assert even[0, 0] == 65535
    assert (even[1:] == 2000).all()
    other = replace(frame, amplitude_kind="range_compensated")
    assert stress.evenly_lit(other, transmission) is other


def test_two_places_are_contiguous_in_time_and_twice_has_gap(stress) -> None:
    took, other = made_take(stress), made_take(stress, 20)
    away = other.poses.copy()
    away[:, 0, 3] += stress.APART_M
    both = stress.two_places(took, replace(other, poses=away))
    times = np.array([frame.timestamp for frame in both.frames])
    np.testing.assert_allclose(np.diff(times), 0.1, atol=1e-9)
    found = stress.as_case("wall", "two places", both).truth.groups
    np.testing.assert_array_equal(found, [0] * 20 + [1] * 20)
    again = stress.twice(took, other)
    times = np.array([frame.timestamp for frame in again.frames])
    assert np.diff(times).max() == pytest.approx(60.0)
    assert (stress.as_case("wall", "twice", again).truth.groups == 0).all()


def test_shuffling_keeps_frames_and_poses_together(stress) -> None:
    took = made_take(stress)
    mixed = stress.shuffled(took, np.random.default_rng(0))
    times = np.array([frame.timestamp for frame in mixed.frames])
    assert (np.diff(times) > 0).all()
    for frame, pose in zip(mixed.frames, mixed.poses, strict=True):
        assert pose[0, 3] == pytest.approx(0.02 * frame.index)


def test_quick_turns_and_close_up_return_to_path(stress) -> None:
    def path(t):
        T = np.eye(4)
        T[2, 3] = 0.5 * t
        return T

    turning = stress.quick_turns(path, 0.0)
    angles = np.degrees([se3.angle(turning(t)) for t in np.arange(0, 6, 0.02)])
    assert angles.max() == pytest.approx(60, abs=0.1)
    assert np.abs(np.diff(angles)).max() / 0.02 > 150  # degrees a second
    assert (angles < 1).mean() > 0.4
    wall = se3.exp(np.array([1.0, 0.2, 0.5, 0.0, 1.0, 0.0]))
    close = stress.close_up(path, 2.0, wall)
    np.testing.assert_allclose(close(1.5), path(1.5))
    middle = [close(2.0 + stress.STRETCH_S * u) for u in (1.0, 1.5, 2.0)]
    assert max(np.linalg.norm((se3.inverse(wall) @ T)[:3, 3]) for T in middle) < 0.05
    np.testing.assert_allclose(close(2.0 + 3 * stress.STRETCH_S + 1), path(3.0), atol=1e-9)
    t = np.arange(0, 8, 1 / 120)
    poses = np.array([close(s) for s in t])
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) * 120
    assert speed.max() < 2.5


@pytest.mark.slow
def test_scene_cases_are_selected(stress, monkeypatch) -> None:
    short = replace(stress.SCENES["rail"], frames=8)
    found = list(stress.cases(short, 0, quick=True, containing="frame"))
    names = [case.name for case in found]
    assert names == [
        "every 4th frame",
        "half of the frames dropped",
        "amplitude x 4 from a frame on",
        "warm-up, 1 mm a frame",
    ]
    assert len(found[0].recording) == 2
    again = list(stress.cases(short, 0, quick=True, containing="dropped"))
    np.testing.assert_array_equal(again[0].recording.timestamps, found[1].recording.timestamps)
    for case in found:
        assert len(case.truth.poses) == len(case.truth.groups) == len(case.recording)
    for scene in stress.SCENES.values():
        assert scene.again < stress.scene_frames(scene.name)


@pytest.mark.slow
def test_runs_are_summarised_and_crashes_counted(stress, monkeypatch, capsys, tmp_path) -> None:
    import robustness

    short = {"rail": replace(stress.SCENES["rail"], frames=6)}
    monkeypatch.setattr(robustness.stress, "SCENES", short)
    arguments = ["stress", "--scenes", "rail", "--cases", "as it is", "--threads", "1"]
    robustness.main([*arguments, "--out", str(tmp_path)])
    text = capsys.readouterr().out
    assert "tofuse: 1 runs, 0 without a result; 100.0% of overlapping frames covered" in text

    def broken(*_arguments, **_options):
        raise ZeroDivisionError("oops")

    monkeypatch.setattr(robustness, "reconstruct", broken)
    robustness.main([*arguments, "--out", str(tmp_path)])
    text = capsys.readouterr().out
    assert "crashed: ZeroDivisionError: oops" in text
    assert "1 without a result; 0.0% of overlapping frames covered" in text
    assert (tmp_path / "robustness_stress.json").is_file()


def test_real_recordings_have_reference_poses(monkeypatch, shared_data) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import recorded

    for name in ("sr4000_corridor", "xtion_ring", "azure_kinect_rig", "open3d_rgbd5"):
        one = recorded.RECORDED[name]
        recording = one.open(shared_data)
        references = one.references(shared_data, recording)
        assert references
        for poses in references:
            assert poses.shape == (len(recording), 4, 4)
            np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1, atol=1e-3)
