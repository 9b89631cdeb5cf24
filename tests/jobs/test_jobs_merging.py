"""Several sessions in one map: joined if they overlap, otherwise separate and reported."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import made_sessions
from cli_calls import printed, refuses
from made_rooms import at, seen
from made_sessions import made_result_of, quick
from tofuse.apps.export.exporting import export
from tofuse.apps.jobs import merging
from tofuse.apps.jobs.merging import joined_recording, merge_sessions, merged_config
from tofuse.apps.jobs.running import exit_status
from tofuse.apps.jobs.sessions import read_sessions
from tofuse.apps.report.session_words import session_sentences
from tofuse.apps.results.folders import OutputFolder
from tofuse.apps.results.loading import stated_accuracy
from tofuse.apps.results.output import write_result
from tofuse.engine.errors import InputError
from tofuse.engine.frames.frames import CloudFrame
from tofuse.engine.fusion import texture
from tofuse.engine.fusion.texture import textured
from tofuse.engine.geometry import se3
from tofuse.engine.graph.external_sensors import OdometryEdges
from tofuse.engine.progress import Silent
from tofuse.formats.geometry import read_textured_glb
from tofuse.formats.poses.trajectory import read_tum, write_tum
from written import record
from written_run_json import change_run, read_from, run_json

HERE, THERE = made_sessions.HERE[::2], made_sessions.THERE[::2]
N = len(HERE)
TRUE = np.array([*HERE, *THERE])


def quick_merge(sessions, searches=6):
    """A quick configuration that searches for few links between sessions."""
    config = quick(merged_config(sessions))
    joining = replace(config.joining, searches=searches, tries=searches)
    return replace(config, joining=joining)


def merged(*folders, searches=6, **options):
    sessions = read_sessions(folders, 2, Silent())
    return merge_sessions(sessions, quick_merge(sessions, searches), threads=2, **options)


@pytest.fixture(scope="module")
def both(session_results):
    return merged(session_results["here"], session_results["there"])


@pytest.fixture(scope="module")
def pair(both, tmp_path_factory) -> Path:
    """The result of merging two sessions, in a folder."""
    folder = tmp_path_factory.mktemp("merged") / "pair"
    write_result(both, OutputFolder(folder))
    return folder


def copied(folder: Path, to: Path) -> Path:
    """A result next to its recording, in another folder."""
    shutil.copytree(folder, to / "out")
    return to / "out"


def recording_of(folder: Path) -> str:
    (path,) = json.loads((folder / "run.json").read_text())["input"]["opening"]["paths"]
    return path


def test_two_sessions_in_one_room_give_one_map(both) -> None:
    assert both.has_pose.all()
    off = se3.inverse(TRUE[0]) @ TRUE
    error = np.linalg.norm(off[:, :3, 3] - both.trajectory[:, :3, 3], axis=1)
    assert error.max() < 0.005
    assert both.diagnostics.verdict == "good"
    assert exit_status(both) == 0


def test_corrections_of_the_sessions_count_in_the_bound(both, session_results) -> None:
    """The poses begin where the refinement of each session has moved them."""
    stated = [stated_accuracy(session_results[name]).moved_m for name in ("here", "there")]
    assert min(stated) > 0
    rms = np.sqrt(np.mean(np.square(stated)))  # as many frames each
    assert both.diagnostics.accuracy.moved_m == pytest.approx(rms)


def test_overlap_and_probability_are_reported(both) -> None:
    (pair,) = both.session_pairs
    assert (pair.a, pair.b, pair.joined, pair.before) == (0, 1, True, False)
    assert pair.links >= 2
    assert pair.probability > 0.99
    assert pair.support > 0.99
    assert 0.5 < pair.overlap <= 1
    (text,) = session_sentences(both)
    assert "overlap" in text
    assert "probability" in text


def test_odometry_that_one_path_rests_on_counts_in_the_map(session_results, tmp_path) -> None:
    frames = [seen(T, 100 + k) for k, T in enumerate(HERE)]
    with_odometry = made_result_of(tmp_path / "here", frames, np.array(HERE))
    sessions = read_sessions([with_odometry, session_results["there"]], 2, Silent())
    (used,) = [p for p in merged_config(sessions).priors if isinstance(p, OdometryEdges)]
    assert used.scale is not None
    recording, _ = joined_recording(sessions)
    assert recording.odometry is not None
    np.testing.assert_allclose(recording.odometry[:N], HERE, atol=1e-6)
    assert np.isnan(recording.odometry[N:]).all()
    found = merge_sessions(sessions, quick_merge(sessions), threads=2)
    (record,) = [p for p in found.diagnostics.priors if p.sensor == "odometry"]
    assert (record.measured, record.used) == (N - 1, N - 1)
    # With the factor on the lengths of its wheels that the run found.
    run = json.loads((with_odometry / "run.json").read_text())
    change_run(with_odometry, priors=[{**p, "lengths": 1.02} for p in run["priors"]])
    reopened = joined_recording(
        read_sessions([with_odometry, session_results["there"]], 2, Silent())
    )
    longer = np.array(HERE)[:, :3, 3] * 1.02
    np.testing.assert_allclose(reopened[0].odometry[:N, :3, 3], longer, atol=1e-6)


def test_session_of_a_camera_on_its_side_is_joined(session_results, tmp_path) -> None:
    on_its_side = se3.pose(se3.so3_exp([0, 0, np.pi / 2]))
    turned = [at(0.25 * np.sin(0.2 * k), 0.1, 0.15 + 0.05 * k) @ on_its_side for k in range(12)]
    side = made_sessions.made_result(tmp_path / "side", turned, 4)
    upright = np.diag([1.0, -1.0, -1.0, 1.0]) @ se3.pose(turned[0][:3, :3])
    change_run(side, T_up_world=upright.tolist())  # as a phone measures it
    sessions = read_sessions([session_results["here"], side], 2, Silent())
    assert [s.roll for s in sessions] == pytest.approx([0, -np.pi / 2], abs=0.1)
    config, roll = quick_merge(sessions), merged_config(sessions).search.roll
    config = replace(config, search=replace(config.search, roll=roll))
    found = merge_sessions(sessions, config, threads=2)
    true = se3.inverse(HERE[0]) @ np.array([*HERE, *turned])
    assert found.has_pose.all()
    off = np.linalg.norm(true[:, :3, 3] - found.trajectory[:, :3, 3], axis=1)
    assert off.max() < 0.02


def test_run_json_states_session_of_each_frame(both, session_results) -> None:
    data = run_json(both)
    assert [frame["session"] for frame in data["frames"]] == [0] * N + [1] * N
    assert [s["name"] for s in data["sessions"]] == ["here", "there"]
    folders = [str(session_results[name]) for name in ("here", "there")]
    assert [s["result"] for s in data["sessions"]] == folders
    assert [s["first"] for s in data["sessions"]] == [0, N]
    assert data["session_pairs"][0]["joined"]


@pytest.mark.nightly
def test_flat_of_same_plan_is_not_joined(session_results) -> None:
    found = merged(session_results["here"], session_results["elsewhere"], searches=4)
    assert found.has_pose.tolist() == [True] * N + [False] * N
    (pair,) = found.session_pairs
    assert not pair.joined
    assert (pair.links, pair.probability, pair.support) == (0, None, None)
    assert found.sessions[1].T_main_session is None
    assert session_sentences(found) == [
        "elsewhere is not joined: no overlap with the first session could be confirmed."
    ]
    (reason,) = [r for r in found.diagnostics.reasons if r.code == "disconnected"]
    assert "between here and elsewhere" in reason.text
    doubted = replace(found.components[1], reached=0.87)
    doubted = replace(found, components=(found.components[0], doubted))
    (reason,) = [r for r in merging._reasons(doubted) if r.code == "disconnected"]
    assert "with a probability of 87 %, and 99 % are required; more views" in reason.text
    assert found.components[1].result.has_pose.all()
    assert exit_status(found) == 3


@pytest.mark.nightly
def test_loops_of_earlier_merge_are_registered_again(both, session_results, pair) -> None:
    sessions = read_sessions([session_results["elsewhere"], pair], 2, Silent())
    across = [(p.i, p.j) for p in both.diagnostics.loops if p.accepted and p.i < N <= p.j]
    assert len(across) >= 2
    assert sessions[0].links == ()
    assert set(sessions[1].links) == set(across)
    # No view may be a candidate by its overlap.
    config = quick_merge(sessions, 3)
    config = replace(config, loops=replace(config.loops, per_view=0))
    found = merge_sessions(sessions, config, threads=2)
    (apart,) = [c.result for c in found.components if not c.connected]
    again = {(p.i - N, p.j - N): p for p in apart.diagnostics.loops}
    assert set(again) == set(across)
    assert sum(p.accepted for p in again.values()) >= 2
    # A link of a join may overlap less than a loop must.
    rejected = [p.reason for p in again.values() if not p.accepted]
    assert all("of the points project into the other view" in reason for reason in rejected)
    assert "loop_rejected" not in {reason.code for reason in apart.diagnostics.reasons}


@pytest.mark.nightly_part
def test_command_writes_result(session_results, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(merging, "merged_config", quick_merge)
    out = tmp_path / "all"
    words = ["merge", session_results["here"], session_results["there"], "--out", out]
    painted = []

    def painting(mesh, views, poses, size):
        painted.append(len(views))
        return textured(mesh, views, poses, size // 8)  # a small texture

    monkeypatch.setattr(texture, "textured", painting)
    assert "here and there overlap" in printed(capsys, *words, "--threads", "2", "--texture")
    assert painted == [2 * N]  # views of both
    assert read_textured_glb(out / "mesh.glb") is not None
    times, poses = read_tum(out / "trajectory.txt")
    assert len(poses) == 2 * N
    assert (np.diff(times) > 0).all()
    data = json.loads((out / "run.json").read_text())
    assert [s["name"] for s in data["sessions"]] == ["here", "there"]
    report = (out / "report.html").read_text()
    assert "here, there merged" in report
    assert "Sessions" in report
    refuses(capsys, *words, says="overwrite")


def refused(folders, *parts) -> None:
    with pytest.raises(InputError) as caught:
        read_sessions(folders, 1, Silent())
    for part in parts:
        assert part in str(caught.value)
    assert "\n" not in str(caught.value)


def test_bad_input_is_refused_in_one_line(session_results, tmp_path) -> None:
    here, there = session_results["here"], session_results["there"]
    refused([here], str(here), "single session")
    refused([], "single session")
    refused([here, there, there.parent / "there" / ".." / "here"], "given twice")
    refused([here, tmp_path / "nothing"], "doesn't exist")
    refused([here, tmp_path], "no run.json")
    copied(here, tmp_path)
    refused([here, tmp_path / "out"], "same recording", f"{N} frames are in both")
    # Of a copy of the recording, too.
    shutil.copytree(recording_of(here), tmp_path / "copy")
    read_from(tmp_path / "out", tmp_path / "copy")
    refused([here, tmp_path / "out"], "same recording", f"{N} frames are in both")


def test_missing_recording_is_named_with_remedy(session_results, tmp_path) -> None:
    again = copied(session_results["there"], tmp_path)
    gone = tmp_path / "was-here"
    read_from(again, gone)
    refused([session_results["here"], again], str(gone), "doesn't exist", "put it back")


def test_exported_images_have_the_times_of_the_map(pair, tmp_path) -> None:
    (folder,) = export(pair, ["nerfstudio"], tmp_path)
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    times, _ = read_tum(pair / "trajectory.txt")
    np.testing.assert_allclose([frame["timestamp"] for frame in frames], times)


def test_changed_recording_is_refused(session_results, tmp_path) -> None:
    again = copied(session_results["there"], tmp_path)
    run = json.loads((again / "run.json").read_text())
    frames = [{**f, "timestamp": f["timestamp"] + 1.0} for f in run["frames"]]
    times, poses = read_tum(again / "trajectory.txt")
    write_tum(again / "trajectory.txt", times + 1.0, poses)
    change_run(again, frames=frames)
    says = ("does not match the frames", "has changed", "run `tofuse run` again")
    refused([session_results["here"], again], *says)


def test_recording_with_other_images_is_refused(session_results, tmp_path) -> None:
    again = copied(session_results["there"], tmp_path)
    scan = shutil.copytree(recording_of(again), tmp_path / "scan")
    depth = sorted((scan / "depth").iterdir())
    depth[-1].replace(depth[0])
    shutil.copy(depth[1], depth[-1])
    read_from(again, scan)
    refused([session_results["here"], again], "at frame 0, which has changed")


def test_results_of_clouds_are_refused(session_results, tmp_path) -> None:
    points = np.random.default_rng(0).uniform(1, 2, (50, 3)).astype(np.float32)
    record(tmp_path / "clouds", [CloudFrame(k, k / 10, points) for k in range(N)])
    again = copied(session_results["there"], tmp_path)
    run = json.loads((again / "run.json").read_text())
    frames = [frame | {"mean_depth_m": None} for frame in run["frames"]]
    read_from(again, tmp_path / "clouds", frames=frames)
    refused([session_results["here"], again], "clouds", "pass their clouds together")


@pytest.mark.parametrize(
    "changes", [{"frames": [{}]}, {"frames": 3}, {"input": {}}, {"components": [1]}]
)
def test_damaged_result_is_refused(session_results, tmp_path, changes) -> None:
    again = copied(session_results["there"], tmp_path)
    change_run(again, **changes)
    refused([session_results["here"], again], "damaged")
