"""The output folder: all files of a result or none, and no foreign files."""

from __future__ import annotations

import errno
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from made_results import contents, result, torn
from refused import refused
from tofuse.apps.export.exporting import export
from tofuse.apps.jobs.running import exit_status
from tofuse.apps.results import output
from tofuse.apps.results.folders import OutputFolder, check_result, component_number, is_result
from tofuse.apps.results.loading import load_result
from tofuse.apps.results.output import write_result
from tofuse.apps.results.run_json import frames_in_main_model, read_run_json
from tofuse.engine.errors import OutputError
from tofuse.engine.results.types import FrameRecord
from tofuse.formats.files.staging import beside
from tofuse.formats.geometry.pcd import read_pcd
from wavy_surface import waves

FILES = {"trajectory.txt", "pose_graph.g2o", "cloud.ply", "run.json"}


def test_new_folder_and_its_parents_are_made(tmp_path) -> None:
    out = tmp_path / "a" / "b"
    write_result(result(), OutputFolder(out), lambda r, f: (f / "report.html").write_text("x"))
    assert set(contents(out)) == FILES | {"report.html"}
    assert [p.name for p in out.iterdir() if p.is_dir()] == []
    assert is_result(out)


def test_earlier_result_is_replaced_only_on_request(tmp_path) -> None:
    write_result(result(), OutputFolder(tmp_path))
    before = contents(tmp_path)
    with pytest.raises(OutputError, match="contains an earlier result; pass overwrite"):
        OutputFolder(tmp_path)
    assert contents(tmp_path) == before
    write_result(result(seed=5), OutputFolder(tmp_path, overwrite=True))
    assert read_run_json(tmp_path / "run.json")["seed"] == 5


def test_large_model_is_compressed_and_has_an_overview(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(output, "MAX_PLY_POINTS", 20_000)
    monkeypatch.setattr("tofuse.engine.fusion.mesh.OVERVIEW_FACES", 20_000)
    mesh = waves()
    whole = replace(result(), mesh=mesh, cloud=mesh.cloud())
    write_result(whole, OutputFolder(tmp_path / "out"))
    assert set(contents(tmp_path / "out")) == FILES - {"cloud.ply"} | {
        "cloud.laz", "mesh.ply", "mesh.glb",
    }  # fmt: skip
    found = load_result(tmp_path / "out")
    np.testing.assert_allclose(found.cloud.points, mesh.vertices, atol=0.51e-4)
    for name in ("normals", "color", "views", "sigma"):
        np.testing.assert_array_equal(getattr(found.cloud, name), getattr(whole.cloud, name))
    assert found.mesh is not None
    np.testing.assert_array_equal(found.mesh.vertices, mesh.vertices)
    np.testing.assert_array_equal(found.mesh.faces, mesh.faces)
    assert 300_000 < (tmp_path / "out/mesh.glb").stat().st_size <= 640_000
    export(tmp_path / "out", ["pcd"])
    assert len(read_pcd(tmp_path / "out/cloud.pcd").cloud) == len(mesh.vertices)
    # A small result replaces all of it.
    write_result(result(), OutputFolder(tmp_path / "out", overwrite=True))
    assert {p.name for p in (tmp_path / "out").iterdir()} == FILES


@pytest.mark.parametrize("name", ["photo.jpg", "run.json", "trajectory.txt", ".hidden"])
@pytest.mark.parametrize("overwrite", [False, True])
def test_foreign_folder_is_unchanged(tmp_path, name, overwrite) -> None:
    (tmp_path / name).write_text('{"a": 1}')
    with pytest.raises(OutputError, match=f"contains {name}, but no earlier result"):
        OutputFolder(tmp_path, overwrite=overwrite)
    assert contents(tmp_path) == {name: b'{"a": 1}'}


def test_file_as_folder_or_parent_is_refused(tmp_path) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    refused("is a file; choose a folder", file, by=OutputFolder, error=OutputError)
    refused("can't be written", file / "below", by=OutputFolder, error=OutputError)
    assert file.read_text() == "mine"


def test_files_of_killed_run_are_ignored(tmp_path) -> None:
    out = tmp_path / "out"
    beside(out, "new").mkdir()
    (beside(out, "new") / "trajectory.txt").write_text("half")
    write_result(result(), OutputFolder(out))
    assert set(contents(out)) == FILES
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "No space left"), KeyboardInterrupt()])
def test_failure_while_writing_changes_nothing(tmp_path, overwrite, failure) -> None:
    out = tmp_path / "out"
    if overwrite:
        write_result(result(), OutputFolder(out))
    before = contents(tmp_path)

    def report(_result, folder) -> None:
        (folder / "report.html").write_text("half")
        raise failure

    expected = OutputError if isinstance(failure, OSError) else KeyboardInterrupt
    with pytest.raises(expected) as caught:
        write_result(result(seed=1), OutputFolder(out, overwrite=overwrite), report)
    if expected is OutputError:
        assert "no space left" in str(caught.value)
        assert str(out) in str(caught.value)
    assert contents(tmp_path) == before
    assert out.exists() == overwrite


