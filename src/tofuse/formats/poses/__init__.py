"""Files of trajectories, pose graphs, single poses and loops.

`read_poses` detects the format of a trajectory; `read_tum` and the writers are for one format each.
Poses are T_world_camera, (N, 4, 4), with NaN where unknown; `associated_poses` are those at times.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.formats.poses.g2o import read_g2o, write_g2o
    from tofuse.formats.poses.pose import pose_text, read_loops, read_pose
    from tofuse.formats.poses.trajectory import (
        associated_poses,
        interpolated_poses,
        read_tum,
        write_kitti,
        write_log,
        write_tum,
    )
    from tofuse.formats.poses.trajectory_formats import OPENGL, Clock, TimedPoses, read_poses

__getattr__, __dir__, __all__ = face(__name__, __file__)
