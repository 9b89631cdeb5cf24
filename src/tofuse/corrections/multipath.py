"""Take the light out of a view that came by way of other surfaces."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from tofuse.arrays import Float64
from tofuse.bounds import above, at_least, whole, within
from tofuse.corrections.base import Correction, Corrector
from tofuse.corrections.raw_amplitude import modulation_period, tof_image
from tofuse.parts import part
from tofuse.recordings.frames import SATURATED_AMPLITUDE, Frame, RangeFrame
from tofuse.sensor.multipath import (
    Bounces,
    GainEstimator,
    MultipathEstimate,
    MultipathModel,
    ToFImage,
)
from tofuse.sensor.multipath_map import ReflectorMap


@part("correction", "multipath", label="validated")
@dataclass(frozen=True)
class Multipath(Correction):
    """Compensate the light that surfaces reflect onto each other (Fuchs 2010), see `sensor`.

    Corners are no longer rounded, and floors and walls lie where they are. Works on cameras of
    one modulation frequency that record amplitude; other views are passed on as they are.

    Attributes
    ----------
    gain
        Counts of raw amplitude of a white wall (albedo 1) at 1 m in the image's centre; for
        range-compensated amplitude, of a white wall anywhere. None: found from the recording.
    period_m
        Range after which the phase repeats; None: as the frame says.
    bounces
        "one": light by way of one other surface; "all": by way of any number.
    iterations
        Times that the light is computed, from surfaces corrected by the time before.
    columns
        Blocks of pixels along the image's width for which the light is computed.
    lamp
        Angle up to which the lamp lights, relative to that of the image's corner. OffscreenCells the image
        surfaces are taken to go on.
    relative_sigma
        Standard deviation of the correction, as a share of it; neighbouring pixels share its
        error.
    trial
        Apply it only where overlapping views of the recording clearly disagree as it predicts:
        where there is no such light, it bends what is straight. A gain that is given is trusted.
    applied
        Whether anything is corrected: what a trial decides.
    seen
        What a trial found: the share of the predicted disagreement that is there, and its standard
        error; None where there was none, or too little to compare.
    """

    gain: float | None = None
    period_m: float | None = None
    bounces: Bounces = "one"
    iterations: int = 3
    columns: int = 44
    lamp: float = 1.2
    relative_sigma: float = 0.2
    trial: bool = True
    applied: bool = True
    seen: tuple[float, ...] | None = None

    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

    def __post_init__(self) -> None:
        if self.gain is not None:
            above("gain", self.gain, 0)
        if self.period_m is not None:
            above("period_m", self.period_m, 0)
        whole("iterations", self.iterations, 1, 10)
        whole("columns", self.columns, 8, 200)
        at_least("lamp", self.lamp, 1)
        within("relative_sigma", self.relative_sigma, 0, 10)
        if self.seen is not None and not (len(self.seen) == 2 and np.isfinite(self.seen).all()):
            raise ValueError(f"seen is {self.seen}, not a strength and its standard error")

    @property
    def needs_trial(self) -> bool:
        """See `Correction.needs_trial`."""
        return self.trial and self.applied and self.gain is None

    @property
    def disabled(self) -> bool:
        """See `Correction.disabled`."""
        return not self.applied

    def after_trial(
        self, helps: bool, strength: float = float("nan"), error: float = float("inf")
    ) -> Multipath:
        """See `Correction.after_trial`.

        The strength itself is not scaled by: what is seen of it is diluted (`pipeline.trial`), and
        the gain has been found from the recording already. But as far as it is not known, all
        pixels are wrong by the same share of the correction; and so each of them is by more.
        """
        if not np.isfinite([strength, error]).all():
            return replace(self, trial=False, applied=helps)
        relative_sigma = (
            float(np.hypot(self.relative_sigma, error / strength)) if helps else self.relative_sigma
        )
        seen = (float(strength), float(error))
        return replace(self, trial=False, applied=helps, seen=seen, relative_sigma=relative_sigma)

    def start(self) -> MultipathCorrector:
        """See `Correction.start`."""
        return MultipathCorrector(self)


class MultipathCorrector(Corrector):
    """Corrects the frames of one recording, with a gain that it needs_fit from them unless given.

    Surfaces that the image does not show are those that earlier views have, where it is known how
    the camera has moved.

    Attributes
    ----------
    gain
        As given, or as known so far; None before the first frame.
    """

    def __init__(self, options: Multipath) -> None:
        self.gain = options.gain
        self._options = options
        self._reflections = MultipathModel(
            options.columns, options.iterations, options.lamp, options.bounces
        )
        self._estimator = GainEstimator(self._reflections)
        self._map = ReflectorMap()
        self._last: tuple[int, MultipathEstimate] | None = None

    def is_independent(self, frame: Frame) -> bool:
        """See `Corrector.is_independent`: so are views that are passed on."""
        if not isinstance(frame, RangeFrame) or not self._options.applied:
            return True
        return (
            modulation_period(frame, self._options.period_m) is None
            or frame.amplitude_image is None
        )

    def apply(self, frame: Frame, T_world_camera: Float64 | None = None) -> Frame:
        """See `Corrector.apply`. The amplitude loses its indirect share as well."""
        if not isinstance(frame, RangeFrame) or not self._options.applied:
            return frame
        image = tof_image(frame, self._options.period_m)
        if image is None:
            return frame
        if self._options.gain is None:
            self._estimator.add(image)
            self.gain = self._estimator.gain
        found = None
        if self.gain is not None:
            found = self._reflections.solve(image, self.gain, self._map, T_world_camera)
        if found is None:
            return frame
        self._last = frame.index, found
        return _corrected(frame, image, found, self._options.relative_sigma)

    def reset_poses(self) -> None:
        """See `Corrector.reset_poses`."""
        self._map, self._last = ReflectorMap(), None

    def add_pose(self, frame: Frame, T_world_camera: Float64) -> None:
        """See `Corrector.add_pose`."""
        if self._last is None or not isinstance(frame, RangeFrame) or frame.index != self._last[0]:
            return
        found = self._last[1]
        middle = [
            np.minimum(np.arange(n) * found.step + found.step // 2, size - 1)
            for n, size in zip(found.surfaces.good.shape, frame.valid.shape, strict=True)
        ]
        self._map.add(found.surfaces, frame.valid[np.ix_(*middle)], T_world_camera)


def _corrected(
    frame: RangeFrame, image: ToFImage, found: MultipathEstimate, relative_sigma: float
) -> RangeFrame:
    assert frame.amplitude_image is not None
    nearer = np.where(image.z > 0, found.z / np.where(image.z > 0, image.z, 1), 1)
    factor = 1 / found.factor
    if frame.amplitude_kind == "range_compensated":
        factor = factor * nearer**2
    plain = (image.z <= 0) | (frame.amplitude_image >= SATURATED_AMPLITUDE)
    amplitude = np.where(plain, frame.amplitude_image, frame.amplitude_image * factor)
    shared = frame.shared_sigma_image
    if relative_sigma > 0:
        own = relative_sigma * np.abs(frame.radial_range * (1 - nearer))
        shared = (own if shared is None else np.hypot(shared, own)).astype(np.float32)
    return replace(
        frame,
        depth=(frame.depth * nearer).astype(np.float32),
        amplitude_image=amplitude.astype(np.float32),
        shared_sigma_image=shared,
    )
