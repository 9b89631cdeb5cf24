"""Progress of long jobs: stages, steps and notes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.frames import Frame
from tofuse.engine.graph import PoseGraph
from tofuse.engine.results import FrameRecord
from tofuse.engine.stored_views import PosedView
from tofuse.engine.views import PreparedView


@dataclass(frozen=True, eq=False)
class OnlineMap:
    """What is known between two frames: of the component of the latest one.

    Attributes
    ----------
    graph
        With the loops closed so far, and optimised.
    timestamps
        (N,) s, of its vertices.
    views
        Prepared views of some of them.
    degenerate
        Indices of the frames whose registration left some direction open.
    """

    graph: PoseGraph
    timestamps: Float64
    views: Sequence[PosedView[PreparedView]]
    degenerate: frozenset[int] = frozenset()


def receiver(progress: Progress | bool | None) -> Progress:
    """Return what receives the progress; InputError for an object that can't."""
    if not progress:
        return Silent()
    if progress is True or not hasattr(progress, "began"):
        raise InputError(
            f"is {progress!r}",
            where="progress",
            remedy="pass an object that receives it; `reconstruct` shows True on the terminal",
        )
    return progress


class Progress(Protocol):
    """Receives the progress of a long job; what a receiver does not override, it ignores."""

    def stage(self, name: str, total: int | None = None) -> None:
        """Begin a stage of `total` steps (None: unknown)."""
        return

    def advance(self, record: FrameRecord | None = None) -> None:
        """Finish one step of the stage; with the record of the frame, if the step is a frame."""
        return

    def note(self, text: str) -> None:
        """Show a message to the user."""
        return

    def placed(self, frame: Frame, T_world_camera: Float64) -> None:
        """Show a frame of the model at its current pose (4, 4)."""
        return

    def began(self, so_far: Callable[[], OnlineMap]) -> None:
        """Begin a map; `so_far` tells what is known when a frame has been placed."""
        return


class Silent(Progress):
    """Ignores all progress."""


@dataclass(frozen=True)
class CombinedProgress:
    """Forwards progress to two receivers."""

    first: Progress
    second: Progress

    def stage(self, name: str, total: int | None = None) -> None:
        """See `Progress`."""
        self.first.stage(name, total)
        self.second.stage(name, total)

    def advance(self, record: FrameRecord | None = None) -> None:
        """See `Progress`."""
        self.first.advance(record)
        self.second.advance(record)

    def note(self, text: str) -> None:
        """See `Progress`."""
        self.first.note(text)
        self.second.note(text)

    def placed(self, frame: Frame, T_world_camera: Float64) -> None:
        """See `Progress`."""
        self.first.placed(frame, T_world_camera)
        self.second.placed(frame, T_world_camera)

    def began(self, so_far: Callable[[], OnlineMap]) -> None:
        """See `Progress`."""
        self.first.began(so_far)
        self.second.began(so_far)
