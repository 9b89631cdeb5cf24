"""The flat of four rooms and the walk through it."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.geometry import se3
from tofuse.lab.scenes.flat import DOOR, HALF, ROOMS, T_flat_room
from tofuse.lab.world.scene import build

ALL_AROUND = np.random.default_rng(30).normal(size=(40000, 3))
ALL_AROUND /= np.linalg.norm(ALL_AROUND, axis=1, keepdims=True)


@pytest.fixture(scope="module", params=["flat", "flat-alike"])
def flat(request):
    return build(request.param)


def test_walk_visits_all_rooms_and_returns(flat) -> None:
    _, sequence = flat
    times = np.arange(0, sequence.frames, 3) / sequence.frame_rate_hz
    places = np.array([sequence.T_room_camera(t)[:3, 3] for t in times])
    assert 20 < np.linalg.norm(np.diff(places, axis=0), axis=1).sum() < 24
    of_quarter = {(False, False): 0, (True, False): 1, (True, True): 2, (False, True): 3}
    rooms = [of_quarter[x > 0, y > 0] for x, y, _ in places]
    assert [a for a, b in zip(rooms, [None, *rooms[:-1]], strict=True) if a != b] == [0, 1, 2, 3, 0]
    speed = np.linalg.norm(np.diff(places, axis=0), axis=1) * 10
    assert speed.min() > 0.2
    assert speed.max() < 1.2
    assert np.linalg.norm(places[-1] - places[0]) < 0.2
    off = se3.inverse(sequence.T_room_camera(times[0])) @ sequence.T_room_camera(times[-1])
    assert np.degrees(se3.angle(off)) < 10


def test_rooms_are_closed_except_for_doorways(flat) -> None:
    scene, _ = flat
    for room in range(ROOMS):
        T = T_flat_room(room)
        origin = se3.transform(T, np.array([[0.0, 0.0, 2.3]]))[0]
        hits = scene.cast(origin, ALL_AROUND)
        assert np.isfinite(hits.distance).all()
        # Rays leave the room only through its two doorways.
        seen = se3.transform(se3.inverse(T), origin + hits.distance[:, None] * ALL_AROUND)
        beyond = np.abs(seen[:, :2]).max(1) > HALF + 0.13
        assert 0 < beyond.mean() < 0.05
        low = ALL_AROUND[beyond] @ T[:3, :3]
        x, y = low[:, 0], low[:, 1]
        through = (x > np.abs(y) * HALF / (DOOR / 2)) | (y > np.abs(x) * HALF / (DOOR / 2))
        assert through.all()
