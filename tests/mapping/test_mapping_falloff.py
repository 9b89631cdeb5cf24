"""The falloffs of amplitude and of colour are estimated from the recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.engine.alignment.projective import ProjectiveOptions, Target, align
from tofuse.engine.cameras.cameras import ray_lengths
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.mapping import falloff
from tofuse.engine.mapping.adaptation import adapted
from tofuse.engine.mapping.falloff import estimate_falloff
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import camera_model
from tofuse.lab.simulation.render import render
from tofuse.lab.world.scene import build


def rendered(scene: str, change=lambda path: path) -> list[RangeFrame]:
    """Frames along the path of a scene, or along another one."""
    built, path = build(scene, texture=True)
    path, model = change(path), camera_model("sr4000")
    effects = Effects.none(shot_noise=True)
    taken = [render(built, path, model, k, effects=effects).frame for k in range(0, 48, 2)]
    return [replace(frame, index=n, timestamp=n / 15) for n, frame in enumerate(taken)]


@pytest.fixture(scope="module")
def frames() -> list[RangeFrame]:
    return rendered("room")


@pytest.fixture(scope="module")
def forward() -> list[RangeFrame]:
    """Forward into a furnished room, so that ranges change."""

    def forwards(sequence):
        start, twist = sequence.T_room_camera(0.0), np.array([0.05, 0, 0.3, 0, 0.1, 0])
        return replace(sequence, camera_path=lambda t: start @ se3.exp(t * twist))

    return rendered("room", forwards)


@pytest.fixture(scope="module")
def wall() -> list[RangeFrame]:
    """Along a wall with pictures, where only amplitude shows the motion."""
    return rendered("wall")


def recording(frames: list[RangeFrame], exponent: float) -> Recording:
    fallen = []
    for frame in frames:
        assert frame.amplitude_image is not None
        light = frame.amplitude_image / ray_lengths(frame.camera) ** exponent
        fallen.append(replace(frame, amplitude_image=light.astype(np.float32)))
    return Recording.of(ArraySource(tuple(fallen)), "made", "arrays")


@pytest.mark.parametrize("exponent", [-3.0, 2.0, 5.0])
def test_falloff_is_estimated(frames, exponent):
    plain = estimate_falloff(recording(frames, 0.0), lambda f: f, SurfaceOptions())
    found = estimate_falloff(recording(frames, exponent), lambda f: f, SurfaceOptions())
    assert abs(plain) < 0.5
    assert found == pytest.approx(exponent, abs=0.6)


def test_estimated_falloff_enters_configuration_once(frames):
    config = adapted(from_method("default"), recording(frames, 5.0), threads=1)
    assert config.odometry.views.falloff == pytest.approx(5.0, abs=0.6)
    # A given value is kept.
    views = replace(config.odometry.views, falloff=1.0)
    given = replace(config, odometry=replace(config.odometry, views=views))
    assert adapted(given, recording(frames, 5.0), threads=1).odometry.views.falloff == 1.0


def test_no_falloff_without_amplitude_or_motion(frames):
    still = [replace(frames[0], index=k, timestamp=k / 15) for k in range(24)]
    assert estimate_falloff(recording(still, 4.0), lambda f: f, SurfaceOptions()) == 0.0
    dark = [replace(frame, amplitude_image=None) for frame in frames]
    source = ArraySource(tuple(dark))
    config = adapted(from_method("default"), Recording.of(source, "made", "arrays"), threads=1)
    assert config.odometry.views.falloff == 0.0


@pytest.mark.parametrize("exponent", [0.0, 4.0])
def test_falloff_is_estimated_where_geometry_is_degenerate(wall, exponent):
    given = recording(wall, exponent)
    views = [prepare_view(frame, SurfaceOptions(falloff=0.0)) for frame in given]
    by_shape = replace(ProjectiveOptions(), photometric=False)
    assert len(align(views[4], [Target(views[0], np.eye(4))], np.eye(4), by_shape).unobservable)
    found = estimate_falloff(given, lambda f: f, SurfaceOptions())
    assert found == pytest.approx(exponent, abs=0.6)


def test_few_pairs_suffice(frames):
    few = recording(frames[:4], 4.0)
    assert estimate_falloff(few, lambda f: f, SurfaceOptions()) == pytest.approx(4.0, abs=0.6)


def colored(frames: list[RangeFrame], exponent: float) -> Recording:
    """Frames with colour, at a gamma of 2.2, instead of amplitude."""
    out = []
    for frame in frames:
        log_albedo = prepare_view(frame, SurfaceOptions(falloff=0.0)).albedo[..., 0]
        far = np.fmax(frame.radial_range, 0.3)
        log_light = log_albedo - exponent * np.log(far)
        gamma = np.exp((log_light - np.nanmedian(log_light)) / 2.2)
        grey = np.clip(np.nan_to_num(80 * gamma), 0, 255).astype(np.uint8)
        color = np.dstack([grey] * 3)
        out.append(replace(frame, amplitude_image=None, color_image=color, color_registered=True))
    return Recording.of(ArraySource(tuple(out)), "made", "arrays")


@pytest.mark.parametrize("exponent", [0.0, 1.0, 3.0])
def test_colour_falloff_is_estimated(forward, exponent):
    config = adapted(from_method("default"), colored(forward, exponent), threads=1)
    assert config.odometry.views.range_falloff == pytest.approx(exponent / 2.2, abs=0.1)
    assert config.odometry.views.falloff == 0.0


def infrared(frames: list[RangeFrame], exponent: float) -> Recording:
    """Frames whose amplitude falls off with the range, of kind "ir"."""
    out = []
    for frame in frames:
        assert frame.amplitude_image is not None
        amplitude = frame.amplitude_image / np.fmax(frame.radial_range, 0.3) ** exponent
        out.append(
            replace(frame, amplitude_image=amplitude.astype(np.float32), amplitude_kind="ir")
        )
    return Recording.of(ArraySource(tuple(out)), "made", "arrays")


@pytest.mark.parametrize("exponent", [0.0, 2.0])
def test_falloff_of_infrared_images_is_estimated(forward, exponent):
    config = adapted(from_method("default"), infrared(forward, exponent), threads=1)
    views = config.odometry.views
    assert views.range_falloff == pytest.approx(exponent, abs=0.2)
    assert abs(views.falloff) < 0.5
    compensated, raw = infrared(forward[:1], 0.0)[0], infrared(forward[:1], exponent)[0]
    expected = prepare_view(compensated, SurfaceOptions(falloff=0.0, range_falloff=0.0))
    alone = prepare_view(raw, SurfaceOptions(falloff=0.0, range_falloff=exponent))
    assert np.nanstd(alone.albedo[..., 0] - expected.albedo[..., 0]) < 0.02


def test_colour_falloff_is_compensated(forward):
    lit, ambient = colored(forward[:1], 4.4)[0], colored(forward[:1], 0.0)[0]
    view = prepare_view(lit, SurfaceOptions(range_falloff=2.0))
    expected = prepare_view(ambient, SurfaceOptions(range_falloff=0.0))
    plain = prepare_view(lit, SurfaceOptions(range_falloff=0.0))
    off, before = (v.albedo[..., 0] - expected.albedo[..., 0] for v in (view, plain))
    assert np.nanstd(off) < np.nanstd(before) / 4
    slopes = [v.albedo[..., 1:] - expected.albedo[..., 1:] for v in (view, plain)]
    right, wrong = (np.abs(np.nanmedian(s, axis=(0, 1))).max() for s in slopes)
    assert right < wrong / 4


def test_no_light_falls_off_by_what_little_evidence_says(frames, monkeypatch):
    """Pairs that hardly tell may agree by chance, on a falloff that there is not."""
    few = iter(falloff._Slope(exponent, 0.1, 0.02) for exponent in (16.6, 16.0, 16.3, 16.2) * 3)
    monkeypatch.setattr(falloff, "_slope_from", lambda *_: next(few))
    given = recording(frames, 0.0)
    assert estimate_falloff(given, lambda f: f, SurfaceOptions(), falloff.RANGE) == 0.0
