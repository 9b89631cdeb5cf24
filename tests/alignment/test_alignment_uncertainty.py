from dataclasses import replace

import numpy as np
import pytest

from ray_casting import rays_at, to_plane
from tofuse.engine.alignment import uncertainty
from tofuse.engine.alignment.projective import UNITS, ProjectiveOptions, Target, align
from tofuse.engine.alignment.step_kernels import spurious_information
from tofuse.engine.alignment.uncertainty import (
    Patches,
    UncertaintyOptions,
    bounded_by_prior,
    covariance,
    covariance_of_patches,
    patches,
)
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.residual_kernels import POINT_SIZE
from tofuse.engine.views.view_planes import SurfaceOptions

CAMERA = Pinhole(88, 72, 115.0, 115.0, 43.5, 35.5)
GEOMETRY_ONLY = ProjectiveOptions(photometric=False)
CORNER = ((0.0, 0.0, 1.0, 2.6), (0.8, 0.0, 0.6, 2.0), (0.0, 0.85, 0.53, 1.8))


def _depth(planes, T=None):
    """Depths (H, W) of planes n . X = d of the world, seen by a camera at T_world_camera."""
    rays = rays_at(np.eye(4) if T is None else T, CAMERA)
    return np.min([to_plane(*rays, n / np.linalg.norm(n), d) for *n, d in planes], 0)


def _view(index, planes, T=None, *, sigma=0.004, bend=None, light=None):
    rng = np.random.default_rng([5, index])
    depth = _depth(planes, T) + sigma * rng.normal(size=(CAMERA.height, CAMERA.width))
    if bend is not None:
        depth = depth + bend
    frame = RangeFrame(
        index, index / 30, CAMERA, depth.astype(np.float32), "z", light, amplitude_kind="raw"
    )
    return prepare_view(frame, SurfaceOptions())


def _aligned(source, target, T):
    targets = [Target(target, np.eye(4))]
    return targets, align(source, targets, T, GEOMETRY_ONLY)


def _sigmas(C):
    return np.sqrt(np.diag(C)) / UNITS


@pytest.fixture(scope="module")
def corner_errors():
    """Whitened errors (N, 6) of a corner with noise only, by two covariances."""
    T = se3.exp([0.004, -0.003, 0.005, 0.002, -0.003, 0.002])
    ours, plain = [], []
    for k in range(40):
        target, source = _view(2 * k, CORNER), _view(2 * k + 1, CORNER, T)
        targets, aligned = _aligned(source, target, T)
        error = se3.log(se3.inverse(aligned.T_world_source) @ T)
        for C, out in (
            (covariance(source, targets, aligned, GEOMETRY_ONLY), ours),
            (np.linalg.inv(aligned.information), plain),
        ):
            values, vectors = np.linalg.eigh(C / np.outer(UNITS, UNITS))
            out.append(vectors.T @ (error / UNITS) / np.sqrt(values))
    return np.array(ours), np.array(plain)


def test_covariance_covers_errors_of_noise(corner_errors):
    ours, _ = corner_errors
    assert np.mean(np.abs(ours) < 1.96) > 0.88
    # Not so wide as to be useless.
    assert np.sqrt(np.mean(ours**2)) > 0.3


def test_inconsistent_patches_increase_covariance():
    T = se3.exp([0.01, 0, 0, 0, 0.01, 0])
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    bend = 0.02 * np.sin(2 * np.pi * u / 44) * np.sin(2 * np.pi * v / 36)
    found = []
    for shape in (None, bend):
        target, source = _view(0, CORNER), _view(1, CORNER, T, bend=shape)
        targets, aligned = _aligned(source, target, T)
        found.append(_sigmas(covariance(source, targets, aligned, GEOMETRY_ONLY)))
    assert (found[1] > 1.5 * found[0]).sum() >= 3


def test_hidden_errors_grow_with_change_of_view():
    steps = [se3.exp(np.array([0.02, 0, 0, 0, 0.03, 0]) * k) for k in (0, 1, 3)]
    found = []
    for T in steps:
        target, source = _view(0, CORNER), _view(1, CORNER, T)
        targets, aligned = _aligned(source, target, T)
        found.append(_sigmas(covariance(source, targets, aligned, GEOMETRY_ONLY)))
    assert (found[0] < found[1]).all()
    assert (found[1] < found[2]).all()


def test_degenerate_directions_of_wall_have_prior_uncertainty():
    wall = [(0.0, 0.0, 1.0, 2.0)]
    target, source = _view(0, wall), _view(1, wall)
    targets, aligned = _aligned(source, target, np.eye(4))
    C = covariance(source, targets, aligned, GEOMETRY_ONLY)
    sigma = np.sqrt(np.diag(C))
    assert len(aligned.unobservable) == 3
    np.testing.assert_allclose(sigma[[0, 1]], GEOMETRY_ONLY.prior_m, rtol=0.1)
    np.testing.assert_allclose(sigma[5], GEOMETRY_ONLY.prior_rad, rtol=0.1)
    assert sigma[2] < 0.005
    assert (np.linalg.eigvalsh(C) > 0).all()


