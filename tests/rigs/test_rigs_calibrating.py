"""From recordings to a rig: static cameras, bad input, the commands, one model of all cameras."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tofuse
from cli_calls import printed, refuses
from pose_errors import assert_near
from refused import refused
from rig_room import ROOM
from rig_scene import CAMERA, looked_at
from tofuse.apps.cli.program import main
from tofuse.apps.report.scene import CAMERA_COLORS
from tofuse.apps.rigs.calibrating import calibrate_cameras, moves
from tofuse.apps.rigs.inputs import Calibration, Camera
from tofuse.engine.errors import InputError
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.formats.poses.trajectory import read_tum
from tofuse.formats.recordings.open import Opening, open_recording
from tofuse.formats.rigs.rig_file import Rig, RigCamera, read_rig, write_rig
from tofuse.lab.simulation.rig import camera_ring, relative
from written import record

# Three cameras, neighbours 25 degrees apart.
STANDS = [
    camera_ring((0.4, 0, 0.5), 1.6, 0.5, 1, np.pi + (k - 1) * np.radians(25))[0] for k in range(3)
]


def images(k: int, count: int = 1, offset: float = 0.0) -> list[RangeFrame]:
    rng = np.random.default_rng([k, 9])
    frames = [looked_at(STANDS[k], rng, offset, ROOM) for _ in range(count)]
    return [RangeFrame(i, i / 30, CAMERA, frame.depth, "z", None) for i, frame in enumerate(frames)]


def camera(k: int, frames: list[RangeFrame]) -> Camera:
    return Camera(f"cam{k}", Recording.of(ArraySource(frames), f"cam{k}", "array"))


def written(folder: Path, count: int = 2, cameras: int = 3) -> Path:
    for k in range(cameras):
        record(folder / f"cam{k}", images(k, count), frame_rate_hz=30.0, depth_unit_m=2e-4)
    return folder


@pytest.fixture(scope="module")
def calibrated() -> Calibration:
    return calibrate_cameras([camera(k, images(k)) for k in range(3)])


def test_static_cameras_are_calibrated_from_one_instant(calibrated: Calibration) -> None:
    found = calibrated
    assert found.how == "one instant"
    assert not found.rig.unplaced
    for stated, T in zip(found.rig.cameras, relative(STANDS), strict=True):
        assert_near(stated.T_rig_camera, T, 0.01, 0.3)
    assert {(d.a, d.b) for d in found.rig.disagreement} >= {("cam0", "cam1"), ("cam1", "cam2")}


@pytest.mark.nightly
def test_camera_without_overlap_is_named() -> None:
    wall = RangeFrame(0, 0.0, CAMERA, np.full((72, 96), 1.7, np.float32), "z", None)
    cameras = [camera(0, images(0)), camera(1, images(1)), camera(2, [wall])]
    found = calibrate_cameras(cameras)
    assert [c.name for c in found.rig.cameras] == ["cam0", "cam1"]
    assert found.rig.unplaced["cam2"]


def test_static_camera_beside_moving_camera_is_refused() -> None:
    rng = np.random.default_rng(0)
    turned = [camera_ring((0.4, 0, 0.5), 1.6, 0.5, 1, np.pi + 0.12 * i)[0] for i in range(8)]
    frames = [
        RangeFrame(i, i / 30, CAMERA, looked_at(T, rng, 0.0, ROOM).depth, "z", None)
        for i, T in enumerate(turned)
    ]
    with pytest.raises(InputError, match="cam0 stood still while other cameras moved"):
        moves([camera(0, images(0, 8)), camera(1, frames)], "auto")


@pytest.mark.nightly_part
def test_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Two cameras: from three on, each could be the wrong one, which takes much longer.
    folder = written(tmp_path / "rig", cameras=2)
    cameras = [str(folder / f"cam{k}") for k in range(2)]
    out = folder / "rig.json"
    assert "cam1" in printed(capsys, "rig", "calibrate", *cameras, "--out", out)
    assert [c.name for c in read_rig(out).cameras] == ["cam0", "cam1"]
    # It is not overwritten by default.
    assert main(["rig", "calibrate", *cameras, "--out", str(out)]) == 2
    capsys.readouterr()

    checked = json.loads(printed(capsys, "rig", "check", out, *cameras, "--json").splitlines()[-1])
    assert not any(c["moved"] for c in checked["cameras"])
    # They agree with themselves, whatever happened to the cameras.
    assert checked["images_of_calibration"] == ["cam0", "cam1"]

    refuses(capsys, "rig", "check", out, *cameras[:1], says="2 cameras")

    # The folder opens like a recording, and gives one model.
    recording = open_recording(folder)
    assert recording.format == "rig"
    assert len(recording) == 4
    assert main(["run", str(folder), "--out", str(tmp_path / "model"), "--voxel", "3cm"]) == 0
    times, poses = read_tum(tmp_path / "model" / "rig_trajectory.txt")
    assert len(times) == 2
    assert np.allclose(poses, np.eye(4))
    _, of_images = read_tum(tmp_path / "model" / "trajectory.txt")
    assert np.allclose(of_images[1], read_rig(out).cameras[1].T_rig_camera, atol=1e-9)
    # Its accuracy is that of the rig, not that of one camera jumping from place to place.
    run_json = json.loads((tmp_path / "model" / "run.json").read_text())
    assert run_json["verdict"] == "good"
    assert 0.005 < run_json["accuracy"]["position_m"] < 0.03
    assert not run_json["reasons"]
    report = (tmp_path / "model" / "report.html").read_text()
    assert '<section id="rig">' in report
    assert "cam0, cam1</td>" in report
    assert ">cam1</text>" in report or ">cam1<" in report

    # Its images are found again.
    assert main(["export", str(tmp_path / "model"), "octomap"]) == 0

    # The camera of each frame is stated: in the file and in the report.
    run_json = json.loads((tmp_path / "model" / "run.json").read_text())["rig"]
    assert run_json == {"cameras": ["cam0", "cam1"], "of_frames": [0, 1, 0, 1]}
    assert tofuse.load(tmp_path / "model").recording["rig"] == run_json
    page = (tmp_path / "model" / "report.html").read_text(encoding="utf-8")
    assert re.findall(r'background:(rgb\(.*?\))"></i>(cam\d)', page) == [
        (f"rgb{color}", f"cam{k}") for k, color in enumerate(CAMERA_COLORS[:2])
    ]


@pytest.mark.nightly
def test_displaced_camera_is_found(calibrated: Calibration, tmp_path: Path, capsys) -> None:
    folder = written(tmp_path / "rig", 1)
    cameras = [str(folder / f"cam{k}") for k in range(3)]
    rig = calibrated.rig
    moved = rig.cameras[2].T_rig_camera @ se3.exp([0.03, 0, 0, 0, np.radians(1.5), 0])
    last = replace(rig.cameras[2], T_rig_camera=moved)
    write_rig(tmp_path / "knocked.json", Rig((*rig.cameras[:2], last)))
    assert main(["rig", "check", str(tmp_path / "knocked.json"), *cameras]) == 3
    output = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in output if "moved by" in line] == ["cam2"]


def test_recordings_of_rig_are_opened_again(tmp_path: Path) -> None:
    """As a result states them, with a rig.json elsewhere."""
    folder = written(tmp_path / "rig", cameras=2)
    names = ("cam0", "cam1")
    rows = [RigCamera(name, "", np.eye(4), np.zeros((6, 6))) for name in names]
    write_rig(tmp_path / "rig.json", Rig(tuple(rows)))
    opening = Opening(tuple(folder / name for name in names), tmp_path / "rig.json")
    again = Opening.from_dict(opening.to_dict(), "run.json")
    assert again == opening
    assert again.open().metadata["cameras"] == list(names)
    with pytest.raises(InputError, match=r"has 2 cameras .* 1 recordings are given"):
        replace(opening, paths=opening.paths[:1]).open()
    write_rig(tmp_path / "rig.json", Rig(tuple(rows), unplaced={"top": "too dark"}))
    with pytest.raises(InputError, match="and none of top, whose pose was not found"):
        replace(opening, paths=(*opening.paths, folder / "top")).open()


def test_rig_is_not_taken_for_one_camera(tmp_path: Path, capsys) -> None:
    folder = written(tmp_path / "rig", cameras=2)
    rows = [RigCamera(f"cam{k}", "", np.eye(4), np.zeros((6, 6))) for k in range(2)]
    write_rig(folder / "rig.json", Rig(tuple(rows)))
    recording = open_recording(folder)
    poses = np.tile(np.eye(4), (len(recording), 1, 1))
    for use in (tofuse.inspect, tofuse.reconstruct, lambda r: tofuse.judge(r, poses)):
        refused("is a rig of several cameras", recording, by=use)
    for words in (["inspect"], ["noise"], ["calibrate", "depth"]):
        refuses(capsys, *words, folder, says="is a rig of several cameras")


def test_options_reach_the_recordings_or_are_refused(tmp_path: Path, capsys) -> None:
    """A factor had no effect."""
    folder = written(tmp_path / "rig", 1)
    cameras = [str(folder / f"cam{k}") for k in range(3)]
    rows = [RigCamera(f"cam{k}", "", T, 1e-8 * np.eye(6)) for k, T in enumerate(relative(STANDS))]
    rig = str(tmp_path / "rig.json")
    write_rig(Path(rig), Rig(tuple(rows)))
    run, out = ["run", "--rig", rig, *cameras], ["--out", str(tmp_path / "out")]
    for words, says in (
        ([*run, *out, "--factor", "2"], "--factor: can't be used with a rig"),
        ([*run, *out, "--prior", "none"], "--prior: can't be used with a rig"),
        ([*run, *out, "--topic", "/depth"], "--topic: does not apply to the format 'native'"),
        (["rig", "calibrate", *cameras, *out, "--topic", "/depth"], "--topic: does not apply to"),
        (["rig", "check", rig, *cameras, "--topic", "/depth"], "--topic: does not apply to"),
    ):
        refuses(capsys, *words, says=says)
    assert not (tmp_path / "out").exists()


@pytest.mark.nightly
def test_rig_that_contradicts_images_is_reported(tmp_path: Path) -> None:
    folder = written(tmp_path / "rig", 1)
    cameras = [str(folder / f"cam{k}") for k in range(3)]
    knocked = relative(STANDS)
    knocked[1] = knocked[1] @ se3.exp([0.1, 0, 0, 0, 0, 0])
    rows = [RigCamera(f"cam{k}", "", T, 1e-8 * np.eye(6)) for k, T in enumerate(knocked)]
    write_rig(tmp_path / "rig.json", Rig(tuple(rows)))
    out = tmp_path / "model"
    main(["run", "--rig", str(tmp_path / "rig.json"), *cameras, "--out", str(out)])
    reasons = json.loads((out / "run.json").read_text())["reasons"]
    (text,) = (r["text"] for r in reasons if r["code"] == "rig_changed")
    assert "cam1 by" in text
    assert "cam2" not in text
