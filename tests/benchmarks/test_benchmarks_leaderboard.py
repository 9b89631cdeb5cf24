"""The leaderboard: new parts become rows, and stored results are reused."""

from __future__ import annotations

import json
from concurrent.futures import Future
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from paths import BENCHMARKS
from tofuse.engine import parts
from tofuse.engine.alignment.base import Registrar, Registration
from tofuse.engine.geometry import se3


class Inline:
    """An executor that runs work immediately."""

    def submit(self, work, *arguments):
        future = Future()
        try:
            future.set_result(work(*arguments))
        except ValueError as error:
            future.set_exception(error)
        return future


@pytest.fixture
def board(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import leaderboard

    monkeypatch.setattr(leaderboard, "KEPT", tmp_path / "kept")
    return leaderboard


def test_registered_part_becomes_row(board, monkeypatch):
    @parts.part("registration", "of-a-test")
    @dataclass(frozen=True)
    class OfATest(Registrar):
        takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

        def register(self, source, target, guess, rng):
            return Registration(guess, True, 1, 10, 10, 0.0, 0.0, np.eye(6))

    try:
        assert "of-a-test" in board.BOARDS["pairs"].methods()
        assert "in-turn" not in board.BOARDS["pairs"].methods()  # it needs its stages
    finally:
        del parts._registry["registration"]["of-a-test"]
    names = set(board.BOARDS["pairs"].methods())
    assert {"ndt", "ls3d", "icp, gnc", "icp, comprehensive", "any-pair"} <= names


@pytest.mark.slow
def test_graph_results_are_reused_and_tabulated(board, monkeypatch, tmp_path):
    graphs = board.BOARDS["graphs"]
    monkeypatch.setattr(type(graphs), "methods", lambda _: ["elch", "levenberg-marquardt"])
    board.run_missing(["graphs"], 1, tmp_path, Inline(), [])
    files = sorted((tmp_path / "kept").rglob("*.json"))
    assert len(files) == 2 * len(graphs.cases(1))
    first = {f: f.stat().st_mtime_ns for f in files}
    files[0].unlink()
    board.run_missing(["graphs"], 1, tmp_path, Inline(), [])
    assert {f: f.stat().st_mtime_ns for f in files[1:]} == {f: first[f] for f in files[1:]}
    assert files[0].exists()
    text = board.page(["graphs"], 1)
    rows = [line for line in text.splitlines() if line.startswith(("| elch", "| levenberg"))]
    assert rows[0].startswith("| levenberg")  # it is robust to false loops
    score = json.loads(board.kept("graphs", "elch", "noise1/room/0").read_text())
    assert 0 < score["ate"] < score["before"]


def test_failed_case_is_reported_and_not_stored(board, monkeypatch, tmp_path, capsys):
    def broken(*_):
        raise ValueError("no such view")

    monkeypatch.setattr(type(board.BOARDS["graphs"]), "methods", lambda _: ["elch"])
    monkeypatch.setattr(type(board.BOARDS["graphs"]), "run", broken)
    board.run_missing(["graphs"], 1, tmp_path, Inline(), [])
    assert "no such view" in capsys.readouterr().err
    assert not list((tmp_path / "kept").rglob("*.json"))


def test_initial_guess_errors_match_column(board):
    from boards import two_views

    rng = np.random.default_rng(0)
    middle = np.array([0.1, -0.2, 2.0])
    for metres, degrees in two_views.STARTS:
        T = two_views._about(middle, metres, degrees, rng)
        assert np.degrees(se3.angle(T[:3, :3])) == pytest.approx(degrees)
        moved = se3.transform(T, middle[None])[0] - middle
        assert np.linalg.norm(moved) == pytest.approx(metres)


def test_statements_compare_rates_and_errors(board):
    from boards.statements import statements

    def row(right, off):
        return {"start2": [{"right": right, "off": off, "seconds": 0.1}] * 4}

    found = {
        "pairs": {
            "ndt": row(1.0, 0.01),
            "icp, point-to-point": row(0.0, 0.5),
            "gicp": row(0.0, 0.5),
            "ls3d": row(0.0, 0.5),
        }
    }
    out = {paper: here for paper, _, here in statements(found)}
    assert out["Magnusson 2009"] == "confirmed: 100 % vs. 0 %"
    assert out["Segal et al. 2009"].startswith("comparable")
    assert "Yang et al. 2020" not in out  # not run
