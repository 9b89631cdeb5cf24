"""Folders of cwipc open as rigs, with the poses of the depth cameras; others are rejected."""

from __future__ import annotations

import copy
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import ros_bags
from camera_files import read_through
from damaged_files import damage
from made_cwipc import (
    SERIALS,
    T_WORLD_DEPTH,
    TRAFOS,
    config,
    expected_pose,
    make_cwipc,
    off_planes,
)
from tofuse.cli import main
from tofuse.errors import InputError
from tofuse.geometry.se3 import inverse, transform
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.open import open_recording
from tofuse.recordings.rig_folder import rig_file_in
from tofuse.recordings.rig_source import RigSource


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    make_cwipc(tmp_path / "scan")
    return tmp_path / "scan"


def rewrite(folder: Path, data: dict) -> None:
    (folder / "cameraconfig.json").write_text(json.dumps(data))


def test_kinects_measure_same_planes(folder: Path) -> None:
    """The trafo is of the colour camera, the images are of the depth camera."""
    recording = open_recording(folder)
    assert recording.format == "rig"
    assert len(recording) == 4
    source = recording.source
    assert isinstance(source, RigSource)
    assert [c.name for c in source.rig.cameras] == list(SERIALS)
    np.testing.assert_allclose(source.rig.cameras[1].T_rig_camera, expected_pose(), atol=1e-9)
    for frame, T in zip(recording, source.T_rig_camera, strict=True):
        assert isinstance(frame, RangeFrame)
        points = transform(T_WORLD_DEPTH[0] @ T, frame.points)
        assert off_planes(points).max() < 0.002
    assert any("no covariances" in line for line in recording.warnings)


@pytest.mark.parametrize("version", [3, 4])
def test_earlier_versions_and_file_names(folder: Path, version: int) -> None:
    """File names as in the published test recording; a disabled camera is left out."""
    data = config(version)
    for k, name in enumerate(("output_master.mkv", "output_sub_1.mkv")):
        data["camera"][k]["playback_filename" if version == 3 else "filename"] = name
        (folder / f"{SERIALS[k]}.mkv").rename(folder / name)
    data["camera"].append(data["camera"][0] | {"disabled": True, "serial": "1", "filename": "no"})
    rewrite(folder, data)
    source = open_recording(folder).source
    assert isinstance(source, RigSource)
    np.testing.assert_allclose(source.rig.cameras[1].T_rig_camera, expected_pose(), atol=1e-9)


@pytest.fixture(scope="module")
def realsense_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bag")
    return ros_bags.real_sense(folder, "ros1", "None", name="Intel RealSense D455", color="rgb8")


@pytest.mark.parametrize("mapping", [None, 1, 0, -1])
def test_realsense_pose_depends_on_mapping(
    realsense_bag: Path, tmp_path: Path, mapping: int | None
) -> None:
    """Without a mapping of depth to colour, the trafo is of the depth camera."""
    for serial in SERIALS:
        shutil.copy(realsense_bag, tmp_path / f"{serial}.bag")
    filtering = {} if mapping is None else {"filtering": {"map_color_to_depth": mapping}}
    data = config(type="realsense_playback", **filtering)
    for row in data["camera"]:
        row["type"] = "realsense_playback"
    rewrite(tmp_path, data)
    source = open_recording(tmp_path).source
    assert isinstance(source, RigSource)
    T = ros_bags.T_COLOR @ inverse(ros_bags.T_DEPTH) if mapping == 0 else np.eye(4)
    expected = inverse(TRAFOS[0] @ T) @ TRAFOS[1] @ T
    np.testing.assert_allclose(source.rig.cameras[1].T_rig_camera, expected, atol=1e-6)


