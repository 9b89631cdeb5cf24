"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.views import residual_kernels, view_descriptors
    from tofuse.engine.views.extended_planes import with_extended_planes, with_rough_planes
    from tofuse.engine.views.prepared_view import RAW_RANGE_FALLOFF, PreparedView, prepare_view
    from tofuse.engine.views.projection import Projection
    from tofuse.engine.views.view_planes import SurfaceOptions, dilated

__getattr__, __dir__, __all__ = face(__name__, __file__)
