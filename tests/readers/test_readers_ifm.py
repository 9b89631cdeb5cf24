"""O3R streams: written here in the manufacturer's layout, and a real frame."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

import made_ifm as made
from refused import refused
from tofuse.engine.errors import UnreadableFrameError
from tofuse.formats.recordings.open import open_recording


def unit_vector(model: int, numbers: tuple[float, ...], u: int, v: int) -> np.ndarray:
    """The manufacturer's formula for one pixel, evaluated literally."""
    fx, fy, mx, my, skew, a, b, c, d, e = numbers
    y = (v + 0.5 - my) / fy
    x = (u + 0.5 - mx) / fx - skew * y
    r2 = x**2 + y**2
    if model == 0:
        radial = 1 + a * r2 + b * r2**2 + e * r2**3
        ray = np.array(
            [
                x * radial + 2 * c * x * y + d * (r2 + 2 * x**2),
                y * radial + c * (r2 + 2 * y**2) + 2 * d * x * y,
                1.0,
            ]
        )
        return ray / np.linalg.norm(ray)
    s = min(np.sqrt(r2), e) ** 2
    theta = np.sqrt(r2) * (1 + a * s + b * s**2 + c * s**3 + d * s**4)
    side = np.array([x, y]) / np.sqrt(r2) * np.sin(theta)
    return np.array([*side, np.cos(theta)])


@pytest.mark.parametrize(("model", "numbers"), [(0, made.BOUGUET), (2, made.FISHEYE)])
def test_points_noise_and_flags(tmp_path: Path, model: int, numbers: tuple[float, ...]) -> None:
    made.make_o3r(tmp_path / "buffer.data", model, numbers)
    recording = open_recording(tmp_path)
    np.testing.assert_allclose(recording.timestamps, 1000 + 0.05 * np.arange(3))
    for k, frame in enumerate(recording):
        assert frame.depth_kind == "range"
        good = made.FLAGS[k] % 2 == 0
        seen = np.isfinite(frame.camera.rays()).all(-1)
        np.testing.assert_array_equal(frame.valid, good & seen)
        np.testing.assert_allclose(
            frame.radial_range[good], made.COUNTS[k][good] * made.UNIT, rtol=1e-5
        )
        np.testing.assert_allclose(frame.sigma_image, made.NOISE[k] * made.UNIT, rtol=1e-5)
        np.testing.assert_array_equal(frame.amplitude_image, made.AMPLITUDE[k])
        for u, v in ((3, 4), (12, 9), (17, 11), (0, 0), (23, 17)):
            vector = unit_vector(model, numbers, u, v)
            if vector[2] <= 0:
                assert not seen[v, u]
            elif good[v, u]:
                expected = vector * made.COUNTS[k, v, u] * made.UNIT
                np.testing.assert_allclose(frame.point_image[v, u], expected, rtol=1e-4, atol=1e-6)


def test_damaged_frame_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "buffer.data"
    data = bytearray(made.frame(0) + made.frame(1) + made.frame(2))
    at = len(made.frame(0)) + 24 + 4
    struct.pack_into("<I", data, at, 10)  # the size of frame 1's first chunk
    path.write_bytes(data)
    items = list(open_recording(path).read_all())
    assert [isinstance(item, UnreadableFrameError) for item in items] == [False, True, False]
    assert "frame 1: is cut off or damaged in chunk 100" in str(items[1])
    path.write_bytes(made.frame(0).replace(struct.pack("<I", 420), struct.pack("<I", 421), 1))
    refused(r"has no lens \(chunk 420\); record with", path)


def test_real_frame(shared_data: Path) -> None:
    recording = open_recording(shared_data / "ifm_o3r")
    assert (recording.format, len(recording)) == ("ifm-o3r", 1)
    frame = recording[0]
    assert (frame.camera.width, frame.camera.height) == (224, 172)
    data = (shared_data / "ifm_o3r" / "O3RBuffer.data").read_bytes()
    # The camera's own model of the other direction, from points to pixels, to 0.6 pixel.
    at = data.rfind(struct.pack("<III", 420, 360, 48))
    model, fx, fy, mx, my, skew, k1, k2, k3, k4, k5 = struct.unpack_from(
        "<I10f", data, at + 48 + 180
    )
    assert (model, skew, k3, k4) == (1, 0, 0, 0)
    x, y, z = frame.points.astype(float).T
    r2 = (x**2 + y**2) / z**2
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k5))
    rows, columns = np.nonzero(frame.valid)
    assert np.abs(fx * x / z * radial + mx - 0.5 - columns).max() < 0.6
    assert np.abs(fy * y / z * radial + my - 0.5 - rows).max() < 0.6
    # The camera marks pixels without a distance as invalid.
    start = data.find(struct.pack("<II", 300, 38576)) + 48
    flags = np.frombuffer(data, np.uint8, 172 * 224, start).reshape(172, 224)
    np.testing.assert_array_equal(frame.valid, flags % 2 == 0)
    # The face of the box is flat.
    points = frame.point_image[66:108, 76:104].reshape(-1, 3).astype(float)
    normal = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][2]
    assert np.median(np.abs((points - points.mean(0)) @ normal)) < 0.002
    # The camera's own noise: about a millimetre in this near scene.
    assert 1e-4 < np.median(frame.sigma) < 3e-3
