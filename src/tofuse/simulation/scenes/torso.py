"""A person on a rotating chair, in front of a still camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofuse.simulation import mesh as meshes
from tofuse.simulation import paths
from tofuse.simulation.mesh import Mesh
from tofuse.simulation.scene import Plan, SceneOptions
from tofuse.simulation.scenes import furniture, implicit
from tofuse.simulation.scenes.assembly import Assembly, studio
from tofuse.simulation.scenes.implicit import Shape, ellipsoid, limb
from tofuse.simulation.texture import Material

DISTANCE = 1.45
GRID = 0.020

SKIN = Material("skin", 0.55, 0.05, "noise", (0.06, 0.06, 0.06))
HAIR = Material("hair", 0.25, 0.15, "noise", (0.02, 0.02, 0.05))
SHIRT = Material("shirt", 0.52, 0.14, "noise", (0.10, 0.10, 0.10))
TROUSERS = Material("trousers", 0.40, 0.08, "noise", (0.08, 0.08, 0.08))
SEAT = Material("seat", 0.3, 0.1, "speckle", (0.03, 0.03, 0.03))


def body() -> list[tuple[Shape, float, Material]]:
    """Shapes of a seated person, facing +x, with the seat at z = 0.47 m.

    Returns (shape, m over which it blends with those before it, material).
    """
    parts: list[tuple[Shape, float, Material]] = [
        (ellipsoid((-0.01, 0, 0.89), (0.115, 0.155, 0.19)), 0.05, SHIRT),
        (ellipsoid((0.005, 0, 0.70), (0.108, 0.145, 0.17)), 0.10, SHIRT),
        (ellipsoid((-0.01, 0, 0.565), (0.125, 0.175, 0.10)), 0.08, TROUSERS),
        (limb((-0.02, -0.135, 1.025), (-0.02, 0.135, 1.025), 0.062, 0.062), 0.09, SHIRT),
        # The slope from shoulders to neck.
        (limb((-0.025, -0.09, 1.065), (-0.025, 0.09, 1.065), 0.045, 0.045), 0.07, SHIRT),
        (limb((-0.03, 0, 1.06), (0.005, 0, 1.17), 0.058, 0.053), 0.05, SKIN),
        (ellipsoid((0.015, 0, 1.265), (0.097, 0.077, 0.118)), 0.03, SKIN),
        (ellipsoid((0.050, 0.004, 1.190), (0.052, 0.046, 0.045)), 0.05, SKIN),
        (ellipsoid((0.118, 0.008, 1.245), (0.022, 0.014, 0.028)), 0.025, SKIN),
        (ellipsoid((0.095, 0.005, 1.282), (0.016, 0.050, 0.012)), 0.02, SKIN),
        (ellipsoid((-0.008, 0, 1.285), (0.100, 0.083, 0.112)), 0.01, HAIR),
    ]
    for side in (-1, 1):
        # Left and right differ a little, as they do in people.
        lift = 0.02 if side > 0 else 0.0
        elbow = (-0.03 - lift, 0.255 * side, 0.755 + lift)
        wrist = (0.20, 0.175 * side, 0.655 + 0.5 * lift)
        hand = (0.265, 0.150 * side, 0.640 + 0.4 * lift)
        knee = (0.42, 0.115 * side, 0.545)
        heel, toe = (0.39, 0.115 * side, 0.11), (0.55, 0.13 * side, 0.095)
        parts += [
            (ellipsoid((0.07, 0.075 * side, 0.945), (0.055, 0.075, 0.060)), 0.05, SHIRT),
            (ellipsoid((-0.085, 0.085 * side, 0.955), (0.045, 0.065, 0.095)), 0.05, SHIRT),
            (ellipsoid((0.005, 0.082 * side, 1.255), (0.020, 0.013, 0.032)), 0.01, SKIN),
            (limb((-0.02, 0.185 * side, 1.020), elbow, 0.060, 0.042), 0.04, SHIRT),
            (limb(elbow, wrist, 0.042, 0.029), 0.02, SHIRT),
            (limb((0.0, 0.095 * side, 0.565), knee, 0.090, 0.062), 0.06, TROUSERS),
            (limb(knee, (0.40, 0.115 * side, 0.16), 0.060, 0.042), 0.03, TROUSERS),
            (limb(heel, toe, 0.045, 0.035), 0.03, HAIR),
            (ellipsoid(hand, (0.075, 0.042, 0.022)), 0.03, SKIN),
        ]
    return parts


def person() -> tuple[Mesh, list[Material]]:
    """Triangulate the body; returns the mesh and the materials of its surfaces."""
    parts = body()
    shape = implicit.blend([(s, width) for s, width, _ in parts])
    mesh = implicit.surface_net(shape, (-0.25, -0.36, 0.0), (0.66, 0.36, 1.46), GRID)
    materials = [SHIRT, TROUSERS, SKIN, HAIR]
    middle = mesh.corners().mean(1)
    nearest = np.argmin([s(middle) for s, _, _ in parts], axis=0)
    of_part = np.array([materials.index(m) for _, _, m in parts])
    return Mesh(mesh.vertices, mesh.faces, of_part[nearest]), materials


def plan(options: SceneOptions) -> Plan:
    """Lay out the person, turning about the room's z axis."""
    still = Assembly([])
    studio(still)
    still.add(furniture.PLASTIC, *furniture.star_base())
    still.add(furniture.CHROME, meshes.rod((0, 0, 0.12), (0, 0, 0.385), 0.028))
    turning = Assembly(still.materials)
    mesh, materials = person()
    for k, material in enumerate(materials):
        turning.add(material, _only(mesh, mesh.surface == k))
    seat = meshes.superellipsoid((0.42, 0.42, 0.08), (0.4, 0.8), (8, 28)).shifted(0.03, 0, 0.445)
    turning.add(SEAT, seat)
    camera = paths.look_at((-DISTANCE, 0, 0.98), (0, 0, 0.96))
    # Facing the camera first.
    facing = paths.rotation([0, 0, np.pi])
    turn = paths.object_turn(options.seconds)
    return Plan(
        turning.materials,
        still.mesh(),
        paths.still(camera),
        turning.mesh(),
        lambda t: turn(t) @ facing,
        ambient=0.2,
        max_depth_m=2.2,
    )


def _only(mesh: Mesh, mask: NDArray[np.bool_]) -> Mesh:
    """Return the triangles of a mask, with all vertices."""
    return Mesh(mesh.vertices, mesh.faces[mask], mesh.surface[mask])
