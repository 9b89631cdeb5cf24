"""A person on a rotating chair, in front of a still camera."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.lab.scenes import blends, furniture
from tofuse.lab.scenes.blends import Shape, ellipsoid, limb
from tofuse.lab.scenes.composition import Assembly, studio
from tofuse.lab.world import Material, Mesh, SceneOptions, ScenePlan, paths
from tofuse.lab.world import mesh as meshes

DISTANCE = 1.45
GRID = 0.018

SKIN = Material("skin", 0.55, 0.05, "noise", (0.06, 0.06, 0.06))
HAIR = Material("hair", 0.25, 0.15, "noise", (0.02, 0.02, 0.05))
SHIRT = Material("shirt", 0.52, 0.14, "noise", (0.10, 0.10, 0.10))
TROUSERS = Material("trousers", 0.40, 0.08, "noise", (0.08, 0.08, 0.08))
SEAT = Material("seat", 0.3, 0.1, "speckle", (0.03, 0.03, 0.03))


def body() -> list[tuple[Shape, float, Material]]:
    """Shapes of a seated person, facing +x, with the seat at z = 0.47 m.

    Returns (shape, blending width in m with those before it, material).
    """
    parts: list[tuple[Shape, float, Material]] = [
        (ellipsoid((-0.01, 0, 0.89), (0.115, 0.155, 0.19)), 0.05, SHIRT),
        (ellipsoid((0.005, 0, 0.70), (0.108, 0.145, 0.17)), 0.10, SHIRT),
        (ellipsoid((-0.01, 0, 0.565), (0.125, 0.175, 0.10)), 0.08, TROUSERS),
        (limb((-0.02, -0.135, 1.025), (-0.02, 0.135, 1.025), 0.062, 0.062), 0.09, SHIRT),
        # The slope from shoulders to neck.
        (limb((-0.025, -0.09, 1.065), (-0.025, 0.09, 1.065), 0.045, 0.045), 0.07, SHIRT),
        (limb((-0.03, 0, 1.09), (0.005, 0, 1.18), 0.056, 0.053), 0.05, SKIN),
        (ellipsoid((0.010, 0, 1.270), (0.098, 0.076, 0.115)), 0.03, SKIN),
        (ellipsoid((0.045, 0, 1.235), (0.060, 0.060, 0.085)), 0.03, SKIN),
        # Chin, lips, nose, brow.
        (ellipsoid((0.080, 0.003, 1.163), (0.026, 0.026, 0.022)), 0.04, SKIN),
        (ellipsoid((0.100, 0.003, 1.200), (0.014, 0.024, 0.012)), 0.02, SKIN),
        (limb((0.104, 0.004, 1.268), (0.124, 0.006, 1.232), 0.010, 0.014), 0.02, SKIN),
        (ellipsoid((0.094, 0.003, 1.284), (0.016, 0.046, 0.012)), 0.02, SKIN),
        (ellipsoid((-0.012, 0, 1.290), (0.096, 0.083, 0.108)), 0.01, HAIR),
    ]
    for side in (-1, 1):
        # Slightly asymmetric, as real people.
        lift = 0.02 if side > 0 else 0.0
        elbow = (-0.03 - lift, 0.255 * side, 0.755 + lift)
        wrist = (0.20, 0.175 * side, 0.655 + 0.5 * lift)
        hand = (0.265, 0.150 * side, 0.640 + 0.4 * lift)
        knee = (0.42, 0.115 * side, 0.545)
        heel, toe = (0.39, 0.115 * side, 0.11), (0.55, 0.13 * side, 0.095)
        parts += [
            (ellipsoid((0.062, 0.075 * side, 0.945), (0.052, 0.078, 0.065)), 0.06, SHIRT),
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
    shape = blends.blend([(s, width) for s, width, _ in parts])
    mesh = blends.surface_net(shape, (-0.25, -0.36, 0.0), (0.66, 0.36, 1.46), GRID)
    materials = [SHIRT, TROUSERS, SKIN, HAIR]

    def distances(p: Float64) -> Float64:
        """Distance (4, V) in m of points to the nearest part of each material."""
        return np.stack(
            [np.min([s(p) for s, _, m in parts if m is material], 0) for material in materials]
        )

    vertices = blends.project_to_surface(
        shape, _snap_to_borders(mesh, distances(mesh.vertices)), GRID
    )
    mesh = Mesh(vertices, mesh.faces, mesh.surface)
    return Mesh(vertices, mesh.faces, distances(mesh.corners().mean(1)).argmin(0)), materials


def _snap_to_borders(mesh: Mesh, distance: Float64) -> Float64:
    """Move vertices next to a border between materials onto the border, to smooth it."""
    label = distance.argmin(0)
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    edges = np.concatenate([edges, edges[:, ::-1]])
    a, b = edges[label[edges[:, 0]] != label[edges[:, 1]]].T
    # Difference of the distances to both materials, at either end: 0 on the border.
    difference_a = distance[label[b], a] - distance[label[a], a]
    difference_b = distance[label[b], b] - distance[label[a], b]
    fraction = difference_a / np.maximum(difference_a - difference_b, 1e-12)
    nearer_to_border = fraction <= 0.5
    a, b, fraction = a[nearer_to_border], b[nearer_to_border], fraction[nearer_to_border]
    step = fraction[:, None] * (mesh.vertices[b] - mesh.vertices[a])
    # The last assignment of a vertex prevails: the shortest step.
    order = np.argsort(-np.linalg.norm(step, axis=1), kind="stable")
    vertices = mesh.vertices.copy()
    vertices[a[order]] += step[order]
    return vertices


def plan(options: SceneOptions) -> ScenePlan:
    """Lay out the person, turning about the room's z axis."""
    still = Assembly([])
    studio(still)
    still.add(furniture.PLASTIC, *furniture.star_base())
    still.add(furniture.CHROME, meshes.rod((0, 0, 0.12), (0, 0, 0.385), 0.028))
    turning = Assembly(still.materials)
    mesh, materials = person()
    turning.add_mixed(materials, mesh)
    seat = meshes.superellipsoid((0.42, 0.42, 0.08), (0.4, 0.8), (8, 28)).translated(0.03, 0, 0.445)
    turning.add(SEAT, seat)
    camera = paths.look_at((-DISTANCE, 0, 0.98), (0, 0, 0.96))
    # Facing the camera first.
    facing = paths.rotation([0, 0, np.pi])
    turn = paths.object_turn(options.seconds)
    return ScenePlan(
        turning.materials,
        still.mesh(),
        paths.still(camera),
        turning.mesh(),
        lambda t: turn(t) @ facing,
        ambient=0.2,
        max_depth_m=2.2,
    )
