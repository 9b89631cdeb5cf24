"""Selection, matching and rejection of points."""

from __future__ import annotations

import numpy as np
import pytest

from registration_scenes import (
    CAMERA,
    box_walls,
    error,
    relief,
    relief_image,
    rng,
    stone,
    turn,
    view,
)
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames.frames import CloudFrame
from tofuse.engine.geometry import se3
from tofuse.engine.icp.icp import Icp
from tofuse.engine.icp.icp_kernels import transform_points
from tofuse.engine.icp.icp_parts import (
    All,
    ClosestPoint,
    MaxDistance,
    PointToPoint,
    Random,
    SmallStep,
    Uniform,
)
from tofuse.engine.icp.interfaces import Alignment, History, Matches, Points
from tofuse.engine.icp.surface_metrics import PointToPlane
from tofuse.lab.methods.compatibility import (
    AmplitudeCompatibility,
    Boundary,
    ColorCompatibility,
    CurvatureCompatibility,
    NormalCompatibility,
    Trimmed,
)
from tofuse.lab.methods.correspondence import (
    ClosestCompatible,
    ClosestInvariant,
    NormalShooting,
    Projection,
    ProjectionSearch,
)
from tofuse.lab.methods.sampling import IntensityGradient, NormalSpace, Voxel


def everything(a_view):
    return Points.of(a_view, np.arange(len(a_view)))


def aligned(source, target, T=None, resolution=0.02):
    data, model = everything(source), everything(target)
    T = np.eye(4) if T is None else T
    return Alignment(data, model, resolution, T, transform_points(T, data.points))


def one_to_one(n, distance=None):
    return Matches(np.arange(n), np.arange(n), np.zeros(n) if distance is None else distance)


# Selection


@pytest.mark.parametrize(("size", "points", "step"), [(1000, 100, 10), (1999, 1000, 1), (7, 3, 2)])
def test_uniform_takes_every_kth(size, points, step):
    chosen = Uniform(points).select(CloudFrame.of(np.zeros((size, 3))), rng())
    np.testing.assert_array_equal(chosen, np.arange(0, size, step))


def test_voxel_selects_point_nearest_to_centre_of_each_cube():
    points = rng(1).uniform(-1, 1, (2000, 3)).astype(np.float32)
    chosen = Voxel(0.25).select(CloudFrame.of(points), rng())
    cells = {}
    for i, p in enumerate(points.astype(float) / 0.25):
        cell = tuple(np.floor(p))
        off = ((p - np.floor(p) - 0.5) ** 2).sum()
        if cell not in cells or off < cells[cell][0]:
            cells[cell] = (off, i)
    np.testing.assert_array_equal(chosen, sorted(i for _, i in cells.values()))


def grooved_wall(n, seed):
    """A wall with two grooves, 12 mm deep, and 1.5 mm of noise."""
    r = rng(seed)
    p = np.column_stack([r.uniform(-0.5, 0.5, (n, 2)), np.full(n, 1.5)])
    for x, y, angle in ((0, 0, 0.3), (0.05, -0.05, 1.9)):
        off = (p[:, 0] - x) * np.cos(angle) + (p[:, 1] - y) * np.sin(angle)
        p[:, 2] += np.maximum(0, 0.012 - np.abs(off))
    p[:, 2] += r.normal(0, 0.0015, n)
    return p


@pytest.mark.nightly
def test_normal_space_registers_grooves_that_random_points_miss():
    """Figures 7 and 8 of Rusinkiewicz and Levoy: an incised plane."""
    T = se3.exp([0.008, -0.006, 0.003, 0.004, -0.003, 0.01])
    squares = {}
    for selector in (Random(600), NormalSpace(600, buckets=16)):
        errors = []
        for k in range(4):
            target, source = view(grooved_wall(20000, 10 + k)), view(grooved_wall(20000, 20 + k), T)
            method = Icp(
                0.01,
                source=selector,
                target=All(),
                metric=PointToPlane(),
                rejectors=(MaxDistance(3),),
                stopping=SmallStep(1e-4, 40),
            )
            errors.append(error(method.register(source, target, np.eye(4), rng(k)), T)[0])
        squares[type(selector)] = np.mean(np.square(errors))
    assert squares[NormalSpace] < 0.4 * squares[Random]


