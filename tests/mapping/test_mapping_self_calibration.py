"""A recording that reveals a calibration error is reconstructed with a correction."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from boxes_in_room import views_in_room
from tofuse.engine.cameras.cameras import BrownConrady, Pinhole, RayTable
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.geometry.rays import homogeneous
from tofuse.engine.mapping.config import changed
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.engine.mapping.self_calibration import self_calibrated
from tofuse.engine.progress import Silent
from tofuse.engine.quality.pose_accuracy import Accuracy
from tofuse.engine.quality.trajectory_errors import displacement
from tofuse.engine.refinement.calibration_check import CalibrationCheck
from tofuse.engine.refinement.refinement import Refinement
from tofuse.engine.sensor.camera_errors import CameraErrors
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.record import simulate
from written_run_json import run_json

CAMERA = Pinhole(8, 6, 10.0, 11.0, 3.5, 2.5)
# Only the poses matter: the model is coarse.
COARSE = changed(from_method("default"), {"fusion": {"voxel_m": 0.1}}, where="test")


def frame(camera=CAMERA, kind="z") -> RangeFrame:
    depth = np.full((6, 8), 2.0, np.float32)
    depth[0, 0] = 0
    return RangeFrame(0, 0.0, camera, depth, kind)


@pytest.mark.parametrize("camera", [CAMERA, RayTable(CAMERA.rays())])
@pytest.mark.parametrize("kind", ["z", "range"])
@pytest.mark.parametrize("distortion", [0.0, -0.04])
def test_corrected_points_are_correct(camera, kind, distortion) -> None:
    before = frame(camera, kind)
    after = CameraErrors(0.1, 0.05, 0.02, -0.03, distortion).start().apply(before)
    assert isinstance(after, RangeFrame)
    np.testing.assert_array_equal(after.valid, before.valid)
    slopes = [f.points[:, :2] / f.points[:, 2:] for f in (before, after)]
    scale = 1.1 + distortion * (slopes[0] ** 2).sum(1, keepdims=True)
    true = scale * slopes[0] + [0.02, -0.03]
    np.testing.assert_allclose(slopes[1], true, rtol=1e-5, atol=1e-6)
    rays = homogeneous(true)
    lengths = np.linalg.norm(rays, axis=1)
    # The camera measures 2 m: the range, or z along the corrected ray.
    ranges = (2.0 if kind == "range" else 2.0 * lengths) + 0.05
    expected = (ranges / lengths)[:, None] * rays
    np.testing.assert_allclose(after.points, expected, rtol=1e-5, atol=1e-6)


def test_errors_are_composed() -> None:
    first = CameraErrors(0.1, 0.02, 0.01, focal_sigma=0.004, center_x_sigma=0.002)
    second = CameraErrors(0.1, 0.01, 0.0, -0.02, 0.0, focal_sigma=0.003, offset_sigma_m=0.005)
    both = first.and_then(second)
    assert both.sigmas["focal"] == 0.003
    assert both.sigmas["center_x"] == 0.002
    assert both.focal == pytest.approx(0.21)
    assert both.offset_m == pytest.approx(0.03)
    camera = both.camera(CAMERA)
    again = second.camera(first.camera(CAMERA))
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(camera, name) == pytest.approx(getattr(again, name))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Once around a room, with its true camera."""
    folder = tmp_path_factory.mktemp("calibration") / "room"
    effects = Effects(multipath=False, smear=False)
    return open_recording(simulate("room", folder, every=16, seed=10, effects=effects))


def seen_by(recording: Recording, share: float, kind: str = "z") -> Recording:
    """The recording with the focal length multiplied by a factor.

    The camera measures z, or `kind` "range".
    """
    frames = []
    for item in recording:
        assert isinstance(item, RangeFrame)
        if kind == "range":
            item = replace(item, depth=item.radial_range, depth_kind="range")
        camera = item.camera
        assert isinstance(camera, Pinhole)
        frames.append(
            replace(item, camera=replace(camera, fx=share * camera.fx, fy=share * camera.fy))
        )
    source = ArraySource(frames, recording.reference, metadata=dict(recording.metadata))
    return Recording.of(source, recording.path, recording.format)


