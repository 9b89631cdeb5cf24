"""Algorithm 1 of the thesis as a whole."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames.frames import CloudFrame
from tofuse.engine.geometry import se3
from tofuse.engine.icp.icp import algorithm_1


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
    assert np.sqrt(np.linalg.inv(found.information)[0, 0]) < 0.001


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
        with pytest.raises(RegistrationError, match=f"frame 8: has {count} point"):
            algorithm_1().register(source, target, np.eye(4), rng())
