"""Frames, clips and clouds located in a result: right where the map has the place, else refused."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tofuse
from cli_calls import call, listing, printed, refuses
from made_rooms import OTHER, at, seen
from made_sessions import HERE, recorded
from refused import refused
from tofuse.apps.jobs import locating
from tofuse.apps.pairs import pair_words
from tofuse.engine.frames.frames import CloudFrame
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.engine.geometry import se3
from tofuse.engine.mapping import clips
from tofuse.engine.progress import Silent
from tofuse.formats.geometry.ply import write_ply
from tofuse.formats.poses.trajectory import read_tum
from written_run_json import read_from

# A second pass, beside and above the first one.
AGAIN = [at(0.1 + 0.02 * k, 0.1, 0.05 + 0.1 * k, 0.25, -0.05) for k in range(6)]
T_WORLD_ROOM = se3.inverse(HERE[0])
# The same walls with other furniture, and another room altogether.
FOREIGN = ({"boxes": OTHER, "scene": 8}, {"boxes": OTHER, "scene": 9, "half": (1.6, 1.3, 2.4)})


def again(folder: Path, poses=AGAIN, **scene) -> Path:
    return recorded(folder, (seen(T, 900 + k, **scene) for k, T in enumerate(poses)))


def error_m(T_world_camera, T_room_camera) -> float:
    off = se3.inverse(T_WORLD_ROOM @ T_room_camera) @ T_world_camera
    return float(np.linalg.norm(off[:3, 3]))


@pytest.fixture(scope="module")
def here(session_results) -> tofuse.Result:
    return tofuse.load(session_results["here"])


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    return again(tmp_path_factory.mktemp("clip") / "clip")


def locate_json(capfd, *words: object) -> tuple[int, dict]:
    capfd.readouterr()
    return call("locate", *words, "--json"), json.loads(capfd.readouterr().out)


@pytest.mark.parametrize("k", [1, 4])
def test_frame_of_second_pass_is_located(here, k) -> None:
    located = here.locate(seen(AGAIN[k], 500 + k))
    assert located.accepted
    assert located.reason == ""
    location = located.location
    assert location.probability > 0.9
    assert error_m(location.T_map_camera, AGAIN[k]) < 0.02
    off = se3.log(se3.inverse(T_WORLD_ROOM @ AGAIN[k]) @ location.T_map_camera)
    assert off @ np.linalg.solve(location.covariance, off) < 30
    assert np.linalg.eigvalsh(location.covariance)[-1] < 0.1**2


def test_camera_that_focuses_is_that_of_the_map(here) -> None:
    """Phones state the lens of each frame, which differs by fractions of a pixel."""
    frame = seen(AGAIN[1], 501)
    for shift, same in ((0.5, True), (5.0, False)):
        camera = replace(frame.camera, cx=frame.camera.cx + shift)
        assert (here._map._config_of(replace(frame, camera=camera)) is here._map.config) == same


def test_single_frame_is_corrected_like_its_recording(
    session_results, clip, capsys, monkeypatch
) -> None:
    """A frame of another camera, without its noise model, would count as exact."""

    def counted(_, frame, recording):
        return locating.LocatedFrame(frame.index, 0, None, str(len(recording)))

    monkeypatch.setattr(locating.ResultMap, "locate_frame", counted)
    assert call("locate", session_results["here"], f"{clip}#3") == 3
    assert call("locate", session_results["here"], clip, "--start", 3, "--end", 4) == 3
    lines = capsys.readouterr().out.splitlines()
    assert lines[::2] == ["rejected frame 3; 6", "rejected frame 3; 1"]


@pytest.mark.parametrize("scene", FOREIGN)
@pytest.mark.parametrize("k", [0, 3])
def test_frame_of_another_room_is_not_accepted(here, scene, k) -> None:
    located = here.locate(seen(AGAIN[k], 600 + k, **scene))
    assert not located.accepted
    assert located.reason


def test_two_rooms_that_look_the_same_are_rivals(here) -> None:
    """A map with the same room twice: either pose fits, so none is accepted."""
    views = here._map.locator._views
    apart = se3.exp([20, 0, 0, 0, 0, 0])
    twice = [*views, *(type(v)(v.view, apart @ v.T_component_camera) for v in views)]
    locator = type(here._map.locator)(twice)
    located = replace(here._map, locator=locator).locate_frame(seen(AGAIN[2], 502))
    assert not located.accepted
    between = se3.inverse(located.location.T_map_camera) @ located.location.runner_up
    assert np.linalg.norm(between[:3, 3]) == pytest.approx(20, abs=0.3)


def test_clip_is_located_as_a_whole(session_results, clip, tmp_path, capfd) -> None:
    out = tmp_path / "out"
    status, data = locate_json(capfd, session_results["here"], clip, "--out", out)
    assert status == 0
    assert data["accepted"] == len(AGAIN)
    assert listing(out) == ["locations.json", "trajectory.txt"]
    written = json.loads((out / "locations.json").read_text())
    assert written == {k: v for k, v in data.items() if k != "out"}
    times, poses = read_tum(out / "trajectory.txt")
    assert times == pytest.approx(np.arange(len(AGAIN)) / 10)
    assert max(error_m(T, true) for T, true in zip(poses, AGAIN, strict=True)) < 0.02
    for frame, T in zip(data["frames"], poses, strict=True):
        assert np.allclose(frame["T_world_camera"], T)
        assert len(frame["covariance"]) == 36


def slid(tracked, frame: int, shift_m: float):
    """Clips whose poses slide along x at a frame, as before a bare wall, where tracking says so."""
    (clip,), lost = tracked
    slide = se3.exp([shift_m, 0, 0, 0, 0, 0])
    for k, T in clip.poses.items():
        clip.poses[k] = T @ slide if k >= frame else T
    clip.unobservable[frame] = np.eye(6)[:1]
    return [clip], lost


@pytest.mark.parametrize(("shift_m", "fits"), [(0.05, True), (2.0, False)])
def test_frames_beyond_degenerate_tracking_are_aligned_with_the_map(
    here, clip, monkeypatch, shift_m, fits
) -> None:
    original = clips.tracked_clips
    monkeypatch.setattr(clips, "tracked_clips", lambda *a: slid(original(*a), 3, shift_m))
    monkeypatch.setattr(locating, "_LOCATED", 1)  # one frame, from which all others are carried
    located = here._map.locate_clip(tofuse.open(clip), Silent())
    assert [frame.accepted for frame in located] == [True] * 3 + [fits] * 3
    for frame, true in zip(located, AGAIN, strict=True):
        if frame.accepted:
            assert error_m(frame.location.T_map_camera, true) < 0.02
        else:
            assert "does not constrain" in frame.reason
            assert len(frame.location.unobservable) == 1
            assert se3.largest_sigmas(frame.location.covariance)[0] > 1
        # The width of the prior is no error of a pose.
        assert ("sigma" in locating.sentence(frame)) == frame.accepted


def test_motion_in_a_clip_knows_what_tracking_did_not_constrain() -> None:
    clip = clips.Clip({k: at(0.1 * k, 0, 0, 0.3 * k, 0) for k in range(4)})
    clip.unobservable[2] = np.eye(6)[2:3]
    for start, end, count in ((0, 1, 0), (2, 3, 0), (0, 2, 1), (3, 0, 1), (1, 3, 1)):
        T, free = clip.motion(start, end)
        np.testing.assert_allclose(clip.poses[start] @ T, clip.poses[end], atol=1e-12)
        assert free.shape == (count, 6)
    # What moves frame 2 along its axis moves frame 3 along the same line.
    _, free = clip.motion(0, 3)
    moved = clip.poses[3] @ se3.exp(1e-3 * free[0]) @ se3.inverse(clip.poses[3])
    same = clip.poses[2] @ se3.exp(1e-3 * np.eye(6)[2]) @ se3.inverse(clip.poses[2])
    np.testing.assert_allclose(moved, same, atol=1e-12)


def test_one_frame_of_a_recording(session_results, clip, capsys) -> None:
    done = printed(capsys, "locate", session_results["here"], f"{clip}#3")
    assert done.startswith("accepted frame 3; at (")
    assert "probability" in done
    assert done.endswith("1 of 1 frames located\n")


def test_one_selected_frame(session_results, clip, tmp_path, capfd) -> None:
    """Also of a folder with a # in its name, which is no frame's number."""
    shutil.copytree(clip, tmp_path / "clip#2")
    words = session_results["here"], tmp_path / "clip#2", "--start", 3, "--end", 4
    status, data = locate_json(capfd, *words)
    assert status == 0
    assert [frame["index"] for frame in data["frames"]] == [3]
    named = session_results["here"], f"{clip}#3", "--every", 2
    refuses(capfd, "locate", *named, says=("clip#3: names one frame already", "--every"))


