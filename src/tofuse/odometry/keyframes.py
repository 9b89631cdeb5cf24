"""Odometry against keyframes: projective, photometric, and aware of what it can't see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from tofuse.odometry.base import Odometry, Tracker
from tofuse.parts import part
from tofuse.registration.prepared_view import SurfaceOptions
from tofuse.registration.projective import ProjectiveOptions
from tofuse.registration.search import SearchOptions
from tofuse.registration.uncertainty import UncertaintyOptions

Guess = Literal["identity", "previous", "odometry"]


@part("odometry", "keyframes")
@dataclass(frozen=True)
class Keyframes(Odometry):
    """Aligns each frame with the newest keyframe, coarse to fine.

    A frame that leaves the keyframe becomes the next one. Degenerate directions follow the motion
    model, and are reported. An alignment is compared with how views of this camera usually fit
    (`registration.verification`): what fits worse has to beat its rivals, and gets a wide
    covariance. A frame that can't be connected begins a new component, which is tracked as well as
    the first, in a frame of its own.

    Attributes
    ----------
    surface
        How views are prepared.
    alignment
        How they are aligned.
    uncertainty
        How the covariance of an alignment is estimated.
    unusual
        A statistic of an alignment is unusual so many standard deviations above its median.
    search
        How far and how finely a lost frame is searched for.
    searches
        Whether lost frames are searched for while frames arrive.
    guess
        Where an alignment starts: "previous" (the last motion goes on), "identity" (the camera
        stands still), "odometry" (the motion between the poses of an odometry file).
    keyframe_angle, keyframe_distance
        Motion after which a frame becomes a keyframe: rad, and as a fraction of the median depth.
    minimum_points
        Valid points that a frame must have.
    """

    surface: SurfaceOptions = SurfaceOptions()  # noqa: RUF009 - immutable
    alignment: ProjectiveOptions = ProjectiveOptions()  # noqa: RUF009 - immutable
    uncertainty: UncertaintyOptions = UncertaintyOptions()  # noqa: RUF009 - immutable
    unusual: float = 3.0
    search: SearchOptions = SearchOptions(mode="both")  # noqa: RUF009 - immutable
    searches: bool = True
    guess: Guess = "previous"
    keyframe_angle: float = 0.2
    keyframe_distance: float = 0.1
    minimum_points: int = 300

    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    def __post_init__(self) -> None:
        if not 0.5 <= self.unusual <= 100:
            raise ValueError(f"unusual is {self.unusual}, not 0.5 to 100")
        if self.minimum_points < 1:
            raise ValueError(f"minimum_points is {self.minimum_points}, not 1 or more")
        if not (self.keyframe_angle > 0 and self.keyframe_distance > 0):
            raise ValueError("keyframe_angle and keyframe_distance must be above 0")

    def start(self, seed: int) -> Tracker:
        """See `Odometry.start`. There is nothing random in it."""
        from tofuse.odometry.keyframe_tracker import KeyframeTracker

        return KeyframeTracker(self)
