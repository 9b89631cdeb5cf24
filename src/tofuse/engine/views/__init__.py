"""Views prepared for alignment: a plane, its uncertainty and an albedo at each pixel.

`prepare_view` makes a `PreparedView` of a range image with `SurfaceOptions`; `with_extended_planes`
and `with_rough_planes` add planes for fusion and for searches. A `Projection` is the camera at the
resolution of the view. `residual_kernels` compare two views, `view_descriptors` recognise places.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.views import residual_kernels, view_descriptors
    from tofuse.engine.views.extended_planes import with_extended_planes, with_rough_planes
    from tofuse.engine.views.prepared_view import RAW_RANGE_FALLOFF, PreparedView, prepare_view
    from tofuse.engine.views.projection import Projection, interpolated, projection_of
    from tofuse.engine.views.view_planes import SurfaceOptions, dilated

__getattr__, __dir__, __all__ = face(__name__, __file__)
