"""Plane fits, halving and slopes of range images, against slow NumPy references."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from tofuse.engine.cameras.cameras import BrownConrady, Pinhole
from tofuse.engine.geometry.rays import homogeneous
from tofuse.engine.views.view_planes_kernels import (
    albedo_image,
    fit_planes,
    halve,
    smooth_and_slope,
)

CAMERA = Pinhole(40, 30, 45.0, 45.0, 19.5, 14.5)
LENS = BrownConrady(40, 30, 45.0, 45.0, 19.5, 14.5, k1=-0.2, k2=0.05, p1=0.01, p2=-0.005)
A, B, C = 0.12, -0.2, 0.5  # a X + b Y + c Z = 1, about 2 m away


def plane_w(rays, a=A, b=B, c=C):
    return (a * rays[..., 0] + b * rays[..., 1] + c).astype(np.float32)


def fit(w, rays, weight, radii=(2, 5), limit=1e-6, fill=0.7, offset=0.2):
    planes = np.full((*w.shape, 4), 7, np.float32)
    quality = np.full((*w.shape, 2), 7, np.float32)
    for start, stop in ((0, 11), (11, w.shape[0])):
        fit_planes(
            w, rays, weight, weight > -1, np.array(radii), limit, fill, offset,
            planes, quality, start, stop,
        )  # fmt: skip
    return planes, quality


# --- halve ---------------------------------------------------------------------------------------


def halve_twin(z, value, variance, jump):
    rows, columns = z.shape[0] // 2, z.shape[1] // 2
    z_out, value_out, variance_out = np.zeros((3, rows, columns))
    for i, j in itertools.product(range(rows), range(columns)):
        block = z[2 * i : 2 * i + 2, 2 * j : 2 * j + 2].ravel().astype(float)
        amount = value[2 * i : 2 * i + 2, 2 * j : 2 * j + 2].ravel().astype(float)
        spread = variance[2 * i : 2 * i + 2, 2 * j : 2 * j + 2].ravel().astype(float)
        amount, spread, block = amount[block > 0], spread[block > 0], block[block > 0]
        if len(block):
            middle = np.sort(block)[min(1, len(block) - 1)]
            near = np.abs(block - middle) <= jump * middle
            z_out[i, j] = 1 / np.mean(1 / block[near])
            for out, numbers in ((value_out, amount[near]), (variance_out, spread[near])):
                if numbers.any():
                    out[i, j] = numbers[numbers > 0].mean()
            variance_out[i, j] /= near.sum()
    return z_out, value_out, variance_out


def halved(z, value, variance=None, jump=0.02):
    out = np.full((3, z.shape[0] // 2, z.shape[1] // 2), 7, np.float32)
    for start, stop in ((0, 3), (3, out.shape[1])):
        halve(z, value, value if variance is None else variance, jump, *out, start, stop)
    return out


@pytest.mark.parametrize("unknown", [0.0, 0.3])
@pytest.mark.parametrize("shape", [(20, 16), (21, 17)])
def test_halving_matches_slow_twin(shape, unknown):
    rng = np.random.default_rng(1)
    z = rng.choice([0, 1.0, 1.5, 1.51, 3], shape).astype(np.float32)
    z += np.where(z > 0, rng.uniform(0, 0.01, shape), 0).astype(np.float32)
    value, variance = rng.uniform(1, 9, (2, *shape)).astype(np.float32)
    for image in (value, variance):
        image[rng.random(shape) < unknown] = 0
    twin = halve_twin(z, value, variance, 0.02)
    for found, wanted in zip(halved(z, value, variance), twin, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-6)


# --- planes --------------------------------------------------------------------------------------


@pytest.mark.nightly
def test_pixels_without_weight_are_ignored_even_with_unknown_rays():
    rays = CAMERA.rays().copy()
    w, weight = plane_w(rays), np.ones(rays.shape[:2], np.float32)
    weight[4, 4] = 0
    whole, _ = fit(w, rays, weight)
    rays[4, 4] = w[4, 4] = np.nan
    holed, _ = fit(w, rays, weight)
    np.testing.assert_array_equal(holed, whole)
    assert (holed[4, 5:8, 3] > 0).all()


def twin_of_one_fit(w, rays, weight, i, j, r):
    """Weighted least squares over one window: coefficients, value at the pixel, its variance."""
    s = np.s_[max(i - r, 0) : i + r + 1, max(j - r, 0) : j + r + 1]
    g = np.sqrt(weight[s].astype(float).ravel())
    X = np.concatenate([rays[s].astype(float), np.ones((*w[s].shape, 1))], -1).reshape(-1, 3)
    found = np.linalg.lstsq(X * g[:, None], w[s].astype(float).ravel() * g, rcond=None)[0]
    here = np.append(rays[i, j].astype(float), 1)
    inverse = np.linalg.inv((X * g[:, None] ** 2).T @ X)
    left_over = (g**2 * (w[s].ravel() - X @ found) ** 2).sum() / (np.count_nonzero(g) - 3)
    return found, here @ found, here @ inverse @ here, left_over


def test_depth_is_fitted_in_smallest_and_slope_in_widest_window():
    rng = np.random.default_rng(3)
    rays = LENS.rays()
    weight = rng.uniform(0.5e6, 2e6, rays.shape[:2]).astype(np.float32)
    w = plane_w(rays) + (rng.normal(size=weight.shape) / np.sqrt(weight)).astype(np.float32)
    planes, quality = fit(w, rays, weight, limit=100.0)
    for i, j in ((8, 9), (15, 20), (20, 30)):
        wide = twin_of_one_fit(w, rays, weight, i, j, 5)
        small = twin_of_one_fit(w, rays, weight, i, j, 2)
        np.testing.assert_allclose(planes[i, j, :2], wide[0][:2], rtol=1e-3, atol=1e-5)
        assert planes[i, j, 3] == pytest.approx(small[1], rel=1e-6)
        assert planes[i, j, :2] @ rays[i, j] + planes[i, j, 2] == pytest.approx(small[1], rel=1e-5)
        assert quality[i, j, 1] == pytest.approx(small[2], rel=1e-4)
        assert quality[i, j, 0] == pytest.approx(small[3], rel=1e-3)


def test_depth_edges_are_not_bridged():
    rays = CAMERA.rays()
    near = np.arange(40) < 20
    w = np.where(near, 1.0, 0.5).astype(np.float32)[None].repeat(30, 0)
    weight = np.full(w.shape, 1e6, np.float32)
    planes, _ = fit(w, rays, weight, limit=1.0)
    # Windows that cross the edge have no plane; the others are exact.
    assert (planes[5:-5, 18:22, 3] == 0).all()
    np.testing.assert_allclose(planes[5:-5, 3:17, 3], 1.0, rtol=1e-5)
    np.testing.assert_allclose(planes[5:-5, 23:-3, 3], 0.5, rtol=1e-5)
    assert (np.abs(planes[5:-5, :, :2])[planes[5:-5, :, 3] > 0] < 1e-4).all()


def test_creases_are_not_bridged_by_wide_windows():
    rays = CAMERA.rays()
    left, right = plane_w(rays, 0.6, 0, 0.5), plane_w(rays, -0.6, 0, 0.5)
    w = np.where(rays[..., 0] < 0, left, right)
    weight = np.full(w.shape, 1 / 0.002**2, np.float32)
    planes, _ = fit(w, rays, weight, limit=1.2)
    # The wide window, halfway across the crease, fits worse than the noise: the small one is kept.
    np.testing.assert_allclose(planes[8:-8, 15:17, 0], 0.6, atol=1e-3)
    np.testing.assert_allclose(planes[8:-8, 23:25, 0], -0.6, atol=1e-3)


def test_pixels_at_outlines_are_dropped():
    rays = CAMERA.rays()
    w = plane_w(rays)
    weight = np.full(w.shape, 1e6, np.float32)
    weight[:, 20:] = 0
    planes, quality = fit(w, rays, weight, limit=1.0)
    assert (planes[:, 20:] == 0).all()
    assert np.isnan(quality[:, 20:, 0]).all()
    assert (planes[5:-5, 19] == 0).all(), "its window is mostly on one side"
    assert (planes[5:-5, 10:17, 3] > 0).all()
    loose, _ = fit(w, rays, weight, limit=1.0, fill=0.1, offset=5.0)
    assert (loose[5:-5, 19, 3] > 0).all(), "only the two limits drop them"


def test_pixel_off_its_neighbours_plane_has_no_plane():
    rays = CAMERA.rays()
    w = plane_w(rays)
    weight = np.full(w.shape, 1e6, np.float32)
    w[15, 20] += 0.006  # 6 sigmas; of 25 pixels, that leaves the window's misfit within limits
    planes, _ = fit(w, rays, weight, limit=1.2)
    assert planes[15, 20, 3] == 0
    assert planes[15, 23, 3] > 0


# --- albedo --------------------------------------------------------------------------------------


@pytest.mark.parametrize("falloff", [0.0, 4.0])
@pytest.mark.parametrize("power", [0.0, 2.0])
@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_lambertian_plane_has_uniform_albedo(power, camera, falloff):
    rays = camera.rays().astype(float)
    w = plane_w(rays).astype(float)
    direction = homogeneous(rays)
    length = np.linalg.norm(direction, axis=-1)
    cosine = (direction @ [A, B, C]) / length / np.linalg.norm([A, B, C])
    distance = length / w
    light = 0.4 * cosine / distance**power
    light = (light / length**falloff).astype(np.float32)
    planes = np.broadcast_to(np.float32([A, B, C, 0]), (*w.shape, 4)).copy()
    planes[..., 3] = w
    planes[3, 4] = 0
    light[5, 6] = 0
    light[5, 7] = np.nan
    out = np.zeros(w.shape, np.float32)
    albedo_image(planes, camera.rays(), light, power > 0, True, falloff, out)
    holes = np.zeros(w.shape, bool)
    holes[[3, 5, 5], [4, 6, 7]] = True
    np.testing.assert_array_equal(np.isnan(out), holes)
    np.testing.assert_allclose(out[~holes], np.log(0.4), atol=1e-5)


def test_surface_at_grazing_incidence_has_no_albedo():
    rays = CAMERA.rays()
    planes = np.zeros((*rays.shape[:2], 4), np.float32)
    planes[..., 0], planes[..., 2] = 10.0, 1.0  # nearly contains the optical axis
    planes[..., 3] = np.maximum(plane_w(rays, 10, 0, 1), 0)
    out = np.zeros(rays.shape[:2], np.float32)
    albedo_image(planes, rays, np.ones(out.shape, np.float32), False, True, 0.0, out)
    assert np.isnan(out[15, 20])
    assert np.isfinite(out[15, 39])


# --- slopes --------------------------------------------------------------------------------------


def smoothed(image, planes, rays, radius=1, jump=0.05):
    out = np.zeros((*image.shape, 3), np.float32)
    for start, stop in ((0, 13), (13, image.shape[0])):
        smooth_and_slope(image, planes, rays, radius, jump, out, start, stop)
    return out


def flat(rays, w=0.5):
    planes = np.zeros((*rays.shape[:2], 4), np.float32)
    planes[..., 2] = planes[..., 3] = w
    return planes


@pytest.mark.parametrize("radius", [0, 1, 2])
@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_ramp_has_its_slope(camera, radius):
    rays = camera.rays()
    image = (0.7 + 3 * rays[..., 0] - 2 * rays[..., 1]).astype(np.float32)
    out = smoothed(image, flat(rays), rays, radius)
    h = radius + 1
    inside = out[h:-h, h:-h]
    assert np.isnan(out[:h]).all()
    assert np.isnan(out[:, -h:]).all()
    # Box means of a distorted lens's rays equal those of the centre up to curvature.
    atol = 1e-4 if camera is CAMERA else 0.01
    np.testing.assert_allclose(inside[..., 0], image[h:-h, h:-h], atol=atol)
    np.testing.assert_allclose(inside[..., 1], 3, atol=5 * atol)
    np.testing.assert_allclose(inside[..., 2], -2, atol=5 * atol)


def test_slopes_do_not_cross_depth_edges_or_holes():
    rays = CAMERA.rays()
    planes = flat(rays)
    planes[:, 20:, 2:] = 1.0  # 1 m from here on, 2 m before
    image = np.where(np.arange(40) < 20, 0, 5).astype(np.float32)[None].repeat(30, 0)
    out = smoothed(image, planes, rays)
    assert np.isnan(out[:, 18:22]).all(), "the cross reaches two pixels"
    assert np.nanmax(np.abs(out[5:-5, 5:17, 1:])) == 0
    planes = flat(rays)
    planes[15, 20] = 0
    out = smoothed(np.zeros((30, 40), np.float32), planes, rays)
    assert np.isnan(out[15, [18, 20, 22]]).all()
    assert np.isnan(out[[13, 17], 20]).all()
    assert np.isfinite(out[14, 19]).all()


def test_holes_are_excluded_from_means():
    rays = CAMERA.rays()
    image = np.ones((30, 40), np.float32)
    image[10, 10] = np.nan
    out = smoothed(image, flat(rays), rays)
    assert np.isnan(out[10, 10]).all()
    np.testing.assert_allclose(out[10, 11], [1, 0, 0], atol=1e-6)
    # Nor do they shift the means: a ramp keeps its slope around them.
    image = (3 * rays[..., 0] - 2 * rays[..., 1]).astype(np.float32)
    ramp = image.copy()
    image[10, 10] = image[20, 25:27] = np.nan
    out = smoothed(image, flat(rays), rays)
    known = np.isfinite(out[..., 0])
    assert 0 < np.count_nonzero(known) < 26 * 36
    np.testing.assert_allclose(out[known][:, 0], ramp[known], atol=1e-5)
    assert np.abs(out[known][:, 1:] - [3, -2]).max() < 1e-4


def test_slanted_plane_is_not_an_edge():
    rays = CAMERA.rays()
    planes = np.zeros((30, 40, 4), np.float32)
    planes[..., :3] = 1.2, 0, 0.8  # by 5 % a pixel and more at the near side
    planes[..., 3] = plane_w(rays, 1.2, 0, 0.8)
    out = smoothed(np.ones((30, 40), np.float32), planes, rays, jump=0.02)
    assert np.isfinite(out[2:-2, 2:-2]).all()
