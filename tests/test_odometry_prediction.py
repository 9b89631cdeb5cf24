"""How far off an extrapolated motion is."""

import numpy as np
import pytest

from tofuse.odometry.prediction import growth, runs

NONE, SOME = np.zeros((0, 6)), np.eye(6)[:1]


def test_runs_of_degenerate_frames() -> None:
    assert runs([NONE, SOME, SOME, NONE, SOME]).tolist() == [0, 1, 2, 0, 1]
    assert runs([SOME, SOME]).tolist() == [1, 2]
    assert runs([]).tolist() == []


@pytest.mark.parametrize("n", [3, 20])
def test_errors_grow_as_those_of_a_velocity_that_wanders(n) -> None:
    """Frame by frame, or over all frames at once: as in many draws of a random walk."""
    step = np.random.default_rng(1).standard_normal((20_000, n))
    expected = np.cumsum(np.cumsum(step, axis=1), axis=1)[:, -1].std()
    single = np.sqrt(sum(growth(k, 1) ** 2 for k in range(1, n + 1)))
    assert single == pytest.approx(expected, rel=0.03)
    assert growth(n, n) == pytest.approx(single)
    # Beside a later frame of the run, the velocity is off from the first one on.
    assert growth(n, 2) == pytest.approx(np.hypot(n - 1, n))


def test_one_prediction_is_off_by_its_own_error() -> None:
    assert growth(1, 1) == 1
    assert growth(0, 0) == 0
