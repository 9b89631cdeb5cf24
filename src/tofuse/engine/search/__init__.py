"""The relative pose of two images without a guess, and the probability that it is right.

`register_pair` searches and verifies; `follow` verifies a guess only. `pair_agreement` compares two
images at a pose, `pose_probability` turns that into a decision, and `verification` compares an
alignment with those that are usual for the camera. `detect_planes` finds the planes of a room.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.search import pair_agreement, pose_probability, verification
    from tofuse.engine.search.plane_detection import Plane, detect_planes
    from tofuse.engine.search.search import DISTINCT_M, DISTINCT_RAD, Search, are_distinct_poses
    from tofuse.engine.search.search_grid import SearchOptions
    from tofuse.engine.search.search_kernels import ViewPoints
    from tofuse.engine.search.view_pair import follow, register_pair

__getattr__, __dir__, __all__ = face(__name__, __file__)
