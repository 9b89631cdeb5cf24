"""Files of Arducam's and Analog Devices' cameras, in their published layouts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import made_tof
from made_phones import DEPTH
from made_tof import ADI_LENS, adi_frame
from refused import refused
from tofuse.formats.recordings.open import open_recording
from written import change_camera


def test_invalid_numbers_of_arducam(tmp_path: Path) -> None:
    made_tof.make_arducam(tmp_path / "scan")
    recording = open_recording(tmp_path / "scan")
    assert recording.metadata["confidence_max"] == 255
    for k, frame in enumerate(recording):
        expected = DEPTH[k].copy()
        expected[0, :4] = 0
        np.testing.assert_allclose(frame.depth, expected, atol=1e-6)
        assert frame.confidence_image[1, :3].tolist() == [0, 255, 0]
        assert (frame.confidence_image[2:] == 40 + k).all()


def test_arducam_in_metres_along_ray(tmp_path: Path) -> None:
    """Unit and kind are those of camera.json: earlier SDKs wrote metres."""
    made_tof.make_arducam(tmp_path / "scan")
    change_camera(tmp_path / "scan", depth_unit_m=1.0, depth_kind="range")
    frame = open_recording(tmp_path / "scan")[0]
    assert frame.depth_kind == "range"
    np.testing.assert_allclose(frame.depth[2:], 1000 * DEPTH[0][2:], rtol=1e-6)


def test_arducam_raw_phases_are_refused(tmp_path: Path) -> None:
    (tmp_path / "raw_240_1800_u16_1700000000000.raw").write_bytes(bytes(100))
    refused("not the sensor's raw phases", tmp_path, format="arducam")


def check_adi(frame: object, k: int) -> None:
    assert frame.depth_kind == "range"
    assert not frame.valid[2:5, 2:9].any()
    assert frame.valid.sum() == 64 * 48 - 21
    # The wall of `adi_frame`, within the rounding to mm.
    x, y, z = frame.points.T
    wall = (z + 0.3 * x + 0.1 * y - (1.8 + 0.1 * k)) / np.linalg.norm((1, 0.3, 0.1))
    assert np.abs(wall).max() < 0.001
    ranges = np.rint(1000 * frame.depth)
    np.testing.assert_array_equal(frame.amplitude_image, ranges // 3)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"confidence": False},  # the megapixel modes
        {"stated": False},  # SDKs before 6
        {"stated": False, "confidence": False},
    ],
)
def test_aditof(tmp_path: Path, options: dict[str, bool]) -> None:
    path = tmp_path / "frame2025_01_01_00_00_00_0.bin"
    path.write_bytes(b"".join(adi_frame(k, **options) for k in range(3)))
    for given in (path, tmp_path):
        recording = open_recording(given)
        assert (recording.format, len(recording)) == ("aditof", 3)
        np.testing.assert_allclose(recording.timestamps, 1.7e9 + 0.25 * np.arange(3))
        for k, frame in enumerate(recording):
            check_adi(frame, k)
    rays = recording[0].camera.rays()
    known = np.isfinite(rays).all(-1)
    assert not known[2:5, 2:9].any()
    off = np.abs(rays - ADI_LENS.rays())[known] * (ADI_LENS.fx, ADI_LENS.fy)
    assert np.sqrt((off**2).mean()) < 0.01  # pixels; rounding alone would be 0.02
    assert off.max() < 0.05
    assert recording.warnings == []


def test_aditof_with_one_frame_per_file(tmp_path: Path) -> None:
    for k in (0, 1, 10):
        (tmp_path / f"frame2025_01_01_00_00_00_{k}.bin").write_bytes(adi_frame(k, clock=False))
    recording = open_recording(tmp_path)
    np.testing.assert_array_equal(recording.timestamps, [0, 1, 2])
    for k, frame in zip((0, 1, 10), recording, strict=True):
        check_adi(frame, k)


def test_other_bin_files_are_not_taken_for_aditof(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    path = tmp_path / "a.bin"
    for size in (100, 128, 10_000, 1 << 20):
        path.write_bytes(rng.bytes(size))
        refused("not a recording of a known format", path)
