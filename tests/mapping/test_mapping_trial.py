"""Corrections with a trial are applied only if there is evidence of the error."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import tofuse
from tofuse.engine.frames.frames import Frame, RangeFrame
from tofuse.engine.frames.recording import Recording
from tofuse.engine.mapping.adaptation import adapted
from tofuse.engine.mapping.config import Config
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.mapping.trial import Trial, trial
from tofuse.engine.progress import Silent
from tofuse.engine.sensor.multipath_correction import Multipath
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.record import simulate_recording


class Listener(Silent):
    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)


@pytest.fixture(scope="module")
def straight() -> Recording:
    """A rotation in a room without multipath."""
    effects = Effects.none(shot_noise=True)
    return simulate_recording("empty-room", every=6, frames=40, effects=effects)


def multipath_of(config: Config) -> Multipath:
    (found,) = (c for c in config.corrections if isinstance(c, Multipath))
    return found


@pytest.mark.nightly_part
def test_compensation_is_disabled_without_multipath(straight: Recording) -> None:
    listener = Listener()
    config = adapted(from_method("default"), straight, 1, listener)
    part = multipath_of(config)
    assert part.disabled
    assert not part.trial
    assert part.strength is not None
    assert abs(part.strength[0]) < 0.15
    assert [n for n in listener.notes if "multipath not applied" in n]
    # Views pass unchanged.
    corrector, frame = part.start(), straight[0]
    assert corrector.apply(frame) is frame
    assert corrector.is_independent(frame)
    # A decision is not tried again.
    assert adapted(config, straight, 1) == config


@pytest.mark.nightly
def test_compensation_is_kept_with_multipath() -> None:
    effects = Effects.none(shot_noise=True, multipath=True)
    recording = simulate_recording("empty-room", every=6, frames=20, effects=effects)
    listener = Listener()
    config = adapted(from_method("default"), recording, 1, listener)
    part = multipath_of(config)
    assert part.applied
    assert part.strength is not None
    strength, error = part.strength
    assert 0.2 < strength < 1
    assert part.gain is not None  # one for all frames
    # The uncertainty of the strength is part of each pixel's error.
    assert part.relative_sigma == pytest.approx(
        math.hypot(Multipath().relative_sigma, error / strength)
    )
    assert not listener.notes
    assert adapted(config, recording, 1) == config


def test_correction_is_left_out_with_too_few_views(straight: Recording) -> None:
    listener = Listener()
    few = straight.select(end=5)
    config = adapted(from_method("default"), few, 1, listener)
    assert multipath_of(config) == Multipath(trial=False, applied=False)
    assert [n for n in listener.notes if "too few views" in n]
    result = tofuse.reconstruct(few, config)
    left_out = [r for r in result.diagnostics.reasons if r.code == "correction_left_out"]
    assert len(left_out) == 1
    assert "multipath" in left_out[0].text


def test_explicit_settings_are_not_tried(straight: Recording) -> None:
    for part in (Multipath(gain=3000.0), Multipath(trial=False), Multipath(applied=False)):
        config = replace(from_method("default"), corrections=(part,))
        assert adapted(config, straight, 1).corrections == config.corrections


def bent(by: float, at: float = 8.0) -> object:
    """Distorts images by a bump that is fixed to the camera."""

    def made(frame: Frame) -> Frame:
        assert isinstance(frame, RangeFrame)
        rays = frame.camera.rays()
        bump = 1 + by * np.cos(at * rays[..., 0]) * np.cos(at * rays[..., 1])
        return replace(frame, depth=(frame.depth * bump).astype(np.float32))

    return made


def plain(frame: Frame) -> Frame:
    return frame


@pytest.mark.nightly
@pytest.mark.parametrize("there", [0.0, 0.5])
def test_strength_is_fraction_of_error_in_data(straight: Recording, there: float) -> None:
    """The correction removes a bump of 2 %, of which the data contain this fraction."""
    spoil, correct = bent(0.02 * there), bent(-0.02)
    found = trial(straight, spoil, lambda frame: correct(spoil(frame)))
    assert found.strength == pytest.approx(there, abs=max(3 * found.error, 0.1))
    assert found.is_significant == (there > 0)


@pytest.mark.nightly
def test_correction_of_another_error_does_not_help(straight: Recording) -> None:
    spoil, correct = bent(0.02, 8.0), bent(-0.02, 21.0)
    assert not trial(straight, spoil, lambda frame: correct(spoil(frame))).is_significant
    worse = bent(0.02)  # the right shape, with the wrong sign
    assert not trial(straight, spoil, lambda frame: worse(spoil(frame))).is_significant
    nothing = trial(straight, plain, plain)
    assert not nothing.is_significant
    assert not nothing.predicted


def test_single_run_of_bad_poses_does_not_decide() -> None:
    """Not even if it has most of the predicted effect."""
    strengths = np.array([0.2, 0.3, 0.25, 0.35, 0.2, 0.3, 0.25, -0.4])
    predicted = np.array([*[1.0] * 7, 12.0])
    assert Trial(tuple(strengths * predicted), tuple(predicted)).is_significant
