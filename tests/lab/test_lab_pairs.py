"""Methods for two views that no configuration uses: claims of their papers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from registration_scenes import bumpy_ball, directions, error, relief, rng, stone, turn, view
from tofuse.engine import parts
from tofuse.engine.frames.frames import CloudFrame
from tofuse.engine.geometry import se3
from tofuse.engine.icp.icp import Icp
from tofuse.engine.icp.icp_kernels import transform_points
from tofuse.engine.icp.icp_parts import All, MaxDistance, PointToPoint, SmallStep
from tofuse.engine.icp.interfaces import Alignment, Matches, Points
from tofuse.engine.icp.surface_metrics import PointToPlane
from tofuse.lab.methods.comprehensive import Cicp, Comprehensive
from tofuse.lab.methods.implicit import Implicit
from tofuse.lab.methods.least_squares_matching import LeastSquaresMatching
from tofuse.lab.methods.ndt import Ndt
from tofuse.lab.methods.neighbourhoods import mean_curvature, neighbourhood
from tofuse.lab.methods.robust_metrics import Graduated, estimate_shape
from tofuse.lab.methods.squared_distance import SquaredDistance, approximant

EVERY = [Cicp(0.03), LeastSquaresMatching(0.03), Ndt(0.03)]


def small(seed, degrees=6.0, shift=0.02):
    T = turn(rng(seed).normal(size=3), degrees)
    T[:3, 3] += rng(seed, 50).normal(0, shift, 3)
    return T


def points_of(cloud):
    frame = CloudFrame(0, 0.0, cloud.astype(np.float32))
    return Points(frame, np.arange(len(cloud)), cloud.astype(float))


def alignment_of(source, target, resolution=0.03):
    a, b = points_of(source), points_of(target)
    return Alignment(a, b, resolution, np.eye(4), a.points)


def icp(metric, reach=3.0, steps=100, resolution=0.03):
    return Icp(
        resolution,
        source=All(),
        target=All(),
        rejectors=(MaxDistance(reach),),
        metric=metric,
        stopping=SmallStep(1e-3, steps),
    )


@pytest.mark.parametrize("method", EVERY, ids=parts.name_of)
def test_small_motion_is_recovered(method):
    for k in range(2):
        T = small(k)
        source, target = view(stone(3000, 1), T), view(stone(3000, 0))
        found = method.register(source, target, np.eye(4), rng(k))
        most = 2.5 if isinstance(method, Cicp) else 1.0  # points slide along a smooth surface
        assert error(found, T)[0] < 0.02
        assert error(found, T)[1] < most
        assert np.linalg.eigvalsh(found.information).min() > 0


def test_comprehensive_pairs_match_full_lookup_matrix():
    a, b = rng(0).uniform(size=(60, 3)), rng(1).uniform(size=(45, 3))
    table = cdist(a, b)
    expected = []
    while np.isfinite(table).any():
        i, j = np.unravel_index(np.argmin(table), table.shape)
        expected.append((i, j))
        table[i], table[:, j] = np.inf, np.inf
    search = Comprehensive().prepare(points_of(b))
    found = search.match(alignment_of(a, b), np.inf)
    assert sorted(expected) == list(zip(found.source, found.target, strict=True))
    near = search.match(alignment_of(a, b), 0.1)
    assert 0 < len(near) < len(found)
    assert near.distance.max() <= 0.1


def test_cicp_is_more_accurate_in_fewer_iterations_with_noise():
    """The paper's claim for one-to-one pairs: the same points in both views, with noise."""
    comprehensive, closest = [], []
    for k in range(4):
        T = small(k, 8)
        cloud = bumpy_ball(500, k)
        source, target = view(cloud + rng(k, 7).normal(0, 0.02, cloud.shape), T), view(cloud)
        found = Cicp(0.03, points=500).register(source, target, np.eye(4), rng())
        plain = replace(icp(PointToPoint()), rejectors=())
        other = plain.register(source, target, np.eye(4), rng())
        comprehensive.append([error(found, T)[1], found.iterations])
        closest.append([error(other, T)[1], other.iterations])
    assert (np.median(comprehensive, 0) < 0.7 * np.median(closest, 0)).all()