def test_clip_of_another_room_has_status_3(session_results, tmp_path, capfd) -> None:
    foreign = again(tmp_path / "foreign", AGAIN[::2], **FOREIGN[1])
    out = tmp_path / "out"
    status, data = locate_json(capfd, session_results["here"], foreign, "--out", out)
    assert status == 3
    assert data["accepted"] == 0
    assert all(frame["reason"] for frame in data["frames"])
    assert (out / "trajectory.txt").read_text() == ""


def test_cloud_is_registered_with_points_of_the_map(session_results, tmp_path, capfd) -> None:
    write_ply(tmp_path / "view.ply", GeometryRecord(seen(AGAIN[0], 700).points))
    status, data = locate_json(capfd, session_results["here"], tmp_path / "view.ply")
    (frame,) = data["frames"]
    assert status == (0 if frame["accepted"] else 3)
    if frame["accepted"]:
        assert error_m(np.array(frame["T_world_camera"]), AGAIN[0]) < 0.05


def test_cloud_in_map_coordinates_is_located_by_a_point_of_it(
    session_results, tmp_path, capfd
) -> None:
    """Where its origin comes to lie, hundreds of kilometres away, says nothing."""
    shift = np.array([412_000.0, 5_653_000.0, 118.0])
    points = seen(AGAIN[0], 700).points
    write_ply(tmp_path / "view.ply", GeometryRecord(points + shift))
    _, data = locate_json(capfd, session_results["here"], tmp_path / "view.ply")
    (frame,) = data["frames"]
    point, T = np.array(frame["reference_point_m"]), np.array(frame["T_world_camera"])
    assert np.linalg.norm(point - shift) < 10
    assert frame["sigma_m"] < 0.1
    (place,) = se3.transform(T, point[None])
    assert np.linalg.norm(place) < 10
    call("locate", session_results["here"], tmp_path / "view.ply")
    assert pair_words.vector(place, 3) in capfd.readouterr().out


def test_python_refuses_cloud(here) -> None:
    cloud = CloudFrame(0, 0.0, np.zeros((20, 3), np.float32))
    refused(r"is a cloud.*tofuse\.register", cloud, by=here.locate)


def test_missing_recording_is_named(session_results, clip, tmp_path, capfd) -> None:
    folder = tmp_path / "result"
    shutil.copytree(session_results["here"], folder)
    read_from(folder, tmp_path / "gone")
    says = (f"{tmp_path / 'gone'}, which doesn't exist", "put it back")
    refuses(capfd, "locate", folder, clip, says=says)


def test_errors_are_one_line(session_results, clip, tmp_path, capfd) -> None:
    refuses(capfd, "locate", tmp_path, clip, says=(str(tmp_path),))
    refuses(capfd, "locate", session_results["here"], tmp_path / "no", says=("no",))
    here = session_results["here"]
    refuses(capfd, "locate", here, f"{clip}#77", says=("has no frame 77", "0 to 5"))
    refuses(capfd, "locate", here, clip, "--overwrite", says="requires --out")
