"""Pairs of clouds with a known motion: symmetric ones, and ones with stray points or far away.

The pose of a symmetric body that was turned by its symmetry can't be known; a pair of a furnished
room can, wherever its coordinates begin.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3, triangles
from tofuse.lab.scenes.composition import placed
from tofuse.lab.world import mesh as meshes
from tofuse.lab.world.mesh import Mesh

# Of a right pose of clouds: its error as a fraction of their extent, and its angle.
MAX_FRACTION, MAX_RAD = 0.05, np.radians(4.0)
MAP = np.array([500_000.0, 4_000_000.0, 100.0])
T_ROOM = se3.exp([0.3, 0.1, 0.0, 0.0, 0.0, 0.1])
POINTS, NOISE_M = 4000, 0.003


@dataclass(frozen=True, eq=False)
class Pair:
    """Two clouds (N, 3), m, and the true T_target_source."""

    source: Float64
    target: Float64
    T_target_source: Float64

    def is_right(self, T: Float64) -> bool:
        """Whether a pose is right, by the points that are not stray."""
        middle = np.median(self.source, axis=0)
        near = self.source[np.linalg.norm(self.source - middle, axis=1) < 100]
        extent = np.linalg.norm(np.ptp(near, axis=0))
        error = se3.transform(T, near) - se3.transform(self.T_target_source, near)
        far = np.sqrt((error**2).sum(1).mean()) > MAX_FRACTION * extent
        return not far and se3.angle(se3.inverse(self.T_target_source) @ T) <= MAX_RAD


def furnished(points: int = 3000, rng: np.random.Generator | None = None) -> Float64:
    """(N, 3) points of three walls and of boxes before them, m; of one room, or of a random one."""
    rng = rng or np.random.default_rng(0)
    parts = []
    for axis in range(3):
        wall = rng.uniform(0, 1, (points, 3)) * [6, 5, 3]
        wall[:, axis] = 0
        parts.append(wall)
    for _ in range(6):
        box = rng.uniform(0, 1, (points // 4, 3))
        face = rng.integers(0, 3, len(box))
        box[np.arange(len(box)), face] = rng.integers(0, 2, len(box))
        parts.append(rng.uniform(0.5, 4, 3) * [1, 1, 0.3] + box * rng.uniform(0.2, 0.9, 3))
    return np.concatenate(parts)


def seen(world: Float64, T_world_view: Float64, rng: np.random.Generator) -> Float64:
    """Return a random part of points (N, 3), with noise, in the frame of a view."""
    chosen = world[rng.choice(len(world), min(POINTS, len(world)), replace=False)]
    points = chosen + rng.normal(0, NOISE_M, chosen.shape)
    return se3.transform(se3.inverse(T_world_view), points)


def room_pair(seed: int) -> Pair:
    """Two views of a furnished room."""
    world, rng = furnished(), np.random.default_rng([seed, 20])
    target, source = seen(world, np.eye(4), rng), seen(world, T_ROOM, rng)
    return Pair(source, target, T_ROOM)


# ---- Symmetric bodies ----------------------------------------------------------------------------


def _prism(corners: int, radius: float = 0.3, height: float = 0.5) -> Mesh:
    profile = [(0, 0), (radius, 0), (radius, height), (0, height)]
    return meshes.lathe(profile, corners).translated(0, 0, -height / 2)


def _table(width: float, depth: float) -> Mesh:
    legs = [
        meshes.box((0.05, 0.05, 0.7), (0.45 * x * width, 0.45 * y * depth, 0.35))
        for x in (-1, 1)
        for y in (-1, 1)
    ]
    return meshes.joined([meshes.box((width, depth, 0.04), (0, 0, 0.72)), *legs])


def _four_walls(width: float, depth: float) -> Mesh:
    """A room with a cupboard in the middle of each wall."""
    shell = meshes.inside_out(meshes.box((width, depth, 2.5), (0, 0, 1.25)))
    cupboards = [
        meshes.box((0.4, 0.8, 1.8), (size / 2 - 0.2, 0, 0.9)).transformed(placed((0, 0), turn))
        for turn, size in zip(np.arange(4) * np.pi / 2, (width, depth, width, depth), strict=True)
    ]
    return meshes.joined([shell, *cupboards])


def _bowl() -> Mesh:
    z = np.linspace(0, 0.15, 8)
    outside = [(np.sqrt(max(0.04 - (0.2 - h) ** 2, 0.0)), h) for h in z]
    return meshes.lathe(outside, 64)


# Mesh, and the turns about x, y or z in degrees.
_BODIES: dict[str, tuple[Callable[[], Mesh], tuple[tuple[str, float], ...]]] = {
    "box": (lambda: meshes.box((0.6, 0.4, 0.3)), (("x", 180), ("y", 180), ("z", 180), ("z", 178))),
    "cube": (lambda: meshes.box((0.4, 0.4, 0.4)), (("x", 90), ("z", 90), ("z", 88), ("z", 180))),
    "triangular prism": (lambda: _prism(3), (("z", 120), ("z", 240))),
    "pentagonal prism": (lambda: _prism(5), (("z", 72),)),
    "hexagonal prism": (lambda: _prism(6), (("z", 60), ("z", 120), ("z", 58))),
    "octagonal prism": (lambda: _prism(8), (("z", 45), ("z", 90))),
    "cylinder": (lambda: _prism(64), (("z", 37), ("x", 180))),
    "bowl": (_bowl, (("z", 50),)),
    "ball": (lambda: meshes.superellipsoid((0.4, 0.4, 0.4), segments=(16, 32)), (("y", 70),)),
    "table": (lambda: _table(1.6, 0.8), (("z", 180),)),
    "square table": (lambda: _table(1.0, 1.0), (("z", 90), ("z", 180))),
    "room with four alike walls": (
        lambda: _four_walls(4, 4), (("z", 90), ("z", 93), ("z", 180))),
    "room with two alike walls": (lambda: _four_walls(5, 3), (("z", 180), ("z", 176))),
}  # fmt: skip


def symmetric_pairs() -> Iterator[tuple[str, Callable[[int], Pair]]]:
    """Yield bodies that were turned by their symmetry, or nearly: name, and pair by seed."""
    for name, (make, turns) in _BODIES.items():
        for axis, degrees in turns:

            def pair(seed: int, make: Callable[[], Mesh] = make, axis: str = axis,
                     degrees: float = degrees) -> Pair:  # fmt: skip
                rng = np.random.default_rng([seed, 21])
                w = np.radians(degrees) * np.eye(3)["xyz".index(axis)]
                T = se3.exp([0, 0, 0, *w])
                world = triangles.random_points(make().corners(), 2 * POINTS, rng)
                source, target = seen(world[:POINTS], T, rng), seen(world[POINTS:], np.eye(4), rng)
                return Pair(source, target, T)

            yield f"{name}, turned by {degrees:g} degrees about {axis}", pair


# ---- Stray points and map coordinates ------------------------------------------------------------


def strayed_pairs() -> Iterator[tuple[str, Callable[[int], Pair]]]:
    """Yield a room with stray points, or in map coordinates: name, and pair by seed."""
    for metres in (9e3, 1.3e4, 2e4, 1e5, 1e6, 1e8):
        for where in ("source", "target"):
            yield (
                f"stray point of the {where} at {metres:.0e} m",
                lambda seed, m=metres, w=where: with_points(room_pair(seed), _at(m), w),
            )
    yield "stray points of both", lambda seed: with_points(room_pair(seed), _at(2e4), "both")
    for percent, metres in ((1, 3e3), (4, 2e4)):
        yield (
            f"{percent} % of the points about {metres:.0e} m away",
            lambda seed, p=percent, m=metres: with_points(
                room_pair(seed),
                np.random.default_rng([seed, 22]).normal(0, m, (POINTS * p // 100, 3)),
                "source",
            ),
        )
    yield "map coordinates", lambda seed: moved(room_pair(seed), MAP, MAP)
    yield "one cloud in map coordinates", lambda seed: moved(room_pair(seed), MAP, np.zeros(3))
    yield (
        "map coordinates and a point at zero",
        lambda seed: with_points(moved(room_pair(seed), MAP, MAP), np.zeros((1, 3)), "both"),
    )


def _at(metres: float) -> Float64:
    return np.array([[metres, -0.5 * metres, 1.0]])


def with_points(pair: Pair, points: Float64, where: str) -> Pair:
    """Add points (N, 3) to "source", "target" or "both"."""
    changed = {
        name: np.concatenate([getattr(pair, name), points])
        for name in ("source", "target")
        if where in (name, "both")
    }
    return replace(pair, **changed)


def moved(pair: Pair, source: Float64, target: Float64) -> Pair:
    """Translate both clouds, each by a vector (3,), m."""
    T = pair.T_target_source.copy()
    T[:3, 3] += target - T[:3, :3] @ source
    return Pair(pair.source + source, pair.target + target, T)
