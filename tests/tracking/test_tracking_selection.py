"""Accepted explanations of a view: camera motion, a moving object, or a fast motion."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from coarse_steps import without_multipath
from made_rooms import CAMERA, at, seen
from pose_errors import pose_error
from tofuse.engine.geometry import se3
from tofuse.engine.mapping.config import changed
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.engine.quality.trajectory_errors import displacement
from tofuse.engine.search import pair_agreement
from tofuse.engine.search.verification import FitQuality, FitStatistics
from tofuse.engine.tracking.keyframes import Keyframes
from tofuse.engine.tracking.motion import FrameTime, MotionModel
from tofuse.engine.tracking.selection import Selection
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions

SHARP = SurfaceOptions(radii=(2,))
# A camera that translates and turns slowly.
WALK = [at(-0.4 + 0.03 * k, 0.0, 0.015 * k) for k in range(24)]
FIRST = 10  # first frame with an object before the camera


def run(frames, odometry=None, options=None):
    tracker = (options or Keyframes()).start(0)
    given = odometry or [None] * len(frames)
    return [
        tracker.push(frame, T, prepare_view(frame, SHARP))
        for frame, T in zip(frames, given, strict=True)
    ]


def with_plate(frame, left, right, z=0.7):
    """Put a textured plate of full image height before the camera, between two columns."""
    columns = np.arange(CAMERA.width)
    covered = np.broadcast_to((columns >= left) & (columns < right), frame.depth.shape)
    rng = np.random.default_rng(frame.index)
    depth = np.where(covered, z * (1 + 0.004 * rng.standard_normal(frame.depth.shape)), frame.depth)
    marks = 600 + 300 * (((columns - left) // 5) % 2)
    light = np.where(covered, marks, frame.amplitude_image)
    light = light * (1 + 0.02 * rng.standard_normal(light.shape))
    return replace(frame, depth=depth.astype(np.float32), amplitude_image=light.astype(np.float32))


def off(step, pose, first=WALK[0]):
    """Pose error of a step in component 0, in m and degrees."""
    return pose_error(step.T_component_camera, se3.inverse(first) @ pose)


class Alignments(list):
    """Alignments of a view 1 m from the last pose, whose images agree by `view`."""

    def __init__(self, fits, static=(), confirmed=None):
        keyframe = SimpleNamespace(doubtful=False)
        reference = SimpleNamespace(
            keyframe=keyframe, target=SimpleNamespace(view=0, T_target_world=np.eye(4))
        )
        super().__init__(
            SimpleNamespace(
                fit=FitQuality(kind),
                predicted=predicted,
                view=agreement,
                aligned=SimpleNamespace(converged=True, unobservable=()),
                reference=reference,
                keyframe=keyframe,
                T_component_camera=at(1.0, 0.0, 0.0),
                T_keyframe_camera=at(1.0, 0.0, 0.0),
            )
            for kind, predicted, agreement in fits
        )
        self.now, self.T_last, self.references = FrameTime(0, 0.0), np.eye(4), [reference]
        self.static = lambda _: static
        self.state = SimpleNamespace(
            in_sequence=False,
            motion=MotionModel(),
            fit_statistics=FitStatistics(),
            relocalizer=SimpleNamespace(confirms=lambda *_: confirmed),
        )


@pytest.mark.parametrize(
    ("fit", "predicted", "agreement", "confirmed", "accepted"),
    [
        ("usual", True, 0.5, None, True),
        ("usual", True, -0.1, None, False),  # the images disagree, of an unknown camera
        ("usual", False, 0.5, True, True),
        ("usual", False, 0.5, False, False),
        ("usual", False, 0.5, None, False),
        ("noisy", True, 0.5, None, True),
        ("noisy", True, -0.1, None, False),
        ("noisy", False, 0.5, True, False),
        ("conflicting", True, 0.5, True, False),
        ("conflicting", False, 0.5, True, False),
    ],
)
def test_cases_of_fit_and_motion(monkeypatch, fit, predicted, agreement, confirmed, accepted):
    monkeypatch.setattr(pair_agreement, "agreement", lambda view, *_: SimpleNamespace(score=view))
    alignments = Alignments([(fit, predicted, agreement)], confirmed=confirmed)
    assert Selection(alignments).best() is (alignments[0] if accepted else None)


def test_conflict_is_explained_by_objects_or_rivals(monkeypatch) -> None:
    monkeypatch.setattr(pair_agreement, "agreement", lambda view, *_: SimpleNamespace(score=view))
    for rival, chosen in ((0.5, 1), (0.9, None)):
        alignments = Alignments([("conflicting", True, rival), ("usual", True, 0.5)])
        assert Selection(alignments).best() is (None if chosen is None else alignments[chosen])
    static = Alignments([("noisy", True, 0.5), ("usual", True, 0.4)])
    alignments = Alignments([("conflicting", True, 0.9), ("usual", True, 0.5)], static)
    assert Selection(alignments).best() is static[1]


@pytest.mark.nightly_part
def test_passing_object_does_not_drag_poses() -> None:
    """A plate moves with the camera at 3 cm per frame: nearly half a metre in total."""
    frames = []
    for k, T in enumerate(WALK):
        frame = seen(T, k)
        if k >= FIRST:
            right = min(12 * (k - FIRST + 1), 100)
            frame = with_plate(frame, right - 48, right)
        frames.append(frame)
    steps = run(frames)
    assert [step.component for step in steps] == [0] * len(WALK)
    for step, pose in zip(steps, WALK, strict=True):
        metres, degrees = off(step, pose)
        assert metres < 0.03
        assert degrees < 1.5
    assert sum(step.moving is not None for step in steps[FIRST:]) > len(steps[FIRST:]) / 2
    assert all(step.moving is None for step in steps[:FIRST])


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("there", "component"),
    [(at(0.35, 0.3, 0.25), 1), (at(-0.4, 0.0, 0.25), 0), (at(0.45, 0.0, 0.25), 1)],
)
def test_camera_jump_is_not_explained_by_moving_objects(there, component) -> None:
    """Differences after a jump in the same room are as coherent as those of a moving object."""
    frames = [seen(T, k) for k, T in enumerate(WALK[:12])]
    frames += [seen(there, 12 + k) for k in range(3)]
    steps = run(frames)
    assert [step.component for step in steps] == [0] * 12 + [component] * 3
    for step in steps[12:]:
        assert step.moving is None
        assert off(step, there, there if component else WALK[0])[0] < 0.03
    for link in steps[12].links:
        true = se3.inverse(WALK[link.i]) @ there
        assert not link.certain or pose_error(link.T_i_j, true)[0] < 0.03


def test_fast_turn_keeps_component_if_search_is_certain() -> None:
    path = [*WALK[:12], *(at(-0.07 + 0.03 * k, 0.0, 0.165 + 0.45 + 0.015 * k) for k in range(6))]
    steps = run([seen(T, k) for k, T in enumerate(path)])
    assert [step.component for step in steps] == [0] * len(path)
    assert "found by a search" in steps[12].reason
    for step, pose in zip(steps, path, strict=True):
        assert off(step, pose)[0] < 0.03


def test_fast_turn_measured_by_odometry_needs_no_search() -> None:
    rng = np.random.default_rng(5)
    path = [T @ se3.exp([0, 0, 0, *rng.normal(0, 0.01, 3)]) for T in WALK[:12]]
    path += [at(-0.07 + 0.03 * k, 0.0, 0.615 + 0.015 * k) for k in range(6)]
    frames = [seen(T, k) for k, T in enumerate(path)]
    never = Keyframes(searches=False)
    assert max(step.component for step in run(frames, options=never)) > 0
    steps = run(frames, path, never)
    assert [step.component for step in steps] == [0] * len(path)
    for step, pose in zip(steps, path, strict=True):
        assert off(step, pose, path[0])[0] < 0.03


@pytest.mark.parametrize(("jump", "kept"), [(0.0, True), (0.5, False)])
def test_view_that_fits_nowhere_keeps_the_pose_of_proven_odometry(jump, kept) -> None:
    """One view of another room; odometry that jumps there as well proves nothing."""
    rng = np.random.default_rng(6)
    path = [T @ se3.exp([*rng.normal(0, 0.01, 3), 0, 0, 0]) for T in WALK]
    frames = [seen(T, k) for k, T in enumerate(path)]
    k = 14
    frames[k] = seen(path[k], k, boxes=(), spots=90, scene=9, half=(2.6, 1.4, 2.4))
    odometry = [at(jump if n >= k else 0.0, 0.0, 0.0) @ T for n, T in enumerate(path)]
    steps = run(frames, odometry, Keyframes(searches=False))
    assert (steps[k].component == 0) is kept
    if kept:
        assert "by odometry" in steps[k].reason
        assert len(steps[k].registration.unobservable) == 6
        assert max(step.component for step in steps) == 0
        assert max(off(s, T, path[0])[0] for s, T in zip(steps, path, strict=True)) < 0.03


@pytest.mark.nightly
def test_new_component_continues_motion() -> None:
    """Another room from one frame to the next, with the same camera motion."""
    frames = [seen(T, k) for k, T in enumerate(WALK[:12])]
    frames += [
        seen(T, 12 + k, boxes=(), spots=90, scene=9, half=(2.6, 1.4, 2.4))
        for k, T in enumerate(WALK[12:])
    ]
    steps = run(frames)
    assert [step.component for step in steps] == [0] * 12 + [1] * 12
    assert "no prediction" not in steps[13].reason
    for step, pose in zip(steps[12:], WALK[12:], strict=True):
        assert off(step, pose, WALK[12])[0] < 0.03


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("scene", "camera", "taken", "bound"),
    [
        # Steps of 26 cm: a wall fits anywhere, and the objects before it are out of reach.
        ("rail", "ifm-o3r", {"every": 20, "frames": 16}, 0.04),
        # Steps of 14, 37 and 46 cm: the prediction is too short; 0.27 m if started only near it.
        ("corridor", "sr4000", {"every": 12}, 0.02),
    ],
)
def test_large_steps_along_walls_are_searched(tmp_path, scene, camera, taken, bound) -> None:
    recording = without_multipath(tmp_path, scene, camera, **taken)
    changes = {"refinement": {"part": "none"}} if scene == "rail" else {}
    config = changed(from_method("default"), changes | {"fusion": {"voxel_m": 0.1}}, where="test")
    result = reconstruct(recording, config)
    assert result.has_pose.all()
    assert displacement(recording.reference, result.trajectory)[0] < bound
    assert scene == "corridor" or not any(len(f.unobservable) for f in result.diagnostics.frames)
