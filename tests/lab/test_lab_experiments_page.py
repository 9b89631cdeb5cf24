"""The experiments' page: verdicts follow the numbers, and foreign files are untouched."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from tofuse.lab.experiments.page import run_experiments
from tofuse.lab.experiments.peaks import PeaksSweep
from tofuse.lab.experiments.statements import STATEMENTS


@pytest.fixture(scope="module")
def peaks_page(tmp_path_factory):
    out = tmp_path_factory.mktemp("experiments") / "peaks"
    return run_experiments(out, cases=("peaks",), seeds=1)


@pytest.fixture(scope="module")
def rail_page(tmp_path_factory):
    out = tmp_path_factory.mktemp("experiments") / "rail"
    return run_experiments(out, cases=("rail",), limit=8, draws=1)


def read(page):
    return json.loads((page.parent / "results.json").read_text(encoding="utf-8"))


def test_sweep_is_judged_by_its_errors():
    sigmas = np.arange(1, 11) / 100
    axes = np.ones((10, 2, 6))
    axes[:, 0] += np.array([2, 0.1, 2, 3, 0.5, 0.5]) * np.maximum(sigmas - 0.04, 0)[:, None]
    position = np.stack([np.where(sigmas > 0.05, 2.0, 0.1), np.full(10, 0.05)], 1)
    sweep = PeaksSweep(sigmas, position, position, axes, 0 * axes, ())
    chosen = {s.name: s for s in STATEMENTS}

    def outcome(name, sweep):
        return chosen[name].judge(sweep).outcome

    for name in ("threshold", "improves", "y", "x-z", "more-noise", "yaw"):
        assert outcome(f"peaks-{name}", sweep) == "agrees"
    worse = replace(
        sweep, axes=axes[:, ::-1], position=position[:, ::-1], rotation=position[:, ::-1]
    )
    for name in ("improves", "y", "more-noise", "yaw"):
        assert outcome(f"peaks-{name}", worse) == "disagrees"
    assert outcome("peaks-threshold", replace(sweep, position=position + 1)) == "partly"


@pytest.mark.nightly
def test_peaks_case_gives_page_and_results(peaks_page):
    data = read(peaks_page)
    assert (data["kind"], data["parameters"]["seeds"]) == ("experiments", 1)
    assert data["cases"] == {}
    assert {s["section"] for s in data["statements"]} == {"5.6"}
    error = data["peaks"]["position_m"]
    assert len(error["sequential"]) == 10
    assert error["optimised"][-1] < error["sequential"][-1]
    text = peaks_page.read_text(encoding="utf-8")
    for outside in ("http://", "https://", "<script", "@import"):
        assert outside not in text
    # Six panels, and the example before and after.
    assert text.count('<svg class="plot"') == 8
    assert "“The yaw-angle is most improved.”" in text


@pytest.mark.nightly
def test_scene_is_run_with_all_variants(rail_page):
    data = read(rail_page)
    runs = data["cases"]["rail"]["runs"]
    ways = {(r["method"], r["stride"], r["guess"]) for r in runs}
    assert len(runs) == len(ways) == 2 * 3 * 2
    assert {r["stride"] for r in runs} == {3, 5, 7}
    for run in runs:
        assert run["frames"] == run["with_pose"] == -(-8 // run["stride"])
        assert run["before"]["end_error_m"] < 0.1
    # With the true poses the same frames lie on the true surface.
    assert data["cases"]["rail"]["true_poses"]["surface_error_m"] < 0.03
    judged = {s["name"]: s for s in data["statements"]}
    assert set(judged) == {s.name for s in STATEMENTS if s.needs == ("rail",)}
    for s in judged.values():
        assert set(s["findings"]) == {"thesis", "default"}
    text = rail_page.read_text(encoding="utf-8")
    assert "Translation of the camera" in text
    assert not re.search(r"\bnan\b", re.sub(r"data:[^\"']+", "", text), re.IGNORECASE)
