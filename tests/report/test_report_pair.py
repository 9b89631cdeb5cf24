"""The scene of a registered pair: its content, and the distances between the views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from registration_scenes import relief, view
from tofuse.apps.pairs.page import COLORS, distances, pair_scene
from tofuse.apps.pairs.result import PairResult
from tofuse.apps.report import thumbnails
from tofuse.apps.report.scene import render
from tofuse.engine.alignment.base import Registration
from tofuse.engine.geometry import se3
from tofuse.formats.recordings.open import SingleView

T = se3.exp([0.1, -0.05, 0.02, 0.02, 0.1, -0.05])


def local(points: np.ndarray, up=None, center=(0, 0, 0)) -> SingleView:
    frame = replace(view(points), shift=np.asarray(center, float), up=up)
    return SingleView("a", "a", "ply", 0, frame)


def pair(points: np.ndarray, others: np.ndarray, pose=T, **more) -> PairResult:
    found = Registration(pose, True, 1, 1, 1, 0.0, 0.002, np.eye(6))
    return PairResult(local(points, **more), local(others, **more), found)


def sheet(seed: int, low: float = 0.0, high: float = 1.0, z: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    flat = rng.uniform([low, 0], [high, 1], (6000, 2))
    return np.column_stack([flat, z + rng.normal(0, 0.003, len(flat))])


def test_far_sparse_points_do_not_decide_what_is_framed() -> None:
    rng = np.random.default_rng(1)
    ranges = rng.exponential(2.0, 20_000)[:, None]  # as the points of a scanner thin out
    points = ranges * rng.normal(size=(20_000, 3)) * [1, 1, 0.1]
    scene, _ = pair_scene(pair(points, points, np.eye(4)))
    assert np.ptp(scene.framed, axis=0)[0] < 0.2 * np.ptp(points[:, 0])


def test_hidden_cameras_are_not_framed() -> None:
    """The model filled the upper half of the picture, above cameras that are not shown."""
    scene, _ = pair_scene(pair(sheet(1), sheet(2), np.eye(4)))
    poses = se3.pose(np.eye(3), [0.5, 0.5, -0.5])[None]
    shown = replace(scene, after=poses)
    assert shown.box[0, 2] == -0.5
    assert shown.framed[:, 2].min() > 0.9


def test_distances_are_from_surfaces_not_points() -> None:
    ours, theirs = sheet(1, z=1.012), sheet(2)
    up = np.tile([0.0, 0, 1], (len(theirs), 1))
    found = distances(ours, theirs, up, 0.1)
    assert 0.009 < np.median(found) < 0.013  # the nearest of noisy points
    # Beside the other surface there is no counterpart, however close its plane.
    assert (distances(sheet(3, 1.2, 1.5), theirs, up, 0.1) > 0.1).mean() > 0.97
    assert np.isinf(distances(ours, theirs[:0], up[:0], 0.1)).all()


def test_views_are_placed_by_the_pose() -> None:
    others, points = relief(900, 1), se3.transform(se3.inverse(T), relief(800, 2))
    scene, field = pair_scene(pair(points, others))
    np.testing.assert_allclose(scene.points[:800], se3.transform(T, points), atol=1e-5)
    np.testing.assert_allclose(scene.points[800:], others, atol=1e-5)
    assert (scene.colors[:800] == COLORS["source"]).all()
    assert (scene.colors[800:] == COLORS["target"]).all()
    assert len(field.values) == 1700
    assert np.median(field.values) < 0.01


def test_wrong_pose_is_visible() -> None:
    others, points = relief(3000, 1), se3.transform(se3.inverse(T), relief(3000, 2))
    scene, right = pair_scene(pair(points, others))
    _, wrong = pair_scene(pair(points, others, pose=se3.exp([0, 0, 0.03, 0, 0, 0]) @ T))
    assert np.median(wrong.values) > 4 * np.median(right.values)
    filled = (render(scene) != thumbnails.BACKGROUND).any(-1)
    assert 0.1 < filled.mean() < 0.95


@pytest.mark.parametrize(
    ("up", "center", "is_turned"),
    [
        (None, (0, 0, 0), False),
        (np.array([0.0, 0, 1]), (0, 0, 0), True),
        (None, (5e5, 4e6, 0), True),
    ],
)
def test_maps_and_scans_are_upright(up, center, is_turned) -> None:
    """Down is y for the viewer; in a map up is z."""
    points = relief(500, 1)
    scene, _ = pair_scene(pair(points, points, pose=np.eye(4), up=up, center=center))
    shown = scene.points[500:]
    turned = np.column_stack([points[:, 0], -points[:, 2], points[:, 1]])
    np.testing.assert_allclose(shown, turned if is_turned else points, atol=1e-5)
