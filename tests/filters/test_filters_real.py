"""Filters on frames of the camera of the thesis."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tofuse.engine.filters.base import Filter, apply_filters
from tofuse.engine.filters.thresholds import Confidence
from tofuse.engine.frames.frames import RangeFrame
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.methods.filters_temporal import TemporalDeviation, z_deviation


def noise(frames: list[RangeFrame], filters: list[Filter]) -> tuple[float, float]:
    """Median and rms over the pixels that are kept in all frames of the deviation of z, m."""
    kept = np.all([apply_filters(filters, f)[0].valid for f in frames], axis=0)
    deviation = z_deviation([f.z for f in frames])[kept]
    assert len(deviation) > 500
    return float(np.median(deviation)), float(np.sqrt((deviation**2).mean()))


@pytest.fixture(scope="module", params=["Y1", "Y2"])
def still(request: pytest.FixtureRequest, shared_data: Path) -> list[RangeFrame]:
    frames = list(open_recording(shared_data / "sr4000_corridor" / request.param))
    assert len(frames) == 4
    return [frame for frame in frames if isinstance(frame, RangeFrame)]


def test_temporal_noise_falls_with_confidence(still: list[RangeFrame]) -> None:
    levels = [noise(still, [Confidence(level)] if level else []) for level in range(8)]
    medians, rms = np.array(levels).T
    assert (np.diff(medians) < 0).all()
    assert (np.diff(rms) < 0).all()
    assert medians[7] < medians[0] / 2
    assert rms[7] < rms[0] / 10


def test_temporal_filter_keeps_stable_pixels(still: list[RangeFrame]) -> None:
    left, removal = apply_filters([TemporalDeviation(0.025, 4)], still[-1], still[:-1])
    assert np.nanmax(z_deviation([f.z for f in still])[left.valid]) <= 0.025
    assert 0.2 < removal[0].removed / removal[0].received < 0.9
