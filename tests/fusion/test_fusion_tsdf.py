"""TSDF surfaces: position, closedness, excluded parts, and reproducibility."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from ball_views import CAMERA, EYE, around_a_ball, frame_of, look, plane_range, sphere_range
from tofuse.engine.cameras.cameras import BrownConrady, Pinhole
from tofuse.engine.compute.spill import Spill
from tofuse.engine.frames.frames import SATURATED_AMPLITUDE, CloudFrame, RangeFrame
from tofuse.engine.fusion.block_kernels import block_of, voxel_of
from tofuse.engine.fusion.cloud import has_color
from tofuse.engine.fusion.layout import Layout
from tofuse.engine.fusion.model import ModelBuilder
from tofuse.engine.fusion.options import Fusion
from tofuse.engine.fusion.range_view import DECODED, CameraCorrection, RangeView
from tofuse.engine.fusion.tsdf import Volume, fuse_surface
from tofuse.engine.geometry import se3
from tofuse.engine.refinement.fixed_pattern import FixedPattern
from tofuse.engine.refinement.refinement import without_errors
from tofuse.engine.sensor.camera_errors import CameraErrors
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions
from whole_volume import volume_around


@pytest.fixture(scope="module")
def ball():
    frames, poses = around_a_ball(noise=np.random.default_rng(1))
    views = [RangeView.of(f) for f in frames]
    return views, poses, fuse_surface(views, poses, Fusion(voxel_m=0.012))


def edges_of(faces):
    """Directed edges (3 M, 2) of triangles."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def test_exact_zero_level_is_closed_across_blocks() -> None:
    frames, poses = around_a_ball()
    volume = volume_around([RangeView.of(f) for f in frames], poses, 0.012)
    volume.distance[:] = np.linalg.norm(voxels_of(volume), axis=-1) - 0.3
    volume.weight[:] = 1e6
    volume.seen[:] = 1
    mesh = volume.surface()
    edges = edges_of(mesh.faces)
    there, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 1).all()  # a directed edge is of one face: orientation is consistent
    np.testing.assert_array_equal(there, np.unique(edges[:, ::-1], axis=0))  # no border
    # Euler: V - E + F = 2 for a ball.
    assert len(mesh) - len(edges) // 2 + len(mesh.faces) == 2
    assert len(mesh) > 5000
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.3, atol=2e-4)
    np.testing.assert_allclose(mesh.normals, mesh.vertices / 0.3, atol=0.02)
    np.testing.assert_allclose(mesh.sigma, 1e-3)


def test_noisy_surface_is_closed(ball) -> None:
    edges = edges_of(ball[2].faces)
    there, count = np.unique(edges, axis=0, return_counts=True)
    back, count_back = np.unique(edges[:, ::-1], axis=0, return_counts=True)
    np.testing.assert_array_equal(there, back)
    np.testing.assert_array_equal(count, count_back)
    assert (count > 1).mean() < 0.001  # where the surface touches itself


def test_noisy_ball_has_correct_radius_and_normals(ball) -> None:
    _, _, mesh = ball
    p = mesh.vertices.astype(float)
    r = np.linalg.norm(p, axis=1)
    assert np.abs(r - 0.3).mean() < 0.002  # noise of 5 mm in each image
    assert np.percentile(np.abs(r - 0.3), 99) < 0.006
    outwards = p / r[:, None]
    assert ((mesh.normals * outwards).sum(1) > np.cos(np.radians(25))).mean() > 0.98
    a, b, c = (p[mesh.faces[:, k]] for k in range(3))
    face_normals = np.cross(b - a, c - a)
    assert ((face_normals * a).sum(1) > 0).mean() > 0.999
    area = np.linalg.norm(face_normals, axis=1).sum() / 2
    assert area == pytest.approx(4 * np.pi * 0.09, rel=0.03)
    assert mesh.views.max() > 2
    assert 0.0005 < np.median(mesh.sigma) < 0.005


