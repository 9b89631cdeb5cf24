"""Corrections that are on trial stay where what they take off is there, and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.filters.multipath import Multipath
from tofuse.pipeline.config import Config, from_method
from tofuse.pipeline.learn import learnt
from tofuse.pipeline.progress import Silent
from tofuse.pipeline.trial import Trial, trial
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.recordings.recording import Recording
from tofuse.simulation.effects import Effects
from tofuse.simulation.record import simulate_recording


class Listener(Silent):
    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)


@pytest.fixture(scope="module")
def straight() -> Recording:
    """A turn in a room without indirect light."""
    effects = Effects.none(shot_noise=True)
    return simulate_recording("empty-room", every=6, frames=40, effects=effects)


def multipath_of(config: Config) -> list[Multipath]:
    return [c for c in config.corrections if isinstance(c, Multipath)]


def test_compensation_goes_where_there_is_nothing_to_compensate(straight: Recording) -> None:
    listener = Listener()
    config = learnt(from_method("default"), straight, 1, listener)
    assert not multipath_of(config)
    assert len(config.corrections) == len(from_method("default").corrections) - 1
    assert [n for n in listener.notes if "multipath is left out" in n]


def test_compensation_stays_where_there_is_indirect_light() -> None:
    effects = Effects.none(shot_noise=True, multipath=True)
    recording = simulate_recording("empty-room", every=6, frames=24, effects=effects)
    listener = Listener()
    config = learnt(from_method("default"), recording, 1, listener)
    assert multipath_of(config) == [Multipath(trial=False)]
    assert not listener.notes
    # What has passed is not tried again.
    assert learnt(config, recording, 1) == config


def test_what_is_given_or_asked_for_is_not_tried(straight: Recording) -> None:
    for part in (Multipath(gain=3000.0), Multipath(trial=False)):
        config = replace(from_method("default"), corrections=(part,))
        assert learnt(config, straight, 1).corrections == config.corrections


def bent(by: float) -> object:
    """Bends images by a bump that is fixed to the camera."""

    def made(frame: Frame) -> Frame:
        assert isinstance(frame, RangeFrame)
        rays = frame.camera.rays()
        bump = 1 + by * np.cos(8 * rays[..., 0]) * np.cos(8 * rays[..., 1])
        return replace(frame, depth=(frame.depth * bump).astype(np.float32))

    return made


def plain(frame: Frame) -> Frame:
    return frame


def test_bending_harms_and_straightening_does_not(straight: Recording) -> None:
    harmful = trial(straight, plain, bent(0.02))
    assert harmful.harms
    assert harmful.mean > 0.5
    helpful = trial(straight, bent(0.02), plain)
    assert not helpful.harms
    assert helpful.mean < -0.5
    assert trial(straight, plain, plain).mean == 0


def test_a_trial_needs_several_runs_that_agree() -> None:
    assert not Trial(()).harms
    assert not Trial((1.0, 1.1, 1.2)).harms
    assert Trial((1.0, 1.1, 1.2, 0.9)).harms
    assert not Trial((1.0, -0.9, 1.4, 0.2)).harms
    assert not Trial((0.05, 0.05, 0.06, 0.05)).harms  # sure, but too little


def test_views_without_amplitude_are_not_tried(straight: Recording) -> None:
    source = straight.source

    class Dark:
        metadata = source.metadata
        timestamps = source.timestamps

        def __len__(self) -> int:
            return len(source)

        def read(self, index: int) -> Frame:
            assert index == 0, "one frame tells that there is nothing to compensate"
            frame = source.read(index)
            assert isinstance(frame, RangeFrame)
            return replace(frame, amplitude_image=None)

    config = learnt(from_method("default"), replace(straight, source=Dark()), 1)
    assert multipath_of(config) == [Multipath(trial=False)]
