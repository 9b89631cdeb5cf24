"""Models of ToF cameras: lens, modulation, electronics and noise.

The SR4000's gain, noise, falloff and confidence thresholds are fitted to a real recording (see
docs/simulator.md). The others follow data sheets and published lens parameters; their noise is
scaled to that stated by their makers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, Self

import numpy as np
from scipy.constants import speed_of_light

from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import BrownConrady, Pinhole, Rational
from tofuse.engine.errors import InputError
from tofuse.engine.noise import AmplitudeLaw, NoiseModel, RangeLaw

# Typical ambient light indoors, as a fraction of that on a white wall in a bright office.
_TYPICAL_AMBIENT = 0.15


@dataclass(frozen=True)
class CameraModel:
    """One ToF camera.

    Attributes
    ----------
    name
        As in `CAMERAS`.
    camera
        Resolution, intrinsics and lens.
    modulation_hz
        Frequency that determines the precision.
    unwrap_hz
        Frequency that unwraps the phase of the former (the beat of a camera with several
        frequencies), or None.
    frame_rate_hz, integration_s
        Frames per second; time from the start of the first phase image to the end of the last.
    depth_unit_m, depth_kind
        Of the recorded images.
    signal_electrons
        Electrons in one phase image of a white wall (albedo 1) at 1 m on the optical axis.
    modulation_contrast
        Demodulation contrast, 0 to 1.
    ambient_electrons
        Electrons of ambient light in one phase image of a white wall in a bright office.
    read_noise_electrons
        Standard deviation of the read noise of one bucket.
    full_well_electrons
        Capacity of one bucket.
    counts_per_electron
        Of the amplitude image.
    falloff
        Exponent of the cosine to the optical axis by which light falls off (lens and illumination,
        half each).
    blur_px
        Standard deviation of the lens's point spread function, in pixels.
    amplitude_kind
        "raw", "ir", or "range_compensated": multiplied by the square of the measured range and
        divided by the falloff, as the SR4000 does.
    minimum_amplitude
        Raw counts below which the camera drops a pixel; 0: never.
    confidence_thresholds
        Raw counts at which confidence rises by one step; empty: no confidence map.
    reports_noise
        Whether each frame comes with a standard deviation of the range.
    harmonics
        Third and fifth harmonic of the correlation, relative to the first.
    readout_delay_m, pixel_delay_m
        Range offset from the first to the last column along the read-out chain (and a quarter of
        it over the rows), and standard deviation from pixel to pixel.
    compression
        Relative loss of a signal that fills the wells.
    drift_m, drift_time_s
        Range offset of a warm camera relative to time 0, when it is switched on, and the time
        constant.
    """

    name: str
    camera: Pinhole
    modulation_hz: float
    frame_rate_hz: float
    integration_s: float
    depth_unit_m: float
    signal_electrons: float
    read_noise_electrons: float
    full_well_electrons: float
    unwrap_hz: float | None = None
    depth_kind: Literal["z", "range"] = "z"
    modulation_contrast: float = 0.8
    ambient_electrons: float = 1500.0
    counts_per_electron: float = 0.064
    falloff: float = 4.0
    blur_px: float = 0.3
    amplitude_kind: Literal["raw", "range_compensated", "ir"] = "raw"
    minimum_amplitude: float = 0.0
    confidence_thresholds: tuple[float, ...] = ()
    reports_noise: bool = False
    harmonics: tuple[float, float] = (0.012, 0.004)
    readout_delay_m: float = 0.02
    pixel_delay_m: float = 0.003
    compression: float = 0.1
    drift_m: float = 0.012
    drift_time_s: float = 240.0

    def binned(self, columns: int) -> Self:
        """Return the camera with squares of pixels summed, so that it has about `columns`."""
        n = max(1, round(self.camera.width / columns))
        lens = self.camera
        camera = replace(
            lens,
            width=lens.width // n,
            height=lens.height // n,
            fx=lens.fx / n,
            fy=lens.fy / n,
            cx=(lens.cx + 0.5) / n - 0.5,
            cy=(lens.cy + 0.5) / n - 0.5,
        )
        return replace(
            self,
            camera=camera,
            signal_electrons=n**2 * self.signal_electrons,
            ambient_electrons=n**2 * self.ambient_electrons,
            full_well_electrons=n**2 * self.full_well_electrons,
            read_noise_electrons=n * self.read_noise_electrons,
            counts_per_electron=self.counts_per_electron / n**2,
            blur_px=self.blur_px / n,
        )

    @property
    def period_m(self) -> float:
        """Ambiguity range of the fine frequency, m."""
        return speed_of_light / (2 * self.modulation_hz)

    @property
    def ambiguity_m(self) -> float:
        """Ambiguity range of the camera, m."""
        return speed_of_light / (2 * (self.unwrap_hz or self.modulation_hz))

    @property
    def frequencies(self) -> tuple[float, ...]:
        """Modulation frequencies in Hz, the fine one first."""
        return (
            (self.modulation_hz,)
            if self.unwrap_hz is None
            else (self.modulation_hz, self.unwrap_hz)
        )

    @property
    def confidence_max(self) -> int | None:
        """Highest value of the confidence map, or None without one."""
        return len(self.confidence_thresholds) or None

    @cached_property
    def transmission(self) -> Float64:
        """Return the light (H, W) in each pixel relative to the axis; 0 outside the valid area."""
        rays = self.camera.rays().astype(float)
        cosine = 1 / np.sqrt(1 + (rays * rays).sum(-1))
        return np.where(np.isfinite(cosine), cosine**self.falloff, 0.0)


CAMERAS: dict[str, CameraModel] = {
    model.name: model
    for model in (
        # Mesa SwissRanger SR4000, 5 m version.
        CameraModel(
            name="sr4000",
            camera=BrownConrady(176, 144, 229.0, 229.0, 87.1, 71.6, k1=-0.12, k2=0.08),
            modulation_hz=29_979_245.8,
            frame_rate_hz=30.0,
            integration_s=0.030,
            depth_unit_m=0.0001,
            signal_electrons=68_000.0,
            read_noise_electrons=45.0,
            full_well_electrons=180_000.0,
            blur_px=0.9,
            amplitude_kind="range_compensated",
            confidence_thresholds=(10.5, 16.4, 24.0, 33.0, 47.8, 73.1, 136.0),
        ),
        # Microsoft Kinect v2: 16, 80 and 120 MHz, in which 80 MHz carries the range here.
        CameraModel(
            name="kinect2",
            camera=BrownConrady(512, 424, 365.5, 365.5, 257.0, 209.5, k1=0.093, k2=-0.27, k3=0.097),
            modulation_hz=80e6,
            unwrap_hz=8e6,
            frame_rate_hz=30.0,
            integration_s=0.020,
            depth_unit_m=0.0002,
            signal_electrons=90_000.0,
            read_noise_electrons=50.0,
            full_well_electrons=600_000.0,
            amplitude_kind="ir",
            minimum_amplitude=12.0,
            harmonics=(0.010, 0.003),
            readout_delay_m=0.01,
            pixel_delay_m=0.001,
        ),
        # Azure Kinect, narrow field of view, unbinned.
        CameraModel(
            name="azure-nfov",
            camera=Rational(
                640,
                576,
                504.6,
                504.7,
                332.8,
                348.8,
                k1=0.548,
                k2=-0.0210,
                p1=2.06e-5,
                p2=-7.21e-5,
                k3=-0.00265,
                k4=0.890,
                k5=0.0861,
                k6=-0.0139,
            ),
            modulation_hz=200e6,
            unwrap_hz=15e6,
            frame_rate_hz=30.0,
            integration_s=0.0128,
            depth_unit_m=0.001,
            signal_electrons=20_000.0,
            read_noise_electrons=14.0,
            full_well_electrons=150_000.0,
            ambient_electrons=400.0,
            amplitude_kind="ir",
            minimum_amplitude=8.0,
            harmonics=(0.006, 0.002),
            readout_delay_m=0.004,
            pixel_delay_m=0.001,
            drift_m=0.004,
        ),
        # pmd CamBoard pico flexx: 60 and 80 MHz.
        CameraModel(
            name="pico-flexx",
            camera=BrownConrady(224, 171, 211.8, 211.8, 117.6, 87.2, k1=0.36, k2=-3.4, k3=6.4),
            modulation_hz=80_320_000.0,
            unwrap_hz=20_080_000.0,
            frame_rate_hz=45.0,
            integration_s=0.012,
            depth_unit_m=0.00025,
            signal_electrons=7_000.0,
            read_noise_electrons=30.0,
            full_well_electrons=90_000.0,
            ambient_electrons=800.0,
            minimum_amplitude=3.0,
            confidence_thresholds=(6.0, 12.0, 25.0),
            readout_delay_m=0.008,
            pixel_delay_m=0.002,
        ),
        # ifm O3R, 3D head with 60 x 45 degrees.
        CameraModel(
            name="ifm-o3r",
            camera=BrownConrady(224, 172, 186.0, 186.0, 111.5, 85.5, k1=-0.25, k2=0.07),
            modulation_hz=80e6,
            unwrap_hz=10e6,
            frame_rate_hz=20.0,
            integration_s=0.015,
            depth_unit_m=1.52587890625e-4,
            depth_kind="range",
            signal_electrons=30_000.0,
            read_noise_electrons=40.0,
            full_well_electrons=300_000.0,
            minimum_amplitude=6.0,
            reports_noise=True,
            readout_delay_m=0.008,
            pixel_delay_m=0.002,
        ),
    )
}


def camera_model(name: str) -> CameraModel:
    """Return the camera called `name`.

    Raises
    ------
    InputError
        If there is none.
    """
    check_camera(name, [*CAMERAS])
    return CAMERAS[name]


def check_camera(name: str, names: Sequence[str]) -> None:
    """Raise InputError unless there is a camera called `name`."""
    if name not in names:
        choices = ", ".join(names)
        raise InputError(
            f"there is no camera called {name!r}", where="--camera", remedy=f"use one of {choices}"
        )


def noise_of(model: CameraModel) -> NoiseModel:
    """Derive the noise model of a modulated camera from its electronics.

    From the phasor ``((D_0 - D_2) + i (D_1 - D_3)) / 2`` of bucket differences D, each with the
    variance of its electrons: ``sigma_phase^2 = (S / m + E + 2 R^2) / (2 S^2)`` for amplitude
    S, contrast m, ambient electrons E and read noise R; ``sigma_r = sigma_phase period / (2 pi)``.
    The law over the range alone is that of a grey wall (albedo 0.4).
    """
    per_rad, gain = model.period_m / (2 * math.pi), model.counts_per_electron
    ambient = _TYPICAL_AMBIENT * model.ambient_electrons
    dark_electrons2 = (2 * model.read_noise_electrons**2 + ambient) / 2
    shot = per_rad * math.sqrt(gain / (2 * model.modulation_contrast))
    dark = per_rad * gain * math.sqrt(dark_electrons2)
    falloff = model.falloff if model.amplitude_kind == "range_compensated" else 0.0
    wall = 0.4 * model.signal_electrons * model.modulation_contrast * gain
    return NoiseModel(
        model.name,
        RangeLaw(0.5 * shot / math.sqrt(wall), dark / wall + 0.5 * shot / math.sqrt(wall)),
        AmplitudeLaw(shot, dark, model.depth_unit_m / math.sqrt(12), falloff),
        ceiling_m=model.ambiguity_m / math.sqrt(12),
    )