def pixels_of(view):
    """(H, W, 5) plane n . p = h of each pixel as n, h, and its weight, 0 where unknown."""
    n = view.normals / 127.0
    along = (n[..., :2] * view.projection.rays).sum(-1) + n[..., 2]
    weight = DECODED[view.strength] * ((view.z > 0) & (along > 0))
    return np.concatenate([n, (view.z * view.unit * along)[..., None], weight[..., None]], -1)


def voxels_of(volume):
    """(B, 512, 3) positions of the voxels, in m."""
    ijk = np.array([block_of(int(key)) for key in volume.keys])
    inside = np.array([voxel_of(v) for v in range(512)])
    return (8 * ijk[:, None] + inside[None]) * volume.voxel_m


def slow_distances(volume, views, poses):
    """Sums over all views for every voxel, by the camera's own projection."""
    world = voxels_of(volume)
    top, weight, seen = (np.zeros(world.shape[:2]) for _ in range(3))
    margin = np.full(world.shape[:2], np.inf)
    for view, T in zip(views, poses, strict=True):
        p = se3.transform(se3.inverse(T), world.reshape(-1, 3)).reshape(world.shape)
        uv = CAMERA.project(p)
        good = (p[..., 2] > 1e-3) & np.isfinite(uv).all(-1)
        u = np.where(good, uv[..., 0], 0)
        w = np.where(good, uv[..., 1], 0)
        # Voxels that land between two pixels may go to either.
        for x in (u, w):
            margin = np.minimum(margin, np.where(good, 0.5 - np.abs(x - np.round(x)), np.inf))
        c, r = np.round(u).astype(int), np.round(w).astype(int)
        good &= (c >= 0) & (r >= 0) & (c < 88) & (r < 72)
        pixel = pixels_of(view)[np.where(good, r, 0), np.where(good, c, 0)]
        d = pixel[..., 3] - (pixel[..., :3] * p).sum(-1)
        good &= (pixel[..., 4] > 0) & (d >= -volume.reach_m)
        wt = np.where(good, pixel[..., 4], 0)
        top += wt * np.minimum(d, volume.reach_m)
        weight += wt
        seen += good & (d < volume.reach_m)
    return np.divide(top, weight, out=np.zeros_like(top), where=weight > 0), weight, seen, margin


def test_distances_match_slow_sum_over_views() -> None:
    # A ball in front of a wall, gone after two views: free-space violations, occlusion and jumps.
    rng = np.random.default_rng(2)
    poses = np.array([look([x, 0.1 * x, 0], [0.2 * x, 0, 2]) for x in np.linspace(-1.2, 1.2, 5)])
    views = []
    for k, T in enumerate(poses):
        wall = plane_range(T, np.array([0, 0, 1.0]), 2.0)
        ball = sphere_range(T, np.array([0, 0, 1.2]), 0.3 if k < 2 else 0.0)
        views.append(RangeView.of(frame_of(np.minimum(wall, ball), noise=rng)))
    volume = volume_around(views, poses, 0.01)
    volume.add(views, poses)
    assert (volume.free > 0).sum() > 10
    volume.surface()  # applies free-space violations
    distance, weight, seen, margin = slow_distances(volume, views, poses)
    near = (seen > 0) & (margin > 0.05)
    assert near.sum() > 10_000
    assert (volume.seen[near] != seen[near]).mean() < 1e-3  # at the truncation, by rounding
    # Blocks with free-space violations use the least weight of the pixels behind them.
    assert (volume.weight[near] > weight[near] * (1 + 1e-5)).mean() < 1e-3  # truncation again
    exact = near & np.isclose(volume.weight, weight, rtol=1e-4) & (volume.seen == seen)
    assert exact.sum() > 0.6 * near.sum()
    np.testing.assert_allclose(volume.distance[exact], distance[exact], atol=2e-5)
    # That changes few distances.
    assert np.abs(volume.distance - distance)[near].mean() < 0.01 * volume.reach_m


