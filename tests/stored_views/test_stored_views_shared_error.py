"""Patch-correlated errors in a refinement: their sums, size, and effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aligned_surfaces import path
from corner_views import SHARP, corner, unpack
from pair_equations import pair_equations
from tofuse.engine.geometry import se3
from tofuse.engine.refinement.joint_alignment import refine
from tofuse.engine.stored_views import pair_equation_kernels as kernels
from tofuse.engine.stored_views import shared_error
from tofuse.engine.stored_views.pair_equation_kernels import marginalise_shared_errors
from tofuse.engine.stored_views.pair_equations import DirectedPairs, RefineOptions, Round
from tofuse.engine.stored_views.view_store import SampledView
from tofuse.engine.views.prepared_view import prepare_view

CUTOFF = 3.5
WIDE = (1.0, 50.0, 0.5)  # scale, robust limit (so wide that robust weights are 1), cosine


def view(frame) -> SampledView:
    return SampledView.of(prepare_view(frame, SHARP), 1500)


def bent(frame, rng, size: float):
    """The frame with depth errors that vary over some 15 pixels, different in each frame."""
    v, u = np.indices(frame.depth.shape) / 15.0
    waves = rng.standard_normal((4, 2))
    phase = rng.uniform(0, 2 * np.pi, 4)
    field = sum(np.sin(a * u + b * v + c) for (a, b), c in zip(waves, phase, strict=True))
    depth = frame.depth + size / np.sqrt(2.0) * field
    return replace(frame, depth=np.where(frame.depth > 0, depth, 0).astype(np.float32))


@pytest.fixture(scope="module")
def pair():
    T = se3.exp(np.array([0.06, -0.04, 0.05, 0.03, -0.04, 0.02]))
    near = T @ se3.exp(np.array([0.004, -0.003, 0.002, 0.002, 0.001, -0.002]))
    return view(corner(T)), view(corner(np.eye(4))), near


def sums_of(source, target, T):
    residuals = (0.0, WIDE[0], 0.0, 0.0, *WIDE[1:])
    row, sums = pair_equations(
        source.points, target, T, residuals, patches=source.patches, count=shared_error.PATCHES
    )
    return sums, row


def test_patches_divide_image_into_equal_cells(pair):
    source, _, _ = pair
    u, v = source.patches % shared_error.ACROSS, source.patches // shared_error.ACROSS
    x, y = (source.points[:, :2] / source.points[:, 2:3]).T
    assert set(u) == set(range(shared_error.ACROSS))
    assert set(v) == set(range(shared_error.DOWN))
    # Neighbouring cells do not overlap.
    for k in range(1, shared_error.ACROSS):
        assert x[u == k - 1].max() < x[u == k].min()
    for k in range(1, shared_error.DOWN):
        assert y[v == k - 1].max() < y[v == k].min()
    correlation = shared_error.patch_correlation(source.shape)
    np.testing.assert_array_equal(np.diag(correlation), 1)
    assert np.linalg.eigvalsh(correlation).min() > 0


def test_sums_of_patches_match_normal_equations(pair):
    source, target, T = pair
    sums, row = sums_of(source, target, T)
    H, g = unpack(row)
    response = sums[:, kernels.PATCH_RESPONSE :]
    # One patch for each point would give all of H; here only the mean of each patch counts.
    R = response / np.sqrt(np.maximum(sums[:, :1], 1e-12))
    assert np.linalg.eigvalsh(H[:6, :6] - R.T @ R).min() > -1e-6 * np.trace(H)
    middle = len(source.points) // 2
    one, row = sums_of(source.with_points(np.s_[middle : middle + 1]), target, T)
    H, g = unpack(row)
    (k,) = np.flatnonzero(one[:, kernels.PATCH_WEIGHT])
    weight, r, J = one[k, 0], one[k, 1] / one[k, 0], one[k, 2:] / one[k, 0]
    expected = weight * np.outer(J, J)
    np.testing.assert_allclose(H[:6, :6], expected, atol=1e-5 * np.abs(expected).max())
    np.testing.assert_allclose(g[:6], weight * r * J, atol=1e-5 * np.abs(weight * r * J).max())


def discount(sums, correlation, variance, row):
    which = np.array([0])
    variances = np.array([variance])
    marginalise_shared_errors(sums[None], correlation, variances, which, CUTOFF, row[None])


def test_kernel_eliminates_one_unknown_per_patch(pair):
    source, target, T = pair
    sums, row = sums_of(source, target, T)
    correlation, variance = shared_error.patch_correlation(target.shape), 0.004**2
    H, g = unpack(row.copy())
    # Reference by the full system: pose, then the errors of the patches with their prior.
    D, h, M = sums[:, 0], sums[:, 1], sums[:, 2:]
    big = np.diag(D) + np.linalg.inv(variance * correlation)
    H[:6, :6] -= M.T @ np.linalg.solve(big, M)
    g[:6] -= M.T @ np.linalg.solve(big, h)
    allowed = row.copy()
    discount(sums, correlation, variance, allowed)
    found_H, found_g = unpack(allowed)
    np.testing.assert_allclose(found_H, H, atol=1e-7 * np.abs(H).max())
    np.testing.assert_allclose(found_g, g, atol=1e-7 * np.abs(g).max())
    # What the errors explain is no loss of support: the slope of (1 - r^2 / c^2)^3 by r^2.
    explained = 3 / CUTOFF**2 * (h @ np.linalg.solve(big, h))
    assert allowed[kernels.SUPPORT] - row[kernels.SUPPORT] == pytest.approx(explained, rel=1e-7)
    # Counts are unchanged, and without errors everything is.
    counts = np.setdiff1d(np.arange(kernels.COMPARED, kernels.SIZE), kernels.SUPPORT)
    np.testing.assert_array_equal(allowed[counts], row[counts])
    same = row.copy()
    discount(sums, correlation, 0.0, same)
    np.testing.assert_allclose(same, row, rtol=1e-9, atol=1e-9 * np.abs(row).max())


@pytest.mark.parametrize("size", [0.0, 0.01])
def test_size_of_shared_errors_is_estimated_from_residuals(size):
    """It is zero for pixel noise only."""
    rng = np.random.default_rng(5)
    T = se3.exp(np.array([0.06, -0.04, 0.05, 0.03, -0.04, 0.02]))
    seen = []
    for _ in range(12):
        frames = []
        for pose in (T, np.eye(4)):
            frame = bent(corner(pose), rng, size)
            noise = 0.005 * rng.standard_normal(frame.depth.shape)
            frames.append(replace(frame, depth=(frame.depth + noise).astype(np.float32)))
        source, target = (view(frame) for frame in frames)
        sums, row = sums_of(source, target, T)
        correlation = shared_error.patch_correlation(target.shape)
        found = shared_error.disagreement(sums[None], row[None], correlation)
        seen.append((found.observed - found.noise) / found.expected)
    sigma = np.sqrt(max(float(np.mean(seen)), 0.0))
    # Both views have errors along their rays, which meet surfaces at an angle.
    assert sigma < 0.002 if size == 0 else 0.5 * size < sigma < 2 * size


def bent_views(seed: int, size: float, *, lit: bool = True) -> tuple[list[SampledView], np.ndarray]:
    rng = np.random.default_rng(seed)
    truth, views = path(8), []
    for k, T in enumerate(truth):
        frame = bent(corner(T), rng, size)
        depth = frame.depth + 0.005 * rng.standard_normal(frame.depth.shape)
        light = frame.amplitude_image if lit else None
        views.append(
            view(replace(frame, index=k, depth=depth.astype(np.float32), amplitude_image=light))
        )
    return views, truth


def test_albedo_weighs_more_with_shared_errors():
    """Shared errors bias a refinement that assumes all pixels to be independent."""
    errors = []
    for seed in (1, 2, 3, 4):
        views, truth = bent_views(seed, 0.01)
        for shared in (0.0, 1.0):
            poses = refine(views, truth, RefineOptions(shared=shared)).poses
            errors.append(float(np.sqrt(((poses - truth)[:, :3, 3] ** 2).sum(1).mean())))
    without, allowed = np.reshape(errors, (4, 2)).mean(0)
    assert allowed < 0.92 * without


def test_refinement_states_the_size_of_shared_errors():
    """Relative to the depth and to the change of the viewpoint."""
    found = []
    for size in (0.0, 0.005, 0.01):
        views, truth = bent_views(1, size)
        found.append(refine(views, truth, RefineOptions()).shared_growth ** 0.5)
    none, small, large = found
    assert none < 0.2 * large
    assert small == pytest.approx(large / 2, rel=0.25)
    views, truth = bent_views(1, 0.01, lit=False)
    assert refine(views, truth, RefineOptions()).shared_growth == 0


def test_pixels_are_not_discounted_without_shared_errors_or_albedo():
    views, truth = bent_views(1, 0.0)
    some, none = (refine(views, truth, RefineOptions(shared=s)).poses for s in (1.0, 0.0))
    assert np.abs(some - none).max() < 2e-3
    views, truth = bent_views(1, 0.01, lit=False)
    some, none = (refine(views, truth, RefineOptions(shared=s)).poses for s in (1.0, 0.0))
    np.testing.assert_array_equal(some, none)


def test_a_pair_whose_sums_are_not_finite_says_nothing(pair):
    source, target, T = pair
    points = source.points.copy()
    points[len(points) // 2, 3:6] = np.inf  # the normal of a plane that was fitted to mere noise
    views = [target, source, replace(source, points=points)]
    state = DirectedPairs.of(views, np.array([(0, 1), (0, 2)]), RefineOptions())
    fixed = np.ones(kernels.ERRORS, np.int64)
    state.evaluate(np.stack([np.eye(4), T, T]), np.zeros(kernels.ERRORS), fixed, Round(1, 0.0, 0.0))
    is_noise = (state.source == 2) & (state.target == 0)
    assert not state.rows[is_noise].any()
    assert np.isfinite(state.rows).all()
    assert state.rows[~is_noise].any(1).all()
