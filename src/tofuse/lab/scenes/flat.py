"""Four rooms of 4.4 x 4.4 m in a square, connected by doorways, and a walk through them.

Room k is room 0 rotated by k quarter turns about the middle of the flat: each has a doorway in the
middle of its +y wall, where the path enters, and one in its +x wall, where it leaves. In `flat`
rooms have different walls and furniture; in `flat-alike` all have the same, with small differences.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.lab.scenes import furniture, household
from tofuse.lab.scenes.composition import Assembly, placed
from tofuse.lab.world import Material, SceneOptions, ScenePlan, paths
from tofuse.lab.world import mesh as meshes

HALF, HEIGHT, WALL = 2.2, 2.5, 0.12
DOOR, DOOR_TOP = 0.90, 2.05
ROOMS = 4
EYE = 1.30

SIDES = [
    Material("wall 0", 0.70, 0.14, "noise", (0.5, 0.5, 0.5)),
    Material("wall 1", 0.52, 0.18, "print", (0.5, 0.5, 0.5)),
    Material("wall 2", 0.80, 0.10, "noise", (0.9, 0.9, 0.3)),
    Material("wall 3", 0.62, 0.16, "wood", (1.2, 1.2, 0.25)),
]
FLOORS = [
    Material("floor 0", 0.38, 0.18, "speckle", (0.09, 0.09, 0.09)),
    Material("floor 1", 0.45, 0.2, "wood", (0.15, 1.4, 0.15)),
    Material("floor 2", 0.30, 0.12, "noise", (0.3, 0.3, 0.3)),
    Material("floor 3", 0.55, 0.2, "tiles", (0.3, 0.3, 0.3)),
]
CEILING = Material("ceiling", 0.78, 0.05, "tiles", (0.6, 0.6, 0.6))
CASING = Material("casing", 0.72)
POSTERS = [
    Material(f"poster {k}", albedo, 0.35, "print", (0.2, 0.2, 0.2))
    for k, albedo in enumerate((0.55, 0.45, 0.6, 0.5))
]
FABRICS = [
    Material(f"fabric {k}", albedo, 0.1, "speckle", (0.03, 0.03, 0.03))
    for k, albedo in enumerate((0.34, 0.22, 0.45, 0.3))
]

# The walk in room 0 (x, y in m) and where the camera faces (degrees): from the doorway in the
# +y wall to the one in the +x wall, which is that of the next room's +y wall.
_WALK = [
    (0.00, HALF + WALL / 2, -90.0),
    (-0.10, 1.00, -122.0),
    (-0.42, -0.40, -135.0),
    (0.25, -0.52, -92.0),
    (1.15, -0.15, -20.0),
]


def T_flat_room(room: int) -> Float64:
    """(4, 4) pose of a room's frame, whose origin is the middle of its floor."""
    to_corner = -(HALF + WALL / 2)
    return paths.rotation([0, 0, room * np.pi / 2]) @ se3.translation((to_corner, to_corner, 0))


def plan(options: SceneOptions) -> ScenePlan:
    """Lay out the flat."""
    assembly = Assembly([])
    alike = options.name == "flat-alike"
    for room in range(ROOMS):
        rng = np.random.default_rng([options.seed, 3, room])
        style = 0 if alike else room
        T = T_flat_room(room)
        _walls(assembly.at(T), SIDES[style], FLOORS[style])
        _doorway(assembly.at(T), SIDES[style])
        furnish = _study if alike else _FURNISHED[room]
        furnish(assembly, T, rng, room)
    path = _walk(options.seconds, np.random.default_rng([options.seed, 4]))
    return ScenePlan(assembly.materials, assembly.mesh(), path, ambient=0.3)