def test_blocks_lie_near_surfaces_for_any_number_of_views(ball) -> None:
    views, poses, _ = ball
    once = volume_around(views, poses, 0.012)
    twice = volume_around([*views, *views], np.concatenate([poses, poses]), 0.012)
    np.testing.assert_array_equal(once.keys, twice.keys)
    assert (np.diff(once.keys) > 0).all()
    corners = np.array([[(k >> s & 0x1FFFFF) - (1 << 20) for s in (42, 21, 0)] for k in once.keys])
    off = np.abs(np.linalg.norm((corners + 0.5) * 8 * 0.012, axis=1) - 0.3)
    assert off.max() < once.reach_m + 0.02 + np.sqrt(3) * 4 * 0.012


def test_free_space_removes_ghost_of_one_view() -> None:
    wall = [plane_range(look([x, 0, 0], [x, 0, 2]), np.array([0, 0, 1.0]), 2.0) for x in (0, 0.1)]
    poses = np.array([look([x, 0, 0], [x, 0, 2]) for x in (0, 0.1)] * 4)
    frames = [frame_of(wall[k % 2], k) for k in range(8)]
    ghost = wall[0].copy()
    ghost[26:48, 30:56] = 1.4  # too large for an island
    views = [RangeView.of(f) for f in frames]
    options = Fusion(voxel_m=0.02, island=10)
    alone = fuse_surface([RangeView.of(frame_of(ghost, 0))], poses[:1], options)
    assert (np.abs(alone.vertices[:, 2] - 1.4) < 0.05).sum() > 50
    views[0] = RangeView.of(frame_of(ghost, 0))
    mesh = fuse_surface(views, poses, options)
    assert np.abs(mesh.vertices[:, 2] - 2).max() < 0.02
    assert len(mesh) > 1000


def test_noisy_views_make_one_surface_not_several() -> None:
    """A view ignores what is behind its surface only where that is significant."""
    code = 137
    assert 1 / np.sqrt(DECODED[code]) == pytest.approx(0.05, rel=0.1)
    views = []
    for k in range(7):
        z = 3.13 if k == 3 else 3.0  # 2.6 sigmas
        view = RangeView.of(frame_of(plane_range(EYE, np.array([0, 0, 1.0]), z), k))
        noisy = np.where(view.strength > 0, code, 0).astype(np.uint8)
        views.append(replace(view, strength=noisy))
    poses = np.array([EYE] * 7)
    volume = volume_around(views, poses, 0.03)
    assert volume.reach_m < 0.1
    volume.add(views, poses)
    z = volume.surface().vertices[:, 2]
    assert len(z) > 1000
    assert np.abs(z - 3).max() < 0.05
    # What is significantly behind is kept: precise views do not measure it.
    sure = [replace(v, strength=np.where(v.strength > 0, 200, 0).astype(np.uint8)) for v in views]
    volume = volume_around(sure, poses, 0.03)
    volume.add(sure, poses)
    assert (np.abs(volume.surface().vertices[:, 2] - 3.13) < 0.01).sum() > 500


def test_surfaces_end_at_depth_jumps() -> None:
    ranges = plane_range(EYE, np.array([0, 0, 1.0]), 2.0)
    ranges[:, 40:] = plane_range(EYE, np.array([0, 0, 1.0]), 1.0)[:, 40:]
    ranges[:, 40] = 1.5  # a mixed pixel
    view = RangeView.of(frame_of(ranges, noise=np.random.default_rng(4)))
    weight = DECODED[view.strength[10:60]]
    assert (weight[:, 40] == 0).all()
    middle = np.median(weight[:, 10:36])
    for beside, wall in ((39, 2.0), (41, 1.0)):
        assert (weight[:, beside] > 0).mean() > 0.9
        assert (weight[:, beside] < 0.5 * middle).all()
        # Denoised by the plane fit, as the others are: the noise was 5 mm.
        assert np.std(view.z[10:60, beside] * view.unit - wall) < 0.0035
    assert (weight[:, 10:36] > 0.5 * middle).mean() > 0.98
    z = fuse_surface([view], EYE[None], Fusion(voxel_m=0.03, island=0)).vertices[:, 2]
    assert (np.minimum(np.abs(z - 1), np.abs(z - 2)) < 0.01).all()


