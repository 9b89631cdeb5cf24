"""Fusion of posed views into a model: a surface from signed distances, or a cloud of averages.

A `ModelBuilder` stores views until their final poses are known and fuses them, by the options
`Fusion`, into a `Model` of a `Cloud` and a `Mesh`, both with standard deviations. Files are
written from a `GeometryRecord`. `texture` paints a mesh; `T_up_world` turns it upright.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.fusion import display_surface, drawing, texture
    from tofuse.engine.fusion.cloud import Cloud, as_cloud
    from tofuse.engine.fusion.geometry_record import GeometryRecord
    from tofuse.engine.fusion.mesh import Mesh
    from tofuse.engine.fusion.model import Model, ModelBuilder
    from tofuse.engine.fusion.options import Fusion
    from tofuse.engine.fusion.pose_errors import UNKNOWN_M, with_pose_errors
    from tofuse.engine.fusion.range_view import albedo
    from tofuse.engine.fusion.texture import Textured
    from tofuse.engine.fusion.upright import T_up_world

__getattr__, __dir__, __all__ = face(__name__, __file__)
