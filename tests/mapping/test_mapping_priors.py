"""A device's own poses are used if requested and consistent."""

from __future__ import annotations

import copy
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tofuse
from ray_casting import rays_at, to_plane
from report_results import lonely
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import POSES_BY, ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.graph.external_sensors import GravityEdges, OdometryEdges
from tofuse.engine.mapping.adaptation import with_odometry_prior, with_prior
from tofuse.engine.mapping.config import changed
from tofuse.engine.mapping.mapper import Mapper
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.mapping.reconstructing import device_up, reconstruct
from tofuse.engine.quality.trajectory_errors import displacement
from tofuse.engine.results.types import FrameRecord
from tofuse.engine.tracking.rival_motions import RivalMotions, Rivalry
from tofuse.formats.recordings.open import open_recording

# Only the poses matter: the model is coarse.
COARSE = changed(from_method("default"), {"fusion": {"voxel_m": 0.1}}, where="test")


@pytest.fixture(scope="module")
def recording(room_recording: Path) -> Recording:
    return open_recording(room_recording)


def by_phone(recording: Recording, poses=None) -> Recording:
    """The recording as if its reference poses, or others, were those of a phone."""
    frames = list(recording)
    found = recording.reference if poses is None else np.asarray(poses)
    source = ArraySource(frames, found, metadata={**recording.metadata, POSES_BY: "ARKit"})
    return Recording.of(source, recording.path, recording.format)


def kinds(config) -> list[type]:
    return [type(sensor) for sensor in config.priors]


def test_device_poses_are_used_as_odometry(recording) -> None:
    phone = by_phone(recording)
    led, config = with_prior(phone, from_method("default"), "auto")
    assert kinds(config) == [GravityEdges, OdometryEdges]
    np.testing.assert_array_equal(led.odometry, recording.reference)
    # They remain the reference for comparison.
    np.testing.assert_array_equal(led.reference, recording.reference)
    assert led[0].index == phone[0].index
    np.testing.assert_array_equal(copy.deepcopy(led).odometry, recording.reference)


def test_reference_poses_are_used_for_comparison_only(recording) -> None:
    same, config = with_prior(recording, from_method("default"), "auto")
    assert same is recording
    assert kinds(config) == [GravityEdges]
    with pytest.raises(InputError, match="no poses of its device"):
        with_prior(recording, from_method("default"), "device")


def test_device_poses_give_gravity_direction(recording) -> None:
    # Its world has y up, and is rotated about y and translated relative to the result's.
    T_device_world = se3.pose(
        [[0.0, 0.0, 1.0], [-0.6, -0.8, 0.0], [0.8, -0.6, 0.0]], [3.0, 1.0, -2.0]
    )
    phone = by_phone(recording, T_device_world @ recording.reference)
    n = len(recording)
    poses = recording.reference @ se3.exp(np.tile([0.1, 0, 0, 0, 0, 0], (n, 1)))
    frames = tuple(FrameRecord(int(k), 0.0, "tracked") for k in recording.indices)
    result = lonely(trajectory=poses, timestamps=np.arange(n), sequential=poses, frames=frames)
    np.testing.assert_allclose(device_up(phone, result), [-0.6, -0.8, 0.0], atol=1e-9)
    assert device_up(recording, result) is None
    assert device_up(phone, replace(result, trajectory=np.full_like(poses, np.nan))) is None


def test_prior_none_uses_images_only(recording) -> None:
    same, config = with_prior(by_phone(recording), from_method("default"), "none")
    assert same.odometry is None
    assert config.priors == ()


def test_thesis_method_uses_no_priors_by_default(recording) -> None:
    phone, thesis = by_phone(recording), from_method("thesis")
    assert with_prior(phone, thesis, "auto") == (phone, thesis)
    assert kinds(with_prior(phone, thesis, "device")[1]) == [GravityEdges, OdometryEdges]


def test_odometry_file_takes_precedence_over_device_poses(recording) -> None:
    phone = by_phone(recording)
    odometry = np.tile(np.eye(4), (len(phone), 1, 1))
    phone.source.odometry = odometry
    led, config = with_prior(phone, from_method("default"), "device")
    np.testing.assert_array_equal(led.odometry, odometry)
    assert kinds(config) == [GravityEdges, OdometryEdges]
    # The odometry of a configuration is kept.
    with_odometry = replace(from_method("default"), priors=(OdometryEdges(relative=0.1),))
    assert with_prior(phone, with_odometry, "device")[1] is with_odometry


@pytest.mark.parametrize(("prior", "sensors"), [("auto", ["odometry"]), ("none", [])])
def test_python_uses_device_poses_as_the_command_line_does(recording, prior, sensors) -> None:
    result = tofuse.reconstruct(by_phone(recording).select(end=6), COARSE, prior=prior)
    assert [sensor.sensor for sensor in result.diagnostics.priors] == sensors


