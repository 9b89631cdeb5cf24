"""What odometry gives for each frame, whatever the method."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from tofuse.maps.surface_map import SurfaceMap
from tofuse.recordings.frames import Frame
from tofuse.registration.base import Registration

Float64 = NDArray[np.float64]

Status = Literal["tracked", "predicted", "lost", "skipped"]


@dataclass(frozen=True, eq=False)
class Step:
    """What became of one frame.

    Attributes
    ----------
    status
        "tracked"; "predicted" where the data held none of it; "lost" without a pose.
    reason
        Why it is not tracked, or what was out of the ordinary in tracking it; may be empty.
    T_world_camera
        (4, 4), or None where lost.
    reference
        Index (`Frame.index`) of the frame it was registered to; None for the first.
    registration
        T_reference_frame and how well it is known; None for the first frame.
    surface
        The view as it was made ready for tracking; None where the method makes none, and for
        frames without a pose.
    earlier
        Steps of frames that were lost when they came, by `Frame.index` and in its order, and that
        are found from this frame.
    """

    status: Status
    reason: str
    T_world_camera: Float64 | None
    reference: int | None = None
    registration: Registration | None = None
    surface: SurfaceMap | None = None
    earlier: tuple[tuple[int, Step], ...] = ()


class Tracker(Protocol):
    """Odometry at work: holds what it needs of the frames so far."""

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: SurfaceMap | None = None
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

    def prepare(self, frame: Frame) -> SurfaceMap | None:
        """Make a frame ready before its turn, if there is something to be made of it alone.

        Other threads may ask for it while frames before it are tracked.
        """
        return None

    @property
    def waiting(self) -> Collection[int]:
        """Indices of the lost frames that may yet be found; what others are needed for no more."""
        return ()

    def finish(self) -> tuple[tuple[int, Step], ...]:
        """Hear that no frame follows; returns steps as `Step.earlier` has them."""
        return ()

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
