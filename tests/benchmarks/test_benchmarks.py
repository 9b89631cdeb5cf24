"""The benchmark scripts run without peers, and their measurements are right."""

import dataclasses
import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from paths import BENCHMARKS
from tofuse.engine.alignment import step_kernels as steps
from tofuse.engine.cameras.cameras import BrownConrady
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import Measured
from tofuse.engine.quality.map_agreement import map_consistency
from tofuse.formats.recordings.native import RecordingWriter
from tofuse.lab.experiments.peaks import chain


@pytest.fixture
def scripts(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import end_to_end
    import pairs
    import peers.o3d
    import pose_graphs
    import scaling
    import sequences
    import tracking

    return {
        "end_to_end": end_to_end,
        "pairs": pairs,
        "pose_graphs": pose_graphs,
        "peers": peers,
        "scaling": scaling,
        "sequences": sequences,
        "tracking": tracking,
    }


@pytest.fixture
def small_room(scripts, tmp_path, monkeypatch):
    """A recording of six views in place of the simulated room."""
    sequences, scaling = scripts["sequences"], scripts["scaling"]
    frames = scaling.made_frames(96, 6)
    monkeypatch.setattr(sequences, "OUT", tmp_path)
    (tmp_path / "recordings").mkdir()
    writer = RecordingWriter(
        tmp_path / "recordings" / "room",
        frames[0].camera,
        depth_unit_m=0.0005,
        depth_kind="z",
        frame_rate_hz=30.0,
    )
    for frame in frames:
        writer.add(frame)
    writer.finish(groundtruth=np.stack([scaling.made_pose(k) for k in range(6)]))
    return tmp_path


@pytest.mark.parametrize("script", ["tracking", "scaling", "end_to_end", "offline_system"])
def test_script_prints_help(scripts, script, capsys):
    with pytest.raises(SystemExit, match="0"):
        importlib.import_module(script).main(["--help"])
    assert "--threads" in capsys.readouterr().out


@pytest.mark.slow
def test_end_to_end_run_is_measured(scripts, small_room):
    end_to_end = scripts["end_to_end"]
    room = small_room / "recordings" / "room"
    spent = end_to_end.tofuse_run(room, ["--end", "2"], 1)
    assert spent.frames == 2
    assert {"opening", "reading", "tracking", "fusion"} <= set(spent.stages)
    assert 0 < sum(spent.stages.values()) < spent.wall_s
    assert spent.peak_mb > 50  # the imports alone
    lines = list(end_to_end.table([("tofuse run", [spent])]))
    assert f"{spent.ms_per_frame:.1f}" in lines[1]
    slow = dataclasses.replace(spent, stages={"tracking": 1.3, "loops": 0.01})
    stages = [line.split() for line in list(end_to_end.table([("tofuse run", [slow])]))[2:]]
    fraction = f"{1.3 / slow.wall_s:.0%}"
    assert stages[0] == ["tracking", "1.3", "650.0", fraction]  # ms of each of 2 frames
    assert "loops" not in [line[0] for line in stages]  # negligible time
    with pytest.raises(RuntimeError, match=r"nothing: doesn.t exist"):
        end_to_end.tofuse_run(room / "nothing", [], 1)


@pytest.mark.slow
def test_tracking_benchmark_runs_without_peers(scripts, small_room, tmp_path, monkeypatch, capsys):
    tracking = scripts["tracking"]
    for name in ("open3d", "small_gicp", "kiss_icp"):
        monkeypatch.setitem(sys.modules, name, None)
    # Must not limit the threads of other tests.
    monkeypatch.setattr(tracking, "limit_threads", lambda count: None)
    out = tmp_path / "out"
    tracking.main(["--sequences", "room", "--threads", "1", "--out", str(out)])

    assert capsys.readouterr().out.count("not installed") >= 10  # printed at once, and in the table
    found = json.loads((out / "tracking.json").read_text())["sequences"]
    (rows,) = found.values()
    by_name = {row["method"]: row for row in rows}
    for peer in ("Open3D dense SLAM", "small_gicp pairwise", "small_gicp map", "KISS-ICP"):
        assert "not installed" in by_name[peer]["problem"]
    ours, reference = by_name["tofuse"], by_name["reference poses"]
    assert ours["coverage"] == 1
    assert 0 < ours["ate_m"] < 0.015
    assert 0 < ours["ms_median"] <= ours["ms_p95"]
    assert reference["ate_m"] == pytest.approx(0, abs=1e-6)
    assert reference["map_inliers"] > 0.95
    table = (out / "tracking.md").read_text()
    assert "| tofuse" in table
    assert "96 columns of 96 x 72" in table
    assert (out / "tracking.png").stat().st_size > 1000


def test_tracking_rejects_unknown_sequence(scripts, capsys):
    with pytest.raises(SystemExit):
        scripts["tracking"].main(["--sequences", "garden"])
    assert "garden" in capsys.readouterr().err


class _Drifting:
    """A tracker whose drift grows by `error_m` times the square of the frame number."""

    tuning = ""

    def __init__(self, error_m):
        self.error_m = error_m

    def start(self, frame, threads):
        self.T = np.eye(4)
        return self

    def prepare(self, frame):
        return frame.index

    def push(self, index):
        self.T[0, 3] = index * index * self.error_m
        return self.T


def test_best_tuning_is_chosen(scripts, small_room):
    sequence = scripts["sequences"].load("room", Path())
    still = np.tile(np.eye(4), (6, 1, 1))
    object.__setattr__(sequence, "reference", still)
    candidates = [_Drifting(0.1), _Drifting(0.01), _Drifting(0.05)]
    chosen, cleaned, how = scripts["tracking"].best(candidates, sequence, 1, 100)
    assert chosen is candidates[1]
    assert cleaned
    assert how == "best of 3 on 6 frames, cleaned"


def test_pair_fit_recovers_logistic_model(scripts):
    pairs = scripts["pairs"]
    rng = np.random.default_rng(0)
    x = np.column_stack([np.ones(4000), rng.uniform(0, 1, (4000, 2))])
    p = 1 / (1 + np.exp(-x @ [-1.0, 4.0, -2.0]))
    right = rng.uniform(size=4000) < p
    np.testing.assert_allclose(pairs.fitted(x, right), [-1, 4, -2], atol=0.35)
    ranked, known = np.array([0.9, 0.8, 0.3, 0.2]), np.array([True, False, True, False])
    assert pairs.roc_area(ranked, known) == 0.75
    assert pairs.roc_area(known.astype(float), known) == 1


def test_pairs_are_spread_over_recording(scripts):
    chosen = scripts["pairs"].chosen
    assert chosen(10, 3, 3) == [(0, 3), (3, 6), (6, 9)]
    assert chosen(4, 3, 8) == [(0, 3)]
    assert chosen(3, 3, 8) == []


def test_undistorted_images_show_same_surface(scripts):
    camera = BrownConrady(176, 144, 150.0, 150.0, 87.0, 71.0, k1=-0.2, k2=0.05)
    normal, distance = np.array([0.3, -0.2, 0.9]), 2.0
    rays = np.concatenate([camera.rays(), np.ones((144, 176, 1))], -1)
    frame = RangeFrame(0, 0.0, camera, (distance / (rays @ normal)).astype(np.float32))

    images = scripts["peers"].PinholeImages(camera)
    z = images.take(frame.z)
    seen = RangeFrame(0, 0.0, images.pinhole, z)
    off = seen.points @ normal - distance
    # Half a pixel is 7 mm sideways at 2 m; the plane slopes by less than half of that.
    assert len(seen) > 0.9 * z.size
    assert np.abs(off).max() < 0.008
    untouched = RangeFrame(0, 0.0, images.pinhole, frame.depth)
    assert np.abs(untouched.points @ normal - distance).max() > 0.03


@pytest.mark.slow
def test_scanner_app_poses_are_consistent_with_images(scripts, shared_data):
    sequence = scripts["sequences"].load("iphone", shared_data)
    assert len(sequence.frames) == 70
    found = map_consistency(sequence.checked, sequence.reference, 12)
    assert found.pairs > 10
    assert found.inlier_ratio > 0.7
    flipped = sequence.reference @ np.diag([1.0, -1.0, -1.0, 1.0])
    assert not map_consistency(sequence.checked, flipped, 12).inlier_ratio > 0.5


def test_synthetic_room_is_consistent(scripts):
    scaling = scripts["scaling"]
    frames = scaling.made_frames(96, 20)
    T = se3.inverse(scaling.made_pose(0)) @ scaling.made_pose(19)
    moved = se3.transform(T, frames[19].points)
    u, v = np.round(frames[0].camera.project(moved)).T
    inside = (u >= 0) & (u < 96) & (v >= 0) & (v < 72)
    z = frames[0].z[v[inside].astype(int), u[inside].astype(int)]
    assert np.median(np.abs(z - moved[inside, 2])) < 0.02
    still = frames[0].z - frames[19].z
    assert np.median(np.abs(still)) > 0.05


def test_scaling_benchmark_runs(scripts, capsys, monkeypatch):
    scaling = scripts["scaling"]
    monkeypatch.setattr(scaling, "compilation", lambda: iter(["left out"]))
    monkeypatch.setattr(scaling, "BANDWIDTH_BYTES", 1 << 20)
    scaling.main(["--columns", "48", "96", "--counts", "6", "9", "--length", "5", "--threads", "1"])
    text = capsys.readouterr().out
    assert text.count("100%") >= 4
    assert "iterate_level" in text
    assert "outside of kernels" in text


def test_frames_run_forth_and_back(scripts):
    scaling = scripts["scaling"]
    frames = scaling.made_frames(48, 3)
    order = list(scaling.forth_and_back(frames, 7))
    assert [frame.index for frame in order] == list(range(7))
    assert [int(frame.depth is frames[1].depth) for frame in order] == [0, 1, 0, 1, 0, 1, 0]
    assert order[4].depth is frames[0].depth


def test_kernel_watch_counts_bytes(scripts):
    scaling = scripts["scaling"]
    frames = scaling.made_frames(48, 2)
    scaling.timed(scaling.tracker(48), iter(frames))
    before = steps.iterate_level
    with scaling.watched_kernels() as spent:
        scaling.timed(scaling.tracker(48), iter(frames))
        assert steps.iterate_level is not before
    assert steps.iterate_level is before
    # Every iteration reads the source's rows (at most 16 floats a point) and the whole target.
    found = spent["iterate_level"]
    assert found.calls >= 3  # levels
    source = 48 * 36 * 4 * 16
    assert source / 16 < found.bytes / found.calls < 40 * (source + 48 * 36 * 4 * 16)
    assert found.seconds > 0


def test_false_loops_leave_true_edges_unchanged(scripts):
    pose_graphs = scripts["pose_graphs"]
    clean, truth = pose_graphs.make_graph("walk", 1, 0.0)
    graph, _ = pose_graphs.make_graph("walk", 1, 0.3)
    m = len(clean.edges)
    np.testing.assert_array_equal(graph.measurements[:m], clean.measurements)
    false = len(graph.edges) - m
    assert false / graph.loop.sum() == pytest.approx(0.3, abs=0.01)
    # True edges have six degrees of freedom by their information; false ones are gross outliers.
    exact = graph.with_poses(truth)
    assert exact.chi2(np.arange(len(graph.edges)) < m) / m == pytest.approx(6, abs=1)
    assert exact.chi2(np.arange(len(graph.edges)) >= m) / false > 1000
    assert pose_graphs.ate(clean.with_poses(truth), truth) == pytest.approx(0, abs=1e-9)
    assert pose_graphs.ate(clean, truth) > 0.01


def test_general_solver_finds_same_minimum(scripts):
    pose_graphs = scripts["pose_graphs"]
    relative = se3.exp(np.tile([0.3, 0.0, 0.1, 0.02, 0.5, 0.1], (12, 1)))
    graph = chain(relative, [Measured(0, 12, np.eye(4), np.eye(6))])
    least = pose_graphs.LevenbergMarquardt(robust="none").optimise(graph).graph.chi2()
    assert least < 0.5 * graph.chi2()
    assert pose_graphs.general_solver(graph)[-1] == pytest.approx(least, rel=0.01)
