"""Causes of the errors of poses, by simulated errors of all kinds."""

from __future__ import annotations

import re

import numpy as np
import pytest
from tests.helpers.measured_graph import DEPTH_M, RIGID, jumped, measured

from tofuse.apps.jobs.pose_scale import with_scale
from tofuse.engine.geometry import se3
from tofuse.engine.quality.pose_causes import _Hypothesis, _words, cause_of
from tofuse.engine.quality.pose_deviation import deviation, fitted

RATE_HZ = 10.0


def walk(count=32):
    """Poses along a bent path of 4 m, whose camera looks around."""
    s = np.linspace(0, 1, count)
    twists = np.stack([4 * s, 0.3 * np.sin(5 * s), s**2, 0.2 * np.sin(9 * s), 3 * s, 0.1 * s], 1)
    return se3.exp(twists)


def velocity(poses):
    """(V, 6) motion per second."""
    steps = se3.log(se3.inverse(poses[:-1]) @ poses[1:]) * RATE_HZ
    return np.concatenate([steps[:1], 0.5 * (steps[:-1] + steps[1:]), steps[-1:]])


def drifted(poses, per_step):
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    length = np.linalg.norm(steps[:, :3, 3], axis=1) + DEPTH_M * se3.angle(steps)
    out = [poses[0]]
    for step in steps @ se3.exp(length[:, None] / length.sum() * np.asarray(per_step)):
        out.append(out[-1] @ step)
    return np.array(out)


WRONG = {
    "scale": lambda T: with_scale(T, 1.1),
    "time": lambda T: T @ se3.exp(-0.05 * velocity(T)),
    "mount": lambda T: T @ se3.exp(np.array([0.06, 0, 0.09, 0, 0.06, 0])),
    "turning": lambda T: drifted(T, [0, 0, 0, 0.02, 0.08, 0]),
    "drift": lambda T: drifted(T, [0.2, 0.1, 0.3, 0.04, 0.06, 0]),
    "jump": lambda T: jumped(T, [0.04, 0.02, 0, 0, 0.03, 0]),
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", WRONG)
def test_each_cause_is_named(kind, seed) -> None:
    truth = walk()
    wrong = RIGID @ WRONG[kind](truth)
    found = cause_of(deviation(fitted(measured(truth, seed=seed), DEPTH_M), wrong), velocity(wrong))
    assert found is not None
    assert found.kind == kind
    assert found.explained > 0.7
    assert found.frames == ((15, 16) if kind == "jump" else None)
    size = {
        "scale": r"1\.[01]\d* times",
        "time": r"lag behind .* (49|50|51) ms",
        "jump": r"4\d mm and 1\.[67]",
    }
    assert re.search(size.get(kind, ""), found.text)


@pytest.mark.parametrize("seed", range(5))
def test_no_cause_of_correct_poses_nor_of_unrelated_errors(seed) -> None:
    truth = walk()
    fit = fitted(measured(truth, seed=seed), DEPTH_M)
    rng = np.random.default_rng(seed)
    for sigma in (0.0, 0.002, 0.02):
        poses = truth @ se3.exp(sigma * rng.standard_normal((len(truth), 6)))
        assert cause_of(deviation(fit, poses), velocity(poses)) is None


@pytest.mark.parametrize("seed", range(3))
def test_no_cause_of_poses_of_another_path(seed) -> None:
    """Neither a jump of a step, as all steps are wrong, nor drift by a whole turn."""
    truth = walk()
    fit = fitted(measured(truth, seed=seed, reach=12), DEPTH_M)
    steps = np.random.default_rng(seed).normal(0, [0.1, 0.03, 0.1, 0.02, 0.2, 0.02], (32, 6))
    for poses in (truth[::-1], se3.exp(np.cumsum(steps, 0))):
        assert cause_of(deviation(fit, poses), velocity(poses)) is None


def test_large_angles_have_no_exponent() -> None:
    turning = _Hypothesis("turning", np.zeros((2, 6, 3)))
    assert "by 220\N{DEGREE SIGN} in total" in _words(turning, np.array([0, 3.84, 0]), None)


def test_unknown_times_exclude_an_offset() -> None:
    truth = walk()
    wrong = WRONG["time"](truth)
    fit = fitted(measured(truth), DEPTH_M)
    found = cause_of(deviation(fit, wrong), np.full((len(truth), 6), np.nan))
    assert found is None or found.kind != "time"
