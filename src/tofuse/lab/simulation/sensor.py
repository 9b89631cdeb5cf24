"""Sensor model, from per-pixel light to the reported data: four phase images and their sums.

Phase image k correlates the light with the signal shifted by ``theta_k = k pi / 2`` in two buckets,
whose difference is ``D_k = m sum s c(phase - theta_k)`` electrons with the correlation
``c(x) = cos x + h3 cos 3x + h5 cos 5x`` (Lange 2000; Lindner et al. 2010 for the harmonics). The
phasor ``((D_0 - D_2) + i (D_1 - D_3)) / 2`` has the range in its angle and the amplitude in its
length (eq 2.2). As four samples alias the third and fifth harmonic onto the first, the range error
has four periods per period of the phase: wiggling.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.constants import speed_of_light

from tofuse.engine.arrays import Bool, Complex128, Float32, Float64, UInt8
from tofuse.engine.frames import SATURATED_AMPLITUDE
from tofuse.engine.sensor import DepthCorrection
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import CameraModel

TAPS = 4


def correlate(light: Float64, tap: int, harmonics: tuple[float, float]) -> Float64:
    """Correlation (H, W) of light (H, W, 7), see `phasor_kernels`, in phase image `tap`."""
    # Multiples of a right angle, exactly.
    cosine, sine = ((1, 0), (0, 1), (-1, 0), (0, -1))[tap]
    third = harmonics[0] * (light[..., 3] * cosine - light[..., 4] * sine)
    fifth = harmonics[1] * (light[..., 5] * cosine + light[..., 6] * sine)
    return light[..., 1] * cosine + light[..., 2] * sine + third + fifth


def phasor_of(differences: Float64) -> Complex128:
    """Phasor (...) of the bucket differences (4, ...)."""
    return (differences[0] - differences[2] + 1j * (differences[1] - differences[3])) / 2


@dataclass(frozen=True, eq=False)
class Exposure:
    """Expected light of all phase images, relative to a white wall at 1 m.

    Attributes
    ----------
    difference
        (F, 4, H, W) correlation, for each frequency and phase image.
    total
        (F, 4, H, W) all modulated light.
    ambient
        (H, W) unmodulated light, relative to a white wall in a bright office.
    """

    difference: Float64
    total: Float64
    ambient: Float64


@dataclass(frozen=True, eq=False)
class Measurement:
    """The camera's measurement of an exposure.

    Attributes
    ----------
    range_m
        (H, W) radial range in m, 0 where dropped; neither corrected nor rounded.
    amplitude
        (H, W) raw counts.
    saturated
        (H, W) mask.
    """

    range_m: Float64
    amplitude: Float64
    saturated: Bool


def expose(
    model: CameraModel, effects: Effects, exposure: Exposure, rng: np.random.Generator | None
) -> Measurement:
    """Simulate charge integration and read-out of the buckets.

    Parameters
    ----------
    rng
        Source of noise; None for the expected values.
    """
    signal = model.signal_electrons * exposure.total
    ambient = effects.ambient * model.ambient_electrons * exposure.ambient
    difference = model.signal_electrons * model.modulation_contrast * exposure.difference
    if rng is None or not effects.shot_noise:
        buckets = (signal + ambient + difference) / 2, (signal + ambient - difference) / 2
    else:
        buckets = _noisy(model, effects, signal + ambient, difference, rng)
    a, b = buckets
    saturated: Bool = np.zeros(a.shape[2:], bool)
    if effects.saturation:
        overflow = np.maximum(a, b) >= model.full_well_electrons
        saturated = np.asarray(overflow.any((0, 1)))
        a, b = np.minimum(a, model.full_well_electrons), np.minimum(b, model.full_well_electrons)
    fraction = (a + b) / (2 * model.full_well_electrons)
    read = (a - b) * (1 - effects.amplitude_nonlinearity * model.compression * fraction)
    phasors = phasor_of(np.moveaxis(read, 1, 0))
    amplitude = np.abs(phasors[0]) * model.counts_per_electron
    return Measurement(unwrapped_range(model, phasors), amplitude, saturated)


def unwrapped_range(model: CameraModel, phasors: Complex128) -> Float64:
    """Range (H, W) in m of phasors (F, H, W): the fine one's, unwrapped by the coarse one."""
    cycles = np.mod(np.angle(phasors) / (2 * np.pi), 1)
    fine = cycles[0] * model.period_m
    if model.unwrap_hz is None:
        return fine
    coarse = cycles[1] * model.ambiguity_m
    periods = np.round((coarse - fine) / model.period_m)
    return np.mod(fine + periods * model.period_m, model.ambiguity_m)


def _noisy(
    model: CameraModel,
    effects: Effects,
    electrons: Float64,
    difference: Float64,
    rng: np.random.Generator,
) -> tuple[Float64, Float64]:
    mean_a = np.maximum((electrons + difference) / 2, 0)
    mean_b = np.maximum((electrons - difference) / 2, 0)
    read = model.read_noise_electrons
    if effects.noise == "poisson":
        a = rng.poisson(mean_a) + rng.normal(0, read, mean_a.shape)
        b = rng.poisson(mean_b) + rng.normal(0, read, mean_b.shape)
        return a, b
    # A common factor of a pixel's phase images makes the tails of the range heavy (Student's t with
    # 5 degrees of freedom).
    shape = mean_a.shape[2:]
    gain = _noise_gain(shape) * np.sqrt(3 / rng.chisquare(5, shape))
    a, b = (
        mean + gain * np.sqrt(mean + read**2) * _correlated_noise(rng, mean.shape)
        for mean in (mean_a, mean_b)
    )
    return a, b


