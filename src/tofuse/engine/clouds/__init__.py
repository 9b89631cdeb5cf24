"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.clouds import cloud_sum_kernels, fpfh, point_pairs, robust_motion, surface_metrics, surface_shape
    from tofuse.engine.clouds.any_pair import AnyPair
    from tofuse.engine.clouds.cloud_shape_kernels import symmetric_eigen
    from tofuse.engine.clouds.coarse_to_fine import CoarseToFine
    from tofuse.engine.clouds.icp import Icp, algorithm_1
    from tofuse.engine.clouds.icp_kernels import transform_points
    from tofuse.engine.clouds.interfaces import Alignment, Matcher, Matches, Metric, Points, Rejector, Search, Selector
    from tofuse.engine.clouds.metrics import PointToPoint
    from tofuse.engine.clouds.pair import register
    from tofuse.engine.clouds.reduce import extent
    from tofuse.engine.clouds.rejectors import MaxDistance, Unique
    from tofuse.engine.clouds.selectors import All, Random, at_most
    from tofuse.engine.clouds.stopping import SmallStep

__getattr__, __dir__, __all__ = face(__name__, __file__)
