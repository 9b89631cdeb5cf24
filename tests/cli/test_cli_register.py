"""``tofuse register``: all kinds of views and guesses, its output, and its errors."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cli_calls import call, listing, refuses
from pose_errors import pose_error
from registration_scenes import bumpy_ball, stone, turn
from tofuse.engine.alignment.base import Registration
from tofuse.engine.clouds import AnyPair
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.engine.geometry import se3
from tofuse.formats.geometry.ply import read_ply, write_ply
from tofuse.formats.poses.pose import read_pose
from tofuse.formats.poses.trajectory import read_tum, tum_text
from tofuse.formats.recordings.open import open_recording

FILES = {"registration.json", "transform.txt", "aligned.ply", "report.html"}
MAP = np.array([512_345.25, 4_012_345.5, 310.0])
T_SMALL = turn([0.1, 1, 0.2], 4) @ se3.exp([0.02, -0.01, 0.03, 0, 0, 0])


@pytest.fixture
def light_page(monkeypatch) -> None:
    """Skip the page if the test does not use it."""
    monkeypatch.setattr(
        "tofuse.apps.pairs.page.write_pair_report", lambda _, path: path.write_text("<html>")
    )


@pytest.fixture
def clouds(tmp_path) -> tuple[Path, Path]:
    """Two samples of one surface: the source is the target's frame turned by `T_SMALL`."""
    target = stone(3000, 1, noise=0.001)
    source = se3.transform(se3.inverse(T_SMALL), stone(3000, 2, noise=0.001))
    for name, points in (("source.ply", source), ("target.ply", target)):
        write_ply(tmp_path / name, GeometryRecord(points))
    return tmp_path / "source.ply", tmp_path / "target.ply"


def register_json(capfd, *words: object) -> tuple[int, dict]:
    """Run with --json, which prints exactly one object."""
    capfd.readouterr()
    status = call("register", *words, "--json")
    out = capfd.readouterr().out
    assert out.count("\n") == 1
    return status, json.loads(out)


def near(T: object, truth: np.ndarray, at=(0, 0, 2.0), metres=0.01, degrees=0.5) -> None:
    moved, turned = pose_error(np.asarray(T), truth, np.array([at]))
    assert moved < metres
    assert turned < degrees


def true_motion(recording: Path, source: int, target: int) -> np.ndarray:
    _, poses = read_tum(recording / "groundtruth.txt")
    return se3.inverse(poses[target]) @ poses[source]


