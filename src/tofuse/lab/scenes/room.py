"""The room of 6.0 x 3.2 m, with seven office chairs or empty."""

from __future__ import annotations

import numpy as np

from tofuse.lab.scenes import furniture
from tofuse.lab.scenes.composition import Assembly, shell
from tofuse.lab.world import Material, SceneOptions, ScenePlan, paths
from tofuse.lab.world import mesh as meshes

LENGTH, WIDTH, HEIGHT = 6.0, 3.2, 2.5
CAMERA_HEIGHT = 0.8
CHAIRS = 7

WALLPAPER = Material("long wall", 0.68, 0.16, "noise", (0.45, 0.45, 0.45))
PLASTER = Material("short wall", 0.74, 0.08, "noise", (0.6, 0.6, 0.6))
CARPET = Material("floor", 0.38, 0.18, "speckle", (0.09, 0.09, 0.09))
CEILING = Material("ceiling", 0.78, 0.05, "tiles", (0.6, 0.6, 0.6))
SKIRTING = Material("skirting", 0.55, 0.1, "wood", (0.8, 0.8, 0.04))
DOOR = Material("door", 0.5, 0.1, "wood", (0.08, 0.08, 0.9), gloss=0.3)
CASING = Material("casing", 0.72)
STEEL = Material("handle", 0.4, gloss=0.3)
GLASS = Material("window pane", 0.08, gloss=0.6)
SOCKET = Material("socket", 0.82)
POSTER = Material("poster", 0.55, 0.35, "print", (0.22, 0.22, 0.22))
CHART = Material("chart", 0.7, 0.3, "tiles", (0.11, 0.11, 0.11))
CORK = Material("pin board", 0.45, 0.28, "print", (0.14, 0.14, 0.14))
FABRICS = [
    Material(f"chair {k}", albedo, 0.07, "speckle", (0.03, 0.03, 0.03))
    for k, albedo in enumerate((0.34, 0.22, 0.45, 0.30, 0.16, 0.40, 0.26))
]


def plan(options: SceneOptions) -> ScenePlan:
    """Lay out the room."""
    assembly = Assembly([])
    x, y = LENGTH / 2, WIDTH / 2
    shell(
        assembly,
        (-x, -y, 0),
        (x, y, HEIGHT),
        [PLASTER, PLASTER, WALLPAPER, WALLPAPER],
        CARPET,
        CEILING,
    )
    _fittings(assembly)
    if options.name == "room":
        _chairs(assembly, np.random.default_rng([options.seed, 3]))
    camera = paths.look_at((0, 0, CAMERA_HEIGHT), (1, 0.2, CAMERA_HEIGHT))
    path = paths.camera_turn(camera, options.seconds)
    return ScenePlan(assembly.materials, assembly.mesh(), path, ambient=0.4)


def _fittings(assembly: Assembly) -> None:
    """Add door, window, skirting boards, sockets, pictures: all within 5 cm of the walls."""
    x, y = LENGTH / 2, WIDTH / 2
    between = meshes.box_between
    # The door is in the long wall at -y.
    left, right, top = 1.35, 2.25, 2.05
    assembly.add(DOOR, between((left, -y, 0), (right, -y + 0.010, top)))
    assembly.add(
        CASING,
        between((left - 0.07, -y, 0), (left, -y + 0.025, top + 0.07)),
        between((right, -y, 0), (right + 0.07, -y + 0.025, top + 0.07)),
        between((left, -y, top), (right, -y + 0.025, top + 0.07)),
    )
    assembly.add(
        STEEL,
        meshes.rod((left + 0.07, -y, 1.03), (left + 0.07, -y + 0.05, 1.03), 0.011),
        meshes.rod((left + 0.06, -y + 0.05, 1.03), (left + 0.19, -y + 0.05, 1.03), 0.010),
    )
    # The window is in the short wall at +x.
    low, high, half = 0.85, 2.10, 0.85
    assembly.add(GLASS, between((x - 0.006, -half, low), (x, half, high)))
    bars = [(-half - 0.06, -half), (-0.03, 0.03), (half, half + 0.06)]
    assembly.add(CASING, *(between((x - 0.03, a, low), (x, b, high)) for a, b in bars))
    for a, b in ((low - 0.06, low), (high, high + 0.06)):
        assembly.add(CASING, between((x - 0.03, -half - 0.06, a), (x, half + 0.06, b)))
    sill = between((x - 0.05, -half - 0.12, low - 0.09), (x, half + 0.12, low - 0.06))
    assembly.add(CASING, sill)
    skirting_height, skirting_depth = 0.09, 0.012
    assembly.add(
        SKIRTING,
        between((-x, y - skirting_depth, 0), (x, y, skirting_height)),
        between((-x, -y, 0), (left - 0.07, -y + skirting_depth, skirting_height)),
        between((right + 0.07, -y, 0), (x, -y + skirting_depth, skirting_height)),
        between((-x, -y, 0), (-x + skirting_depth, y, skirting_height)),
        between((x - skirting_depth, -y, 0), (x, y, skirting_height)),
    )
    for left_edge in (-2.2, 0.4, 2.5):
        assembly.add(SOCKET, between((left_edge, y - 0.008, 0.28), (left_edge + 0.15, y, 0.36)))
    assembly.add(SOCKET, between((1.10, -y, 1.02), (1.18, -y + 0.008, 1.10)))
    assembly.add(SOCKET, between((-1.9, -y, 0.28), (-1.75, -y + 0.008, 0.36)))
    assembly.add(POSTER, between((-1.75, y - 0.005, 0.75), (-1.05, y, 1.70)))
    assembly.add(CHART, between((0.7, y - 0.005, 0.70), (1.7, y, 1.40)))
    assembly.add(POSTER, between((-0.6, -y, 0.80), (0.0, -y + 0.005, 1.60)))
    assembly.add(CORK, between((-x, -0.75, 0.70), (-x + 0.015, 0.55, 1.50)))


def _chairs(assembly: Assembly, rng: np.random.Generator) -> None:
    """Add seven chairs evenly around the camera, roughly facing it."""
    for k, fabric in enumerate(FABRICS):
        azimuth = 2 * np.pi * (k + 0.35) / CHAIRS
        # Evenly in angle, so that one is always visible, on an ellipse clear of the walls.
        c, s = np.cos(azimuth), np.sin(azimuth)
        position = np.array([c, s]) / np.hypot(c / 2.15, s / 1.12)
        T = paths.rotation([0, 0, azimuth + np.pi + rng.uniform(-0.9, 0.9)])
        T[:2, 3] = position
        furniture.chair(assembly.at(T), fabric, arms=k % 3 != 1)