@cache
def _noise_gain(shape: tuple[int, ...]) -> Float64:
    """Factor on the noise of each pixel, log-normal with mean square 1."""
    sigma = 0.35
    return np.exp(np.random.default_rng([90210]).normal(0, sigma, shape) - sigma**2)


def _correlated_noise(rng: np.random.Generator, shape: tuple[int, ...]) -> Float64:
    """Normal noise of unit variance, half of which is correlated with the neighbours."""
    own, other = rng.normal(size=shape), rng.normal(size=shape)
    shifts = [np.roll(other, shift, (-2, -1)) for shift in ((0, 0), (0, 1), (1, 0), (1, 1))]
    return (own + sum(shifts) / 2) / np.sqrt(2)


@cache
def pixel_offsets(model: CameraModel) -> Float64:
    """Range offset (H, W) in m of each pixel: read-out delay plus a random part."""
    height, width = model.camera.height, model.camera.width
    ramp = np.linspace(-0.5, 0.5, width) + 0.25 * np.linspace(-0.5, 0.5, height)[:, None]
    random = np.random.default_rng([height, width]).normal(0, model.pixel_delay_m, (height, width))
    return model.readout_delay_m * ramp + random


def drift(model: CameraModel, time_s: float) -> float:
    """Thermal range offset in m at `time_s` after the camera was switched on."""
    return model.drift_m * (1 - float(np.exp(-max(time_s, 0.0) / model.drift_time_s)))


def factory_correction(model: CameraModel, effects: Effects) -> DepthCorrection:
    """Calibrate the camera: return its factory correction.

    All pixels measure a series of known ranges without noise, scattering or multipath, which gives
    the curve; a pixel's offset is its residual at one of them.
    """
    per_period = 96
    count = per_period * round(model.ambiguity_m / model.period_m)
    true = (np.arange(count) + 0.5) / count * model.ambiguity_m
    measured = _measure_known_range(model, effects, true)
    bias = np.mod(measured - true + model.ambiguity_m / 2, model.ambiguity_m)
    bias -= model.ambiguity_m / 2
    order = np.argsort(measured)
    knots, curve = measured[order], bias[order]
    increasing = np.concatenate([[True], np.diff(knots) > 0])
    offsets = effects.pixel_offsets * pixel_offsets(model)
    return DepthCorrection(knots[increasing], curve[increasing], offsets.astype(np.float32))


def _measure_known_range(model: CameraModel, effects: Effects, true: Float64) -> Float64:
    harmonics = scaled_harmonics(model, effects)
    phasors = []
    for frequency in model.frequencies:
        phase = 4 * np.pi * frequency / speed_of_light * true
        light = np.stack(
            [
                np.ones_like(phase),
                *(part(n * phase) for n in (1, 3, 5) for part in (np.cos, np.sin)),
            ],
            -1,
        )
        phasors.append(phasor_of(np.stack([correlate(light, k, harmonics) for k in range(TAPS)])))
    return unwrapped_range(model, np.stack(phasors))


def scaled_harmonics(model: CameraModel, effects: Effects) -> tuple[float, float]:
    """Harmonics of the correlation, scaled by the effects."""
    return model.harmonics[0] * effects.wiggling, model.harmonics[1] * effects.wiggling


def reported_amplitude(model: CameraModel, measurement: Measurement) -> Float32:
    """Amplitude image (H, W) in the camera's counts: integers up to 65534, or saturated."""
    amplitude = measurement.amplitude
    if model.amplitude_kind == "range_compensated":
        amplitude = amplitude * measurement.range_m**2 / np.maximum(model.transmission, 1e-6)
    counts = np.clip(np.round(amplitude), 0, SATURATED_AMPLITUDE - 1)
    return np.where(measurement.saturated, SATURATED_AMPLITUDE, counts).astype(np.float32)


def reported_confidence(model: CameraModel, measurement: Measurement) -> UInt8 | None:
    """Confidence (H, W): number of thresholds below the raw amplitude; 0 where saturated."""
    if not model.confidence_thresholds:
        return None
    level = np.searchsorted(model.confidence_thresholds, measurement.amplitude, side="right")
    return np.where(measurement.saturated, 0, level).astype(np.uint8)


def reported_sigma(model: CameraModel, measurement: Measurement) -> Float32 | None:
    """Standard deviation (H, W) in m of the range, as reported by the camera, or None.

    Estimated from the read-out noise and the shot noise of the measured amplitude.
    """
    if not model.reports_noise:
        return None
    signal = np.maximum(measurement.amplitude / model.counts_per_electron, 1e-3)
    electrons = signal / model.modulation_contrast + 2 * model.read_noise_electrons**2
    phase = np.sqrt(electrons / 2) / signal
    return (np.minimum(phase, 1.8) * model.period_m / (2 * np.pi)).astype(np.float32)
