"""Surfaces near and far: voxels of the size that the pixels resolve there, without seams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ball_views import EYE, frame_of, look, plane_range, sphere_range
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.compute.thread_pool import threads
from tofuse.engine.fusion import tsdf
from tofuse.engine.fusion.options import Fusion
from tofuse.engine.fusion.range_view import DECODED, RangeView
from tofuse.engine.fusion.tsdf import fitting_levels, fitting_voxel, fuse_surface

CAMERA = Pinhole(160, 120, 140.0, 140.0, 79.5, 59.5)
FLOOR, WALL = 0.5, 6.0
BALL = np.array([0.0, 0.2, 0.8])
RADIUS = 0.3


def seen(T, index, rng, ball=True):
    """A view of a floor that leads from a ball to a far wall, with stereo noise (~ z^2)."""
    ranges = np.minimum(
        plane_range(T, np.array([0, 1.0, 0]), FLOOR, CAMERA),
        plane_range(T, np.array([0, 0, 1.0]), WALL, CAMERA),
    )
    if ball:
        ranges = np.minimum(ranges, sphere_range(T, BALL, RADIUS, CAMERA))
    sigma = (0.001 * ranges**2).astype(np.float32)
    noisy = ranges + sigma * rng.standard_normal(ranges.shape)
    return RangeView.of(frame_of(noisy, index, camera=CAMERA, sigma_image=sigma))


def recorded(count=12, ball=True):
    """Views (views, poses) from slightly different places."""
    rng = np.random.default_rng(0)
    poses = np.array(
        [
            look([0.1 * np.sin(k), -0.1 + 0.05 * np.cos(2 * k), 0], [0, 0.25, 2.0])
            for k in range(count)
        ]
    )
    return [seen(T, k, rng, ball) for k, T in enumerate(poses)], poses


@pytest.fixture(scope="module")
def scene():
    views, poses = recorded()
    return views, poses, fuse_surface(views, poses)


@pytest.fixture(scope="module")
def uniform(scene):
    """The same surface in the finest voxels everywhere."""
    views, poses, _ = scene
    voxel = fitting_voxel(views)
    finest = voxel * 2.0 ** fitting_levels(views, voxel)[0]
    return fuse_surface(views, poses, Fusion(voxel_m=finest))


def errors_of(points):
    """Distances (N,) of points from the true surfaces, m."""
    return np.min(
        [
            np.abs(points[:, 1] - FLOOR),
            np.abs(points[:, 2] - WALL),
            np.abs(np.linalg.norm(points - BALL, axis=1) - RADIUS),
        ],
        axis=0,
    )


def edge_at(mesh, low, high):
    """Edge of a square of two typical triangles at depths from `low` to `high`, m."""
    a, b, c = mesh.vertices[mesh.faces].astype(float).transpose(1, 0, 2)
    double_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    z = (a + b + c)[:, 2] / 3
    return np.sqrt(np.median(double_area[(z > low) & (z < high)]))


def near_ball(mesh):
    return np.linalg.norm(mesh.vertices - BALL, axis=1) < RADIUS + 0.02


def borders_of(mesh):
    """Centres (N, 3) of the edges of a single triangle."""
    edges = np.sort(np.concatenate([mesh.faces[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    distinct, count = np.unique(edges, axis=0, return_counts=True)
    return mesh.vertices[distinct[count == 1]].mean(1)


def test_near_surfaces_keep_their_detail_and_far_ones_are_coarser(scene, uniform) -> None:
    views, _, mesh = scene
    assert list(fitting_levels(views, fitting_voxel(views))) == [-1, 0, 1]
    near, middle, far = (edge_at(mesh, *z) for z in ((0.5, 0.65), (1.6, 2.2), (5.9, 6.1)))
    assert near == pytest.approx(edge_at(uniform, 0.5, 0.65), rel=0.05)
    assert middle > 1.7 * near
    assert far > 3 * near
    # Within a factor of 2 of the distance between pixels.
    for edge, z in ((near, 0.5), (middle, 2.0), (far, 6.0)):
        assert 0.5 < edge / (z / CAMERA.fx) < 2
    ball, same_ball = (m.vertices[near_ball(m)] for m in (mesh, uniform))
    assert len(ball) > 0.95 * len(same_ball)
    assert errors_of(ball).mean() < 1.05 * errors_of(same_ball).mean()


def test_size_is_bounded_by_what_the_pixels_resolve(scene, uniform) -> None:
    views, _, mesh = scene
    assert len(mesh) < 0.2 * len(uniform)
    assert errors_of(mesh.vertices).mean() < errors_of(uniform.vertices).mean()
    # Space does not matter, pixels do: the wall alone fills 15 m^2.
    assert len(mesh) < 4 * views[0].z.size


def test_levels_meet_without_gaps(monkeypatch) -> None:
    """A floor leads from one level to the next: it has no border but where the views end."""
    monkeypatch.setattr(tsdf, "fitting_levels", lambda *_: range(-1, 1))
    views, poses = recorded(ball=False)
    mesh = fuse_surface(views, poses)
    assert edge_at(mesh, 2.2, 2.6) > 1.7 * edge_at(mesh, 1.4, 1.6)
    x, _, z = borders_of(mesh).T
    assert not ((np.abs(x) < 0.3 * z) & (z > 1.4) & (z < 2.6)).any()
    x, _, z = mesh.vertices.T
    assert ((np.abs(x) < 0.3 * z) & (z > 1.4) & (z < 2.6)).sum() > 1000


def test_finer_levels_do_not_make_the_model_larger() -> None:
    """A near object in few views of a far scene adds no level: no coarser one pays for it."""
    views, poses = recorded(ball=False)
    voxel = fitting_voxel(views)
    near = [seen(T, k, np.random.default_rng(k)) for k, T in enumerate(poses[:2])]
    assert fitting_levels([*views, *near], voxel) == range(1)


def test_regions_and_threads_give_the_same_bytes(scene) -> None:
    views, poses, mesh = scene
    with threads(1):
        other = fuse_surface(views, poses, Fusion(memory_mb=1))
    for name in ("vertices", "faces", "normals", "color", "sigma", "views"):
        assert getattr(mesh, name).tobytes() == getattr(other, name).tobytes(), name


def test_voxel_of_the_user_holds_everywhere(scene) -> None:
    views, poses, _ = scene
    mesh = fuse_surface(views, poses, Fusion(voxel_m=0.02))
    for z in ((0.5, 0.65), (1.6, 2.2), (5.9, 6.1)):
        assert 0.6 < edge_at(mesh, *z) / 0.02 < 1.1


def test_noisy_surfaces_have_coarser_voxels(scene) -> None:
    views, poses, mesh = scene
    code = np.searchsorted(DECODED, 1 / 0.02**2)  # more than their pixels are apart
    noisy = [
        replace(v, strength=np.where(v.z * v.unit < 1, np.minimum(v.strength, code), v.strength))
        for v in views
    ]
    noisy = [replace(view, strength=view.strength.astype(np.uint8)) for view in noisy]
    coarser = fuse_surface(noisy, poses)
    assert edge_at(coarser, 0.5, 0.65) > 1.7 * edge_at(mesh, 0.5, 0.65)
    assert edge_at(coarser, 5.9, 6.1) == pytest.approx(edge_at(mesh, 5.9, 6.1), rel=0.05)


def test_surfaces_at_similar_distances_have_one_voxel() -> None:
    rng = np.random.default_rng(1)
    ranges = plane_range(EYE, np.array([0.3, 0, 1.0]), 2.0, CAMERA)
    view = RangeView.of(frame_of(ranges, camera=CAMERA, noise=rng, sigma=0.004))
    assert fitting_levels([view], fitting_voxel([view])) == range(1)


def test_levels_of_empty_views() -> None:
    empty = RangeView.of(frame_of(np.full((120, 160), np.inf), camera=CAMERA))
    assert fitting_levels([empty], fitting_voxel([empty])) == range(1)
    assert len(fuse_surface([empty, empty], np.array([EYE, EYE]))) == 0
