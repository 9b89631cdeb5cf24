"""The Iterative Closest Point algorithm, composed of exchangeable parts.

`Icp` matches, rejects and moves until it stops; `algorithm_1` is that of the thesis and
`CoarseToFine` a robust default for clouds. `interfaces` says what a part is, `icp_parts` and
`surface_metrics` hold the common ones, and `surface_shape` gives normals and edges.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.icp import icp_kernels, icp_parts, interfaces, surface_metrics, surface_shape
    from tofuse.engine.icp.coarse_to_fine import CoarseToFine, averaged, extent, reduced, spacing
    from tofuse.engine.icp.icp import Icp, Remapping, algorithm_1

__getattr__, __dir__, __all__ = face(__name__, __file__)