def test_normal_space_sampling_is_uniform_over_directions():
    walls = np.vstack([box_walls(4000, 0, 0, "z"), box_walls(200, 1, 0, "x")])
    chosen = NormalSpace(300).select(view(walls), rng())
    assert len(chosen) == len(set(chosen)) == 300
    assert (np.diff(chosen) > 0).all()
    # One point in 20 is on the side walls; the fraction of selected ones is much larger.
    assert (chosen >= 4000).mean() > 0.3
    few = NormalSpace(10000).select(view(walls), rng())
    np.testing.assert_array_equal(few, np.arange(len(walls)))


def test_intensity_gradient_selects_edges_of_pattern():
    image = relief_image(np.eye(4), amplitude=lambda x, y: np.where(x > 0.05, 400.0, 100.0))
    chosen = IntensityGradient(80).select(image, rng())
    assert len(chosen) == 80
    assert np.abs(image.points[chosen, 0] - 0.05).max() < 0.05
    flat = relief_image(np.eye(4), amplitude=lambda x, y: np.full(x.shape, 50.0))
    assert len(IntensityGradient(80).select(flat, rng())) == 0
    with pytest.raises(RegistrationError, match="no amplitude image"):
        IntensityGradient().select(relief_image(np.eye(4)), rng())
    with pytest.raises(RegistrationError, match="no amplitude image"):
        IntensityGradient().select(view(relief(50, 0)), rng())


# Matching


def test_normal_shooting_finds_intersection_along_normal():
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-40, 41) * 0.01, np.arange(-40, 41) * 0.01))
    target = view(np.column_stack([x, y, 1.5 + 0.5 * x]))
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    start = np.array([[0.02, 0.01, 1.4], [-0.05, 0.1, 1.55]])
    source = CloudFrame(
        1, 0.0, start.astype(np.float32), normals=np.tile(normal, (2, 1)).astype(np.float32)
    )
    a = aligned(source, target)
    matches = NormalShooting().prepare(a.target).match(a, 1.0)
    # Intersection of the line with the plane 0.5 x - z + 1.5 = 0, computed by hand.
    plane_normal = np.array([0.5, 0, -1])
    along = -(start @ plane_normal + 1.5) / (normal @ plane_normal)
    meets = start + along[:, None] * normal
    hit = a.target.points[matches.target]
    assert np.linalg.norm(hit - meets, axis=1).max() < 0.009
    np.testing.assert_allclose(matches.distance, np.linalg.norm(hit - start, axis=1), rtol=1e-5)
    closest = ClosestPoint().prepare(a.target).match(a, 1.0)
    assert np.linalg.norm(a.target.points[closest.target] - meets, axis=1).min() > 0.015
    assert len(NormalShooting().prepare(a.target).match(a, 0.05)) < 2


SMALL = se3.exp([0.01, -0.008, 0.012, 0.01, -0.008, 0.012])


def test_projection_matches_points_on_same_pixel():
    source, target = relief_image(SMALL, 1), relief_image(np.eye(4))
    target = target.keep(rng(3).random(target.depth.shape) < 0.9)
    a = aligned(source, target, SMALL)
    matches = Projection().prepare(a.target).match(a, 0.05)
    uv = np.rint(CAMERA.project(a.transformed)).astype(int)
    pixel = np.column_stack(np.nonzero(target.valid))[:, ::-1]
    assert len(matches) > 8000
    np.testing.assert_array_equal(uv[matches.source], pixel[matches.target])
    gap = a.transformed[matches.source] - a.target.points[matches.target]
    np.testing.assert_allclose(matches.distance, np.linalg.norm(gap, axis=1))
    # No pair is missing: the others are outside, on no point, or too far.
    inside = ((uv >= 0) & (uv < [120, 90])).all(1)
    lost = np.setdiff1d(np.flatnonzero(inside), matches.source)
    position = np.full(target.valid.shape, -1)
    position[target.valid] = np.arange(len(a.target))
    there = position[uv[lost, 1], uv[lost, 0]]
    far = np.linalg.norm(a.transformed[lost] - a.target.points[np.maximum(there, 0)], axis=1) > 0.05
    assert ((there < 0) | far).all()


