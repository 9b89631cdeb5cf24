"""A printed checkerboard on a long wall, viewed from many static poses."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.lab.scenes.composition import Assembly
from tofuse.lab.world import Material, Path, SceneOptions, ScenePlan, paths
from tofuse.lab.world import mesh as meshes

# Inner corners, and the side of a square in m.
COLUMNS, ROWS, SQUARE_M = 8, 6, 0.1
# Margin of white paper, m; and offsets of paper and print in front of the wall.
MARGIN_M, _PAPER_M = 0.08, 0.0005
POSES = 32
SECONDS_PER_POSE = 3.0
# Fraction of the time per pose spent moving to the next one.
_MOVING_FRACTION = 0.8
_HEIGHT = 1.5

WALL = Material("wall", 0.6, 0.1, "noise", (0.5, 0.5, 0.5))
PAPER = Material("paper", 0.85)
INK = Material("ink", 0.12)


def plan(options: SceneOptions) -> ScenePlan:
    """Lay out wall and board; the board's centre is at the camera's height."""
    assembly = Assembly([])
    assembly.add(WALL, meshes.quad((-60, 0, -60), (120, 0, 0), (0, 0, 120)))
    width, height = (COLUMNS + 1) * SQUARE_M, (ROWS + 1) * SQUARE_M
    left, low = -width / 2, _HEIGHT - height / 2
    y = -_PAPER_M
    m = MARGIN_M
    for corner, size in (  # paper all around the squares
        ((left - m, low - m), (width + 2 * m, m)),
        ((left - m, low + height), (width + 2 * m, m)),
        ((left - m, low), (m, height)),
        ((left + width, low), (m, height)),
    ):
        assembly.add(PAPER, _upright(*corner, y, *size))
    for row in range(ROWS + 1):
        for column in range(COLUMNS + 1):
            x, z = left + column * SQUARE_M, low + row * SQUARE_M
            material = INK if (row + column) % 2 == 0 else PAPER
            assembly.add(material, _upright(x, z, y, SQUARE_M, SQUARE_M))
    return ScenePlan(assembly.materials, assembly.mesh(), _stops(camera_poses(options.seed)))


def _upright(x: float, z: float, y: float, width: float, height: float) -> meshes.Mesh:
    return meshes.quad((x, y, z), (width, 0, 0), (0, 0, height))


def camera_poses(seed: int) -> Float64:
    """(POSES, 4, 4) T_room_camera: poses that cover distances, tilts and image regions."""
    rng = np.random.default_rng([seed, 30])
    # A narrow lens sees the whole board from 1.4 m on; a wide one needs shorter distances.
    near_count, middle_count = 6, 16
    distance = np.concatenate(
        [
            rng.uniform(0.9, 1.3, near_count),
            rng.uniform(1.4, 2.2, middle_count),
            rng.uniform(2.2, 3.6, POSES - near_count - middle_count),
        ]
    )[rng.permutation(POSES)]
    out = []
    for k, d in enumerate(distance):
        tilt = np.radians(rng.uniform(10, 45))
        azimuth = 2 * np.pi * (k * 0.382 + rng.uniform(0, 0.1))
        direction = np.array(
            [np.sin(tilt) * np.cos(azimuth), -np.cos(tilt), np.sin(tilt) * np.sin(azimuth)]
        )
        T = paths.look_at(np.array([0, 0, _HEIGHT]) + d * direction, (0, 0, _HEIGHT))
        # Off-centre, within a narrow field of view at this distance, and rolled.
        margin = np.radians([21.0, 17.0]) - np.arctan([0.45 / d, 0.35 / d])
        offset = rng.uniform(-1, 1, 2) * np.maximum(margin, np.radians(3)) * 0.9
        roll = np.radians(rng.uniform(-20, 20))
        out.append(T @ paths.rotation([offset[1], offset[0], 0]) @ paths.rotation([0, 0, roll]))
    return np.stack(out)


def _stops(poses: Float64) -> Path:
    """Path that rests at each pose in turn, with minimum-jerk motion in between."""
    steps = se3.log(se3.inverse(poses[:-1]) @ poses[1:])

    def path(t: float) -> Float64:
        position = min(max(t / SECONDS_PER_POSE, 0.0), len(poses) - 1.0)
        k = min(int(position), len(poses) - 2)
        # Half of the rest precedes the motion, half follows it.
        progress = paths.smooth_step((position - k - (1 - _MOVING_FRACTION) / 2) / _MOVING_FRACTION)
        return np.asarray(poses[k] @ se3.exp(progress * steps[k]))

    return path
