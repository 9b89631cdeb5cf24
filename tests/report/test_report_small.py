"""The thumbnail of a model, in the table of a batch."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.report.scene import Scene, render_thumbnail
from tofuse.report.thumbnails import BACKGROUND

SIZE = (160, 100)


def scene_of(points: np.ndarray) -> Scene:
    none = np.zeros((0, 4, 4))
    camera = np.eye(4)[None].copy()
    camera[0, 2, 3] = -3.0
    loops = np.zeros((0, 2, 3))
    white = np.full((len(points), 3), 255, np.uint8)
    return Scene(points, white, None, len(points), 0.01, none, camera, none, loops)


@pytest.mark.parametrize("scale", [0.01, 1.0, 300.0])
def test_model_fills_the_thumbnail(scale: float) -> None:
    rng = np.random.default_rng(3)
    shape = np.array([1.0, 0.6, 0.4])
    points = scale * (rng.uniform(-1, 1, (20_000, 3)) * shape + [40.0, -7.0, 3.0])
    image = render_thumbnail(scene_of(points), SIZE)
    assert image.shape == (100, 160, 3)
    rows, columns = np.nonzero((image != BACKGROUND).any(2))
    reach = np.array([np.ptp(columns) / SIZE[0], np.ptp(rows) / SIZE[1]])
    assert 0.6 < reach.max() <= 1
    assert abs(np.mean([rows.min(), rows.max()]) - 50) < 15
    assert abs(np.mean([columns.min(), columns.max()]) - 80) < 15


def test_empty_model_has_a_thumbnail() -> None:
    assert render_thumbnail(scene_of(np.zeros((0, 3))), SIZE).shape == (100, 160, 3)
    assert render_thumbnail(scene_of(np.ones((1, 3))), SIZE).shape == (100, 160, 3)