def test_projection_search_finds_closest_points_for_small_motions():
    source, target = relief_image(SMALL, 1), relief_image(np.eye(4))
    a = aligned(source, target, SMALL)
    found = ProjectionSearch(2).prepare(a.target).match(a, 0.05)
    exact = ClosestPoint().prepare(a.target).match(a, 0.05)
    both, i, j = np.intersect1d(found.source, exact.source, return_indices=True)
    assert len(both) > 0.97 * len(exact)
    assert (found.target[i] == exact.target[j]).mean() > 0.97


def test_closest_compatible_skips_incompatible_points():
    points = np.array([[0, 0, 1], [0.1, 0, 1], [0.3, 0, 1.0]], np.float32)
    target = CloudFrame(0, 0.0, points, amplitude=np.array([100, 0, 205], np.float32))
    source = CloudFrame(1, 0.0, points[[0, 0, 0]], amplitude=np.array([199, 90, 500], np.float32))
    a = aligned(source, target)
    matches = ClosestCompatible(1.2).prepare(a.target).match(a, 1.0)
    assert list(matches.source) == [0, 1]
    assert list(matches.target) == [2, 0]
    np.testing.assert_allclose(matches.distance, [0.3, 0], atol=1e-7)
    assert list(ClosestCompatible(1.2).prepare(a.target).match(a, 0.2).source) == [1]


def test_closest_invariant_weighs_shape_against_distance():
    # A source point on a bump is closer to a flat place than to the bump.
    def sheet(bump):
        x, y = rng(1).uniform(-0.5, 0.5, (2, 6000))
        off = (x - bump) ** 2 + y**2
        return np.column_stack([x, y, 2 - 0.08 * np.exp(-off / 0.005)])

    a = aligned(view(sheet(-0.15)), view(sheet(0.15)), resolution=0.02)
    top = np.argmin(a.transformed[:, 2])
    near = ClosestPoint().prepare(a.target).match(a, np.inf)
    assert abs(a.target.points[near.target[top], 0] - 0.15) > 0.2
    for features in (("moments",), ("curvature",)):
        alike = ClosestInvariant(features, weight=20.0).prepare(a.target).match(a, np.inf)
        assert abs(a.target.points[alike.target[alike.source == top][0], 0] - 0.15) < 0.06
        little = ClosestInvariant(features, weight=1e-6).prepare(a.target).match(a, np.inf)
        _, i, j = np.intersect1d(little.source, near.source, return_indices=True)
        np.testing.assert_array_equal(little.target[i], near.target[j])


# Rejection


def with_normals(normals):
    normals = np.asarray(normals, np.float32)
    return CloudFrame(0, 0.0, np.zeros((len(normals), 3), np.float32), normals=normals)


def test_normal_compatibility_uses_rotated_normals():
    angles = np.deg2rad([0, 40, 50, 180, 0])
    source = with_normals(np.column_stack([np.sin(angles), 0 * angles, -np.cos(angles)]))
    source.normals[4] = np.nan
    target = with_normals(np.tile([0, 0, -1], (5, 1)))
    a = aligned(source, target)
    assert list(NormalCompatibility().reject(one_to_one(5), a).source) == [0, 1]
    T = se3.pose(se3.so3_exp([0, np.deg2rad(45), 0]))
    kept = NormalCompatibility(np.deg2rad(20)).reject(one_to_one(5), aligned(source, target, T))
    assert list(kept.source) == [1, 2]


