"""`tofuse compare` and `tofuse repeat` with files: output, exit status, errors."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

from cli_calls import call, listing, refuses
from measured_parts import drawn, scan
from tofuse.apps.compare.nearest import Reference
from tofuse.apps.compare.page import colors
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.engine.geometry import se3
from tofuse.formats.geometry.ply import read_ply, write_ply
from tofuse.formats.poses.pose import pose_text


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    """A part in mm, a scan of it and one with a bump, and a guess."""
    folder = tmp_path_factory.mktemp("parts")
    nominal = drawn()
    write_ply(folder / "part.ply", GeometryRecord(1000 * nominal.points, nominal.faces))
    reference = Reference.of(nominal)
    for name, bump in (("good", 0.0), ("bad", 0.006)):
        surface = scan(reference, 1, 8000, bump=bump)
        write_ply(
            folder / f"{name}.ply",
            GeometryRecord(
                surface.points,
                normals=surface.normals.astype(np.float32),
                scalars={"sigma": np.full(len(surface.points), 0.0003, np.float32)},
            ),
        )
    (folder / "guess.txt").write_text(pose_text(se3.exp([0.001, 0, 0, 0, 0.002, 0])))
    return folder


def test_all_files_are_written(files, tmp_path, capfd) -> None:
    out = tmp_path / "out"
    words = ("compare", files / "bad.ply", files / "part.ply", "--tolerance", "2mm")
    options = ("--guess", files / "guess.txt", "--accuracy", "0.2mm", "--out", out)
    assert call(*words, *options) == 3
    text = capfd.readouterr().out
    assert text.startswith("fail: ")
    assert "is taken to be in mm" in text
    assert listing(out) == ["compare.json", "deviations.csv", "deviations.ply", "report.html"]
    data = json.loads((out / "compare.json").read_text())
    assert data["verdict"] == "fail"
    assert data["reference"]["unit"] == "mm"
    assert len(data["regions"]) == 18
    model = read_ply(out / "deviations.ply")
    assert {"deviation", "sigma"} <= set(model.scalars)
    assert 0.004 < np.abs(model.scalars["deviation"]).max() < 0.008
    rows = list(csv.DictReader((out / "deviations.csv").read_text().splitlines()))
    assert max(abs(float(row["deviation_m"])) for row in rows) > 0.004
    page = (out / "report.html").read_text()
    assert "deviation, mm" in page
    assert re.search(r"<li>[^<]*part\.ply is taken to be in mm: [^<]*\.</li>", page)
    assert "<strong>Fail</strong>" in page
    # A comparison may be replaced, other files may not.
    refuses(capfd, *words, "--out", out, says=("--overwrite",))
    (out / "mine.txt").touch()
    refuses(capfd, *words, "--out", out, "--overwrite", says=("mine.txt",))


def test_exit_status_states_the_verdict(files, capfd) -> None:
    words = ("compare", files / "good.ply", files / "part.ply", "--guess", files / "guess.txt")
    assert call(*words, "--tolerance", "2mm", "--unit", "mm", "--json") == 0
    assert json.loads(capfd.readouterr().out)["verdict"] == "pass"
    assert call(*words, "--tolerance", "2mm", "--accuracy", "8mm") == 4
    assert "undecided: " in capfd.readouterr().out
    assert call(*words) == 0
    assert "No place differs" in capfd.readouterr().out


def test_unusable_files_are_named(files, tmp_path, capfd) -> None:
    part, good = files / "part.ply", files / "good.ply"
    refuses(capfd, "compare", good, tmp_path / "none.stl", says=("none.stl", "exist"))
    write_ply(tmp_path / "few.ply", GeometryRecord(np.zeros((20, 3), np.float32)))
    refuses(capfd, "compare", good, tmp_path / "few.ply", says=("few.ply", "no triangles"))
    line = np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]], np.float32)
    write_ply(tmp_path / "flat.ply", GeometryRecord(line, np.array([[0, 1, 2]], np.int32)))
    refuses(capfd, "compare", good, tmp_path / "flat.ply", says=("flat.ply", "without area"))
    write_ply(tmp_path / "same.ply", GeometryRecord(np.ones((90, 3), np.float32)))
    refuses(capfd, "compare", good, tmp_path / "same.ply", says=("same.ply", "one place"))
    (tmp_path / "result").mkdir()
    (tmp_path / "result" / "run.json").write_text('{"schema": 1, "verd')
    for command in ("compare", "register", "evaluate"):
        words = (command, tmp_path / "result", good)
        refuses(capfd, *words, says=("result/run.json", "damaged", "copy the whole folder"))
    refuses(capfd, "compare", good, part, "--overwrite", says=("requires --out",))
    refuses(capfd, "repeat", tmp_path, says=("two or more",))
    refuses(capfd, "repeat", tmp_path, tmp_path, says=(str(tmp_path),))


def test_colors_diverge() -> None:
    inside, none, outside, unseen = colors(np.array([-1.0, 0.0, 1.0, np.nan]), 0.5).astype(int)
    assert inside[2] > inside[0]
    assert outside[0] > outside[2]
    assert np.ptp(none) == 0
    assert none[0] > unseen[0]
