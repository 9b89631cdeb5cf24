"""What tells a mirror: how two paths add up, ambiguous ranges, planes and rooms that are none."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.apps.mirrors.finding import _behind
from tofuse.apps.mirrors.openings import Opening, Plane
from tofuse.apps.mirrors.reflection import _shortened
from tofuse.apps.mirrors.views import View, wrapped
from tofuse.engine.cameras import Pinhole
from tofuse.engine.geometry import se3

_SQUARE = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
# The plane z = 0, seen from z > 0.
_OPENING = Opening(Plane(np.array([0.0, 0.0, 1.0]), 0.0), _SQUARE, True)


@pytest.mark.parametrize("period_m", [0.75, 1.875, 5.0])
def test_two_paths_add_up_as_phasors(period_m: float) -> None:
    share, shorter = np.array([0.0, 0.3, 0.8, 1.0]), np.full(4, 0.3)
    far = 4.0
    light = (1 - share) * np.exp(2j * np.pi / period_m * far)
    light += share * np.exp(2j * np.pi / period_m * (far - shorter))
    measured = np.angle(light) / (2 * np.pi) * period_m
    expected = far - _shortened(share, shorter, period_m)
    np.testing.assert_allclose(wrapped(measured - expected, period_m), 0, atol=1e-9)


def test_of_long_periods_the_mean_and_of_pulses_the_stronger_path() -> None:
    share, shorter = np.array([0.3, 0.7]), np.full(2, 0.2)
    np.testing.assert_allclose(_shortened(share, shorter, 50.0), share * shorter, atol=1e-4)
    np.testing.assert_allclose(_shortened(share, shorter, np.inf), share * shorter)
    np.testing.assert_allclose(_shortened(share, shorter, 0.0), [0.0, 0.2])


def test_ranges_are_known_up_to_the_ambiguity_range() -> None:
    differences = np.array([-10.1, -4.9, 0.2, 5.1])
    np.testing.assert_allclose(wrapped(differences, 5.0), [-0.1, 0.1, 0.2, 0.1], atol=1e-12)
    np.testing.assert_allclose(wrapped(differences, np.inf), differences)


def test_tilt_is_that_of_the_surface_around_the_opening() -> None:
    grid = np.stack(np.meshgrid(*[np.linspace(-0.7, 0.7, 41)] * 2), -1).reshape(-1, 2)
    wall = np.c_[grid, 0.1 * grid[:, 0]]
    normal = np.array([-0.1, 0.0, 1.0]) / np.hypot(0.1, 1.0)
    normals = np.tile(normal, (len(wall), 1))
    assert _OPENING.tilt_rad(wall, normals, 0.1) == pytest.approx(np.arctan(0.1), abs=1e-6)
    # The surface in the opening itself says nothing.
    inside = _OPENING.contains(wall)
    assert np.isinf(_OPENING.tilt_rad(wall[inside], normals[inside], 0.1))


def _view_from_behind(range_m: float) -> View:
    """A camera 2 m behind the plane that looks at it, and measures one range everywhere."""
    T = np.eye(4)
    T[2, 3] = -2.0
    camera = Pinhole(40, 30, 35.0, 35.0, 19.5, 14.5)
    return View(camera, T, np.full((30, 40), range_m), None, 0.6, np.inf)


@pytest.mark.parametrize(("range_m", "is_room"), [(1.0, True), (1.9, False)])
def test_what_views_from_behind_measure_is_a_room(range_m: float, is_room: bool) -> None:
    angles = np.linspace(-0.3, 0.3, 30)
    points = np.stack([np.sin(angles), 0 * angles, np.cos(angles) - 2.0], -1)
    through = np.ones(len(points), bool)
    behind, room = _behind(
        _OPENING, points.astype(np.float32), through, [_view_from_behind(range_m)], 0.05
    )
    assert room == is_room
    assert behind.all() != is_room


def test_an_opening_is_seen_in_front_of_its_plane_only() -> None:
    behind = _view_from_behind(1.0)
    assert not _OPENING.seen_by(behind, 0.0)
    turned = se3.exp(np.array([0, 0, 0, np.pi, 0, 0]))
    turned[2, 3] = 2.0
    front = View(behind.camera, turned, behind.ranges, None, 0.6, np.inf)
    assert _OPENING.seen_by(front, 0.0)
    turned = turned.copy()
    turned[0, 3] = 5.0
    aside = View(behind.camera, turned, behind.ranges, None, 0.6, np.inf)
    assert not _OPENING.seen_by(aside, 0.0)
