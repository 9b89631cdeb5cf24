"""Entries of a recording that are not files: an unreadable frame, or ignored, without blocking."""

from __future__ import annotations

import json
import os
import shutil
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import tofuse
from cli_calls import refuses
from made_recordings import make_sr4000
from refused import refused
from tofuse.apps.cli.program import main
from tofuse.engine.errors import InputError
from tofuse.formats.files.stamps import stamps_in
from tofuse.formats.poses.g2o import read_g2o
from tofuse.formats.poses.pose import read_loops, read_pose
from tofuse.formats.poses.trajectory_formats import read_poses
from tofuse.formats.rigs.rig_file import read_rig
from written import change_camera

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="links and queues of other systems")


@pytest.fixture
def recording(room_recording: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(room_recording, tmp_path / "rec"))


ODD: dict[str, Callable[[Path], object]] = {
    "nothing": lambda path: path.symlink_to("/dev/null"),
    "without end": lambda path: path.symlink_to("/dev/zero"),
    "a queue": lambda path: os.mkfifo(path),
    "to nowhere": lambda path: path.symlink_to("nowhere"),
    "to itself": lambda path: path.symlink_to(path.name),
    "a folder": lambda path: path.mkdir(),
    "to a folder": lambda path: path.symlink_to("/"),
    "empty": lambda path: path.touch(),
}


@pytest.mark.parametrize("name", ODD)
def test_invalid_entry_in_place_of_frame_is_unreadable(name, recording) -> None:
    for k in (0, 3):
        path = recording / "depth" / f"{k:06}.png"
        path.unlink()
        ODD[name](path)
    found = tofuse.open(recording)
    assert len(found) == 8
    unread = [k for k, item in enumerate(found.read_all()) if isinstance(item, InputError)]
    assert unread == [0, 3]  # timestamps of the others are unchanged
    assert found.timestamps[4] == pytest.approx(tofuse.open(recording).timestamps[4])


@pytest.mark.nightly
@pytest.mark.parametrize("name", ODD)
def test_unrelated_entries_are_ignored(name, recording, tmp_path, capfd) -> None:
    for path in (recording / "lock", recording / "depth" / ".#000001.png", recording / "truth/x"):
        ODD[name](path)
    assert len(stamps_in(recording, tmp_path / "out")) > 8
    assert len(tofuse.open(recording)) == 8
    if name == "to nowhere":  # such a link once made the recording unreadable
        words = ["run", str(recording), "--out", str(tmp_path / "out"), "--end", "1"]
        assert main([*words, "--voxel", "10cm"]) == 0, capfd.readouterr().err


def test_special_file_as_recording_is_refused_at_once(tmp_path, capfd) -> None:
    os.mkfifo(tmp_path / "a.r3d")
    for name in ("a.r3d", "/dev/zero"):
        words = ("inspect", tmp_path / name, "--format", "record3d")
        refuses(capfd, *words, says="is neither a file nor a folder")


def test_links_out_of_recording_are_read(recording, tmp_path) -> None:
    """Users choose the folder; data sets on other disks are linked."""
    image = recording / "depth" / "000002.png"
    image.rename(tmp_path / "elsewhere.png")
    image.symlink_to(tmp_path / "elsewhere.png")
    assert not isinstance(list(tofuse.open(recording).read_all())[2], InputError)


@pytest.mark.parametrize("name", ["..", ".", "../x", "/etc", "a/b", "a\\b", "C:", "C:x", "a\nb"])
def test_camera_names_are_no_paths(name, tmp_path) -> None:
    camera = {"name": name, "recording": "", "T_rig_camera": np.eye(4).tolist()}
    path = tmp_path / "rig.json"
    path.write_text(json.dumps({"schema": 1, "cameras": [camera, camera | {"name": "b"}]}))
    refused("which is not a folder name", path, by=read_rig)


@pytest.mark.parametrize(
    ("field", "value"), [("frame_rate_hz", 1e-300), ("frame_rate_hz", 1e300), ("ambiguity_m", 1e-9)]
)
def test_implausible_numbers_are_refused(field, value, recording, tmp_path, capfd) -> None:
    change_camera(recording, **{field: value})
    refuses(capfd, "run", recording, "--out", tmp_path / "out", says=field)


LONG = "1e300 0 0 1"  # a quaternion whose squared norm overflows


@pytest.mark.parametrize(
    ("name", "text", "read"),
    [
        ("a.g2o", f"VERTEX_SE3:QUAT 0 0 0 0 {LONG}\n", read_g2o),
        ("a.txt", f"0 0 0 0 {LONG}\n", read_poses),
        ("loops.txt", f"0 1 0 0 0 {LONG}\n", read_loops),
        ("pose.txt", f"0 0 0 {LONG}\n", read_pose),
    ],
)
def test_non_normalised_quaternions_are_refused(name, text, read, tmp_path) -> None:
    path = tmp_path / name
    path.write_text(text)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(InputError):
            read(path)


def test_absurd_numbers_beside_images_cause_no_numpy_warnings(recording) -> None:
    """Pytest turns warnings into errors."""
    rows = "".join(f"{0.01 * k},1e308,1e308,1e308,1e308,0,0\n" for k in range(50))
    (recording / "imu.csv").write_text("t,ax,ay,az,gx,gy,gz\n" + rows)
    assert not any(isinstance(item, InputError) for item in tofuse.open(recording).read_all())
    path = recording / "groundtruth.txt"
    lines = path.read_text().splitlines()
    words = lines[-1].split()
    path.write_text("\n".join([*lines[:-1], " ".join([words[0], "1e300", *words[2:]])]) + "\n")
    refused("contains a coordinate beyond", recording)


def test_special_files_are_not_read_for_timestamps(tmp_path: Path) -> None:
    """A device is endless, and a FIFO blocks until something is written."""
    folder = tmp_path / "rec"
    make_sr4000(folder, 4)
    first, second, *_ = sorted(folder.iterdir())
    for path in (first, second):
        path.unlink()
    first.symlink_to("/dev/zero")
    os.mkfifo(second)
    recording = tofuse.open(folder, format="sr4000")
    np.testing.assert_allclose(np.diff(recording.timestamps[2:]), 0.03125)
    bad = [isinstance(item, InputError) for item in recording.read_all()]
    assert bad == [True, True, False, False]
