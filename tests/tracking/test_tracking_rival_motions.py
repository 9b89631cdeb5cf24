"""What is near must not win by its size in the image, and an open choice must be noticed."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.tracking.keyframe_map import Keyframe
from tofuse.engine.tracking.keyframes import Keyframes
from tofuse.engine.tracking.rival_motions import STANDS, STOOD, Rival, RivalMotions, Rivalry
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions
from tofuse.formats.recordings.open import open_recording

WIDTH, HEIGHT, FOCAL = 160, 120, 140.0
CAMERA = Pinhole(WIDTH, HEIGHT, FOCAL, FOCAL, 79.5, 59.5)
NEAR_M, FAR_M, SHIFT = 0.8, 1.6, 16


def relief(metres: float, seed: int) -> np.ndarray:
    """A wavy surface, wider than the image."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:HEIGHT, : 2 * WIDTH]
    waves = [
        np.sin(
            2 * np.pi * (u * np.cos(a) + v * np.sin(a)) / rng.uniform(35, 60) + rng.uniform(0, 6)
        )
        for a in rng.uniform(0, np.pi, 4)
    ]
    return metres * (1 + 0.03 * np.sum(waves, axis=0))


def image(index: int, columns: int, shift: int = 0) -> RangeFrame:
    """A near surface in the first columns, which has moved by some pixels, before a far one."""
    depth = relief(FAR_M, 1)[:, :WIDTH]
    depth[:, :columns] = relief(NEAR_M, 2)[:, 40 - shift : 40 - shift + columns]
    depth += np.random.default_rng([3, index]).normal(0, 0.002, depth.shape) * depth
    return RangeFrame(index, index / 15, CAMERA, depth.astype(np.float32))


def compared(columns: int, T: np.ndarray, rivals: dict[str, np.ndarray]) -> Rivalry:
    """Compare a tracked motion with its rivals, where the near surface moved in between."""
    before = prepare_view(image(0, columns), SurfaceOptions())
    now = prepare_view(image(2, columns, SHIFT), SurfaceOptions())
    keyframe = Keyframe(before, np.eye(4), 0)
    others = {name: Rival(keyframe, T_rival) for name, T_rival in rivals.items()}
    return RivalMotions().compare(now, T, {STANDS: Rival(keyframe, T), **others}, 1.0)


WITH_NEAR = se3.translation((-SHIFT * NEAR_M / FOCAL, 0.0, 0.0))


def test_camera_that_follows_near_surface_is_noticed() -> None:
    share, winner, rest = compared(110, WITH_NEAR, {STANDS: np.eye(4)})
    assert share > 0.4  # of the view; more is occluded, or out of view
    assert winner == STANDS
    assert 0.25 < rest < 0.75  # the near surface is larger in the image, and still is open


def test_near_surface_does_not_win_by_its_size() -> None:
    share, winner, _ = compared(110, np.eye(4), {"goes on": WITH_NEAR})
    assert share > 0.25
    assert winner == ""


def test_small_near_surface_leaves_nothing_open() -> None:
    share, winner, _ = compared(16, np.eye(4), {"goes on": WITH_NEAR})
    assert share < 0.25
    assert winner == ""


def test_equal_motions_are_no_rivals() -> None:
    assert compared(110, np.eye(4), {STANDS: np.eye(4)}) == Rivalry(0.0)


def test_rival_that_everything_follows_leaves_nothing_open() -> None:
    """The tracked motion was wrong, and nothing else moves."""
    share, winner, rest = compared(0, WITH_NEAR, {STANDS: np.eye(4)})
    assert share > 0.7
    assert winner == STANDS
    assert rest < 0.1


