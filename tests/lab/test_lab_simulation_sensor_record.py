"""Whole simulated recordings: on disk, in memory, and their ground truth."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.geometry import se3
from tofuse.engine.geometry.rays import homogeneous
from tofuse.formats.geometry.ply import read_ply
from tofuse.formats.images.images import read_image
from tofuse.formats.poses.trajectory import read_tum
from tofuse.formats.readers.native import NativeSource
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.record import plan, simulate, simulate_recording
from tofuse.lab.world.scene import build


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    reported = []
    path = simulate(
        "corner",
        tmp_path_factory.mktemp("simulated") / "corner",
        every=10,
        frames=3,
        progress=lambda done, of: reported.append((done, of)),
    )
    assert reported == [(1, 3), (2, 3), (3, 3)]
    return path


@pytest.mark.nightly
def test_written_folder_matches_recording_in_memory(folder) -> None:
    source = NativeSource(folder)
    memory = simulate_recording("corner", every=10, frames=3)
    assert len(memory) == 3
    for k, frame in enumerate(memory):
        read = source.read(k)
        assert frame.index == k
        np.testing.assert_array_equal(read.depth, frame.depth)
        np.testing.assert_array_equal(read.amplitude_image, frame.amplitude_image)
        np.testing.assert_array_equal(read.confidence_image, frame.confidence_image)
    np.testing.assert_array_equal(source.timestamps, memory.timestamps)
    np.testing.assert_allclose(source.reference, memory.reference, atol=1e-9)
    assert not source.warnings
    for key, value in memory.metadata.items():
        assert source.metadata[key] == value
    assert source.metadata["sensor"] == "sr4000 (simulated)"


def test_ground_truth_poses_are_exact(folder) -> None:
    _, sequence = build("corner")
    times, poses = read_tum(folder / "groundtruth.txt")
    np.testing.assert_array_equal(poses[0], np.eye(4))
    np.testing.assert_allclose(times, [0, 10 / 30, 20 / 30], atol=1e-9)
    for t, pose in zip(times, poses, strict=True):
        np.testing.assert_allclose(pose, sequence.T_world_camera(t), atol=1e-8)
    assert np.abs(poses[2] - np.eye(4)).max() > 1e-3


def test_true_depth_lies_on_true_surface(folder) -> None:
    """True depth of any frame, moved by the true pose, lies in the planes of surface.ply."""
    mesh = read_ply(folder / "truth" / "surface.ply")
    corners = mesh.points.astype(float)[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    source = NativeSource(folder)
    rays = homogeneous(source.camera.rays()[::9, ::9].reshape(-1, 2))
    for k in range(3):
        z = read_image(folder / "truth" / "depth" / f"{k:06d}.png")[::9, ::9].ravel() * 1e-4
        points = rays * z[:, None]
        points = se3.transform(source.reference[k], points[z > 0])
        off = np.abs(np.einsum("nfc,fc->nf", points[:, None] - corners[:, 0], normals)).min(1)
        assert len(points) > 200
        assert off.max() < 3e-4


def test_moving_object_defines_world() -> None:
    made = plan("box", every=50, frames=3)
    _, sequence = build("box")
    rate = sequence.frame_rate_hz
    for raw, pose in zip(made.raw, made.poses, strict=True):
        T_object_camera = [
            se3.inverse(sequence.T_room_object(k / rate)) @ sequence.T_room_camera(k / rate)
            for k in (0, raw)
        ]
        expected = se3.inverse(T_object_camera[0]) @ T_object_camera[1]
        np.testing.assert_allclose(pose, expected, atol=1e-12)


def test_bias_remains_without_correction(tmp_path) -> None:
    effects = Effects.none(wiggling=1.0, pixel_offsets=1.0)
    path = simulate("wall", tmp_path / "raw", every=10, frames=1, effects=effects, correction=False)
    assert not (path / "correction.npz").exists()
    raw = NativeSource(path).read(0)
    truth = read_image(path / "truth" / "depth" / "000000.png") * 1e-4
    corrected = simulate_recording("wall", every=10, frames=1, effects=effects)[0]
    assert np.sqrt(((raw.depth - truth) ** 2).mean()) > 0.004
    assert np.sqrt(((corrected.depth - truth) ** 2).mean()) < 0.001
