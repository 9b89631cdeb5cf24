"""What odometry gives for each frame, whatever the method."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol

from tofuse.arrays import Bool, Float64
from tofuse.odometry.motion import Moment
from tofuse.recordings.frames import Frame
from tofuse.registration.base import Link, Registration
from tofuse.registration.prepared_view import PreparedView

Status = Literal["tracked", "predicted", "lost", "skipped"]


@dataclass(frozen=True, eq=False)
class Step:
    """What became of one frame.

    Attributes
    ----------
    status
        "tracked"; "predicted" where no direction was observable; "lost" without a pose.
    reason
        Why it is not tracked, or what was out of the ordinary in tracking it; may be empty.
    T_component_camera
        (4, 4) pose in the frame of its component; None where lost.
    reference
        Index (`Frame.index`) of the frame it was registered to; None for the first of a component.
    registration
        T_reference_frame and how well it is known; None for the first of a component.
    surface
        The view as it was prepared for tracking; None where the method makes none, and for
        frames without a pose.
    component
        Number of the component: what is tracked without a break. A frame that can't be connected
        begins a new one, in a frame of its own.
    links
        Registrations of this frame to frames of other components, that may join them.
    doubtful
        Whether it fits worse than views of this camera usually do.
    moving
        (H, W) mask of the frame's pixels that moved by themselves; None where none did.
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
    moving: Bool | None = None


class Tracker(Protocol):
    """Odometry at work: keeps what it needs of the frames so far."""

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: PreparedView | None = None
    ) -> Step:
        """Find the pose of the next (filtered) frame.

        Parameters
        ----------
        T_odometry
            The frame's T_world_camera from an odometry file, if there is one.
        surface
            What `prepare` made of the frame, if it was asked to.
        """
        ...

    def prepare(self, frame: Frame) -> PreparedView | None:
        """Make a frame ready before its turn, if there is something to be made of it alone.

        Other threads may ask for it while frames before it are tracked.
        """
        return None

    def expected(self, now: Moment) -> Float64 | None:
        """Pose (4, 4) in the frame of the present component that the motion leads to, if known."""
        return None

    def interrupt(self) -> None:
        """Hear that the next frame begins another recording: the motion need not go on."""
        return


class Odometry(Protocol):
    """A method that turns frames into poses, one at a time."""

    part_kind: ClassVar[str] = "odometry"

    @property
    def takes(self) -> frozenset[str]:
        """Kinds of view it works on: "range", "cloud"."""
        ...

    def start(self, seed: int) -> Tracker:
        """Begin a new recording."""
        ...
