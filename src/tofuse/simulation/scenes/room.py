"""The room of 6.0 x 3.2 m, with seven office chairs or empty."""

from __future__ import annotations

from tofuse.simulation import paths
from tofuse.simulation.scene import Plan, SceneOptions
from tofuse.simulation.scenes.assembly import Assembly, shell
from tofuse.simulation.texture import Material

LENGTH, WIDTH, HEIGHT = 6.0, 3.2, 2.5
CAMERA_HEIGHT = 0.8

WALLPAPER = Material("long wall", 0.68, 0.18, "noise", (0.45, 0.45, 0.45))
PLASTER = Material("short wall", 0.74, 0.08, "noise", (0.6, 0.6, 0.6))
CARPET = Material("floor", 0.38, 0.18, "speckle", (0.09, 0.09, 0.09))
CEILING = Material("ceiling", 0.78, 0.05, "tiles", (0.6, 0.6, 0.6))


def plan(options: SceneOptions) -> Plan:
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
    camera = paths.look_at((0, 0, CAMERA_HEIGHT), (1, 0.2, CAMERA_HEIGHT))
    path = paths.camera_turn(camera, options.seconds, options.axis_offset_m)
    return Plan(assembly.materials, assembly.mesh(), path, ambient=0.4)
