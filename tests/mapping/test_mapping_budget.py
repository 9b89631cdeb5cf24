"""Division of `--memory`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tofuse.apps.jobs.run_options import Options, resolve
from tofuse.engine.errors import InputError
from tofuse.engine.mapping.config import changed, views_bytes, voxels_mb
from tofuse.engine.mapping.methods import from_method


def test_memory_budget_is_divided_consistently() -> None:
    config = resolve(Options(Path("out"), memory=1_000_000_000))
    assert config.memory_mb == 1000
    assert config.fusion.memory_mb == voxels_mb(1000) == 300
    # Voxels, half as much for images, and views leave room for the program itself.
    assert 1.5 * voxels_mb(2000) * 1_000_000 + views_bytes(2000) < 0.7 * 2e9


def test_configured_memory_is_divided_too() -> None:
    config = changed(from_method("default"), {"memory_mb": 500}, where="test")
    assert (config.memory_mb, config.fusion.memory_mb) == (500, voxels_mb(500))
    changes = {"memory_mb": 500, "fusion": {"memory_mb": 90}}
    assert changed(config, changes, where="test").fusion.memory_mb == 90
    assert changed(config, {"fusion": {"memory_mb": 80}}, where="test").memory_mb == 500
    with pytest.raises(InputError, match="memory_mb"):
        changed(config, {"memory_mb": "much"}, where="test")


def test_too_little_memory_is_refused() -> None:
    with pytest.raises(InputError, match="memory"):
        resolve(Options(Path("out"), memory=100_000_000))
