"""Images of a place that the camera visits again and again are thinned."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.geometry import se3
from tofuse.engine.geometry.places import PlaceCounts


def turned(rad: float, x: float = 0.0) -> np.ndarray:
    return se3.exp(np.array([x, 0, 0, 0, rad, 0]))


def kept(places: PlaceCounts, visits: int, T: np.ndarray, depth: float = 2.0) -> int:
    return sum(places.keeps(depth, T) for _ in range(visits))


def test_all_of_the_first_images_of_a_place_are_kept() -> None:
    assert kept(PlaceCounts(0.1, 0.1, 20), 20, turned(0.05)) == 20


@pytest.mark.parametrize("doublings", [1, 3, 8])
def test_number_of_images_grows_with_the_logarithm_of_the_visits(doublings: int) -> None:
    visits = 16 * (2**doublings - 1)
    assert kept(PlaceCounts(0.1, 0.1, 16), visits, turned(0.05)) == 16 * doublings


def test_images_are_thinned_evenly() -> None:
    places = PlaceCounts(0.1, 0.1, 8)
    chosen = np.flatnonzero([places.keeps(2.0, turned(0.05)) for _ in range(1000)])
    steps = np.diff(chosen)
    assert set(steps) <= {1, 2, 4, 8, 16, 32, 64}
    assert (np.diff(steps) >= 0).all()


def test_noise_of_a_still_camera_does_not_divide_its_place() -> None:
    rng = np.random.default_rng(0)
    places = PlaceCounts(0.12, 0.06, 8)
    noise = 0.002 * rng.standard_normal((248, 6))
    assert sum(places.keeps(2.0, se3.exp(x)) for x in noise) == 8 * 5


def test_places_are_apart_by_position_direction_depth_and_component() -> None:
    places = PlaceCounts(0.1, 0.1, 4)
    here = turned(0.05)
    assert kept(places, 100, here) < 25
    assert places.keeps(2.0, turned(0.25))
    assert places.keeps(2.0, turned(0.05, x=0.5))
    assert places.keeps(8.0, here)
    assert places.keeps(2.0, here, component=1)


def test_a_camera_that_moves_on_keeps_all_images() -> None:
    places = PlaceCounts(0.1, 0.1, 4)
    assert all(places.keeps(2.0, turned(0.0, x=0.1 * k)) for k in range(500))
