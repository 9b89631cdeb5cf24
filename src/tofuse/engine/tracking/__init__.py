"""Odometry: the pose of each frame as it arrives.

An `Odometry` method starts a `Tracker`, which returns a `Step` for each frame. `Keyframes` is the
default; `Pairwise` is for wide baselines and clouds, `Sequential` that of the thesis, and `given`
adopts known poses. `motion_prediction` says how far a prediction can be trusted, and
`moving_objects` keeps what moves out of the alignment.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.tracking import given, motion_prediction, moving_objects, rival_motions
    from tofuse.engine.tracking.base import Odometry, Status, Step, Tracker
    from tofuse.engine.tracking.keyframes import Keyframes
    from tofuse.engine.tracking.motion import HANDHELD, FrameTime, find_jumps, reach_m
    from tofuse.engine.tracking.pairwise import Pairwise, Sequential

__getattr__, __dir__, __all__ = face(__name__, __file__)