def test_curvature_compatibility_distinguishes_ball_and_wall():
    ball = stone(3000, 0) * 0.2
    a = aligned(view(ball), view(box_walls(len(ball), 1, 0, "z")), resolution=0.02)
    n = len(ball)
    assert len(CurvatureCompatibility(0.05).reject(one_to_one(n), a)) < 0.1 * n
    b = aligned(view(ball), view(ball), resolution=0.02)
    assert len(CurvatureCompatibility(0.05).reject(one_to_one(n), b)) > 0.95 * n


def test_amplitude_and_colour_compatibility():
    p = np.zeros((4, 3), np.float32)
    color = np.array([[0, 0, 0], [255, 0, 0], [40, 0, 0], [0, 0, 255]], np.uint8)
    source = CloudFrame(1, 0.0, p, amplitude=np.array([100, 100, 0, 100], np.float32), color=color)
    target = CloudFrame(
        0, 0.0, p, amplitude=np.array([149, 151, 0, 67], np.float32), color=np.zeros_like(color)
    )
    a = aligned(source, target)
    assert list(AmplitudeCompatibility(1.5).reject(one_to_one(4), a).source) == [0, 3]
    assert list(ColorCompatibility(0.2).reject(one_to_one(4), a).source) == [0, 2]
    bare = aligned(CloudFrame.of(p), target)
    with pytest.raises(RegistrationError, match="no amplitude"):
        AmplitudeCompatibility().reject(one_to_one(4), bare)
    with pytest.raises(RegistrationError, match="no colour"):
        ColorCompatibility().reject(one_to_one(4), bare)


def test_trimmed_keeps_fraction_of_source_points():
    source = CloudFrame.of(np.zeros((10, 3)))
    a = aligned(source, source)
    distance = np.array([5, 1, 4, 1, 3, 2, 9, 8.0])
    kept = Trimmed(0.45).reject(Matches(np.arange(8), np.arange(8), distance), a)
    assert list(kept.source) == [1, 3, 4, 5]
    assert len(Trimmed(1.0).reject(one_to_one(8), a)) == 8


def test_boundary_rejection_avoids_bias_of_partial_overlap():
    """Turk and Levoy: points outside the overlap would drag the source over the target."""
    for metric, bound in ((PointToPoint(), 0.04), (PointToPlane(), 0.04)):
        errors = []
        for rejectors in ((Boundary(),), ()):
            T = turn([1, 2, 0.5], 4)
            target, source = view(relief(3000, 1)), view(relief(3000, 2, -0.1, 0.9), T)
            method = Icp(
                0.015,
                source=Random(800),
                target=All(),
                rejectors=rejectors,
                metric=metric,
                stopping=SmallStep(1e-3, 60),
            )
            errors.append(error(method.register(source, target, np.eye(4), rng()), T)[0])
        assert errors[0] < bound
        assert errors[1] > 4 * errors[0]


# Stopping


def test_small_step_stops_at_small_motions_and_cycles():
    rule = SmallStep(0.01, 50)
    assert rule.met(History([5], [1.0], [0.009]))
    assert not rule.met(History([5], [1.0], [0.011]))
    assert rule.met(History([5, 6, 5, 6, 5], [1.0, 2.0, 1.0, 2.0, 1.0], [1.0] * 5))
    assert not rule.met(History([5, 6, 4, 6, 5], [1.0, 2.0, 1.0, 2.0, 1.0], [1.0] * 5))
    assert not rule.met(History([5] * 5, [1.0, 0.9, 0.8, 0.7, 0.6], [1.0] * 5))


# Shared code of the parts


def test_normals_point_towards_sensor():
    sheet = relief(500, 0)
    for z in (0.0, 5.0):
        at = np.array([0.1, 0.2, z])
        assert ((everything(view(sheet, origin=at)).normals * (at - sheet)).sum(1) > 0).all()
