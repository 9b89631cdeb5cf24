"""Cameras: rays and projection invert each other, OpenCV agrees, range and z depth convert."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tofuse.engine.cameras.cameras import (
    BrownConrady,
    Camera,
    Fisheye,
    Pinhole,
    Rational,
    RayTable,
    ray_lengths,
    scaled,
)
from tofuse.engine.cameras.depth_conversion import points_from_z, range_from_z, z_from_range
from tofuse.engine.errors import InputError
from tofuse.engine.geometry.rays import homogeneous, unit_rays
from tofuse.engine.views.projection import Projection

PINHOLE = Pinhole(176, 144, 230.0, 231.0, 87.0, 71.5)
BROWN = BrownConrady(176, 144, 230.0, 231.0, 87.0, 71.5, -0.3, 0.1, 0.001, -0.002, 0.01)
RATIONAL = Rational(
    640, 576, 504.0, 504.5, 320.0, 330.0, 5.2, 3.6, -8e-5, 1e-4, 0.19, 5.5, 5.4, 1.0
)
FISHEYE = Fisheye(224, 172, 110.0, 110.0, 111.0, 86.0, 0.02, -0.01, 0.001, 0.0)


def table(camera: Pinhole) -> RayTable:
    return RayTable(camera.rays())


CAMERAS: list[Camera] = [PINHOLE, BROWN, RATIONAL, FISHEYE, table(PINHOLE), table(BROWN)]


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: f"{type(c).__name__}-{c.width}")
def test_projected_rays_give_pixels(camera: Camera) -> None:
    rays = camera.rays()
    assert rays.shape == (camera.height, camera.width, 2)
    assert rays.dtype == np.float32
    assert not rays.flags.writeable
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    error = np.abs(camera.project(homogeneous(rays) * 2.5) - np.stack([u, v], -1))
    assert np.isfinite(rays).all()
    assert error.max() < 1e-3


def test_unit_rays_point_where_rays_do() -> None:
    rays = FISHEYE.rays()
    unit = unit_rays(rays)
    np.testing.assert_allclose(np.linalg.norm(unit, axis=-1), 1, rtol=1e-12)
    np.testing.assert_allclose(unit[..., :2] / unit[..., 2:], rays, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(unit[..., 2] * ray_lengths(FISHEYE), 1, rtol=1e-6)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: f"{type(c).__name__}-{c.width}")
def test_points_behind_camera_project_to_nan(camera: Camera) -> None:
    uv = camera.project([[0.1, 0.1, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.isnan(uv[:2]).all()
    assert np.isfinite(uv[2]).all()


@pytest.mark.parametrize("camera", [BROWN, RATIONAL])
def test_distortion_matches_opencv(camera: BrownConrady) -> None:
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    names = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]
    coefficients = np.array([getattr(camera, n, 0.0) for n in names])
    points = np.random.default_rng(0).uniform([-0.3, -0.25, 1], [0.3, 0.25, 1.5], (200, 3))
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, coefficients)[0][:, 0]
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-6)


def test_fisheye_matches_opencv() -> None:
    K = np.array([[FISHEYE.fx, 0, FISHEYE.cx], [0, FISHEYE.fy, FISHEYE.cy], [0, 0, 1]])
    D = np.array([FISHEYE.k1, FISHEYE.k2, FISHEYE.k3, FISHEYE.k4])
    points = np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 1.5], (200, 3))
    expected = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, D)[0][:, 0]
    np.testing.assert_allclose(FISHEYE.project(points), expected, atol=1e-6)


def test_unreachable_pixels_are_nan() -> None:
    # Strong barrel distortion folds over: no ray reaches the corners of the image.
    rays = BrownConrady(176, 144, 100.0, 100.0, 87.5, 71.5, -0.5).rays()
    assert np.isnan(rays[0, 0]).all()
    np.testing.assert_allclose(rays[72, 88], [0.005, 0.005], rtol=1e-3)


@pytest.mark.parametrize(
    "camera",
    [
        BrownConrady(640, 480, 400.0, 400.0, 319.5, 239.5, -0.35),
        BrownConrady(640, 480, 400.0, 400.0, 319.5, 239.5, -0.45, 0.05),
        Fisheye(640, 480, 180.0, 180.0, 319.5, 239.5, -0.2),
    ],
    ids=["brown", "brown-2", "fisheye"],
)
def test_lenses_end_where_their_distortion_folds_back(camera: Pinhole) -> None:
    # By brute force: how far from the principal point the lens shows rays, in focal lengths.
    slopes = np.linspace(0, 5, 50_001)
    along_row = np.stack([slopes, 0 * slopes, np.ones_like(slopes)], -1)
    shown = (camera.project(along_row)[:, 0] - camera.cx) / camera.fx
    last = int(np.nanargmax(shown))
    assert np.isnan(shown[slopes > 1.01 * slopes[last]]).all()  # not back into the image
    assert (np.diff(shown[: last - 20]) > 0).all()
    rays = camera.rays().astype(float)
    v, u = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack([u - camera.cx, v - camera.cy], -1) / camera.fx
    known, distance = np.isfinite(rays).all(-1), np.linalg.norm(pixels, axis=-1)
    np.testing.assert_array_equal(known[distance < shown[last] - 1e-4], True)
    np.testing.assert_array_equal(known[distance > shown[last] + 1e-4], False)
    assert ((rays * pixels).sum(-1)[known] > 0).all()  # each on its pixel's side
    assert np.linalg.norm(rays[known], axis=-1).max() < 1.01 * slopes[last]


def test_equal_ray_tables_share_cache_entry() -> None:
    rays = np.array(PINHOLE.rays())
    rays[0, 0], rays[3, 3] = np.nan, 0.0
    other = rays.copy()
    other[3, 3] = -0.0
    kept = {RayTable(rays): "kept"}
    assert kept.get(RayTable(other)) == "kept"
    other[0, 1] = np.nan
    assert kept.get(RayTable(other)) is None


@given(st.floats(0.2, 12), st.integers(0, 175), st.integers(0, 143))
def test_eqs_2_3_to_2_5(radial_range: float, column: int, row: int) -> None:
    depth = np.zeros((144, 176), np.float32)
    depth[row, column] = radial_range
    z = z_from_range(PINHOLE, depth)
    X, Y = column - PINHOLE.cx, row - PINHOLE.cy
    # The thesis's formula with one focal length f and square pixels of size d = 1.
    fx, fy = PINHOLE.fx, PINHOLE.fy
    expected_z = radial_range / np.sqrt(1 + (X / fx) ** 2 + (Y / fy) ** 2)
    point = points_from_z(PINHOLE, z)[row, column]
    np.testing.assert_allclose(point, expected_z * np.array([X / fx, Y / fy, 1]), rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(point), radial_range, rtol=1e-5)
    np.testing.assert_allclose(range_from_z(PINHOLE, z), depth, rtol=1e-5)
    assert np.count_nonzero(z) == 1


def test_ray_table_keeps_rays_and_tolerates_holes() -> None:
    rays = BROWN.rays().copy()
    rays[10:12, 20:30] = np.nan
    camera = RayTable(rays)
    np.testing.assert_array_equal(camera.rays(), rays)
    uv = camera.project([[rays[50, 60, 0] * 3, rays[50, 60, 1] * 3, 3.0]])
    np.testing.assert_allclose(uv, [[60, 50]], atol=1e-3)
    assert abs(camera.fit.fx - BROWN.fx) < 10


@pytest.mark.parametrize("half_field", [0.9, 1.05])
def test_ray_tables_of_round_images_project_to_their_pixels(half_field: float) -> None:
    v, u = np.mgrid[0:192, 0:192] - 95.5  # equidistant: the pinhole fit is far off at the rim
    angle = np.hypot(u, v) / 86
    rays = np.stack([u, v], -1) * (np.tan(angle) / (86 * angle))[..., None]
    rays[angle > half_field] = np.nan
    known = np.isfinite(rays).all(-1)
    assert known.mean() < 0.8
    uv = RayTable(rays.astype(np.float32)).project(homogeneous(rays)[known])
    np.testing.assert_allclose(uv, np.argwhere(known)[:, ::-1], atol=0.01)
    view = Projection.of(RayTable(rays.astype(np.float32)), 1)
    uv = view.pixels(view.rays[np.isfinite(view.rays).all(-1)].astype(float))
    np.testing.assert_allclose(uv, np.argwhere(known)[:, ::-1], atol=0.1)


def test_scaling_keeps_rays_of_block_centres() -> None:
    rays, full = scaled(PINHOLE, 88, 72).rays(), PINHOLE.rays()
    blocks = full.reshape(72, 2, 88, 2, 2).mean((1, 3))
    np.testing.assert_allclose(rays, blocks, atol=1e-6)


@pytest.mark.parametrize(
    "change",
    [
        {"fx": float("nan")},
        {"cx": float("inf")},
        {"fy": -1.0},
        {"fx": 0.0},
        {"width": 0},
        {"height": 10**6},
        {"fx": "230"},
        {"fx": True},
    ],
)
def test_invalid_intrinsics_are_rejected(change: dict[str, object]) -> None:
    good: dict[str, object] = {
        "width": 176, "height": 144, "fx": 230.0, "fy": 230.0, "cx": 87.0, "cy": 71.0,
    }  # fmt: skip
    with pytest.raises(InputError, match="camera"):
        Pinhole(**{**good, **change})  # type: ignore[arg-type]


@pytest.mark.parametrize("shape", [(144, 176), (144, 176, 3), (1, 1, 2)])
def test_ray_tables_of_wrong_shape_are_rejected(shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match="rays"):
        RayTable(np.zeros(shape, np.float32))


def test_ray_table_without_rays_is_rejected() -> None:
    with pytest.raises(InputError, match="no finite rays"):
        RayTable(np.full((10, 10, 2), np.nan, np.float32))


@pytest.mark.parametrize("mirror", [(-1, 1), (1, -1)])
def test_mirrored_ray_tables_are_rejected(mirror: tuple[int, int]) -> None:
    rays = Pinhole(40, 30, 50.0, 50.0, 19.5, 14.5).rays() * np.array(mirror, np.float32)
    rays[:5] = np.nan
    with pytest.raises(InputError, match="mirror the image"):
        RayTable(rays)


def test_noisy_and_upside_down_ray_tables_are_accepted() -> None:
    rays = Pinhole(40, 30, 50.0, 50.0, 19.5, 14.5).rays()
    rng = np.random.default_rng(3)
    for sign in (1, -1):
        table = sign * rays + rng.normal(0, 0.004, rays.shape)
        table[rng.random(rays.shape[:2]) < 0.5] = np.nan
        assert RayTable(table.astype(np.float32)).width == 40
