"""An office desk, a chair and a plastic plant, seen from a camera on a rail."""

from __future__ import annotations

import numpy as np

from tofuse.lab.scenes import furniture
from tofuse.lab.scenes.composition import Assembly, placed, shell
from tofuse.lab.world import Material, SceneOptions, ScenePlan, paths
from tofuse.lab.world import mesh as meshes

RAIL_LENGTH = 0.90

WALL = Material("wall", 0.7, 0.09, "noise", (0.5, 0.5, 0.5))
FLOOR = Material("floor", 0.4, 0.18, "speckle", (0.09, 0.09, 0.09))
CEILING = Material("ceiling", 0.78, 0.05, "tiles", (0.6, 0.6, 0.6))
SKIRTING = Material("skirting", 0.6)
FABRIC = Material("chair", 0.32, 0.07, "speckle", (0.03, 0.03, 0.03))
POSTER = Material("poster", 0.55, 0.35, "print", (0.25, 0.25, 0.25))
CALENDAR = Material("calendar", 0.65, 0.3, "tiles", (0.06, 0.06, 0.06))


def plan(options: SceneOptions) -> ScenePlan:
    """Lay out the office: the camera looks along +y and slides along +x."""
    assembly = Assembly([])
    shell(assembly, (-3, -1.5, 0), (3, 3.0, 2.6), [WALL] * 4, FLOOR, CEILING)
    assembly.add(SKIRTING, meshes.box_between((-3, 2.988, 0), (3, 3.0, 0.08)))
    assembly.add(POSTER, meshes.box_between((-1.0, 2.994, 1.05), (-0.4, 3.0, 1.75)))
    assembly.add(CALENDAR, meshes.box_between((0.75, 2.994, 1.15), (1.15, 3.0, 1.65)))
    # The sitter's side of the desk faces the camera.
    furniture.desk(assembly.at(placed((0.05, 2.45), -np.pi / 2)))
    furniture.chair(assembly.at(placed((0.62, 1.75), np.deg2rad(140.0))), FABRIC)
    rng = np.random.default_rng([options.seed, 3])
    furniture.plant(assembly.at(placed((-0.98, 2.25), 0.0)), rng)
    camera = paths.look_at((-RAIL_LENGTH / 2, 0, 1.15), (-RAIL_LENGTH / 2, 2.4, 0.80))
    path = paths.out_and_back(camera, RAIL_LENGTH, options.seconds)
    return ScenePlan(assembly.materials, assembly.mesh(), path, ambient=0.3)
