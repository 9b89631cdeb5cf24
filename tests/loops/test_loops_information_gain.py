"""Information gain of loops, by a scalar model of the positions."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.loops.information_gain import InformationGain

SIGMA2 = 0.02**2  # of a loop


def bits(relative: float) -> float:
    return float(np.round(0.5 * np.log2(1 + relative / SIGMA2)))


def test_gain_is_that_of_the_relative_position():
    gain = InformationGain(np.array([0.0, 1.0, 4.0]))
    assert gain.of(0, 2) == gain.of(2, 0) == bits(4.0)
    assert gain.of(1, 2) == bits(3.0)
    assert gain.of(1, 1) == 0
    np.testing.assert_array_equal(gain.of(np.array([0, 1]), 2), [bits(4.0), bits(3.0)])


def test_loops_reduce_the_gain_of_others():
    """A random walk between two positions known relative to each other is a Brownian bridge."""
    gain = InformationGain(np.linspace(0, 4, 9))
    gain.add(0, 8)
    assert gain.of(0, 8) == bits(1 / (1 / 4.0 + 1 / SIGMA2)) <= 1
    assert gain.of(0, 4) == pytest.approx(bits(4 * 0.5 * 0.5), abs=1)
    # Outside of the loop nothing changes.
    gain = InformationGain(np.linspace(0, 4, 9))
    gain.add(0, 4)
    assert gain.of(4, 8) == bits(2.0)
    # What two loops connect with a third place is known relative to each other.
    gain.add(0, 8)
    assert gain.of(4, 8) <= 1


def test_order_of_loops_does_not_matter():
    one, other = (InformationGain(np.linspace(0, 9, 10)) for _ in range(2))
    loops = [(0, 5), (2, 9), (1, 6)]
    for pair in loops:
        one.add(*pair)
    for pair in reversed(loops):
        other.add(*pair)
    i, j = np.triu_indices(10, 1)
    np.testing.assert_array_equal(one.of(i, j), other.of(i, j))


def test_successive_ones_of_many_views_share_a_position():
    gain = InformationGain(np.linspace(0, 100, 5000))
    assert gain.of(0, 4999) == bits(100)
    assert gain.of(2500, 2501) == 0
    gain.add(0, 4999)
    assert gain.of(3, 4997) <= 1