def _walls(assembly: Assembly, side: Material, floor: Material) -> None:
    """Add floor, ceiling and walls, with openings in the walls at +x and +y."""
    a, h, d = HALF, HEIGHT, DOOR / 2
    quad = meshes.quad
    assembly.add(floor, quad((-a, -a, 0), (2 * a, 0, 0), (0, 2 * a, 0)))
    assembly.add(CEILING, quad((-a, -a, h), (0, 2 * a, 0), (2 * a, 0, 0)))
    parts = [
        quad((-a, -a, 0), (0, 2 * a, 0), (0, 0, h)),
        quad((-a, -a, 0), (0, 0, h), (2 * a, 0, 0)),
    ]
    beside_door = a - d
    for start, along in (((a, -a, 0), (0, 1, 0)), ((-a, a, 0), (1, 0, 0))):
        p, u = np.array(start, float), np.array(along, float)
        up = np.array([0, 0, 1.0])
        parts += [
            quad(p, beside_door * u, h * up),
            quad(p + (beside_door + DOOR) * u, beside_door * u, h * up),
            quad(p + beside_door * u + DOOR_TOP * up, DOOR * u, (h - DOOR_TOP) * up),
        ]
    assembly.add(side, *parts)
    skirting = [
        meshes.box_between((-a, -a, 0), (-a + 0.012, a, 0.08)),
        meshes.box_between((-a, -a, 0), (a, -a + 0.012, 0.08)),
    ]
    assembly.add(CASING, *skirting)


def _doorway(assembly: Assembly, side: Material) -> None:
    """Line the doorway at +x, through the wall, and frame it."""
    a, d, top = HALF, DOOR / 2, DOOR_TOP
    lining = [
        meshes.quad((a, -d, 0), (WALL, 0, 0), (0, 0, top)),
        meshes.quad((a, d, 0), (WALL, 0, 0), (0, 0, top)),
        meshes.quad((a, -d, 0), (WALL, 0, 0), (0, DOOR, 0)),
        meshes.quad((a, -d, top), (WALL, 0, 0), (0, DOOR, 0)),
    ]
    assembly.add(side, *lining)
    for x in (a - 0.02, a + WALL):
        posts = [
            meshes.box_between((x, -d - 0.07, 0), (x + 0.02, -d, top + 0.07)),
            meshes.box_between((x, d, 0), (x + 0.02, d + 0.07, top + 0.07)),
            meshes.box_between((x, -d, top), (x + 0.02, d, top + 0.07)),
        ]
        assembly.add(CASING, *posts)


def _poster(
    assembly: Assembly, T: Float64, room: int, at: float, size: tuple[float, float]
) -> None:
    """Hang a poster on the wall at -x."""
    low, high = (-HALF, at, 1.55 - size[1] / 2), (-HALF + 0.006, at + size[0], 1.55 + size[1] / 2)
    assembly.at(T).add(POSTERS[room], meshes.box_between(low, high))


def _study(assembly: Assembly, T: Float64, rng: np.random.Generator, room: int) -> None:
    """Furnish with desk, chair, shelf and plant at slightly random poses."""

    def jittered(x: float, y: float, yaw: float) -> Float64:
        jitter = rng.normal(0.0, 0.03, 2)
        return T @ placed((x + jitter[0], y + jitter[1]), yaw + np.deg2rad(rng.normal(0.0, 3.0)))

    furniture.desk(assembly.at(jittered(-1.70, -0.15, 0.0)))
    seat = jittered(-1.12, -0.25, np.deg2rad(200 + rng.normal(0, 15)))
    furniture.chair(assembly.at(seat), FABRICS[0])
    household.shelf(assembly.at(jittered(0.70, -HALF + 0.08, np.pi / 2)), rng)
    furniture.plant(assembly.at(jittered(-1.75, -1.75, 0.0)), rng)
    household.cabinet(assembly.at(jittered(1.95, 1.45, np.pi)), household.OAK, (0.42, 1.0, 0.9))
    _poster(assembly, T, 0, -0.9 + rng.normal(0, 0.04), (0.7, 0.5))


def _living(assembly: Assembly, T: Float64, rng: np.random.Generator, room: int) -> None:
    household.sofa(assembly.at(T @ placed((-1.72, -0.4), 0.0)), FABRICS[1])
    household.table(assembly.at(T @ placed((-1.0, -1.35), 0.3)), household.BIRCH, (0.6, 0.9), 0.42)
    household.shelf(assembly.at(T @ placed((0.9, -HALF + 0.01), np.pi / 2)), rng, 1.6, 4)
    household.floor_lamp(assembly.at(T @ placed((-1.8, 0.85), 0.0)))
    furniture.plant(assembly.at(T @ placed((1.7, 1.7), 0.0)), rng)
    _poster(assembly, T, room, -1.1, (1.2, 0.7))


