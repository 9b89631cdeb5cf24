"""Smoke tests of the benchmark scripts, without peers."""

from __future__ import annotations

import ast
import importlib
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from paths import BENCHMARKS
from tofuse.engine.compute import ahead
from tofuse.engine.errors import InputWarning


@pytest.fixture(autouse=True)
def on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))


def test_imported_names_exist() -> None:
    """Of the package and of other scripts, which are only read, as some need peers."""
    missing = []
    for path in sorted(BENCHMARKS.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.ImportFrom) or node.module is None:
                continue
            script = BENCHMARKS / f"{node.module.replace('.', '/')}.py"
            names = {alias.name for alias in node.names}
            if node.module.split(".")[0] == "tofuse":
                module = importlib.import_module(node.module)
                known = {n for n in names if hasattr(module, n) or find_spec(f"{node.module}.{n}")}
            else:
                known = set(names_in(script)) if script.exists() else names
            missing += [f"{path.name}: {name}" for name in names - known]
    assert missing == []


def names_in(script: Path) -> Iterator[str]:
    """Names that a script defines or imports at its top level."""
    for node in ast.parse(script.read_text()).body:
        for inner in ast.walk(node):
            if isinstance(inner, ast.Name) and isinstance(inner.ctx, ast.Store):
                yield inner.id
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Import | ast.ImportFrom):
            yield from (alias.asname or alias.name for alias in node.names)


def test_own_scenes_can_be_built() -> None:
    unusual, other_sensor = (importlib.import_module(n) for n in ("unusual", "other_sensor"))
    made = [unusual.built(name, fill) for name, (fill, _) in other_sensor.SCENES.items()]
    own = [u.scene for u in unusual.UNUSUAL.values() if "built" in u.scene.__qualname__]
    for scene in (*made, *own):
        assert scene(0).materials


@pytest.mark.parametrize("script", ["tracking", "scaling", "end_to_end", "offline_system"])
def test_script_prints_help(script: str, capsys) -> None:
    with pytest.raises(SystemExit, match="0"):
        importlib.import_module(script).main(["--help"])
    assert "--threads" in capsys.readouterr().out


def test_picture_of_speed_finds_peers_in_the_evidence() -> None:
    picture = importlib.import_module("speed_picture")
    peers = dict(picture.peers(picture.EVIDENCE.read_text()))
    assert list(peers) == list(picture.PEERS.values())
    assert all(5 < ms < 500 for ms in peers.values())
    assert peers["Open3D dense SLAM and mesh"] > peers["small_gicp, tracking only"]


def test_groups_of_stages_have_all_time() -> None:
    grouped = importlib.import_module("stages").grouped
    groups = grouped({"imports": 1.0, "kernels": 2.0, "tracking": 4.0, "unknown": 8.0})
    assert (groups["start"], groups["tracking"], groups["other"]) == (3, 4, 8)
    assert sum(groups.values()) == 15


def test_listed_signatures_round_trip() -> None:
    compilation = importlib.import_module("compilation")
    listed = ahead.signatures(all_commands=True)
    lines = [compilation.signature_line(name, types) for name, types in listed]
    text = Path(ahead.__file__).with_name("signatures.txt").read_text()
    assert lines == text.replace("\n\n", "\n").splitlines()


def test_leak_is_detected() -> None:
    soak = importlib.import_module("soak")

    def bounded(memory: list[int], descriptors: int = 7, threads: int = 3) -> bool:
        usages = [soak.Usage(100 * (k + 1), m, 7, 3) for k, m in enumerate(memory[:-1])]
        last = soak.Usage(1000, memory[-1], descriptors, threads)
        return soak.bounded([*usages, last], soak.RUN_BYTES)

    flat = [int(5e8 + 1e5 * (-1) ** k) for k in range(10)]
    assert bounded(flat)
    assert bounded([int(1e8 * min(k + 1, 4)) for k in range(10)])  # caches fill at the beginning
    assert not bounded([int(1e8 + 5e6 * k) for k in range(10)])  # 50 kB each
    assert not bounded(flat, descriptors=8)
    assert not bounded(flat, threads=4)


@pytest.mark.nightly
def test_mapper_accepts_late_missing_and_duplicate_frames(tmp_path: Path) -> None:
    soak: ModuleType = importlib.import_module("soak")
    camera = soak.Camera(32, 70, 10.0)
    list(camera._frames(70))
    assert min(camera.sent.missing, camera.sent.doubled, camera.sent.late) > 0
    with pytest.warns(InputWarning, match="leave out frames that repeat"):
        assert soak.live(32, 7.0, 10.0, tmp_path, mapped=True, samples=3)


def test_false_loops_leave_true_edges_unchanged() -> None:
    pose_graphs = importlib.import_module("pose_graphs")
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


def test_real_recordings_have_reference_poses(shared_data: Path) -> None:
    recorded = importlib.import_module("recorded")
    for name in ("sr4000_corridor", "xtion_ring", "azure_kinect_rig", "open3d_rgbd5"):
        one = recorded.RECORDED[name]
        recording = one.open(shared_data)
        references = one.references(shared_data, recording)
        assert references
        for poses in references:
            assert poses.shape == (len(recording), 4, 4)
            np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1, atol=1e-3)
