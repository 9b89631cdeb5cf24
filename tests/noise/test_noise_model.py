"""Noise models: the physics of amplitude, tables over confidence, JSON, and invalid models."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from paths import DOCS
from tofuse.engine.cameras.cameras import Pinhole, ray_lengths
from tofuse.engine.errors import InputError
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry.rays import homogeneous
from tofuse.engine.noise.model import NOISE, AmplitudeLaw, ConfidenceLaw, NoiseModel, RangeLaw
from tofuse.formats.cameras.calibration_files import read_noise, write_noise

CAMERA = Pinhole(40, 30, 30.0, 30.0, 19.5, 14.5)
DARK = NoiseModel("dark", RangeLaw(0.01, 0.0), AmplitudeLaw(0.0, 2.0), ceiling_m=10.0)


def image(value: float | np.ndarray) -> np.ndarray:
    return np.broadcast_to(np.asarray(value, np.float32), (30, 40)).copy()


def frame(depth: float | np.ndarray = 2.0, **channels: object) -> RangeFrame:
    return RangeFrame(0, 0.0, CAMERA, image(depth), "range", **channels)  # type: ignore[arg-type]


def test_noise_is_inversely_proportional_to_amplitude() -> None:
    amplitudes = np.geomspace(10, 1000, 40)
    sigma = DARK.sigma(frame(amplitude_image=image(amplitudes)))
    np.testing.assert_allclose(sigma * amplitudes, 2.0, rtol=1e-6)


def test_shot_noise_falls_with_square_root_of_amplitude() -> None:
    model = replace(DARK, amplitude=AmplitudeLaw(0.5, 0.0))
    amplitudes = np.geomspace(10, 1000, 40)
    sigma = model.sigma(frame(amplitude_image=image(amplitudes)))
    np.testing.assert_allclose(sigma * np.sqrt(amplitudes), 0.5, rtol=1e-6)


@pytest.mark.parametrize("kind", ["raw", "range_compensated"])
def test_noise_of_constant_albedo_grows_with_squared_range(kind: str) -> None:
    ranges = np.linspace(1, 5, 40)
    amplitude = 500.0 / ranges**2 if kind == "raw" else np.full(40, 500.0)
    seen = frame(ranges, amplitude_image=image(amplitude), amplitude_kind=kind)
    np.testing.assert_allclose(DARK.sigma(seen)[0] / ranges**2, 2.0 / 500.0, rtol=1e-5)


@pytest.mark.parametrize("power", [0.0, 3.0, 4.0])
def test_compensated_amplitude_excludes_falloff(power: float) -> None:
    model = replace(DARK, amplitude=AmplitudeLaw(0.0, 2.0, falloff=power))
    seen = frame(amplitude_image=image(500.0), amplitude_kind="range_compensated")
    expected = 2.0 * 4.0 / 500.0 * ray_lengths(CAMERA) ** power
    np.testing.assert_allclose(model.sigma(seen), expected, rtol=1e-5)
    raw = frame(amplitude_image=image(500.0))
    np.testing.assert_allclose(model.sigma(raw), 2.0 / 500.0, rtol=1e-5)


def test_confidence_is_monotone_and_saturates_at_last_level() -> None:
    model = NoiseModel("table", RangeLaw(1.0, 0.0), confidence=ConfidenceLaw((0.3, 0.1, 0.03), 1.0))
    levels = np.broadcast_to(np.arange(40, dtype=np.uint8), (30, 40))
    sigma = model.sigma(frame(2.0, confidence_image=levels))
    assert (np.diff(sigma[0]) <= 0).all()
    np.testing.assert_allclose(sigma[0, :5], [0.6, 0.2, 0.06, 0.06, 0.06], rtol=1e-6)


def test_noise_of_every_family_is_monotone() -> None:
    for model in NOISE.values():
        plain = model.sigma(frame(np.linspace(0.5, 6, 40)))
        assert (np.diff(plain[0]) > 0).all()
        assert 0.0002 < plain[0, 5] < 0.1
        light = model.sigma(frame(2.0, amplitude_image=image(np.geomspace(1, 5000, 40))))
        assert (np.diff(light[0]) <= 0).all()
        levels = np.broadcast_to(np.arange(40, dtype=np.uint8) // 6, (30, 40))
        assert (np.diff(model.sigma(frame(2.0, confidence_image=levels))[0]) <= 0).all()


def test_precedence_of_laws() -> None:
    model = replace(NOISE["sr4000"], name="x")
    full = frame(
        amplitude_image=image(300.0),
        confidence_image=np.full((30, 40), 5, np.uint8),
        sigma_image=image(0.123),
    )
    assert model.law(full) == "camera"
    np.testing.assert_allclose(model.sigma(full), 0.123, rtol=1e-3)
    assert model.law(replace(full, sigma_image=None)) == "amplitude"
    assert model.law(replace(full, sigma_image=None, amplitude_image=None)) == "confidence"
    assert model.law(frame()) == "range"


def test_invalid_pixels_have_no_sigma() -> None:
    depth = image(2.0)
    depth[3, 4] = 0
    sigma = DARK.sigma(frame(depth))
    assert sigma.dtype == np.float32
    assert sigma[3, 4] == 0
    assert (sigma > 0).sum() == sigma.size - 1


def test_z_images_have_noise_of_their_range() -> None:
    seen = frame(2.0 + np.arange(40) / 40)
    as_z = RangeFrame(0, 0.0, CAMERA, seen.z, "z")
    model = NOISE["unknown"]
    np.testing.assert_allclose(model.sigma(as_z), model.sigma(seen), rtol=1e-5)


def test_tilted_wall_is_noisier_by_change_within_pixel() -> None:
    # z = d / (n . ray) for a plane at 60 degrees: the exact change to the next pixel.
    normal = np.array([np.sin(np.pi / 3), 0.0, -np.cos(np.pi / 3)])
    rays = homogeneous(CAMERA.rays())
    z = (-2.0 / (rays @ normal)).astype(np.float32)
    z[z < 0] = 0
    normals = np.broadcast_to(normal.astype(np.float32), (30, 40, 3))
    seen = RangeFrame(0, 0.0, CAMERA, z, "z", normal_image=normals)
    model = NoiseModel("flat", RangeLaw(1e-6, 0.0), footprint=0.29)
    sigma = model.sigma(seen)[15, 15:25]
    distance = np.linalg.norm(seen.point_image[15], axis=-1)
    change = np.abs(np.gradient(distance))[15:25]
    # The step to the neighbour is perpendicular to the ray: within the obliqueness of these rays.
    np.testing.assert_allclose(sigma, 0.29 * change, rtol=0.12)
    unknown = np.full_like(normals, np.nan)
    assert (model.sigma(replace(seen, normal_image=unknown)) < 1e-5).all()
    assert (model.sigma(replace(seen, normal_image=None)) < 1e-5).all()


def test_json_round_trip(tmp_path: Path) -> None:
    for model in NOISE.values():
        write_noise(tmp_path / "noise.json", model)
        assert read_noise(tmp_path / "noise.json") == model


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": 2}, "schema: is 2"),
        ({"range": {"a": 5.2e3, "b": 0.0}}, "a must be 0 to 5, not 5200.0"),
        ({"range": {"a": float("nan"), "b": 0.0}}, "a must be 0 to 5, not nan"),
        ({"confidence": {"sigma_m": [0.1, 0.2]}}, "grows with confidence"),
        ({"confidence": {"sigma_m": []}}, "sigma_m must be non-empty, not ()"),
        ({"amplitude": {"shot": 0, "dark": 0}}, "both 0"),
        ({"amplitude": {"shot": "loud", "dark": 0}}, "is 'loud'"),
        ({"loudness": 1}, "unknown option 'loudness'"),
        ({"range": None}, "range"),
    ],
)
def test_invalid_values_are_refused_by_name(tmp_path: Path, change: dict, message: str) -> None:
    path = tmp_path / "noise.json"
    path.write_text(json.dumps({**NOISE["sr4000"].to_dict(), **change}))
    with pytest.raises(InputError, match=r"noise\.json") as caught:
        read_noise(path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[1]", "null", "[" * 100_000])
def test_invalid_files(tmp_path: Path, text: str) -> None:
    (tmp_path / "noise.json").write_text(text)
    with pytest.raises(InputError, match=r"noise\.json"):
        read_noise(tmp_path / "noise.json")


def test_documented_file_is_valid() -> None:
    (block,) = re.findall(r"```json\n(.*?)```", (DOCS / "noise.md").read_text(), re.DOTALL)
    assert NoiseModel.from_dict(json.loads(block)).name == "mine"