def test_share_is_that_of_the_view() -> None:
    """All that is decided follows the rival; most of both views is too noisy to tell."""
    views = []
    for index, shift in ((0, 0), (2, SHIFT)):
        frame = image(index, 70, shift)
        noise = np.random.default_rng(index).uniform(1, 3, frame.depth.shape)
        noisy = np.where(np.arange(WIDTH) < 70, frame.depth, noise).astype(np.float32)
        frame = RangeFrame(index, index / 15, CAMERA, noisy)
        views.append(prepare_view(frame, SurfaceOptions()))
    keyframe = Keyframe(views[0], np.eye(4), 0)
    rivals = {STANDS: Rival(keyframe, np.eye(4)), "goes on": Rival(keyframe, WITH_NEAR)}
    share, _, _ = RivalMotions().compare(views[1], np.eye(4), rivals, 1.0)
    assert 0.2 < share < 0.4


def test_rival_that_has_become_the_tracked_motion_is_none() -> None:
    before = prepare_view(image(0, 110), SurfaceOptions())
    now = prepare_view(image(2, 110, SHIFT), SurfaceOptions())
    keyframe = Keyframe(before, np.eye(4), 0)
    motions = RivalMotions()
    for T_rival, is_open in ((WITH_NEAR, True), (np.eye(4), False)):
        rivals = {STANDS: Rival(keyframe, np.eye(4)), "goes on": Rival(keyframe, T_rival)}
        for _ in range(2):  # every second view is compared
            share = motions.compare(now, np.eye(4), rivals, 1.0).share
        assert (share > 0.25) == is_open


@pytest.mark.parametrize("columns", [80, 120])
def test_somebody_near_does_not_take_the_camera_along(columns: int) -> None:
    tracker = Keyframes().start(0)
    steps = []
    for k in range(24):
        near = columns if 8 <= k < 18 else 0
        steps.append(tracker.push(image(k, near, 2 * (k - 8))))
    assert {step.component for step in steps} == {0}
    for step in steps:
        assert np.linalg.norm(step.T_component_camera[:3, 3]) < 0.02


@pytest.mark.parametrize(("winner", "left"), [(STANDS, 0.1), ("", 0.9)])
def test_adopted_rival_leaves_open_what_does_not_follow_it(monkeypatch, winner, left) -> None:
    monkeypatch.setattr(RivalMotions, "compare", lambda *_: Rivalry(0.9, winner, 0.1))
    tracker = Keyframes().start(0)
    steps = [tracker.push(image(k, 0)) for k in range(2)]
    assert steps[1].rival == left


def test_what_moves_slowly_is_noticed_in_the_long_run() -> None:
    """From view to view the far surface agrees with either motion."""
    tracker = Keyframes().start(0)
    steps = [tracker.push(image(k, 110, k)) for k in range(20)]
    followed = [np.linalg.norm(step.T_component_camera[:3, 3]) for step in steps]
    assert max(followed) > 0.06
    assert followed[-1] < 0.02
    assert max(step.rival for step in steps) > 0.25


def test_camera_that_moves_does_not_stand_since_long_ago() -> None:
    views = [prepare_view(image(k, 0), SurfaceOptions()) for k in range(4)]
    rivals = RivalMotions()
    first = Keyframe(views[0], np.eye(4), 0)
    rivals.compare(views[1], np.eye(4), {STANDS: Rival(first, np.eye(4))}, 1.0)
    assert rivals.stood_since is first
    # Nothing is seen of the view of long ago.
    away = se3.translation((3.0, 0.0, 0.0))
    now = Keyframe(views[2], away, 0)
    others = {STANDS: Rival(now, away), STOOD: Rival(first, np.eye(4))}
    rivals.compare(views[2], away, others, 1.0)
    rivals.compare(views[3], away, others, 1.0)
    assert rivals.stood_since is now


def test_real_person_who_fills_the_view_is_noticed(shared_data) -> None:
    """The camera stands; its background, a quarter of the view, is three times as far away."""
    tracker = Keyframes().start(0)
    steps = [tracker.push(f) for f in open_recording(shared_data / "cases/person_fills_view")]
    moved = [np.linalg.norm(step.T_component_camera[:3, 3]) for step in steps]
    assert max(moved) < 0.1
    assert max(step.rival for step in steps) > 0.5
