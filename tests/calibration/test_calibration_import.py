"""`tofuse calibrate import`: intrinsics from files of other programs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cli_calls import refuses
from made_lens_files import OPENCV, written
from tofuse.apps.cli.program import main
from tofuse.engine.cameras.cameras import BrownConrady
from tofuse.formats.cameras.camera_file import load_camera


def test_size_that_the_file_lacks_is_that_of_the_recording(
    tmp_path: Path, room_recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As of `K` and `D` that a script of OpenCV has saved."""
    source = written(tmp_path, "c.json", json.dumps({"K": [[50, 0, 31], [0, 51, 23], [0, 0, 1]]}))
    out = tmp_path / "camera.json"
    command = ["calibrate", "import", str(source), "--out", str(out)]
    refuses(capsys, *command, says="or pass --recording")
    assert main([*command, "--recording", str(room_recording)]) == 0
    images, lens = load_camera(room_recording / "camera.json")[1], load_camera(out)[1]
    assert (lens.width, lens.height, lens.fx) == (images.width, images.height, 50)


def test_import_command(tmp_path: Path, room_recording: Path, capsys) -> None:
    source = written(tmp_path, "c.json", OPENCV.format(k=[-0.2, 0.1, 1e-3, -2e-3, 0.05]))
    out = tmp_path / "lens" / "camera.json"
    command = ["calibrate", "import", str(source), "--out", str(out)]
    assert main([*command, "--recording", str(room_recording)]) == 0
    done = capsys.readouterr()
    assert "opencv" in done.out
    assert "the lens is that of images of 64 x 48 pixels" in done.out + done.err
    about, camera = load_camera(out)
    assert camera == BrownConrady(64, 48, 50, 51, 31, 23, -0.2, 0.1, 1e-3, -2e-3, 0.05)
    assert about.depth_unit_m == 0.0001
    assert about.amplitude_kind == "range_compensated"
    refuses(capsys, *command, says="--overwrite")
    # What the file that is replaced says of the images was lost: depth of 0.1 mm became 1 mm.
    assert main([*command, "--overwrite"]) == 0
    kept = load_camera(out)[0]
    assert (kept.depth_unit_m, kept.amplitude_kind) == (0.0001, "range_compensated")
    assert (kept.frame_rate_hz, kept.sensor) == (about.frame_rate_hz, about.sensor)
    other = tmp_path / "camera.json"
    assert main(["calibrate", "import", str(source), "--out", str(other)]) == 0
    assert load_camera(other)[0].depth_unit_m == 0.001
    assert "--recording" in capsys.readouterr().out