def error_of(recording: Recording, result) -> float:
    assert recording.reference is not None
    assert result.has_pose.all()
    return displacement(recording.reference, result.trajectory)[0]


@pytest.fixture(scope="module")
def wrong(recording):
    return seen_by(recording, 1.05)


@pytest.mark.nightly
def test_wrong_focal_length_is_corrected(wrong) -> None:
    config = replace(COARSE, self_calibration=False)
    stated = reconstruct(wrong, config)
    assert stated.diagnostics.calibrated is None
    assert "calibration_alarm" in {r.code for r in stated.diagnostics.reasons}
    result = self_calibrated(stated, config, partial(reconstruct, wrong), Silent())
    found = result.diagnostics.calibrated
    assert found is not None
    assert found.focal == pytest.approx(0.05, abs=0.01)
    assert found.offset_m == 0
    assert 0 < found.sigmas["focal"] < 0.01
    assert found.bound_m[1] < 0.5 * found.bound_m[0]
    assert found.bound_m[1] == result.diagnostics.accuracy.position_m
    written = run_json(result)
    assert written["self_calibration"]["focal"] == found.focal
    applied = written["config"]["corrections"][0]
    assert (applied["part"], applied["focal"]) == ("camera-errors", found.focal)
    assert applied["focal_sigma"] == found.sigmas["focal"]
    codes = {r.code for r in result.diagnostics.reasons}
    assert "self_calibrated" in codes
    assert "calibration_alarm" not in codes
    assert error_of(wrong, result) < 0.3 * error_of(wrong, stated)
    assert error_of(wrong, result) < result.diagnostics.accuracy.position_m


@pytest.mark.nightly
def test_wrong_focal_length_of_range_camera_is_corrected(recording) -> None:
    """Rotation scales with the focal length and all views agree: only the loop reveals it."""
    wrong = seen_by(recording, 1.05, "range")
    result = reconstruct(wrong, COARSE)
    found = result.diagnostics.calibrated
    assert found is not None
    assert found.focal == pytest.approx(0.05, abs=0.01)
    assert error_of(wrong, result) < result.diagnostics.accuracy.position_m


# A sweep to both sides and back, which closes loops without a full turn.
SWEEP = np.linspace(0, 2 * np.pi, 30)
SWEPT = np.tile(np.eye(4), (30, 1, 1))
SWEPT[:, :3, :3] = se3.exp(
    np.outer(1.2 * np.sin(SWEEP), [0, 0, 0, 0, 1, 0])
    + np.outer(0.15 * np.sin(2 * SWEEP), [0, 0, 0, 1, 0, 0])
)[:, :3, :3]
SWEPT[:, :3, 3] = np.stack([0.4 * np.sin(SWEEP), 0.1 * np.sin(SWEEP), 0.4 * (np.cos(SWEEP) - 1)], 1)
WIDE = BrownConrady(64, 64, 32.0, 32.0, 31.5, 31.5)
BENT = replace(WIDE, k1=-0.15, k2=0.08)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("camera", "true", "errors", "corrected"),
    [
        (WIDE, {"fx": 31.84, "fy": 31.84}, {"focal": 0.005}, False),
        (WIDE, {"fx": 31.36, "fy": 31.36}, {"focal": 0.02}, True),
        (BENT, {"fx": 31.36, "fy": 31.36}, {"focal": 0.02}, True),
        (WIDE, {"cy": 32.46}, {"center_y": -0.03}, True),
        (BENT, {"cy": 32.46}, {"center_y": -0.03}, True),
        (WIDE, {"k1": -0.02}, {"distortion": 0.02}, True),
    ],
)
def test_wrong_intrinsics_are_corrected_or_part_of_bound(camera, true, errors, corrected) -> None:
    frames = views_in_room(replace(camera, **true), SWEPT, 0.005, 0)
    stated = [replace(f, camera=camera) for f in frames]
    result = reconstruct(Recording.of(ArraySource(stated), "", "test"), COARSE)
    error, _ = displacement(SWEPT, result.trajectory)
    d = result.diagnostics
    assert error < d.accuracy.position_m
    assert (d.calibrated is not None) == corrected
    if corrected:
        assert error < 0.005
        (name, expected), *_ = errors.items()
        assert getattr(d.calibrated, name) == pytest.approx(expected, rel=0.2)
        assert run_json(result)["self_calibration"][name] == getattr(d.calibrated, name)


