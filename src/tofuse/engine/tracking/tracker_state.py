"""The state of the keyframe tracker between two frames."""

from __future__ import annotations

from dataclasses import dataclass, field

from tofuse.engine.search import verification
from tofuse.engine.tracking.keyframe_map import Keyframe, KeyframeMap, Relocalizer
from tofuse.engine.tracking.motion import MotionModel
from tofuse.engine.tracking.moving_objects import MovingObjects


@dataclass(eq=False)
class TrackerState:
    """What the tracker knows of the frames so far.

    `Hypotheses` and `Selection` read it for one frame; `KeyframeTracker` updates it.

    Attributes
    ----------
    keyframes
        Those of all components.
    relocalizer
        Searches for poses, and their budget.
    fit_statistics
        Usual fit of views of this camera.
    motion
        Velocity of the camera.
    objects
        Moving objects in the last view and in the keyframes.
    last
        The last frame of the component; None after an interruption.
    in_sequence
        Whether the frame just before has a pose in the component.
    component
        Number of the component; -1 before the first.
    connected
        Whether a certain link joins the component to an earlier one.
    degenerate
        Number of degenerate directions of the last selected alignment.
    """

    keyframes: KeyframeMap
    relocalizer: Relocalizer
    fit_statistics: verification.FitStatistics
    motion: MotionModel = field(default_factory=MotionModel)
    objects: MovingObjects = field(default_factory=MovingObjects)
    last: Keyframe | None = None
    in_sequence: bool = False
    component: int = -1
    connected: bool = True
    degenerate: int = 0
