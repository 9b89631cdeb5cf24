"""Short soaks of `benchmarks/soak.py`, and whether they would detect a leak."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import numpy as np
import pytest

from paths import BENCHMARKS

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


@pytest.fixture
def soak(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import soak

    return soak


def usages(soak, memory, descriptors=7, threads=3):
    return [soak.Usage(100 * (k + 1), m, descriptors, threads) for k, m in enumerate(memory)]


def test_leak_is_detected(soak, capsys) -> None:
    flat = [int(5e8 + 1e5 * (-1) ** k) for k in range(10)]
    assert soak.bounded(usages(soak, flat), soak.RUN_BYTES)
    filled = [int(1e8 * min(k + 1, 4)) for k in range(10)]  # caches fill at the beginning
    assert soak.bounded(usages(soak, filled), soak.RUN_BYTES)
    growing = [int(1e8 + 5e6 * k) for k in range(10)]  # 50 kB each
    assert soak.growth(usages(soak, growing)) == pytest.approx(5e4)
    assert not soak.bounded(usages(soak, growing), soak.RUN_BYTES)
    more = [*usages(soak, flat[:9]), soak.Usage(1000, flat[9], 8, 3)]
    assert not soak.bounded(more, soak.RUN_BYTES)
    more = [*usages(soak, flat[:9]), soak.Usage(1000, flat[9], 7, 4)]
    assert not soak.bounded(more, soak.RUN_BYTES)
    assert capsys.readouterr().out.count("FAILED") == 3


def test_store_may_fill_its_budget_but_not_exceed_it(soak) -> None:
    def filling(budget: int) -> list:
        return [
            soak.Usage(100 * k, int(5e8 + 1e7 * k), 7, 3, stored=int(1e7 * k), budget=budget)
            for k in range(10)
        ]

    assert soak.bounded(filling(10**8), soak.RUN_BYTES)
    assert not soak.bounded(filling(5 * 10**7), soak.RUN_BYTES)


@pytest.mark.slow
def test_descriptors_of_stores_are_not_counted(soak) -> None:
    before = soak.Usage.measured(1).descriptors
    spilled = soak.SpillFile()
    spilled.append(np.zeros(10, np.uint8))
    assert soak.Usage.measured(2).descriptors == before
    with open("/dev/null"):
        assert soak.Usage.measured(3).descriptors == before + 1
    spilled.close()
    assert soak.Usage.measured(4).descriptors == before


@pytest.mark.slow
def test_all_live_frames_are_recorded(soak, tmp_path: Path, capsys) -> None:
    """A minute of camera time with missing, duplicate and late frames."""
    assert soak.live(32, 60.0, 10.0, tmp_path, mapped=False)
    sent = soak.Camera(32, 600, 10.0)
    frames = list(sent._frames(600))
    times = [frame.timestamp for frame in frames]
    assert min(sent.sent.missing, sent.sent.doubled, sent.sent.late) > 3
    assert len(times) == 600 - sent.sent.missing + sent.sent.doubled
    steps = [b - a for a, b in itertools.pairwise(times)]
    assert sum(step == 0 for step in steps) == sent.sent.doubled
    assert sum(step < 0 for step in steps) >= 1
    assert "600" not in capsys.readouterr().err
    repeated = sum(a.depth is b.depth for a, b in itertools.pairwise(frames))
    with soak.Camera(32, 600, 10.0) as camera, pytest.raises(soak.DeviceError):
        for _ in camera:
            pass
    assert camera.sent.repeated == repeated >= camera.sent.doubled


@pytest.mark.slow
def test_mapper_accepts_late_missing_and_duplicate_frames(soak, tmp_path: Path) -> None:
    camera = soak.Camera(32, 70, 10.0)
    list(camera._frames(70))
    assert min(camera.sent.missing, camera.sent.doubled, camera.sent.late) > 0
    assert soak.live(32, 7.0, 10.0, tmp_path, mapped=True, samples=3)
