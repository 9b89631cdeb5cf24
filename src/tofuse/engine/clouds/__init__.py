"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.clouds.any_pair import AnyPair
    from tofuse.engine.clouds.cloud_shape_kernels import symmetric_eigen
    from tofuse.engine.clouds.cloud_sum_kernels import matrix_sums, plane_sums
    from tofuse.engine.clouds.coarse_to_fine import CoarseToFine
    from tofuse.engine.clouds.fpfh import FPFH_NEIGHBOURS, POINTS, REACH, candidates
    from tofuse.engine.clouds.icp import Icp, algorithm_1
    from tofuse.engine.clouds.icp_kernels import transform_points
    from tofuse.engine.clouds.interfaces import (
        Alignment,
        Matcher,
        Matches,
        Metric,
        Points,
        Rejector,
        Search,
        Selector,
    )
    from tofuse.engine.clouds.metrics import PointToPoint
    from tofuse.engine.clouds.pair import register
    from tofuse.engine.clouds.pairs import (
        Loss,
        SurfacePairs,
        in_scales,
        loss_weights,
        solve,
        surface_pairs,
        variance_of,
    )
    from tofuse.engine.clouds.reduce import extent
    from tofuse.engine.clouds.rejectors import MaxDistance, Unique
    from tofuse.engine.clouds.robust_motion import (
        MIN_PAIRS,
        Consensus,
        ConsensusOptions,
        Motions,
        Pairs,
        consensus,
        motions_of,
        squared_residuals,
    )
    from tofuse.engine.clouds.selectors import All, Random, at_most
    from tofuse.engine.clouds.shape import NEIGHBOURS, normals_at, shape_at
    from tofuse.engine.clouds.stopping import SmallStep
    from tofuse.engine.clouds.surface_metrics import (
        PlaneToPlane,
        PointToPlane,
        SurfaceMetric,
        TangentPlanes,
    )

__getattr__, __dir__, __all__ = face(__name__, __file__)
