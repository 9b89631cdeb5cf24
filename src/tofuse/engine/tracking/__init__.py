"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.tracking.base import Odometry, Status, Step, Tracker
    from tofuse.engine.tracking.given import GivenPoses, StatedPose, StatedPoses
    from tofuse.engine.tracking.keyframes import Keyframes
    from tofuse.engine.tracking.motion import HANDHELD, FrameTime, find_jumps
    from tofuse.engine.tracking.moving_objects import at_size, without_pixels
    from tofuse.engine.tracking.pairwise import Pairwise
    from tofuse.engine.tracking.prediction import Prediction, degenerate_runs, with_prediction
    from tofuse.engine.tracking.sequential import Sequential

__getattr__, __dir__, __all__ = face(__name__, __file__)
