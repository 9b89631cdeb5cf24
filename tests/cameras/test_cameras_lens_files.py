"""Lenses in calibration files of other programs."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from made_lens_files import OPENCV, written
from tofuse.engine.cameras.cameras import BrownConrady, Fisheye, Rational
from tofuse.engine.errors import InputError
from tofuse.formats.cameras import lenses
from tofuse.formats.cameras.camera_file import load_camera, read_lens_file

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
    assert found.program == "opencv"
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
    assert found.program == "ros"
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


K = [[365.5, 0, 257.0], [0, 366.5, 209.5], [0, 0, 1]]
FLAT = [value for row in K for value in row]
COEFFICIENTS = [0.1, -0.2, 0, 0.001, 0.05]
SIZE = "width: 512\nheight: 424\n"
LAYOUTS = {
    "ros2 topic echo --once.yaml": f"{SIZE}distortion_model: plumb_bob\nd:\n- 0.1\n- -0.2\n- 0.0\n"
    "- 0.001\n- 0.05\nk:\n" + "".join(f"- {value}\n" for value in FLAT) + "r: [1, 0, 0]\n---\n",
    "ros1 topic.yaml": f"{SIZE}distortion_model: plumb_bob\nD: {COEFFICIENTS}\nK: {FLAT}\n",
    "kalibr.yaml": f"cam0:\n  camera_model: pinhole\n  distortion_coeffs: {COEFFICIENTS}\n"
    "  distortion_model: radtan\n  intrinsics: [365.5, 366.5, 257.0, 209.5]\n"
    "  resolution: [512, 424]\n",
    "orb-slam.yaml": "%YAML:1.0\nCamera.fx: 365.5\nCamera.fy: 366.5\nCamera.cx: 257.0\n"
    "Camera.cy: 209.5\nCamera.k1: 0.1\nCamera.k2: -0.2\nCamera.p1: 0\nCamera.p2: 0.001\n"
    "Camera.k3: 0.05\nCamera.width: 512\nCamera.height: 424\nDepthMapFactor: 5000.0\n",
    "plain.json": json.dumps(
        {"width": 512, "height": 424, "fx": 365.5, "fy": 366.5, "cx": 257.0, "cy": 209.5}
        | {"distortion": [0.1, -0.2, 0, 0.001, 0.05]}
    ),
    "transforms.json": json.dumps(
        {"w": 512, "h": 424, "fl_x": 365.5, "fl_y": 366.5, "cx": 257.5, "cy": 210.0}  # of corners
        | {"k1": 0.1, "k2": -0.2, "p1": 0, "p2": 0.001, "k3": 0.05}
    ),
    "matrix.txt": "365.5 0 257\n0 366.5 209.5\n0 0 1\ndistortion: [0.1, -0.2, 0, 0.001, 0.05]\n"
    + SIZE,
    "four.txt": "365.5 366.5 257 209.5\nk1 = 0.1\nk2 = -0.2\np2 = 0.001\nk3 = 0.05\n" + SIZE,
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts_of_other_programs(tmp_path: Path, name: str) -> None:
    found = read_lens_file(written(tmp_path, name, LAYOUTS[name]))
    expected = BrownConrady(512, 424, 365.5, 366.5, 257.0, 209.5, 0.1, -0.2, 0.0, 0.001, 0.05)
    assert found.camera == expected
    assert found.depth_unit_m == (0.0002 if name == "orb-slam.yaml" else 0.001)
    # As the user would pass it.
    assert load_camera(tmp_path / name)[1] == expected


def test_damaged_camera_json_is_called_that(tmp_path: Path) -> None:
    path = written(tmp_path, "mine.json", '{"schema": 1, "model": "pinhole", "fx": 1')
    with pytest.raises(InputError, match="JSON"):
        load_camera(path)
    with pytest.raises(InputError, match="no schema, and is no camera"):
        load_camera(written(tmp_path, "b.json", '{"model": "pinhole", "fx": 1}'))


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_distortion_in_one_dimension_is_read(tmp_path: Path, suffix: str) -> None:
    """OpenCV writes an array (5,) unlike one of (1, 5), and wraps long lines."""
    path = tmp_path / f"camera.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.array(K))
    storage.write("distortion_coefficients", np.array([0.0931, -0.27, 0.0, 0.001, 0.0971]))
    storage.write("image_width", 512)
    storage.write("image_height", 424)
    storage.release()
    expected = BrownConrady(512, 424, 365.5, 366.5, 257.0, 209.5, 0.0931, -0.27, 0.0, 0.001, 0.0971)
    assert read_lens_file(path).camera == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{SIZE}K: {FLAT}\nD: {{a: 0.1}}\n", "D: is not understood"),
        (
            f"{SIZE}K: {FLAT}\nlens_distortion_of_mine: [0.1]\n",
            "a distortion that is not understood",
        ),
        ("cam0:\n  intrinsics: [1, 1, 0, 0]\ncam1:\n  intrinsics: [2, 2, 0, 0]\n", "has 2 cameras"),
        ("1 2 3\n4 5 6\n", "contains no known lens"),
        (f"{SIZE}K: {FLAT}\ndepth_kind: far\n", "depth_kind: is 'far'"),
        (f"{SIZE}K: {FLAT}\ndepth_unit_m: 7\n", "depth_unit_m: is 7"),
    ],
)
def test_a_lens_is_never_guessed(tmp_path: Path, text: str, message: str) -> None:
    """Coefficients that are overlooked would bend the model."""
    with pytest.raises(InputError) as caught:
        read_lens_file(written(tmp_path, "a.yaml", text))
    assert message in str(caught.value)


def test_inverse_lens_that_folds_in_view_has_no_forward_lens() -> None:
    lens = BrownConrady(640, 480, 400.0, 400.0, 320.0, 240.0, k1=-0.5)
    table = lenses.inverse_brown(lens)
    assert np.isnan(table.rays()).any()
    with pytest.raises(InputError, match="too much distortion"):
        lenses.forward_brown(table, lens)
