"""Which views look alike: the same view, turned a little, before any other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.maps.surface_map import SurfaceOptions, surface_map
from tofuse.odometry.likeness import likeness, thumbnail
from tofuse.sensor.models import camera_model
from tofuse.simulation.effects import Effects
from tofuse.simulation.render import render
from tofuse.simulation.scene import build


@pytest.fixture(scope="module")
def views():
    """A turn in the room, every 19 degrees."""
    scene, path = build("room")
    effects = Effects.none(shot_noise=True)
    model = camera_model("sr4000")
    return [
        surface_map(render(scene, path, model, k, effects=effects).frame, SurfaceOptions())
        for k in range(0, 384, 20)
    ]


def test_a_thumbnail_is_the_mean_inverse_depth_of_each_cell(views) -> None:
    view = views[0]
    made = thumbnail(view)
    assert made.shape == (9, 12)
    rows, columns = view.z.shape
    for i, j in ((0, 0), (4, 7), (8, 11)):
        picked = [
            1 / float(view.z[r, c])
            for r in range(rows)
            for c in range(columns)
            if r * 9 // rows == i and c * 12 // columns == j and view.z[r, c] > 0
        ]
        assert made[i, j] == pytest.approx(np.log(np.mean(picked)), rel=1e-6)
    empty = replace(view, z=np.where(np.arange(columns) < columns // 2, 0, view.z))
    assert np.isnan(thumbnail(empty)[:, :6]).all()
    np.testing.assert_array_equal(thumbnail(empty)[:, 6:], made[:, 6:])


def test_the_same_place_comes_first(views) -> None:
    known = [thumbnail(view) for view in views]
    for k, look in enumerate(known):
        order = likeness(look, known)
        assert sorted(order) == list(range(len(known)))
        assert order[0] == k


def test_neighbours_come_before_what_is_elsewhere(views) -> None:
    known = [thumbnail(view) for view in views]
    for k, look in enumerate(known[:-1]):
        others = [j for j in range(len(known)) if j != k]
        first = [others[n] for n in likeness(look, [known[j] for j in others])[:5]]
        assert {k - 1, k + 1} & set(first), k


def test_of_equals_the_newest_comes_first(views) -> None:
    look = thumbnail(views[0])
    assert likeness(look, [look, thumbnail(views[9]), look]) == [2, 0, 1]


def test_what_is_unknown_is_unlike(views) -> None:
    look = thumbnail(views[0])
    nothing = np.full_like(look, np.nan)
    far = look + 10.0
    assert likeness(look, [nothing, look, far])[0] == 1
