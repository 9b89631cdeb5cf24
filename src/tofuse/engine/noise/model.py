"""Noise models of cameras: the standard deviation of the range of each pixel.

The phase of a modulated camera is the angle of a phasor of amplitude A, whose two components have
the same noise: shot noise of the signal, which grows as the root of A, and noise that doesn't
depend on the signal (ambient light, read-out). The ratio of noise and amplitude gives

    sigma_r^2 = floor^2 + shot^2 / A + dark^2 / A^2,    A in raw counts

(Lange 2000, ch. 4; the usual "noise over amplitude" is its last term). On a surface of one albedo
A falls as 1/r^2, so that sigma grows as r^2 in the dark limit. Cameras that don't give their
amplitude are described by a table over their levels of confidence, or over the range alone,
``sigma_r = a + b r^2``, which is also the law of triangulating cameras (Khoshelham 2011).

The model of a recording comes from its folder, its camera family, or its frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Annotated, Any, Literal, Self

import numpy as np

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.bounds import Bounded, Bounds, NotEmpty
from tofuse.engine.cameras import ray_lengths
from tofuse.engine.compute import run_chunks
from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame, Recording
from tofuse.engine.noise import noise_kernels as kernels
from tofuse.engine.normal import MEDIAN_OF_NORMAL
from tofuse.engine.parts import from_dict, to_dict

Law = Literal["range", "amplitude", "confidence", "camera"]

# Key of a source's metadata: the model that came with the recording.
NOISE_MODEL = "noise_model"
SCHEMA = 1
_CODES = {
    "range": kernels.BY_RANGE,
    "amplitude": kernels.BY_AMPLITUDE,
    "confidence": kernels.BY_CONFIDENCE,
    "camera": kernels.BY_CAMERA,
}
# Maximum sigma in m; larger values are probably in millimetres.
_MAX_SIGMA_M = 5.0
_NO_IMAGE = np.empty((0, 0), np.float32)


@dataclass(frozen=True)
class AmplitudeLaw(Bounded):
    """``sigma^2 = floor^2 + shot^2 / A + dark^2 / A^2`` over the raw amplitude A in counts.

    Attributes
    ----------
    shot
        m times the root of a count: shot noise of the signal.
    dark
        m times a count: noise that doesn't depend on the signal.
    floor
        m: noise that doesn't decrease with the amplitude (rounding, jitter).
    falloff
        Exponent of the cosine to the optical axis by which range-compensated amplitude was divided.
    """

    shot: Annotated[float, Bounds(0)]
    dark: Annotated[float, Bounds(0)]
    floor: Annotated[float, Bounds(0, _MAX_SIGMA_M)] = 0.0
    falloff: Annotated[float, Bounds(0)] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shot == 0 and self.dark == 0:
            raise ValueError("shot and dark are both 0: set at least one")


@dataclass(frozen=True)
class ConfidenceLaw(Bounded):
    """``sigma = sigma_m[level] * r^power``, with a table over the levels of confidence.

    Attributes
    ----------
    sigma_m
        In m, at 1 m, for the levels 0, 1, ...; must not increase. Higher levels use the last value.
    power
        Exponent of the range; 0 if sigma depends on the level only.
    """

    sigma_m: Annotated[tuple[float, ...], NotEmpty()]
    power: Annotated[float, Bounds(0, 4)] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for value in self.sigma_m:
            if value not in Bounds(0, _MAX_SIGMA_M):
                raise ValueError(f"sigma_m must be {Bounds(0, _MAX_SIGMA_M)}, not {value!r}")
        if any(b > a for a, b in zip(self.sigma_m, self.sigma_m[1:], strict=False)):
            raise ValueError("sigma_m grows with confidence: higher levels must be better")


@dataclass(frozen=True)
class RangeLaw(Bounded):
    """``sigma = a + b r^2`` over the radial range r; `a` in m, `b` in 1/m."""

    a: Annotated[float, Bounds(0, _MAX_SIGMA_M)]
    b: Annotated[float, Bounds(0, 1)]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.a == 0 and self.b == 0:
            raise ValueError("a and b are both 0: set at least one")


@dataclass(frozen=True)
class NoiseModel(Bounded):
    """Standard deviation of the radial range of one camera, in m.

    A frame with a sigma stated by the camera keeps it. Otherwise the first law applies that the
    model contains and whose channel the frame has: amplitude, confidence, range.

    Attributes
    ----------
    name
        Of the camera.
    range
        Required, for frames with depth only.
    amplitude, confidence
        Or None.
    ceiling_m
        Sigma of a pixel without signal: the ambiguity range divided by the root of 12. Applies to
        pixels without amplitude, and to saturated ones.
    footprint
        Noise due to the change of range of an oblique surface within a pixel, as a fraction of this
        change, if the incidence is known; 0.29 for a uniform distribution.
    """

    name: str
    range: RangeLaw
    amplitude: AmplitudeLaw | None = None
    confidence: ConfidenceLaw | None = None
    ceiling_m: Annotated[float, Bounds(0, 100, exclusive=True)] = 1.0
    footprint: Annotated[float, Bounds(0, 1)] = 0.29

    def law(self, frame: RangeFrame) -> Law:
        """Return the law that applies to a frame; "camera" if it states its own sigma."""
        if frame.sigma_image is not None:
            return "camera"
        if self.amplitude is not None and frame.amplitude_image is not None:
            return "amplitude"
        if self.confidence is not None and frame.confidence_image is not None:
            return "confidence"
        return "range"

    def sigma(self, frame: RangeFrame) -> Float32:
        """Return the standard deviation (H, W) float32 in m of the radial range; 0 where invalid.

        Without normals, perpendicular incidence is assumed.
        """
        law = self.law(frame)
        channel: Float32 | None = None
        if law == "camera":
            channel = frame.sigma_image
        elif law == "amplitude":
            channel = frame.amplitude_image
        elif law == "confidence" and frame.confidence_image is not None:
            channel = frame.confidence_image.astype(np.float32)
        cosine = incidence_cosine(frame)
        out = np.empty(frame.depth.shape, np.float32)
        channel_image = _NO_IMAGE if channel is None else np.asarray(channel, np.float32)
        cosine_image = _NO_IMAGE if cosine is None else cosine
        depth, rays = np.asarray(frame.depth, np.float32), frame.camera.rays()
        parameters, levels = self._parameters(), self._levels()
        code, compensated = _CODES[law], frame.amplitude_kind == "range_compensated"

        def rows(start: int, stop: int) -> None:
            kernels.range_sigma(
                depth, frame.depth_kind == "range", rays, code, channel_image, compensated,
                levels, cosine_image, parameters, start, stop, out,
            )  # fmt: skip

        run_chunks(rows, len(out))
        return out

    def _parameters(self) -> Float64:
        law = self.amplitude or AmplitudeLaw(1.0, 0.0)
        power = 0.0 if self.confidence is None else self.confidence.power
        return np.array(
            [self.ceiling_m, law.floor, law.shot, law.dark, law.falloff,
             self.range.a, self.range.b, power, self.footprint]
        )  # fmt: skip

    def _levels(self) -> Float64:
        return np.array((0.0,) if self.confidence is None else self.confidence.sigma_m, float)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of noise.json."""
        out: dict[str, Any] = {"schema": SCHEMA, **to_dict(self)}
        return {key: value for key, value in out.items() if value is not None}

    @classmethod
    def from_dict(cls, data: Any, *, where: str = "noise") -> Self:
        """Build a model from the content of noise.json.

        Raises
        ------
        InputError
            Naming the field, for invalid content.
        """
        if not isinstance(data, dict):
            raise InputError("contains no JSON object", where=where, remedy="write {...}")
        data = dict(data)
        schema = data.pop("schema", None)
        if schema != SCHEMA or isinstance(schema, bool):
            raise InputError(
                f"is {schema!r}" if schema is not None else "is missing",
                where=f"{where}: schema",
                remedy=f"write {SCHEMA}, the only version there is",
            )
        model: Self = from_dict(cls, data, where=where)
        _check_finite(model, where)
        return model