def _made_patches(means, weights, change=0.0):
    rng = np.random.default_rng(3)
    n = len(means)
    places = np.stack([np.arange(n) % 8, np.arange(n) // 8], -1) / 8
    J = np.concatenate([rng.normal(size=(n, 6)), np.zeros((n, 1))], 1)
    H = (J * weights[:, None]).T @ J
    return Patches(
        H, np.zeros((7, 7)), H, H, places, weights, means, J * weights[:, None], change, 2.0, 2
    )


def test_residuals_near_limit_do_not_inflate_uncertainty(monkeypatch):
    """The slope of the robust weights may vanish there, and have any sign."""
    found = _made_patches(np.zeros(48), np.full(48, 1e2))
    steep = _sigmas(covariance_of_patches(found, UncertaintyOptions()))
    values, vectors = np.linalg.eigh(found.cross[:6, :6])
    cross = found.cross.copy()
    cross[:6, :6] -= 1.01 * values[0] * np.outer(vectors[:, 0], vectors[:, 0])
    found = replace(found, cross=cross)
    flat = _sigmas(covariance_of_patches(found, UncertaintyOptions()))
    assert (flat >= 0.99 * steep).all()
    assert 1.5 < (flat / steep).max() < 3.5  # not above 1 / 0.3
    monkeypatch.setattr(uncertainty, "_STEEPNESS", 1e-9)
    unbounded = _sigmas(covariance_of_patches(found, UncertaintyOptions()))
    assert (unbounded / steep).max() > 10


@pytest.mark.parametrize("information", [-0.1, 0.0, 0.001, 0.1])
def test_less_information_never_reduces_sigma(information):
    """Also where the cross information is negative, because noise dominates the normals."""
    diagonal = np.array([100.0, 100.0, information, 100.0, 100.0, 100.0, 1.0])
    H = np.diag(np.maximum(diagonal, 0.0))
    nothing = np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros((0, 7))
    found = Patches(H, np.zeros((7, 7)), np.diag(diagonal), np.diag(diagonal), *nothing, 0, 2.0, 3)
    sigma = _sigmas(covariance_of_patches(found, UncertaintyOptions()))
    assert 0.9 * uncertainty._MAX_SIGMA < sigma[2] < 1.1 * uncertainty._MAX_SIGMA
    np.testing.assert_allclose(sigma[[0, 1, 3, 4, 5]], 0.1, rtol=1e-3)


def test_uncertainty_is_bounded_by_prediction():
    prior = np.array([0.3] * 3 + [0.2] * 3)
    turned = se3.exp(np.array([0.0, 0, 0, 0.4, -0.3, 0.2]))[:3, :3]
    axes = np.kron(np.eye(2), turned)
    known = axes @ np.diag([1e-6, 1e-5, 1e-4, 1e-6, 1e-5, 1e-4]) @ axes.T
    np.testing.assert_array_equal(bounded_by_prior(known, prior), known)
    cut = bounded_by_prior(known + 36.0 * np.outer(axes[:, 1], axes[:, 1]), prior)
    np.testing.assert_allclose(axes[:, 1] @ cut @ axes[:, 1], 0.09, rtol=1e-4)
    for k in (0, 2, 3, 4, 5):
        np.testing.assert_allclose(axes[:, k] @ cut @ axes[:, k], axes[:, k] @ known @ axes[:, k])


def test_spurious_information_matches_random_tilts():
    rng = np.random.default_rng(6)
    points = rng.uniform([-1, -1, 1], [1, 1, 3], (300, 3)).astype(np.float32)
    normals = rng.normal(size=(300, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    tilt, slope, sigma, slack, photo_sigma = 0.03, 0.1, 0.005, 0.004, 0.2
    rows = np.zeros((300, POINT_SIZE), np.float32)
    rows[:, :3], rows[:, 3:6], rows[:, 6] = points, normals, sigma / points[:, 2]
    rows[::3, 7] = np.nan  # no albedo
    found = spurious_information(rows, 1, 1.5, slack, photo_sigma**2, tilt, slope)
    along = (points * normals).sum(1) / points[:, 2]
    variance = 2 * (along * 1.5 * sigma) ** 2 + slack**2
    lit = np.isfinite(rows[:, 7])
    total = np.zeros((6, 6))
    rounds = 300
    for _ in range(rounds):
        off = tilt * rng.normal(size=(300, 3))
        off -= (off * normals).sum(1, keepdims=True) * normals
        sloped = slope * rng.normal(size=(300, 3)) / points[:, 2:]
        sloped[:, 2] = -(sloped[:, :2] * points[:, :2]).sum(1) / points[:, 2]
        for m, per in ((off, 1 / variance), (sloped, lit / photo_sigma**2)):
            J = np.concatenate([m, np.cross(points, m)], 1)
            total += (J * per[:, None]).T @ J / rounds / 300
    np.testing.assert_allclose(found, total, atol=0.02 * np.abs(total).max())


def test_common_tilts_do_not_constrain_wall():
    """A wall with the same distortion by the camera in every view still slides."""
    wall = [(0.0, 0.0, 1.0, 2.0)]
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    bow = 0.01 * (((u - 43.5) / 44) ** 2 + ((v - 35.5) / 36) ** 2)
    target, source = (_view(k, wall, bend=bow, sigma=0.002) for k in range(2))
    targets = [Target(target, np.eye(4))]
    fooled = ProjectiveOptions(photometric=False, common_tilt=0.0, common_slope=0.0)
    assert len(align(source, targets, np.eye(4), fooled).unobservable) < 3
    aligned = align(source, targets, np.eye(4), GEOMETRY_ONLY)
    assert len(aligned.unobservable) == 3
    assert patches(source, targets, aligned, GEOMETRY_ONLY).change < 0.01
