"""Each part of an ICP behaves as in its paper, and equals its slow reference."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames.frames import CloudFrame
from tofuse.engine.geometry import se3
from tofuse.engine.icp.icp_kernels import shortest_of_each_target, transform_points
from tofuse.engine.icp.icp_parts import ClosestPoint, MaxDistance, PointToPoint, Random, TwoLoops
from tofuse.engine.icp.interfaces import Alignment, History, Matches, Points

seeds = st.integers(0, 2**32 - 1)


def everything(points):
    view = CloudFrame.of(points)
    return Points.of(view, np.arange(len(view)))


def alignment(source, target, T=None, resolution=0.01):
    source, target = everything(source), everything(target)
    T = np.eye(4) if T is None else T
    return Alignment(source, target, resolution, T, transform_points(T, source.points))


def pairs(m, weight=None):
    return Matches(np.arange(m), np.arange(m), np.zeros(m), weight)


def cost(T, a, matches):
    p = se3.transform(T, a.transformed[matches.source])
    q = a.target.points[matches.target]
    return float((matches.weights() * ((p - q) ** 2).sum(1)).sum())


# Selectors


def test_random_selection_is_uniform():
    view = CloudFrame.of(np.zeros((100, 3)))
    rng = np.random.default_rng(0)
    counts = sum(np.bincount(Random(10).select(view, rng), minlength=100) for _ in range(3000))
    # Each point is drawn 300 times on average, with a standard deviation of 16.4.
    assert abs(counts - 300).max() < 5 * 16.4


# Matchers


@settings(max_examples=25)
@given(seed=seeds, reach=st.sampled_from([0.05, 0.3, np.inf]))
def test_closest_point_matches_brute_force(seed, reach):
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(0, 0.2, 6))
    a = alignment(rng.uniform(-1, 1, (60, 3)), rng.uniform(-1, 1, (80, 3)), T)
    got = ClosestPoint().prepare(a.target).match(a, reach)
    distance = np.linalg.norm(a.transformed[:, None] - a.target.points[None], axis=2)
    near = np.flatnonzero(distance.min(1) <= reach)
    np.testing.assert_array_equal(got.source, near)
    np.testing.assert_array_equal(got.target, distance[near].argmin(1))
    np.testing.assert_allclose(got.distance, distance[near].min(1), rtol=1e-12)


# Rejectors


def test_max_distance_drops_pairs_beyond_two_resolutions():
    a = alignment(np.zeros((4, 3)), np.zeros((4, 3)), resolution=0.25)
    distance = np.array([0.1, 0.5, np.nextafter(0.5, 1), 3.0])
    matches = Matches(np.arange(4), np.arange(4), distance, np.array([1.0, 2, 3, 4]))
    left = MaxDistance(2.0).reject(matches, a)
    np.testing.assert_array_equal(left.source, [0, 1])
    np.testing.assert_array_equal(left.distance, [0.1, 0.5])
    np.testing.assert_array_equal(left.weight, [1, 2])
    assert MaxDistance(3.0).reach(0.1) == pytest.approx(0.3)


@settings(max_examples=50)
@given(
    pairs_=st.lists(
        st.tuples(st.integers(0, 6), st.sampled_from([0.0, 0.1, 0.2, 0.3])), max_size=40
    )
)
def test_unique_matches_reference(pairs_):
    target = np.array([t for t, _ in pairs_], np.int64)
    distance = np.array([d for _, d in pairs_], float)
    best: dict[int, int] = {}
    for i, (t, d) in enumerate(pairs_):
        if t not in best or d < distance[best[t]]:
            best[t] = i
    want = np.zeros(len(pairs_), bool)
    want[list(best.values())] = True
    np.testing.assert_array_equal(shortest_of_each_target(target, distance, 7), want)


# Metrics


@settings(max_examples=40)
@given(
    seed=seeds,
    m=st.integers(3, 40),
    kind=st.sampled_from(["noisy", "planar", "mirrored", "unrelated"]),
    weighted=st.booleans(),
)
def test_no_motion_fits_better_than_that_of_arun(seed, m, kind, weighted):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(m, 3))
    if kind == "planar":
        source[:, 2] = 0
    target = se3.transform(se3.exp(rng.normal(0, 2, 6)), source) + rng.normal(0, 0.1, (m, 3))
    if kind == "mirrored":
        target = source * [1, 1, -1]
    elif kind == "unrelated":
        target = rng.normal(size=(m, 3))
    a = alignment(source, target)
    matches = pairs(m, rng.uniform(0.1, 2, m) if weighted else None)
    T = PointToPoint().motion(matches, a)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    best = cost(T, a, matches)
    for scale in (1e-3, 0.1, 3.0):
        for xi in rng.normal(0, scale, (20, 6)):
            assert cost(T @ se3.exp(xi), a, matches) >= best * (1 - 1e-12) - 1e-12


@pytest.mark.parametrize(
    "source",
    [
        np.outer([0.0, 1, 2, 3], [1.0, 0.3, -0.2]) + np.array([4, 5, 6]),
        np.tile([1.0, 2, 3], (4, 1)),
    ],
    ids=["line", "one place"],
)
def test_degenerate_pairs_are_refused(source):
    a = alignment(source, se3.transform(se3.exp([1, 2, 3, 0.1, 0.2, 0.3]), source))
    with pytest.raises(RegistrationError, match="line"):
        PointToPoint().motion(pairs(4), a)


@pytest.mark.parametrize("m", [0, 1, 2])
def test_fewer_than_three_pairs_are_refused(m):
    a = alignment(np.eye(3), np.eye(3))
    with pytest.raises(RegistrationError, match=f"only {m} corresponding point"):
        PointToPoint().motion(pairs(m), a)


def test_information_predicts_scatter_for_true_pairs():
    """With true pairs the errors xi, T_found = T exp(xi), have covariance information^-1."""
    rng = np.random.default_rng(4)
    T = se3.exp([0.3, -1, 2, 0.5, 1.0, -0.7])
    source = rng.normal(0, [1.0, 0.3, 0.1], (40, 3)) + np.array([0, 0, 2])
    metric = PointToPoint()
    chi2 = []
    for _ in range(300):
        target = se3.transform(T, source) + rng.normal(0, 0.02, source.shape)
        found = metric.motion(pairs(40), alignment(source, target, T)) @ T
        after = alignment(source, target, found)
        xi = se3.log(se3.inverse(T) @ found)
        chi2.append(xi @ metric.information(pairs(40), after) @ xi)
    # chi^2 with 6 degrees of freedom, a little wider since sigma is estimated.
    assert 5.3 < np.mean(chi2) < 6.9


def test_information_of_perfect_data_is_finite():
    source = np.random.default_rng(5).normal(size=(10, 3))
    information = PointToPoint().information(pairs(10), alignment(source, source))
    assert np.isfinite(information).all()
    assert np.linalg.eigvalsh(information).min() > 0


# Stopping


@settings(max_examples=200)
@given(
    steps=st.lists(st.tuples(st.integers(1, 2), st.integers(1, 2)), min_size=1, max_size=14),
    k=st.integers(1, 3),
)
def test_two_loops_match_literal_loops(steps, k):
    def written_out():
        i = 0
        while True:  # the first loop
            i += 1
            if i >= len(steps):
                return None
            if steps[i][0] == steps[i - 1][0]:
                break
        unchanged = 0
        while unchanged < k:  # the second
            i += 1
            if i >= len(steps):
                return None
            unchanged = unchanged + 1 if steps[i][1] == steps[i - 1][1] else 0
        return i + 1

    rule, history, met = TwoLoops(epsilon=0.5, k=k), History(), None
    for i, (count, error) in enumerate(steps):
        history.correspondences.append(count)
        history.errors.append(float(error))
        if rule.met(history):
            met = i + 1
            break
    assert met == written_out()