@pytest.mark.parametrize("sigma", [0.002, 0.01, 0.03])
def test_weights_reflect_residual_noise(sigma) -> None:
    straight = plane_range(EYE, np.array([0, 0, 1.0]), 2.0)
    view = RangeView.of(frame_of(straight, sigma=sigma, noise=np.random.default_rng(6)))
    off = view.z[5:-5, 5:-5] * view.unit - 2.0
    pixels = pixels_of(view)[5:-5, 5:-5].astype(float)
    lengths = np.linalg.norm(np.insert(CAMERA.rays(), 2, 1, -1), axis=-1)[5:-5, 5:-5]
    cosine = np.clip(pixels[..., 2] / lengths, 0.5, 1)
    stated = 1 / (cosine * np.sqrt(np.maximum(pixels[..., 4], 1e-9)))
    fitted = pixels[..., 4] > 0
    assert fitted.mean() > 0.9
    ratio = off[fitted].std() / np.median(stated[fitted])
    assert 0.2 < ratio < 1.6  # possible relief counts as uncertainty, but not as noise
    assert off[fitted].std() < sigma


def test_views_without_colour_do_not_darken() -> None:
    ranges = plane_range(EYE, np.array([0, 0, 1.0]), 2.0)
    red = np.zeros((72, 88, 3), np.uint8)
    red[..., 0] = 200
    colors = (None, np.zeros_like(red), red, None)
    views = [RangeView.of(frame_of(ranges, k, color_image=c)) for k, c in enumerate(colors)]
    mesh = fuse_surface(views, np.stack([EYE] * 4), Fusion(voxel_m=0.03))
    np.testing.assert_array_equal(np.unique(mesh.color, axis=0), [[200, 0, 0]])
    assert (mesh.views == 4).all()


def test_dark_surfaces_have_a_colour_and_unknown_ones_take_no_contrast() -> None:
    ranges = plane_range(EYE, np.array([0, 0, 1.0]), 2.0)
    albedo = np.tile(np.linspace(50, 1000, 88), (72, 1))
    partly = np.where(np.arange(72)[:, None] < 60, albedo, 0)
    shades = []
    for light, share in ((albedo, 1.0), (partly, 60 / 72)):
        frame = frame_of(ranges, amplitude_image=(light / ranges**2).astype(np.float32))
        mesh = fuse_surface([RangeView.of(frame)], EYE[None], Fusion(voxel_m=0.03))
        known = has_color(mesh.color)
        assert known.mean() == pytest.approx(share, abs=0.04 * (share < 1))
        shades.append(np.quantile(mesh.color[known], (0.02, 0.5, 0.98)))
    np.testing.assert_allclose(*shades, atol=8)
    assert shades[0][0] < 40


def test_views_without_colour_do_not_count_in_the_mean() -> None:
    """Beside the field of view of the colour camera most views see a surface without colour."""
    ranges = plane_range(EYE, np.array([0, 0, 1.0]), 2.0)
    colors = [
        None if c is None else np.full((72, 88, 3), c, np.uint8) for c in (*[None] * 5, 100, 200)
    ]
    views = [RangeView.of(frame_of(ranges, k, color_image=c)) for k, c in enumerate(colors)]
    mesh = fuse_surface(views, np.stack([EYE] * len(views)), Fusion(voxel_m=0.03))
    np.testing.assert_array_equal(np.unique(mesh.color, axis=0), [[150, 150, 150]])


