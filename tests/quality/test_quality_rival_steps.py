"""Scenes that repeat themselves: a rival step within reach is found, and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.helpers.made_rooms import CAMERA, at, seen, surface

from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.mapping.mapper import Mapper
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.quality.rival_steps import ambiguous_frames
from tofuse.engine.stored_views.view_store import PosedView
from tofuse.engine.tracking.motion import FrameTime

PERIOD = 0.3
STEP = (0.02, 0.01, 0.0)


def tiles(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The height of a floor that is the same after a period in x and in y."""
    return 0.02 * (np.sin(2 * np.pi * x / PERIOD) + np.cos(2 * np.pi * y / PERIOD))


def blocks(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The height of blocks with steep sides, which repeat themselves as the tiles do."""
    x, y = np.sin(2 * np.pi * x / PERIOD), np.cos(2 * np.pi * y / PERIOD)
    return 0.02 * np.tanh(3 * x) * np.tanh(3 * y)


def relief(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The height of a floor that never repeats itself."""
    return 0.02 * (np.sin(9 * x + 3 * y**2) + np.cos(8 * y + 4 * x**2))


def flat(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The height of a floor along which the motion is not determined at all."""
    return 0.0 * x


def floor_from_above(height, k: int, noise: float = 0.001, step=STEP) -> RangeFrame:
    """The k-th view of a floor 1.5 m away, a step further each time."""
    rays = CAMERA.rays()
    z = np.full((CAMERA.height, CAMERA.width), 1.5)
    origin = k * np.array(step)
    for _ in range(30):
        z = 1.5 - height(*(rays * z[..., None] + origin[:2]).transpose(2, 0, 1))
    z += noise * np.random.default_rng(k).standard_normal(z.shape)
    return RangeFrame(k, 0.5 * k, CAMERA, z.astype(np.float32), "z")


def patterned(height, pattern, k: int, noise: float, step) -> RangeFrame:
    """The same with the amplitude of a matt floor, its albedo a pattern of x and y."""
    frame, rays = floor_from_above(height, k, 0.005, step), CAMERA.rays()
    z = np.asarray(frame.z, float)
    x, y = (rays * z[..., None] + k * np.array(step[:2])).transpose(2, 0, 1)
    slope = [(height(x + d, y + e) - height(x, y)) / 1e-4 for d, e in ((1e-4, 0), (0, 1e-4))]
    length2 = 1 + (rays**2).sum(-1)
    facing = np.abs(rays[..., 0] * slope[0] + rays[..., 1] * slope[1] + 1)
    cosine = facing / np.sqrt(length2 * (1 + slope[0] ** 2 + slope[1] ** 2))
    relative = 1 + noise * np.random.default_rng(100 + k).standard_normal(z.shape)
    amplitude = (3000 * pattern(x, y) * cosine / (z**2 * length2) * relative).astype(np.float32)
    return replace(frame, amplitude_image=amplitude)


def joints(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Albedo that is the same after a period: dark joints between tiles."""
    return np.where((x % PERIOD < 0.02) | (y % PERIOD < 0.02), 0.5, 1.0)


def stains(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Albedo that never repeats itself."""
    return 1 + 0.3 * np.sin(9 * x + 5 * y**2) * np.cos(8 * y + 3 * x**2)


def found(frames, poses, seconds: float) -> tuple[int, ...]:
    """The frames to which another step fits, if they were taken this long after each other."""
    views = [PosedView(surface(frame), T) for frame, T in zip(frames, poses, strict=True)]
    moments = [FrameTime(k, 5.0 + seconds * k) for k in range(len(frames))]
    return ambiguous_frames(views, dict(enumerate(poses)), moments)


def above(height, seconds: float, count: int = 3) -> tuple[int, ...]:
    poses = [se3.translation(k * np.array(STEP)) for k in range(count)]
    return found([floor_from_above(height, k) for k in range(count)], poses, seconds)


def test_floor_of_tiles_is_ambiguous_where_a_step_by_a_tile_is_possible() -> None:
    assert above(tiles, 0.5) == (1, 2)
    assert above(tiles, 0.1) == ()  # 3 m/s would be necessary


def along(height, seconds: float, step: float = 0.16, count: int = 8) -> tuple[int, ...]:
    """The same for a camera that moves by more than half a period at a time."""
    steps = (step, 0.0, 0.0)
    frames = [floor_from_above(height, k, step=steps) for k in range(count)]
    return found(frames, [se3.translation(k * np.array(steps)) for k in range(count)], seconds)


def test_fast_camera_may_have_moved_the_other_way_if_nothing_contradicts() -> None:
    def marked(x, y):  # in view of some frames
        return tiles(x, y) + 0.1 * np.exp(-((x - 1.8) ** 2 + y**2) / 0.2)

    assert along(tiles, 0.1) == (1, 3, 5, 7)  # by 0.14 m
    assert along(marked, 0.1) == ()  # as it would have to turn round where the mark is seen
    assert along(relief, 0.1) == ()
    assert along(tiles, 0.03) == ()  # at 4.7 m/s


@pytest.mark.parametrize("height", [tiles, blocks])
def test_camera_that_seems_to_stand_still_may_have_moved_by_a_period(height) -> None:
    mapper = Mapper(from_method("default"), threads=1)
    for k in range(6):
        mapper.push(floor_from_above(height, k, step=(PERIOD, 0.0, 0.0)))
    result = mapper.finish()
    assert np.linalg.norm(result.trajectory[-1][:3, 3]) < 0.01
    assert "ambiguous_steps" in [reason.code for reason in result.diagnostics.reasons]
    assert np.isinf(result.diagnostics.accuracy.position_m)


@pytest.mark.parametrize("noise", [0.01, 0.15])
@pytest.mark.parametrize("height", [tiles, blocks, flat])
@pytest.mark.parametrize("step", [STEP, (0.1, 0.05, 0.0)])
def test_pattern_decides_whether_a_floor_repeats_itself(height, noise, step) -> None:
    poses = [se3.translation(k * np.array(step)) for k in range(3)]
    for pattern, expected in ((joints, (1, 2)), (stains, ())):
        frames = [patterned(height, pattern, k, noise, step) for k in range(3)]
        assert found(frames, poses, 0.5) == expected


@pytest.mark.parametrize("height", [relief, flat])
def test_other_floors_are_not(height) -> None:
    assert above(height, 0.5) == ()


def test_ordinary_room_has_no_rival_steps() -> None:
    poses = [at(0.1 * k, -0.5, 0.1 * k) for k in range(4)]
    assert found([seen(T, k) for k, T in enumerate(poses)], poses, 0.5) == ()


def test_frames_without_times_are_not_examined() -> None:
    frames = [floor_from_above(tiles, k) for k in range(2)]
    views = [PosedView(surface(frame), se3.translation(np.array(STEP) * frame.index))
             for frame in frames]  # fmt: skip
    poses = {view.index: view.T_component_camera for view in views}
    assert ambiguous_frames(views, poses, [FrameTime(k, float(k)) for k in range(2)]) == ()
