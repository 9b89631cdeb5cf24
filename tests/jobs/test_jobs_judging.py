"""The error of given poses is estimated without a reference."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import tofuse
from cli_calls import call, printed, refuses
from refused import refused
from tofuse.apps.jobs import judging
from tofuse.apps.jobs.judging import poses_for, sentence
from tofuse.apps.jobs.pose_scale import with_scale
from tofuse.apps.results.folders import RESULT
from tofuse.engine.errors import InputError
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.engine.geometry import se3
from tofuse.engine.progress import Silent
from tofuse.engine.quality.pose_accuracy import Accuracy
from tofuse.engine.quality.trajectory_errors import displacement
from tofuse.formats.poses.trajectory import write_tum
from tofuse.formats.recordings import read_reference
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.record import simulate


@pytest.fixture(scope="module")
def recording(room_recording):
    return tofuse.open(room_recording)


@pytest.fixture(scope="module")
def truth(recording):
    return recording.reference


def bent(truth):
    """The second half is displaced from the first by 8 cm and 3 degrees."""
    out = truth.copy()
    out[4:] = se3.exp(np.array([0.06, 0.04, -0.03, 0.02, -0.05, 0])) @ out[4:]
    return out


@pytest.fixture(scope="module")
def of_truth(recording, truth):
    return tofuse.judge(recording, truth)


@pytest.fixture(scope="module")
def of_bent(recording, truth):
    return tofuse.judge(recording, bent(truth))


def test_correct_poses_are_good(of_truth) -> None:
    assert of_truth.verdict == "good"
    assert of_truth.reasons == ()
    assert of_truth.started
    assert of_truth.displacement_m.max() < 0.012
    assert of_truth.accuracy.position_m < 0.02
    assert of_truth.deviation.consistent
    assert of_truth.deviation.at_most_m < 0.03
    assert of_truth.consistency is not None
    assert of_truth.consistency.inlier_ratio > 0.9


def test_stated_error_of_wrong_poses_is_correct(of_bent, truth) -> None:
    wrong, _ = displacement(truth, bent(truth))
    assert wrong > 0.02
    assert wrong < of_bent.accuracy.position_m < 1.6 * wrong
    assert of_bent.verdict == "degraded"
    assert [r.code for r in of_bent.reasons] == ["inconsistent_poses", "jumped"]
    assert of_bent.reasons[0].ranges == ((3, 4),)
    assert "The motion from frame 3 to 4 is wrong by itself." in of_bent.reasons[0].text
    assert of_bent.reasons[1].frames == (4, 4)
    refined = of_bent.refined
    assert displacement(truth, refined.trajectory)[0] < 0.01
    assert refined.diagnostics.accuracy.position_m < 0.01
    assert refined.diagnostics.verdict == "good"
    assert of_bent.refined_consistency.rms_m < of_bent.consistency.rms_m


@pytest.fixture(scope="module")
def on_rail(tmp_path_factory):
    """A camera that moves sideways."""
    folder = tmp_path_factory.mktemp("rail") / "rail"
    simulate("rail", folder, frames=8, every=8, effects=Effects.none(shot_noise=True))
    return tofuse.open(folder)


@pytest.mark.parametrize("factor", [1.0, 0.2, pytest.param(5.0, marks=pytest.mark.nightly_part)])
def test_poses_of_another_scale_are_judged_in_metres(factor, on_rail):
    found = tofuse.judge(on_rail, with_scale(on_rail.reference, factor))
    scale = found.scale
    assert scale.applied == (factor != 1)
    assert abs(scale.factor * factor - 1) < 3 * scale.sigma * factor
    assert scale.sigma * factor < 0.03
    assert found.verdict == "good"
    assert found.accuracy.position_m < 0.03
    text = f"poses.txt times {scale.factor:.4g} \N{PLUS-MINUS SIGN} "
    assert sentence(found, "poses.txt").startswith(text) == scale.applied
    assert found.to_dict()["scale"]["factor"] == scale.factor
    if not scale.applied:
        np.testing.assert_array_equal(found.poses, on_rail.reference)


def test_noise_of_positions_is_not_another_scale(on_rail):
    """It makes steps longer in all directions, which a smaller scale would make fit better."""
    noise = np.random.default_rng(1).normal(0, 0.1, (len(on_rail), 3))
    poses = on_rail.reference.copy()
    poses[:, :3, 3] += noise
    found = tofuse.judge(on_rail, poses)
    assert not found.scale.applied
    assert "inconsistent_poses" in {reason.code for reason in found.reasons}
    assert found.finding is None


@pytest.mark.nightly_part
def test_small_error_of_scale_is_an_error_unless_scale_is_unknown(on_rail):
    poses = with_scale(on_rail.reference, 1.08)
    assert not tofuse.judge(on_rail, poses).scale.applied
    found = tofuse.judge(on_rail, poses, scale=True)
    assert found.scale.applied
    assert found.scale.factor == pytest.approx(1 / 1.08, abs=3 * found.scale.sigma)


def test_rotations_have_no_scale(of_truth, recording, truth) -> None:
    assert of_truth.scale is None
    refused("scale: can't be estimated", recording, truth, by=tofuse.judge, scale=True)


@pytest.mark.nightly
def test_poses_of_another_place_are_contradicted_and_replaced(recording, truth) -> None:
    turns = np.array([se3.exp(np.array([0, 0, 0, 0, 2.5 * k, 0])) for k in range(8)])
    found = tofuse.judge(recording, turns @ truth)
    assert not found.started
    assert found.verdict == "degraded"
    assert "inconsistent_poses" in [r.code for r in found.reasons]
    assert found.accuracy.rotation_rad > 1
    assert displacement(truth, found.refined.trajectory)[0] < 0.01
    away = np.array([se3.exp(np.array([0, 0, 0, 0, 1.1 * k, 0])) for k in range(8)])
    found = tofuse.judge(recording, away @ np.linalg.inv(truth))
    assert found.verdict == "failed"
    assert "images_disagree" in [r.code for r in found.reasons]


def test_result_has_the_bound_of_its_run_unless_contradicted(recording, tmp_path) -> None:
    result = tofuse.reconstruct(recording)
    stated = result.diagnostics.accuracy
    assert tofuse.judge(recording, result).accuracy == stated
    # Poses alone don't say how well they are known.
    of_poses = tofuse.judge(recording, result.trajectory)
    assert of_poses.accuracy.position_m == pytest.approx(stated.position_m, rel=0.2)
    assert of_poses.accuracy.position_m != stated.position_m
    wrong = tofuse.judge(recording, replace(result, trajectory=bent(result.trajectory)))
    assert wrong.accuracy.position_m > 2 * stated.position_m
    result.save(tmp_path / "out")
    file = tmp_path / "out/trajectory.txt"
    assert tofuse.judge(recording, file.parent).accuracy.position_m == stated.position_m
    file.write_text(file.read_text() + "\n")
    edited = tofuse.judge(recording, file)
    assert edited.accuracy.position_m == pytest.approx(of_poses.accuracy.position_m, rel=0.01)


def test_frames_without_a_given_pose_are_not_lost(recording, truth) -> None:
    """The report of poses that are good said not to rely on them, as a half had none."""
    some = truth.copy()
    some[1::2] = some[2] = np.nan
    found = tofuse.judge(recording, some)
    assert found.started
    assert found.refined.diagnostics.verdict == found.verdict == "good"
    posed = np.flatnonzero(np.isfinite(some[:, 0, 0]))
    assert [f.index for f in found.refined.diagnostics.frames] == posed.tolist()


def test_jump_is_named_and_nothing_of_correct_poses(of_truth, of_bent) -> None:
    assert of_truth.cause is None
    assert of_truth.to_dict()["cause"] is None
    cause = of_bent.cause
    assert cause.kind == "jump"
    assert cause.frames == (3, 4)
    assert cause.text in of_bent.reasons[0].text
    assert cause.text in sentence(of_bent, "poses.txt")
    assert repr(of_bent).startswith(f"Judgement: {of_bent.verdict}. poses: ")
    # What is wrong, but by less than the tolerance, may still be uncertain by more.
    unsure = replace(of_bent, reasons=())
    assert "with the depth, but not significantly beyond the tol" in sentence(unsure, "poses.txt")
    assert of_bent.to_dict()["cause"]["frames"] == [3, 4]


class Notes(Silent):
    def __init__(self):
        self.texts = []

    def note(self, text):
        self.texts.append(text)


def test_convention_of_inverted_poses_is_named(recording, truth):
    notes = Notes()
    judged = tofuse.judge(recording, se3.inverse(truth), progress=notes)
    assert judged.cause is None
    (named,) = [text for text in notes.texts if "The poses fit the images if" in text]
    assert "T_camera_world, the inverse" in named
    assert judged.to_dict()["finding"]["code"] == "poses_misread"
    quiet = Notes()
    tofuse.judge(recording, truth, progress=quiet)
    assert not [text for text in quiet.texts if "The poses" in text]


def test_unusable_poses_are_refused(recording, truth, tmp_path) -> None:
    refused(r"pass \(8, 4, 4\)", recording, truth[:5], by=tofuse.judge)
    one = np.full_like(truth, np.nan)
    one[3] = np.eye(4)
    refused("has a pose for 1 of the 8 frames", recording, one, by=tofuse.judge)
    with pytest.raises(InputError, match="has a single frame, whose pose nothing contradicts"):
        tofuse.judge(recording[:1], truth[:1])
    refused("has no rotation", recording, truth * np.array([2.0, 1, 1, 1]), by=tofuse.judge)
    write_tum(tmp_path / "late.txt", recording.timestamps + 1000, truth)
    with pytest.raises(InputError, match=r"late.txt: has a pose for 0 .* on the clock"):
        poses_for(recording, tmp_path / "late.txt")
    for k in range(3):
        points = np.random.default_rng(k).uniform(-1, 1, (500, 3)).astype(np.float32)
        tofuse_ply(tmp_path / f"scans/{k}.ply", points)
    with pytest.raises(InputError, match=r"contains clouds.*tofuse evaluate"):
        tofuse.judge(tofuse.open(tmp_path / "scans"), np.tile(np.eye(4), (3, 1, 1)))


def tofuse_ply(path, points) -> None:
    from tofuse.formats.geometry.ply import write_ply

    path.parent.mkdir(exist_ok=True)
    write_ply(path, GeometryRecord(points))


@pytest.mark.nightly_part
def test_odometry_of_recording_is_judged_where_it_has_no_reference(room_recording, tmp_path):
    folder = tmp_path / "recording"
    shutil.copytree(room_recording, folder)
    (folder / "groundtruth.txt").rename(folder / "odometry.txt")
    recording = tofuse.open(folder)
    assert recording.reference is None
    np.testing.assert_allclose(poses_for(recording, folder), recording.odometry, atol=1e-6)
    refused("has no reference poses", folder, by=read_reference)


def test_noise_of_poses_between_those_of_the_sample_counts() -> None:
    """Between views that are refined, refined poses keep the noise of the given ones."""
    true = np.tile(np.eye(4), (600, 1, 1))
    noisy = se3.exp(np.random.default_rng(0).normal(0, [0.02] * 3 + [0.03] * 3, (600, 6)))
    rows = np.arange(0, 600, 3)
    refined = judging._propagated(noisy, rows, true[rows])
    reference = Accuracy(position_m=0.001, rotation_rad=0.001, assessed=True)
    sampled: Any = SimpleNamespace(
        diagnostics=SimpleNamespace(accuracy=reference), cloud=SimpleNamespace(diagonal_m=5.0)
    )
    distances = judging._distances(noisy, refined)
    found = judging._accuracy(distances, noisy, refined, rows, None, sampled, np.arange(600))
    wrong = displacement(true, noisy)
    assert found.position_m > 0.95 * wrong[0]
    assert found.rotation_rad > 0.95 * wrong[1]


def test_command(room_recording, truth, tmp_path, capsys) -> None:
    recording = tofuse.open(room_recording)
    poses = tmp_path / "poses.txt"
    write_tum(poses, recording.timestamps, bent(truth))
    words = ["judge", str(room_recording), str(poses), "--out", str(tmp_path / "out")]
    assert call(*words, "--json") == 3
    data = json.loads(capsys.readouterr().out)
    assert data["verdict"] == "degraded"
    assert data["out"] == str(tmp_path / "out")
    kept = json.loads((tmp_path / "out/judge.json").read_text())
    assert {**kept, "out": data["out"]} == data
    assert kept["refined"]["verdict"] == "good"
    assert kept["refined"]["from_these_poses"]
    assert kept["refined"]["accuracy"]["position_m"] < 0.4 * kept["accuracy"]["position_m"]
    written = {p.name for p in (tmp_path / "out").iterdir()}
    assert all(RESULT.files.fullmatch(name) for name in written)
    assert {"trajectory.txt", "report.html", "run.json", "judge.json"} <= written
    report = (tmp_path / "out/report.html").read_text()
    assert "poses.txt: ±" in report
    assert "Inconsistent with the depth: surfaces displaced by about" in report
    deviation = kept["deviation"]
    assert 0 < deviation["at_least_m"] <= deviation["estimate_m"] <= deviation["at_most_m"]
    assert len(deviation["frames"]) == len(deviation["of_frames_m"])
    assert deviation["inconsistent_steps"] == [[3, 4]]
    # Its result is replaced only on request, and is a trajectory itself.
    refuses(capsys, *words, says="--overwrite")
    out = printed(capsys, "judge", room_recording, tmp_path / "out")
    assert "\nout: ±" in out
    assert "Consistent with the depth to within" in out
    assert "map consistency: given" in out


def test_command_refuses(room_recording, tmp_path, capsys) -> None:
    refuses(capsys, "judge", room_recording, tmp_path / "none.txt", says="none.txt")
    refuses(capsys, "judge", room_recording, room_recording, "--overwrite", says="pass --out")
    shutil.copytree(room_recording, tmp_path / "mine")
    poses = str(room_recording / "groundtruth.txt")
    refuses(
        capsys, "judge", room_recording, poses, "--out", tmp_path / "mine", says="no earlier result"
    )
