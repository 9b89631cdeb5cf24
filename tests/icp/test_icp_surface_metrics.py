"""Metrics with normals: claimed properties, and their stated uncertainty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from registration_scenes import box_walls, error, relief, rng, stone, turn, view
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames.frames import CloudFrame
from tofuse.engine.geometry import se3
from tofuse.engine.geometry.kdtree import KdTree
from tofuse.engine.icp.icp import Icp
from tofuse.engine.icp.icp_kernels import transform_points
from tofuse.engine.icp.icp_parts import All, MaxDistance, PointToPoint, Random, SmallStep
from tofuse.engine.icp.interfaces import Alignment, Matches, Points
from tofuse.engine.icp.surface_metrics import (
    PlaneToPlane,
    PointToPlane,
    cross_information,
    loss_weights,
    surface_pairs,
)
from tofuse.engine.normal import MEDIAN_OF_NORMAL
from tofuse.lab.methods.symmetric import Symmetric

SURFACE_METRICS = [PointToPlane(), Symmetric(), PlaneToPlane()]


def icp(metric, resolution=0.03, reach=None, points=None, epsilon=1e-3, steps=100, neighbours=20):
    return Icp(
        resolution,
        source=All() if points is None else Random(points),
        target=All(),
        rejectors=() if reach is None else (MaxDistance(reach),),
        metric=metric,
        stopping=SmallStep(epsilon, steps),
        neighbours=neighbours,
    )


def perfect(points, normals, T):
    """Alignment of a cloud with itself, moved by T, with every point matched to itself."""
    target = CloudFrame(0, 0.0, points.astype(np.float32), normals=normals.astype(np.float32))
    back = se3.inverse(T)
    source = CloudFrame(
        1,
        0.0,
        se3.transform(back, points).astype(np.float32),
        normals=(normals @ T[:3, :3]).astype(np.float32),
    )
    n = np.arange(len(points))
    data, model = Points.of(source, n), Points.of(target, n)
    alignment = Alignment(data, model, 0.01, np.eye(4), transform_points(np.eye(4), data.points))
    return alignment, Matches(n, n, np.zeros(len(points)))


@pytest.mark.parametrize("metric", SURFACE_METRICS)
def test_true_pairs_are_aligned_in_few_steps(metric):
    T = se3.exp([0.1, -0.2, 0.15, 0.2, -0.1, 0.25])
    points = stone(400, 0)
    normals = rng(1).normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    alignment, matches = perfect(points, normals, T)
    for _ in range(5):
        motion = metric.motion(matches, alignment) @ alignment.T_target_source
        moved = transform_points(motion, alignment.source.points)
        alignment = replace(alignment, T_target_source=motion, transformed=moved)
    np.testing.assert_allclose(alignment.T_target_source, T, atol=1e-5)


def test_point_to_plane_converges_faster_than_point_to_point():
    target = view(stone(3000, 0))
    for k in range(3):
        T = turn(rng(k).normal(size=3), 10)
        source = view(stone(3000, 1), T)
        plane = icp(PointToPlane(), points=800).register(source, target, np.eye(4), rng())
        point = icp(PointToPoint(), points=800).register(source, target, np.eye(4), rng())
        assert plane.converged
        assert error(plane, T)[1] < 0.1
        assert 4 * plane.iterations < point.iterations
        assert error(point, T)[1] > 3 * error(plane, T)[1]


def test_symmetric_error_vanishes_on_a_ball():
    # Points slide on their own ball: they leave the tangent planes, the symmetric error stays zero.
    ball = rng(3).normal(size=(2, 500, 3))
    a, b = ball / np.linalg.norm(ball, axis=2)[..., None]
    near = (a * b).sum(1) > 0.5
    a, b = a[near], b[near]
    assert np.abs(((a - b) * b).sum(1)).mean() > 0.1
    source = CloudFrame(1, 0.0, a.astype(np.float32), normals=a.astype(np.float32))
    target = CloudFrame(0, 0.0, b.astype(np.float32), normals=b.astype(np.float32))
    n = np.arange(len(a))
    data, model = Points.of(source, n), Points.of(target, n)
    alignment = Alignment(data, model, 0.01, np.eye(4), data.points)
    matches = Matches(n, n, np.zeros(len(n)))
    np.testing.assert_allclose(Symmetric().motion(matches, alignment), np.eye(4), atol=1e-5)
    assert np.abs(PointToPlane().motion(matches, alignment) - np.eye(4)).max() > 0.01


@pytest.mark.nightly
def test_gicp_is_insensitive_to_maximum_distance():
    """Figures 3 to 5 of Segal et al.: the largest distance is easy to choose."""
    worst = {}
    for metric in (PlaneToPlane(), PointToPlane()):
        for reach in (1, 4, 16):
            errors = []
            for k in range(4):
                T = turn(rng(k).normal(size=3), 2)
                # The views overlap by three fifths; all other pairs are wrong.
                target = view(relief(2500, 2 * k, -0.5, 0.5))
                source = view(relief(2500, 2 * k + 1, -0.1, 0.9), T)
                method = icp(metric, 0.02, reach, points=800, steps=50)
                errors.append(error(method.register(source, target, np.eye(4), rng()), T)[1])
            worst[type(metric), reach] = max(errors)
    assert worst[PointToPlane, 1] < 0.5
    assert worst[PointToPlane, 16] > 5
    assert max(worst[PlaneToPlane, reach] for reach in (1, 4, 16)) < 1


@pytest.mark.parametrize("metric", SURFACE_METRICS)
def test_robust_losses_tolerate_gross_errors(metric):
    T = turn([1, 2, 0.5], 2)
    target = view(relief(3000, 0))
    r = rng(5)
    lifted = relief(3000, 1)
    lifted[r.random(len(lifted)) < 0.1] -= [0, 0, 0.05]
    source = view(lifted, T)
    plain = icp(metric, reach=4).register(source, target, np.eye(4), rng())
    for loss in ("huber", "cauchy", "tukey"):
        robust = icp(replace(metric, loss=loss), reach=4)
        found = robust.register(source, target, np.eye(4), rng())
        assert error(found, T)[0] < 0.6 * error(plain, T)[0]
    assert error(found, T)[0] < 0.002


def test_losses_match_formulas():
    r = np.array([0, 1, 2, 5, 20.0, -1, -2]) * 0.01
    sigma = 0.02 / MEDIAN_OF_NORMAL
    x = np.abs(r) / sigma
    np.testing.assert_allclose(loss_weights("square", r, 1e-3), 1)
    huber = np.where(x <= 1.345, 1, 1.345 / np.maximum(x, 1e-9))
    np.testing.assert_allclose(loss_weights("huber", r, 1e-3), huber)
    np.testing.assert_allclose(loss_weights("cauchy", r, 1e-3), 1 / (1 + (x / 2.385) ** 2))
    tukey = np.where(x < 4.685, (1 - (x / 4.685) ** 2) ** 2, 0)
    np.testing.assert_allclose(loss_weights("tukey", r, 1e-3), tukey)


def test_precise_points_have_more_weight():
    """With noise of 1 mm on one half and 2 cm on the other, sigma weights halve the error."""
    squares = np.zeros(2)
    for k in range(6):
        T = turn(rng(k).normal(size=3), 1)
        views = []
        for j in range(2):
            p = relief(2000, 10 * k + j, noise=0)
            sigma = np.where(p[:, 1] > 0, 0.001, 0.02)
            p[:, 2] += rng(k, j, 7).normal(0, sigma)
            views.append(view(p, T if j else None, index=j, sigma=sigma.astype(np.float32)))
        for j, chosen in enumerate((views, [replace(v, sigma=None) for v in views])):
            found = icp(PointToPlane(), reach=4).register(chosen[1], chosen[0], np.eye(4), rng())
            squares[j] += error(found, T)[0] ** 2
    assert squares[0] < 0.5 * squares[1]


@pytest.mark.parametrize("metric", SURFACE_METRICS)
def test_information_predicts_scatter(metric):
    T = turn([1, 2, 0.5], 1)
    chi2 = []
    for k in range(24):
        target, source = view(relief(1500, 2 * k)), view(relief(1500, 2 * k + 1), T)
        found = icp(metric, reach=3).register(source, target, np.eye(4), rng())
        xi = se3.log(se3.inverse(T) @ found.T_target_source)
        np.testing.assert_allclose(found.information, found.information.T, rtol=1e-9)
        chi2.append(xi @ found.information @ xi)
    # Six if all pairs were independent; neighbours share the noise of their plane fits.
    assert 3 < np.median(chi2) < 20


def test_information_refers_to_source_origin():
    target, source = view(relief(1500, 0)), view(relief(1500, 1))
    method = icp(PointToPlane(), reach=3)
    here = method.register(source, target, np.eye(4), rng())
    # The same source in a moved frame: T' = T S^-1, xi' = Ad(S) xi.
    S = se3.exp([0.3, -0.5, 1, 0.4, -0.3, 0.2])
    moved = CloudFrame.of(se3.transform(S, source.points), index=1)
    moved = replace(moved, origin=se3.transform(S, np.zeros((1, 3)))[0])
    there = method.register(moved, target, se3.inverse(S), rng())
    A = se3.adjoint(S)
    np.testing.assert_allclose(A.T @ there.information @ A, here.information, rtol=1e-3, atol=10)


SLIDES = {
    "wall": (lambda n, s, e: box_walls(n, s, e, "z"), 3),
    "two walls": (lambda n, s, e: box_walls(n, s, e, "x"), 3),
    "corridor": (lambda n, s, e: box_walls(n, s, e, "xy"), 1),
    "closed room": (lambda n, s, e: box_walls(n, s, e, "xyz"), 0),
    "relief": (lambda n, s, e: relief(n, s, noise=e / 4), 0),
}


@pytest.mark.parametrize("metric", SURFACE_METRICS)
@pytest.mark.parametrize("scene", SLIDES)
@pytest.mark.parametrize("noise", [0.002, 0.01])
def test_degenerate_directions_are_found(scene, noise, metric):
    make, count = SLIDES[scene]
    source, target = view(make(3000, 1, noise)), view(make(3000, 2, noise))
    found = icp(metric, resolution=0.06, reach=2, steps=3).register(
        source, target, np.eye(4), rng()
    )
    assert found.unobservable.shape == (count, 6)
    if scene == "corridor":
        assert np.abs(found.unobservable[0, 2]) > 0.99
    if scene == "wall":
        # In the plane, and about its normal.
        assert np.abs(found.unobservable[:, [2, 3, 4]]).max() < 0.05


def test_cross_information_of_wall_is_not_inflated_by_noise():
    # Noise of the normals inflates the plain information about sliding, not the cross-information.
    source, target = (view(box_walls(3000, s, 0.01, "z")) for s in (1, 2))
    n = np.arange(3000)
    data, model = Points.of(source, n), Points.of(target, n)
    j, d2 = KdTree(model.points).nearest(data.points)
    alignment = Alignment(data, model, 0.05, np.eye(4), data.points)
    pairs = surface_pairs(Matches(n, j, np.sqrt(d2)), alignment, source=True)
    plain, variance = PointToPlane().fit(pairs)
    cross = cross_information(pairs, variance)
    assert plain[0, 0] > 100
    assert abs(cross[0, 0]) < 0.1 * plain[0, 0]
    assert cross[2, 2] == pytest.approx(plain[2, 2], rel=0.05)


@pytest.mark.parametrize("metric", SURFACE_METRICS)
def test_missing_normals_are_reported(metric):
    line = view(np.outer(np.linspace(0, 1, 50), [1, 1, 1]))
    with pytest.raises(RegistrationError, match="with normals"):
        icp(metric).register(line, line, np.eye(4), rng())
