"""The interface of odometry: methods, their trackers, and the result of each frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol

from tofuse.engine.alignment import Link, Registration
from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.frames import Frame
from tofuse.engine.search import SearchOptions
from tofuse.engine.tracking.motion import FrameTime
from tofuse.engine.views import PreparedView

Status = Literal["tracked", "predicted", "lost", "skipped"]
# Where the alignment of a frame starts: at the last pose, at constant velocity, or where the
# motion of an odometry file leads.
Guess = Literal["identity", "previous", "odometry"]


@dataclass(frozen=True, eq=False)
class Step:
    """The result of tracking one frame.

    Attributes
    ----------
    status
        "tracked"; "predicted" where all directions are degenerate; "lost" without a pose.
    reason
        Why it is not tracked, or anything unusual in tracking it; may be empty.
    T_component_camera
        (4, 4) pose in the frame of its component; None where lost.
    reference
        Index (`Frame.index`) of the frame it was registered to; None for the first of a component.
    registration
        T_reference_frame and its information; None for the first of a component.
    surface
        The view as prepared for tracking; None where the method needs none, and for frames
        without a pose.
    component
        Number of the component: the frames tracked without a break. A frame that can't be
        connected begins a new one, in a coordinate frame of its own.
    links
        Registrations of this frame to frames of other components, which may join them.
    doubtful
        Whether it fits worse than usual for views of this camera.
    inflation
        Factor by which the standard deviations of the registration were enlarged for that reason.
    moving
        (H, W) mask of the frame's pixels on moving objects; None without any.
    moved
        Fraction of the image on objects that certainly moved, see `outlines`; the rest of `moving`
        may be due to errors of the depth.
    rival
        Share of the last views that follows a rival of the tracked motion, see `RivalMotions`.
    """

    status: Status
    reason: str
    T_component_camera: Float64 | None
    reference: int | None = None
    registration: Registration | None = None
    surface: PreparedView | None = None
    component: int = 0
    links: tuple[Link, ...] = ()
    doubtful: bool = False
    inflation: float = 1.0
    moving: Bool | None = None
    moved: float = 0.0
    rival: float = 0.0

    @property
    def moving_fraction(self) -> float:
        """Fraction of the image on moving objects."""
        return 0.0 if self.moving is None else float(self.moving.mean())


class Tracker(Protocol):
    """The state of an odometry method on one recording."""

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: PreparedView | None = None
    ) -> Step:
        """Estimate the pose of the next frame.

        Parameters
        ----------
        frame
            The filtered frame.
        T_odometry
            Its (4, 4) T_world_camera by external odometry, if known.
        surface
            The result of `prepare` for the frame, if it was called.
        """
        ...

    def prepare(self, frame: Frame) -> PreparedView | None:
        """Prepare a frame in advance, as far as that depends on it alone; None if it doesn't.

        May be called by other threads while earlier frames are tracked.
        """
        return None

    def predicted_pose(self, now: FrameTime) -> Float64 | None:
        """Return the predicted pose (4, 4) in the present component's frame, if known."""
        return None

    def interrupt(self) -> None:
        """Expect the first frame of another recording: the motion is not continuous."""
        return


class Odometry(Protocol):
    """A method that turns frames into poses, one at a time."""

    part_kind: ClassVar[str] = "odometry"

    @property
    def takes(self) -> frozenset[str]:
        """Kinds of view it works on: "range", "cloud"; by default both."""
        return frozenset({"range", "cloud"})

    def start(self, seed: int, search: SearchOptions | None = None) -> Tracker:
        """Return a tracker for a new recording.

        Parameters
        ----------
        seed
            Of its random choices.
        search
            Range and effort of exhaustive searches for the pose; the default ones unless given.
        """
        ...
