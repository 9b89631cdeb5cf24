"""Whole runs at the command line: exit status, output folder, messages, interruptions."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import tofuse
from cli_calls import printed, refuses
from tofuse.apps.cli.program import main
from tofuse.engine.errors import InputWarning, TofuseError
from tofuse.engine.results.verdicts import REASONS
from tofuse.formats.geometry.ply import read_ply
from tofuse.formats.images.images import read_image, write_png
from tofuse.formats.poses.g2o import read_g2o
from tofuse.formats.poses.trajectory import read_tum
from tofuse.lab import demo as demo_module
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.record import simulate
from written import change_camera

SAME = ("trajectory.txt", "pose_graph.g2o", "cloud.ply", "mesh.ply", "mesh.glb")
FILES = {*SAME, "report.html", "run.json"}
# Fields of frames in run.json, and of its loops.


FRAME_KEYS = """
index timestamp status reason valid_share inlier_share rms_m covariance unobservable
component session mean_depth_m
"""
LOOP_KEYS = """
i j accepted reason overlap rms_m free_space_violation margin
"""
# Options of a quick run.
QUICK = ("--every", "4", "--method", "thesis", "--no-report")


@pytest.fixture
def recording(room_recording, tmp_path) -> Path:
    return shutil.copytree(room_recording, tmp_path / "rec")


def run(*words: object, status: int = 0, report: bool = False) -> None:
    """Run, without the report where the test does not use it: it takes half of the time."""
    more = [] if report else ["--no-report"]
    assert main(["run", *(str(w) for w in words), *more]) == status


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def same(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in SAME}


def run_json(folder: Path) -> dict:
    return json.loads(
        (folder / "run.json").read_text(), parse_constant=lambda c: pytest.fail(f"{c} in run.json")
    )


@pytest.fixture(scope="module")
def quick_run(room_recording, tmp_path_factory) -> Path:
    """The result of a quick run, without its report."""
    out = tmp_path_factory.mktemp("quick") / "out"
    run(room_recording, "--out", out, *QUICK)
    return out


def test_output_files_follow_contract(room_result, room_recording) -> None:
    assert {p.name for p in room_result.iterdir()} == FILES
    times, poses = read_tum(room_result / "trajectory.txt")
    recorded, _ = read_tum(room_recording / "groundtruth.txt")
    np.testing.assert_allclose(times, recorded, atol=1e-6)
    np.testing.assert_array_equal(poses[0], np.eye(4))
    graph = read_g2o(room_result / "pose_graph.g2o")
    np.testing.assert_allclose(graph.poses, poses, atol=1e-6)
    assert len(graph.edges) >= 7
    assert (np.linalg.eigvalsh(graph.information) > 0).all()
    cloud = read_ply(room_result / "cloud.ply")
    assert len(cloud) > 1000
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-4)
    assert np.ptp(cloud.color) > 100
    report = (room_result / "report.html").read_text()
    assert report.lower().startswith("<!doctype html")
    assert not re.search(r"(src|href)=[\"']https?:", report)


def test_run_json_follows_contract(room_result, room_recording) -> None:
    data = run_json(room_result)
    opening = data["input"].pop("opening")
    assert data["input"] == {"path": str(room_recording), "format": "native", "frames": 8}
    assert opening["paths"] == [str(room_recording)]
    assert (data["seed"], data["threads"]) == (0, 2)
    assert data["verdict"] in ("good", "degraded", "failed")
    assert all(isinstance(s, float) and s >= 0 for s in data["seconds"].values())
    for reason in data["reasons"]:
        assert set(reason) == {"code", "frames", "ranges", "remedy", "text"}
        assert reason["code"] in REASONS
        assert len(reason["frames"]) == 2
    assert [f["index"] for f in data["frames"]] == list(range(8))
    for frame in data["frames"]:
        assert set(frame) == set(FRAME_KEYS.split())
        assert frame["status"] == "tracked"
        assert 0 < frame["valid_share"] <= 1
        if frame["index"]:
            assert 0 < frame["inlier_share"] <= 1
            assert 0 < frame["rms_m"] < 0.1
            assert (np.linalg.eigvalsh(np.array(frame["covariance"]).reshape(6, 6)) > 0).all()
    for values in data["filters"].values():
        assert set(values) == {"removed"}
        assert 0 <= values["removed"] <= 1


def test_result_depends_on_neither_threads_nor_reference(recording, room_result, tmp_path) -> None:
    assert run_json(room_result)["threads"] == 2
    (recording / "groundtruth.txt").write_text("0 5 5 5 0 0 0 1\n0.1 -5 5 5 0 0 0 1\n")
    run(recording, "--out", tmp_path / "out", "--threads", 1)
    assert same(tmp_path / "out") == same(room_result)


@pytest.mark.nightly
def test_seed_controls_randomness(room_recording, tmp_path) -> None:
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        run(room_recording, "--out", tmp_path / name, "--seed", seed, *QUICK)
    assert same(tmp_path / "a") == same(tmp_path / "b")
    assert len({(tmp_path / n / "trajectory.txt").read_bytes() for n in ("b", "c")}) == 2


@pytest.mark.nightly_part
def test_run_json_as_config_reproduces_result(recording, tmp_path) -> None:
    change_camera(recording, confidence_max=2)
    for file in (recording / "confidence").iterdir():
        write_png(file, (read_image(file) // 3).astype(np.uint8))
    options = ["--seed", 3, "--max-depth", 4, "--guess", "identity", "--method", "thesis"]
    part = ["--end", 3]  # which frames are read is no part of the configuration
    run(recording, "--out", tmp_path / "a", *options, *part)
    config = run_json(tmp_path / "a")["config"]
    limits = {"minimum": 0.0, "maximum": 4.0, "measure": "z"}
    assert config["filters"][0] == {"part": "distance"} | limits
    assert config["filters"][1] == {"part": "confidence", "minimum": 2, "highest": 2}
    run(recording, "--out", tmp_path / "b", "--config", tmp_path / "a/run.json", *part)
    assert same(tmp_path / "b") == same(tmp_path / "a")
    again = run_json(tmp_path / "b")
    assert again["config"] == config
    assert again["seed"] == 3
    # Options of the command line override those of the file.
    words = ["--config", tmp_path / "a/run.json", "--seed", 4]
    run(recording, "--out", tmp_path / "c", *words, *part)
    assert run_json(tmp_path / "c")["seed"] == 4


@pytest.mark.nightly_part
def test_object_is_segmented_from_background(tmp_path, capsys) -> None:
    effects = Effects.none(shot_noise=True, scatter=0.02)
    simulate("box", tmp_path / "rec", every=20, frames=6, effects=effects)
    run(tmp_path / "rec", "--out", tmp_path / "out", "--object")
    assert "interrupted" not in capsys.readouterr().err
    made = run_json(tmp_path / "out")
    assert made["config"]["filters"][0] == {"part": "background", "sigmas": 4.0, "fraction": 0.02}
    *_, scattering, multipath = made["config"]["corrections"]
    assert (scattering["part"], multipath["part"]) == ("scattering", "multipath")
    assert 0.01 < sum(scattering["fractions"]) < 0.04
    assert 0.5 < made["filters"]["background"]["removed"] < 0.95
    # The wall is 4 m away.
    assert np.linalg.norm(read_ply(tmp_path / "out/cloud.ply").points, axis=1).max() < 2
    # The run is reproducible from its run.json.
    again = ["--config", tmp_path / "out/run.json", "--threads", 1]
    run(tmp_path / "rec", "--out", tmp_path / "again", "--object", *again)
    assert same(tmp_path / "again") == same(tmp_path / "out")


def test_unwrap_without_amplitude_is_rejected(recording, tmp_path, capsys) -> None:
    shutil.rmtree(recording / "amplitude")
    words = ("run", recording, "--out", tmp_path / "out", "--unwrap")
    refuses(capsys, *words, says="--unwrap: the recording can't be unwrapped")


def test_unwrap_of_several_frequencies_says_why_not(recording, tmp_path, capsys) -> None:
    change_camera(recording, ambiguity_m=7.5)
    words = ("run", recording, "--out", tmp_path / "out", "--unwrap")
    refuses(capsys, *words, says="ambiguity range of 7.5 m is that of several")


def test_object_option_rejects_moving_camera(room_recording, tmp_path, capsys) -> None:
    words = ("run", room_recording, "--out", tmp_path / "out", "--object")
    refuses(capsys, *words, says="leave it out if the camera moves")
    assert not (tmp_path / "out").exists()


def test_unreadable_frame_is_skipped_and_blank_one_lost(recording, tmp_path, capsys) -> None:
    unreadable, blank = (recording / f"depth/00000{k}.png" for k in (1, 3))
    unreadable.write_bytes(unreadable.read_bytes()[:200])
    write_png(blank, np.zeros_like(read_image(blank)))
    run(recording, "--out", tmp_path / "out", "--end", 6, status=3, report=True)
    assert "4 of 6 frames tracked, 1 lost, 1 unreadable" in capsys.readouterr().out
    data = run_json(tmp_path / "out")
    status = ["tracked", "skipped", "tracked", "lost", "tracked", "tracked"]
    assert [f["status"] for f in data["frames"]] == status
    assert "000001.png" in data["frames"][1]["reason"]
    assert data["frames"][3]["covariance"] is None
    assert {"unreadable_frames", "lost_frames"} <= {r["code"] for r in data["reasons"]}
    assert data["verdict"] == "degraded"
    times, _ = read_tum(tmp_path / "out/trajectory.txt")
    recorded, _ = read_tum(recording / "groundtruth.txt")
    np.testing.assert_allclose(times, recorded[[0, 2, 4, 5]], atol=1e-6)
    assert read_g2o(tmp_path / "out/pose_graph.g2o").ids.tolist() == [0, 2, 4, 5]
    assert "Frame 1 could not be read." in (tmp_path / "out/report.html").read_text()
    (text,) = (r["text"] for r in data["reasons"] if r["code"] == "unreadable_frames")
    assert "000001.png" in text


def test_loops_are_read_from_file(room_recording, tmp_path) -> None:
    loops = tmp_path / "loops.txt"
    T = read_tum(room_recording / "groundtruth.txt")[1][6]
    loops.write_text(f"# by hand\n0 6 {T[0, 3]} {T[1, 3]} {T[2, 3]} 0 0 0 1\n")
    run(room_recording, "--out", tmp_path / "out", "--loops", loops, "--method", "thesis")
    (loop,) = run_json(tmp_path / "out")["loops"]
    assert (loop["i"], loop["j"], loop["accepted"]) == (0, 6, True)
    assert set(loop) == set(LOOP_KEYS.split())
    assert len(read_g2o(tmp_path / "out/pose_graph.g2o").edges) == 8


def test_json_lines_end_with_result(room_recording, tmp_path, capfd) -> None:
    run(room_recording, "--out", tmp_path / "out", "--json", "--every", 4, "--voxel", "10cm")
    done = capfd.readouterr()
    assert done.err == ""
    lines = [json.loads(line) for line in done.out.splitlines()]
    assert {line["event"] for line in lines} == {"stage", "frame", "note", "result"}
    assert [line["index"] for line in lines if line["event"] == "frame"] == [0, 4]
    last = lines[-1]
    assert last["event"] == "result"
    assert last["frames"] == {"tracked": 2, "predicted": 0, "lost": 0, "skipped": 0}
    assert last["out"] == str(tmp_path / "out")
    assert json.loads(printed(capfd, "inspect", "--json", room_recording))["facts"]["frames"] == "8"


def test_log_output_is_concise_and_notes_appear_once(recording, tmp_path, capfd) -> None:
    change_camera(recording, colour_of_case="grey")
    run(recording, "--out", tmp_path / "out", "--every", 4)
    done = capfd.readouterr()
    notes = done.err.splitlines()
    assert all(note.startswith("note: ") for note in notes)
    assert sum("colour_of_case" in note for note in notes) == 1
    assert sum("multipath not applied" in note for note in notes) == 1
    assert len(notes) == 2
    # Each reason, and its remedy.
    assert len(done.out.splitlines()) <= 4 + 2 * len(run_json(tmp_path / "out")["reasons"])
    assert "\x1b" not in done.out


@pytest.mark.nightly_part
@pytest.mark.parametrize(
    ("stage", "error"),
    [("tracking", KeyboardInterrupt), ("checking", TofuseError), ("writing", RuntimeError)],
)
def test_interrupted_run_changes_nothing(
    stage, error, quick_run, room_recording, tmp_path, monkeypatch
) -> None:
    words = ["run", str(room_recording), "--out", str(tmp_path / "out"), *QUICK]
    shutil.copytree(quick_run, tmp_path / "out")
    before = contents(tmp_path)

    def interrupt(_self, name, total=None) -> None:
        if name == stage:
            raise error("now")

    with monkeypatch.context() as patch:
        patch.setattr("tofuse.apps.cli.progress.QuietProgress.stage", interrupt)
        words += ["--overwrite", "--seed", "1"]
        if error is RuntimeError:
            with pytest.raises(RuntimeError):
                main(words)
        else:
            assert main(words) == (130 if error is KeyboardInterrupt else 2)
        assert contents(tmp_path) == before
        # Without an earlier result nothing is left behind, and the same command then succeeds.
        words = ["run", str(room_recording), "--out", str(tmp_path / "new/out"), *QUICK]
        with contextlib.suppress(RuntimeError):
            main(words)
        assert not (tmp_path / "new").exists()
    assert main(words) == 0


OPTIONS = {
    "run": "--out --method --camera --config --format --seed --threads --start --end --every "
    "--min-depth --max-depth --guess --loops --object --overwrite --json",
    "demo": "--scene --out",
    "simulate": "--out --camera --seed",
    "inspect": "",
    "evaluate": "--recording --json",
    "optimize": "--out",
    "experiments": "--out",
}


@pytest.mark.parametrize("command", OPTIONS)
def test_each_command_has_help(command, capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    done = capsys.readouterr()
    assert done.err == ""
    for option in OPTIONS[command].split():
        assert re.search(rf"{option}\b", done.out), option
    if command in ("run", "demo"):
        assert "exit status" in done.out
    assert "None" not in done.out


def test_help_and_version_are_printed(capsys) -> None:
    for words in (["--help"], ["--version"]):
        with pytest.raises(SystemExit) as stop:
            main(words)
        assert stop.value.code == 0
    out = capsys.readouterr().out
    for command in OPTIONS:
        assert re.search(rf"^ +{command}\b", out, re.MULTILINE)
    assert re.search(r"^tofuse \d+\.\d+", out, re.MULTILINE)


def test_module_runs_as_script() -> None:
    words = [sys.executable, "-m", "tofuse", "--version"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("tofuse ")
    done = subprocess.run(words[:-1], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("usage: tofuse")


@pytest.mark.nightly
def test_closed_output_pipe_is_silent(room_recording) -> None:
    words = [sys.executable, "-m", "tofuse", "inspect", str(room_recording)]
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(words, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.nightly
def test_peaks_demo(tmp_path, capsys, monkeypatch) -> None:
    out = tmp_path / "demo"
    # A part of the circle.
    monkeypatch.setattr(demo_module, "simulate_to", partial(demo_module.simulate_to, frames=3))
    assert main(["demo", "--scene", "peaks", "--out", str(out)]) in (0, 3)
    made = (FILES | {"recording"}) - {"mesh.ply", "mesh.glb"}
    assert {p.name for p in out.iterdir()} == made
    assert run_json(out)["config"]["filters"] == []
    refuses(capsys, "demo", "--scene", "peaks", "--out", out, says="--overwrite")
    words = ["demo", "--scene", "peaks", "--method", "thesis", "--seed", "1"]
    assert main([*words, "--out", str(out), "--overwrite"]) in (0, 3)
    assert run_json(out)["seed"] == 1
    assert run_json(out)["config"]["odometry"]["registration"]["resolution"] == 1.0
    assert {p.name for p in out.iterdir()} == made


def test_run_is_evaluated(room_result, room_recording, capsys) -> None:
    words = ["evaluate", str(room_result), str(room_recording), "--recording", str(room_recording)]
    data = json.loads(printed(capsys, *words, "--json"))
    assert data["ate_rms_m"] < 0.1
    assert data["coverage"] == 1
    assert data["map_consistency"]["inlier_share"] > 0.5
    table = printed(capsys, *words)
    for part in ("ATE rms", "RPE over 1 frame", "RPE over 30 frames", "map consistency"):
        assert part in table


def test_evaluate_says_what_is_not_comparable(room_result, room_recording, tmp_path, capsys):
    rows = np.loadtxt(room_result / "trajectory.txt")
    np.save(tmp_path / "inverse.npy", np.linalg.inv(tofuse.load(room_result).trajectory))
    np.savetxt(tmp_path / "ms.txt", rows * ([1000] + [1] * 7))
    assert main(["evaluate", str(tmp_path / "inverse.npy"), str(room_recording)]) == 0
    assert "if the estimate or the reference holds T_camera_world" in capsys.readouterr().err
    words = ["evaluate", str(tmp_path / "ms.txt"), str(room_recording)]
    assert main([*words, "--reference-error", "5mm"]) == 0
    printed = capsys.readouterr()
    assert "same clock" in printed.err
    assert "too few poses" in printed.out
    assert "true ATE" not in printed.out


def test_evaluate_uses_reference_of_recording(room_result, room_recording, tmp_path, capsys):
    """In any format, not only the native one."""
    out = tmp_path / "tum"
    assert main(["convert", str(room_recording), "--out", str(out), "--to", "tum"]) == 0
    words = ["evaluate", str(room_result), "--json"]
    expected = json.loads(
        printed(capsys, "evaluate", room_result, room_recording, "--json").splitlines()[-1]
    )
    found = json.loads(printed(capsys, "evaluate", room_result, out, "--json"))
    assert found["ate_rms_m"] == pytest.approx(expected["ate_rms_m"], abs=1e-5)
    bare = tmp_path / "bare"
    shutil.copytree(room_recording, bare)
    (bare / "groundtruth.txt").unlink()
    refuses(capsys, *words, bare, says="has no reference poses")
    refuses(capsys, *words, tmp_path / "none.txt", says="none.txt: doesn't exist")


def test_optimize_command_keeps_refined_poses(room_result, tmp_path, capsys) -> None:
    out = tmp_path / "out.g2o"
    assert re.match(
        r"8 poses, \d+ edges: squared error",
        printed(capsys, "optimize", room_result / "pose_graph.g2o", "--out", out),
    )
    # The edges are those of the refinement, so there is nothing to improve.
    before, after = read_g2o(room_result / "pose_graph.g2o"), read_g2o(out)
    assert after.ids.tolist() == list(range(8))
    assert np.abs(after.poses - before.poses).max() < 2e-3
    assert main(["optimize", str(out), "--out", str(out)]) == 2
    words = ["optimize", str(out), "--out", str(out), "--overwrite", "--optimiser"]
    assert main([*words, "castellani"]) == 0
    capsys.readouterr()
    refuses(capsys, *words, "guesswork", says="castellani")


def test_optimize_reports_false_loops_and_components(tmp_path, capsys) -> None:
    unit = " ".join(str(v) for v in 1e4 * np.eye(6)[np.triu_indices(6)])
    lines = [f"VERTEX_SE3:QUAT {k} {k} 0 0 0 0 0 1" for k in (0, 1, 2, 3, 4, 9)]
    edges = [(0, 1, 1.01), (1, 2, 0.99), (2, 3, 1.0), (3, 4, 1.0)]
    edges += [(0, 2, 2.01), (0, 3, 3.0), (1, 4, 3.01), (0, 4, -7.0)]
    lines += [f"EDGE_SE3:QUAT {i} {j} {x} 0 0 0 0 0 1 {unit}" for i, j, x in edges]
    (tmp_path / "in.g2o").write_text("\n".join(lines) + "\n")
    words = ["optimize", str(tmp_path / "in.g2o"), "--out", str(tmp_path / "out.g2o")]
    output = printed(capsys, *words, "--robust", "truncated")
    assert "1 edge rejected as inconsistent with the others" in output
    assert re.search(r"part from vertex 0: 5 poses, 8 edges", output)
    assert re.search(r"part from vertex 9: 1 pose, 0 edges", output)
    assert "No other poses fit these measurements better" in output
    assert read_g2o(tmp_path / "out.g2o").poses[4, 0, 3] == pytest.approx(4.0, abs=0.02)
    # By default it is least squares of what is in the file.
    found = json.loads(printed(capsys, *words, "--overwrite", "--json"))
    assert found["rejected"] == []
    assert found["poses"] == 6
    assert found["after"] < 0.9 * found["before"]
    # With so false a loop the relaxation is not tight, and nothing is claimed.
    assert not found["certificate"]["optimal"]
    assert found["certificate"]["lower_bound"] < 0.95 * found["after"]
    assert read_g2o(tmp_path / "out.g2o").poses[4, 0, 3] < 2
    words += ["--overwrite", "--robust", "huber", "--optimiser", "elch"]
    refuses(capsys, *words, says="--robust: needs the optimiser levenberg-marquardt")


def test_optimize_says_what_it_cannot_show(tmp_path, capsys) -> None:
    """Rounded information is projected, with a warning; anisotropic information certifies less."""
    rows = [f"VERTEX_SE3:QUAT {k} {k} 0 0 0 0 0 1" for k in range(3)]
    information = np.diag([1.0, 1.0, 1e4, 1.0, 1.0, 1.0])
    information[0, 1] = information[1, 0] = 1.0001
    upper = " ".join(str(v) for v in information[np.triu_indices(6)])
    for i, j, z in ((0, 1, 0.1), (1, 2, 0.1), (0, 2, 0.0)):
        rows.append(f"EDGE_SE3:QUAT {i} {j} {j - i} 0 {z} 0 0 0 1 {upper}")
    (tmp_path / "in.g2o").write_text("\n".join(rows) + "\n")
    with pytest.warns(InputWarning, match="3 of 3 information matrices are slightly indefinite"):
        main(["optimize", str(tmp_path / "in.g2o"), "--out", str(tmp_path / "out.g2o")])
    assert "no other poses fit better is not shown" in capsys.readouterr().out
