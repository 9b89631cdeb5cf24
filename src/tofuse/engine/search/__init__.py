"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.search.pair_agreement import (
        MIN_LEAD,
        Agreement,
        AgreementOptions,
        Comparison,
        agreement,
        nearest_depth,
    )
    from tofuse.engine.search.plane_detection import Plane, detect_planes
    from tofuse.engine.search.pose_probability import (
        ACCEPTED,
        CERTAIN,
        CLOUDS,
        CONTRADICTION,
        PoseEvidence,
        logistic,
    )
    from tofuse.engine.search.search import (
        DISTINCT_M,
        DISTINCT_RAD,
        Search,
        SearchOptions,
        are_distinct_poses,
    )
    from tofuse.engine.search.search_kernels import ViewPoints
    from tofuse.engine.search.verification import (
        MAX_OVERLAP_DISTANCE,
        PATIENT,
        FitKind,
        FitQuality,
        FitStatistics,
        comparable,
        fine_tolerances,
        usual_tolerances,
    )
    from tofuse.engine.search.view_pair import follow, register_pair
    from tofuse.engine.search.view_points import landing_pixels, sampled_points

__getattr__, __dir__, __all__ = face(__name__, __file__)