def _bedroom(assembly: Assembly, T: Float64, rng: np.random.Generator, room: int) -> None:
    household.bed(assembly.at(T @ placed((-1.12, -1.65), 0.0)))
    tall = (0.58, 1.2, 2.0)
    household.cabinet(assembly.at(T @ placed((-HALF, 0.6), 0.0)), household.BIRCH, tall)
    furniture.chair(assembly.at(T @ placed((1.5, -1.6), 2.2)), FABRICS[2], arms=False)
    household.floor_lamp(assembly.at(T @ placed((0.35, -1.9), 0.0)))
    household.cabinet(assembly.at(T @ placed((HALF, 1.4), np.pi)), household.OAK, (0.45, 0.9, 1.1))
    _poster(assembly, T, room, -0.7, (0.5, 0.8))


def _dining(assembly: Assembly, T: Float64, rng: np.random.Generator, room: int) -> None:
    household.table(assembly.at(T @ placed((-1.30, -1.05), 0.15)), household.OAK)
    for x, y, yaw in ((-1.45, -1.85, 1.3), (-1.95, -1.1, 0.2), (-1.35, -0.15, -1.7)):
        furniture.chair(assembly.at(T @ placed((x, y), yaw)), FABRICS[3], arms=False)
    low = (0.45, 1.4, 0.85)
    household.cabinet(assembly.at(T @ placed((0.95, -HALF), np.pi / 2)), household.BIRCH, low)
    furniture.plant(assembly.at(T @ placed((-1.8, 1.7), 0.0)), rng)
    _poster(assembly, T, room, 0.1, (0.6, 0.9))


_FURNISHED: list[Callable[[Assembly, Float64, np.random.Generator, int], None]] = [
    _study,
    _living,
    _bedroom,
    _dining,
]


def _walk(seconds: float, rng: np.random.Generator) -> paths.Path:
    """Walk once through all rooms, from the middle of room 0 back to it."""
    points, yaws = [], []
    for room in range(ROOMS):
        T = T_flat_room(room)
        for k, (x, y, yaw) in enumerate(_WALK):
            # Waypoints vary between rooms, but little in the doorways.
            jitter = rng.normal(0.0, 0.02 if k == 0 else 0.08, 2)
            points.append(se3.transform(T, np.array([[x + jitter[0], y + jitter[1], EYE]]))[0])
            yaw_jitter = rng.normal(0.0, 2.0 if k == 0 else 5.0)
            yaws.append(np.deg2rad(yaw + yaw_jitter) + room * np.pi / 2)
    # Begin in the middle of room 0.
    first = 2
    points = points[first:] + points[:first]
    yaws = yaws[first:] + [yaw + 2 * np.pi for yaw in yaws[:first]]
    points, yaws = [*points, points[0]], [*yaws, yaws[0] + 2 * np.pi]
    positions, yaw_rad = np.array(points), np.array(yaws)
    # Constant speed, but slower where the camera turns.
    effort = np.linalg.norm(np.diff(positions, axis=0), axis=1) + 0.6 * np.abs(np.diff(yaw_rad))
    times = seconds * np.concatenate([[0.0], np.cumsum(effort)]) / effort.sum()
    position = CubicSpline(times, positions, bc_type="periodic")
    mean_rotation = 2 * np.pi * times / seconds
    facing = CubicSpline(times, yaw_rad - mean_rotation, bc_type="periodic")
    rate = 4 * np.pi * round(0.85 * seconds) / seconds  # of steps

    def path(t: float) -> Float64:
        heading = float(facing(t % seconds)) + 2 * np.pi * t / seconds
        bob = 0.010 * np.sin(rate * t)
        tilt = -0.14 + 0.06 * np.sin(2 * np.pi * 5 * t / seconds) + 0.006 * np.sin(rate * t + 1)
        c, s = np.cos(heading), np.sin(heading)
        sway = 0.008 * np.sin(rate * t / 2)
        p = position(t % seconds) + np.array([-sway * s, sway * c, bob])
        T = paths.look_at(p, p + np.array([c, s, np.tan(tilt)]))
        return T @ paths.rotation([0, 0, 0.012 * np.sin(rate * t / 2)])

    return path
