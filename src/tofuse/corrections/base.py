"""The interface of a correction: what changes a view before it is filtered."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Protocol

from tofuse.arrays import Float64
from tofuse.recordings.frames import Frame


class Corrector(Protocol):
    """A correction at work on one recording."""

    def apply(self, frame: Frame, T_world_camera: Float64 | None = None) -> Frame:
        """Return the corrected view; the same one where there is nothing to correct it by.

        Points stay where they are in the image: what is valid stays valid, and nothing else
        becomes so.

        Parameters
        ----------
        T_world_camera
            (4, 4) where the camera is expected; None where that is not known.
        """
        ...

    def is_independent(self, frame: Frame) -> bool:
        """Whether `apply` asks for nothing but this frame: then it may come out of turn.

        Neither frames before it nor where the camera is then play a part, and nothing is kept.
        """
        return False

    def add_pose(self, frame: Frame, T_world_camera: Float64) -> None:
        """Hear where the view that was corrected last has been found to be.

        Parameters
        ----------
        frame
            What the filters left of it: what stands still in the world.
        T_world_camera
            (4, 4), in the same frame as what `apply` is given.
        """
        return

    def reset_poses(self) -> None:
        """Hear that poses are in another frame from here on: where surfaces were is not known."""
        return


class Correction(Protocol):
    """One way of making measurements better.

    Attributes
    ----------
    takes
        Kinds of view it works on, or passes through: "range", "cloud".
    needs_fit
        Whether it can learn from frames of the whole recording first.
    needs_trial
        Whether it may bend what is straight where the error that it takes off is not there, so
        that it stays only where views show this error.
    disabled
        Whether a trial has found that it is better left out.
    """

    part_kind: ClassVar[str] = "correction"
    takes: ClassVar[frozenset[str]]

    @property
    def needs_fit(self) -> bool:
        """Whether it can learn from frames of the whole recording, with `fit`, beforehand."""
        return False

    @property
    def needs_trial(self) -> bool:
        """Whether a trial on the recording (`pipeline.trial`) is to decide if it stays."""
        return False

    @property
    def disabled(self) -> bool:
        """Whether it changes nothing, as views did not show in a trial what it corrects."""
        return False

    def after_trial(
        self, helps: bool, strength: float = float("nan"), error: float = float("inf")
    ) -> Correction:
        """Return the correction as it is after a trial.

        Parameters
        ----------
        helps
            Whether it is to be applied.
        strength, error
            Share of the predicted error that views show, and its standard error; NaN or inf where
            too little could be compared.
        """
        return self

    def fit(self, frames: Sequence[Frame]) -> Correction:
        """Return the correction with what it has learnt from frames spread over a recording.

        Parameters
        ----------
        frames
            As they reach this correction: corrected by those before it.
        """
        return self

    def start(self) -> Corrector:
        """Begin a recording, about which the correction may learn from its frames, in order."""
        ...
