"""Furniture: office chair, desk with objects on it, plant. Forward is +x, the floor is z = 0."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.lab.scenes.composition import Assembly
from tofuse.lab.world import Material, Mesh
from tofuse.lab.world import mesh as meshes

PLASTIC = Material("chair frame", 0.16, 0.0, "plain", gloss=0.05)
CHROME = Material("chair column", 0.3, 0.0, "plain", gloss=0.35)


def star_base() -> list[Mesh]:
    """Five legs with casters, and the hub."""
    parts = [meshes.rod((0, 0, 0.07), (0, 0, 0.14), 0.045, 0.035)]
    for k in range(5):
        a = 2 * np.pi * k / 5
        along = np.array([np.cos(a), np.sin(a), 0.0])
        across = np.array([-np.sin(a), np.cos(a), 0.0])
        parts.append(
            meshes.rod(0.03 * along + [0, 0, 0.11], 0.31 * along + [0, 0, 0.075], 0.026, 0.016, 6)
        )
        wheel = 0.30 * along + np.array([0, 0, 0.028])
        inner, outer = 0.008 * across, 0.026 * across
        parts.append(meshes.rod(wheel + inner, wheel + outer, 0.028))
        parts.append(meshes.rod(wheel - inner, wheel - outer, 0.028))
    return parts


def cushion() -> Mesh:
    """Seat of 0.48 x 0.49 m with a sloping front edge; its top is at z = 0.50."""

    def sloped(p: Float64) -> Float64:
        q = p.copy()
        q[:, 2] -= 0.9 * np.maximum(p[:, 0] - 0.08, 0.0) ** 2
        q[:, 2] -= 0.010 * np.cos(np.clip(p[:, 1] / 0.22, -1, 1) * np.pi / 2) * (p[:, 2] > 0)
        return q

    seat = meshes.superellipsoid((0.48, 0.49, 0.085), (0.45, 0.45), (10, 24))
    return seat.warped(sloped).translated(0, 0, 0.46)


def backrest() -> Mesh:
    """Back of 0.44 x 0.52 m, curved around the sitter and leaning back."""

    def curve(p: Float64) -> Float64:
        # Built with its thickness along z: rotate it to x, then bend.
        x, y, z = p[:, 2], p[:, 0], p[:, 1]
        lean = -0.20 * (z + 0.1)
        lumbar = 0.025 * np.cos(np.clip((z + 0.10) / 0.20, -1, 1) * np.pi / 2)
        return np.stack([x + 0.9 * y * y + lean + lumbar, y, z], -1)

    panel = meshes.superellipsoid((0.44, 0.52, 0.06), (0.5, 0.4), (10, 28))
    return panel.warped(curve).translated(-0.235, 0, 0.84)


def chair(assembly: Assembly, fabric: Material, *, arms: bool = True) -> None:
    """Add an office chair: five-star base, column, seat, back, armrests."""
    frame = star_base()
    frame.append(meshes.box((0.24, 0.18, 0.045), (-0.02, 0, 0.405)))
    # The bar that carries the back.
    frame.append(meshes.box((0.22, 0.07, 0.02), (-0.21, 0, 0.405)))
    frame.append(meshes.rod((-0.31, 0, 0.40), (-0.285, 0, 0.80), 0.026, 0.026, 8))
    if arms:
        for side in (-1, 1):
            y = 0.285 * side
            frame.append(meshes.box((0.06, 0.18, 0.018), (-0.02, 0.20 * side, 0.425)))
            frame.append(meshes.rod((-0.02, y, 0.42), (-0.03, y, 0.655), 0.02, 0.018, 8))
            pad = meshes.superellipsoid((0.27, 0.075, 0.035), (0.5, 0.5), (6, 16))
            frame.append(pad.translated(0.01, y, 0.67))
    assembly.add(PLASTIC, *frame)
    column = [
        meshes.rod((0, 0, 0.12), (0, 0, 0.28), 0.028),
        meshes.rod((0, 0, 0.28), (0, 0, 0.40), 0.016),
    ]
    assembly.add(CHROME, *column)
    assembly.add(fabric, cushion(), backrest())


WOOD = Material("desk", 0.42, 0.2, "wood", (0.9, 0.9, 0.05))
CABINET = Material("drawers", 0.5, 0.08, "wood", (0.05, 0.9, 0.9))
METAL = Material("metal", 0.45, 0.0, "plain", gloss=0.15)
SCREEN = Material("screen", 0.08, 0.0, "plain", gloss=0.4)
CASE = Material("monitor case", 0.25, 0.0, "plain", gloss=0.05)
KEYS = Material("keyboard", 0.35, 0.35, "tiles", (0.022, 0.022, 0.022))
PAPER = Material("paper", 0.75, 0.25, "print", (0.07, 0.07, 0.07))
CERAMIC = Material("mug", 0.7, 0.0, "plain", gloss=0.05)
BOOKS = [
    Material(f"book {k}", albedo, 0.12, "print", (0.08, 0.08, 0.08))
    for k, albedo in enumerate((0.55, 0.3, 0.7, 0.42))
]
LAMP = Material("lamp", 0.6, 0.0, "plain", gloss=0.1)


def desk(assembly: Assembly) -> None:
    """Add a desk of 1.6 x 0.75 x 0.73 m, long along y, the sitter at +x, with objects on it."""
    top = 0.73
    add = assembly.add
    add(WOOD, meshes.box_between((-0.375, -0.8, top - 0.03), (0.375, 0.8, top)))
    add(WOOD, meshes.box_between((-0.34, -0.74, 0.35), (-0.32, 0.74, top - 0.03)))
    legs = [
        meshes.box_between((x - 0.025, y - 0.025, 0), (x + 0.025, y + 0.025, top - 0.03))
        for x in (-0.33, 0.33)
        for y in (-0.75, 0.75)
    ]
    add(METAL, *legs)
    drawers = [meshes.box_between((-0.28, 0.28, 0.05), (0.28, 0.70, 0.62))]
    fronts = [
        meshes.box_between((0.28, 0.285, z), (0.298, 0.695, z + 0.175)) for z in (0.06, 0.25, 0.44)
    ]
    add(CABINET, *drawers, *fronts)
    handles = [
        meshes.rod((0.315, 0.42, z), (0.315, 0.56, z), 0.007, segments=8)
        for z in (0.19, 0.38, 0.57)
    ]
    add(METAL, *handles)
    T_desk_monitor = np.eye(4)
    T_desk_monitor[:2, :2] = [[0.97, 0.243], [-0.243, 0.97]]
    T_desk_monitor[:2, :2] /= np.sqrt(0.97**2 + 0.243**2)
    T_desk_monitor[:3, 3] = (-0.12, -0.05, top)
    screen = [meshes.box((0.012, 0.50, 0.30), (0.024, 0, 0.29))]
    case = [
        meshes.box((0.036, 0.54, 0.34), (0, 0, 0.29)),
        meshes.box((0.03, 0.06, 0.16), (-0.02, 0, 0.09)),
        meshes.superellipsoid((0.20, 0.26, 0.02), (0.3, 0.8), (6, 20)).translated(-0.01, 0, 0.012),
    ]
    add(SCREEN, *(part.transformed(T_desk_monitor) for part in screen))
    add(CASE, *(part.transformed(T_desk_monitor) for part in case))
    add(KEYS, meshes.box((0.15, 0.44, 0.02), (0.18, -0.08, top + 0.011)))
    add(
        CASE,
        meshes.superellipsoid((0.11, 0.065, 0.04), (0.7, 0.8)).translated(0.2, 0.24, top + 0.02),
    )
    add(PAPER, meshes.box((0.297, 0.21, 0.012), (0.14, -0.52, top + 0.006)))
    height = top
    for k, (material, thickness) in enumerate(
        zip(BOOKS, (0.035, 0.022, 0.045, 0.028), strict=True)
    ):
        size = (0.24 - 0.02 * k, 0.17 - 0.01 * k, thickness)
        add(
            material, meshes.box(size, (-0.12 + 0.01 * k, 0.55 - 0.015 * k, height + thickness / 2))
        )
        height += thickness
    mug = [(0, 0), (0.036, 0), (0.041, 0.095), (0.036, 0.095), (0.032, 0.012), (0, 0.012)]
    add(CERAMIC, meshes.lathe(mug, 20).translated(0.12, 0.42, top))
    angle = np.linspace(-1.9, 1.9, 9)
    ring = np.stack([0 * angle, 0.05 + 0.03 * np.cos(angle), 0.05 + 0.03 * np.sin(angle)], -1)
    ring += (0.12, 0.41, top)
    add(CERAMIC, *(meshes.rod(a, b, 0.006, segments=6) for a, b in pairwise(ring)))
    foot, neck, elbow, head, rim = np.array([-0.15, -0.62, top]) + np.array(
        [(0, 0, 0), (0, 0, 0.02), (-0.08, 0.02, 0.30), (0.12, 0.10, 0.46), (0.18, 0.125, 0.38)]
    )
    add(
        LAMP,
        meshes.rod(foot, neck, 0.09, segments=20),
        meshes.rod(neck, elbow, 0.009, segments=8),
        meshes.rod(elbow, head, 0.009, segments=8),
        meshes.rod(head, rim, 0.025, 0.075, 16),
    )


LEAF = Material("leaf", 0.5, 0.12, "noise", (0.05, 0.05, 0.05), hue=0.3)
STEM = Material("stem", 0.35)
POT = Material("pot", 0.45, 0.06, "noise", (0.1, 0.1, 0.1), hue=0.04)
SOIL = Material("soil", 0.2, 0.25, "speckle", (0.02, 0.02, 0.02))


def leaf(length: float, width: float, droop: float) -> Mesh:
    """Pointed leaf along +x from the origin, folded along its midrib, bending down."""
    s = np.linspace(0.0, 1.0, 9)
    half = 0.5 * width * np.sin(np.pi * s**0.75)
    side = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    points = np.empty((len(s), len(side), 3))
    points[..., 0] = (length * (s - 0.12 * droop * s * s))[:, None]
    points[..., 1] = half[:, None] * side
    points[..., 2] = (-length * droop * s * s)[:, None] + 0.35 * half[:, None] * np.abs(side)
    return meshes.grid(points)


def plant(assembly: Assembly, rng: np.random.Generator) -> None:
    """Add a potted plastic plant, 1.1 m high: stems that fan out, with broad leaves."""
    pot = [(0, 0), (0.12, 0), (0.165, 0.27), (0.175, 0.27), (0.175, 0.30), (0.155, 0.30)]
    assembly.add(POT, meshes.lathe([*pot, (0.15, 0.26)], 28))
    assembly.add(SOIL, meshes.lathe([(0.152, 0.262), (0, 0.275)], 20))
    stems: list[Mesh] = []
    foliage: list[Mesh] = []
    golden, leaves = np.pi * (3 - np.sqrt(5)), 34
    for k in range(leaves):
        fraction = (k + 0.5) / leaves
        azimuth = golden * k + rng.uniform(-0.3, 0.3)
        height = 0.42 + 0.62 * fraction + rng.uniform(-0.04, 0.04)
        reach = (0.22 - 0.14 * fraction) * rng.uniform(0.8, 1.2)
        out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        root = 0.03 * out + [0, 0, 0.26 + 0.4 * fraction]
        tip = reach * out + [0, 0, height]
        stems.append(meshes.rod(root, tip, 0.006, 0.004, 6))
        blade = leaf(rng.uniform(0.20, 0.28), rng.uniform(0.09, 0.13), rng.uniform(0.3, 0.9))
        pitch = rng.uniform(0.1, 0.7) + 0.3 * fraction
        c, s = np.cos(pitch), np.sin(pitch)
        across = np.cross([0.0, 0.0, 1.0], out)
        forward = c * out + [0, 0, s]
        axes = np.stack([forward, across, np.cross(forward, across)], 1)
        foliage.append(blade.transformed(se3.pose(axes, tip)))
    stems.append(meshes.rod((0, 0, 0.25), (0, 0, 0.72), 0.014, 0.008, 8))
    assembly.add(STEM, *stems)
    assembly.add(LEAF, *foliage)
