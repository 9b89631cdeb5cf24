"""A camera's noise from static recordings: simulated ones with known noise, and real ones."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from cli_calls import printed, refuses
from refused import refused
from tofuse.apps.calibration.noise_estimation import estimate_noise
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.frames.frames import CloudFrame, RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.noise.model import NOISE, NoiseModel, noise_model_for
from tofuse.formats.cameras.calibration_files import read_noise
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import camera_model
from tofuse.lab.simulation.record import simulate_recording
from tofuse.lab.simulation.render import render
from tofuse.lab.world.scene import build
from written import record

CAMERA = Pinhole(80, 60, 60.0, 60.0, 39.5, 29.5)


def recording_of(frames: list, **metadata: object) -> Recording:
    numbered = [replace(f, index=k, timestamp=k / 10) for k, f in enumerate(frames)]
    return Recording.of(ArraySource(numbered, metadata=dict(metadata)), "still", "simulated")


@cache
def still_frames(scene: str, camera: str, count: int, first_seed: int = 0) -> list[RangeFrame]:
    built, sequence = build(scene, seed=1)
    effects = Effects().without("multipath", "gloss", "mixed_pixels")
    return [
        render(built, sequence, camera_model(camera), 0, effects=effects, seed=k).frame
        for k in range(first_seed, first_seed + count)
    ]


@pytest.mark.nightly
@pytest.mark.parametrize(("scene", "camera"), [("corner", "sr4000"), ("wall", "pico-flexx")])
def test_static_recording_recovers_camera_noise(scene: str, camera: str) -> None:
    fit = estimate_noise(recording_of(still_frames(scene, camera, 8)))
    assert fit.law == "amplitude"
    assert fit.frames == 8
    assert fit.stretches == 1
    assert fit.rms_log_error < 0.1
    # Other frames of the same view, which the fit did not use.
    others = still_frames(scene, camera, 12, first_seed=100)
    variance = np.stack([f.radial_range for f in others]).var(0, ddof=1)
    valid = np.all([f.valid for f in others], 0)
    predicted = np.mean([fit.model.sigma(f).astype(float) ** 2 for f in others], 0)
    edges = np.quantile(predicted[valid], np.linspace(0, 1, 7))
    for low, high in itertools.pairwise(edges):
        inside = valid & (predicted >= low) & (predicted <= high)
        # 0.94: median of chi squared with 11 degrees of freedom, divided by 11.
        ratio = np.median(variance[inside] / predicted[inside]) / 0.94
        assert np.sqrt(ratio) == pytest.approx(1, abs=0.1)


def test_estimate_agrees_with_built_in_model() -> None:
    fit = estimate_noise(recording_of(still_frames("corner", "sr4000", 8)))
    frame = still_frames("corner", "sr4000", 1)[0]
    reliable = frame.valid & (NOISE["sr4000"].sigma(frame) < 0.2)
    ratio = fit.model.sigma(frame)[reliable] / NOISE["sr4000"].sigma(frame)[reliable]
    assert np.quantile(ratio, [0.05, 0.95]) == pytest.approx([1, 1], abs=0.15)


def plain_frames(
    sigma: np.ndarray, count: int = 12, confidence: np.ndarray | None = None
) -> list[RangeFrame]:
    """Depth alone, from 0.5 m on the left to 4 m on the right, with given noise."""
    rng = np.random.default_rng(5)
    r = np.broadcast_to(np.linspace(0.5, 4, 80), (60, 80))
    return [
        RangeFrame(
            k, 0.0, CAMERA, (r + sigma * rng.normal(size=r.shape)).astype(np.float32), "range",
            confidence_image=confidence,
        )
        for k in range(count)
    ]  # fmt: skip


def test_depth_alone_gives_range_law() -> None:
    r = np.broadcast_to(np.linspace(0.5, 4, 80), (60, 80))
    fit = estimate_noise(recording_of(plain_frames(0.002 + 0.003 * r**2)), "mine")
    assert fit.law == "range"
    assert fit.model.name == "mine"
    assert fit.model.range.a == pytest.approx(0.002, rel=0.15)
    assert fit.model.range.b == pytest.approx(0.003, rel=0.1)


def test_single_range_gives_conservative_law() -> None:
    frames = [
        replace(f, depth=np.float32(2) + (f.depth - np.linspace(0.5, 4, 80, dtype=np.float32)))
        for f in plain_frames(np.full((60, 80), 0.01))
    ]
    fit = estimate_noise(recording_of(frames))
    assert fit.model.range.a == 0
    assert fit.model.range.b * 4 == pytest.approx(0.01, rel=0.05)
    assert "extrapolated" in " ".join(fit.warnings)


def test_confidence_is_used_only_if_informative() -> None:
    levels = (np.arange(60)[:, None] // 15 + np.zeros(80, int)).astype(np.uint8)
    table = np.array([0.1, 0.05, 0.02, 0.01])
    fit = estimate_noise(recording_of(plain_frames(table[levels], confidence=levels)))
    assert fit.law == "confidence"
    assert fit.model.confidence is not None
    assert fit.model.confidence.power == 0
    np.testing.assert_allclose(fit.model.confidence.sigma_m, table, rtol=0.1)
    r = np.broadcast_to(np.linspace(0.5, 4, 80), (60, 80))
    empty = plain_frames(0.004 * r**2, confidence=np.zeros((60, 80), np.uint8))
    assert estimate_noise(recording_of(empty)).model.range.b == pytest.approx(0.004, rel=0.1)


def test_estimate_is_robust_to_flickering_edges() -> None:
    frames = plain_frames(0.003 * np.broadcast_to(np.linspace(0.5, 4, 80), (60, 80)) ** 2)
    rng = np.random.default_rng(8)
    edge = rng.random((60, 80)) < 0.08
    flicker = [
        replace(f, depth=np.where(edge & (rng.random((60, 80)) < 0.5), f.depth + 0.8, f.depth))
        for f in frames
    ]
    assert estimate_noise(recording_of(flicker)).model.range.b == pytest.approx(0.003, rel=0.15)


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (lambda: still_frames("corner", "sr4000", 8)[:2], "has 2 frames"),
        (lambda: still_frames("corner", "sr4000", 8)[:1] * 6, "repeats the same image"),
        (lambda: [CloudFrame.of(np.eye(3))] * 5, "contains clouds"),
        pytest.param(
            lambda: list(simulate_recording("room", every=3, frames=3)),
            "consecutive static frames",
            marks=pytest.mark.nightly,
        ),
        (
            lambda: [replace(f, depth=f.depth * 1000) for f in plain_frames(np.full(80, 0.01))],
            "check depth_unit_m",
        ),
        (
            lambda: [
                f.keep(np.indices((60, 80)).sum(0) < 12) for f in plain_frames(np.full(80, 0.01))
            ],
            "static",
        ),
    ],
)
def test_unsuitable_recordings_are_rejected(frames, message: str) -> None:
    with pytest.raises(InputError) as caught:
        estimate_noise(recording_of(frames()))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_noise_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    still = still_frames("corner", "sr4000", 8)[:4]
    seen = [replace(frame, timestamp=k / 30) for k, frame in enumerate(still)]
    record(tmp_path / "rec", seen, depth_unit_m=0.0001, amplitude_kind="range_compensated")
    out = tmp_path / "rec" / "noise.json"
    text = printed(capsys, "noise", tmp_path / "rec", "--out", out, "--name", "mine")
    assert "raw amplitude" in text
    assert "mine, 4 frames in 1 static segment" in text
    recording = open_recording(tmp_path / "rec")
    assert recording.warnings == []
    assert noise_model_for(recording) == read_noise(out)
    refuses(capsys, "noise", tmp_path / "rec", "--out", out, says="--overwrite")
    found = json.loads(printed(capsys, "noise", tmp_path / "rec", "--json"))
    assert NoiseModel.from_dict(found["model"]).amplitude == read_noise(out).amplitude
    out.write_text('{"schema": 1, "name": "x", "range": {"a": 20, "b": 0}}')
    refused("a must be 0 to 5", tmp_path / "rec")


@pytest.mark.parametrize("gain", [0.01, 30.0])
def test_amplitude_gain_mismatch_is_corrected(gain: float) -> None:
    frames = still_frames("wall", "pico-flexx", 8)
    other = [replace(f, amplitude_image=f.amplitude_image * np.float32(gain)) for f in frames]
    model = noise_model_for(recording_of(other))
    assert model.amplitude is not None
    right, wrong = NOISE["pico-flexx"].sigma(frames[0]), NOISE["pico-flexx"].sigma(other[0])
    seen = frames[0].valid
    assert not 0.5 < np.median(wrong[seen] / right[seen]) < 2
    assert np.median(model.sigma(other[0])[seen] / right[seen]) == pytest.approx(1, abs=0.15)


@pytest.mark.nightly
def test_real_sr4000_noise_agrees_with_data_description(shared_data: Path) -> None:
    fit = estimate_noise(open_recording(shared_data / "sr4000_corridor"))
    assert (fit.law, fit.stretches, fit.frames) == ("amplitude", 2, 8)
    assert fit.rms_log_error < 0.1
    # The error of the family's built-in model, which was not fitted to these bins.
    assert fit.rms_log_error_before < 0.15
    assert fit.model.confidence is not None
    # Medians of deviations of z over four frames, from the description of the data; the median
    # of chi with three degrees of freedom is 0.89 of the deviation.
    described = np.array([133, 92, 67, 46, 31, 22, 13.5]) / 1000
    ratio = 0.89 * np.array(fit.model.confidence.sigma_m)[1:] / described
    assert ((ratio > 0.8) & (ratio < 1.7)).all()
