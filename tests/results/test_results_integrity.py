"""Results that were edited, or whose values contradict each other."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tofuse
from cli_calls import refuses
from refused import refused
from tofuse.apps.cli.program import main
from tofuse.apps.results import integrity, load_result, run_json
from tofuse.engine.errors import InputError


@pytest.fixture
def result(room_result: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(room_result, tmp_path / "result"))


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the content of `run.json`, with digests as a run would write them."""
    path = folder / "run.json"
    run = json.loads(path.read_text())
    del run["sha256"]
    change(run)
    path.write_text(json.dumps(run, indent=1).removesuffix("}").rstrip())
    integrity.seal(path)


def test_every_file_has_its_digest(result) -> None:
    digests = json.loads((result / "run.json").read_text())["sha256"]
    assert set(digests) == {file.name for file in result.iterdir()}
    for name in set(digests) - {"run.json"}:
        assert digests[name] == hashlib.sha256((result / name).read_bytes()).hexdigest()
    edit(result, lambda run: None)
    load_result(result)


@pytest.mark.parametrize("name", ["trajectory.txt", "pose_graph.g2o", "cloud.ply", "mesh.ply"])
def test_edited_file_is_refused_by_name_or_accepted(result, name, capfd) -> None:
    (result / name).write_bytes((result / name).read_bytes().replace(b"1", b"2", 1))
    refused(f"{name} was changed after the run", result, by=tofuse.load)
    refuses(capfd, "export", result, "pcd", says=f"{name} was changed after the run")
    assert main(["export", str(result), "pcd", "--edited"]) == 0


def test_edited_run_json_is_refused_or_accepted(result) -> None:
    path = result / "run.json"
    path.write_text(path.read_text().replace('"tracked"', '"predicted"', 1))
    refused(r"run\.json was changed after the run", result, by=load_result)
    assert tofuse.load(result, edited=True).diagnostics.frames[0].status == "predicted"


def test_deleted_overview_is_no_edit(result) -> None:
    (result / "mesh.glb").unlink()
    load_result(result)


def set_covariance(run: dict[str, Any], change: Callable[[np.ndarray], np.ndarray]) -> None:
    frame = run["frames"][-1]
    frame["covariance"] = change(np.reshape(frame["covariance"], (6, 6))).ravel().tolist()


def later(run: dict[str, Any]) -> None:
    run["frames"][1]["timestamp"] = 7e9


def mirrored(run: dict[str, Any]) -> None:
    run["T_up_world"][0] = [-x for x in run["T_up_world"][0]]


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda run: run.update(verdict="excellent"), "verdict is 'excellent'"),
        (lambda run: run.update(verdict="failed"), "the reasons say otherwise"),
        (lambda run: run.update(version="99.0.0"), "newer version 99.0.0"),
        (lambda run: run.update(version="new"), "version is 'new'"),
        (lambda run: run.update(seed=-1), "seed is -1"),
        (lambda run: run["accuracy"].update(position_m=-0.1), "negative bound"),
        (lambda run: run["frames"][0].update(status="fine"), "status is 'fine'"),
        (lambda run: run["frames"][0].update(component=7), "components that are not listed"),
        (lambda run: run["reasons"].append({"code": "x", "text": ""}), "code is 'x'"),
        (lambda run: set_covariance(run, lambda C: -C), "covariance of frame"),
        (lambda run: set_covariance(run, lambda C: C + np.eye(6, k=1)), "covariance of frame"),
        (mirrored, r"run\.json: T_up_world"),
        (later, "other timestamps"),
    ],
)
def test_values_that_no_run_writes_are_refused_even_sealed(result, change, problem) -> None:
    edit(result, change)
    for accepted in (False, True):
        refused(problem, result, by=tofuse.load, edited=accepted)


def test_reversed_trajectory_is_refused_even_if_edits_are_accepted(result) -> None:
    lines = (result / "trajectory.txt").read_text().splitlines()
    (result / "trajectory.txt").write_text("\n".join(reversed(lines)) + "\n")
    with pytest.raises(InputError, match="other timestamps"), integrity.accepting_edits():
        load_result(result)


def test_result_of_an_earlier_version_counts_as_edited(result) -> None:
    path = result / "run.json"
    run = json.loads(path.read_text())
    del run["sha256"]
    path.write_text(json.dumps(run))
    refused(r"run\.json was changed", result, by=load_result)
    with integrity.accepting_edits(), run_json.opened(result) as found:
        assert found == run


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda path: path.write_text(""), "run.json"),
        (lambda path: edit(path.parent, lambda run: run.update(frames=[])), "lists 0 frames"),
        (lambda path: edit(path.parent, later), "other timestamps"),
    ],
)
@pytest.mark.parametrize("place", [0, 1])
def test_contradictory_result_is_not_evaluated(result, tmp_path, change, problem, place) -> None:
    reference = Path(shutil.copy(result / "trajectory.txt", tmp_path / "reference.txt"))
    sources = [result, reference] if place == 0 else [reference, result]
    assert tofuse.evaluate(*sources).error.ate_rms_m < 1e-6
    change(result / "run.json")
    refused(problem, *sources, by=tofuse.evaluate)
