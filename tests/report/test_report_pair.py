"""The scene of a registered pair: its content, and the distances between the views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from registration_scenes import relief, view
from tofuse.apps.pairs.page import PairScene, distances, packed, still
from tofuse.apps.pairs.result import PairResult
from tofuse.apps.report import thumbnails
from tofuse.engine.alignment.base import Registration
from tofuse.engine.geometry import se3
from tofuse.formats.recordings.open import SingleView
from unpacked import unpack

T = se3.exp([0.1, -0.05, 0.02, 0.02, 0.1, -0.05])


def local(points: np.ndarray, format: str = "ply", center=(0, 0, 0)) -> SingleView:  # noqa: A002
    frame = replace(view(points), shift=np.asarray(center, float))
    return SingleView("a", "a", format, 0, frame)


def pair(points: np.ndarray, others: np.ndarray, pose=T, start=None, **more) -> PairResult:
    found = Registration(pose, True, 1, 1, 1, 0.0, 0.002, np.eye(6))
    start = np.eye(4) if start is None else start
    return PairResult(local(points, **more), local(others, **more), found, start)


def sheet(seed: int, low: float = 0.0, high: float = 1.0, z: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    flat = rng.uniform([low, 0], [high, 1], (6000, 2))
    return np.column_stack([flat, z + rng.normal(0, 0.003, len(flat))])


def test_distances_are_between_surfaces_not_noise() -> None:
    ours, theirs = sheet(1, z=1.012), sheet(2)
    found = distances(ours, theirs, np.arange(len(ours)))
    assert np.isfinite(found).mean() > 0.97
    assert np.median(found) == pytest.approx(0.012, abs=5e-4)
    # Beside the other surface there is no counterpart, however close its edge.
    aside = distances(sheet(3, 1.1, 1.5), theirs, np.arange(6000))
    assert np.isinf(aside).mean() > 0.97
    assert np.isinf(distances(ours[:9], theirs, np.arange(9))).all()


def decoded(data: dict, mode: str, which: str) -> np.ndarray:
    (layer,) = (x for x in data["layers"] if (x["mode"], x["view"]) == (mode, which))
    steps = unpack(data["arrays"][layer["points"]], "<u2", 3)
    assert len(steps) == layer["count"]
    return layer["low"] + steps / 65535 * np.array(layer["extent"])


def test_layers_are_placed_by_poses() -> None:
    others, points = relief(900, 1), se3.transform(se3.inverse(T), relief(800, 2))
    start = se3.exp([0.3, 0, 0, 0, 0, 0.2])
    scene = PairScene.of(pair(points, others, start=start))
    data = packed(scene)
    for mode, which, truth in (
        ("before", "source", se3.transform(start, points)),
        ("after", "source", se3.transform(T, points)),
        ("distance", "source", se3.transform(T, points)),
        ("before", "target", others),
        ("after", "target", others),
    ):
        np.testing.assert_allclose(decoded(data, mode, which), truth, atol=1e-4)
    assert len(scene.matched) / len(scene.all_distances) > 0.8
    assert np.median(scene.matched) < 0.01
    assert scene.cap_m * 1000 in (1, 2, 5, 10, 20)
    # All are framed by the visible content, identically, so that nothing jumps.
    assert data["outlines"]["before"] == data["outlines"]["after"]


def test_wrong_pose_is_visible() -> None:
    others, points = relief(3000, 1), se3.transform(se3.inverse(T), relief(3000, 2))
    right = PairScene.of(pair(points, others))
    wrong = PairScene.of(pair(points, others, pose=se3.exp([0, 0, 0.03, 0, 0, 0]) @ T))
    assert np.median(wrong.matched) > 4 * np.median(right.matched)
    filled = (still(right) != thumbnails.BACKGROUND).any(-1)
    assert 0.1 < filled.mean() < 0.95
    assert not filled[[0, -1]].all(1).any()


@pytest.mark.parametrize(
    ("format", "center", "up"), [("ply", (0, 0, 0), False), ("las", (0, 0, 0), True),
                                 ("ply", (5e5, 4e6, 0), True)],
)  # fmt: skip
def test_maps_and_scans_are_upright(format, center, up) -> None:  # noqa: A002
    """Down is y for the viewer; in a map up is z."""
    points = relief(500, 1)
    scene = PairScene.of(pair(points, points, pose=np.eye(4), format=format, center=center))
    shown = scene.points["target"]
    turned = np.column_stack([points[:, 0], -points[:, 2], points[:, 1]])
    np.testing.assert_allclose(shown, turned if up else points, atol=1e-5)
