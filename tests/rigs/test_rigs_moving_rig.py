"""A moving rig: from the trajectories of the cameras to the rig and back."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from boxes_in_room import views_in_room
from pose_errors import assert_near, pose_error
from rig_room import ROOM
from rig_scene import CAMERA, looked_at
from tofuse.apps.rigs.calibrating import calibrate_cameras
from tofuse.apps.rigs.hand_eye import HandEye, Track, hand_eye
from tofuse.apps.rigs.inputs import Calibration, Camera
from tofuse.apps.rigs.moving_rig import (
    _common_world,
    _initial_offset,
    _JointViews,
    _too_uncertain,
    _views,
)
from tofuse.apps.rigs.rig_trajectory import refined
from tofuse.apps.rigs.run import reconstruct_rig
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.mapping.config import changed
from tofuse.engine.mapping.methods import from_method
from tofuse.formats.rigs.rig_source import RigSource
from tofuse.lab.world.paths import look_at, rotation

CLOCK = 0.012
COUNT = 18
# Boards on all sides, which constrain each camera.
BOARDS = (
    *ROOM,
    ((-1.0, 0.0, 0.0), 1.8, 9.0),
    ((0.0, -1.0, 0.0), 1.8, 9.0),
    ((0.1, -0.8, 0.5), 0.9, 0.4),
    ((-0.7, -0.5, 0.4), 1.0, 0.4),
)


def path(t: float) -> np.ndarray:
    at = np.array([0.1 * np.sin(1.9 * t), 0.12 * np.sin(2.6 * t), 0.9 + 0.08 * np.sin(3.1 * t)])
    T = look_at(at, np.add(at, [1.0, 0.0, -0.35]))
    angles = [0.16 * np.sin(2.9 * t), 0.35 * np.sin(1.7 * t), 0.16 * np.sin(3.7 * t + 1)]
    return T @ rotation(angles)


def mounted() -> np.ndarray:
    T = rotation([0.03, -1.2, 0.02])
    T[:3, 3] = [-0.08, 0.01, -0.03]
    return T


@cache
def cameras() -> tuple[Camera, Camera]:
    found = []
    for k, (rate, clock, T) in enumerate(((15.03, 0.0, np.eye(4)), (15.14, CLOCK, mounted()))):
        rng = np.random.default_rng([k, 2])
        frames = []
        for i in range(COUNT):
            stamp = i / rate + 1.0 - clock
            pose = path(stamp + clock) @ T
            image = looked_at(pose, rng, 0.0, BOARDS)
            frames.append(RangeFrame(i, stamp, CAMERA, image.depth, "z", None))
        found.append(Camera(f"cam{k}", Recording.of(ArraySource(frames), f"cam{k}", "array")))
    return found[0], found[1]


@cache
def calibrated() -> Calibration:
    return calibrate_cameras(cameras())


@pytest.mark.nightly
def test_moving_rig_is_calibrated_from_its_trajectories() -> None:
    found = calibrated()
    assert found.how == "a walk"
    assert not found.rig.unplaced
    camera = found.rig.cameras[1]
    assert_near(camera.T_rig_camera, mounted(), 0.03, 1.0)
    assert abs(camera.time_offset_s - CLOCK) < 0.004
    e = se3.log(se3.inverse(camera.T_rig_camera) @ mounted())
    assert e @ np.linalg.solve(camera.covariance, e) < 22.5  # 99.9 % of chi-square, 6 degrees


@pytest.mark.nightly
def test_each_instant_of_moving_rig_has_one_pose() -> None:
    rig = calibrated().rig
    source = RigSource(rig, [camera.recording for camera in cameras()])
    recording = Recording.of(source, "rig", "rig")
    config = changed(from_method("default"), {"fusion": {"voxel_m": 0.1}}, where="test")
    found = reconstruct_rig(cameras(), recording, config)
    assert len(found.times) == len(found.poses) == len(recording) // 2
    truth = np.stack([path(t) for t in found.times])
    assert pose_error(found.poses, se3.inverse(truth[0]) @ truth)[0] < 0.003
    # The clocks are independent: each image has its own time.
    mount, seen = (np.eye(4), mounted()), zip(recording.timestamps, source.camera, strict=True)
    images = np.stack([path(t) @ mount[camera] for t, camera in seen])
    assert_near(found.result.trajectory, se3.inverse(truth[0]) @ images, 0.003, 0.1)
    between = se3.inverse(found.result.trajectory[::2]) @ found.result.trajectory[1::2]
    strayed = pose_error(between, rig.cameras[1].T_rig_camera)
    assert strayed[1] > 0.2  # degrees, at times of the first camera's images
    # The second camera sees a single wall for a while; the first one constrains the rig pose.
    assert result_is_bounded(found.result)


def result_is_bounded(result) -> bool:
    d = result.diagnostics
    assert d.verdict == "good"
    assert not d.accuracy.unbounded
    return d.accuracy.position_m < 0.02


def test_views_of_all_cameras_refine_path_of_rig() -> None:
    rig = calibrated().rig
    recording = Recording.of(RigSource(rig, [c.recording for c in cameras()]), "rig", "rig")
    of_rig = np.repeat(np.arange(len(recording) // 2), 2)
    truth = np.stack([path(t) for t in recording.timestamps[::2]])
    truth = se3.inverse(truth[0]) @ truth
    drift = np.linspace(0, 1, len(truth))[:, None] * [0.01, -0.01, 0.005, 0.003, -0.004, 0.002]
    mount = (np.eye(4), mounted())
    images = np.stack([path(t) @ mount[k % 2] for k, t in enumerate(recording.timestamps)])
    T_rig_frame = se3.inverse(truth[of_rig]) @ se3.inverse(images[0]) @ images
    start = truth @ se3.exp(drift)
    found = refined(cameras(), recording, start, T_rig_frame, of_rig)
    off = (se3.inverse(truth) @ poses for poses in (start, found.poses))
    before, after = (np.linalg.norm(T[:, :3, 3], axis=1) for T in off)
    assert before.max() > 0.014
    assert after.max() < 0.3 * before.max()
    (ends,) = found.disagreement
    assert ends == (0, 1)
    assert found.disagreement[ends][0] < 0.004
    assert found.disagreement[ends][1] > 1000
    assert len(found.measured) > 100


def test_split_half_reveals_systematic_errors() -> None:
    times = np.arange(40) / 20.0
    world = np.stack([path(t) for t in times])
    fit = HandEye(mounted(), np.eye(6), np.eye(4), 0.0, 0.0)
    error = np.array([0.004, -0.001, 0.002, 0.001, 0.0, -0.002])

    def tracks(by: np.ndarray) -> dict[int, Track]:
        return {0: Track(times, world), 1: Track(times, world @ mounted() @ se3.exp(by))}

    together = _JointViews({})
    together._halves = [(tracks(error), tracks(-error))]
    found = together.systematic(1, fit)
    np.testing.assert_allclose(found, np.outer(error, error), atol=1e-7)
    # Motion of a single half does not constrain the camera.
    together._halves = [(tracks(error), tracks(0 * error))]
    np.testing.assert_allclose(together.systematic(1, fit), 0, atol=1e-7)


def walked(clock: float = 0.0, T: np.ndarray | None = None, seconds: float = 6.0) -> Track:
    """The trajectory of a camera on the rig by its own clock, without errors."""
    times = np.arange(round(30 * seconds)) / 30.0
    poses = np.stack([path(t) @ (np.eye(4) if T is None else T) for t in times])
    return Track(times - clock, se3.inverse(poses[0]) @ poses)


def test_frames_out_of_order_have_the_track_and_views_of_their_times() -> None:
    ordered, order = walked(), np.random.default_rng(4).permutation(180)
    track = Track.of(ordered.times[order], ordered.poses[order])
    np.testing.assert_array_equal(track.times, ordered.times)
    np.testing.assert_array_equal(track.poses, ordered.poses)
    camera = SimpleNamespace(
        recording=SimpleNamespace(timestamps=ordered.times[order]),
        image=lambda k: order[k],  # its place in order
        surface=lambda place: place,
    )
    for row, place in _views(camera, track, 7):
        assert row == place


def clock_between(first: Track, second: Track) -> tuple[float, list[str]]:
    notes: list[str] = []
    return _initial_offset(cameras(), [first, second], 1, notes), notes


def test_clocks_an_hour_apart_are_aligned_by_rotations() -> None:
    offset, notes = clock_between(walked(), walked(3600.0, mounted()))
    assert abs(offset - 3600.0) < 0.01
    assert "cam1 differs by 3600" in notes[0]


def test_cameras_with_different_rotations_are_refused() -> None:
    first = walked()
    rng = np.random.default_rng(2)
    turns = np.cumsum(rng.normal(size=(len(first.times), 3)) * 0.05, axis=0)
    other = np.tile(np.eye(4), (len(first.times), 1, 1))
    other[:, :3, :3] = se3.so3_exp(turns)
    with pytest.raises(RegistrationError, match="rotation differs from that of cam0"):
        clock_between(first, Track(first.times, other))
    with pytest.raises(RegistrationError, match="after those of cam0"):
        clock_between(first, Track(first.times + 3600.0, other))


def on_a_cart(distance: float, noise: float = 1e-3) -> HandEye:
    """Two cameras on a cart that drives `distance` m on a flat floor and rotates."""
    times = np.arange(180) / 30.0
    world = np.tile(np.eye(4), (len(times), 1, 1))
    world[:, :3, :3] = se3.so3_exp(np.outer(0.8 * np.sin(1.3 * times), [0.0, 1.0, 0.0]))
    world[:, 0, 3] = distance * np.sin(0.7 * times)
    world[:, 2, 3] = distance * np.cos(0.9 * times)
    rng = np.random.default_rng(3)

    def track(T: np.ndarray) -> Track:
        poses = world @ T @ se3.exp(noise * rng.normal(size=(len(times), 6)))
        return Track(times, se3.inverse(poses[0]) @ poses)

    return hand_eye(track(np.eye(4)), track(mounted()), 0.0)


def test_rotation_about_one_axis_does_not_constrain_spacing_along_it() -> None:
    fit = on_a_cart(1.0)
    assert "rotate the rig about two axes" in _too_uncertain(fit, 2.0)
    off = fit.T_a_b[:3, 3] - mounted()[:3, 3]
    R = fit.T_a_b[:3, :3]
    sigma = np.sqrt(np.diag(R @ fit.covariance[:3, :3] @ R.T))
    assert sigma[1] > 0.5  # along the axis, whatever noise suggests
    assert sigma[[0, 2]].max() < 0.01
    assert (np.abs(off) < 3 * sigma + 1e-4).all()


def test_registered_views_decide_what_the_motion_leaves_open() -> None:
    """A rig that only turns about the vertical: any height of the second camera fits it."""
    lens = Pinhole(80, 60, 60.0, 60.0, 39.5, 29.5)
    mount = se3.pose(rotation([0.0, 0.3, 0.0])[:3, :3], np.array([0.2, 0.0, 0.05]))
    world = np.stack([rotation([0.0, 0.04 * k, 0.0]) for k in range(14)])
    times = np.arange(14) / 10.0
    rig, tracks = [], []
    for k, T in enumerate((np.eye(4), mount)):
        poses = world @ T
        frames = views_in_room(lens, poses, 0.002, seed=k)
        rig.append(Camera(f"cam{k}", Recording.of(ArraySource(frames), f"cam{k}", "array")))
        tracks.append(Track(times, se3.inverse(poses[0]) @ poses))
    off = se3.translation((0.0, 0.6, 0.0))
    open_fit = HandEye(off @ mount, np.diag([1.0] * 3 + [0.01] * 3), off @ mount, 0.0, 0.01)
    assert_near(_common_world(rig, tracks, 1, open_fit).T_a_b, mount, 0.02, 0.5)
    certain = HandEye(mount, 1e-6 * np.eye(6), mount, 0.0, 0.01)
    assert _common_world(rig, tracks, 1, certain) is certain
    elsewhere = [replace(f, depth=np.full_like(f.depth, 30.0)) for f in rig[1].recording]
    rig[1] = Camera("cam1", Recording.of(ArraySource(elsewhere), "cam1", "array"))
    with pytest.raises(RegistrationError, match="rotate the rig about two axes"):
        _common_world(rig, tracks, 1, open_fit)


def test_motion_in_all_directions_constrains_camera() -> None:
    assert _too_uncertain(hand_eye(walked(), walked(0.0, mounted()), 0.0), 2.0) == ""
