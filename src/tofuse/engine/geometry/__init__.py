"""Rigid motions and points in space.

`se3` and `quaternion` work on arrays of poses; `compose`, `retract`, `twist_between` and
`distance_and_angle` do so for one pose inside kernels. `KdTree` finds nearest neighbours, and
`PlaceCounts` tells how often a camera has been at a place. `triangles` has their areas and
points; `homogeneous` and `unit_rays` are points and unit vectors along rays, `unit_vectors` those
along any vectors, `tangents` those across them, `sphere_directions` some in all directions.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.geometry import quaternion, se3, triangles
    from tofuse.engine.geometry.kdtree import KdTree, checked_points
    from tofuse.engine.geometry.places import PlaceCounts
    from tofuse.engine.geometry.rays import (
        homogeneous,
        sphere_directions,
        tangents,
        unit_rays,
        unit_vectors,
    )
    from tofuse.engine.geometry.rigid_motion_kernels import (
        compose,
        distance_and_angle,
        retract,
        twist_between,
    )

__getattr__, __dir__, __all__ = face(__name__, __file__)
