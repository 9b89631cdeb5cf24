"""The gravity direction from accelerometers: native folders, phones, simulated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.formats.recordings.native import RecordingWriter
from tofuse.formats.recordings.open import open_recording
from tofuse.formats.sources.imu import gravity_at

UP = np.array([0.1, -0.9, 0.3]) / np.linalg.norm([0.1, -0.9, 0.3])


def columns(times: np.ndarray, felt: np.ndarray) -> dict[str, np.ndarray]:
    return {"timestamp": times, "ax": felt[:, 0], "ay": felt[:, 1], "az": felt[:, 2]}


def test_each_frame_uses_nearest_samples():
    times = np.array([0.0, 1.0, 1.2])
    at = np.arange(-0.3, 2.0, 0.01)
    felt = np.where((at < 0.5)[:, None], UP, -UP) * 9.81
    found = gravity_at(times, columns(at, felt))
    np.testing.assert_allclose(found[:, :3], [-UP, UP, UP], atol=1e-12)
    assert (found[:, 3] < 0.005).all()
    # In units of g, or as fused by the phone: the same.
    np.testing.assert_allclose(gravity_at(times, columns(at, felt / 9.81)), found, atol=1e-12)
    fused = {f"gravity_{axis}": -felt[:, k] for k, axis in enumerate("xyz")}
    fused_found = gravity_at(times, {"timestamp": at, **fused})
    np.testing.assert_allclose(fused_found[:, :3], found[:, :3], atol=1e-12)


def test_variation_along_gravity_estimates_the_error():
    rng = np.random.default_rng(0)
    times = np.arange(200.0)
    still = 9.81 * UP + 0.02 * rng.standard_normal((200, 3))
    moved = 9.81 * UP + 0.8 * rng.standard_normal((200, 3))
    for felt, low, high in ((still, 0.002, 0.006), (moved, 0.06, 0.13)):
        found = gravity_at(times, columns(times, felt))
        assert low < np.median(found[:, 3]) < high
        away = np.linalg.norm(found[:, :3] + UP, axis=1)
        # Two perpendicular directions, each with that sigma.
        assert 0.5 < np.sqrt((away**2).mean() / 2) / np.sqrt((found[:, 3] ** 2).mean()) < 1.5


def test_missing_measurements_are_unknown():
    times = np.array([0.0, 10.0, 20.0])
    felt = np.stack([9.81 * UP, 9.81 * UP, [np.nan, 0, 0]])
    found = gravity_at(times, columns(np.array([0.1, 14.0, 20.0]), felt))
    assert np.isfinite(found).all(1).tolist() == [True, False, False]
    assert gravity_at(times, {"timestamp": times, "temperature": times}) is None
    assert gravity_at(times, {"ax": times, "ay": times, "az": times}) is None
    falling = gravity_at(times, columns(times, np.stack([9.81 * UP, 9.81 * UP, 0.1 * UP])))
    assert np.isfinite(falling).all(1).tolist() == [True, True, False]


def folder(path: Path, imu: dict[str, np.ndarray]) -> Path:
    camera = Pinhole(width=8, height=6, fx=8.0, fy=8.0, cx=3.5, cy=2.5)
    writer = RecordingWriter(path, camera, depth_unit_m=0.001, frame_rate_hz=10)
    for k in range(4):
        writer.add(RangeFrame(k, k / 10, camera, np.full((6, 8), 1 + k / 10, np.float32)))
    return writer.finish(imu=imu)


def test_gravity_of_native_recordings_and_selections(tmp_path: Path):
    felt = np.tile(9.81 * UP, (4, 1))
    recording = open_recording(folder(tmp_path / "a", columns(np.arange(4) / 10, felt)))
    assert recording.warnings == []
    np.testing.assert_allclose(recording.gravity[:, :3], np.tile(-UP, (4, 1)), atol=1e-9)
    assert recording.select(1, None, 2).gravity.shape == (2, 4)
    joined = open_recording(tmp_path / "a", folder(tmp_path / "b", {"strange": np.zeros(3)}))
    assert np.isfinite(joined.gravity).all(1).tolist() == [True] * 4 + [False] * 4
    assert any("gravity is unknown" in warning for warning in joined.warnings)


def test_samples_of_zero_leave_gravity_unknown(tmp_path: Path):
    zeros = columns(np.arange(4) / 10, np.zeros((4, 3)))
    recording = open_recording(folder(tmp_path / "a", zeros))
    assert not np.isfinite(recording.gravity).any()
    (warning,) = recording.warnings
    assert warning.endswith("imu.csv: has no samples other than zero near the time of any frame")


def test_simulated_accelerometer_gives_camera_tilt():
    from tofuse.lab.simulation.accelerometer import accelerations
    from tofuse.lab.simulation.record import plan

    made = plan("room", frames=40)
    times = made.raw / made.sequence.frame_rate_hz
    found = gravity_at(times, accelerations(made.sequence, times[0], times[-1], 0))
    seen = np.einsum("kij,kj->ki", made.poses[:, :3, :3], found[:, :3])
    mean = seen.mean(0) / np.linalg.norm(seen.mean(0))
    assert np.degrees(np.linalg.norm(seen - mean, axis=1)).max() < 2
    # Down in the first camera's frame agrees with the room's z axis.
    down = made.sequence.T_room_camera(times[0])[:3, :3].T @ [0, 0, -1]
    assert np.degrees(np.arccos(mean @ down)) < 1.5


def test_accelerometer_of_phone_agrees_with_its_poses(shared_data):
    recording = open_recording(shared_data / "iphone_stray")
    known = np.isfinite(recording.gravity).all(1)
    assert known.mean() > 0.9
    T, d = recording.reference[known], recording.gravity[known]
    seen = np.einsum("kij,kj->ki", T[:, :3, :3], d[:, :3])
    mean = seen.mean(0)
    # ARKit's world has y up.
    assert np.degrees(np.arccos(-mean[1] / np.linalg.norm(mean))) < 1.5
    spread = np.linalg.norm(seen - mean, axis=1)
    assert np.sqrt((spread**2).mean()) < 3 * np.median(d[:, 3])
    assert se3.angle(T[0]) == pytest.approx(np.pi, abs=0.2)
