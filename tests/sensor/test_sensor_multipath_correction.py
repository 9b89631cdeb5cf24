"""Multipath compensation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from multipath_corner import CAMERA, FLOOR, GAIN, LEFT, PERIOD_M, RIGHT, Seen
from tofuse.engine.frames.frames import SATURATED_AMPLITUDE, CloudFrame, RangeFrame
from tofuse.engine.sensor.multipath import (
    GainEstimator,
    MultipathEstimate,
    MultipathModel,
    ToFImage,
)
from tofuse.engine.sensor.multipath_correction import Multipath
from tofuse.engine.sensor.raw_amplitude import tof_image
from tofuse.lab.simulation import record
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.render import render

WALL = ((0.2, 0.1, -0.9747), -2.5)


@pytest.fixture(scope="module")
def corner() -> Seen:
    return Seen(LEFT, RIGHT, FLOOR)


# `Seen` has no surfaces outside the image.
REFLECTIONS = MultipathModel(columns=30, lamp=0.1)
EVERY_PIXEL = MultipathModel(columns=60, lamp=0.1)


def solved(
    seen: Seen, reflections: MultipathModel = REFLECTIONS, gain: float = GAIN
) -> MultipathEstimate:
    found = reflections.solve(seen.image, gain)
    assert found is not None
    return found


def test_corner_bias_is_positive_and_removed(corner: Seen) -> None:
    before = corner.errors(corner.image.z)
    # Indirect light travels farther: corners appear too far away.
    assert np.median(before) > 0.03
    assert (before > 0).mean() > 0.95
    exact = np.abs(corner.errors(solved(corner, EVERY_PIXEL).z))
    assert np.median(exact) < 0.001
    assert np.percentile(exact, 90) < 0.003
    coarse = np.abs(corner.errors(solved(corner).z))
    assert np.median(coarse) < np.median(before) / 10
    assert np.percentile(coarse, 90) < np.percentile(before, 90) / 8


def test_increase_of_amplitude_is_estimated(corner: Seen) -> None:
    found = solved(corner)
    true = corner.raw / corner.own
    assert np.median(true) > 1.05
    assert np.median(np.abs(found.factor / true - 1)) < 0.02


def test_correction_depends_on_ratio_of_amplitude_and_gain_only(corner: Seen) -> None:
    brighter = replace(corner.image, amplitude=corner.image.amplitude * np.float32(8))
    found = REFLECTIONS.solve(brighter, 8 * GAIN)
    assert found is not None
    np.testing.assert_allclose(found.z, solved(corner).z, atol=1e-5)


def test_flat_wall_is_unchanged() -> None:
    rng = np.random.default_rng(0)
    image = Seen(WALL).image
    noisy = image.z * (1 + 0.003 * rng.normal(size=image.z.shape).astype(np.float32))
    for z in (image.z, noisy):
        found = REFLECTIONS.solve(replace(image, z=z), GAIN)
        assert found is not None
        assert np.abs(found.z - z).max() < 0.0005


def test_convex_edge_is_unchanged() -> None:
    rays = CAMERA.rays().astype(float)
    # Two faces that recede from the edge at x = 0.
    z = (2 / (1 - 0.7 * np.abs(rays[..., 0]))).astype(np.float32)
    found = REFLECTIONS.solve(ToFImage(z, CAMERA.rays(), np.full_like(z, 100), PERIOD_M), GAIN)
    assert found is not None
    assert np.abs(found.z - z).max() < 0.0005


@pytest.mark.nightly
@pytest.mark.parametrize("albedo", [0.25, 0.9])
def test_gain_is_estimated_from_flatness_of_surfaces(albedo: float) -> None:
    seen = Seen(LEFT, RIGHT, FLOOR, albedo=albedo)
    estimator = GainEstimator(EVERY_PIXEL)
    for _ in range(4):
        estimator.add(seen.image)
    assert estimator.gain is not None
    assert GAIN / 1.7 < estimator.gain < GAIN * 1.7
    found = solved(seen, gain=estimator.gain)
    before, after = seen.errors(seen.image.z), seen.errors(found.z)
    assert np.median(np.abs(after)) < 0.6 * np.median(np.abs(before))


def test_images_without_depth_or_amplitude_have_no_estimate() -> None:
    dark = replace(Seen(WALL).image, amplitude=np.zeros((48, 60), np.float32))
    empty = replace(dark, z=np.zeros((48, 60), np.float32))
    for image in (dark, empty):
        assert REFLECTIONS.solve(image, GAIN) is None
        estimator = GainEstimator(REFLECTIONS)
        estimator.add(image)
        assert estimator.gain is None


def test_depth_and_amplitude_of_any_kind_are_corrected(corner: Seen) -> None:
    found = solved(corner, MultipathModel(columns=30, lamp=1.0))
    part, reflections = Multipath(gain=GAIN), MultipathModel(columns=30, lamp=1.0)
    frame = corner.frame()
    fixed = part.start(reflections).apply(frame)
    assert isinstance(fixed, RangeFrame)
    assert fixed.amplitude_image is not None
    np.testing.assert_allclose(fixed.depth, found.z, rtol=1e-6)
    np.testing.assert_allclose(fixed.amplitude_image, corner.raw / found.factor, rtol=1e-5)

    far = part.start(reflections).apply(
        replace(frame, depth=frame.radial_range, depth_kind="range")
    )
    assert isinstance(far, RangeFrame)
    np.testing.assert_allclose(far.depth, fixed.radial_range, rtol=1e-5)

    white = corner.raw * frame.radial_range**2 * corner.length**4
    even = part.start(reflections).apply(
        replace(frame, amplitude_image=white.astype(np.float32), amplitude_kind="range_compensated")
    )
    assert isinstance(even, RangeFrame)
    assert even.amplitude_image is not None
    np.testing.assert_allclose(even.depth, fixed.depth, rtol=1e-4)
    wanted = fixed.amplitude_image * fixed.radial_range**2 * corner.length**4
    np.testing.assert_allclose(even.amplitude_image, wanted, rtol=1e-3)


def test_sigma_of_correction_is_added_in_quadrature(corner: Seen) -> None:
    frame = corner.frame()
    own = np.full(frame.depth.shape, 0.003, np.float32)

    def corrected(given: RangeFrame, relative_sigma: float) -> RangeFrame:
        part = Multipath(gain=GAIN, relative_sigma=relative_sigma)
        fixed = part.start(MultipathModel(columns=30)).apply(given)
        assert isinstance(fixed, RangeFrame)
        return fixed

    assert corrected(frame, 0).shared_sigma_image is None
    fixed = corrected(frame, 0.25)
    moved = np.abs(frame.radial_range - fixed.radial_range)
    assert np.median(moved) > 0.01
    assert fixed.shared_sigma_image is not None
    np.testing.assert_allclose(fixed.shared_sigma_image, moved / 4, atol=1e-6)
    both = corrected(replace(frame, shared_sigma_image=own), 0.25).shared_sigma_image
    assert both is not None
    np.testing.assert_allclose(both, np.hypot(moved / 4, 0.003), atol=1e-6)


def test_unsuitable_frames_are_unchanged(corner: Seen) -> None:
    frame = corner.frame()
    cloud = CloudFrame.of(frame.points)
    for given in (
        replace(frame, amplitude_image=None),
        replace(frame, ambiguity_m=None),
        replace(frame, ambiguity_m=18.7),
        replace(frame, amplitude_kind="ir"),
        replace(frame, depth=np.zeros_like(frame.depth)),
        replace(frame, amplitude_image=np.zeros_like(frame.depth)),
        cloud,
    ):
        assert Multipath().start().apply(given) is given
    assert Multipath(period_m=5.0).start().apply(replace(frame, ambiguity_m=None)) is not frame


def test_invalid_pixels_are_kept_and_others_corrected(corner: Seen) -> None:
    rng = np.random.default_rng(4)
    frame = corner.frame()
    assert frame.amplitude_image is not None
    holes = rng.random(frame.depth.shape) < 0.1
    amplitude = frame.amplitude_image.copy()
    for value in (np.nan, np.inf, -5.0, 0.0, SATURATED_AMPLITUDE):
        amplitude[rng.random(amplitude.shape) < 0.02] = value
    bad = frame.keep(~holes)
    bad = replace(bad, amplitude_image=amplitude)
    fixed = Multipath(gain=GAIN).start(MultipathModel(columns=30, lamp=1.0)).apply(bad)
    assert isinstance(fixed, RangeFrame)
    assert (fixed.valid == bad.valid).all()
    assert np.isfinite(fixed.depth).all()
    assert fixed.amplitude_image is not None
    assert (fixed.amplitude_image[amplitude == SATURATED_AMPLITUDE] == SATURATED_AMPLITUDE).all()
    error = np.abs(corner.errors(fixed.z))[bad.valid]
    assert np.median(error) < np.median(corner.bias) / 5

    noise = RangeFrame(
        0, 0.0, CAMERA, rng.uniform(0.05, 5, (48, 60)).astype(np.float32), "z",
        rng.uniform(0, 9000, (48, 60)).astype(np.float32), ambiguity_m=5.0,
    )  # fmt: skip
    fixed = Multipath().start().apply(noise)
    assert isinstance(fixed, RangeFrame)
    assert (fixed.valid == noise.valid).all()


@pytest.mark.parametrize(("texture", "share"), [(True, 2.5), (False, 2.5)])
def test_multipath_of_simulated_corner_is_reduced(texture: bool, share: float) -> None:
    plan = record.plan("corner", effects=Effects.none(multipath=True), texture=texture)
    corrector = Multipath().start()
    before, after = [], []
    for k in (0, 30):
        rendered = render(plan.scene, plan.sequence, plan.model, k, effects=plan.effects)
        frame = rendered.frame
        assert tof_image(frame) is not None
        fixed = corrector.apply(frame)
        assert isinstance(fixed, RangeFrame)
        seen = frame.valid & (rendered.depth > 0)
        before.append(np.abs(frame.depth - rendered.depth)[seen])
        after.append(np.abs(fixed.depth - rendered.depth)[seen])
    assert np.median(before) > 0.025
    assert np.median(after) < np.median(before) / share
    assert np.percentile(after, 90) < np.percentile(before, 90) / share
