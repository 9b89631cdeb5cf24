"""Simulated mirrors: the image in a mirror is that of the mirrored camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.engine.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.lab.simulation import Effects, optics
from tofuse.lab.simulation.mirrors import Mirror, hang_mirror
from tofuse.lab.simulation.models import CameraModel, camera_model
from tofuse.lab.simulation.render import render
from tofuse.lab.world import scene as scenes

_TIME = 1.0


def _room() -> tuple[scenes.Scene, scenes.Scene, scenes.Sequence, CameraModel, Mirror]:
    plain, sequence = scenes.build("room", seed=2)
    model = replace(camera_model("kinect2"), camera=Pinhole(80, 60, 70.0, 70.0, 39.5, 29.5))
    times = np.array([_TIME])
    scene, mirror = hang_mirror(plain, sequence, model, (0.7, 0.9), times=times, seed=4)
    return plain, scene, sequence, model, mirror


def _seen_in_it() -> tuple[np.ndarray, optics.Returns, np.ndarray]:
    """Rays that hit the mirror, what they return, and the ranges of the mirrored camera."""
    plain, scene, sequence, model, mirror = _room()
    T = sequence.T_room_camera(_TIME)
    rays = optics.ray_grid(model, False).directions.reshape(-1, 3)
    returns = optics.trace(scene, model, rays, T, None, gloss=True)
    hit = returns.surface == len(scene.materials) - 1
    n = mirror.normal
    reflect = np.eye(3) - 2 * np.outer(n, n)
    origin = reflect @ (T[:3, 3] - mirror.centre) + mirror.centre
    directions = (rays @ T[:3, :3].T @ reflect)[hit]
    # The mirrored camera looks through the mirror as through a window in the wall.
    to_window = ((mirror.centre - origin) @ n) / (directions @ n)
    start = origin + (to_window + 1e-3)[:, None] * directions
    behind = plain.cast(start, directions).distance + to_window + 1e-3
    return hit, returns, behind


def test_path_is_that_of_the_mirrored_camera() -> None:
    hit, returns, expected = _seen_in_it()
    assert hit.sum() > 100
    np.testing.assert_allclose(returns.path[hit, 1] / 2, expected, atol=3e-4)
    assert (returns.strength[hit, 0] < 1e-6).all()


def test_range_is_the_whole_path() -> None:
    hit, returns, expected = _seen_in_it()
    _, scene, sequence, model, _ = _room()
    k = round(_TIME * sequence.frame_rate_hz)
    frame = render(scene, sequence, model, k, effects=Effects.none(gloss=True)).frame
    not_lit = returns.strength[hit, 2] < 1e-9
    assert not_lit.sum() > 30
    measured = frame.radial_range.reshape(-1)[hit]
    np.testing.assert_allclose(measured[not_lit], expected[not_lit], atol=2e-3)


def test_light_directly_from_the_lamp_is_on_a_shorter_path() -> None:
    hit, returns, _ = _seen_in_it()
    lit = hit & (returns.strength[:, 2] > 0)
    assert (returns.path[lit, 2] <= returns.path[lit, 1] + 1e-9).all()


def test_no_wall_has_room_for_it() -> None:
    scene, sequence = scenes.build("room", seed=2)
    model = camera_model("kinect2")
    with pytest.raises(InputError, match="no wall in view"):
        hang_mirror(scene, sequence, model, (9.0, 1.0), times=np.array([_TIME]), seed=4)
