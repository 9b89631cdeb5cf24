"""The configuration is adapted to what a recording states, or shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.helpers.made_rooms import at, seen

from tofuse.engine.filters import Confidence
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.mapping.adaptation import with_recording_defaults
from tofuse.engine.mapping.methods import from_method


def levels_kept(highest: int, **metadata: object) -> tuple[int, int]:
    """The lowest confidence that is tracked, and that is in the model."""
    frames = []
    for k in range(3):
        frame = seen(at(0.05 * k, 0.0, 0.0), k)
        level = np.full(frame.depth.shape, highest if k == 1 else 1, np.uint8)
        frames.append(replace(frame, confidence_image=level))
    recording = Recording.of(ArraySource(frames, metadata=metadata), "made", "made")
    config = with_recording_defaults(from_method("default"), recording)
    (tracked,) = (f.minimum for f in config.filters if isinstance(f, Confidence))
    (model,) = (f.minimum for f in config.model_filters if isinstance(f, Confidence))
    return tracked, model


@pytest.mark.parametrize(("highest", "model"), [(1, 1), (2, 1), (4, 2), (7, 3), (200, 3)])
def test_few_levels_of_confidence_are_seen(highest: int, model: int) -> None:
    assert levels_kept(highest) == (1, model)


def test_stated_levels_of_confidence_count() -> None:
    assert levels_kept(2, confidence_max=7) == (1, 3)
    assert levels_kept(200, confidence_max=255) == (37, 110)
