"""Searches and sums over points of the laboratory, against slow twins."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofuse.engine.compute.thread_pool import threads
from tofuse.engine.geometry import se3
from tofuse.lab.methods.featured_tree import FeaturedKdTree

seeds = st.integers(0, 2**32 - 1)


def test_moments_match_twin_and_are_rotation_invariant():
    points = np.random.default_rng(3).normal(size=(500, 3))
    centres = np.vstack([points[:50], [[50, 0, 0]]])
    found = FeaturedKdTree(points).moments(centres, 0.7)
    for c, values in zip(centres, found, strict=True):
        near = points[((points - c) ** 2).sum(1) <= 0.49] - c
        wanted = np.linalg.eigvalsh(near.T @ near / len(near)) if len(near) else np.zeros(3)
        np.testing.assert_allclose(values, wanted, atol=1e-12)
    T = se3.exp([1, 2, 3, 0.5, -1, 0.3])
    turned = FeaturedKdTree(se3.transform(T, points)).moments(se3.transform(T, centres), 0.7)
    np.testing.assert_allclose(turned, found, atol=1e-9)


@settings(max_examples=40)
@given(
    seed=seeds,
    n=st.integers(0, 120),
    k=st.integers(1, 3),
    tolerance=st.sampled_from([0.3, 1.0, np.inf]),
    limit=st.sampled_from([0.4, np.inf]),
    share=st.sampled_from([0.0, 1.0]),
    count=st.sampled_from([1, 3]),
)
def test_nearest_featured_matches_brute_force(seed, n, k, tolerance, limit, share, count):
    r = np.random.default_rng(seed)
    points, queries = (r.uniform(0, 1, (m, 3)) for m in (n, 40))
    f, g = (r.integers(0, 4, (m, k)) / 4 for m in (n, 40))
    f[: n // 5] = np.nan
    with threads(count):
        index, squared = FeaturedKdTree(points).nearest_featured(
            queries, f, g, tolerance, limit, share
        )
    for q in range(40):
        d = ((points - queries[q]) ** 2).sum(1)
        gap = f - g[q]
        ok = (d <= limit**2) & (np.abs(gap) <= tolerance).all(1)
        total = np.where(ok, d + share * (gap**2).sum(1), np.inf)
        if not ok.any():
            assert index[q] == -1
            assert squared[q] == np.inf
        else:
            assert index[q] == np.argmin(total)
            assert squared[q] == pytest.approx(d[index[q]])
