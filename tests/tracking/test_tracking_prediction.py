"""The error of extrapolated motion."""

import itertools

import numpy as np
import pytest

from tofuse.engine.alignment.projective import UNITS
from tofuse.engine.alignment.uncertainty import with_prior
from tofuse.engine.geometry import se3
from tofuse.engine.tracking.motion_prediction import (
    Prediction,
    degenerate_runs,
    steps_between_bounded,
    with_prediction,
)

NONE, SOME = np.zeros((0, 6)), np.eye(6)[:1]


def path(motions):
    """Poses (N, 4, 4) of motions (N-1, 6)."""
    poses = [np.eye(4)]
    for T in se3.exp(motions):
        poses.append(poses[-1] @ T)
    return np.array(poses)


def random_walk(rng, n):
    """Motions (N, 6) whose change is random, small enough for rotations to add up."""
    return np.cumsum(rng.standard_normal((n, 6)) * ([0.01] * 3 + [1e-3] * 3), axis=0)


def around_a_mean(rng, n):
    """Motions (N, 6) that are independent of each other."""
    return rng.standard_normal((n, 6)) * ([0.01] * 3 + [1e-3] * 3)


def test_runs_of_degenerate_frames() -> None:
    assert degenerate_runs([NONE, SOME, SOME, NONE, SOME]).tolist() == [0, 1, 2, 0, 1]
    assert degenerate_runs([SOME, SOME]).tolist() == [1, 2]
    assert degenerate_runs([]).tolist() == []


@pytest.mark.parametrize("n", [3, 20])
def test_error_grows_as_for_random_walk_of_velocity(n) -> None:
    """Frame by frame or over all frames at once, as in simulated random walks."""
    step = np.random.default_rng(1).standard_normal((20_000, n))
    expected = np.cumsum(np.cumsum(step, axis=1), axis=1)[:, -1].std()
    usual = Prediction((1.0, 1.0))
    single = np.sqrt(sum(usual.error(k, 1)[0] ** 2 for k in range(1, n + 1)))
    assert single == pytest.approx(expected, rel=0.03)
    assert usual.error(n, n)[0] == pytest.approx(single)
    # Relative to a later frame of the run, the velocity is off from the first one on.
    assert usual.error(n, 2)[0] == pytest.approx(np.hypot(n - 1, n))


@pytest.mark.parametrize(
    ("walk", "low", "high"), [(random_walk, 1.5, 2), (around_a_mean, 0.7, 1.3)]
)
def test_error_growth_is_estimated_from_constrained_motion(walk, low, high) -> None:
    """It is faster for a random walk of the velocity than for independent motions."""
    poses = path(walk(np.random.default_rng(5), 300))
    found = Prediction.of(poses, [NONE] * len(poses))
    assert low <= found.power[0] <= high
    assert low <= found.power[1] <= high


def test_predicted_error_matches_recording() -> None:
    poses = path(around_a_mean(np.random.default_rng(6), 400))
    found = Prediction.of(poses, [NONE] * len(poses))
    steps = np.array([se3.log(se3.inverse(a) @ b) for a, b in itertools.pairwise(poses)])
    off = [
        poses[k + 12][:3, 3] - (poses[k] @ se3.exp(12 * steps[k - 1]))[:3, 3] for k in range(1, 380)
    ]
    assert found.error(12, 12)[0] == pytest.approx(np.sqrt(np.mean(np.square(off))), rel=0.15)


def test_degenerate_directions_are_excluded() -> None:
    """Extrapolated motion agrees with its prediction by construction, and is no evidence."""
    motions = around_a_mean(np.random.default_rng(7), 300)
    motions[:, 1] = 0.02
    poses = path(motions * [1, 1, 1, 0, 0, 0])
    found = Prediction.of(poses, [np.eye(6)[1:2]] * len(poses))
    ignored = Prediction.of(poses, [NONE] * len(poses))
    assert found.sigma[0] == pytest.approx(ignored.sigma[0] * np.sqrt(3 / 2), rel=1e-3)


def test_without_constrained_motion_error_is_half_of_the_rms_motion() -> None:
    """Along each axis, though the camera moves along one of them, and not all the time."""
    motions = np.zeros((40, 6))
    motions[::4, 0], motions[:, 4] = 0.06, 0.02
    found = Prediction.of(path(motions), [np.eye(6)] * 41)
    assert found.sigma[0] == pytest.approx(0.5 * 0.06 / np.sqrt(4 * 3), rel=1e-3)
    assert found.sigma[1] == pytest.approx(0.5 * 0.02 / np.sqrt(3), rel=1e-3)


@pytest.mark.parametrize("n", [0, 1, 2, 3, 5])
def test_few_poses_give_default_growth(n) -> None:
    found = Prediction.of(path(np.full((n, 6), 0.1))[:n], [NONE] * n)
    assert np.isfinite(found.sigma).all()
    assert min(found.sigma) > 0
    assert found.power == (2.0, 2.0)


