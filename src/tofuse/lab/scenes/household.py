"""Furniture of a flat: sofa, bed, shelf, table, cabinet, lamp. Forward is +x, the floor z = 0."""

from __future__ import annotations

import numpy as np

from tofuse.lab.scenes.composition import Assembly
from tofuse.lab.world import Material
from tofuse.lab.world import mesh as meshes

OAK = Material("oak", 0.46, 0.2, "wood", (0.9, 0.9, 0.05))
BIRCH = Material("birch", 0.62, 0.12, "wood", (0.7, 0.7, 0.06))
LINEN = Material("linen", 0.72, 0.1, "noise", (0.15, 0.15, 0.15))
QUILT = Material("quilt", 0.5, 0.3, "print", (0.18, 0.18, 0.18))
SHADE = Material("lampshade", 0.75, 0.05, "noise", (0.1, 0.1, 0.1))
IRON = Material("iron", 0.2, 0.0, "plain", gloss=0.1)
SPINES = [
    Material(f"spine {k}", albedo, 0.15, "print", (0.06, 0.06, 0.06))
    for k, albedo in enumerate((0.25, 0.6, 0.42, 0.72, 0.33))
]


def sofa(assembly: Assembly, fabric: Material, width: float = 1.7) -> None:
    """Add a sofa, 0.85 m deep and 0.85 m high."""
    half = width / 2
    roundness = (0.25, 0.3)
    parts = [
        meshes.box_between((-0.40, -half, 0.08), (0.40, half, 0.30)),
        meshes.superellipsoid((0.26, width, 0.62), roundness).translated(-0.30, 0, 0.55),
    ]
    for side in (-1, 1):
        arm = meshes.superellipsoid((0.82, 0.20, 0.55), roundness)
        parts.append(arm.translated(0, side * (half - 0.08), 0.34))
        seat = meshes.superellipsoid((0.62, half - 0.18, 0.18), (0.3, 0.3))
        parts.append(seat.translated(0.10, side * (half - 0.16) / 2, 0.37))
    assembly.add(fabric, *parts)
    pillow = meshes.superellipsoid((0.14, 0.42, 0.40), (0.7, 0.6))
    assembly.add(QUILT, pillow.translated(-0.12, 0.24 * width, 0.62))


def bed(assembly: Assembly) -> None:
    """Add a bed of 2.0 x 0.95 m, its head at -x."""
    assembly.add(
        OAK,
        meshes.box_between((-1.0, -0.475, 0.12), (1.0, 0.475, 0.30)),
        meshes.box_between((-1.03, -0.475, 0), (-0.98, 0.475, 0.85)),
        *(
            meshes.box_between((x, y, 0), (x + 0.06, y + 0.06, 0.12))
            for x in (-0.98, 0.92)
            for y in (-0.46, 0.40)
        ),
    )
    mattress = meshes.superellipsoid((1.96, 0.93, 0.22), (0.25, 0.25)).translated(0, 0, 0.40)
    pillow = meshes.superellipsoid((0.45, 0.70, 0.16), (0.7, 0.5)).translated(-0.68, 0.02, 0.56)
    assembly.add(LINEN, mattress, pillow)
    quilt = meshes.superellipsoid((1.25, 1.02, 0.20), (0.5, 0.3)).translated(0.36, 0.01, 0.46)
    assembly.add(QUILT, quilt)


def shelf(
    assembly: Assembly, rng: np.random.Generator, width: float = 0.9, boards: int = 6
) -> None:
    """Add a shelf 0.30 m deep with books of random sizes; its back is at x = 0."""
    pitch, half = 0.34, width / 2
    top = 0.04 + pitch * (boards - 1)
    assembly.add(
        BIRCH,
        *(
            meshes.box_between((0, -half, 0.04 + pitch * k), (0.30, half, 0.06 + pitch * k))
            for k in range(boards)
        ),
        *(
            meshes.box_between((0, y, 0), (0.30, y + 0.02, top + 0.02))
            for y in (-half, half - 0.02)
        ),
        meshes.box_between((0, -half, 0), (0.008, half, top)),
    )
    for k in range(boards - 1):
        left, end = -half + 0.03, half - 0.03 - rng.uniform(0.0, 0.35)
        while True:
            thickness = rng.uniform(0.018, 0.06)
            if left + thickness > end:
                break
            low = 0.06 + pitch * k
            depth, height = rng.uniform(0.14, 0.24), rng.uniform(0.18, 0.29)
            book = meshes.box_between(
                (0.01, left, low), (depth, left + thickness - 0.002, low + height)
            )
            assembly.add(SPINES[int(rng.integers(len(SPINES)))], book)
            left += thickness


def table(
    assembly: Assembly, wood: Material, size: tuple[float, float] = (0.8, 1.2), height: float = 0.74
) -> None:
    """Add a table on four legs."""
    x, y = size[0] / 2, size[1] / 2
    top = meshes.box_between((-x, -y, height - 0.035), (x, y, height))
    legs = [
        meshes.rod((a, b, 0), (a, b, height - 0.03), 0.03)
        for a in (0.06 - x, x - 0.06)
        for b in (0.06 - y, y - 0.06)
    ]
    assembly.add(wood, top, *legs)
    bowl = [(0, 0.0), (0.06, 0.0), (0.15, 0.07), (0.145, 0.075), (0.05, 0.012), (0, 0.012)]
    assembly.add(LINEN, meshes.lathe(bowl, 20).translated(0.05, -0.1, height))


def cabinet(assembly: Assembly, wood: Material, size: tuple[float, float, float]) -> None:
    """Add a closed cabinet with two doors (depth, width, height); its back is at x = 0."""
    depth, width, height = size
    half = width / 2
    assembly.add(
        wood,
        meshes.box_between((0, -half, 0.06), (depth - 0.02, half, height)),
        meshes.box_between((depth - 0.02, -half + 0.005, 0.07), (depth, -0.004, height - 0.01)),
        meshes.box_between((depth - 0.02, 0.004, 0.07), (depth, half - 0.005, height - 0.01)),
    )
    handle_z = 0.5 * height
    handles = [
        meshes.rod(
            (depth + 0.03, y, handle_z - 0.1), (depth + 0.03, y, handle_z + 0.1), 0.008, segments=8
        )
        for y in (-0.05, 0.05)
    ]
    assembly.add(IRON, *handles)


def floor_lamp(assembly: Assembly) -> None:
    """Add a lamp 1.6 m high."""
    assembly.add(
        IRON,
        meshes.rod((0, 0, 0), (0, 0, 0.025), 0.15, segments=20),
        meshes.rod((0, 0, 0.025), (0, 0, 1.35), 0.014, segments=8),
    )
    assembly.add(SHADE, meshes.rod((0, 0, 1.32), (0, 0, 1.60), 0.22, 0.15, 24))
