"""The Cramér-Rao bound of a recording: its noise model, and its dependence on the scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.lab.experiments.recording_bound import phase_noise, trajectory_bounds
from tofuse.lab.simulation import sensor
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import camera_model
from tofuse.lab.simulation.record import plan

NOISE = Effects.none(shot_noise=True, ambient=1.0)


def test_phase_noise_matches_simulated_camera():
    """Range and log amplitude of one light, measured many times."""
    model = replace(camera_model("sr4000"))
    light, albedo, turn, ambient = 0.15, 0.6, 1.1, 0.4
    shape = (model.camera.height, model.camera.width)
    signal = light * model.transmission
    taps = np.arange(sensor.TAPS)[:, None, None]
    exposure = sensor.Exposure(
        (signal * np.cos(turn - taps * np.pi / 2))[None],
        np.broadcast_to(signal, (1, sensor.TAPS, *shape)),
        ambient * albedo * np.sqrt(model.transmission),
    )
    rng = np.random.default_rng(0)
    many = [sensor.expose(model, NOISE, exposure, rng) for _ in range(40)]
    expected = phase_noise(model, np.full(shape, light), np.full(shape, albedo), NOISE, ambient)
    per_m = 2 * np.pi / model.period_m
    ranges = np.std([m.range_m for m in many], axis=0, ddof=1) * per_m
    levels = np.std([np.log(m.amplitude) for m in many], axis=0, ddof=1)
    assert np.mean(ranges / expected) == pytest.approx(1, abs=0.02)
    assert np.mean(levels / expected) == pytest.approx(1, abs=0.02)


def test_albedo_and_light_lower_the_bound():
    made = plan("room", effects=NOISE, frames=4)
    distances, both = trajectory_bounds(made, every=4)
    assert 0 < both.mean < distances.mean
    assert both.low < both.mean < both.high
    brighter = replace(
        made, model=replace(made.model, signal_electrons=4 * made.model.signal_electrons)
    )
    assert trajectory_bounds(brighter, every=4)[0].mean < 0.55 * distances.mean
