"""The fused cloud: exact voxel averages, normals, colours, bounded memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import CloudFrame, RangeFrame
from tofuse.engine.fusion.cloud import CloudBuilder, as_cloud, choose_voxel
from tofuse.engine.fusion.options import Fusion
from tofuse.engine.geometry import se3

EYE = np.eye(4)


def view(points, index=0, **channels) -> CloudFrame:
    return CloudFrame(index, float(index), np.asarray(points, np.float32), **channels)


def fuse(views, *, voxel=0.1, poses=None, **options):
    builder = CloudBuilder(Fusion(**options), voxel)
    for k, item in enumerate(views):
        builder.add(item, EYE if poses is None else poses[k])
    return builder.finish()


def plane(rng, n=2000, z=2.0):
    points = np.empty((n, 3), np.float32)
    points[:, :2] = rng.uniform(-0.5, 0.5, (n, 2))
    points[:, 2] = z
    return points


def test_voxel_averages_views_with_equal_weight() -> None:
    first = view([[0.01, 0.02, 1.01], [0.03, 0.02, 1.03], [0.55, 0.05, 1.05]])
    found = fuse([first, view([[0.06, 0.06, 1.06]], 1)])
    assert len(found) == 2
    # Two points of the first view count as one, at their mean.
    np.testing.assert_allclose(found.points[0], [0.04, 0.04, 1.04], atol=1e-6)
    np.testing.assert_allclose(found.points[1], [0.55, 0.05, 1.05], atol=1e-6)
    assert found.views.tolist() == [2, 1]
    assert found.points.dtype == np.float32


def test_black_is_ignored_as_colour() -> None:
    points = np.array([[0.05, 0.05, 1.05], [0.55, 0.05, 1.05]], np.float32)
    seen = view(points, color=np.array([[10, 20, 30], [0, 0, 0]], np.uint8))
    found = fuse([seen, view(points, 1, color=np.zeros((2, 3), np.uint8))])
    assert found.color is not None
    np.testing.assert_array_equal(found.color, [[10, 20, 30], [128, 128, 128]])


def test_voxels_at_negative_coordinates_have_same_size() -> None:
    found = fuse([view([[-0.01, 0.05, 1.05], [0.01, 0.05, 1.05], [-0.09, 0.05, 1.05]])])
    np.testing.assert_allclose(sorted(found.points[:, 0]), [-0.05, 0.01], atol=1e-6)


def test_poses_transform_points() -> None:
    T = se3.exp(np.array([0.5, -0.2, 0.1, 0.2, -0.4, 0.3]))
    points = np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 2.0], [0.0, 0.5, 3.0]])
    found = fuse([view(points)], poses=[T], voxel=0.001)
    expected = se3.transform(T, points)
    order = np.lexsort(expected.T[::-1])
    got = found.points[np.lexsort(found.points.T[::-1])]
    np.testing.assert_allclose(got, expected[order], atol=1e-6)


def test_cloud_is_independent_of_view_order() -> None:
    rng = np.random.default_rng(1)
    views = [
        view(rng.uniform(0, 1, (500, 3)), k, amplitude=rng.uniform(1, 9, 500).astype(np.float32))
        for k in range(5)
    ]
    one, other = fuse(views), fuse(views[::-1])
    np.testing.assert_array_equal(one.views, other.views)
    np.testing.assert_allclose(one.points, other.points, atol=1e-6)
    assert np.abs(one.color.astype(int) - other.color).max() <= 1


def test_no_points_give_empty_cloud() -> None:
    for found in (fuse([]), fuse([view(np.zeros((0, 3)))])):
        assert len(found) == 0
        assert found.points.shape == (0, 3)
        assert found.normals is None


def test_normals_face_camera() -> None:
    points = plane(np.random.default_rng(3))
    found = fuse([view(points)], voxel=0.02)
    np.testing.assert_allclose(found.normals, np.tile([0, 0, -1], (len(found), 1)), atol=1e-5)
    # Seen from behind, the same plane has opposite normals.
    T_behind = se3.exp(np.array([0, 0, 0, 0, np.pi, 0.0]))
    T_behind[:3, 3] = [0, 0, 4]
    behind = fuse([view(se3.transform(se3.inverse(T_behind), points))], poses=[T_behind])
    np.testing.assert_allclose(behind.normals, np.tile([0, 0, 1], (len(behind), 1)), atol=1e-5)


def test_amplitude_is_range_compensated_to_grey() -> None:
    # One albedo at 1 m and 3 m: the amplitude falls with the square, the grey must not.
    z = np.repeat([1.0, 3.0], 50)
    albedo = np.tile(np.repeat([0.2, 0.8], 25), 2)
    points = np.c_[np.arange(100) * 0.0, np.arange(100) * 0.0, z + np.tile(np.arange(50), 2) * 1e-3]
    distance = np.linalg.norm(points, axis=1)
    found = fuse([view(points, amplitude=(albedo / distance**2).astype(np.float32))], voxel=0.000_5)
    grey = found.color[:, 0].astype(int)
    assert (found.color == found.color[:, :1]).all()
    near = found.points[:, 2] < 2
    dark = (found.points[:, 2] % 1) < 0.0245
    assert grey[near & dark].max() <= grey[near & ~dark].min() - 100
    assert abs(grey[near & dark].mean() - grey[~near & dark].mean()) < 2
    assert abs(grey[near & ~dark].mean() - grey[~near & ~dark].mean()) < 2


@pytest.mark.parametrize("thinned", [False, True])
def test_compensated_amplitude_is_not_compensated_again(thinned) -> None:
    camera = Pinhole(100, 80, 200.0, 200.0, 50.0, 40.0)
    depth = np.full((80, 100), 1.0, np.float32)
    depth[:, 50:] = 3.0
    albedo = np.where(np.arange(80)[:, None] < 40, 200.0, 800.0) * np.ones((1, 100))
    frame = RangeFrame(0, 0.0, camera, depth)
    square = (frame.point_image.astype(float) ** 2).sum(-1)
    raw = replace(frame, amplitude_image=(1000 * albedo / square).astype(np.float32))
    compensated = replace(
        frame, amplitude_image=albedo.astype(np.float32), amplitude_kind="range_compensated"
    )
    found = [fuse([as_cloud(f, 10**6) if thinned else f]) for f in (raw, compensated)]
    assert (found[0].color.min(), found[0].color.max()) == (1, 255)  # black is no colour
    assert np.abs(found[0].color.astype(int) - found[1].color).max() <= 1


def test_colour_is_averaged_and_preferred_to_amplitude() -> None:
    point = [[0.05, 0.05, 1.05]]
    views = [
        view(point, 0, color=np.array([[10, 20, 30]], np.uint8)),
        view(point, 1, color=np.array([[30, 40, 50]], np.uint8)),
        view([*point, [0.55, 0.05, 1.05]], 2, amplitude=np.array([5, 5], np.float32)),
    ]
    found = fuse(views)
    assert found.color[0].tolist() == [20, 30, 40]
    assert found.color[1, 0] == found.color[1, 1] == found.color[1, 2]
    assert fuse([view(point)]).color is None


def test_voxel_size_follows_point_spacing() -> None:
    square = np.mgrid[0:50, 0:50, 0:1].reshape(3, -1).T * 0.02
    assert choose_voxel(view(square)) == pytest.approx(0.02, rel=0.1)
    assert choose_voxel(view(square / 1000)) == 0.002
    assert choose_voxel(view(square * 1000)) == 0.1
    assert choose_voxel(view(np.zeros((0, 3)))) > 0
