"""Static cameras around a moving object: their poses and clocks."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from pose_errors import assert_near
from refused import refused
from rig_room import ROOM
from rig_scene import CAMERA, looked_at
from tofuse.apps.rigs.calibrating import calibrate_cameras
from tofuse.apps.rigs.inputs import Calibration, Camera
from tofuse.apps.rigs.static_rig import minimum_cost_lag
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.lab.simulation.rig import camera_ring, relative

STANDS = [
    camera_ring((0.4, 0, 0.5), 1.6, 0.5, 1, np.pi + (k - 0.5) * np.radians(25))[0] for k in (0, 1)
]
INTERVAL_S = 0.1
Board = tuple[tuple[float, ...], float, float]


def board(centre: np.ndarray, half: float) -> Board:
    distance = float(np.linalg.norm(centre))
    return tuple(centre / distance), distance, half


def phase(t: float) -> float:
    """Of varying speed, so that no other offset fits as well."""
    return 2.1 * t + 1.3 * np.sin(0.9 * t) + 0.7 * np.sin(2.3 * t + 1)


def towards(t: float) -> Board:
    """A board that moves towards the cameras and away from them."""
    at = phase(t)
    return board(np.array([-0.45 + 0.12 * np.sin(at), 0.05 * np.sin(0.7 * at), 0.3]), 0.3)


def sideways(t: float) -> Board:
    at = phase(t)
    return board(np.array([0.2 + 0.1 * np.sin(0.8 * at), 0.45 * np.sin(at), 0.75]), 0.4)


def filmed(k: int, clock_s: float, moving: Callable[[float], Board]) -> Camera:
    """Images of a camera whose clock shows `clock_s` less than the time."""
    rng = np.random.default_rng([k, 5])
    frames = []
    for i in range(60):
        t = (i + 0.4 * k) * INTERVAL_S
        image = looked_at(STANDS[k], rng, 0.0, (*ROOM, moving(t)))
        frames.append(RangeFrame(i, t - clock_s, CAMERA, image.depth, "z", None))
    return Camera(f"cam{k}", Recording.of(ArraySource(frames), f"cam{k}", "array"))


def calibrated(clock_s: float, moving: Callable[[float], Board]) -> Calibration:
    return calibrate_cameras([filmed(0, 0.0, moving), filmed(1, clock_s, moving)])


@pytest.mark.nightly
def test_clocks_are_aligned_by_motion_and_all_instants_are_used() -> None:
    found = calibrated(100.0, towards)
    assert found.how == "60 instants"
    camera = found.rig.cameras[1]
    assert abs(camera.time_offset_s - 100.0) < INTERVAL_S
    assert any("cam1 differs by 100.00 s" in note for note in found.notes)
    assert_near(camera.T_rig_camera, relative(STANDS)[1], 0.002, 0.05)


def test_clocks_not_determined_by_motion_are_refused() -> None:
    refused("no motion that both see determines the offset", 100.0, sideways, by=calibrated)


def costs_at(lags: np.ndarray, noise: float, motion: Callable[[np.ndarray], np.ndarray], seed: int):
    """Distances between surfaces at lags, of ten instants with different moving fractions."""
    rng = np.random.default_rng(seed)
    still, moves = rng.normal(5, 0.5, (10, 1)), rng.uniform(0.3, 1.7, (10, 1))
    return still + moves * motion(lags / INTERVAL_S) + rng.normal(0, noise, (10, len(lags)))


LAGS = np.arange(-6, 7) * INTERVAL_S


def test_lag_of_minimum_distance_is_interpolated() -> None:
    for seed in range(20):
        costs = costs_at(LAGS, 0.05, lambda x: np.minimum((x - 1.3) ** 2, 9), seed)
        assert abs(minimum_cost_lag(LAGS, costs) - 1.3 * INTERVAL_S) < 0.1 * INTERVAL_S
