"""Whole reconstructions with gravity and odometry priors, and without."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tofuse.engine.geometry import se3
from tofuse.engine.graph.external_sensors import GravityEdges, OdometryEdges
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.engine.refinement.refinement import Joint
from tofuse.engine.results.types import Reconstruction
from tofuse.formats.files.tables import write_columns
from tofuse.formats.poses.trajectory import write_tum
from tofuse.formats.recordings.open import open_recording
from written_run_json import run_json

BOTH = (GravityEdges(), OdometryEdges())


@pytest.fixture(scope="module")
def beside(room_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The simulated room with an accelerometer and odometry, which lacks one pose."""
    folder = tmp_path_factory.mktemp("beside") / "room"
    shutil.copytree(room_recording, folder)
    recording = open_recording(room_recording)
    assert recording.reference is not None
    times, poses = recording.timestamps, recording.reference
    up = np.array([0.05, -0.99, 0.1])
    felt = 9.81 * np.einsum("kji,j->ki", poses[:, :3, :3], up / np.linalg.norm(up))
    columns = {"timestamp": times} | {f"a{axis}": felt[:, k] for k, axis in enumerate("xyz")}
    write_columns(folder / "imu.csv", columns)
    elsewhere = se3.exp(np.array([1.0, 2, 3, 0.3, 0.2, 0.1]))
    keep = np.arange(len(times)) != 5
    write_tum(folder / "odometry.txt", times[keep], (elsewhere @ poses)[keep])
    return folder


def made(folder: Path, *priors: object, frames: int | None = None) -> Reconstruction:
    config = replace(from_method("default"), priors=priors, refinement=Joint())
    return reconstruct(open_recording(folder).select(end=frames), config, threads=1)


@pytest.mark.nightly_part
def test_priors_are_used_on_request_and_reported(beside, room_recording):
    alone, both = made(beside), made(beside, *BOTH)
    records = {record.sensor: record for record in both.diagnostics.priors}
    assert (records["gravity"].measured, records["gravity"].used) == (8, 8)
    assert (records["odometry"].measured, records["odometry"].used) == (5, 5)
    assert [s["sensor"] for s in run_json(both)["priors"]] == ["gravity", "odometry"]
    assert len(both.graph.edges) == len(alone.graph.edges) + 5
    assert both.graph.gravity is not None
    np.testing.assert_array_equal(both.trajectory[0], np.eye(4))
    reference = open_recording(room_recording).reference
    assert reference is not None

    def off(result: Reconstruction) -> float:
        e = se3.log(se3.inverse(reference) @ result.trajectory)
        return float(np.linalg.norm(e[:, 3:], axis=1).max())

    assert 0 < np.abs(both.trajectory - alone.trajectory).max() < 0.02
    assert off(both) < off(alone) + 0.001
    # The accuracy includes the priors, but the verdict is that of the images.
    assert both.diagnostics.verdict == alone.diagnostics.verdict
    stated, by_images = (r.diagnostics.accuracy for r in (both, alone))
    # Tracking starts closer to the solution, and the correction by the refinement counts.
    assert 0.7 * by_images.rotation_rad < stated.rotation_rad < 1.05 * by_images.rotation_rad
    last = [r.diagnostics.frames[-1].covariance for r in (both, alone)]
    assert last[0] is not None
    assert last[1] is not None
    # Each run measures its own noise, by which its covariances are scaled.
    assert np.trace(last[0][3:, 3:]) < 1.1 * np.trace(last[1][3:, 3:])


def test_missing_sensor_files_change_nothing(room_recording):
    asked, not_asked = (made(room_recording, *p, frames=3) for p in (BOTH, ()))
    assert asked.diagnostics.priors == ()
    np.testing.assert_array_equal(asked.trajectory, not_asked.trajectory)
    np.testing.assert_array_equal(asked.graph.information, not_asked.graph.information)
    np.testing.assert_array_equal(asked.cloud.points, not_asked.cloud.points)
