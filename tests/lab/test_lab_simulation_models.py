"""Models of cameras."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tofuse.engine.noise.model import NOISE
from tofuse.lab.simulation.models import CAMERAS, noise_of


@pytest.mark.parametrize("name", CAMERAS)
def test_noise_of_family_is_that_of_electronics(name: str) -> None:
    assert replace(NOISE[name], confidence=None) == noise_of(CAMERAS[name])
