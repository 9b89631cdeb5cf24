"""Simulated recordings with cameras, scenes and motions that no other benchmark has; part of
`variants.py`.

Simulated without multipath and smear, with all other errors of the camera. Poses are exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.lab.scenes.composition import Assembly, placed, shell
from tofuse.lab.scenes.furniture import chair, plant
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import CameraModel, camera_model
from tofuse.lab.simulation.record import RecordingPlan
from tofuse.lab.world import mesh as meshes
from tofuse.lab.world import paths
from tofuse.lab.world import scene as scenes
from tofuse.lab.world.paths import Path
from tofuse.lab.world.texture import Material

WALL = Material("wall", 0.65, 0.1, "noise", (0.5, 0.5, 0.5))
GROUND = Material("ground", 0.4, 0.2, "speckle", (0.1, 0.1, 0.1))
WHITE = Material("ceiling", 0.78, 0.05, "tiles", (0.6, 0.6, 0.6))
WOOD = Material("wood", 0.45, 0.2, "wood", (0.9, 0.9, 0.05))
PLASTER = Material("plaster", 0.7)
TILES = Material("tiles", 0.8, 0.05, "tiles", (0.15, 0.15, 0.15))
THINGS = tuple(Material(f"thing {k}", 0.25 + 0.1 * k, 0.1, "print", (0.1,) * 3) for k in range(5))


@dataclass(frozen=True)
class Unusual:
    """One recording: scene, camera motion, camera, and frame rate.

    Attributes
    ----------
    scene, path
        Functions of the seed.
    range_m
        Depth beyond is missing.
    moving
        Bodies that move: materials, meshes, and their poses in the room as functions of time.
    """

    scene: Callable[[int], scenes.Scene]
    path: Callable[[int], Path]
    camera: CameraModel
    frames: int = 80
    rate_hz: float = 15.0
    range_m: float = np.inf
    moving: tuple[tuple[Material, meshes.Mesh, Path], ...] = ()


def pinhole(model: str, width: int, height: int, degrees: float) -> CameraModel:
    """Return a camera with another image size and horizontal field of view."""
    base = camera_model(model)
    f = width / 2 / np.tan(np.radians(degrees) / 2)
    camera = Pinhole(width, height, f, f, (width - 1) / 2, (height - 1) / 2)
    return replace(base, name=f"{model}, {width} x {height}, {degrees:g} degrees", camera=camera)


# ---- Motions -------------------------------------------------------------------------------------


def handheld(
    rng: np.random.Generator, metres: float, degrees: float, fastest_hz: float = 0.5
) -> Path:
    """Sway smoothly in all directions about the identity, with the given rms."""
    sizes = np.repeat([metres, np.radians(degrees)], 3)
    rates = rng.uniform(0.05, fastest_hz, (5, 6))
    phases = rng.uniform(0, 2 * np.pi, (5, 6))

    def path(t: float) -> Float64:
        waves = np.sin(2 * np.pi * rates * t + phases).sum(0) * np.sqrt(2 / 5)
        return se3.exp(sizes * waves)

    return path


def jerks(rng: np.random.Generator, degrees: float, seconds: float = 0.15) -> Path:
    """Rotate abruptly about random axes and back, about once a second."""
    axes = rng.standard_normal((100, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)

    def path(t: float) -> Float64:
        k, u = divmod(t, 1.0)
        fraction = paths.smooth_step((u - 0.2) / seconds) - paths.smooth_step((u - 0.7) / seconds)
        return paths.rotation(np.radians(degrees) * fraction * axes[int(k) % 100])

    return path


def together(*parts: Path) -> Path:
    """Compose paths: later ones in the frame of earlier ones."""

    def path(t: float) -> Float64:
        T = np.eye(4)
        for part in parts:
            T = T @ part(t)
        return T

    return path


def straight(start: Float64, velocity: tuple[float, float, float]) -> Path:
    """Move at constant velocity in the room (m/s), without rotation."""

    def path(t: float) -> Float64:
        T = start.copy()
        T[:3, 3] += np.asarray(velocity) * t
        return T

    return path


def around(
    radius: float, height: float, target: tuple[float, float, float], seconds: float
) -> Path:
    """Walk once around a target."""

    def path(t: float) -> Float64:
        a = 2 * np.pi * t / seconds
        x, y, _ = target
        return paths.look_at((x + radius * np.cos(a), y + radius * np.sin(a), height), target)

    return path


# ---- Scenes --------------------------------------------------------------------------------------


def known(name: str) -> Callable[[int], scenes.Scene]:
    """Return one of the simulator's scenes."""
    return lambda seed: scenes.build(name, seed=seed)[0]


