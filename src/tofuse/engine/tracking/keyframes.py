"""Keyframe odometry: projective, photometric, and aware of degenerate directions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from tofuse.engine.alignment import ViewOptions
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.parts import part
from tofuse.engine.search import SearchOptions
from tofuse.engine.tracking.base import Odometry, Tracker

Guess = Literal["identity", "previous", "odometry"]


@part("odometry", "keyframes")
@dataclass(frozen=True)
class Keyframes(Bounded, Odometry):
    """Aligns each frame with the newest keyframe, coarse to fine.

    A frame far from the keyframe becomes the next one. Degenerate directions follow the motion
    model, and are reported. An alignment is compared with how views of this camera usually fit
    (`registration.verification`): one that fits worse must beat its rivals, and gets a wide
    covariance. A frame that can't be connected begins a new component, in a coordinate frame of
    its own.

    Attributes
    ----------
    views
        How images are prepared and aligned.
    searches
        Whether lost frames are relocalized by exhaustive search while frames arrive; without, the
        time of each frame is bounded.
    guess
        Where an alignment starts: "previous" (constant velocity), "identity" (the last pose),
        "odometry" (the motion between the poses of an odometry file).
    keyframe_angle, keyframe_distance
        Motion after which a frame becomes a keyframe: rad, and as a fraction of the median depth.
    minimum_points
        Valid points that a frame must have.
    """

    views: ViewOptions = ViewOptions()  # noqa: RUF009 - immutable
    searches: bool = True
    guess: Guess = "previous"
    keyframe_angle: Annotated[float, Bounds(0, exclusive=True)] = 0.2
    keyframe_distance: Annotated[float, Bounds(0, exclusive=True)] = 0.1
    minimum_points: Annotated[int, Bounds(1)] = 100

    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    def start(self, seed: int, search: SearchOptions | None = None) -> Tracker:
        """See `Odometry.start`. There is nothing random in it."""
        from tofuse.engine.tracking.keyframe_tracker import KeyframeTracker

        return KeyframeTracker(self, search or SearchOptions())
