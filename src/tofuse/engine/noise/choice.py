"""Choice of a recording's noise model: from its folder, its camera family, or its frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.frames import NOISE_MODEL, RangeFrame, Recording
from tofuse.engine.noise.model import NOISE, AmplitudeLaw, NoiseModel
from tofuse.engine.normal import MEDIAN_OF_NORMAL

# Keywords in a sensor's name, in lower case, the more specific ones first.
_SENSOR_KEYWORDS = (
    (("sr4000", "swissranger"), "sr4000"),
    (("kinect v2", "kinect2", "kinectv2"), "kinect2"),
    (("azure",), "azure-nfov"),
    (("pico flexx", "pico-flexx", "picoflexx"), "pico-flexx"),
    (("zense",), "pico-zense"),
    (("o3r", "ifm"), "ifm-o3r"),
    (("iphone", "ipad", "arkit", "lidar"), "iphone"),
    (("kinect v1", "xtion", "primesense", "structured light", "kinect"), "kinect1"),
)
_SIZES = {
    (176, 144): "sr4000",
    (512, 424): "kinect2",
    (640, 576): "azure-nfov",
    (320, 288): "azure-nfov",
    (224, 171): "pico-flexx",
    (224, 172): "ifm-o3r",
    (256, 192): "iphone",
    (192, 256): "iphone",
}
_SAMPLED_FRAMES = 3
_MAX_RATIO = 3.0  # of observed to predicted noise


def noise_model_for(recording: Recording) -> NoiseModel:
    """Choose the noise model of a recording.

    One that came with the recording comes first, then the sensor's name, then the size of the
    images. Amplitude counts have no common unit: where the noise predicted from amplitude differs
    by more than a factor of three from that between neighbouring pixels, the amplitude law is
    rescaled by an unknown gain.
    """
    stored = recording.metadata.get(NOISE_MODEL)
    if isinstance(stored, NoiseModel):
        return stored
    frames = _sampled_frames(recording)
    model = NOISE[family_of(recording, frames[0] if frames else None)]
    if model.amplitude is None:
        return model
    frames = [f for f in frames if model.law(f) == "amplitude"]
    return _rescaled(model, model.amplitude, frames) if frames else model


def family_of(recording: Recording, frame: RangeFrame | None) -> str:
    """Return the name of the camera family in `NOISE`; "unknown" if it can't be determined."""
    sensor = str(recording.metadata.get("sensor", "")).lower()
    for keywords, family in _SENSOR_KEYWORDS:
        if any(keyword in sensor for keyword in keywords):
            return family
    if frame is None:
        return "unknown"
    family = _SIZES.get((frame.camera.width, frame.camera.height), "unknown")
    if family == "iphone" and frame.amplitude_image is not None:
        return "unknown"  # iPhones have no amplitude
    return family


def _sampled_frames(recording: Recording) -> list[RangeFrame]:
    positions = np.unique(np.linspace(0, len(recording) - 1, _SAMPLED_FRAMES).astype(int))
    images = (recording.image(int(k)) for k in positions)
    return [image for image in images if image is not None and len(image)]


def _rescaled(model: NoiseModel, law: AmplitudeLaw, frames: list[RangeFrame]) -> NoiseModel:
    """The model with the gain of its amplitude law adjusted to the noise of the frames."""

    def excess(gain: float) -> float:
        """Log ratio of observed to predicted noise, if counts are `gain` times those of the law."""
        scaled = replace(law, shot=law.shot * gain**0.5, dark=law.dark * gain)
        return _log_excess(replace(model, amplitude=scaled), frames)

    mismatch = excess(1.0)
    if not np.isfinite(mismatch) or abs(mismatch) <= np.log(_MAX_RATIO):
        return model
    low, high = 1e-4, 1e4
    for _ in range(30):
        gain = float(np.sqrt(low * high))
        low, high = (gain, high) if excess(gain) > 0 else (low, gain)
    return replace(model, amplitude=replace(law, shot=law.shot * gain**0.5, dark=law.dark * gain))


def _log_excess(model: NoiseModel, frames: list[RangeFrame]) -> float:
    """Median log ratio of the noise in second differences along rows to that of the model."""
    ratios_by_frame = []
    for frame in frames:
        values, valid = frame.radial_range.astype(float), frame.valid
        second = values[:, :-2] - 2 * values[:, 1:-1] + values[:, 2:]
        # Variance of the second difference: 1 + 4 + 1.
        expected = model.sigma(frame).astype(float)[:, 1:-1] * np.sqrt(6.0)
        usable = valid[:, :-2] & valid[:, 1:-1] & valid[:, 2:] & (expected > 0)
        ratios_by_frame.append(np.abs(second[usable]) / expected[usable])
    ratios: Float64 = np.concatenate(ratios_by_frame) if ratios_by_frame else np.empty(0)
    if len(ratios) < 200 or not (median := float(np.median(ratios))) > 0:
        return float("nan")
    return float(np.log(median / MEDIAN_OF_NORMAL))
