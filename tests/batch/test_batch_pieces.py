"""One long recording, computed in parts on a Dask cluster of two processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from aligned_surfaces import drifted, path, surfaces
from paths import BENCHMARKS, HELPERS
from refined_submaps import refined
from revisited_path import ALL, pushed, turn  # noqa: F401 - a fixture
from tofuse.batch import client
from tofuse.cli import main
from tofuse.kernels.executors import LocalExecutor, executor, using_executor
from tofuse.posegraph.refinement import Joint
from tofuse.posegraph.revisits import Revisits

pytest.importorskip("distributed", reason="Dask is not installed")
from tofuse.batch import pieces
from tofuse.batch.pieces import DaskExecutor


@pytest.fixture(scope="module")
def batch_benchmark() -> Iterator:
    """The benchmark, which starts clusters and compares results."""
    pytest.importorskip("psutil")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        # Workers look up the functions of this module by their names.
        known = [str(Path(__file__).parent), str(HELPERS), os.environ.get("PYTHONPATH", "")]
        patch.setenv("PYTHONPATH", os.pathsep.join(known))
        # Shorter than the half minute that a scheduler waits for a killed worker to connect, and
        # long enough for a busy machine.
        patch.setenv("DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT", "8s")
        import batch

        yield batch


@pytest.fixture(scope="module")
def cluster(batch_benchmark) -> Iterator[str]:
    """The address of a cluster of two workers."""
    with batch_benchmark.local_cluster(2) as (address, _):
        yield address


def slowly_squared(k: int) -> tuple[int, int]:
    import time

    time.sleep(0.05)
    return k * k, os.getpid()


def failing(k: int) -> int:
    raise ValueError(f"piece {k}")


@pytest.mark.slow
def test_cluster_run_gives_same_bytes(
    batch_benchmark, cluster: str, tmp_path: Path, monkeypatch
) -> None:
    from tofuse.lab.simulation.effects import Effects
    from tofuse.lab.simulation.record import simulate

    recording = simulate("room", tmp_path / "room", frames=11, effects=Effects.none())
    config = tmp_path / "small.toml"
    config.write_text('corrections = []\n[refinement]\npart = "joint"\nsubmap = 10\n')
    there: list[int] = []
    leave = DaskExecutor.close
    monkeypatch.setattr(
        DaskExecutor, "close", lambda self: (there.append(self.n_remote), leave(self))
    )
    words = ["run", str(recording), "--config", str(config), "--voxel", "50mm", "--no-report"]
    words += ["--threads", "2"]
    assert main([*words, "--out", str(tmp_path / "here")]) == 0
    assert main([*words, "--out", str(tmp_path / "there"), "--scheduler", cluster]) == 0
    assert there == [2]  # submaps
    assert batch_benchmark.contents(tmp_path / "here") == batch_benchmark.contents(
        tmp_path / "there"
    )


@pytest.mark.slow
def test_cluster_refinement_is_bit_identical(cluster: str) -> None:
    truth = path(30)
    views, start = surfaces(truth, noise=0.005), drifted(truth)
    here = refined(Joint(submap=10), views, start)
    messages: list[str] = []
    there = DaskExecutor(cluster, messages.append)
    with using_executor(there):
        assert executor() is there
        found = refined(Joint(submap=10), views, start)
    there.close()
    assert isinstance(executor(), LocalExecutor)
    assert there.n_remote == 3
    assert not messages
    np.testing.assert_array_equal(found.poses, here.poses)
    assert found.support == here.support
    for a, b in zip(found.edges, here.edges, strict=True):
        np.testing.assert_array_equal(a.information, b.information)


def test_cluster_loop_search_is_bit_identical(cluster: str, turn) -> None:  # noqa: F811
    frames, _, start = turn
    options = Revisits(overlap=0.15)
    here = pushed(options, frames, start)
    there = DaskExecutor(cluster, lambda text: None)
    with using_executor(there):
        found = pushed(options, frames, start)
    there.close()
    assert there.n_remote >= len(here) > 1
    for a, b in zip(found, here, strict=True):
        assert a.record == b.record
        np.testing.assert_array_equal(a.T_i_j, b.T_i_j)
        np.testing.assert_array_equal(a.information, b.information)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
def test_killed_worker_loses_no_results(cluster: str) -> None:
    there = DaskExecutor(cluster, lambda text: None)
    killed: set[int] = set()

    def arguments(k: int) -> tuple[int]:
        if k == 12 and not killed:  # some pieces are in progress
            pids = there._client.run(os.getpid)
            killed.add(next(iter(pids.values())))
            os.kill(next(iter(killed)), signal.SIGKILL)
        return (k,)

    found = there.map(slowly_squared, 40, arguments)
    there.close()
    assert killed
    assert [square for square, _ in found] == [k * k for k in range(40)]


def test_requests_that_time_out_are_repeated(cluster: str, monkeypatch) -> None:
    messages: list[str] = []
    there = DaskExecutor(cluster, messages.append)
    timed_out: list[str] = []

    def once(name: str):
        request = getattr(there._client, name)

        def ask(*args, **kwargs):
            if name not in timed_out:
                timed_out.append(name)
                raise TimeoutError
            return request(*args, **kwargs)

        return ask

    for name in ("scheduler_info", "scatter"):
        monkeypatch.setattr(there._client, name, once(name))
    found = there.map(slowly_squared, 3, lambda k: (k,))
    there.close()
    assert timed_out == ["scheduler_info", "scatter"]
    assert not messages
    assert there.n_remote == 3
    assert [square for square, _ in found] == [0, 1, 4]


@pytest.mark.slow
def test_first_worker_may_connect_after_run(batch_benchmark) -> None:
    messages: list[str] = []
    with batch_benchmark.local_cluster(0) as (address, _):
        command = [sys.executable, "-m", "dask", "worker", address, "--no-nanny", "--no-dashboard"]
        worker = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        try:
            there = DaskExecutor(address, messages.append)
            there.map(slowly_squared, 3, lambda k: (k,))
            there.close()
        finally:
            worker.kill()
            worker.wait()
    assert not messages
    assert there.n_remote == 3


def test_worker_error_is_raised_as_in_local_run(cluster) -> None:
    messages: list[str] = []
    there = DaskExecutor(cluster, messages.append)
    with pytest.raises(ValueError, match="piece 0"):
        there.map(failing, 3, lambda k: (k,))
    there.close()
    assert messages == [
        f"{cluster}: a worker failed (piece 0); the rest of the run is done on this machine"
    ]


@pytest.mark.slow
def test_lost_scheduler_falls_back_to_local_execution(batch_benchmark) -> None:
    messages: list[str] = []
    with batch_benchmark.local_cluster(1) as (address, _):
        there = DaskExecutor(address, messages.append)
        some = there.map(slowly_squared, 3, lambda k: (k,))
        assert not messages
        assert os.getpid() not in {pid for _, pid in some}
    rest = there.map(slowly_squared, 5, lambda k: (k,))
    assert {pid for _, pid in rest} == {os.getpid()}
    assert [square for square, _ in rest] == [0, 1, 4, 9, 16]
    there.map(slowly_squared, 2, lambda k: (k,))
    there.close()
    gone = f"{address}: the scheduler disappeared; the rest of the run is done on this machine"
    assert messages == [gone]


def test_workers_of_other_versions_are_rejected(
    batch_benchmark, room_recording, tmp_path, monkeypatch, capsys, cluster
) -> None:
    monkeypatch.setattr(pieces, "_environment", lambda: ("tofuse 0.0", "numpy 1"))
    words = ["run", str(room_recording), "--out", str(tmp_path / "out"), "--scheduler", cluster]
    monkeypatch.setattr(DaskExecutor, "_check_workers", _checked_against(pieces._environment()))
    assert main(words) == 2
    output = capsys.readouterr().err
    assert "results would differ: install the same versions there" in output
    assert output.count("\n") == 1


def _checked_against(mine):
    checked = DaskExecutor._check_workers

    def check(self) -> None:
        self._client.run = lambda _: {"tcp://worker:1": ("tofuse 9.9", *mine[1:])}
        checked(self)

    return check


def test_unreachable_scheduler_is_reported(
    room_recording: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.setattr(client, "TIMEOUT_S", 1.0)
    words = ["run", str(room_recording), "--out", str(tmp_path / "out")]
    assert main([*words, "--scheduler", "tcp://127.0.0.1:1"]) == 2
    output = capsys.readouterr().err
    assert output.startswith("tofuse: tcp://127.0.0.1:1: no Dask scheduler answers; start one")
    assert output.count("\n") == 1
    assert not (tmp_path / "out").exists()
