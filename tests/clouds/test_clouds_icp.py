"""Algorithm 1 of the thesis as a whole."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import pytest

from tofuse.engine import parts
from tofuse.engine.alignment.base import Registrar
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.compute.thread_pool import threads
from tofuse.engine.errors import InputError, RegistrationError
from tofuse.engine.frames.frames import CloudFrame, RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.icp.icp import Icp, algorithm_1
from tofuse.engine.icp.interfaces import Alignment, Matcher, Matches, Points, Search, Selector


def corner(n, seed, noise=0.0):
    """Points on three walls that meet in a corner, 1 m in size and 2 m ahead."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (n, 3))
    points[np.arange(n), rng.integers(0, 3, n)] = 0.5
    return points + np.array([0, 0, 2]) + rng.normal(0, noise, (n, 3))


def pair(T, n=3000, noise=0.002, same_points=False):
    """Source and target views of the corner with T_target_source = T."""
    target = corner(n, 0, noise)
    source = target if same_points else corner(n, 1, noise)
    return (
        CloudFrame.of(se3.transform(se3.inverse(T), source), index=1),
        CloudFrame.of(target, index=0),
    )


def rng(seed=0):
    return np.random.default_rng(seed)


SMALL = se3.exp([0.004, -0.003, 0.005, 0.004, -0.002, 0.003])


