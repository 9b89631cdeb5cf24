"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.icp import (
        icp_kernels,
        icp_parts,
        interfaces,
        point_pairs,
        surface_metrics,
        surface_shape,
    )
    from tofuse.engine.icp.coarse_to_fine import CoarseToFine, spacing
    from tofuse.engine.icp.icp import Icp, Remapping, algorithm_1
    from tofuse.engine.icp.reduce import extent, reduced

__getattr__, __dir__, __all__ = face(__name__, __file__)
