"""Whole reconstructions of recordings with few pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.mapping.adaptation import adapted
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.engine.quality.trajectory_errors import evaluate_trajectory
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import camera_model
from tofuse.lab.simulation.render import render
from tofuse.lab.world.scene import FRAME_RATE_HZ, build

WIDTH, HEIGHT = 54, 42


@pytest.fixture(scope="module")
def recording() -> Recording:
    """A furnished room, with raw amplitude that falls off towards the corners."""
    f = WIDTH / 2 / np.tan(np.radians(30))
    camera = Pinhole(WIDTH, HEIGHT, f, f, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    model = replace(camera_model("ifm-o3r"), name="coarse", camera=camera)
    scene, path = build("room", texture=True)
    effects = Effects.none(shot_noise=True)
    frames = [render(scene, path, model, k, effects=effects).frame for k in range(0, 120, 3)]
    times = np.arange(0, 120, 3) / FRAME_RATE_HZ
    frames = [
        replace(frame, index=n, timestamp=t)
        for n, (frame, t) in enumerate(zip(frames, times, strict=True))
    ]
    poses = np.stack([path.T_world_camera(t, 0.0) for t in times])
    return Recording.of(ArraySource(tuple(frames), poses), "made", "arrays")


@pytest.mark.nightly
def test_few_pixels_are_tracked(recording):
    result = reconstruct(recording, "default", threads=1)
    assert all(frame.status == "tracked" for frame in result.diagnostics.frames)
    times = recording.timestamps
    error = evaluate_trajectory(times, result.trajectory, times, recording.reference)
    assert error.ate_rms_m < 0.015


def test_falloff_is_estimated_from_few_pixels(recording):
    config = adapted(from_method("default"), recording, threads=1)
    assert config.odometry.views.falloff == pytest.approx(4.0, abs=1.0)
