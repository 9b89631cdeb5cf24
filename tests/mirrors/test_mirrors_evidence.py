"""What tells a mirror: how two paths add up, ambiguous ranges, planes and rooms that are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.apps.mirrors.finding import _behind
from tofuse.apps.mirrors.openings import Opening, Plane
from tofuse.apps.mirrors.reflection import Evidence, _shortened, predict, weigh
from tofuse.apps.mirrors.views import Noise, View, with_too_short, wrapped
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


def _wall() -> tuple[np.ndarray, np.ndarray]:
    grid = np.stack(np.meshgrid(*[np.linspace(-0.7, 0.7, 41)] * 2), -1).reshape(-1, 2)
    wall = np.c_[grid, 0.05 * grid[:, 0]]
    return wall, np.tile(np.array([-0.05, 0.0, 1.0]) / np.hypot(0.05, 1.0), (len(wall), 1))


def test_tilt_is_that_of_the_surface_around_the_opening() -> None:
    wall, normals = _wall()
    assert _OPENING.tilt_rad(wall, normals, 0.1) == pytest.approx(np.arctan(0.05), abs=1e-6)
    # The surface in the opening itself says nothing.
    inside = _OPENING.contains(wall)
    assert np.isinf(_OPENING.tilt_rad(wall[inside], normals[inside], 0.1))


@pytest.mark.parametrize(("share", "expected"), [(0.3, np.arctan(0.05)), (0.7, np.inf)])
def test_furniture_before_a_wall_does_not_tilt_it(share: float, expected: float) -> None:
    wall, normals = _wall()
    furniture = np.random.default_rng(0).random(len(wall)) < share
    normals[furniture] = (1.0, 0.0, 0.0)
    assert _OPENING.tilt_rad(wall, normals, 0.1) == pytest.approx(expected, abs=1e-6)


def test_a_camera_goes_through_a_door_but_not_through_a_mirror() -> None:
    path = np.array([(2.0, 0.0, 1.0), (2.0, 0.0, -1.0), (0.2, 0.0, -1.0)])
    assert not _OPENING.crossed_by(path)
    assert _OPENING.crossed_by(np.concatenate([path, [(0.2, 0.0, 1.0)]]))


_NOISE = Noise(0.02, 2.0, 0.0)


def _room() -> tuple[np.ndarray, np.ndarray]:
    """Return a bumpy wall opposite of the mirror, behind the camera, and its normals."""
    grid = np.stack(np.meshgrid(*[np.linspace(-3.0, 3.0, 121)] * 2), -1).reshape(-1, 2)
    wall = np.c_[grid, 3.0 + 0.4 * np.sin(3 * grid[:, 0]) + 0.3 * np.cos(4 * grid[:, 1])]
    return wall, np.tile([0.0, 0.0, -1.0], (len(wall), 1))


def _before_the_mirror(ranges: np.ndarray | float) -> View:
    """A camera 1.5 m in front of the mirror that looks at it."""
    T = se3.exp(np.array([0, 0, 0, np.pi, 0, 0]))
    T[2, 3] = 1.5
    camera = Pinhole(60, 60, 70.0, 70.0, 29.5, 29.5)
    return View(
        camera,
        T,
        np.broadcast_to(ranges, (60, 60)).copy(),
        None,
        0.6,
        np.inf,
        np.zeros((60, 60), bool),
    )


def _shown(share_on_plane: float) -> Evidence:
    """Weigh what a mirror shows, with light from the glass in a share of the pixels."""
    points, normals = _room()
    view = _before_the_mirror(1.0)
    images = _OPENING.plane.reflected(points)
    rows, pixels = view.visible(images)
    ranges = np.zeros((60, 60))
    ranges[tuple(pixels.T)] = np.linalg.norm(images[rows] - view.origin, axis=1)
    rays = view.camera.rays()
    hidden = np.random.default_rng(0).random((60, 60)) < share_on_plane
    ranges[hidden] = 1.5 * np.hypot(1, np.linalg.norm(rays, axis=-1))[hidden]
    return weigh(_OPENING, [_before_the_mirror(ranges)] * 2, points, normals, _NOISE)


def test_light_from_the_glass_itself_does_not_contradict_a_mirror() -> None:
    hidden = _shown(0.8)
    assert hidden.share > 0.9
    assert hidden.log_ratio > 7


def test_what_stands_before_a_mirror_hides_its_image() -> None:
    points, normals = _room()
    box = np.stack(np.meshgrid(*[np.linspace(-0.2, 0.2, 21)] * 2), -1).reshape(-1, 2)
    box = np.c_[box, np.full(len(box), 0.5)]
    view = _before_the_mirror(3.0)

    def count(points: np.ndarray, normals: np.ndarray) -> int:
        return len(predict(_OPENING, _OPENING.plane, [view], points, normals, _NOISE))

    alone = count(points, normals)
    with_box = np.r_[points, box], np.r_[normals, np.tile([0.0, 0.0, 1.0], (len(box), 1))]
    assert 0 < count(*with_box) < 0.8 * alone


def test_of_a_surface_whose_back_is_in_the_model_nothing_is_predicted() -> None:
    points, normals = _room()
    view = _before_the_mirror(3.0)
    assert len(predict(_OPENING, _OPENING.plane, [view], points, normals, _NOISE)) > 100
    assert not len(predict(_OPENING, _OPENING.plane, [view], points, -normals, _NOISE))


@pytest.mark.parametrize("is_mirror", [True, False])
@pytest.mark.parametrize("far_wall", [True, False])
def test_a_room_like_the_reflection_has_no_second_path(is_mirror: bool, far_wall: bool) -> None:
    """Side walls that the camera illuminates directly, too, as in an aisle, tell it."""
    y, z = np.meshgrid(np.linspace(-0.45, 0.45, 61), np.linspace(0.1, 0.45, 41))
    sides = [np.stack([side + 0 * y, y, z], -1).reshape(-1, 3) for side in (-0.45, 0.45)]
    points = np.concatenate(sides)
    normals = np.repeat([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], len(sides[0]), axis=0)
    if far_wall:
        points, normals = np.r_[points, _room()[0]], np.r_[normals, _room()[1]]
    seen = predict(_OPENING, _OPENING.plane, [_before_the_mirror(4.0)], points, normals, _NOISE)
    ranges = np.full(60 * 60, 4.0)
    shorter = 0.5 * (seen.length - seen.direct)
    ranges[seen.pixels] = seen.length - is_mirror * seen.direct_share * shorter
    evidence = weigh(
        _OPENING, [_before_the_mirror(ranges.reshape(60, 60))] * 2, points, normals, _NOISE
    )
    assert (evidence.log_ratio > 7) == is_mirror


def _view_from_behind(range_m: float) -> View:
    """A camera 2 m behind the plane that looks at it, and measures one range everywhere."""
    T = np.eye(4)
    T[2, 3] = -2.0
    camera = Pinhole(40, 30, 35.0, 35.0, 19.5, 14.5)
    none = np.zeros((30, 40), bool)
    return View(camera, T, np.full((30, 40), range_m), None, 0.6, np.inf, none)


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
    assert _OPENING.seen_by(replace(behind, T_world_camera=turned), 0.0)
    turned = turned.copy()
    turned[0, 3] = 5.0
    assert not _OPENING.seen_by(replace(behind, T_world_camera=turned), 0.0)


def test_ranges_are_too_short_where_other_views_see_through() -> None:
    """A box at 1.5 m is there for every view; a range of 6.5 m, wrapped at 5, moves with each."""
    camera = Pinhole(40, 30, 35.0, 35.0, 19.5, 14.5)
    rays = np.concatenate([camera.rays(), np.ones((30, 40, 1))], -1)
    lengths = np.linalg.norm(rays, axis=-1)
    views, wraps, boxes = [], [], []
    for x in np.linspace(-0.5, 0.5, 9):
        T = np.eye(4)
        T[0, 3] = x
        at_wall = 4 * rays[..., 0] + x
        beyond = (at_wall > 0.3) & (at_wall < 1.2)
        box = np.abs(1.5 * rays[..., 0] + x + 0.6) < 0.15
        z = np.where(box, 1.5, np.where(beyond, 6.5, 4.0))
        ranges = np.where(beyond & ~box, (z * lengths) % 5.0, z * lengths)
        ranges[beyond & ~box & (z * lengths < 5.0)] = 0
        views.append(View(camera, T, ranges, None, 0.6, 5.0, np.zeros((30, 40), bool)))
        wraps.append(beyond & ~box)
        boxes.append(box)
    found = [view.too_short for view in with_too_short(views, 0.1)]
    assert np.concatenate(found)[np.concatenate(wraps)].mean() > 0.8
    assert np.concatenate(found)[np.concatenate(boxes)].mean() < 0.1
    assert not np.concatenate(found)[~np.concatenate(wraps) & ~np.concatenate(boxes)].any()
    endless = [replace(view, ambiguity_m=np.inf) for view in views]
    assert not any(view.too_short.any() for view in with_too_short(endless, 0.1))
