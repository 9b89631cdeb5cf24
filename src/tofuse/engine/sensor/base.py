"""The interface of corrections, which change measurements before they are filtered.

And the simplest one: `Noise` changes no measurement, but states its standard deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, Self

from tofuse.engine.arrays import Float64
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.noise import NoiseModel
from tofuse.engine.parts import part


class Corrector(Protocol):
    """A correction in use on one recording."""

    def apply(self, frame: Frame, T_world_camera: Float64 | None = None) -> Frame:
        """Return the corrected view, or the view itself if it can't be corrected.

        The mask of valid pixels is unchanged.

        Parameters
        ----------
        frame
            The view.
        T_world_camera
            (4, 4) predicted pose; None if unknown.
        """
        ...

    def is_independent(self, frame: Frame) -> bool:
        """Whether `apply` depends on this frame only, neither on earlier ones nor on the pose.

        Such frames may be corrected in any order.
        """
        return False

    def add_pose(self, frame: Frame, T_world_camera: Float64) -> None:
        """Receive the estimated pose of the view that was corrected last.

        Parameters
        ----------
        frame
            The filtered view: points of the static scene.
        T_world_camera
            (4, 4), in the same world frame as in `apply`.
        """
        return

    def reset_poses(self) -> None:
        """Forget positions of surfaces, as later poses are in another world frame."""
        return


class Correction(Protocol):
    """Compensation of one systematic error of measurements.

    Attributes
    ----------
    takes
        Kinds of view it accepts: "range", "cloud"; by default both. It may pass some of them
        through unchanged.
    needs_fit
        Whether parameters are to be estimated from frames of the recording first.
    needs_trial
        Whether it introduces errors where the error that it models is absent, so that it is used
        only if views show evidence of it.
    disabled
        Whether a trial found no such evidence.
    """

    part_kind: ClassVar[str] = "correction"
    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

    @property
    def needs_fit(self) -> bool:
        """Whether `fit` is to be called with frames of the recording first."""
        return False

    @property
    def needs_trial(self) -> bool:
        """Whether a trial on the recording (`mapping.trial`) decides if it is used."""
        return False

    @property
    def disabled(self) -> bool:
        """Whether it changes nothing, as a trial found no evidence of the error."""
        return False

    def after_trial(
        self,
        corrector: Corrector,
        improves: bool,
        strength: float = float("nan"),
        error: float = float("inf"),
    ) -> Correction:
        """Return the correction with the outcome of a trial.

        Parameters
        ----------
        corrector
            Has corrected the views of the trial.
        improves
            Whether it is to be used.
        strength, error
            Fraction of the predicted error that is present, and its standard error; NaN and
            infinity if too little could be compared.
        """
        return self

    def fit(self, frames: Sequence[Frame]) -> Correction:
        """Return the correction with parameters estimated from frames sampled over a recording.

        Parameters
        ----------
        frames
            As they reach this correction: corrected by those before it.
        """
        return self

    def start(self) -> Corrector:
        """Return a corrector for one recording, to be applied to its frames in order."""
        ...


class FrameCorrection(Correction, Corrector, Protocol):
    """A correction of each frame by itself: it is its own corrector, without a state."""

    def start(self) -> Self:
        """See `Correction.start`."""
        return self

    def is_independent(self, frame: Frame) -> bool:
        """See `Corrector.is_independent`."""
        return True


@part("correction", "noise")
@dataclass(frozen=True)
class Noise(FrameCorrection):
    """Assign the standard deviation of the range to each pixel, for all later weighting.

    Depths are not changed. Frames with a sigma stated by the camera keep it; clouds are passed
    through.

    Attributes
    ----------
    model
        Noise of the camera. None: that of the recording's `noise.json`, else that of the camera's
        family; without either, frames are passed through.
    """

    model: NoiseModel | None = None

    def apply(self, frame: Frame, T_world_camera: Float64 | None = None) -> Frame:
        """See `Corrector.apply`."""
        if self.model is None or not isinstance(frame, RangeFrame):
            return frame
        if frame.sigma_image is not None:
            return frame
        return replace(frame, sigma_image=self.model.sigma(frame))
