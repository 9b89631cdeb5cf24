"""Intrinsics from files of other programs."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tofuse.apps.calibration.lens_files import read_lens_file
from tofuse.apps.cli.program import main
from tofuse.engine.cameras.cameras import BrownConrady, Fisheye, Rational
from tofuse.engine.errors import InputError
from tofuse.formats.cameras.camera_file import load_camera

ROS = """image_width: 800
image_height: 600
camera_name: left
camera_matrix:
  rows: 3
  cols: 3
  data: [538.63, 0, 457.698, 0, 539.723, 297.003, 0, 0, 1]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {count}
  data: {values}
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""


OPENCV = """{{
 "image_size": [64, 48],
 "camera_matrix": [[50.0, 0, 31.0], [0, 51.0, 23.0], [0, 0, 1]],
 "dist_coeffs": [{k}]
}}"""


def written(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_opencv_file_storage_is_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"camera.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    K = np.array([[500.5, 0, 310.25], [0, 501.5, 230.75], [0, 0, 1]])
    k = np.array([[-0.2, 0.1, 1e-3, -2e-3, 0.05, 0.3, 0.02, 0.001]])
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", k)
    storage.release()
    found = read_lens_file(path)
    assert found.format == "opencv"
    assert found.camera == Rational(640, 480, 500.5, 501.5, 310.25, 230.75, *k[0])


@pytest.mark.parametrize(
    ("model", "values", "expected"),
    [
        ("plumb_bob", [-0.3, 0.08, 0.0028, -0.0001, 0.0], BrownConrady),
        ("rational_polynomial", [0.5, -0.1, 0, 0, 0.02, 0.7, 0.1, 0.01], Rational),
        ("equidistant", [0.05, -0.02, 0.01, -0.002], Fisheye),
    ],
)
def test_ros_camera_info_is_read(
    tmp_path: Path, model: str, values: list[float], expected: type
) -> None:
    text = ROS.format(model=model, count=len(values), values=values)
    found = read_lens_file(written(tmp_path, "left.yaml", text))
    assert found.format == "ros"
    assert found.camera == expected(800, 600, 538.63, 539.723, 457.698, 297.003, *values)
    blocks = text.replace(f"data: {values}", "data:\n" + "\n".join(f"  - {v}" for v in values))
    assert read_lens_file(written(tmp_path, "b.yaml", blocks)).camera == found.camera


def test_matrix_of_open3d_is_column_by_column(tmp_path: Path) -> None:
    matrix = [538.0, 0, 0, 0, 539.0, 0, 457.0, 297.0, 1]
    about = {"width": 800, "height": 600, "intrinsic_matrix": matrix}
    found = read_lens_file(written(tmp_path, "a.json", json.dumps(about)))
    assert found.camera == BrownConrady(800, 600, 538.0, 539.0, 457.0, 297.0)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.yaml", "nothing: here\n", "contains no known lens"),
        ("a.yaml", ROS.format(model="kannala9", count=0, values=[]), "distortion_model"),
        ("a.yaml", ROS.format(model="plumb_bob", count=1, values=[1e300]), "k1"),
        ("a.yaml", "camera_matrix: [1, 0, 1, 0, 1, 1, 0, 0, 1]\n", "image_width"),
        (
            "a.yaml",
            ROS.format(model="equidistant", count=5, values=[0, 0, 0, 0, 1]),
            "fisheye lens",
        ),
        (
            "a.yaml",
            ROS.format(model="plumb_bob", count=0, values=[]).replace("63, 0", "63, 4"),
            "skew",
        ),
        ("a.json", OPENCV.format(k=[*[0.0] * 8, 0.003, -0.001, 0.002, 0.001]), "thin prism"),
    ],
)
def test_broken_files_are_rejected(tmp_path: Path, name: str, text: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        read_lens_file(written(tmp_path, name, text))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_size_that_the_file_lacks_is_that_of_the_recording(
    tmp_path: Path, room_recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As of `K` and `D` that a script of OpenCV has saved."""
    source = written(tmp_path, "c.json", json.dumps({"K": [[50, 0, 31], [0, 51, 23], [0, 0, 1]]}))
    out = tmp_path / "camera.json"
    command = ["calibrate", "import", str(source), "--out", str(out)]
    assert main(command) == 2
    assert "or pass --recording" in capsys.readouterr().err
    assert main([*command, "--recording", str(room_recording)]) == 0
    images, lens = load_camera(room_recording / "camera.json")[1], load_camera(out)[1]
    assert (lens.width, lens.height, lens.fx) == (images.width, images.height, 50)


def test_import_command(
    tmp_path: Path, room_recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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
    assert main(command) == 2
    assert "--overwrite" in capsys.readouterr().err
    other = tmp_path / "camera.json"
    assert main(["calibrate", "import", str(source), "--out", str(other)]) == 0
    assert load_camera(other)[0].depth_unit_m == 0.001
    assert "--recording" in capsys.readouterr().out
