"""Compensation of multipath: light that reaches a pixel after reflections at other surfaces."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.frames import SATURATED_AMPLITUDE, Frame, RangeFrame
from tofuse.engine.parts import part
from tofuse.engine.sensor.base import Correction, Corrector
from tofuse.engine.sensor.multipath import (
    Bounces,
    GainEstimator,
    MultipathEstimate,
    MultipathModel,
    ToFImage,
)
from tofuse.engine.sensor.multipath_surfaces import ReflectorMap
from tofuse.engine.sensor.raw_amplitude import modulation_period, tof_image


@part("correction", "multipath", label="validated")
@dataclass(frozen=True)
class Multipath(Bounded, Correction):
    """Compensate the light that surfaces reflect onto each other (Fuchs 2010).

    See `tofuse.engine.sensor.multipath`. Works on cameras with one modulation frequency that record
    amplitude; other views are passed through.

    Attributes
    ----------
    gain
        Raw amplitude, in counts, of a white wall (albedo 1) at 1 m on the optical axis; for
        range-compensated amplitude, of a white wall anywhere. None: estimated from the recording,
        by the views of the trial if there is one.
    period_m
        Ambiguity range; None: that of the frame.
    bounces
        "one": light reflected by one other surface; "all": by any number.
    lamp
        Illumination angle relative to that of the image's corner. Surfaces are extrapolated up to
        there.
    relative_sigma
        Standard deviation of the correction, as a fraction of it; its error is correlated between
        pixels.
    trial
        Whether it is applied only if overlapping views disagree as it predicts: without multipath
        it bends flat surfaces. Not needed with a given gain.
    applied
        Whether anything is corrected, as decided by the trial.
    strength
        Outcome of the trial: the fraction of the predicted disagreement that was observed, and its
        standard error; None without a trial, or if too little could be compared.
    """

    gain: Annotated[float | None, Bounds(0, exclusive=True)] = None
    period_m: Annotated[float | None, Bounds(0, exclusive=True)] = None
    bounces: Bounces = "one"
    lamp: Annotated[float, Bounds(1)] = 1.2
    relative_sigma: Annotated[float, Bounds(0, 10)] = 0.2
    trial: bool = True
    applied: bool = True
    strength: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.strength is not None and not (
            len(self.strength) == 2 and np.isfinite(self.strength).all()
        ):
            raise ValueError(f"strength is {self.strength}, not a strength and its standard error")

    @property
    def needs_trial(self) -> bool:
        """See `Correction.needs_trial`."""
        return self.trial and self.applied and self.gain is None

    @property
    def disabled(self) -> bool:
        """See `Correction.disabled`."""
        return not self.applied

    def after_trial(
        self,
        corrector: Corrector,
        improves: bool,
        strength: float = float("nan"),
        error: float = float("inf"),
    ) -> Multipath:
        """See `Correction.after_trial`. The gain is that of the trial's views.

        The correction is not scaled by the strength, whose estimate is biased low
        (`mapping.trial`), while the gain has been estimated from the recording. Its standard error
        is added to `relative_sigma`.
        """
        decided = replace(self, trial=False, applied=improves)
        if not np.isfinite([strength, error]).all():
            return decided
        decided = replace(decided, strength=(float(strength), float(error)))
        if not improves:
            return decided
        assert isinstance(corrector, MultipathCorrector)
        relative_sigma = float(np.hypot(self.relative_sigma, error / strength))
        return replace(decided, gain=corrector.gain, relative_sigma=relative_sigma)

    def start(self, model: MultipathModel | None = None) -> MultipathCorrector:
        """See `Correction.start`. `model` computes the multipath."""
        return MultipathCorrector(
            self, model or MultipathModel(lamp=self.lamp, bounces=self.bounces)
        )


class MultipathCorrector(Corrector):
    """Corrects the frames of one recording, and estimates the gain from them unless it is given.

    Surfaces outside the image are those of earlier views, if poses are known.

    Attributes
    ----------
    gain
        As given, or the current estimate; None before the first frame.
    """

    def __init__(self, options: Multipath, model: MultipathModel) -> None:
        self.gain = options.gain
        self._options = options
        self._model = model
        self._estimator = GainEstimator(self._model)
        self._map = ReflectorMap()
        self._last: tuple[int, MultipathEstimate] | None = None

    def is_independent(self, frame: Frame) -> bool:
        """See `Corrector.is_independent`: true for views that are passed through."""
        if not isinstance(frame, RangeFrame) or not self._options.applied:
            return True
        return (
            modulation_period(frame, self._options.period_m) is None
            or frame.amplitude_image is None
        )

    def apply(self, frame: Frame, T_world_camera: Float64 | None = None) -> Frame:
        """See `Corrector.apply`. Indirect light is removed from the amplitude as well."""
        if not isinstance(frame, RangeFrame) or not self._options.applied:
            return frame
        image = tof_image(frame, self._options.period_m)
        if image is None:
            return frame
        if self._options.gain is None:
            self._estimator.add(image)
            self.gain = self._estimator.gain
        estimate = None
        if self.gain is not None:
            estimate = self._model.solve(image, self.gain, self._map, T_world_camera)
        if estimate is None:
            return frame
        self._last = frame.index, estimate
        return _corrected(frame, image, estimate, self._options.relative_sigma)

    def reset_poses(self) -> None:
        """See `Corrector.reset_poses`."""
        self._map, self._last = ReflectorMap(), None

    def add_pose(self, frame: Frame, T_world_camera: Float64) -> None:
        """See `Corrector.add_pose`."""
        if self._last is None or not isinstance(frame, RangeFrame) or frame.index != self._last[0]:
            return
        estimate = self._last[1]
        centres = [
            np.minimum(np.arange(n) * estimate.step + estimate.step // 2, size - 1)
            for n, size in zip(estimate.surfaces.has_plane.shape, frame.valid.shape, strict=True)
        ]
        self._map.add(estimate.surfaces, frame.valid[np.ix_(*centres)], T_world_camera)


def _corrected(
    frame: RangeFrame, image: ToFImage, estimate: MultipathEstimate, relative_sigma: float
) -> RangeFrame:
    assert frame.amplitude_image is not None
    depth_ratio = np.where(image.z > 0, estimate.z / np.where(image.z > 0, image.z, 1), 1)
    factor = 1 / estimate.factor
    if frame.amplitude_kind == "range_compensated":
        factor = factor * depth_ratio**2
    unchanged = (image.z <= 0) | (frame.amplitude_image >= SATURATED_AMPLITUDE)
    amplitude = np.where(unchanged, frame.amplitude_image, frame.amplitude_image * factor)
    shared = frame.shared_sigma_image
    if relative_sigma > 0:
        sigma = relative_sigma * np.abs(frame.radial_range * (1 - depth_ratio))
        shared = (sigma if shared is None else np.hypot(shared, sigma)).astype(np.float32)
    return replace(
        frame,
        depth=(frame.depth * depth_ratio).astype(np.float32),
        amplitude_image=amplitude.astype(np.float32),
        shared_sigma_image=shared,
    )
