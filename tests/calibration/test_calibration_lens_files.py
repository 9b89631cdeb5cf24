"""Intrinsics from files of other programs."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from tofuse.calibration.lens_files import read_lens_file
from tofuse.cli import main
from tofuse.errors import InputError
from tofuse.geometry.cameras import BrownConrady, Fisheye, Pinhole, Rational, RayTable
from tofuse.recordings.camera_file import load_camera

BOUGUET = """% Intrinsic and Extrinsic Camera Parameters
%
%-- Focal length:
fc = [ 657.441441986058860 ; 657.822097611584240 ];

%-- Principal point:
cc = [ 302.955744761465380 ; 242.792195230546920 ];

%-- Skew coefficient:
alpha_c = {skew};

%-- Distortion coefficients:
kc = [ -0.256980502104812 ; 0.134603934513618 ; -0.000210742172505 ; -1.347e-05 ; 0.0 ];

%-- Focal length uncertainty:
fc_error = [ 0.350851651051606 ; 0.377067008488671 ];

%-- Image size:
nx = 640;
ny = 480;
"""

CALLAB = """# DLR-RMC camera calibration file by DLR CalLab.
version=2
origin={origin}
camera.0.R=[ -0.99 0.02 0.003; -0.02 -0.96 -0.26; -0.002 -0.26 0.96]
camera.0.T=[ 0.039 0.169 -1.073]
# u = x*(1 + k1*r2 + k2*r4 + k3*r6) + 2*p1*x*y + p2*(r2+2*x2)
camera.0.k1= 0.131565
camera.0.k2= -0.270235
camera.0.k3= 0.0
camera.0.p1= 0.001
camera.0.p2= 0.0
camera.0.A=[ 601.951 0.00000 316.271; 0.00000 602.5 236.429; 0.00000 0.00000 1.00000]
camera.0.width= 640
camera.0.height= 480
camera.0.rmsInt= 0.220958
{more}
camera.rmsInt= 0.220958
"""

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


def written(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


def test_bouguet_script_is_read(tmp_path: Path) -> None:
    found = read_lens_file(written(tmp_path, "Calib_Results.m", BOUGUET.format(skew="0.000")))
    assert found.format == "bouguet"
    assert isinstance(found.camera, BrownConrady)
    # The principal point is counted from 0: the toolbox subtracts MATLAB's 1.
    assert (found.camera.cx, found.camera.cy) == (302.95574476146538, 242.79219523054692)
    assert found.camera.fy == 657.82209761158424
    assert found.camera.k2 == 0.134603934513618
    assert found.camera.p2 == -1.347e-05


def test_bouguet_mat_is_read(tmp_path: Path) -> None:
    values = {
        "fc": np.array([[500.0], [501.0]]),
        "cc": np.array([[310.0], [230.0]]),
        "kc": np.array([[-0.2], [0.1], [0.001], [0.002], [0.0]]),
        "alpha_c": 0.0,
        "nx": 640,
        "ny": 480,
        "active_images": np.ones(3),
    }
    savemat(tmp_path / "Calib_Results.mat", values)
    camera = read_lens_file(tmp_path / "Calib_Results.mat").camera
    assert camera == BrownConrady(640, 480, 500, 501, 310, 230, -0.2, 0.1, 0.001, 0.002, 0.0)


def test_skew_becomes_ray_table(tmp_path: Path) -> None:
    path = written(tmp_path, "Calib_Results.m", BOUGUET.format(skew="0.004"))
    found = read_lens_file(path)
    assert isinstance(found.camera, RayTable)
    assert "skew" in found.warnings[0]
    # The toolbox's model, forward: x_p = fc1 (x_d + alpha y_d) + cc1.
    v, u = np.array([[40, 300], [250, 620], [470, 5]]).T
    xy = found.camera.rays()[v, u].astype(float)
    r2 = (xy * xy).sum(1)
    radial = 1 - 0.256980502104812 * r2 + 0.134603934513618 * r2 * r2
    p1, p2 = -0.000210742172505, -1.347e-05
    x, y = xy.T
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    assert 657.44144198605886 * (xd + 0.004 * yd) + 302.955744761 == pytest.approx(u, abs=1e-3)
    assert 657.82209761158424 * yd + 242.792195230547 == pytest.approx(v, abs=1e-3)


def test_callab_origin_conventions(tmp_path: Path) -> None:
    centre = written(tmp_path, "a.cal", CALLAB.format(origin="center", more=""))
    corner = written(tmp_path, "b.cal", CALLAB.format(origin="corner", more=""))
    found = read_lens_file(centre)
    assert found.format == "callab"
    expected = BrownConrady(640, 480, 601.951, 602.5, 316.271, 236.429, 0.131565, -0.270235, 0.001)
    assert found.camera == expected
    moved = read_lens_file(corner).camera
    assert isinstance(moved, Pinhole)
    assert (moved.cx, moved.cy) == pytest.approx((315.771, 235.929))


def test_callab_camera_is_selected_by_index(tmp_path: Path) -> None:
    one = CALLAB.format(origin="center", more="")
    second = "\n".join(
        line.replace("camera.0.", "camera.1.").replace("601.951", "700")
        for line in one.splitlines()
        if line.startswith("camera.0.")
    )
    path = written(tmp_path, "two.cal", CALLAB.format(origin="center", more=second))
    with pytest.raises(InputError, match="--index"):
        read_lens_file(path)
    camera = read_lens_file(path, 1).camera
    assert isinstance(camera, Pinhole)
    assert camera.fx == 700
    with pytest.raises(InputError, match="no camera 2"):
        read_lens_file(path, 2)


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


def test_opencv_thin_prism_model_is_inverted(tmp_path: Path) -> None:
    k = [-0.2, 0.1, 1e-3, -2e-3, 0.05, 0, 0, 0, 0.003, -0.001, 0.002, 0.001, 0.01, -0.02]
    data = {
        "image_size": [64, 48],
        "camera_matrix": [[50.0, 0, 31.0], [0, 51.0, 23.0], [0, 0, 1]],
        "dist_coeffs": [k],
    }
    found = read_lens_file(written(tmp_path, "c.json", json.dumps(data, indent=1)))
    assert isinstance(found.camera, RayTable)
    rays = found.camera.rays().astype(float)
    points = np.concatenate([rays, np.ones((48, 64, 1))], -1).reshape(-1, 1, 3)
    K = np.array(data["camera_matrix"])
    uv = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(k))[0].reshape(48, 64, 2)
    v, u = np.mgrid[0:48, 0:64]
    assert np.abs(uv - np.stack([u, v], -1)).max() < 1e-3


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


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.yaml", "nothing: here\n", "contains no known lens"),
        ("a.m", BOUGUET.format(skew="0").replace("nx = 640;", ""), "has no nx"),
        ("a.m", BOUGUET.format(skew="0").replace("657.44", "-657.44"), "fx"),
        ("a.cal", CALLAB.format(origin="center", more="").replace("=2", "=1"), "version 1"),
        ("a.cal", CALLAB.format(origin="middle", more=""), "use center or corner"),
        ("a.cal", CALLAB.format(origin="center", more="camera.0.s1=0.5"), "s1"),
        ("a.yaml", ROS.format(model="kannala9", count=0, values=[]), "distortion_model"),
        ("a.yaml", ROS.format(model="plumb_bob", count=1, values=[1e300]), "k1"),
        ("a.yaml", "camera_matrix: [1, 0, 1, 0, 1, 1, 0, 0, 1]\n", "image_width"),
        ("a.mat", "MATLAB 5.0", "-v7 or older"),
        ("a.m", "\x00fc = [", "known"),
    ],
)
def test_broken_files_are_rejected(tmp_path: Path, name: str, text: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        read_lens_file(written(tmp_path, name, text))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_import_command(
    tmp_path: Path, room_recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = written(tmp_path, "Calib_Results.m", BOUGUET.format(skew="0.004"))
    out = tmp_path / "lens" / "camera.json"
    command = ["calibrate", "import", str(source), "--out", str(out)]
    assert main([*command, "--recording", str(room_recording)]) == 0
    assert "bouguet" in capsys.readouterr().out
    about, camera = load_camera(out)
    assert isinstance(camera, RayTable)
    assert about.depth_unit_m == 0.0001
    assert about.amplitude_kind == "range_compensated"
    assert main(command) == 2
    assert "--overwrite" in capsys.readouterr().err
    source.write_text(BOUGUET.format(skew="0"))
    assert main([*command, "--overwrite"]) == 2
    assert "rays.npy" in capsys.readouterr().err
    other = tmp_path / "camera.json"
    assert main(["calibrate", "import", str(source), "--out", str(other)]) == 0
    assert load_camera(other)[0].depth_unit_m == 0.001
    assert "--recording" in capsys.readouterr().out
