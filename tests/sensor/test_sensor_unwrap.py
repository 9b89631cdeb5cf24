"""Phase unwrapping by amplitude and neighbourhood."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.cameras.depth_conversion import range_from_z
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.sensor.unwrap import Unwrap, count_periods, on_surface
from tofuse.engine.sensor.unwrap_kernels import NEIGHBOURS, pass_messages
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.record import plan

PERIOD = 5.0


def taken(scene: str, every: int) -> list[tuple[RangeFrame, np.ndarray]]:
    """Frames of a simulated SR4000 and the true radial range of their pixels."""
    made = plan(scene, every=every, seed=3, effects=Effects().without("multipath"))
    out = []
    for rendered in made.frames(None):
        frame, true = rendered.frame, rendered.depth
        radial = true if made.model.depth_kind == "range" else range_from_z(frame.camera, true)
        out.append((frame, radial))
    return out


def periods_of(frame: RangeFrame, radial: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Missing periods of each pixel, and which pixels measured one surface to half a metre."""
    lacks = np.rint((radial - frame.radial_range) / PERIOD)
    off = np.abs(radial - frame.radial_range - lacks * PERIOD)
    confident = frame.confidence_image is None or frame.confidence_image >= 1
    return lacks, frame.valid & (radial > 0) & (off < 0.5) & confident


@pytest.mark.nightly_part
def test_hall_beyond_period_is_unwrapped() -> None:
    """8 x 8 m before a camera with a period of 5 m: most of it is wrapped."""
    frames = taken("hall", 90)
    corrector = Unwrap().fit([frame for frame, _ in frames]).start()
    wrapped = restored = good = harmed = 0
    for frame, radial in frames:
        lacks, sure = periods_of(frame, radial)
        moved = np.rint((corrector.apply(frame).radial_range - frame.radial_range) / PERIOD)
        wrapped += (sure & (lacks == 1)).sum()
        restored += (sure & (lacks == 1) & (moved == 1)).sum()
        good += (sure & (lacks == 0)).sum()
        harmed += (sure & (lacks == 0) & (moved != 0)).sum()
    assert wrapped > 10_000
    assert good > 5_000
    assert restored > 0.99 * wrapped
    assert harmed <= 0.001 * good


@pytest.mark.nightly
def test_room_within_period_is_unchanged() -> None:
    """Its dark chairs and floor reflect as little as a white wall one period farther."""
    frames = taken("room", 128)
    corrector = Unwrap().fit([frame for frame, _ in frames]).start()
    for frame, _ in frames:
        moved = corrector.apply(frame).depth != frame.depth
        assert moved.mean() < 0.001


def test_amplitude_is_adapted_to_unwrapped_range() -> None:
    """Range-compensated amplitude of a wall is equal in front of and beyond the period."""
    frame, _ = taken("hall", 180)[0]
    assert frame.amplitude_kind == "range_compensated"
    out = Unwrap().fit([frame]).start().apply(frame)
    assert isinstance(out, RangeFrame)
    assert frame.amplitude_image is not None
    assert out.amplitude_image is not None
    moved = (out.depth != frame.depth) & (frame.radial_range > 0.5)
    factor = (out.radial_range / np.where(moved, frame.radial_range, 1))[moved]
    np.testing.assert_allclose(
        out.amplitude_image[moved], frame.amplitude_image[moved] * factor**2, rtol=1e-4
    )
    still = out.depth == frame.depth
    np.testing.assert_array_equal(out.amplitude_image[still], frame.amplitude_image[still])


def test_messages_find_minimum_of_a_chain() -> None:
    """On a chain belief propagation is exact: all states of 1 x 7 pixels are compared."""
    rng = np.random.default_rng(7)
    for _ in range(20):
        n, labels = 7, 3
        range_m = rng.uniform(0, PERIOD, (1, n)).astype(np.float32)
        unary = rng.uniform(0, 2, (1, n, labels)).astype(np.float32)
        valid = np.ones((1, n), bool)
        messages = np.zeros((4, 1, n, labels), np.float32)
        for step in range(2 * n):
            pass_messages(range_m, valid, unary, PERIOD, 0.5, 3.0, 0, 1, step % 2, messages)
        found = np.argmin(unary + messages.sum(0), axis=2)[0]
        states = np.stack(np.meshgrid(*[range(labels)] * n, indexing="ij"), -1).reshape(-1, n)
        cost = unary[0, np.arange(n), states].sum(1)
        along = range_m[0] + states * PERIOD
        cost += np.minimum(np.abs(np.diff(along, axis=1)) / 0.5, 3.0).sum(1)
        assert np.array_equal(found, states[np.argmin(cost)])
    assert len(NEIGHBOURS) == 4


def test_dark_surfaces_are_not_unwrapped() -> None:
    """A black board before a grey wall, both within the period, is unchanged."""
    r = np.full((48, 64), 3.0, np.float32)
    light = np.full((48, 64), 0.5 * 3000 / 9, np.float32)
    r[15:30, 20:40], light[15:30, 20:40] = 2.0, 0.03 * 3000 / 4
    assert not count_periods(r, light, PERIOD, 3000.0, 0.02).any()
    assert not count_periods(r, light, PERIOD, 0.0, 0.02).any()


def with_weak_pixels(r: np.ndarray, weak: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Ranges and amplitudes of a grey scene at r, with weak pixels at random ranges."""
    rng = np.random.default_rng(seed)
    light = 0.5 * 3000 / r**2
    measured = np.mod(r + rng.normal(0, 0.02, r.shape), PERIOD)
    measured = np.where(weak, rng.uniform(0, PERIOD, r.shape), measured)
    light = np.where(weak, rng.exponential(3.0, r.shape), light)
    return measured.astype(np.float32), light.astype(np.float32)


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_weak_pixels_at_random_ranges_are_not_unwrapped(seed: int) -> None:
    """Whether scattered or contiguous: only surfaces wrap."""
    u = np.arange(176)
    r = np.where(u < 88, 2.5 + 0.005 * u, 3.2 + 0.002 * u) * np.ones((144, 1))
    patch = np.zeros(r.shape, bool)
    patch[30:90, 40:110] = True
    for weak in (patch, patch & (np.random.default_rng(seed).random(r.shape) < 0.3)):
        measured, light = with_weak_pixels(r, weak, seed)
        moved = count_periods(measured, light, PERIOD, 3000.0, 0.02) > 0
        assert moved[weak].mean() < 0.01
        assert not moved[~weak].any()


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_surfaces_are_unwrapped_around_weak_pixels(seed: int) -> None:
    r = 2 + 0.05 * np.arange(144)[:, None] * np.ones((1, 176))
    weak = np.zeros(r.shape, bool)
    weak[30:90, 40:110] = True
    measured, light = with_weak_pixels(r, weak, seed)
    periods = count_periods(measured, light, PERIOD, 3000.0, 0.02)
    surface = on_surface(measured, PERIOD)
    assert surface[~weak].mean() > 0.99
    assert surface[weak].mean() < 0.05
    assert (periods == r // PERIOD)[~weak].mean() > 0.99
    assert (periods > 0)[weak].mean() < 0.05


def test_surface_that_crosses_period_is_connected() -> None:
    r = np.mod(np.linspace(4.0, 6.0, 40)[:, None] * np.ones((1, 30)), PERIOD).astype(np.float32)
    assert on_surface(r, PERIOD).all()
    lonely = np.zeros((9, 9), np.float32)
    lonely[4, 4] = 2.0
    assert not on_surface(lonely, PERIOD).any()
