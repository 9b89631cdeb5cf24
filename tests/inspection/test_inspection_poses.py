"""Poses in another convention are found by the motion that the images show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import tofuse
from tofuse.apps.inspection.pose_convention import difference, misread_poses
from tofuse.apps.inspection.sample import Sample
from tofuse.apps.jobs.pose_scale import with_scale
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry import quaternion, se3
from tofuse.engine.geometry.rays import unit_rays
from tofuse.lab.simulation.record import plan

GL = np.diag([1.0, -1, -1, 1])
BODY = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def rolled(T, shift):
    q = np.roll(quaternion.from_matrix(T[:, :3, :3]), shift, -1)
    out = T.copy()
    out[:, :3, :3] = quaternion.to_matrix(q)
    return out


def turned(T, quarters):
    return T @ se3.exp(np.array([0, 0, 0, 0, 0, quarters * np.pi / 2]))


UNITY = np.diag([1.0, -1, 1, 1])
MISREAD = {
    "T_camera_world, the inverse": se3.inverse,
    "are poses of a camera with the axes of OpenGL": lambda T: T @ GL,
    "T_camera_world of a camera with the axes of OpenGL": lambda T: se3.inverse(T @ GL),
    "the axes of a robot": lambda T: T @ BODY,
    "the left-handed axes of Unity": lambda T: UNITY @ T @ UNITY,
    "order w, x, y, z": lambda T: rolled(T, 1),
    "order x, y, z, w": lambda T: rolled(T, -1),
    "turned by 90 degrees": lambda T: turned(T, -1),
    "turned by 180 degrees": lambda T: turned(T, -2),
    "turned by 270 degrees": lambda T: turned(T, -3),
    "in mm": lambda T: with_scale(T, 1000),
    "in cm": lambda T: with_scale(T, 100),
    "in feet": lambda T: with_scale(T, 3.281),
    "2.5 times as far apart": lambda T: with_scale(T, 2.5),
    "0.4 times as far apart": lambda T: with_scale(T, 0.4),
}
SCALES = ("in feet", "2.5 times as far apart", "0.4 times as far apart")


@pytest.fixture(scope="module")
def recording():
    """A room seen on a way with turns about all axes."""
    made = plan("room")
    camera = Pinhole(80, 60, 70.0, 70.0, 39.5, 29.5)
    rays = unit_rays(camera.rays().reshape(-1, 2))
    rng = np.random.default_rng(4)
    T = made.sequence.T_room_camera(made.raw[0] / made.sequence.frame_rate_hz)
    frames, poses = [], []
    for k in range(9):
        hits = made.scene.cast(T[:3, 3], rays @ T[:3, :3].T)
        z = hits.distance.reshape(60, 80) / np.sqrt((camera.rays() ** 2).sum(-1) + 1)
        z = np.where(np.isfinite(z), z + rng.normal(0, 0.003, z.shape), 0).astype(np.float32)
        frames.append(RangeFrame(k, k / 10, camera, z, "z"))
        poses.append(T)
        step = np.array([0.05, -0.02, 0.03, 0.04, 0.06, -0.03]) * (1 + 0.5 * rng.standard_normal(6))
        T = T @ se3.exp(step)
    return Recording.of(ArraySource(frames, np.array(poses)), "somewhere", "frames")


@pytest.fixture(scope="module")
def sample(recording):
    return Sample.of(recording, 8)


@pytest.mark.parametrize("words", MISREAD)
def test_convention_is_named(sample, recording, words):
    # From a start that is not the identity, as where a device began elsewhere.
    start = se3.exp(np.array([1.0, -2, 0.5, 0.4, 0.9, -0.3]))
    (found,) = misread_poses(sample, MISREAD[words](start @ recording.reference))
    assert found.code == ("depth_scale" if words in SCALES else "poses_misread")
    assert words in found.text
    assert all(np.isfinite(value) for value in found.evidence.values())


@pytest.mark.parametrize(
    ("factor", "words"),
    [(4.0, "the depth is 4 times too large"), (0.2, "the depth is 5 times too small")],
)
def test_depth_of_another_scale_than_the_poses(recording, factor, words):
    frames = [replace(f, depth=f.depth * np.float32(factor)) for f in recording]
    source = ArraySource(frames, recording.reference, metadata={"depth_unit_m": 0.001})
    scaled_recording = Recording.of(source, "somewhere", "frames")
    (found,) = misread_poses(Sample.of(scaled_recording, 8), recording.reference)
    assert found.code == "depth_scale"
    assert words in found.text
    assert found.evidence["factor"] == pytest.approx(1 / factor, rel=0.1)
    assert found.evidence["sigma"] < 0.1 * found.evidence["factor"]


def test_right_poses_are_not_reported(sample, recording):
    rng = np.random.default_rng(1)
    drift = se3.exp(np.cumsum(rng.normal(0, [0.003] * 3 + [0.004] * 3, (9, 6)), 0))
    for poses in (recording.reference, recording.reference @ drift):
        assert not list(misread_poses(sample, poses))


def test_random_poses_are_in_no_convention(sample):
    for seed in range(20):
        poses = se3.exp(np.random.default_rng(seed).normal(0, 1, (9, 6)))
        assert not any("degrees" in f.text for f in misread_poses(sample, poses))


def test_missing_poses_are_left_out(sample, recording):
    poses = recording.reference.copy()
    poses[2:] = np.nan
    assert not list(misread_poses(sample, se3.inverse(poses)))


@pytest.mark.parametrize("quick", [False, True])
def test_inspection_reports_poses_of_recording(recording, quick):
    source = ArraySource(list(recording), recording.reference @ GL)
    found = tofuse.inspect(Recording.of(source, "somewhere", "frames"), quick=quick)
    assert [f.code for f in found.findings if f.severity == "warning"] == ["poses_misread"]


@pytest.mark.parametrize("words", MISREAD)
def test_difference_from_a_reference_is_named(recording, words):
    noise = 0.0002 * np.random.default_rng(1).standard_normal((len(recording), 6))
    reference = recording.reference @ se3.exp(noise)
    estimate = se3.exp(np.array([1.0, 2, 3, 0.4, -0.5, 0.6])) @ recording.reference
    note = difference(MISREAD[words](estimate), reference)
    factor, _, of_images = words.partition(" times as ")
    if of_images:
        larger, factor = ("reference", "2.5") if factor == "0.4" else ("estimate", factor)
        words = f"the {larger} is {factor}"
    assert words.removeprefix("are ") in note
    assert difference(estimate, reference) is None


def test_exact_inverse_may_be_either_trajectory():
    """Both differ from the inverse of the other by rounding only, which 10 m amplify in one."""
    poses = se3.exp(np.random.default_rng(1).normal(0, 0.5, (20, 6)))
    poses[:, 0, 3] += 10
    note = difference(se3.orthonormalise(np.round(se3.inverse(poses), 6)), poses)
    assert "if the estimate or the reference holds T_camera_world" in note


def test_unrelated_trajectories_are_of_no_other_convention():
    """Inverted, one of these differs by 25 degrees instead of 83."""
    steps = np.random.default_rng(487).normal(0, [0.1, 0.03, 0.1, 0.02, 0.3, 0.02], (2, 30, 6))
    assert difference(*se3.exp(np.cumsum(steps, axis=1))) is None


def test_a_slide_is_not_another_scale():
    """The estimate hardly follows a way along a corridor, but its noise is much smaller than it."""
    t = np.linspace(0, 1.6, 20)
    reference = se3.exp(np.outer(t, [0, 0, 1.0, 0, 0, 0]))
    lag = np.where(t < 0.8, 0.1 * t, 0.08 + 0.3 * (t - 0.8))
    assert difference(se3.exp(np.outer(lag, [0, 0, 1.0, 0, 0, 0])), reference) is None
    assert "is 8 times" in difference(reference, with_scale(reference, 8))
