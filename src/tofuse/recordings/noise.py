"""Which noise model a recording has: its own file, its camera's family, or what its frames show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import UnreadableFrameError
from tofuse.files.reading import is_file, is_folder
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.recording import Recording
from tofuse.sensor.noise import NOISE, AmplitudeLaw, NoiseModel

# Words of a sensor's name, in lower case, the more telling ones first.
_WORDS = (
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
# Formats that only one family of cameras writes.
_FORMATS = {"7scenes": "kinect1", "redwood": "kinect1", "tum": "kinect1"}
_LOOKED_AT = 3
_BELIEVED = 3.0
_NORMAL_MEDIAN = 0.6745


def noise_model_for(recording: Recording) -> NoiseModel:
    """Choose the noise model of a recording.

    A noise.json beside its images comes first, then the sensor's name, the format, the size of
    the images. Counts of amplitude have no unit that all programs share: where the law over the
    amplitude is wrong by more than three times what neighbouring pixels show, the counts are
    taken to have another gain, and the law is rescaled.

    Raises
    ------
    InputError
        If there is a noise.json that makes no sense.
    """
    given = _beside(recording)
    if given is not None:
        return given
    frames = _some_frames(recording)
    model = NOISE[family_of(recording, frames[0] if frames else None)]
    if model.amplitude is None:
        return model
    frames = [f for f in frames if model.law(f) == "amplitude"]
    return _regained(model, model.amplitude, frames) if frames else model


def family_of(recording: Recording, frame: RangeFrame | None) -> str:
    """Return the name in `NOISE` that fits best; "unknown" if nothing tells."""
    sensor = str(recording.metadata.get("sensor", "")).lower()
    for words, family in _WORDS:
        if any(word in sensor for word in words):
            return family
    if recording.format in _FORMATS:
        return _FORMATS[recording.format]
    if frame is None:
        return "unknown"
    family = _SIZES.get((frame.camera.width, frame.camera.height), "unknown")
    if family == "iphone" and frame.amplitude_image is not None:
        return "unknown"  # an iPhone gives no amplitude
    return family


def _beside(recording: Recording) -> NoiseModel | None:
    folder = Path(recording.path)
    if is_folder(folder) and is_file(folder / "noise.json"):
        return NoiseModel.load(folder / "noise.json")
    return None


def _some_frames(recording: Recording) -> list[RangeFrame]:
    chosen = np.unique(np.linspace(0, len(recording) - 1, _LOOKED_AT).astype(int))
    frames = []
    for k in chosen:
        try:
            frame = recording[int(k)]
        except UnreadableFrameError:
            continue
        if isinstance(frame, RangeFrame) and len(frame):
            frames.append(frame)
    return frames


def _regained(model: NoiseModel, law: AmplitudeLaw, frames: list[RangeFrame]) -> NoiseModel:
    """Rescale the counts of the law where the frames' own noise says that they are others."""

    def excess(gain: float) -> float:
        """Log of seen over predicted noise, if all counts are `gain` times those of the law."""
        scaled = replace(law, shot=law.shot * gain**0.5, dark=law.dark * gain)
        return _log_excess(replace(model, amplitude=scaled), frames)

    wrong = excess(1.0)
    if not np.isfinite(wrong) or abs(wrong) <= np.log(_BELIEVED):
        return model
    low, high = 1e-4, 1e4
    for _ in range(30):
        gain = float(np.sqrt(low * high))
        low, high = (gain, high) if excess(gain) > 0 else (low, gain)
    return replace(model, amplitude=replace(law, shot=law.shot * gain**0.5, dark=law.dark * gain))


def _log_excess(model: NoiseModel, frames: list[RangeFrame]) -> float:
    """Median log ratio of the noise that second differences along rows show to the model's."""
    found = []
    for frame in frames:
        values, ok = frame.radial_range.astype(float), frame.valid
        second = values[:, :-2] - 2 * values[:, 1:-1] + values[:, 2:]
        # Equal neighbours: variances 1, 4, 1.
        expected = model.sigma(frame).astype(float)[:, 1:-1] * np.sqrt(6.0)
        seen = ok[:, :-2] & ok[:, 1:-1] & ok[:, 2:] & (expected > 0)
        found.append(np.abs(second[seen]) / expected[seen])
    ratios: Float64 = np.concatenate(found) if found else np.empty(0)
    if len(ratios) < 200 or not (median := float(np.median(ratios))) > 0:
        return float("nan")
    return float(np.log(median / _NORMAL_MEDIAN))
