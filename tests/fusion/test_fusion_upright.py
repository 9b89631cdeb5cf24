"""The up direction of a model, without gravity."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tofuse.engine.fusion.mesh import Mesh
from tofuse.engine.fusion.upright import likely_up, upright
from tofuse.engine.geometry import se3
from tofuse.formats.recordings.open import open_recording

RNG = np.random.default_rng(3)
UP = np.array([0.0, -1.0, 0.0])


def surface(points: np.ndarray, normals: np.ndarray) -> Mesh:
    count = len(points)
    return Mesh(
        points.astype(np.float32),
        np.zeros((0, 3), np.int32),
        normals.astype(np.float32),
        None,
        np.full(count, 0.001, np.float32),
        np.ones(count, np.int32),
    )


def room(*, floor: int = 900, ceiling: int = 0, walls: int = 400, turned: float = 0.3) -> Mesh:
    """A room of 4 x 2.5 x 3 m with a number of vertices per part, rotated about the vertical."""
    x, y, z = (RNG.uniform(-1, 1, 4000) * half for half in (2.0, 1.25, 1.5))
    one = np.ones(4000)
    sides = [
        (np.stack([x, 1.25 * one, z], -1), UP, floor),
        (np.stack([x, -1.25 * one, z], -1), -UP, ceiling),
        (np.stack([2 * one, y, z], -1), np.array([-1.0, 0, 0]), walls),
        (np.stack([-2 * one, y, z], -1), np.array([1.0, 0, 0]), walls),
        (np.stack([x, y, 1.5 * one], -1), np.array([0, 0, -1.0]), walls),
    ]
    points = np.concatenate([p[:count] for p, _, count in sides])
    normals = np.concatenate([np.tile(n, (count, 1)) for _, n, count in sides])
    R = se3.exp(np.array([0, 0, 0, 0, turned, 0]))[:3, :3]
    return surface(points @ R.T, normals @ R.T)


def cameras(yaws: np.ndarray, down: float, roll: float, wobble: float = 3.0) -> np.ndarray:
    """Cameras in the middle of the room, all angles in degrees."""
    poses = []
    for yaw in yaws:
        turns = (np.array([0, yaw, 0]), np.array([-down, 0, 0]), np.array([0, 0, roll]))
        T = np.eye(4)
        for turn in turns:
            error = RNG.normal(0, wobble / np.sqrt(3), 3)
            T = T @ se3.exp(np.r_[0, 0, 0, np.radians(turn + error)])
        poses.append(T)
    return np.array(poses)


@pytest.mark.parametrize(
    ("yaws", "down", "roll"),
    [
        (np.linspace(0, 300, 40), 0.0, 0.0),
        (np.linspace(0, 60, 20), 35.0, 0.0),
        (np.linspace(0, 40, 20), 80.0, 0.0),  # over a floor
        (np.linspace(0, 90, 20), -30.0, 0.0),
        (np.linspace(0, 300, 40), 10.0, 90.0),  # on its side
        (np.linspace(0, 300, 40), 10.0, -90.0),
        (np.zeros(1), 30.0, 0.0),
    ],
)
@pytest.mark.parametrize("kind", ["floor", "all", "walls"])
def test_up_is_found_for_any_camera_orientation(yaws, down, roll, kind) -> None:
    if kind != "floor" and down > 60:
        pytest.skip("a camera that looks straight down sees a floor and no ceiling")
    model = {"floor": room(), "all": room(ceiling=700), "walls": room(floor=0)}[kind]
    poses = cameras(yaws, down, roll)
    assert likely_up(model, poses) @ UP > np.cos(np.radians(4))
    # For any axes of the world.
    T = se3.exp(np.array([0, 0, 0, 0.7, -1.9, 0.4]))
    there = surface(model.vertices @ T[:3, :3].T, model.normals @ T[:3, :3].T)
    assert likely_up(there, T @ poses) @ (T[:3, :3] @ UP) > np.cos(np.radians(4))


def test_floor_is_levelled_and_gravity_takes_precedence() -> None:
    poses = cameras(np.linspace(0, 40, 20), 80.0, 0.0)
    R = upright(room(), poses)
    np.testing.assert_allclose(R[1], UP, atol=0.01)
    assert np.linalg.det(R) == pytest.approx(1)
    # Measured gravity takes precedence over the floor.
    tilted = se3.exp(np.array([0, 0, 0, np.radians(40), 0, 0]))[:3, :3] @ UP
    np.testing.assert_allclose(upright(room(), poses, tilted)[1], tilted)


@pytest.mark.parametrize("roll", [0.0, 90.0, -90.0])
def test_up_of_a_walk_is_that_about_which_the_camera_turns(roll) -> None:
    """Of a phone in portrait orientation, whose images are stored on their side."""
    model = room(floor=300, ceiling=300, walls=500)
    poses = cameras(np.linspace(-75, 75, 40), 8.0, roll)
    assert likely_up(model, poses) @ UP > np.cos(np.radians(4))
    # Nodding at a wall is no reason to take a level camera for one on its side.
    nodding = np.concatenate([cameras(np.zeros(1), down, 0.0) for down in np.linspace(-40, 40, 30)])
    assert likely_up(model, nodding) @ UP > np.cos(np.radians(5))


@pytest.mark.parametrize("mesh", [None, room(floor=0, walls=0)])
def test_up_follows_cameras_without_surface(mesh) -> None:
    poses = cameras(np.linspace(0, 300, 40), 30.0, 0.0)
    assert likely_up(mesh, poses) @ UP > np.cos(np.radians(5))
    np.testing.assert_allclose(likely_up(mesh, np.eye(4)[None]), UP, atol=1e-9)
    poses[3:] = np.nan
    assert np.isfinite(upright(mesh, poses)).all()


@pytest.mark.parametrize(
    "name",
    [
        "iphone_stray",
        pytest.param("iphone_chair_3dscannerapp", marks=pytest.mark.nightly),
        pytest.param("iphone_record3d", marks=pytest.mark.nightly),
    ],
)
def test_up_of_phone_recording_matches_gravity(shared_data: Path, name: str) -> None:
    """ARKit's world has y up."""
    recording = open_recording(shared_data / name)
    assert recording.reference is not None
    points, normals, poses = [], [], []
    for k in range(0, len(recording), max(1, len(recording) // 15)):
        T, p = recording.reference[k], recording[k].point_image[::4, ::4].astype(float)
        n = np.cross(p[1:, :-1] - p[:-1, :-1], p[:-1, 1:] - p[:-1, :-1]).reshape(-1, 3)
        length, p = np.linalg.norm(n, axis=1), p[:-1, :-1].reshape(-1, 3)
        good = (length > 0) & (length < 0.01) & (p[:, 2] > 0)
        points.append(se3.transform(T, p[good]))
        normals.append((n[good] / length[good, None]) @ T[:3, :3].T)
        poses.append(T)
    model = surface(np.concatenate(points), np.concatenate(normals))
    assert likely_up(model, np.array(poses))[1] > np.cos(np.radians(5))