@pytest.mark.nightly_part
def test_two_frames_of_recording_are_registered(room_recording, tmp_path, capfd) -> None:
    out = tmp_path / "out"
    views = [f"{room_recording}#{k}" for k in (3, 0)]
    status, output = register_json(capfd, *views, "--out", out, "--threads", 2)
    assert status == 0
    assert output["believed"] is True
    assert output["probability"] > 0.9
    assert output["reason"] == ""
    assert (output["source"]["frame"], output["target"]["frame"]) == (3, 0)
    assert output["source"]["format"] == "native"
    near(output["T_target_source"], true_motion(room_recording, 3, 0), metres=0.03, degrees=1)
    assert {p.name for p in out.iterdir()} == FILES
    written = json.loads((out / "registration.json").read_text())
    assert {**written, "out": str(out)} == output
    assert written["schema"] == 1
    assert len(written["covariance"]) == 36
    covariance = np.reshape(written["covariance"], (6, 6))
    np.testing.assert_allclose(
        covariance @ np.reshape(written["information"], (6, 6)), np.eye(6), atol=1e-6
    )
    assert written["sigma_m"] == pytest.approx(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    np.testing.assert_array_equal(np.loadtxt(out / "transform.txt"), output["T_target_source"])
    frame = open_recording(room_recording)[3]
    ply = read_ply(out / "aligned.ply")
    moved = se3.transform(np.array(output["T_target_source"]), frame.points.astype(float))
    np.testing.assert_allclose(ply.points, moved, atol=1e-5)
    np.testing.assert_array_equal(ply.amplitude, frame.amplitude)
    page = (out / "report.html").read_text()
    assert "room#3 registered to room#0" in page
    assert "Accepted" in page
    assert (out / "report.html").stat().st_size < 4e6


def test_frame_numbers_select_source_and_target(room_recording, capfd) -> None:
    """Source and target are not mixed up: the other way round gives the inverse."""
    _, there = register_json(capfd, f"{room_recording}#5", f"{room_recording}#4")
    _, back = register_json(capfd, f"{room_recording}#4", f"{room_recording}#5")
    near(there["T_target_source"], true_motion(room_recording, 5, 4), metres=0.03, degrees=1)
    near(se3.inverse(back["T_target_source"]), np.array(there["T_target_source"]), metres=0.03)


@pytest.mark.nightly
def test_georeferenced_and_local_cloud_are_registered(tmp_path, capfd) -> None:
    """Without a guess the centres are aligned first; the result is in the frames of the files."""
    target = bumpy_ball(6000, 1) + MAP
    source = se3.transform(se3.inverse(T_SMALL), bumpy_ball(6000, 2))
    write_ply(tmp_path / "map.ply", GeometryRecord(target))
    write_ply(tmp_path / "local.ply", GeometryRecord(source))
    _, output = register_json(capfd, tmp_path / "local.ply", tmp_path / "map.ply")
    shift = se3.translation(MAP)
    near(output["T_target_source"], shift @ T_SMALL, metres=0.02, degrees=1)


def test_single_depth_images_are_registered(room_recording, tmp_path, capfd) -> None:
    for k in (0, 2):
        shutil.copy(room_recording / "depth" / f"{k:06d}.png", tmp_path / f"{k}.png")
    lone = tmp_path / "2.png", tmp_path / "0.png"
    refuses(capfd, "register", *lone, says=("2.png", "without a camera", "--camera"))
    _, output = register_json(capfd, *lone, "--camera", room_recording / "camera.json")
    assert output["source"]["format"] == "depth-png"
    near(output["T_target_source"], true_motion(room_recording, 2, 0), metres=0.05, degrees=1.5)
    shutil.copy(room_recording / "camera.json", tmp_path / "camera.json")
    _, beside = register_json(capfd, *lone)
    assert beside["T_target_source"] == output["T_target_source"]
    inside = room_recording / "depth" / "000002.png"
    refuses(capfd, "register", inside, lone[1], says=(f"use {room_recording}#2",))


GUESSES = {
    "four rows": lambda T: "".join(" ".join(map(repr, row)) + "\n" for row in T.tolist()),
    "one row": lambda T: "# mine\n" + ", ".join(map(repr, T.ravel().tolist())),
    "json": lambda T: json.dumps({"schema": 1, "T_target_source": T.tolist()}),
    "json list": lambda T: json.dumps(T.tolist()),
    "tum": lambda T: "12.5 " + tum_words(T),
    "tum without time": lambda T: tum_words(T),
}


def tum_words(T: np.ndarray) -> str:
    return tum_text([0.0], T[None]).split(" ", 1)[1]


@pytest.mark.parametrize("form", GUESSES)
def test_guess_formats_are_read(form, tmp_path) -> None:
    T = se3.exp([4e5, -2, 0.3, 0.4, -0.2, 1.0])
    path = tmp_path / "guess"
    path.write_text(GUESSES[form](T))
    np.testing.assert_allclose(read_pose(path), T, rtol=0, atol=1e-9)


def test_guess_is_passed_to_registration(clouds, tmp_path, capfd, monkeypatch) -> None:
    """Registration receives the guess, or none."""
    seen = []

    def spy(_, source, target, guess, rng):
        seen.append(guess)
        return made(np.eye(4) if guess is None else guess)

    monkeypatch.setattr(AnyPair, "register", spy)
    T = se3.exp([0.1, 0.2, 0.3, 0.4, -0.2, 1.0])
    (tmp_path / "guess.txt").write_text(GUESSES["tum"](T))
    _, output = register_json(capfd, *clouds, "--guess", tmp_path / "guess.txt")
    np.testing.assert_allclose(seen[0], T, atol=1e-9)
    np.testing.assert_allclose(output["T_target_source"], T, atol=1e-9)
    assert output["guess"] == str(tmp_path / "guess.txt")
    register_json(capfd, *clouds)
    assert seen[1] is None


BAD_GUESSES = {
    "missing": (None, ("doesn't exist",)),
    "empty": ("", ("contains 0 numbers", "16 numbers")),
    "words": ("1 0 0 x", ("line 1", "'x'")),
    "mirrored": ("-1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", ("no rotation",)),
    "projective": ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 1 1", ("last row",)),
    "no quaternion": ("0 0 0 2 0 0 0", ("quaternion", "length 2")),
    "broken json": ('{"T_target_source": ', ("not JSON",)),
    "json without": ('{"pose": 1}', ("T_target_source", "missing")),
    "json of another shape": ('{"T_target_source": [[1, 2]]}', ("T_target_source", "(1, 2)")),
}


@pytest.mark.parametrize("name", BAD_GUESSES)
def test_bad_guess_is_rejected(name, clouds, tmp_path, capfd) -> None:
    text, says = BAD_GUESSES[name]
    guess = tmp_path / "guess.txt"
    if text is not None:
        guess.write_text(text)
    before = listing(tmp_path)
    words = ("register", *clouds, "--guess", guess, "--out", tmp_path / "out")
    assert ";" in refuses(capfd, *words, says=(str(guess), *says))  # the remedy
    assert listing(tmp_path) == before


def bad_cloud(folder: Path, points: np.ndarray | None = None) -> Path:
    path = folder / "bad.ply"
    path.write_bytes(b"junk")
    if points is not None:
        write_ply(path, GeometryRecord(points))
    return path


# Unusable views of a folder and a recording, and what is said of them.
BAD_VIEWS: dict[str, tuple[Callable[[Path, Path], object], tuple[str, ...]]] = {
    "missing": (lambda folder, _: folder / "none.ply", ("none.ply", "doesn't exist")),
    "empty cloud": (lambda f, _: bad_cloud(f, np.zeros((0, 3))), ("bad.ply", "0 valid points")),
    "few points": (lambda f, _: bad_cloud(f, np.eye(3)), ("bad.ply", "3 valid points", "10")),
    "no cloud": (lambda folder, _: bad_cloud(folder), ("bad.ply", "PLY")),
    "several frames": (lambda _, room: room, ("contains 8 frames", "{room}#0 to {room}#7")),
    "out of range": (lambda _, room: f"{room}#8", ("{room}", "has no frame 8", "0 to 7")),
    "negative": (lambda _, room: f"{room}#-1", ("'-1'", "whole number")),
    "no number": (lambda _, room: f"{room}#", ("''", "whole number")),
}


@pytest.mark.parametrize("role", ["source", "target"])
@pytest.mark.parametrize("name", BAD_VIEWS)
def test_bad_view_is_rejected(name, role, clouds, room_recording, tmp_path, capfd) -> None:
    make, says = BAD_VIEWS[name]
    bad, says = make(tmp_path, room_recording), [part.format(room=room_recording) for part in says]
    before = listing(tmp_path)
    words = (bad, clouds[1]) if role == "source" else (clouds[0], bad)
    assert ";" in refuses(capfd, "register", *words, "--out", tmp_path / "out", says=tuple(says))
    assert listing(tmp_path) == before


def test_overwrite_without_out_is_rejected(clouds, capfd) -> None:
    refuses(capfd, "register", *clouds, "--overwrite", says=("--overwrite", "--out"))


def test_overwrite_replaces_only_earlier_result(clouds, tmp_path, capfd, light_page) -> None:
    out = tmp_path / "out"
    assert call("register", *clouds, "--out", out) == 0
    first = (out / "registration.json").read_text()
    (out / "notes.txt").write_text("mine")
    (out / "aligned.ply").unlink()
    says = ("contains an earlier result", "--overwrite")
    refuses(capfd, "register", *clouds, "--out", out, says=says)
    again = ("register", clouds[1], clouds[1], "--out", out, "--overwrite")
    refuses(capfd, *again, says=("notes.txt", "is not a file of an earlier result"))
    assert (out / "notes.txt").read_text() == "mine"
    (out / "notes.txt").unlink()
    assert call(*again) == 0
    assert {p.name for p in out.iterdir()} == set(FILES)
    assert (out / "registration.json").read_text() != first


def made(T: np.ndarray, **more: object) -> Registration:
    """A registration with only the required fields."""
    return replace(Registration(T, True, 3, 80, 100, 0.1, 0.004, 1e6 * np.eye(6)), **more)


@pytest.mark.parametrize(
    ("more", "status", "says"),
    [
        ({"believed": True, "probability": 0.97}, 0, "accepted: probability 97 %"),
        ({"believed": True, "probability": 0.9999}, 0, "accepted: probability over 99.9 %"),
        (
            {"believed": True, "probability": 0.97, "given_guess": True},
            0,
            "accepted: probability 97 %; given the identity: of other poses none was tried",
        ),
        (
            {"believed": False, "probability": 0.2, "reason": "too little overlap"},
            3,
            "rejected: probability 20 %; too little overlap",
        ),
        ({"believed": False}, 3, "rejected"),
        ({}, 3, "not verified: the method can't verify its result"),
    ],
)
def test_verification_sets_exit_status(
    more, status, says, clouds, tmp_path, capfd, monkeypatch, light_page
) -> None:
    """Even if all optional fields are missing."""
    monkeypatch.setattr(AnyPair, "register", lambda *a, **k: made(T_SMALL, **more))
    assert call("register", *clouds, "--out", tmp_path / "out") == status
    assert capfd.readouterr().out.splitlines()[0] == says
    assert {p.name for p in (tmp_path / "out").iterdir()} == FILES
    again, output = register_json(capfd, *clouds)
    assert again == status
    assert output["believed"] is more.get("believed")
    assert output["runner_up"] is output["margin"] is output["overlap"] is None


def test_risk_rejects_what_is_less_certain(clouds, capfd) -> None:
    status, data = register_json(capfd, *clouds, "--risk", "0.1")
    assert status == 0
    wrong = 1 - data["probability"]
    status, strict = register_json(capfd, *clouds, "--risk", f"{0.9 * wrong:.6f}")
    assert status == 3
    assert strict["T_target_source"] == data["T_target_source"]
    assert "above the accepted" in strict["reason"]
    refuses(capfd, "register", *clouds, "--risk", "0.5", says=("--risk", "0 to 0.1"))
