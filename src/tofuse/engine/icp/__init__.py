"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.icp import icp_kernels, icp_parts, interfaces, surface_metrics, surface_shape
    from tofuse.engine.icp.coarse_to_fine import CoarseToFine, extent, reduced, spacing
    from tofuse.engine.icp.icp import Icp, Remapping, algorithm_1

__getattr__, __dir__, __all__ = face(__name__, __file__)