@pytest.mark.nightly
def test_ls3d_estimates_free_scale_and_its_precision():
    T = small(1, 4)
    target = view(bumpy_ball(6000, 0))
    for scale in (0.97, 1.02):
        cloud = bumpy_ball(6000, 1, noise=0.001)
        middle = cloud.mean(0)
        source = view((cloud - middle) / scale + middle, T)
        rigid = LeastSquaresMatching(0.02).register(source, target, np.eye(4), rng())
        free = LeastSquaresMatching(0.02, scale_sigma=1.0).register(
            source, target, np.eye(4), rng()
        )
        assert rigid.scale == 1
        assert free.scale == pytest.approx(scale, abs=max(5 * free.precision[6], 0.002))
        assert free.precision[6] < 0.002
        assert free.rms_m < 0.5 * rigid.rms_m


def test_ls3d_applies_the_scale_before_the_motion():
    """As `Registration.scale` says: about the origin, from which the source is metres away."""
    T, true = small(1, 4), 0.97
    cloud = bumpy_ball(6000, 1)
    source = CloudFrame.of(se3.transform(se3.inverse(T), cloud) / true)
    centre = true * source.points.mean(0)
    guess = T @ se3.translation(centre - centre / true)
    found = LeastSquaresMatching(0.02, scale_sigma=1.0).register(
        source, view(bumpy_ball(6000, 0)), guess, rng()
    )
    moved = se3.transform(found.T_target_source, found.scale * source.points)
    assert np.linalg.norm(moved - cloud, axis=1).max() < 0.002
    assert found.scale_sigma == found.precision[6] > 0
    # The distance along the ray is as uncertain as the scale.
    distance = np.linalg.norm(centre)
    ray = centre / distance
    assert found.covariance is not None
    along = np.sqrt(ray @ found.covariance[:3, :3] @ ray)
    assert along == pytest.approx(distance * found.scale_sigma, rel=0.2)


def test_ls3d_with_intensity_does_not_slide_along_wall():
    """Akca 2007: the intensity is a second surface that constrains what the first does not."""

    def wall(seed, T):
        p = np.column_stack([rng(seed).uniform(-0.6, 0.6, (5000, 2)), np.full(5000, 2.0)])
        light = 100 + 40 * np.sin(9 * p[:, 0]) * np.cos(7 * p[:, 1])
        return view(p, T, amplitude=light.astype(np.float32))

    T = se3.translation([0.03, -0.02, 0.01])
    plain, lit = (
        LeastSquaresMatching(0.02, intensity=intensity).register(
            wall(1, T), wall(0, np.eye(4)), np.eye(4), rng()
        )
        for intensity in (0.0, 0.1)
    )
    assert error(plain, T)[0] > 0.03
    assert error(lit, T)[0] < 0.003


@pytest.mark.nightly
def test_ndt_has_larger_convergence_basin_than_point_to_plane():
    """Magnusson 2009: coarse cells reach further than closest points."""
    target = view(relief(5000, 0))
    good = {"ndt": 0, "plane": 0}
    for k in range(8):
        T = np.eye(4)
        T[:2, 3] = 0.45 * np.array([np.cos(k), np.sin(k)])
        source = view(relief(5000, 1), T)
        ndt = Ndt(0.012).register(source, target, np.eye(4), rng(k))
        plane = icp(PointToPlane(), 5.0, 50, 0.012).register(source, target, np.eye(4), rng(k))
        good["ndt"] += error(ndt, T)[0] < 0.01
        good["plane"] += error(plane, T)[0] < 0.01
    assert good["ndt"] >= good["plane"] + 2


@pytest.mark.parametrize("away", [-0.05, 0.08])
def test_squared_distance_is_second_order_accurate(away):
    """Distance from a sphere, near a point in front of or behind its surface."""
    ball = 0.5 * directions(6000, 0) + [0, 0, 2.0]
    normals = (ball - [0, 0, 2.0]) / 0.5
    target = CloudFrame(0, 0.0, ball.astype(np.float32), normals=normals.astype(np.float32))
    model = Points.of(target, np.arange(len(ball)))
    j = int(np.argmin(ball[:, 2]))
    outward = (ball[j] - [0, 0, 2]) / 0.5
    at = ball[j] + away * outward
    data = points_of(at[None])
    alignment = Alignment(data, model, 0.02, np.eye(4), data.points)
    W = approximant(Matches(np.array([0]), np.array([j]), np.array([abs(away)])), alignment)[0]
    d = rng(3).normal(size=(200, 3)) * 0.01
    x = at + d
    stated = np.einsum("ni,ij,nj->n", x - ball[j], W, x - ball[j])
    true = (np.linalg.norm(x - [0, 0, 2.0], axis=1) - 0.5) ** 2
    plane = ((x - ball[j]) @ outward) ** 2
    if away > 0:
        assert np.abs(stated - true).max() < 0.2 * np.abs(plane - true).max()
    else:  # a negative coefficient is set to zero
        np.testing.assert_allclose(stated, plane, atol=2e-6)