Fill = Callable[[Assembly, np.random.Generator], None]


def built(name: str, fill: Fill) -> Callable[[int], scenes.Scene]:
    """Return a scene built by a function."""

    def make(seed: int) -> scenes.Scene:
        assembly = Assembly([])
        fill(assembly, np.random.default_rng([seed, 11]))
        return scenes.Scene(name, assembly.materials, assembly.mesh(), seed=seed)

    return make


def _stairs(assembly: Assembly, _rng: np.random.Generator) -> None:
    """Add 16 steps of 28 x 18 cm along y between two walls, landings before and after."""
    assembly.add(WALL, meshes.quad((-0.6, -3, 0), (0, 10, 0), (0, 0, 6)))
    assembly.add(WALL, meshes.quad((0.6, -3, 0), (0, 0, 6), (0, 10, 0)))
    assembly.add(GROUND, meshes.quad((-0.6, -3, 0), (1.2, 0, 0), (0, 3, 0)))
    for k in range(16):
        low, high = (-0.6, 0.28 * k, 0.18 * k), (0.6, 0.28 * (k + 1), 0.18 * (k + 1))
        assembly.add(WOOD, meshes.box_between(low, high))
    assembly.add(GROUND, meshes.quad((-0.6, 4.48, 2.88), (1.2, 0, 0), (0, 2.5, 0)))
    assembly.add(WALL, meshes.quad((-0.6, 6.98, 0), (1.2, 0, 0), (0, 0, 6)))


def _table(assembly: Assembly, rng: np.random.Generator) -> None:
    """Add a large table with five small things."""
    assembly.add(WOOD, meshes.box_between((-0.8, -0.8, -0.04), (0.8, 0.8, 0)))
    for material in THINGS:
        x, y, yaw = *rng.uniform(-0.3, 0.3, 2), rng.uniform(0, 3)
        size = rng.uniform(0.05, 0.14, 3)
        T = placed((x, y), yaw)
        assembly.add(material, meshes.box(size, (0, 0, size[2] / 2)).transformed(T))


def _yard(assembly: Assembly, rng: np.random.Generator) -> None:
    """Add ground, a wall at one side, and a few poles and crates; no sky."""
    assembly.add(GROUND, meshes.quad((-20, -20, 0), (40, 0, 0), (0, 40, 0)))
    assembly.add(WALL, meshes.quad((-20, 3.5, 0), (40, 0, 0), (0, 0, 2.2)))
    for k in range(12):
        x, y = rng.uniform(-1, 9), rng.uniform(-2.5, 2.8)
        if k % 2:
            assembly.add(WOOD, meshes.rod((x, y, 0), (x, y, 3.0), 0.06))
        else:
            size = rng.uniform(0.3, 0.7, 3)
            crate = meshes.box(size, (0, 0, size[2] / 2)).transformed(
                placed((x, y), rng.uniform(0, 3))
            )
            assembly.add(THINGS[k % 5], crate)


def _chairs(assembly: Assembly, rng: np.random.Generator) -> None:
    """Add a room with a few chairs, for looking down."""
    shell(assembly, (-3, -2.5, 0), (3, 2.5, 2.5), [WALL] * 4, GROUND, WHITE)
    for k in range(4):
        at = tuple(rng.uniform((-1.5, -1.2), (1.5, 1.2)))
        chair(assembly.at(placed(at, rng.uniform(0, 6))), THINGS[k])


def _chair_alone(assembly: Assembly, _rng: np.random.Generator) -> None:
    """Add a chair, nothing else."""
    chair(assembly.at(placed((0.0, 0.0), 0.3)), THINGS[2])