@pytest.mark.nightly
def test_correct_focal_length_is_unchanged(recording) -> None:
    result = reconstruct(recording, COARSE)
    assert result.diagnostics.calibrated is None
    assert run_json(result)["self_calibration"] is None
    assert "self_calibrated" not in {r.code for r in result.diagnostics.reasons}


def assessed(result, error: float | None, bound: float, posed: int = 3):
    """A result whose views reveal an error of the focal length."""
    found = CalibrationCheck(
        error is not None, {"focal": error or 0.0}, estimates={"focal": (error or 0.0, 0.001)}
    )
    poses = np.tile(np.eye(4), (3, 1, 1))
    refinement = Refinement(poses, True, 3, 3, support=(0.5, 0.9), calibration_check=found)
    d = replace(
        result.diagnostics,
        refinement=refinement,
        accuracy=Accuracy(bound, 0.01, 0.01, True),
        reasons=(),
    )
    trajectory = np.where(np.arange(len(result.trajectory))[:, None, None] < posed, np.eye(4), None)
    return replace(result, trajectory=trajectory.astype(float), diagnostics=d)


@pytest.fixture(scope="module")
def any_result(room_recording):
    return reconstruct(open_recording(room_recording).select(end=3), COARSE)


def test_correction_undone_by_views_is_dropped(any_result) -> None:
    first = assessed(any_result, 0.1, 0.2)
    for left, kept in ((-0.05, False), (-0.005, True), (0.05, True)):
        undone = assessed(any_result, left, 0.05)
        check = undone.diagnostics.refinement.calibration_check
        refinement = replace(
            undone.diagnostics.refinement, calibration_check=replace(check, alarm=False)
        )
        undone = replace(undone, diagnostics=replace(undone.diagnostics, refinement=refinement))
        result = self_calibrated(first, from_method("default"), lambda _, r=undone: r, Silent())
        assert (result.diagnostics.calibrated is not None) == kept


@pytest.mark.parametrize(
    ("again", "kept"),
    [
        ({"bound": 0.05}, True),
        ({"bound": 0.2}, False),
        ({"bound": 0.05, "posed": 2}, False),
        ({"bound": np.inf}, False),
    ],
)
def test_correction_is_kept_only_if_it_helps(any_result, again, kept) -> None:
    first = assessed(any_result, 0.05, 0.1)
    configs = []

    def once(config):
        configs.append(config)
        return assessed(any_result, None, **again)

    result = self_calibrated(first, from_method("default"), once, Silent())
    assert (result.diagnostics.calibrated is not None) == kept
    assert configs[0].corrections[0] == CameraErrors(focal=0.05, focal_sigma=0.001)
    assert (result is first) == (not kept)


def test_nothing_is_corrected_where_nothing_bounds_the_poses(any_result) -> None:
    """There, views may have slid: a correction that makes them agree may only explain that."""
    first = assessed(any_result, 0.05, np.inf)
    again = assessed(any_result, None, np.inf)
    assert self_calibrated(first, from_method("default"), lambda _: again, Silent()) is first


def test_second_estimate_is_composed_with_first(any_result) -> None:
    results = iter([assessed(any_result, 0.01, 0.05), assessed(any_result, 0.01, 0.02)])
    configs = []

    def once(config):
        configs.append(config)
        return next(results)

    result = self_calibrated(
        assessed(any_result, 0.04, 0.1), from_method("default"), once, Silent()
    )
    assert result.diagnostics.calibrated is not None
    assert result.diagnostics.calibrated.focal == pytest.approx(1.04 * 1.01 - 1)
    # Each time relative to the stated calibration, not to the corrected one.
    assert [c.corrections[0].focal for c in configs] == pytest.approx([0.04, 1.04 * 1.01 - 1])
    assert len(configs[1].corrections) == len(configs[0].corrections)


def test_excessive_correction_is_not_applied(any_result) -> None:
    first = assessed(any_result, 0.7, 0.1)

    def never(config):
        raise AssertionError("reconstructed again")

    assert self_calibrated(first, from_method("default"), never, Silent()) is first