def test_squared_distance_is_accurate_in_fewer_steps_than_point_to_point():
    target = view(stone(3000, 0))
    for k in range(3):
        T = small(k, 8)
        source = view(stone(3000, 1), T)
        here = icp(SquaredDistance(), 8.0).register(source, target, np.eye(4), rng())
        point = icp(PointToPoint(), 8.0).register(source, target, np.eye(4), rng())
        assert error(here, T)[0] < 0.003
        assert 2 * here.iterations < point.iterations


def test_principal_curvatures_of_cylinder():
    angle, z = rng(0).uniform(-1, 1, 4000), rng(1).uniform(-0.5, 0.5, 4000)
    tube = np.column_stack([0.3 * np.sin(angle), z, 1.0 - 0.3 * np.cos(angle)])
    frame = CloudFrame(0, 0.0, tube.astype(np.float32))
    inner = np.flatnonzero((np.abs(angle) < 0.6) & (np.abs(z) < 0.3))
    bending = neighbourhood(Points.of(frame, np.arange(4000))).principal_curvatures
    k = bending.curvature[inner]
    assert np.median(k[:, 0]) == pytest.approx(-1 / 0.3, rel=0.05)
    assert abs(np.median(k[:, 1])) < 0.15
    assert np.median(np.abs(bending.directions[inner, 1, 1])) > 0.99


def test_mean_curvature_of_sphere_is_inverse_radius():
    ball = 0.5 * directions(4000, 1)
    front = ball[:, 2] < -0.1
    far = CloudFrame(0, 0.0, ball.astype(np.float32), origin=np.array([0, 0, -1e6]))
    outside = mean_curvature(Points.of(far, np.arange(4000)))
    np.testing.assert_allclose(np.median(outside[front]), 2.0, rtol=0.02)
    # Seen from inside it is concave.
    inside = mean_curvature(points_of(ball))
    np.testing.assert_allclose(np.median(inside), -2.0, rtol=0.02)


def test_mean_curvature_of_line_is_undetermined():
    assert np.isnan(mean_curvature(points_of(np.outer(np.arange(20.0), [1, 2, 3])))).all()


def test_imls_is_nearer_to_surface_than_plane_of_nearest_point():
    """Deschaud 2018: the noise of the target is averaged."""
    target, true = points_of(relief(4000, 0, noise=0.006)), relief(500, 1, -0.4, 0.4, noise=0.0)
    alignment = Alignment(points_of(true), target, 0.015, np.eye(4), true)
    near, _ = neighbourhood(target).tree.nearest(true)
    plane = ((true - target.points[near]) * target.normals[near]).sum(1)
    implicit = Implicit().distance(true, alignment)
    assert np.isfinite(implicit).all()
    assert np.sqrt((implicit**2).mean()) < 0.6 * np.sqrt((plane**2).mean())
    assert np.isnan(Implicit().distance(true + 5, alignment)).all()


def test_gnc_is_robust_to_75_percent_outliers():
    """Yang et al. 2020: robust to 70 to 80 % of outlier correspondences."""
    cloud = bumpy_ball(400, 0)
    T = turn([1, 2, 3], 60)
    moved = transform_points(se3.inverse(T), cloud) + rng(4).normal(0, 0.002, cloud.shape)
    wrong = rng(2).permutation(400)[:300]
    partner = np.arange(400)
    partner[wrong] = rng(3).integers(0, 400, 300)
    alignment = alignment_of(moved, cloud, 0.005)
    matches = Matches(np.arange(400), partner, np.zeros(400))
    robust = Graduated().motion(matches, alignment)
    plain = PointToPoint().motion(matches, alignment)
    assert se3.angle((se3.inverse(T) @ robust)[:3, :3]) < 0.01
    assert se3.angle((se3.inverse(T) @ plain)[:3, :3]) > 0.05
    assert np.linalg.eigvalsh(Graduated().information(matches, alignment)).min() > 0


def test_adaptive_loss_shape_follows_residuals():
    normal = rng(0).normal(size=20000)
    cauchy = rng(1).standard_cauchy(20000)
    contaminated = np.where(rng(2).uniform(size=20000) < 0.3, rng(3).uniform(-9, 9, 20000), normal)
    assert estimate_shape(normal) == 2
    assert -0.75 <= estimate_shape(cauchy * np.sqrt(2)) <= 0.75
    assert estimate_shape(contaminated) < estimate_shape(normal)
