"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.search import pair_agreement, pose_probability, verification
    from tofuse.engine.search.plane_detection import Plane, detect_planes
    from tofuse.engine.search.search import (
        DISTINCT_M,
        DISTINCT_RAD,
        Search,
        SearchOptions,
        are_distinct_poses,
    )
    from tofuse.engine.search.search_kernels import ViewPoints
    from tofuse.engine.search.view_pair import follow, register_pair

__getattr__, __dir__, __all__ = face(__name__, __file__)
