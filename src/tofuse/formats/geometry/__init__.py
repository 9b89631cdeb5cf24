"""Files of clouds and meshes: PLY and PCD in both directions, the other formats as output.

Meshes of other programs are read as points of their surface (`surface_points`).

All functions take or return a `GeometryRecord`, check its shapes, and replace a file as a whole.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.formats.geometry.e57 import write_e57
    from tofuse.formats.geometry.glb import read_textured_glb, write_glb, write_gltf
    from tofuse.formats.geometry.las import write_las
    from tofuse.formats.geometry.obj import write_obj
    from tofuse.formats.geometry.pcd import read_pcd, unpacked_color, write_pcd
    from tofuse.formats.geometry.ply import read_ply, write_ply
    from tofuse.formats.geometry.surfaces import is_surface, read_surface, surface_points
    from tofuse.formats.geometry.usdz import write_usdz

__getattr__, __dir__, __all__ = face(__name__, __file__)
