"""Simple scenes: a wall, a corner, a corridor, a hall."""

from __future__ import annotations

from tofuse.lab.scenes.composition import Assembly, shell
from tofuse.lab.world import Material, SceneOptions, ScenePlan, paths
from tofuse.lab.world import mesh as meshes

WALL = Material("wall", 0.65, 0.2, "noise", (0.5, 0.5, 0.5))
SIDE = Material("side wall", 0.7, 0.15, "print", (0.4, 0.4, 0.4))
FLOOR = Material("floor", 0.4, 0.2, "speckle", (0.1, 0.1, 0.1))
CRATE = Material("crate", 0.5, 0.2, "wood", (0.4, 0.1, 0.1))
CEILING = Material("ceiling", 0.75, 0.05, "tiles", (0.6, 0.6, 0.6))


def plan(options: SceneOptions) -> ScenePlan:
    """Lay out one of the simple scenes."""
    assembly = Assembly([])
    camera = paths.look_at((0, 0, 1.2), (0, 1, 1.2))
    if options.name == "wall":
        assembly.add(WALL, meshes.quad((-6, 2, -4), (12, 0, 0), (0, 0, 10)))
        path = paths.sway(camera, (0.3, 0.05, 0.1, 0.02, 0.08, 0.0), options.seconds)
    elif options.name == "corner":
        assembly.add(WALL, meshes.quad((-4, 3, 0), (4.8, 0, 0), (0, 0, 4)))
        assembly.add(SIDE, meshes.quad((0.8, 3, 0), (0, -6, 0), (0, 0, 4)))
        assembly.add(FLOOR, meshes.quad((-4, 3, 0), (0, -6, 0), (4.8, 0, 0)))
        camera = paths.look_at((0, 0.6, 1.2), (0.4, 3, 0.4))
        path = paths.sway(camera, (0.2, 0.1, 0.2, 0.05, 0.12, 0.03), options.seconds)
    elif options.name == "hall":
        shell(assembly, (-4, -4, 0), (4, 4, 3), [SIDE, WALL, SIDE, WALL], FLOOR, CEILING)
        for x, y, height in ((-1.6, 0.4, 1.1), (0.8, -1.2, 0.8), (1.9, 1.7, 1.9)):
            assembly.add(CRATE, meshes.box_between((x, y, 0), (x + 0.7, y + 0.6, height)))
        camera = paths.look_at((-3.4, -3.4, 1.5), (0, 0, 1.1))
        path = paths.sway(camera, (0.2, 0.1, 0.2, 0.05, 0.6, 0.03), options.seconds)
    else:
        shell(assembly, (-1, -2, 0), (1, 10, 2.4), [SIDE, SIDE, WALL, WALL], FLOOR, CEILING)
        path = paths.sway(camera, (0.0, 0.0, 1.5, 0.0, 0.1, 0.0), 2 * options.seconds)
    return ScenePlan(assembly.materials, assembly.mesh(), path)