def literal_algorithm_1(data, model, res, epsilon, k, guess):
    """Algorithm 1 line by line, without a tree; T is the pose after each iteration."""
    data2 = data @ guess[:3, :3].T + guess[:3, 3]
    T, E, corresponding, poses = guess, [], [], []

    def iteration():
        nonlocal data2, T
        d = np.linalg.norm(data2[:, None] - model[None], axis=2)
        closest, shortest = d.argmin(1), d.min(1)
        kept = {}
        for i in np.flatnonzero(shortest <= 2 * res):
            j = closest[i]
            if j not in kept or shortest[i] < shortest[kept[j]]:
                kept[j] = i
        i = np.array(sorted(kept.values()))
        p, q = data2[i], model[closest[i]]
        U, _, Vt = np.linalg.svd((p - p.mean(0)).T @ (q - q.mean(0)))
        R = Vt.T @ np.diag([1, 1, np.linalg.det(Vt.T @ U.T)]) @ U.T
        t = q.mean(0) - R @ p.mean(0)
        data2 = data2 @ R.T + t
        T = np.block([[R, t[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]) @ T
        E.append(shortest[i].sum() / (len(data) * res))
        corresponding.append(len(i))
        poses.append(T)

    iteration()
    while True:
        iteration()
        if corresponding[-1] == corresponding[-2]:
            break
    below = 0
    while below < k:
        iteration()
        below = below + 1 if abs(E[-1] - E[-2]) < epsilon else 0
    return T, E, corresponding


@pytest.mark.parametrize("guess", [np.eye(4), se3.exp([0.01, 0, 0, 0, 0.01, 0])])
def test_result_equals_literal_algorithm_1(guess):
    source, target = pair(SMALL, n=500)
    res = 0.03
    T, E, corresponding = literal_algorithm_1(
        source.points.astype(float), target.points.astype(float), res, 1e-4, 3, guess
    )
    found = algorithm_1(res, None).register(source, target, guess, rng())
    assert found.converged
    assert found.iterations == len(E) > 6
    assert found.correspondences == corresponding[-1]
    assert found.points == 500
    np.testing.assert_allclose(found.errors, E, rtol=1e-9)
    assert found.error == found.errors[-1]
    np.testing.assert_allclose(found.T_target_source, T, atol=1e-10)


def test_motion_is_exact_for_identical_points():
    source, target = pair(SMALL, n=400, noise=0, same_points=True)
    found = algorithm_1(0.02, None).register(source, target, np.eye(4), rng())
    assert found.converged
    assert found.correspondences == found.points == 400
    assert found.inlier_ratio == 1
    np.testing.assert_allclose(found.T_target_source, SMALL, atol=1e-6)
    assert found.rms_m < 1e-6


def test_aligned_views_take_two_plus_k_iterations():
    source, target = pair(np.eye(4), n=200, noise=0, same_points=True)
    for k in (1, 3, 5):
        found = algorithm_1(0.02, None, k=k).register(source, target, np.eye(4), rng())
        assert found.iterations == len(found.errors) == 2 + k
        assert found.error < 1e-12


def test_different_samples_of_same_surfaces_are_registered():
    T = se3.exp([0.02, -0.01, 0.015, 0.01, -0.02, 0.015])
    source, target = pair(T, n=20_000)
    found = algorithm_1(points=4000).register(source, target, np.eye(4), rng())
    xi = se3.log(se3.inverse(T) @ found.T_target_source)
    assert np.linalg.norm(xi[:3]) < 0.012
    assert np.linalg.norm(xi[3:]) < 0.006
    assert found.errors[-1] < 0.6
    assert 0.2 < found.inlier_ratio < 0.7


def test_registration_starts_at_guess():
    T = se3.exp([0.3, 0.1, -0.2, 0.1, 0.4, -0.2])
    source, target = pair(T, n=400, noise=0, same_points=True)
    icp = algorithm_1(0.02, None)
    found = icp.register(source, target, T @ SMALL, rng())
    np.testing.assert_allclose(found.T_target_source, T, atol=1e-6)
    assert found.T_target_source is not T


@dataclass(frozen=True)
class CountingSelector(Selector):
    calls: list = field(default_factory=list)

    def select(self, view, rng):
        self.calls.append(view.index)
        return np.sort(rng.choice(len(view), 300, replace=False)).astype(np.int64)


@dataclass(frozen=True)
class WatchedMatcher(Matcher):
    takes: ClassVar[frozenset[str]] = frozenset({"cloud"})
    inner: Matcher
    seen: list = field(default_factory=list)

    def prepare(self, target: Points) -> Search:
        self.seen.append("prepared")
        search, seen = self.inner.prepare(target), self.seen

        class Watched(Search):
            def match(self, alignment: Alignment, reach: float) -> Matches:
                seen.append((alignment.source.index.copy(), alignment.target.index.copy(), reach))
                np.testing.assert_allclose(
                    alignment.transformed,
                    se3.transform(alignment.T_target_source, alignment.source.points),
                    atol=1e-12,
                )
                return search.match(alignment, reach)

        return Watched()


def test_subset_is_the_same_in_all_iterations():
    source, target = pair(SMALL)
    selector = CountingSelector()
    base = algorithm_1(0.05)
    matcher = WatchedMatcher(base.matcher)
    icp = replace(base, source=selector, target=selector, matcher=matcher)
    found = icp.register(source, target, np.eye(4), rng())
    assert selector.calls == [source.index, target.index]
    assert matcher.seen[0] == "prepared"
    rounds = matcher.seen[1:]
    assert len(rounds) == found.iterations > 3
    for source_index, target_index, reach in rounds:
        np.testing.assert_array_equal(source_index, rounds[0][0])
        np.testing.assert_array_equal(target_index, rounds[0][1])
        assert reach == pytest.approx(0.1)
    assert icp.takes == {"cloud"}


def test_seed_determines_result():
    source, target = pair(SMALL)
    icp = algorithm_1(0.02)
    first, again, other = (
        icp.register(source, target, np.eye(4), np.random.default_rng(s))
        for s in ([1, 2], [1, 2], 5)
    )
    assert first.T_target_source.tobytes() == again.T_target_source.tobytes()
    assert first.errors == again.errors
    assert first.errors != other.errors


def test_result_is_independent_of_threads():
    source, target = pair(SMALL, n=9000)
    results = []
    for count in (1, 2, 3):
        with threads(count):
            found = algorithm_1(points=None).register(source, target, np.eye(4), rng())
        results.append((found.T_target_source.tobytes(), found.information.tobytes(), found.errors))
    assert results[0] == results[1] == results[2]


def test_point_to_point_slides_along_wall_unnoticed():
    """The wall constrains three of six directions; the others stay near the guess."""

    def wall(seed):
        points = np.random.default_rng(seed).uniform(-1, 1, (8000, 3)) * [1, 1, 0]
        return points + np.array([0, 0, 2])

    T = se3.exp([0.05, 0, 0.008, 0, 0, 0])
    source = CloudFrame.of(se3.transform(se3.inverse(T), wall(1)))
    found = algorithm_1(points=None).register(source, CloudFrame.of(wall(2)), np.eye(4), rng())
    xi = se3.log(se3.inverse(T) @ found.T_target_source)
    assert abs(xi[2]) < 0.001
    assert abs(xi[0]) > 0.03
    claimed = np.sqrt(np.linalg.inv(found.information)[0, 0])
    assert claimed < 0.001


def test_iteration_limit_is_reported():
    source, target = pair(se3.exp([0.02, 0, 0, 0, 0, 0]), n=20_000)
    found = algorithm_1(max_iterations=4).register(source, target, np.eye(4), rng())
    assert not found.converged
    assert found.iterations == len(found.errors) == 4
    se3.check_pose(found.T_target_source)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_views_with_too_few_points_are_refused(count):
    good = CloudFrame.of(corner(100, 0), index=3)
    bad = CloudFrame.of(np.zeros((count, 3)), index=8)
    for source, target in ((good, bad), (bad, good)):
        with pytest.raises(RegistrationError, match=f"frame 8: has {count} points"):
            algorithm_1().register(source, target, np.eye(4), rng())


def test_distant_views_are_refused():
    source, target = pair(SMALL)
    with pytest.raises(RegistrationError, match="only 0 points"):
        algorithm_1().register(source, target, se3.exp([5, 0, 0, 0, 0, 0]), rng())


def test_collinear_points_are_refused():
    line = CloudFrame.of(np.outer(np.linspace(0, 1, 50), [1, 1, 1]))
    with pytest.raises(RegistrationError, match="line"):
        algorithm_1().register(line, line, np.eye(4), rng())


def test_images_of_camera_are_accepted():
    camera = Pinhole(width=40, height=30, fx=40, fy=40, cx=19.5, cy=14.5)
    v, u = np.mgrid[0:30, 0:40]
    depth = (2 + 0.3 * np.sin(u / 6) + 0.2 * np.cos(v / 5)).astype(np.float32)
    depth[:3] = 0
    frame = RangeFrame(0, 0.0, camera, depth)
    icp = algorithm_1(0.05, None)
    assert icp.takes == {"range", "cloud"}
    found = icp.register(frame, frame, SMALL, rng())
    assert found.points == 27 * 40
    np.testing.assert_allclose(found.T_target_source, np.eye(4), atol=1e-6)


def test_configuration_round_trip():
    parts.discover("tofuse.engine.clouds")
    icp = algorithm_1(0.5, None, epsilon=1e-3, k=2, max_iterations=7)
    data = parts.to_dict(icp)
    assert data["part"] == "icp"
    assert data["source"] == {"part": "all"}
    assert data["rejectors"] == [{"part": "max-distance", "factor": 2.0}, {"part": "unique"}]
    assert parts.from_dict(Registrar, data, where="test") == icp
    assert algorithm_1() == Icp()
    for field_, value in (
        ("resolution", 0.0),
        ("resolution", float("nan")),
        ("stopping", {"part": "two-loops", "k": 0}),
        ("matcher", {"part": "no such"}),
    ):
        with pytest.raises(InputError, match=r"test\.?"):
            parts.from_dict(Registrar, {**data, field_: value}, where="test")
