"""The accuracy of a surface includes that of the poses."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.fusion.cloud import Cloud
from tofuse.engine.fusion.mesh import Mesh
from tofuse.engine.fusion.model import Model
from tofuse.engine.fusion.pose_errors import with_pose_errors
from tofuse.engine.geometry import se3

CAMERA = Pinhole(40, 30, 40.0, 40.0, 19.5, 14.5)
SIGMA = 1e-3


def wall(z: float = 2.0) -> RangeFrame:
    return RangeFrame(0, 0.0, CAMERA, np.full((30, 40), z, np.float32))


def model_of(points) -> Model:
    n = len(points)
    cloud = Cloud(
        np.asarray(points, np.float32),
        None,
        None,
        np.ones(n, np.int32),
        np.full(n, SIGMA, np.float32),
    )
    return Model(cloud, None)


def covariance(position_m: float, rotation_rad: float = 0.0):
    return np.diag([position_m**2] * 3 + [rotation_rad**2] * 3)


def test_variance_matches_monte_carlo() -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(0, 0.02, (6, 6))
    C = root @ root.T
    points = wall().points[::250]
    draws = rng.multivariate_normal(np.zeros(6), C, 40_000)
    sigma = with_pose_errors(model_of(points), [wall()], np.eye(4)[None], C[None]).cloud.sigma
    for point, stated in zip(points.astype(float), sigma, strict=True):
        moved = draws[:, :3] + np.cross(draws[:, 3:], point)
        assert stated**2 - SIGMA**2 == pytest.approx((moved**2).sum(1).mean() / 3, rel=0.05)


def test_most_accurate_view_determines_sigma() -> None:
    poses = np.stack([np.eye(4), np.eye(4)])
    both = np.stack([covariance(0.05), covariance(0.01)])
    found = with_pose_errors(model_of(wall().points), [wall(), wall()], poses, both).cloud.sigma
    np.testing.assert_allclose(found, np.hypot(SIGMA, 0.01), rtol=1e-4)


def test_occluded_views_are_ignored() -> None:
    behind = wall(4.0).points
    poses = np.stack([np.eye(4), np.eye(4)])
    frames = [wall(2.0), wall(4.0)]  # in the first, a nearer surface occludes it
    both = np.stack([covariance(0.001), covariance(0.05)])
    found = with_pose_errors(model_of(behind), frames, poses, both).cloud.sigma
    np.testing.assert_allclose(found, np.hypot(SIGMA, 0.05), rtol=1e-4)


def test_unconstrained_pose_gives_large_sigma() -> None:
    nothing = np.full((1, 6, 6), np.nan)
    found = with_pose_errors(model_of(wall().points), [wall()], np.eye(4)[None], nothing)
    assert (found.cloud.sigma > 1).all()


def test_unseen_model_is_unchanged() -> None:
    model = model_of(-wall().points)
    assert with_pose_errors(model, [wall()], np.eye(4)[None], covariance(0.1)[None]) is model
    assert with_pose_errors(model, [], np.zeros((0, 4, 4)), np.zeros((0, 6, 6))) is model


def test_camera_pose_is_applied() -> None:
    T = se3.exp(np.array([1.0, 2, 3, 0.1, 0.5, -0.2]))
    points = se3.transform(T, wall().points.astype(float))
    found = with_pose_errors(model_of(points), [wall()], T[None], covariance(0.03)[None])
    np.testing.assert_allclose(found.cloud.sigma, np.hypot(SIGMA, 0.03), rtol=1e-4)


@pytest.mark.parametrize("same", [True, False])
def test_mesh_vertices_include_pose_errors(same) -> None:
    points = wall().points
    model = model_of(points)
    vertices = points if same else points[::2]
    n = len(vertices)
    mesh = Mesh(
        vertices,
        np.zeros((1, 3), np.int32),
        np.tile(np.float32([0, 0, -1]), (n, 1)),
        None,
        np.full(n, SIGMA, np.float32),
        np.ones(n, np.int32),
    )
    found = with_pose_errors(
        Model(model.cloud, mesh), [wall()], np.eye(4)[None], covariance(0.02)[None]
    ).mesh
    assert found is not None
    assert len(found.sigma) == n
    np.testing.assert_allclose(found.sigma, np.hypot(SIGMA, 0.02), rtol=1e-4)