def test_orbbec_pose_is_that_of_colour_camera(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    R = ros_bags.T_COLOR[:3, :3]
    for serial in SERIALS:
        (tmp_path / serial).mkdir()
        path = ros_bags.orbbec(tmp_path / serial, (0.0,) * 8, color="rgb8", R=R)
        shutil.copy(path, tmp_path / f"{serial}.bag")
    data = config(type="orbbec_playback")
    for row in data["camera"]:
        row["type"] = "orbbec_playback"
    rewrite(tmp_path, data)
    source = open_recording(tmp_path).source
    assert isinstance(source, RigSource)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, ros_bags.T_COLOR[:3, 3]
    expected = inverse(TRAFOS[0] @ T) @ TRAFOS[1] @ T
    np.testing.assert_allclose(source.rig.cameras[1].T_rig_camera, expected, atol=1e-6)


def changed(row: int, **fields: object) -> dict:
    data = copy.deepcopy(config())
    for name, value in fields.items():
        data["camera"][row][name] = value
        if value is None:
            del data["camera"][row][name]
    return data


NAN = TRAFOS[1].copy()
NAN[0, 0] = np.nan
SCALED = TRAFOS[1].copy()
SCALED[:3, :3] *= 2


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (config(6), "version is 6, not 3, 4, 5"),
        (config(True), "version is True"),
        (config(camera=[]), "no enabled camera"),
        (config(camera=[5]), r"camera\[0\] is not an object"),
        (changed(1, trafo=None), r"camera\[1\]: trafo: is missing"),
        (changed(1, trafo=NAN.tolist()), r"camera\[1\]: trafo: is not 4 x 4 finite"),
        (changed(1, trafo=[[1, 2], [3]]), r"camera\[1\]: trafo: is not 4 x 4 finite"),
        (changed(1, trafo=SCALED.tolist()), r"camera\[1\]\.trafo"),
        (changed(1, trafo=TRAFOS[0].tolist()), "have the same trafo: they aren't registered"),
        (changed(1, serial=SERIALS[0]), "two cameras called"),
        (changed(1, serial="../x"), r"camera\[1\]\.serial is '../x'"),
        (changed(1, serial=7), r"camera\[1\]\.serial is 7"),
        (changed(1, filename="/etc/passwd"), r"camera\[1\]\.filename is '/etc/passwd'"),
        (changed(1, filename="a/b.mkv"), r"camera\[1\]\.filename is 'a/b.mkv'"),
        (changed(1, serial="other"), "no recording of the camera 'other'"),
        (changed(1, type="synthetic"), r"camera\[1\]\.type is synthetic"),
    ],
)
def test_invalid_files_are_refused(folder: Path, data: dict, message: str) -> None:
    rewrite(folder, data)
    with pytest.raises(InputError, match=message) as error:
        open_recording(folder)
    assert len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"camera": 5, "type": ""}', "\x00"])
def test_files_of_other_programs_are_no_rig(folder: Path, text: str) -> None:
    """The folder then contains two recordings, and the user has to choose one."""
    (folder / "cameraconfig.json").write_text(text)
    assert rig_file_in(folder) is None
    with pytest.raises(InputError):
        open_recording(folder)


def test_missing_pose_of_colour_camera_is_refused(folder: Path) -> None:
    from made_kinect import calibration, make_mkv, small_counts

    lens = calibration()
    del lens["CalibrationInformation"]["Cameras"][1]
    make_mkv(folder / f"{SERIALS[1]}.mkv", small_counts(2), lens=lens)
    with pytest.raises(InputError, match="pose of its colour camera relative to depth"):
        open_recording(folder)


def test_links(folder: Path, tmp_path: Path) -> None:
    """A linked recording is read; broken and circular links are missing recordings."""
    path = folder / f"{SERIALS[1]}.mkv"
    path.rename(tmp_path / "elsewhere.mkv")
    path.symlink_to(tmp_path / "elsewhere.mkv")
    assert len(open_recording(folder)) == 4
    for target in ("nowhere.mkv", path.name):
        path.unlink()
        path.symlink_to(target)
        with pytest.raises(InputError):
            open_recording(folder)


def test_damaged_folders_raise_only_package_errors(folder: Path, tmp_path: Path) -> None:
    totals = np.zeros(3, int)
    for k in range(40):
        rng = np.random.default_rng([72, k])
        damaged = tmp_path / "copy"
        shutil.copytree(folder, damaged)
        damage(sorted(p for p in damaged.rglob("*") if p.is_file()), rng)
        totals += read_through(damaged, None)
        shutil.rmtree(damaged)
    whole, unread, refused = totals
    assert whole > 0
    assert unread + refused > 0


@pytest.mark.slow
def test_rig_is_reconstructed_by_one_command(
    folder: Path, tmp_path: Path, capfd, monkeypatch
) -> None:
    out = tmp_path / "model"
    assert main(["run", str(folder), "--out", str(out), "--no-report"]) == 0, capfd.readouterr().err
    written = json.loads((out / "run.json").read_text())
    assert written["rig"]["cameras"] == list(SERIALS)
    assert [f["status"] for f in written["frames"]] == ["tracked"] * 4
