"""The falloff of amplitude towards the corners is estimated from the recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.geometry.cameras import ray_lengths
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.render import render
from tofuse.lab.simulation.scene import build
from tofuse.pipeline.adaptation import adapted
from tofuse.pipeline.config import from_method
from tofuse.pipeline.falloff import estimate_falloff
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.recording import ArraySource, Recording
from tofuse.registration.prepared_view import SurfaceOptions, prepare_view
from tofuse.registration.projective import ProjectiveOptions, Target, align
from tofuse.sensor.models import camera_model


@pytest.fixture(scope="module")
def frames() -> list[RangeFrame]:
    scene, path = build("room", texture=True)
    effects = Effects.none(shot_noise=True)
    model = camera_model("sr4000")
    taken = [render(scene, path, model, k, effects=effects).frame for k in range(0, 48, 2)]
    return [replace(frame, index=n, timestamp=n / 15) for n, frame in enumerate(taken)]


@pytest.fixture(scope="module")
def wall() -> list[RangeFrame]:
    """Along a wall with pictures on it, which only light tells from standing still."""
    scene, path = build("wall", texture=True)
    effects = Effects.none(shot_noise=True)
    model = camera_model("sr4000")
    taken = [render(scene, path, model, k, effects=effects).frame for k in range(0, 48, 2)]
    return [replace(frame, index=n, timestamp=n / 15) for n, frame in enumerate(taken)]


def recording(frames: list[RangeFrame], exponent: float) -> Recording:
    fallen = []
    for frame in frames:
        assert frame.amplitude_image is not None
        light = frame.amplitude_image / ray_lengths(frame.camera) ** exponent
        fallen.append(replace(frame, amplitude_image=light.astype(np.float32)))
    source = ArraySource(tuple(fallen))
    return Recording.of(source, "made", "arrays")


@pytest.mark.parametrize("exponent", [-3.0, 2.0, 5.0])
def test_it_is_found_whatever_it_is(frames, exponent):
    plain = estimate_falloff(recording(frames, 0.0), lambda f: f, SurfaceOptions())
    found = estimate_falloff(recording(frames, exponent), lambda f: f, SurfaceOptions())
    assert abs(plain) < 0.5
    assert found == pytest.approx(exponent, abs=0.6)


def test_it_becomes_part_of_the_configuration_once(frames):
    config = adapted(from_method("default"), recording(frames, 5.0), threads=1)
    assert config.odometry.views.falloff == pytest.approx(5.0, abs=0.6)
    # What is given is taken.
    views = replace(config.odometry.views, falloff=1.0)
    given = replace(config, odometry=replace(config.odometry, views=views))
    assert adapted(given, recording(frames, 5.0), threads=1).odometry.views.falloff == 1.0


def test_a_recording_without_amplitude_or_motion_shows_none(frames):
    still = [replace(frames[0], index=k, timestamp=k / 15) for k in range(24)]
    assert estimate_falloff(recording(still, 4.0), lambda f: f, SurfaceOptions()) == 0.0
    dark = [replace(frame, amplitude_image=None) for frame in frames]
    source = ArraySource(tuple(dark))
    config = adapted(from_method("default"), Recording.of(source, "made", "arrays"), threads=1)
    assert config.odometry.views.falloff == 0.0


@pytest.mark.parametrize("exponent", [0.0, 4.0])
def test_light_helps_where_geometry_does_not_tell_the_motion(wall, exponent):
    given = recording(wall, exponent)
    views = [prepare_view(frame, SurfaceOptions(falloff=0.0)) for frame in given]
    by_shape = replace(ProjectiveOptions(), photometric=False)
    assert len(align(views[4], [Target(views[0], np.eye(4))], np.eye(4), by_shape).unobservable)
    found = estimate_falloff(given, lambda f: f, SurfaceOptions())
    assert found == pytest.approx(exponent, abs=0.6)


def test_a_few_pairs_are_enough(frames):
    few = recording(frames[:4], 4.0)
    assert estimate_falloff(few, lambda f: f, SurfaceOptions()) == pytest.approx(4.0, abs=0.6)
