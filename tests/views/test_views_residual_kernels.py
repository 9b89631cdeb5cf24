"""Normal equations of projective alignment, against their sums in NumPy and finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.alignment import step_kernels as steps
from tofuse.engine.cameras.cameras import BrownConrady, Pinhole
from tofuse.engine.geometry import rigid_motion_kernels as rigid_motions
from tofuse.engine.geometry import se3
from tofuse.engine.geometry.rays import homogeneous
from tofuse.engine.views import residual_kernels as kernels
from tofuse.engine.views.projection import Projection

CAMERA = Pinhole(24, 18, 30.0, 30.0, 11.5, 8.5)
LENS = BrownConrady(24, 18, 30.0, 30.0, 11.5, 8.5, k1=-0.15, k2=0.05)
NORMAL = np.array([0.1, -0.25, 0.6])  # a, b, c of the target's plane
SLOPES = np.array([0.8, -0.5])  # of its log albedo
UPPER6, UPPER7 = np.triu_indices(6), np.triu_indices(7)
ROBUST, SCALE_P = 3.5, 0.2
MOTION = se3.exp([0.02, -0.03, 0.01, 0.02, -0.015, 0.03])


def target(camera=CAMERA):
    """A slanted plane whose log albedo is linear in the rays."""
    rays = camera.rays()
    planes = np.empty((*rays.shape[:2], 4), np.float32)
    planes[..., :3] = NORMAL
    planes[..., 3] = rays @ NORMAL[:2] + NORMAL[2]
    albedo = np.empty((*rays.shape[:2], 3), np.float32)
    albedo[..., 0] = 1 + rays @ SLOPES
    albedo[..., 1:] = SLOPES
    variance = np.full(rays.shape[:2], 1e-6, np.float32)
    return planes, variance, albedo, Projection.of(camera, 1)


def source(n=60, noise=0.004, seed=1):
    """Points near the target's plane in the frame of MOTION's camera; noisy normals and albedo."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-0.25, 0.25, (n, 2))
    z = 1 / (xy @ NORMAL[:2] + NORMAL[2])
    there = np.concatenate([xy * z[:, None], z[:, None]], 1) + rng.normal(0, noise, (n, 3))
    points = se3.transform(se3.inverse(MOTION), there).astype(np.float32)
    normals = np.broadcast_to(NORMAL / np.linalg.norm(NORMAL), (n, 3)) @ MOTION[:3, :3]
    normals = normals + rng.normal(0, 0.02, (n, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    albedo = np.empty((n, 3), np.float32)
    albedo[:, 0] = 1 + xy @ SLOPES + rng.normal(0, 0.1, n)
    albedo[:, 1:] = SLOPES + rng.normal(0, 0.1, (n, 2))
    return points, normals, np.full(n, 0.003, np.float32), albedo


def packed(points, normals, sigma, albedo):
    """The source's points in the layout of the kernel."""
    z = points[:, 2:]
    slopes = albedo[:, 1:] / z
    third = -(slopes * points[:, :2]).sum(1, keepdims=True) / z
    columns = [points, normals, sigma[:, None] / z, albedo[:, :1], slopes, third]
    return np.concatenate(columns, 1).astype(np.float32)


def accumulate(view, of, T=MOTION, *, exposure=0.0, scale_g=1.0, scale_p=SCALE_P, slack=0.01,
               min_cosine=0.5, robust=ROBUST, start=0, stop=None):  # fmt: skip
    planes, variance, albedo, projection = of
    points = (view if isinstance(view, np.ndarray) else packed(*view))[start:stop]
    image = kernels.make_target(kernels.ViewImages(projection.rays, planes, variance, albedo))
    seen = kernels.TargetImage(image, projection.lookup, projection.frame)
    residuals = kernels.Residuals(exposure, scale_g, scale_p, slack, robust, min_cosine)
    return kernels.accumulate(points, seen, np.ascontiguousarray(T), residuals)


def photometric_row(slopes, p, R=None, moved=None):
    """Jacobian (7,) of the albedo residual at `moved`, for the right perturbation and exposure."""
    q = p if moved is None else moved
    d = np.array([slopes[0], slopes[1], -(slopes @ q[:2]) / q[2]]) / q[2]
    m = d if R is None else R.T @ d
    return np.concatenate([m, np.cross(p, m), [-1.0]])


def twin(view, of, T=MOTION, exposure=0.0, slack=0.01):
    """The same sums, point by point, with plane and albedo at the exact projection."""
    out = {"H": np.zeros((6, 6)), "g": np.zeros(6), "C": np.zeros((6, 6)), "HP": np.zeros((7, 7)),
           "gP": np.zeros(7), "CP": np.zeros((7, 7)), "squares": 0.0, "weight": 0.0, "metres": 0.0,
           "weight_p": 0.0, "squares_p": 0.0, "inliers": 0}  # fmt: skip
    n_target = NORMAL / np.linalg.norm(NORMAL)
    R = T[:3, :3]
    for p, s, sigma, light in zip(*(a.astype(float) for a in view), strict=True):
        q = R @ p + T[:3, 3]
        r = (NORMAL @ q - 1) / np.linalg.norm(NORMAL)
        m = R.T @ n_target
        variance = (m @ p / p[2] * sigma) ** 2 + 1e-6 / (NORMAL @ NORMAL) + slack**2
        if r * r / variance >= ROBUST**2:
            continue
        weight = (1 - r * r / variance / ROBUST**2) ** 2
        J = np.concatenate([m, np.cross(p, m)])
        K = np.concatenate([s, np.cross(p, s)])
        middle = (J + K) / 2
        out["H"] += weight / variance * np.outer(middle, middle)
        out["g"] += weight / variance * middle * r
        out["C"] += weight / variance * (np.outer(J, K) + np.outer(K, J)) / 2
        out["squares"] += weight * r * r / variance
        out["weight"] += weight
        out["metres"] += r * r
        out["inliers"] += 1
        rp = 1 + SLOPES @ (q[:2] / q[2]) - light[0] - exposure
        e2 = (rp / SCALE_P) ** 2
        if e2 >= ROBUST**2:
            continue
        weight = (1 - e2 / ROBUST**2) ** 2
        J = photometric_row(SLOPES, p, R, q)
        K = photometric_row(light[1:], p)
        out["CP"] += weight / SCALE_P**2 * (np.outer(J, K) + np.outer(K, J)) / 2
        J[:6] = (J[:6] + K[:6]) / 2
        out["HP"] += weight / SCALE_P**2 * np.outer(J, J)
        out["gP"] += weight / SCALE_P**2 * J * rp
        out["weight_p"] += weight
        out["squares_p"] += weight * rp * rp
    return out


@pytest.mark.parametrize("exposure", [0.0, 0.3])
def test_sums_match_numpy(exposure):
    view, of = source(noise=0.015), target()
    got, want = accumulate(view, of, exposure=exposure), twin(view, of, exposure=exposure)
    assert got[kernels.PROJECTED] == got[kernels.COMPARED] == 60
    assert got[kernels.INLIERS] == want["inliers"] > 30
    H, g, C = kernels.normal_equations(got)
    for matrix in (want["HP"], want["CP"]):
        matrix[:6, :6] += want["H"] if matrix is want["HP"] else want["C"]
    want["gP"][:6] += want["g"]
    pairs = [
        (H[UPPER7], want["HP"][UPPER7]),
        (g, want["gP"]),
        (C[UPPER7], want["CP"][UPPER7]),
        (got[kernels.SQUARES_G], want["squares"]),
        (got[kernels.WEIGHT_G], want["weight"]),
        (got[kernels.SQUARES_M], want["metres"]),
        (got[kernels.WEIGHT_P], want["weight_p"]),
        (got[kernels.SQUARES_P], want["squares_p"]),
    ]
    for found, wanted in pairs:
        np.testing.assert_allclose(found, wanted, rtol=2e-3, atol=2e-4 * np.abs(wanted).max())


@pytest.mark.parametrize("step", [1, 2])
@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_points_project_onto_their_pixels(camera, step):
    """Each pixel's own point is compared with that pixel: a different depth in each."""
    rays = camera.rays()[::1, ::1]
    if step == 2:
        rays = rays.reshape(9, 2, 12, 2, 2).mean((1, 3)).astype(np.float32)
    rows, columns = rays.shape[:2]
    w = 1 / (1 + np.arange(rows * columns, dtype=np.float32).reshape(rows, columns) / 100)
    planes = np.zeros((rows, columns, 4), np.float32)
    planes[..., 2] = planes[..., 3] = w
    points = homogeneous(rays) / w[..., None]
    n = rows * columns
    ahead = np.tile(np.float32([0, 0, 1]), (n, 1))
    view = (points.reshape(n, 3).astype(np.float32), ahead,
            np.full(n, 1e-4, np.float32), np.full((n, 3), np.nan, np.float32))  # fmt: skip
    albedo = np.full((rows, columns, 3), np.nan, np.float32)
    of = (planes, np.full((rows, columns), 1e-8, np.float32), albedo, Projection.of(camera, step))
    sums = accumulate(view, of, np.eye(4), slack=0.0, robust=10.0)
    assert sums[kernels.INLIERS] == n
    assert sums[kernels.SQUARES_M] < 1e-9
    assert sums[kernels.COUNT_P] == 0


def test_incomparable_points_are_counted_separately():
    of = target()
    points = np.float32([
        [0, 0, 1 / 0.6],  # on the plane
        [0, 0, 1.0],  # in front of the surface
        [0, 0, 3.0],  # behind
        [0, 0, -1.0],  # behind the camera
        [5, 0, 1.0],  # out of view
    ])  # fmt: skip
    n = len(points)
    normals = np.tile(NORMAL.astype(np.float32) / np.linalg.norm(NORMAL), (n, 1))
    view = (points, normals, np.full(n, 0.003, np.float32),
            np.full((n, 3), np.nan, np.float32))  # fmt: skip
    sums = accumulate(view, of, np.eye(4))
    assert sums[kernels.PROJECTED] == 3
    assert sums[kernels.INLIERS] == 1
    assert sums[kernels.IN_FRONT] == 1
    of[0][8:10, 11:13] = 0  # no plane there
    sums = accumulate(view, of, np.eye(4))
    assert (sums[kernels.PROJECTED], sums[kernels.COMPARED]) == (3, 0)


def test_points_with_deviating_normals_are_no_inliers():
    view, of = list(source()), target()
    view[1][:30] = [1, 0, 0]
    sums = accumulate(view, of)
    assert sums[kernels.INLIERS] == 30


def test_sums_are_additive():
    view, of = source(), target()
    whole = accumulate(view, of)
    parts = accumulate(view, of, stop=25) + accumulate(view, of, start=25)
    np.testing.assert_allclose(parts, whole, rtol=1e-5, atol=1e-6 * np.abs(whole).max())


# --- small solvers -------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [0.0, 1e-6, 1e-3, 0.1, 1.0, 2.5])
def test_retract_is_exponential_map(size):
    rng = np.random.default_rng(5)
    T = se3.exp(rng.normal(size=6))
    xi = size * rng.normal(size=6) / np.sqrt(6)
    np.testing.assert_allclose(rigid_motions.retract(T, xi), T @ se3.exp(xi), atol=1e-9)


@pytest.mark.parametrize("size", [0.0, 1e-10, 1e-5, 0.01, 0.03, 1.0, 2.5])
def test_twist_between_is_logarithm(size):
    rng = np.random.default_rng(6)
    A = se3.exp(rng.normal(size=6))
    xi = size * rng.normal(size=6) / np.sqrt(6)
    B = A @ se3.exp(xi)
    np.testing.assert_allclose(rigid_motions.twist_between(A, B), xi, atol=1e-9)
    found = rigid_motions.distance_and_angle(A, B)
    wanted = np.linalg.norm(B[:3, 3] - A[:3, 3]), np.linalg.norm(xi[3:])
    np.testing.assert_allclose(found, wanted, atol=1e-12)


@pytest.mark.parametrize("photometric", [True, False])
def test_normal_equations_unpack_sums(photometric):
    rng = np.random.default_rng(7)
    J, D = rng.normal(size=(9, 8)), np.zeros((9, 8))
    D[:, :6] = rng.normal(size=(9, 6))
    if not photometric:
        J[:, 6] = 0
    total = np.zeros(kernels.SIZE)
    total[kernels.PRODUCTS :][:36] = (J.T @ J)[np.triu_indices(8)]
    total[kernels.DIFFERENCES :][:21] = (D.T @ D)[UPPER6]
    H, g, C = kernels.normal_equations(total)
    wanted = (J.T @ J)[:7, :7]
    np.testing.assert_allclose(C, wanted - (D.T @ D)[:7, :7], atol=1e-12)
    np.testing.assert_allclose(g, J[:, :7].T @ J[:, 7], atol=1e-12)
    pose = wanted[:6, :6]
    if photometric:
        pose = np.linalg.inv(np.linalg.inv(wanted)[:6, :6])
    else:
        wanted[6, 6] = 1
    np.testing.assert_allclose(H, wanted, atol=1e-12)
    np.testing.assert_allclose(steps.information(total), pose, atol=1e-9)
    np.testing.assert_allclose(steps.cross_information(total), pose - (D.T @ D)[:6, :6], atol=1e-9)


@pytest.mark.parametrize("unheld", [0, 2])
def test_step_solves_normal_equations(unheld):
    """Weak directions follow the prediction alone, the others the data and the prior."""
    rng = np.random.default_rng(9)
    total = np.zeros(kernels.SIZE)
    J = rng.normal(size=(40, 8)) * ([1] * 7 + [0.01])
    total[kernels.PRODUCTS :][:36] = (J.T @ J)[np.triu_indices(8)]
    units, prior = np.array([0.01] * 3 + [0.02] * 3), np.full(6, 0.3)
    T = se3.exp(rng.normal(size=6))
    predicted = T @ se3.exp([0.02, -0.01, 0.03, 0.02, 0.01, -0.02])
    weak = np.linalg.qr(rng.normal(size=(6, 6)))[0][:unheld]
    after, step = steps.solve_step(total, T, predicted, weak, prior, units)
    np.testing.assert_allclose(after, T @ se3.exp(step[:6]), atol=1e-9)
    if unheld:
        left = se3.log(se3.inverse(predicted) @ after) / units
        np.testing.assert_allclose(weak @ left, 0, atol=0.05)
        return
    A, b = (J.T @ J)[:7, :7], J[:, :7].T @ J[:, 7]
    A[:6, :6] += np.eye(6) / 0.3**2
    b[:6] += se3.log(se3.inverse(predicted) @ T) / 0.3**2
    np.testing.assert_allclose(step, -np.linalg.solve(A, b), rtol=1e-9)


def test_degenerate_directions_have_little_information():
    basis = np.linalg.qr(np.random.default_rng(10).normal(size=(6, 6)))[0]
    units = np.array([0.01] * 3 + [0.02] * 3)
    cross = (basis * [0.1, 0.3, 0.9, 1.1, 5.0, 20.0]) @ basis.T / np.outer(units, units)
    found = steps.degenerate_directions(cross, units, 1.0)
    np.testing.assert_allclose(found.T @ found, basis[:, :3] @ basis[:, :3].T, atol=1e-9)
    assert steps.degenerate_directions(cross, units, 0.5).shape == (4, 6)
    assert steps.degenerate_directions(cross, units, 10.0).shape == (0, 6)


@pytest.mark.parametrize("sigma", [0.1, 1.0, 7.0])
def test_scale_estimate_matches_normal_deviates(sigma):
    """The scale of normally distributed distances is recovered."""
    view, of = list(source(3000, noise=0.0)), target()
    unit = NORMAL / np.linalg.norm(NORMAL)
    view[2][:] = 0.0
    off = sigma * np.sqrt(1e-6 / (NORMAL @ NORMAL)) * np.random.default_rng(11).normal(size=3000)
    view[0] += (off[:, None] * (MOTION[:3, :3].T @ unit)).astype(np.float32)
    found = steps.scale_of_distances(accumulate(view, of)[kernels.HISTOGRAM :])
    assert found == pytest.approx(sigma, rel=0.08)
    assert np.isnan(steps.scale_of_distances(np.zeros(kernels.BINS)))


def test_exposure_difference_is_measured_at_correspondences():
    view, of = list(source()), target()
    view[3][:, 0] -= 0.4
    view[3][5, 0] = np.nan
    projection = of[3]
    pixels = kernels.make_target(kernels.ViewImages(projection.rays, *of[:3]))
    seen = kernels.TargetImage(pixels, projection.lookup, projection.frame)
    found = kernels.exposure_differences(packed(*view), 2, seen, MOTION)
    assert len(found) == 30
    assert np.median(found) == pytest.approx(0.4, abs=0.05)


@pytest.mark.parametrize("stride", [1, 2, 3, 4])
def test_gather_samples_pixels_with_plane_at_stride(stride):
    planes, variance, albedo, _ = target()
    planes[3:9, 5:11] = 0
    variance[...] = np.random.default_rng(8).uniform(1e-6, 4e-6, variance.shape)
    rays = CAMERA.rays()
    points = kernels.sample_points(kernels.ViewImages(rays, planes, variance, albedo), stride)
    pick = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    w = planes[pick][..., 3]
    good = w > 0
    n = np.count_nonzero(good)
    assert points.shape == (n, kernels.POINT_SIZE)
    z = 1 / w[good]
    wanted = np.concatenate([rays[pick][good], np.ones((n, 1))], 1) * z[:, None]
    np.testing.assert_allclose(points[:, :3] @ NORMAL, 1, rtol=1e-5)
    unit = np.tile(NORMAL / np.linalg.norm(NORMAL), (n, 1))
    sigma = np.sqrt(variance[pick][good]) * z**2
    light = albedo[pick][good]
    np.testing.assert_allclose(points, packed(wanted, unit, sigma, light), rtol=1e-5, atol=1e-6)
