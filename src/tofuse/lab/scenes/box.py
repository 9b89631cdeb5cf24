"""The box of 300 x 300 x 400 mm on its stand, in front of a still camera."""

from __future__ import annotations

from tofuse.lab.scenes.composition import Assembly, studio
from tofuse.lab.world import Material, SceneOptions, ScenePlan, paths
from tofuse.lab.world import mesh as meshes

WIDTH, DEPTH, HEIGHT = 0.300, 0.300, 0.400
BOTTOM = 0.90
DISTANCE = 1.05

BOX = Material("box", 0.8, 0.03, "noise", (0.12, 0.12, 0.12))
STEEL = Material("stand", 0.35, 0.0, "plain", gloss=0.2)


def plan(options: SceneOptions) -> ScenePlan:
    """Lay out the box, turning about the room's z axis."""
    still = Assembly([])
    studio(still)
    still.add(STEEL, meshes.lathe([(0, 0), (0.22, 0), (0.22, 0.015), (0.03, 0.03), (0, 0.03)], 24))
    turning = Assembly(still.materials)
    turning.add(BOX, meshes.box((WIDTH, DEPTH, HEIGHT), (0, 0, BOTTOM + HEIGHT / 2)))
    turning.add(STEEL, meshes.rod((0, 0, 0.031), (0, 0, BOTTOM - 0.012), 0.02))
    turning.add(STEEL, meshes.rod((0, 0, BOTTOM - 0.012), (0, 0, BOTTOM), 0.08, segments=20))
    # High enough above the top face to see it well, but the sides not foreshortened.
    camera = paths.look_at((-DISTANCE, 0, 1.68), (0, 0, BOTTOM + HEIGHT / 2 - 0.01))
    return ScenePlan(
        turning.materials,
        still.mesh(),
        paths.still(camera),
        turning.mesh(),
        paths.object_turn(options.seconds),
        ambient=0.2,
        max_depth_m=1.8,
    )
