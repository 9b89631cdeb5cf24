"""Raw amplitude and phase of frames, the input of corrections."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Complex128, Float32
from tofuse.engine.frames import SATURATED_AMPLITUDE, Frame, RangeFrame
from tofuse.engine.sensor.multipath import ToFImage
from tofuse.engine.sensor.multipath_kernels import FALLOFF

# Longest ambiguity range of cameras with a single frequency. Longer ones are the beat of several
# frequencies, from which the measured phases can't be recovered.
_LONGEST_PERIOD_M = 6.0


def tof_image(frame: RangeFrame, period_m: float | None = None) -> ToFImage | None:
    """Return depth and raw amplitude of a frame; None without amplitude or ambiguity range.

    `period_m` overrides the ambiguity range of the frame.
    """
    period_m = modulation_period(frame, period_m)
    if period_m is None or frame.amplitude_image is None or not len(frame):
        return None
    z = np.where(frame.valid, frame.z, np.float32(0))
    rays = frame.camera.rays()
    amplitude = frame.amplitude_image
    valid = frame.valid & np.isfinite(amplitude) & (amplitude > 0)
    valid &= amplitude < SATURATED_AMPLITUDE
    raw = np.where(valid, amplitude, np.float32(0))
    if frame.amplitude_kind == "range_compensated":
        squared_length = np.where(valid, 1 + (rays * rays).sum(-1), np.float32(1))
        # The squared range is z^2 times the squared length of the ray.
        raw = raw / (np.where(valid, z * z, np.float32(1)) * squared_length ** (FALLOFF / 2 + 1))
    return ToFImage(z, rays, raw.astype(np.float32, copy=False), period_m)


def modulation_period(frame: RangeFrame, override: float | None) -> float | None:
    """Return the ambiguity range of a single-frequency frame, or `override`; None if unknown."""
    if override is not None:
        return override
    period_m = frame.ambiguity_m
    if period_m is None or period_m > _LONGEST_PERIOD_M or frame.amplitude_kind == "ir":
        return None
    return period_m


def frame_phasor(frame: RangeFrame, period_m: float | None = None) -> Complex128 | None:
    """Return the phasors (H, W) of a frame, see `phasor`; None as in `tof_image`."""
    image = tof_image(frame, period_m)
    return None if image is None else phasor(image)


def phasor(image: ToFImage) -> Complex128:
    """Return raw amplitude and phase as complex numbers (H, W); 0 where invalid."""
    valid = (image.z > 0) & (image.amplitude > 0)
    x, y = image.rays[..., 0], image.rays[..., 1]
    r = np.where(valid, image.z * np.sqrt(1 + x * x + y * y), np.float32(0))
    phase = np.float32(2 * np.pi / image.period_m) * r
    amplitude = np.where(valid, image.amplitude, np.float32(0))
    out = np.empty(r.shape, np.complex128)
    out.real, out.imag = amplitude * np.cos(phase), amplitude * np.sin(phase)
    return out


def range_and_amplitude(
    frame: Frame, period_m: float | None
) -> tuple[Float32, Float32, float] | None:
    """Return radial range (H, W) in m, raw amplitude (H, W) without falloff, and ambiguity range.

    None as in `tof_image`.
    """
    if not isinstance(frame, RangeFrame):
        return None
    image = tof_image(frame, period_m)
    if image is None:
        return None
    rays = frame.camera.rays()
    cosine2 = 1 / (1 + (rays * rays).sum(-1))
    radial = np.where(frame.valid, frame.radial_range, np.float32(0))
    with np.errstate(invalid="ignore"):
        amplitude = np.nan_to_num(image.amplitude / cosine2 ** (FALLOFF / 2))
    return radial, amplitude.astype(np.float32), image.period_m


def pixel_pitch(frame: Frame) -> float:
    """Return the angle between neighbouring pixels at the centre of the image, rad."""
    assert isinstance(frame, RangeFrame)
    rays = frame.camera.rays()
    rows, columns = (slice(n // 4, max(n - n // 4, n // 4 + 2)) for n in rays.shape[:2])
    return float(np.nanmedian(np.abs(np.diff(rays[rows, columns, 0], axis=1))))
