"""The robustness benchmark: definitions of wrong poses, marked poses and wrong joins; its cases."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from paths import BENCHMARKS
from tofuse.engine.geometry import se3


@pytest.fixture
def scoring(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import scoring

    return scoring


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


# ---- Cases ---------------------------------------------------------------------------------------
