"""Intrinsics from views of a checkerboard, for simulated cameras with known intrinsics."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from cli_calls import printed, refuses
from refused import refused
from tofuse.apps.calibration import lens
from tofuse.apps.calibration.board import Board, board_pose, find_corners
from tofuse.apps.calibration.lens import BoardView, LensFit, calibrate_lens
from tofuse.engine.cameras.cameras import Camera, Fisheye, Pinhole, Rational
from tofuse.engine.errors import InputError, on_command_line
from tofuse.engine.frames.frames import CloudFrame, RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.scenes import checkerboard
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import camera_model
from tofuse.lab.simulation.record import simulate_recording
from written import record

BOARD = Board(checkerboard.COLUMNS, checkerboard.ROWS, checkerboard.SQUARE_M)
TRUE = camera_model("sr4000").camera


@cache
def frames() -> tuple[RangeFrame, ...]:
    effects = Effects().without("multipath")
    return tuple(simulate_recording("checkerboard", frames=16, effects=effects))


def recording_of(chosen) -> Recording:
    numbered = [replace(f, index=k, timestamp=float(k)) for k, f in enumerate(chosen)]
    return Recording.of(ArraySource(numbered), "views", "simulated")


@cache
def fitted() -> LensFit:
    return calibrate_lens(recording_of(frames()), BOARD)


@pytest.mark.nightly
def test_focal_length_within_0_2_percent_and_principal_point_within_half_a_pixel() -> None:
    camera = fitted().camera
    assert camera.fx == pytest.approx(TRUE.fx, rel=0.002)
    assert camera.fy == pytest.approx(TRUE.fy, rel=0.002)
    assert camera.cx == pytest.approx(TRUE.cx, abs=0.5)
    assert camera.cy == pytest.approx(TRUE.cy, abs=0.5)
    rays = np.abs(camera.rays() - TRUE.rays()) * TRUE.fx
    assert np.sqrt((rays**2).sum(-1).mean()) < 0.5  # over all of the image, distortion included


def test_standard_deviations_bound_errors() -> None:
    found = fitted()
    for name in ("fx", "fy", "cx", "cy"):
        assert abs(getattr(found.camera, name) - getattr(TRUE, name)) < 4 * found.sigma[name]
    assert found.sigma["fx"] < 0.003 * TRUE.fx
    assert found.sigma.keys() >= {"k1"}
    # Coefficients that the views do not constrain are fixed at 0, without a deviation.
    not_estimated = {"k1", "k2", "p1", "p2", "k3"} - found.sigma.keys()
    assert all(getattr(found.camera, name) == 0 for name in not_estimated)
    assert found.rms_px < 0.1
    assert found.rms_px_before == pytest.approx(found.rms_px, abs=0.02)


def test_corners_follow_pixel_centre_convention() -> None:
    """An offset of half a pixel, as upsampling may add, would show in the mean."""
    corners = find_corners(frames()[0].amplitude_image, BOARD)
    assert corners is not None
    found = board_pose(TRUE, corners, BOARD)
    assert found is not None
    T, rms = found
    assert rms < 0.1
    place = checkerboard.camera_poses(0)[0]
    # Where the wall and the board's middle are, to the millimetre.
    middle = se3.transform(se3.inverse(place), [[0, -0.0005, 1.5]])[0]
    mean = se3.transform(T, BOARD.points).mean(0)
    assert mean == pytest.approx(middle, abs=0.004)
    assert np.abs(TRUE.project(middle) - TRUE.project(mean)).max() < 0.1


@pytest.mark.nightly
def test_inconsistent_view_is_excluded_and_reported() -> None:
    chosen = list(frames()[:10])
    image = chosen[4].amplitude_image
    v, u = np.mgrid[0:144, 0:176].astype(np.float32)
    bent = cv2.remap(image, u + 3 * np.sin(v / 12).astype(np.float32), v, cv2.INTER_LINEAR)
    chosen[4] = replace(chosen[4], amplitude_image=bent)
    found = calibrate_lens(recording_of(chosen), BOARD)
    assert 4 not in found.views
    assert any(k == 4 and ("misses" in why or "not found" in why) for k, why in found.left_out)
    assert found.camera.fx == pytest.approx(TRUE.fx, rel=0.005)


def _bare(frame: RangeFrame) -> RangeFrame:
    return replace(frame, amplitude_image=None)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("chosen", "board", "message"),
    [
        (lambda: frames()[:3], BOARD, "3 distinct viewpoints"),
        (lambda: frames()[:1] * 6, BOARD, "1 distinct viewpoints"),
        (lambda: frames()[:4], Board(9, 7, 0.1), "shows no board of 9 x 7"),
        (lambda: frames()[:4], Board(5, 4, 0.1), "check --board"),
        (lambda: [_bare(frames()[0])], BOARD, "use --image color"),
        (lambda: [CloudFrame.of(np.eye(3))], BOARD, "contains clouds"),
    ],
)
def test_unsuitable_recordings_are_rejected(chosen, board: Board, message: str) -> None:
    with on_command_line(), pytest.raises(InputError) as caught:
        calibrate_lens(recording_of(chosen()), board)
    with on_command_line():
        assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def views_of(camera: Pinhole, poses: list[np.ndarray], sigma: float = 0.03) -> list[BoardView]:
    rng = np.random.default_rng(3)
    points = BOARD.points.astype(float)
    views = []
    for k, T in enumerate(poses):
        uv = camera.project(se3.transform(T, points))
        views.append(BoardView(k, uv + sigma * rng.normal(size=uv.shape)))
    return views


def poses_facing(count: int, tilt: float) -> list[np.ndarray]:
    rng = np.random.default_rng(4)
    out = []
    for k in range(count):
        around = 2.4 * k
        T = se3.exp([0, 0, 0, tilt * np.cos(around), tilt * np.sin(around), 0])
        T[:3, 3] = [*rng.uniform(-0.5, 0.2, 2), rng.uniform(0.8, 1.6)]
        out.append(T)
    return out


def test_degenerate_viewpoints_are_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Pinhole(320, 240, 250, 250, 160, 120)
    views = views_of(camera, poses_facing(12, 0.01))
    monkeypatch.setattr(lens, "board_views", lambda *_: (views, [], camera))
    refused("tilt it by 20 to 40 degrees", recording_of(frames()[:1]), BOARD, by=calibrate_lens)


@pytest.mark.parametrize(
    "camera",
    [
        Pinhole(320, 240, 250, 251, 163, 117),
        Fisheye(320, 240, 150, 151, 163, 117, 0.05, -0.02, 0.01, -0.002),
        Rational(320, 240, 250, 251, 163, 117, 0.5, -0.1, 0.001, -0.002, 0.02, 0.7, 0.1, 0.01),
    ],
    ids=lambda c: c.model,
)
def test_every_lens_model_is_recovered(camera: Pinhole, monkeypatch: pytest.MonkeyPatch) -> None:
    views = views_of(camera, poses_facing(16, 0.5))
    monkeypatch.setattr(lens, "board_views", lambda *_: (views, [], camera))
    found = calibrate_lens(recording_of(frames()[:1]), BOARD, camera.model)
    assert type(found.camera) is type(camera)
    for name in ("fx", "fy", "cx", "cy"):
        assert 0 < found.sigma[name] < 2
        assert abs(getattr(found.camera, name) - getattr(camera, name)) < 4 * found.sigma[name]
    assert found.rms_px == pytest.approx(0.03 * np.sqrt(2), rel=0.15)
    inside = _seen(camera, views)
    apart = (found.camera.rays() - camera.rays())[inside] * camera.fx
    assert np.sqrt((apart**2).sum(-1).mean()) < 0.3


def _seen(camera: Camera, views: list[BoardView]) -> np.ndarray:
    mask = np.zeros((camera.height, camera.width), np.uint8)
    for view in views:
        cv2.fillConvexPoly(mask, cv2.convexHull(view.corners.round().astype(np.int32)), 1)
    return mask.astype(bool)


@pytest.mark.nightly_part
def test_command_writes_camera_for_readers(tmp_path: Path, capsys) -> None:
    wrong = replace(TRUE, fx=200.0)
    seen = [replace(f, camera=wrong, timestamp=float(k)) for k, f in enumerate(frames()[:10])]
    record(tmp_path / "rec", seen, depth_unit_m=0.0001, amplitude_kind="range_compensated")
    out = tmp_path / "new" / "camera.json"
    command = ["calibrate", "lens", str(tmp_path / "rec"), "--board", "8x6:0.1"]
    text = printed(capsys, *command, "--out", out)
    assert "fx 2" in text
    assert "(sigma " in text
    about = json.loads(out.read_text())
    assert about["depth_unit_m"] == 0.0001
    assert about["amplitude_kind"] == "range_compensated"
    frame = open_recording(tmp_path / "rec", camera=out)[0]
    assert isinstance(frame, RangeFrame)
    assert isinstance(frame.camera, Pinhole)
    assert frame.camera.fx == pytest.approx(TRUE.fx, rel=0.005)
    refuses(capsys, *command, "--out", out, says="--overwrite")
    refuses(capsys, "calibrate", "lens", tmp_path / "rec", says="--board")
