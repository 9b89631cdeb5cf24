"""Take the light out of a view that came by way of other surfaces."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from tofuse.arrays import Float64
from tofuse.bounds import above, at_least, whole, within
from tofuse.corrections.base import Correction, Corrector
from tofuse.corrections.raw_amplitude import light_image, modulation_period
from tofuse.parts import part
from tofuse.recordings.frames import SATURATED_AMPLITUDE, Frame, RangeFrame
from tofuse.sensor.multipath import Bounces, GainEstimator, Interference, LightImage, Reflections
from tofuse.sensor.multipath_map import LightMap


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
        Angle up to which the lamp lights, relative to that of the image's corner. Around the image
        surfaces are taken to go on.
    doubt
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
    doubt: float = 0.2
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
        within("doubt", self.doubt, 0, 10)
        if self.seen is not None and not (len(self.seen) == 2 and np.isfinite(self.seen).all()):
            raise ValueError(f"seen is {self.seen}, not a strength and its standard error")

    @property
    def on_trial(self) -> bool:
        """See `Correction.on_trial`."""
        return self.trial and self.applied and self.gain is None

    @property
    def left_out(self) -> bool:
        """See `Correction.left_out`."""
        return not self.applied

    def tried(
        self, helps: bool, strength: float = float("nan"), error: float = float("inf")
    ) -> Multipath:
        """See `Correction.tried`.

        The strength itself is not scaled by: what is seen of it is diluted (`pipeline.trial`), and
        the gain has been found from the recording already. But as far as it is not known, all
        pixels are wrong by the same share of the correction; and so each of them is by more.
        """
        if not np.isfinite([strength, error]).all():
            return replace(self, trial=False, applied=helps)
        doubt = float(np.hypot(self.doubt, error / strength)) if helps else self.doubt
        seen = (float(strength), float(error))
        return replace(self, trial=False, applied=helps, seen=seen, doubt=doubt)

    def start(self) -> MultipathCorrector:
        """See `Correction.start`."""
        return MultipathCorrector(self)


class MultipathCorrector(Corrector):
    """Corrects the frames of one recording, with a gain that it learns from them unless given.

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
        self._reflections = Reflections(
            options.columns, options.iterations, options.lamp, options.bounces
        )
        self._estimator = GainEstimator(self._reflections)
        self._map = LightMap()
        self._last: tuple[int, Interference] | None = None

    def alone(self, frame: Frame) -> bool:
        """See `Corrector.alone`: so are views that are passed on."""
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
        image = light_image(frame, self._options.period_m)
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
        return _corrected(frame, image, found, self._options.doubt)

    def forget(self) -> None:
        """See `Corrector.forget`."""
        self._map, self._last = LightMap(), None

    def placed(self, frame: Frame, T_world_camera: Float64) -> None:
        """See `Corrector.placed`."""
        if self._last is None or not isinstance(frame, RangeFrame) or frame.index != self._last[0]:
            return
        found = self._last[1]
        middle = [
            np.minimum(np.arange(n) * found.step + found.step // 2, size - 1)
            for n, size in zip(found.surfaces.good.shape, frame.valid.shape, strict=True)
        ]
        self._map.add(found.surfaces, frame.valid[np.ix_(*middle)], T_world_camera)


def _corrected(
    frame: RangeFrame, image: LightImage, found: Interference, doubt: float
) -> RangeFrame:
    assert frame.amplitude_image is not None
    nearer = np.where(image.z > 0, found.z / np.where(image.z > 0, image.z, 1), 1)
    factor = 1 / found.factor
    if frame.amplitude_kind == "range_compensated":
        factor = factor * nearer**2
    plain = (image.z <= 0) | (frame.amplitude_image >= SATURATED_AMPLITUDE)
    amplitude = np.where(plain, frame.amplitude_image, frame.amplitude_image * factor)
    shared = frame.shared_sigma_image
    if doubt > 0:
        own = doubt * np.abs(frame.radial_range * (1 - nearer))
        shared = (own if shared is None else np.hypot(shared, own)).astype(np.float32)
    return replace(
        frame,
        depth=(frame.depth * nearer).astype(np.float32),
        amplitude_image=amplitude.astype(np.float32),
        shared_sigma_image=shared,
    )
