"""NumPy archives, Pico Zense folders, and custom sources."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import made_arrays as made
import tofuse
from refused import refused
from tofuse.engine.cameras.cameras import BrownConrady, Pinhole, RayTable
from tofuse.engine.errors import InputError
from tofuse.engine.frames.frames import RangeFrame
from tofuse.formats.recordings.open import open_recording


def test_npz_round_trip(tmp_path: Path) -> None:
    given = made.arrays()
    np.savez_compressed(tmp_path / "a.npz", **given)
    recording = open_recording(tmp_path / "a.npz")
    np.testing.assert_array_equal(recording.timestamps, given["timestamps"])
    assert recording.odometry is not None
    np.testing.assert_allclose(recording.reference, made.POSES, atol=1e-12)
    assert recording.metadata["sensor"] == "My camera (ToF)"
    assert recording.metadata["confidence_max"] == 7
    lens = {"k1": 0.1, "k2": -0.05}
    for k, frame in enumerate(recording):
        assert frame.camera == BrownConrady(16, 12, 20.0, 21.0, 7.5, 5.5, **lens)
        assert frame.depth_kind == "range"
        truth = np.where(made.COUNTS[k] == 65535, 0, made.COUNTS[k]) * 0.001
        np.testing.assert_allclose(frame.radial_range, truth, rtol=1e-6)
        for name in ("amplitude", "confidence", "color", "sigma"):
            np.testing.assert_allclose(getattr(frame, f"{name}_image"), given[name][k], rtol=1e-6)
        assert frame.ambiguity_m == 7.5


def test_npz_with_metres_and_rays(tmp_path: Path) -> None:
    rays = np.random.default_rng(1).normal(size=(12, 16, 2))
    depth = np.full((12, 16), 2.0)
    depth[3, 3] = np.nan
    np.savez(tmp_path / "a.npz", depth=depth, rays=rays, extra=1)
    recording = open_recording(tmp_path / "a.npz")
    frame = recording[0]
    assert isinstance(frame.camera, RayTable)
    assert not frame.valid[3, 3]
    np.testing.assert_allclose(frame.point_image[5, 6], [*(2 * rays[5, 6]), 2], rtol=1e-6)
    assert recording.warnings == [f"{tmp_path / 'a.npz'}: unknown arrays ignored: extra"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth_unit_m": None}, r"depth_unit_m: is missing, but depth has whole numbers"),
        ({"K": None}, "K: is missing, and so is rays"),
        ({"K": np.eye(4)}, r"K: has shape \(4, 4\); save \(3, 3\)"),
        ({"K": np.array([[20, 1, 8], [0, 20, 6], [0, 0, 1.0]])}, "K: has a skew of 1 px"),
        (
            {"depth": np.moveaxis(made.COUNTS, 0, -1)},
            r"K: is that of images of 16 x 12 pixels, and",
        ),
        ({"depth": made.COUNTS[0, 0]}, r"depth: has shape \(16,\)"),
        ({"depth_kind": "radial"}, "depth_kind: is 'radial'; save one of z, range"),
        ({"timestamps": np.zeros(2)}, "timestamps: has 2 values; save 3"),
        ({"confidence": made.COUNTS}, "confidence: has type uint16; save uint8"),
        ({"amplitude": made.COUNTS[:2]}, r"amplitude: has shape \(2, 12, 16\)"),
        ({"reference": np.zeros((3, 4, 4))}, r"reference\[0\]"),
        ({"rays": np.zeros((3, 3, 2))}, "rays: has shape"),
        ({"distortion": np.zeros(6), "model": "brown"}, "distortion: has 6 numbers"),
        ({"confidence_max": -1}, "confidence_max: isn't a positive number"),
        ({"depth": -0.001 * made.COUNTS}, "holds negative depth only; negate it"),
    ],
)
def test_npz_errors_name_the_problem(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    np.savez(tmp_path / "a.npz", **made.arrays(**changes))
    refused(message, tmp_path / "a.npz")


def test_npy_alone_says_what_it_lacks(tmp_path: Path) -> None:
    np.save(tmp_path / "depth.npy", made.COUNTS)
    for path in (tmp_path, tmp_path / "depth.npy"):
        refused(r"depth and K by numpy\.savez", path)


def test_zense(tmp_path: Path) -> None:
    made.make_zense(tmp_path / "scan")
    frame = open_recording(tmp_path / "scan")[1]
    assert frame.camera == Pinhole(16, 12, 20.0, 21.0, 7.5, 5.5)
    np.testing.assert_allclose(frame.z[1:], made.COUNTS[1, 1:] * 0.001, rtol=1e-6)
    path = tmp_path / "scan" / "camera.toml"
    path.write_text(path.read_text().replace("camera_cy = 5.5", ""))
    refused(r"camera\.toml: camera_cy: is missing; use a number", tmp_path / "scan")


def test_real_zense(shared_data: Path) -> None:
    recording = open_recording(shared_data / "pico_zense_static")
    assert (recording.format, len(recording)) == ("zense", 10)
    assert recording.metadata["sensor"] == "Pico Zense (ToF)"
    depths = []
    for frame in recording:
        assert frame.camera == Pinhole(640, 480, 456.636, 456.226, 342.983, 233.82)
        depths.append(np.where(frame.valid, frame.z, np.nan))
    # A static scene: the documented standard deviations over time, in metres.
    stack = np.stack(depths)
    sigma = stack.std(0)[np.isfinite(stack).all(0)]
    np.testing.assert_allclose(np.percentile(sigma, [5, 50, 95]), [0.005, 0.010, 0.053], rtol=0.2)


def test_dates_are_converted_to_seconds() -> None:
    K = [[50.0, 0, 31.5], [0, 50.0, 23.5], [0, 0, 1]]
    times = np.datetime64("2024-01-01T00:00:00", "us") + 40_000 * np.arange(3)
    recording = tofuse.from_arrays(np.ones((3, 48, 64)), K, timestamps=times)
    np.testing.assert_allclose(np.diff(recording.timestamps), 0.04, atol=1e-6)
    assert recording.timestamps[0] == 1704067200
    zone = timezone(timedelta(hours=2))
    for begin in (datetime(2024, 1, 1), datetime(2024, 1, 1, 2, tzinfo=zone), timedelta(0)):
        dates = [begin + timedelta(milliseconds=40 * k) for k in range(3)]
        python = tofuse.from_arrays(np.ones((3, 48, 64)), K, timestamps=dates)
        np.testing.assert_allclose(np.diff(python.timestamps), 0.04, atol=1e-6)
        assert python.timestamps[0] == (0 if begin == timedelta(0) else 1704067200)


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("kind", ["u1", "i2", "u2", "i4", "u4", "f4"])
def test_largest_number_is_no_depth(tmp_path: Path, kind: str, order: str) -> None:
    depth = np.full((2, 4, 6), 7, order + kind)
    depth[0, 0, 0] = (np.finfo if kind == "f4" else np.iinfo)(kind).max
    K = np.array([[5, 0, 2.5], [0, 5, 1.5], [0, 0, 1]])
    np.savez(tmp_path / "a.npz", depth=depth, K=K, depth_unit_m=0.001)
    recordings = (tofuse.open(tmp_path / "a.npz"), tofuse.from_arrays(depth, K, depth_unit_m=0.001))
    for frame in (recording[0] for recording in recordings):
        assert isinstance(frame, RangeFrame)
        assert (frame.depth[0, 0], frame.valid.sum()) == (0, 23)
        assert frame.depth.dtype == np.float32


def test_arrays_that_hold_no_depth_in_mm_or_are_elsewhere() -> None:
    """8 bits end at 255 mm; tensors on a GPU say themselves what to do."""
    K = [[50.0, 0, 31.5], [0, 50.0, 23.5], [0, 0, 1]]
    with pytest.raises(InputError, match="uint8, which ends at 255 mm; pass images of 16 bits, or"):
        tofuse.from_arrays(np.ones((3, 48, 64), np.uint8), K)

    class Tensor:
        def __iter__(self):
            raise TypeError("can't convert cuda:0 device type tensor to numpy: use Tensor.cpu()")

    refused(r"not an array of images .*use Tensor\.cpu\(\)", Tensor(), K, by=tofuse.from_arrays)