@pytest.mark.parametrize("scale", [1, 8])  # from 4 on, images are stored at half resolution
@pytest.mark.parametrize("channel", ["color_image", "amplitude_image"])
def test_surfaces_do_not_darken_where_known_colours_end(scale: int, channel: str) -> None:
    rows, columns, edge = 72 * scale, 88 * scale, 40 * scale + 1
    camera = Pinhole(columns, rows, 80.0 * scale, 80.0 * scale, columns / 2, rows / 2)
    image = np.zeros((rows, columns, 3), np.uint8)
    image[:, :edge] = 200
    if channel == "amplitude_image":
        image = image[..., 0].astype(np.float32)
        image[: rows // 2, edge:] = SATURATED_AMPLITUDE
    depth = np.full((rows, columns), 2.0, np.float32)
    frame = RangeFrame(
        0, 0.0, camera, depth, amplitude_kind="range_compensated", **{channel: image}
    )
    view = RangeView.of(frame)
    assert len(np.unique(view.intensity)) == 2  # the colour, and unknown
    layout = Layout.of([view], EYE[None], 0.03)
    volume = Volume.of(layout, layout.single_region())
    volume.add([view], EYE[None])
    intensity = volume.piece().intensity
    known = intensity[:, 0] > 0
    assert 0.3 < known.mean() < 0.7
    np.testing.assert_allclose(intensity[known], view.intensity.max(), rtol=1e-5)


def test_albedo_is_grey_and_does_not_fall_with_range() -> None:
    # Two walls of one albedo, at 1 m and 2 m, and a dark patch.
    ranges = plane_range(EYE, np.array([0, 0, 1.0]), 2.0)
    ranges[:, :40] = plane_range(EYE, np.array([0, 0, 1.0]), 1.0)[:, :40]
    albedo = np.full((72, 88), 4000.0)
    albedo[50:, 60:] = 500
    view = RangeView.of(frame_of(ranges, amplitude_image=(albedo / ranges**2).astype(np.float32)))
    mesh = fuse_surface([view], EYE[None], Fusion(voxel_m=0.03))
    near, far = mesh.vertices[:, 2] < 1.5, mesh.vertices[:, 2] > 1.5
    assert np.median(mesh.color[near]) == np.median(mesh.color[far])
    assert mesh.color.min() < 60


def test_large_images_are_stored_at_half_resolution() -> None:
    camera = Pinhole(640, 480, 580.0, 580.0, 320.0, 240.0)
    depth = np.full((480, 640), 2.0, np.float32)
    depth[200:, 300:] = 0
    color = np.zeros((480, 640, 3), np.uint8)
    color[:, :320] = 90
    view = RangeView.of(RangeFrame(0, 0.0, camera, depth, color_image=color))
    assert view.z.shape == (240, 320)
    assert view.nbytes <= 10 * 240 * 320
    assert view.intensity[100, 100].tolist() == [90, 90, 90]
    assert (view.z[100:, 150:] == 0).all()
    assert np.abs(fuse_surface([view], EYE[None]).vertices[:, 2] - 2).max() < 0.002


def test_empty_views_make_empty_mesh() -> None:
    mesh = fuse_surface([RangeView.of(frame_of(np.full((72, 88), np.inf)))], EYE[None])
    assert (len(mesh), len(mesh.faces)) == (0, 0)
    assert mesh.cloud().points.shape == (0, 3)


def test_builder_keeps_views_within_memory_limit() -> None:
    frames, poses = around_a_ball(60, noise=np.random.default_rng(1))
    posed = dict(enumerate(poses))
    models = []
    for options in (Fusion(voxel_m=0.02), Fusion(voxel_m=0.02, memory_mb=1)):
        spill = Spill(options.memory_mb * 500_000)
        builder = ModelBuilder(options, spill)
        for frame in frames:
            builder.add(frame, None, 1000)
        assert builder.views == 60
        advanced: list[None] = []
        errors = {"scale": 0.01}
        models.append(
            [
                builder.fuse(posed, partial(advanced.append, None)),
                builder.fuse(posed, errors=errors),
                builder.fuse(posed),
            ]
        )
        assert len(advanced) == 60
        assert (spill.spilled_bytes > 0) == (options.memory_mb == 1)
        assert spill.resident_bytes <= options.memory_mb * 500_000
        assert len(spill) == 60  # views are corrected without copies
        assert len(builder.sketch(posed)) > 500
    for large, small in zip(*models, strict=True):
        for name in ("vertices", "faces", "normals", "color", "sigma", "views"):
            a, b = getattr(large.mesh, name), getattr(small.mesh, name)
            np.testing.assert_array_equal(a, b)
    assert models[0][0].mesh.views.max() > 20


def test_camera_errors_are_corrected_in_images_as_in_points() -> None:
    frame = frame_of(np.random.default_rng(5).uniform(1, 3, (72, 88)))
    frame = replace(frame, camera=Pinhole(88, 72, 90.0, 90.0, 43.0, 36.0))  # points have no lens
    errors = {"offset": 0.03, "scale": -0.01, "focal": 0.02}
    correction = CameraCorrection(errors)
    view = RangeView.of(replace(frame, depth_kind="z"))
    found = [correction(view), correction(view)]
    expected = without_errors(view.as_cloud().points, errors)
    np.testing.assert_allclose(found[1].as_cloud().points, expected, atol=2e-3)
    # Where the range is measured, it is what a wrong focal length leaves alone.
    measured = RangeView.of(frame)
    before, after = (
        np.linalg.norm(v.as_cloud().points, axis=1) for v in (measured, correction(measured))
    )
    np.testing.assert_allclose(after, 0.99 * before + 0.03, atol=2e-4)
    assert found[0].projection is found[1].projection
    # Points still project onto the pixels that measured them.
    p = found[0].projection
    x, y = p.rays[20, 30]
    node = (x - p.frame[0]) * p.frame[2], (y - p.frame[1]) * p.frame[3]
    i, j = (int(n) for n in node)
    a, b = node[0] - i, node[1] - j
    corners = p.lookup[j : j + 2, i : i + 2].astype(float)
    landed = np.einsum("j,i,jik->k", [1 - b, b], [1 - a, a], corners)
    np.testing.assert_allclose(landed, [30, 20], atol=0.1)
    builder = ModelBuilder(Fusion())
    builder.add(frame_of(plane_range(EYE, np.array([0, 0, 1.0]), 2.0)), None, 1000)
    z = builder.fuse({0: EYE}, errors={"scale": 0.05}).mesh.vertices[:, 2]
    np.testing.assert_allclose(z, 2.1, atol=0.003)


def test_an_error_of_the_focal_length_moves_rays_by_the_slope_of_the_distortion() -> None:
    camera = BrownConrady(88, 72, 60.0, 60.0, 43.5, 35.5, k1=-0.15, k2=0.02)
    view = RangeView.of(RangeFrame(0, 0.0, camera, np.full((72, 88), 2, np.float32)))
    corrected = CameraCorrection({"focal": 0.02})(view).projection
    expected = CameraErrors(focal=0.02).camera(camera)
    rays = expected.rays()[6:-6, 6:-6]  # of a lens that is known beyond them
    np.testing.assert_allclose(corrected.rays[6:-6, 6:-6], rays, atol=1e-4)
    landed = corrected.pixels(rays.reshape(-1, 2).astype(float))
    np.testing.assert_allclose(landed[0], [6, 6], atol=0.05)
    np.testing.assert_allclose(landed[-1], [81, 65], atol=0.05)


RANGES = plane_range(EYE, np.array([0, 0, 1.0]), 2.0)
WAVE = 0.01 * np.sin(np.linspace(0, 2 * np.pi, 88))[None] * np.ones((72, 1))
ALONG = (0.015 * np.sin(4 * np.pi * np.linspace(0, 3, 900))).astype(np.float32)


@pytest.mark.parametrize(
    ("errors", "pattern"),
    [
        (WAVE, FixedPattern(WAVE[::2, ::2].astype(np.float32))),
        (
            0.015 * np.sin(4 * np.pi * RANGES),
            FixedPattern(np.zeros((36, 44), np.float32), profile=ALONG, reach=3.0),
        ),
    ],
    ids=["image", "range"],
)
def test_depth_errors_that_are_fixed_to_the_camera_are_removed_from_the_surface(
    errors, pattern
) -> None:
    builder = ModelBuilder(Fusion())
    builder.add(frame_of(RANGES - errors), None, 1000)
    with_errors = builder.fuse({0: EYE}).mesh.vertices[:, 2]
    without = builder.fuse({0: EYE}, pattern=pattern).mesh.vertices[:, 2]
    assert with_errors.std() > 0.005
    assert without.std() < 0.2 * with_errors.std()


def test_builder_keeps_clouds_within_memory_limit() -> None:
    rng = np.random.default_rng(4)
    clouds = [replace(CloudFrame.of(rng.normal(size=(4000, 3))), index=k) for k in range(30)]
    poses = {k: se3.exp(0.1 * rng.normal(size=6)) for k in range(0, 30, 2)}
    made = []
    for memory_mb in (600, 1):
        spill = Spill(memory_mb * 500_000)
        builder = ModelBuilder(Fusion(voxel_m=0.1, memory_mb=memory_mb), spill)
        for cloud in clouds:
            builder.add(cloud, None, 3000)
        assert builder.views == 30
        assert (spill.spilled_bytes > 0) == (memory_mb == 1)
        made += [builder.fuse(poses).cloud, builder.sketch(poses)]
    for large, small in zip(made[:2], made[2:], strict=True):
        assert large.points.tobytes() == small.points.tobytes()
        np.testing.assert_array_equal(large.views, small.views)
    assert made[0].views.max() > 1


def test_clouds_give_no_mesh_and_sparse_images_give_cloud() -> None:
    rng = np.random.default_rng(4)
    builder = ModelBuilder(Fusion())
    builder.add(CloudFrame.of(rng.normal(size=(500, 3))), None, 1000)
    model = builder.fuse({0: EYE})
    assert model.mesh is None
    assert len(model.cloud) > 400
    # A single valid pixel makes no surface.
    ranges = np.full((72, 88), np.inf)
    ranges[36, 43] = 1.0
    builder = ModelBuilder(Fusion())
    builder.add(frame_of(ranges), None, 1000)
    model = builder.fuse({0: EYE})
    assert len(model.mesh) == 0
    assert len(model.cloud) == 1


def half_dark(rng):
    """A wall 2 m away, known to 4 mm on the left and to 60 mm on the right."""
    ranges = plane_range(EYE, np.array([0, 0, 1.0]), 2.0)
    sigma = np.full(ranges.shape, 0.004, np.float32)
    sigma[:, 50:] = 0.06
    depth = (ranges + sigma * rng.standard_normal(ranges.shape)).astype(np.float32)
    return RangeFrame(0, 0.0, CAMERA, depth, "range", sigma_image=sigma)


def test_noisy_wall_has_planes_and_weights_of_its_noise() -> None:
    frame = half_dark(np.random.default_rng(7))
    view = RangeView.of(frame)
    dark, bright = np.s_[6:-6, 56:-6], np.s_[6:-6, 6:44]
    off = view.z * view.unit - 2.0
    assert np.abs(off[dark]).mean() < 0.02  # the mean error of a single pixel is 0.048
    assert (view.strength[dark] > 0).mean() > 0.95
    weight = DECODED[view.strength]
    ratio = np.median(weight[bright]) / np.median(weight[dark])
    assert 10 < ratio < 1000


def test_thinned_planes_are_restored_but_cropped_ones_are_not() -> None:
    rng = np.random.default_rng(8)
    frame = half_dark(rng)
    mask = rng.random(frame.valid.shape) < 0.4
    mask[:, :20] = False
    view = RangeView.of(frame.keep(mask), prepare_view(frame, SurfaceOptions()))
    assert (view.strength[4:-4, 24:-4] > 0).mean() > 0.93
    assert not view.strength[:, :18].any()


def test_round_robin_views_make_accurate_surface() -> None:
    """Of many views each block takes turns for free space and for far parts of the truncation."""
    frames, poses = around_a_ball(70, noise=np.random.default_rng(3))
    # Each also has one false pixel in front of the ball, where the others measure free space.
    for k, frame in enumerate(frames):
        frame.depth[30 + k % 12, 40 + k % 7] = 0.6
    views = [RangeView.of(f) for f in frames]
    assert volume_around(views, poses, 0.012).free_space_stride == 2
    mesh = fuse_surface(views, poses, Fusion(voxel_m=0.012, island=0))
    r = np.linalg.norm(mesh.vertices.astype(float), axis=1)
    assert np.abs(r - 0.3).mean() < 0.0015
    assert np.abs(r - 0.3).max() < 0.03
    assert len(mesh) == pytest.approx(1.5 * (4 * np.pi * 0.3**2) / 0.012**2, rel=0.1)