def _stairwell(assembly: Assembly, _rng: np.random.Generator) -> None:
    """Add stairs that wind around a column through four identical storeys of 2.88 m."""
    height = 4 * 2.88
    assembly.add(WALL, meshes.box_between((-0.25, -0.25, 0), (0.25, 0.25, height)))
    for T in (placed((0, 0), k * np.pi / 2) for k in range(4)):
        wall = meshes.quad((-1.3, 1.3, 0), (2.6, 0, 0), (0, 0, height))
        assembly.add(WALL, wall.transformed(T))
    for k in range(64):
        T = placed((0, 0), 2 * np.pi * k / 16)
        step = meshes.box((1.3, 0.45, 0.18), (0.85, 0, 0.18 * k - 0.09))
        assembly.add(WOOD, step.transformed(T))
    for k in range(4):
        low = 2.88 * k
        assembly.add(THINGS[1], meshes.box_between((1.2, -0.5, low), (1.3, 0.5, low + 2.0)))
        assembly.add(THINGS[3], meshes.box_between((-1.3, 0.2, low + 2.1), (-1.15, 0.8, low + 2.9)))


def _up_the_stairwell(t: float) -> Float64:
    """Walk up, one storey in 8 s."""

    def at(a: float) -> Float64:
        return np.array([0.8 * np.cos(a), 0.8 * np.sin(a), 2.88 * a / (2 * np.pi) + 1.5])

    a = 2 * np.pi * t / 8
    return paths.look_at(at(a), at(a + 0.9) - [0, 0, 0.5])


def _aisle(assembly: Assembly, rng: np.random.Generator) -> None:
    """Add an aisle between identical bays of shelves, 1.2 m wide."""
    assembly.add(GROUND, meshes.quad((-3, -1, 0), (16, 0, 0), (0, 2, 0)))
    assembly.add(WALL, meshes.quad((13, -1, 0), (0, 2, 0), (0, 0, 3)))
    boxes = rng.uniform(0.2, 0.4, (6, 3))
    for side in (-1, 1):
        for bay in range(12):
            x = -2.4 + 1.2 * bay
            post = meshes.box((0.06, 0.54, 2.4), (x + 0.03, side * 1.25, 1.2))
            assembly.add(WOOD, post)
            for level in range(3):
                z = 0.1 + 0.8 * level
                assembly.add(WOOD, meshes.box((1.2, 0.5, 0.04), (x + 0.6, side * 1.25, z)))
                size = boxes[level + (0 if side < 0 else 3)]
                item = meshes.box(size, (x + 0.6, side * 1.25, z + 0.02 + size[2] / 2))
                assembly.add(THINGS[level], item)


def _plants(assembly: Assembly, rng: np.random.Generator) -> None:
    """Add a room full of plants."""
    shell(assembly, (-3, -2.5, 0), (3, 2.5, 2.5), [WALL] * 4, GROUND, WHITE)
    for k in range(10):
        a = 2 * np.pi * k / 10
        at = (2.0 * np.cos(a) + rng.uniform(-0.2, 0.2), 1.8 * np.sin(a) + rng.uniform(-0.2, 0.2))
        plant(assembly.at(placed(at, rng.uniform(0, 6))), rng)