def test_failure_while_moving_is_rolled_back_and_keeps_new_result(tmp_path, monkeypatch) -> None:
    out, new = tmp_path / "out", tmp_path / ".tofuse-new-out"
    write_result(torn(), OutputFolder(out))
    (out / "recording").mkdir()
    (out / "recording" / "depth.png").write_text("recorded")
    before = contents(out)
    folder, move = OutputFolder(out, overwrite=True), os.replace

    def fail(source, target) -> None:
        if Path(source) == new:
            raise OSError(errno.EACCES, "Permission denied")
        move(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", fail)
        words = r"can.t be written .permission denied.*; move the new result, .* from .*tofuse-new-"
        refused(words, torn(seed=1), folder, by=write_result, error=OutputError)
    assert contents(out) == before
    assert set(contents(new)) == BOTH
    assert read_run_json(new / "run.json")["seed"] == 1
    OutputFolder(out, overwrite=True).discard()
    assert contents(tmp_path).keys() == {f"out/{name}" for name in before}


def test_run_json_matches_contract(tmp_path) -> None:
    write_result(result(), OutputFolder(tmp_path))
    text = (tmp_path / "run.json").read_text()
    data = json.loads(text, parse_constant=lambda c: pytest.fail(c))
    assert text == json.dumps(data, indent=1) + "\n"
    assert data["shift_m"] == [0.0, 0.0, 0.0]
    assert " ".join(data) == (
        "schema version input warnings findings seed threads config seconds cpu_seconds verdict "
        "accuracy self_calibration reasons frames T_up_world shift_m rig components sessions "
        "session_pairs changes loops optimiser certificate priors refinement filters sha256"
    )
    assert data["schema"] == 1
    assert data["input"] == {"path": "/somewhere", "format": "native", "frames": 2, "opening": None}
    reason = {"code": "lost_frames", "frames": [1, 1], "ranges": [[1, 1]]}
    assert data["reasons"] == [reason | {"text": "Frame 1 has no pose.", "remedy": ""}]
    assert data["components"] == []
    assert [frame["component"] for frame in data["frames"]] == [None, None]
    assert data["frames"][0]["covariance"] == np.eye(6).ravel().tolist()
    assert data["frames"][0]["unobservable"] == [[1.0] * 6] * 2
    assert data["frames"][0]["rms_m"] == 0.25
    lost = data["frames"][1]
    assert (lost["inlier_share"], lost["rms_m"], lost["covariance"]) == (None, None, None)
    assert lost["unobservable"] == []
    assert data["filters"] == {"median": {"removed": 0.25}}


BOTH = FILES | {f"component-2/{name}" for name in FILES}


def test_components_are_in_run_json(tmp_path) -> None:
    write_result(torn(), OutputFolder(tmp_path))
    data = read_run_json(tmp_path / "run.json")
    assert [c["frames"] for c in data["components"]] == [[[0, 0]], [[1, 1]], [[2, 2]]]
    assert [c["joined"] for c in data["components"]] == [None, "links", None]
    assert data["components"][0]["T_main_component"] == np.eye(4).tolist()
    assert data["components"][1]["T_main_component"][0] == [1, 0, 0, 0.5]
    assert data["components"][2]["T_main_component"] is None
    assert all(
        set(c) == {"frames", "T_main_component", "joined", "reached"} for c in data["components"]
    )
    assert [frame["component"] for frame in data["frames"]] == [0, 1, 2, None]
    assert [frame["index"] for frame in frames_in_main_model(data)] == [0, 1]


def test_exit_status_counts_frames_outside_main_model() -> None:
    r = torn()
    d = r.diagnostics
    assert exit_status(r) == 3
    for kept, status in ((d.frames[:2], 0), (d.frames[:3], 3), ((d.frames[0], d.frames[3]), 3)):
        assert exit_status(replace(r, diagnostics=replace(d, frames=kept))) == status
    skipped = (*d.frames[:2], FrameRecord(4, 0.4, "skipped"))
    assert exit_status(replace(r, diagnostics=replace(d, frames=skipped))) == 0


def test_component_with_its_own_model_has_a_folder(tmp_path) -> None:
    seen = []

    def report(r, folder) -> None:
        seen.append((len(r.trajectory), component_number(folder)))
        (folder / "report.html").write_text("x")

    write_result(torn(), OutputFolder(tmp_path), report)
    assert seen == [(2, 2), (4, None)]
    made = BOTH | {"report.html", "component-2/report.html"}
    assert set(contents(tmp_path)) == made
    assert is_result(tmp_path / "component-2")
    assert (tmp_path / "component-2/run.json").read_text().count("component-2") == 0
    # Only for separate components with a model.
    write_result(torn(parts=1), OutputFolder(tmp_path, overwrite=True))
    assert set(contents(tmp_path)) == FILES
    assert {p.name for p in tmp_path.iterdir()} == FILES


def test_all_files_of_earlier_result_are_replaced(tmp_path) -> None:
    write_result(torn(seed=1), OutputFolder(tmp_path))
    (tmp_path / "component-7").mkdir()
    for name in ("component-7/cloud.pcd", "mesh.stl", ".DS_Store", ".tofuse-tracked.npz"):
        (tmp_path / name).write_text("exported")
    for name in ("nerfstudio/transforms.json", "nerfstudio/images/a.png", "colmap/sparse/0/a.txt"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text("exported")
    write_result(torn(seed=2), OutputFolder(tmp_path, overwrite=True))
    assert set(contents(tmp_path)) == BOTH
    assert read_run_json(tmp_path / "component-2/run.json")["seed"] == 2


@pytest.mark.parametrize(
    "name",
    ["notes.txt", "more/notes.txt", "component-2/notes.txt", "component-2/mesh.glb/notes.txt",
     "component-x/cloud.ply", "component-2/recording/a.png", "nerfstudio/outputs/a.txt"],
)  # fmt: skip
@pytest.mark.parametrize("when", ["before", "meanwhile"])
def test_folder_with_foreign_files_is_kept(tmp_path, name, when) -> None:
    out = tmp_path / "out"
    write_result(torn(), OutputFolder(out))
    folder = OutputFolder(out, overwrite=True)
    (out / name).parent.mkdir(parents=True, exist_ok=True)
    (out / name).write_text("mine")
    before = contents(out)
    if when == "before":
        folder.discard()
    says = rf"out/{name}: is not a file of an earlier result; move"
    with pytest.raises(OutputError, match=says):
        write_result(torn(1), OutputFolder(out, overwrite=True) if when == "before" else folder)
    assert contents(out) == before


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not JSON"),
        ("[]", "is not a run.json of schema 1"),
        ('{"schema": 2}', "is not a run.json of schema 1"),
        ("\xff", "is not text"),
    ],
)
def test_invalid_run_json(tmp_path, text, message) -> None:
    file = tmp_path / "run.json"
    file.write_text(text, encoding="latin-1")
    refused(message, file, by=read_run_json)
    assert not is_result(tmp_path)
    refused(r"run\.json: is damaged, or not a run\.json of tofuse", tmp_path, by=check_result)
    refused("doesn't exist", tmp_path / "none.json", by=read_run_json)
    refused("is a folder", tmp_path, by=read_run_json)