@pytest.mark.parametrize("sigma", [0.02, 0.3, 3.0])
def test_prediction_replaces_the_prior_of_the_alignment(sigma) -> None:
    """Otherwise no motion along a wall would be less certain than that prior, however long."""
    rng = np.random.default_rng(8)
    root = rng.standard_normal((6, 6)) * UNITS[:, None]
    directions = np.linalg.qr(rng.standard_normal((6, 2)))[0].T
    C = with_prior(root @ root.T, directions, np.full(6, 0.3))
    found = np.linalg.inv(with_prediction(np.linalg.inv(C), directions * UNITS, (sigma, sigma)))
    expected = with_prior(C, directions, np.full(6, sigma))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())


def along(speeds):
    """Poses (N, 4, 4) of a camera that moves along x by `speeds` (N - 1,), in m per frame."""
    return path(np.array(speeds)[:, None] * np.eye(6)[0])


N = 30


def between(blind, speeds, spans=None):
    """Steps at `blind` frames from frame 15 on, and the others before them."""
    bounded = np.ones(N, np.bool_)
    bounded[15 : 15 + blind] = False
    unobservable = [NONE if known else SOME for known in bounded]
    spans = np.ones(N - 1) if spans is None else spans
    return steps_between_bounded(along(speeds), unobservable, bounded, spans)


@pytest.mark.parametrize("blind", [1, 2, 3, 8])
def test_stop_on_the_way_is_within_two_sigma_of_even_motion(blind) -> None:
    """The camera stops first and then hurries, or the other way round; the ends are known."""
    speed = 0.02
    steps = between(blind, [speed] * (N - 1))
    assert [k for k, _ in steps] == list(range(15, 16 + blind))
    variance = np.cumsum([covariance[0, 0] for _, covariance in steps])[:-1]
    nearer = np.minimum(variance, variance[::-1])
    stopped = speed * np.minimum(np.arange(1, blind + 1), np.arange(blind, 0, -1))
    assert (stopped < 2 * np.sqrt(nearer)).all()
    assert (2 * np.sqrt(nearer) < 2 * stopped + 0.02).all()


def test_unobserved_motion_over_a_gap_is_less_certain() -> None:
    speeds, spans = np.full(N - 1, 0.02), np.ones(N - 1)
    (_, short), *_ = between(1, speeds)
    speeds[14:16], spans[14:16] = 0.1, 5.0
    (_, long), *_ = between(1, speeds, spans)
    assert long[0, 0] > 4**2 * short[0, 0]


def test_slide_of_a_registration_counts_as_error() -> None:
    speeds = np.full(N - 1, 0.02)
    (_, even), *_ = between(1, speeds)
    speeds[14] += 0.1
    speeds[15] -= 0.1
    (_, slid), *_ = between(1, speeds)
    assert slid[0, 0] == pytest.approx(even[0, 0] + 0.1**2, rel=0.1)


def turning(rng, angle):
    """Poses (N, 4, 4) of a camera whose direction scatters by an angle, rad, across x."""
    motions = 0.02 * np.eye(6)[np.zeros(N - 1, int)]
    motions[:, 1:3] = 0.02 * angle * rng.standard_normal((N - 1, 2))
    return path(motions)


def test_direction_is_as_certain_as_elsewhere() -> None:
    """Along the path the camera may have stopped; across it moved as in the measured frames."""
    bounded = np.ones(N, np.bool_)
    bounded[15:18] = False
    unobservable = [NONE if known else SOME for known in bounded]
    across = {}
    for angle in (0.1, 0.3):
        variances = np.zeros((4, 3))
        for seed in range(50):
            poses = turning(np.random.default_rng(seed), angle)
            steps = steps_between_bounded(poses, unobservable, bounded, np.ones(N - 1))
            variances += [np.diag(covariance)[:3] / 50 for _, covariance in steps]
        assert 0.5 * 0.02 <= np.sqrt(variances[0, 0]) < 0.02
        across[angle] = np.sqrt(variances[0, 1:].mean())
        assert angle * 0.02 < across[angle] < 2.5 * angle * 0.02
    assert across[0.3] < 0.025


def test_direction_is_unknown_if_few_frames_are_measured() -> None:
    bounded = np.ones(N, np.bool_)
    bounded[8:24] = False
    unobservable = [NONE if known else SOME for known in bounded]
    poses = along([0.02] * (N - 1))
    (_, covariance), *_ = steps_between_bounded(poses, unobservable, bounded, np.ones(N - 1))
    assert covariance[1, 1] == pytest.approx(covariance[0, 0], rel=0.01)


def test_unobserved_ends_and_cameras_of_unknown_speed_stay_unbounded() -> None:
    poses, spans = along([0.02] * (N - 1)), np.ones(N - 1)
    bounded = np.ones(N, np.bool_)
    bounded[:3] = bounded[-4:] = False
    unobservable = [NONE if known else SOME for known in bounded]
    assert steps_between_bounded(poses, unobservable, bounded, spans) == []
    bounded[3:25] = False
    bounded[10] = True
    assert steps_between_bounded(poses, unobservable, bounded, spans) == []
