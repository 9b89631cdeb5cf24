"""The world before the camera: surfaces with materials, scenes of them, and paths through them."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.lab.world import mesh, paths, scene
    from tofuse.lab.world.mesh import Mesh
    from tofuse.lab.world.paths import Path, look_at, rotation
    from tofuse.lab.world.scene import SCENES, Body, Scene, SceneOptions, ScenePlan, Sequence
    from tofuse.lab.world.texture import Material

__getattr__, __dir__, __all__ = face(__name__, __file__)