def incidence_cosine(frame: RangeFrame) -> Float32 | None:
    """Return the cosine (H, W) between ray and normal, NaN where unknown; None without normals."""
    normals = frame.normal_image
    if normals is None:
        return None
    rays = frame.camera.rays()
    dot = normals[..., 0] * rays[..., 0] + normals[..., 1] * rays[..., 1] + normals[..., 2]
    return (np.abs(dot) / ray_lengths(frame.camera)).astype(np.float32)


def _check_finite(model: Any, where: str) -> None:
    for field in fields(model):
        value = getattr(model, field.name)
        if is_dataclass(value):
            _check_finite(value, f"{where}.{field.name}")
        elif isinstance(value, float) and not math.isfinite(value):
            raise InputError(f"is {value}", where=f"{where}.{field.name}", remedy="use a number")


# Noise of each family of cameras. That of the first five follows from their electronics, by
# `tofuse.lab.simulation.models.noise_of` (a test compares them): the SR4000's is fitted to a real
# recording, the others have the scale stated by their makers. docs/noise.md states the sources of
# the other numbers.
# Name, a, b, shot, dark, floor and ceiling_m.
_MODULATED = (
    ("kinect2", 0.0006945997474067945, 0.0012238444427074412,
     0.05964181449046179, 0.975503822378152, 5.7735026918962585e-05, 5.4089142602287374),
    ("azure-nfov", 0.0005893874299221687, 0.0008695790154781212,
     0.02385672579618471, 0.11476647344371813, 0.0002886751345948129, 2.884754272121993),
    ("pico-flexx", 0.002480693695628617, 0.00658911277394305,
     0.05940419769966313, 0.5889829590671571, 7.216878364870322e-05, 2.1549459204098556),
    ("ifm-o3r", 0.0012030820534330766, 0.0024885608246149353,
     0.05964181449046179, 0.7897981570141338, 4.4048329863710466e-05, 4.32713140818299),
)  # fmt: skip
NOISE: dict[str, NoiseModel] = {
    model.name: model
    for model in (
        NoiseModel(
            "sr4000",
            RangeLaw(a=0.0021324099655231693, b=0.00382317908289003),
            AmplitudeLaw(0.15915494309189537, 2.3546327036097847, 2.8867513459481293e-05, 4.0),
            ConfidenceLaw((0.6, 0.20, 0.13, 0.094, 0.062, 0.041, 0.028, 0.016)),
            ceiling_m=1.4433756729740645,
        ),
        *(
            NoiseModel(name, RangeLaw(a, b), AmplitudeLaw(*law), ceiling_m=ceiling)
            for name, a, b, *law, ceiling in _MODULATED
        ),
        NoiseModel("pico-zense", RangeLaw(0.0, 0.013)),
        NoiseModel(
            "iphone", RangeLaw(0.003, 0.0012), confidence=ConfidenceLaw((0.04, 0.015, 0.005), 1.0)
        ),
        NoiseModel("kinect1", RangeLaw(0.0005, 0.001425)),
        NoiseModel("unknown", RangeLaw(0.003, 0.003)),
    )
}


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