def test_odometry_of_pushed_frames_is_a_prior(recording) -> None:
    mapper = Mapper()
    for k in range(6):
        mapper.push(recording[k], T_odometry=recording.reference[k])
    assert [sensor.sensor for sensor in mapper.finish().diagnostics.priors] == ["odometry"]
    thesis = from_method("thesis")
    assert with_odometry_prior(thesis) is thesis


@pytest.mark.nightly
def test_inconsistent_device_poses_are_ignored(recording) -> None:
    """A phone that lost tracking: its poses contradict the images."""
    rng = np.random.default_rng(0)
    wrong = recording.reference.copy()
    wrong[:, :3, 3] = rng.uniform(-2, 2, (len(wrong), 3))
    phone, config = with_prior(by_phone(recording, wrong), COARSE, "auto")
    alone = reconstruct(recording, COARSE)
    result = reconstruct(phone, config)
    gap = np.linalg.norm(result.trajectory[:, :3, 3] - alone.trajectory[:, :3, 3], axis=1)
    assert gap.max() < 0.01
    [sensor] = result.diagnostics.priors
    assert sensor.used == 0
    assert "was not used" in sensor.text


CAMERA = Pinhole(160, 120, 150.0, 150.0, 79.5, 59.5)


def past_a_corner(covered: Collection[int] = ()) -> Recording:
    """2 m along a bare wall and the floor, from a corner that is visible at first.

    The lens is covered in some frames.
    """
    a = np.linspace(0, 1, 40)
    along = 1.6 * a - 1.3 + 0.2 * np.sin(10 * a)
    twists = [along, 0.05 * np.sin(9 * a), 0.1 * np.sin(5 * a), 0.05 * np.sin(7 * a)]
    poses = se3.exp(np.stack([*twists, 0.05 * np.sin(6 * a), 0.05 * np.sin(11 * a)], 1))
    rng = np.random.default_rng(0)
    frames = []
    for k, T in enumerate(poses):
        rays = rays_at(T, CAMERA)
        planes = zip(np.eye(3), (-1.6, 0.6, 2.0), strict=True)
        depth = np.min([to_plane(*rays, normal, at) for normal, at in planes], 0)
        noise = rng.normal(0, 0.002, depth.shape)
        image = np.where(k in covered, 0.0, depth + noise).astype(np.float32)
        frames.append(RangeFrame(k, k / 30, CAMERA, image))
    return Recording.of(ArraySource(frames, poses, metadata={}), "simulated", "native")


def drifting(right: Float64) -> Float64:
    """Poses (N, 4, 4) as a phone estimates them."""
    rng = np.random.default_rng(1)
    phone = [right[0]]
    for step in se3.inverse(right[:-1]) @ right[1:]:
        phone.append(phone[-1] @ step @ se3.exp(0.001 * rng.standard_normal(6)))
    return np.array(phone)


def test_device_poses_decide_what_stands_still(monkeypatch) -> None:
    """Errors of an alignment may look like another motion, which a phone's poses refute."""
    monkeypatch.setattr(RivalMotions, "compare", lambda *_: Rivalry(0.9))
    recording = past_a_corner().select(end=14)
    phone = by_phone(recording, drifting(recording.reference))
    accuracies = {}
    for prior in ("auto", "none"):
        found = tofuse.reconstruct(phone, COARSE, prior=prior).diagnostics
        assert ("open_motion" in [r.code for r in found.reasons]) == (prior == "none")
        accuracies[prior] = found.accuracy.position_m
    assert np.isfinite(accuracies["auto"])
    assert not np.isfinite(accuracies["none"])


@pytest.mark.nightly
@pytest.mark.parametrize("covered", [(), range(22, 32)])
def test_device_poses_bound_slide_along_wall(covered) -> None:
    """The images alone do not constrain the motion along it."""
    recording = past_a_corner(covered)
    right = recording.reference
    alone = reconstruct(recording, COARSE)
    slide = alone.diagnostics.accuracy.unbounded
    assert len(slide) > 5
    result = reconstruct(*with_prior(by_phone(recording, drifting(right)), COARSE, "auto"))
    accuracy = result.diagnostics.accuracy
    assert accuracy.unbounded == ()
    assert set(accuracy.by_odometry) >= set(slide[3:])
    assert "bounded_by_odometry" in [r.code for r in result.diagnostics.reasons]
    seen = result.has_pose
    assert seen.sum() == len(right) - len(covered)
    assert displacement(right[seen], result.trajectory[seen])[0] < accuracy.position_m < 0.1
    seen = alone.has_pose
    assert covered or displacement(right[seen], alone.trajectory[seen])[0] > 0.1
