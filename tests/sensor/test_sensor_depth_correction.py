from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.errors import InputError
from tofuse.engine.sensor.camera_errors import DepthCorrection
from tofuse.formats.cameras.calibration_files import read_correction, write_correction


def test_curve_is_linear_between_knots_and_constant_outside() -> None:
    correction = DepthCorrection(np.array([1.0, 2.0, 4.0]), np.array([0.1, 0.3, -0.1]))
    measured = np.array([[0.0, 0.5, 1.5, 3.0, 9.0]], np.float32)
    np.testing.assert_allclose(correction.correct(measured), [[0, 0.4, 1.3, 2.9, 9.1]], atol=1e-6)


def test_pixel_offset_is_subtracted_and_invalid_stays_invalid() -> None:
    pixel = np.array([[0.01, -0.02], [0.5, 0.0]], np.float32)
    correction = DepthCorrection(np.array([0.0]), np.array([0.0]), pixel)
    measured = np.array([[1, 0], [0.2, 2]], np.float32)
    np.testing.assert_allclose(correction.correct(measured), [[0.99, 0], [0, 2]], atol=1e-6)


@pytest.mark.parametrize("with_pixels", [False, True])
def test_saved_correction_is_loaded(tmp_path, with_pixels) -> None:
    pixel = np.random.default_rng(0).normal(size=(3, 4)).astype(np.float32) * 0.01
    one = DepthCorrection(np.linspace(0, 5, 11), np.sin(np.arange(11.0)), pixel)
    one = one if with_pixels else DepthCorrection(one.range_m, one.bias_m)
    write_correction(tmp_path / "correction.npz", one)
    assert [p.name for p in tmp_path.iterdir()] == ["correction.npz"]
    two = read_correction(tmp_path / "correction.npz")
    measured = np.full((3, 4), 2.34, np.float32)
    np.testing.assert_array_equal(one.correct(measured), two.correct(measured))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"range_m": [0.0, 1.0]}, "bias_m"),
        ({"range_m": [0.0, 1.0], "bias_m": [0.0]}, "shape"),
        ({"range_m": [0.0, np.nan], "bias_m": [0.0, 0.0]}, "not finite"),
        ({"range_m": [1.0, 0.0], "bias_m": [0.0, 0.0]}, "ascend"),
        ({"range_m": [0.0], "bias_m": [0.0], "pixel_bias_m": [1.0, 2.0]}, "pixel_bias_m"),
        ({"range_m": ["a"], "bias_m": [0.0]}, "range_m"),
    ],
)
def test_invalid_files_are_refused_in_one_line(tmp_path, arrays, message) -> None:
    path = tmp_path / "correction.npz"
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=message) as error:
        read_correction(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04 cut"])
def test_invalid_and_missing_npz_files_are_refused(tmp_path, content) -> None:
    path = tmp_path / "correction.npz"
    path.write_bytes(content)
    with pytest.raises(InputError):
        read_correction(path)
    with pytest.raises(InputError):
        read_correction(tmp_path / "missing.npz")


def test_objects_are_not_unpickled(tmp_path) -> None:
    path = tmp_path / "correction.npz"
    np.savez(path, range_m=np.array([{}], object), bias_m=np.zeros(1))
    with pytest.raises(InputError):
        read_correction(path)
