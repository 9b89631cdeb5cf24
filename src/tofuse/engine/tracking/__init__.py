"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.tracking import given, motion_prediction, moving_objects
    from tofuse.engine.tracking.base import Odometry, Status, Step, Tracker
    from tofuse.engine.tracking.keyframes import Keyframes
    from tofuse.engine.tracking.motion import HANDHELD, FrameTime, find_jumps
    from tofuse.engine.tracking.pairwise import Pairwise, Sequential

__getattr__, __dir__, __all__ = face(__name__, __file__)