def _tunnel(assembly: Assembly, _rng: np.random.Generator) -> None:
    """Add a round tunnel along x with a rib every 2 m."""
    profile = [(1.2, 0.0)]
    for k in range(12):
        z = 2.0 * k
        profile += [(1.2, z + 1.7), (1.1, z + 1.72), (1.1, z + 1.9), (1.2, z + 1.92)]
    T = se3.pose([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    T[0, 3] = -4
    assembly.add(WALL, meshes.inside_out(meshes.lathe(profile, 48)).transformed(T))


def _attic(assembly: Assembly, rng: np.random.Generator) -> None:
    """Add a room under a roof, with five boxes: between the gables, views are degenerate."""
    low, ridge, half, length = 0.3, 2.5, 2.0, 3.0
    assembly.add(GROUND, meshes.quad((-length, -half, 0), (2 * length, 0, 0), (0, 2 * half, 0)))
    for side in (-1, 1):
        along, up = (2 * length, 0, 0), (0, -side * half, ridge - low)
        edges = (along, up) if side > 0 else (up, along)
        assembly.add(WOOD, meshes.quad((-length, side * half, low), *edges))
        assembly.add(WALL, meshes.quad((-length, side * half, 0), (0, 0, low), along))
        edges = ((0, 2 * half, 0), (0, 0, ridge))
        assembly.add(
            WALL, meshes.quad((side * length, -half, 0), *(edges if side < 0 else edges[::-1]))
        )
    for material in THINGS:
        size, (x, y) = rng.uniform(0.2, 0.6, 3), rng.uniform((-2, -1.2), (2, 1.2))
        at = (x + 1.2 if abs(x) + abs(y) < 0.8 else x, y)
        thing = meshes.box(size, (0, 0, size[2] / 2))
        assembly.add(material, thing.transformed(placed(at, rng.uniform(0, 3))))


def _in_the_attic(t: float) -> Float64:
    """Look around within 10 s, while walking in a circle."""
    a, b = 2 * np.pi * t / 10, 0.7 * t
    return paths.look_at(
        (0.4 * np.sin(b), 0.3 * np.cos(b), 1.3), (2 * np.cos(a), 2 * np.sin(a), 0.9)
    )


def _bathroom(assembly: Assembly, _rng: np.random.Generator) -> None:
    """Add a tiled room of 2.0 x 1.8 m with a bath, a basin, a toilet and a cupboard."""
    shell(assembly, (-1.0, -0.9, 0), (1.0, 0.9, 2.4), [TILES] * 4, TILES, PLASTER)
    assembly.add(PLASTER, meshes.box_between((-1.0, 0.2, 0), (0.9, 0.9, 0.55)))
    raised = se3.translation((0.7, -0.5, 0.8))
    assembly.add(PLASTER, meshes.superellipsoid((0.5, 0.4, 0.2), (0.6, 0.8)).transformed(raised))
    toilet = meshes.superellipsoid((0.4, 0.6, 0.7), (0.8, 0.9))
    assembly.add(PLASTER, toilet.transformed(placed((-0.4, -0.6), 0.0)))
    assembly.add(THINGS[1], meshes.box_between((-0.98, -0.3, 1.2), (-0.9, 0.2, 1.5)))


def _in_the_bathroom(t: float) -> Float64:
    """Stand in the middle, and look around within 10 s."""
    a = 0.6 * t
    return paths.look_at((0.1, -0.1, 1.5), (0.1 + np.cos(a), np.sin(a) - 0.1, 0.8))


def _bookshelf(assembly: Assembly, rng: np.random.Generator) -> None:
    """Add a wall of 5 m with six shelves full of books."""
    assembly.add(WALL, meshes.quad((-4, 0.3, 0), (8, 0, 0), (0, 0, 3)))
    assembly.add(GROUND, meshes.quad((-4, -3, 0), (8, 0, 0), (0, 3.3, 0)))
    for level in range(6):
        z, x = 0.3 + 0.35 * level, -2.5
        assembly.add(WOOD, meshes.box_between((-2.5, 0, z - 0.02), (2.5, 0.3, z)))
        while x < 2.4:
            width, height, depth = rng.uniform((0.015, 0.18, 0.12), (0.06, 0.3, 0.25))
            book = meshes.box_between((x, 0.3 - depth, z), (x + width, 0.3, z + height))
            assembly.add(THINGS[rng.integers(5)], book)
            x += width + (0.1 if rng.random() < 0.05 else 0.002)


def _car(assembly: Assembly, _rng: np.random.Generator) -> None:
    """Add a car on open ground."""
    assembly.add(GROUND, meshes.quad((-8, -8, 0), (16, 0, 0), (0, 16, 0)))
    for material, size, roundness, z in (
        (THINGS[2], (3.8, 1.6, 0.7), (0.3, 0.4), 0.6),
        (THINGS[3], (2.2, 1.4, 0.8), (0.6, 0.5), 1.0),
    ):
        raised = np.eye(4)
        raised[2, 3] = z
        body = meshes.superellipsoid(size, roundness, (16, 32))
        assembly.add(material, body.transformed(raised))
    for x in (-1.2, 1.2):
        for y in (-0.75, 0.75):
            wheel = meshes.rod((x, y - 0.1, 0.3), (x, y + 0.1, 0.3), 0.3, segments=16)
            assembly.add(THINGS[0], wheel)


def _pausing(seed: int) -> Path:
    """Stand still for 4 s, then walk."""
    rng = np.random.default_rng([seed, 14])
    walk = together(paths.camera_turn(EYE, 12.0), calm(rng))
    return lambda t: walk(max(t - 4.0, 0.0))


IFM = camera_model("ifm-o3r")
SR4000 = camera_model("sr4000")
EYE = paths.look_at((0, 0, 1.1), (1, 0.2, 0.9))


def _in_room(*more: Callable[[np.random.Generator], Path]) -> Callable[[int], Path]:
    """Stand in the room, rotate slowly, and add motions."""

    def made(seed: int) -> Path:
        rng = np.random.default_rng([seed, 12])
        turning = paths.camera_turn(EYE, 12.0)
        return together(turning, *(make(rng) for make in more))

    return made


def fixed(path: Path, metres: float = 0.02, degrees: float = 1.5) -> Callable[[int], Path]:
    return lambda seed: together(path, handheld(np.random.default_rng([seed, 13]), metres, degrees))


def _elsewhere_in_flat(seed: int) -> Path:
    """Walk through the flat from 20 s on."""
    sequence = scenes.build("flat", seed=seed)[1]
    return lambda t: sequence.camera_path(20.0 + t)


calm = partial(handheld, metres=0.08, degrees=4.0)
slow_turns = partial(handheld, metres=0.03, degrees=30.0, fastest_hz=0.25)
up_the_stairs = straight(paths.look_at((0, -1.5, 1.5), (0, 0.6, 0.7)), (0, 0.5, 0.28))
through_the_yard = straight(paths.look_at((-2, 0, 1.4), (1, 0.3, 1.0)), (0.6, 0, 0))
over_the_floor = straight(paths.look_at((-1.5, -0.1, 1.6), (-0.9, 0.1, 0.0)), (0.4, 0.1, 0))
below_the_ceiling = straight(paths.look_at((-1.5, 0.2, 1.0), (-1.1, 0.4, 2.5)), (0.4, 0, 0))


def along_the_aisle(t: float) -> Float64:
    """Walk 7 m along the aisle and back within 20 s, looking ahead and a little to the side."""
    u = paths.smooth_step(t / 10) - paths.smooth_step((t - 10) / 10)
    return paths.look_at((7 * u, 0.05, 1.4), (7 * u + 1, 0.25, 1.2))


through_the_tunnel = straight(paths.look_at((0, 0, 0.1), (1, 0.1, 0)), (0.6, 0, 0))
UNUSUAL: dict[str, Unusual] = {
    "field of view of 30 degrees": Unusual(
        known("room"), _in_room(calm), pinhole("sr4000", 176, 144, 30)
    ),
    "field of view of 100 degrees": Unusual(
        known("room"), _in_room(calm), pinhole("ifm-o3r", 224, 172, 100)
    ),
    "80 x 60 pixels": Unusual(known("room"), _in_room(calm), pinhole("ifm-o3r", 80, 60, 60)),
    "54 x 42 pixels": Unusual(known("room"), _in_room(calm), pinhole("ifm-o3r", 54, 42, 60)),
    "32 x 24 pixels": Unusual(known("room"), _in_room(calm), pinhole("ifm-o3r", 32, 24, 60)),
    "54 x 42 pixels, flat": Unusual(
        known("flat"), _elsewhere_in_flat, pinhole("ifm-o3r", 54, 42, 60)
    ),
    "5 Hz": Unusual(known("room"), _in_room(calm), IFM, 50, 5.0),
    "jerks of 12 degrees": Unusual(
        known("room"), _in_room(calm, partial(jerks, degrees=12.0)), IFM
    ),
    "rotation in all directions": Unusual(known("room"), _in_room(slow_turns), IFM),
    "elsewhere in the flat": Unusual(known("flat"), _elsewhere_in_flat, IFM),
    "up the stairs": Unusual(built("stairs", _stairs), fixed(up_the_stairs), IFM, 90),
    "things on a table": Unusual(
        built("table", _table), fixed(around(0.7, 0.5, (0, 0, 0.03), 8.0), 0.01, 1.0), IFM, 120
    ),
    "yard": Unusual(built("yard", _yard), fixed(through_the_yard), IFM, 90),
    "floor and chairs from above": Unusual(built("chairs", _chairs), fixed(over_the_floor), SR4000),
    "ceiling": Unusual(known("room"), fixed(below_the_ceiling), SR4000),
    "chair in empty space": Unusual(
        built("chair", _chair_alone), fixed(around(1.5, 0.9, (0, 0, 0.5), 8.0)), IFM, 120
    ),
    "stairwell": Unusual(
        built("stairwell", _stairwell), fixed(_up_the_stairwell, 0.01), IFM, 240, 10.0
    ),
    "aisle of identical shelves": Unusual(
        built("aisle", _aisle), fixed(along_the_aisle), IFM, 200, 10.0
    ),
    "plants": Unusual(built("plants", _plants), _in_room(calm), IFM, 120),
    "tunnel": Unusual(built("tunnel", _tunnel), fixed(through_the_tunnel), IFM),
    "attic": Unusual(
        built("attic", _attic),
        fixed(_in_the_attic, 0.02, 2.0),
        camera_model("pico-flexx"),
        120,
        10.0,
    ),
    "bathroom": Unusual(
        built("bathroom", _bathroom),
        fixed(_in_the_bathroom, 0.04, 3.0),
        pinhole("azure-nfov", 320, 288, 75),
        120,
        10.0,
    ),
    "bookshelf": Unusual(
        built("bookshelf", _bookshelf),
        fixed(straight(paths.look_at((-1.8, -0.75, 1.2), (-1.8, 0.3, 1.15)), (0.35, 0, 0))),
        camera_model("pico-flexx"),
        100,
        10.0,
    ),
    "car": Unusual(
        built("car", _car),
        fixed(around(3.3, 1.5, (0, 0, 0.6), 16.0)),
        pinhole("azure-nfov", 320, 288, 75),
        160,
        10.0,
    ),
    "range of 1.5 m": Unusual(known("room"), _in_room(calm), IFM, range_m=1.5),
    "1 Hz": Unusual(known("room"), _in_room(calm), IFM, 13, 1.0),
    "field of view of 120 degrees": Unusual(
        known("room"), _in_room(calm), pinhole("azure-nfov", 320, 288, 120), 60, 10.0
    ),
    "pause": Unusual(known("room"), _pausing, IFM, 150),
    "60 Hz": Unusual(known("room"), _in_room(calm), IFM, 300, 60.0),
}


def _within(depth: Float32, range_m: float) -> Float32:
    """Return depth (H, W) without what is farther."""
    return np.where(depth > range_m, np.float32(np.nan), depth)


def record(one: Unusual, seed: int, *without: str) -> Recording:
    """Simulate a recording in memory; the true poses are its reference.

    Parameters
    ----------
    without
        Effects to switch off; by default multipath and smear.
    """
    sequence = scenes.Sequence(one.frames, 1, one.rate_hz, one.path(seed))
    scene = one.scene(seed)
    if one.moving:
        bodies = [body.of_surface(k) for k, (_, body, _) in enumerate(one.moving)]
        scene = scene.with_passing([material for material, _, _ in one.moving], bodies)
        sequence = sequence.with_passing([path for _, _, path in one.moving])
    model = replace(one.camera, frame_rate_hz=one.rate_hz)
    effects = Effects().without(*(without or ("multipath", "smear")))
    made = RecordingPlan(scene, sequence, model, effects, seed, np.arange(one.frames))
    frames = [
        replace(frame, depth=_within(frame.depth, one.range_m)) for frame in made.corrected_frames()
    ]
    metadata = {
        "frame_rate_hz": one.rate_hz,
        "ambiguity_m": model.ambiguity_m,
        "amplitude_kind": model.amplitude_kind,
        "sensor": model.name,
    }
    if model.confidence_max is not None:
        metadata["confidence_max"] = model.confidence_max
    source = ArraySource(frames, made.poses, metadata=metadata)
    return Recording.of(source, "simulated", "simulated")
