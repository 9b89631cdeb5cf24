"""Raw amplitude and phase of a frame, as corrections need them."""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Complex128, Float32
from tofuse.recordings.frames import SATURATED_AMPLITUDE, Frame, RangeFrame
from tofuse.sensor.multipath import ToFImage
from tofuse.sensor.multipath_surfaces import FALLOFF

# Cameras of one frequency measure with periods up to this. A longer ambiguity is a beat of several
# frequencies, which says nothing about the phase that was measured.
_LONGEST_PERIOD_M = 6.0


def tof_image(frame: RangeFrame, period_m: float | None = None) -> ToFImage | None:
    """Return the frame's depth and raw light; None if its light or its period is not known."""
    period_m = modulation_period(frame, period_m)
    if period_m is None or frame.amplitude_image is None or not len(frame):
        return None
    z = np.where(frame.valid, frame.z, np.float32(0))
    rays = frame.camera.rays()
    amplitude = frame.amplitude_image
    fine = frame.valid & np.isfinite(amplitude) & (amplitude > 0)
    fine &= amplitude < SATURATED_AMPLITUDE
    light = np.where(fine, amplitude, np.float32(0))
    if frame.amplitude_kind == "range_compensated":
        square = np.where(fine, 1 + (rays * rays).sum(-1), np.float32(1))
        # z squared times the square of the ray's length is the range's.
        light = light / (np.where(fine, z * z, np.float32(1)) * square ** (FALLOFF / 2 + 1))
    return ToFImage(z, rays, light.astype(np.float32, copy=False), period_m)


def modulation_period(frame: RangeFrame, given: float | None) -> float | None:
    """Range after which the phase of a frame's one frequency repeats; None where not known."""
    if given is not None:
        return given
    period_m = frame.ambiguity_m
    if period_m is None or period_m > _LONGEST_PERIOD_M or frame.amplitude_kind == "ir":
        return None
    return period_m


def frame_phasor(frame: RangeFrame, period_m: float | None = None) -> Complex128 | None:
    """Return the light (H, W) of a frame, with its phase; 0 where there is none.

    None where the light or the period is not known.
    """
    image = tof_image(frame, period_m)
    return None if image is None else phasor(image)


def phasor(image: ToFImage) -> Complex128:
    """Phasor (H, W) of the raw light; 0 where there is none."""
    seen = (image.z > 0) & (image.amplitude > 0)
    x, y = image.rays[..., 0], image.rays[..., 1]
    r = np.where(seen, image.z * np.sqrt(1 + x * x + y * y), np.float32(0))
    phase = np.float32(2 * np.pi / image.period_m) * r
    light = np.where(seen, image.amplitude, np.float32(0))
    out = np.empty(r.shape, np.complex128)
    out.real, out.imag = light * np.cos(phase), light * np.sin(phase)
    return out


def range_and_amplitude(
    frame: Frame, period_m: float | None
) -> tuple[Float32, Float32, float] | None:
    """Return radial range and raw light with the falloff of lens and lamp taken off, and period."""
    if not isinstance(frame, RangeFrame):
        return None
    image = tof_image(frame, period_m)
    if image is None:
        return None
    rays = frame.camera.rays()
    cosine2 = 1 / (1 + (rays * rays).sum(-1))
    radial = np.where(frame.valid, frame.radial_range, np.float32(0))
    with np.errstate(invalid="ignore"):
        light = np.nan_to_num(image.amplitude / cosine2 ** (FALLOFF / 2))
    return radial, light.astype(np.float32), image.period_m


def pixel_pitch(frame: Frame) -> float:
    """Angle between neighbouring pixels in the middle of the image, rad."""
    assert isinstance(frame, RangeFrame)
    rays = frame.camera.rays()
    rows, columns = (slice(n // 4, max(n - n // 4, n // 4 + 2)) for n in rays.shape[:2])
    return float(np.nanmedian(np.abs(np.diff(rays[rows, columns, 0], axis=1))))
