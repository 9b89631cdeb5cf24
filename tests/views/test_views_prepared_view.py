"""Views prepared for tracking, on known scenes of planes."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tofuse.engine.alignment.projective import ProjectiveOptions, Target, align
from tofuse.engine.cameras.cameras import BrownConrady, Pinhole, RayTable, ray_lengths
from tofuse.engine.compute.thread_pool import threads
from tofuse.engine.frames.frames import SATURATED_AMPLITUDE, RangeFrame
from tofuse.engine.views.extended_planes import with_extended_planes
from tofuse.engine.views.prepared_view import PreparedView, prepare_view
from tofuse.engine.views.view_planes import FineScale, SurfaceOptions

CAMERA = Pinhole(88, 72, 115.0, 115.0, 43.5, 35.5)
PLANE = np.array([0.1, -0.15, 0.5])  # a X + b Y + c Z = 1
OPTIONS = SurfaceOptions()
NEVER = FineScale(noise=0)


def wall(camera=CAMERA, sigma=0.0, seed=0, *, kind="z", amplitude="raw", spread=0.0, texture=0.0):
    """A slanted wall with Gaussian noise of the range; `spread` makes the noise uneven."""
    rays = camera.rays().astype(float)
    z = 1 / (rays @ PLANE[:2] + PLANE[2])
    r = z * ray_lengths(camera)
    cosine = np.abs((rays @ PLANE[:2] + PLANE[2]) / ray_lengths(camera)) / np.linalg.norm(PLANE)
    light = 1000 * np.exp(texture * rays[..., 0] + spread * np.sin(9 * rays[..., 1])) * cosine
    raw = light / r**2
    noise = np.random.default_rng(seed).normal(size=z.shape) * sigma
    if spread:  # as with shot noise: one over the raw amplitude
        noise *= np.median(raw) / raw
    z = z * (1 + noise / z)
    depth = z if kind == "z" else z * ray_lengths(camera)
    image = {"raw": raw, "ir": raw, "range_compensated": light, None: None}[amplitude]
    if image is not None:
        image = image.astype(np.float32)
    return RangeFrame(
        3,
        0.1,
        camera,
        depth.astype(np.float32),
        kind,
        amplitude_image=image,
        amplitude_kind=amplitude or "raw",
    )


def inside(view: PreparedView, margin=4):
    return np.s_[margin:-margin, margin:-margin]


@pytest.mark.parametrize("sigma", [0.001, 0.004, 0.02])
@pytest.mark.parametrize("amplitude", ["raw", "range_compensated", "ir", None])
def test_noise_is_estimated_from_view(sigma, amplitude):
    view = prepare_view(wall(sigma=sigma, amplitude=amplitude), OPTIONS)
    assert np.median(view.sigma[view.sigma > 0]) == pytest.approx(sigma, rel=0.15)


@pytest.mark.parametrize("amplitude", ["raw", "range_compensated"])
def test_noise_is_larger_at_low_amplitude(amplitude):
    frame = wall(sigma=0.004, amplitude=amplitude, spread=0.5)
    view = prepare_view(frame, OPTIONS)
    off = (frame.z - wall(sigma=0.0, amplitude=amplitude, spread=0.5).z) / view.sigma
    raw = wall(amplitude="raw", spread=0.5).amplitude_image
    for part in (raw < np.quantile(raw, 0.3), raw > np.quantile(raw, 0.7)):
        assert off[part].std() == pytest.approx(1, rel=0.15)


def test_floor_in_coarse_image_is_no_edge() -> None:
    """Its depth changes by more than `edge_jump` from row to row, far from any edge."""
    camera = Pinhole(64, 48, 45.0, 45.0, 31.5, 23.5)
    rays = camera.rays().astype(float)
    z = 1.2 / (rays[..., 1] + 0.75)  # 1.2 m below, seen at 53 degrees and less
    assert np.median(np.abs(np.diff(z, axis=0)) / z[1:]) > 0.025
    noise = np.random.default_rng(6).normal(0, 0.004, z.shape) * z
    view = prepare_view(RangeFrame(0, 0.0, camera, (z + noise).astype(np.float32)), OPTIONS)
    assert view.planar_fraction > 0.7


@pytest.mark.parametrize("share", [0.1, 0.5, 0.8])
def test_scattered_gaps_reduce_resolution_but_keep_planes(share: float) -> None:
    camera = Pinhole(352, 288, 460.0, 460.0, 175.5, 143.5)
    frame = wall(camera, 0.005)
    rng = np.random.default_rng(4)
    sparse = frame.keep(rng.random(frame.depth.shape) >= share)
    view = prepare_view(sparse, OPTIONS)
    assert np.count_nonzero(view.planes[..., 3]) > 1000
    found = view.planes[view.planes[..., 3] > 0][:, :3]
    assert np.median(found, axis=0) == pytest.approx(PLANE, abs=0.01)


def test_sparse_depth_is_downsampled_until_dense() -> None:
    camera = Pinhole(320, 240, 420.0, 420.0, 159.5, 119.5)
    frame = wall(camera, 0.005)
    grid = np.zeros(frame.depth.shape, bool)
    grid[1::4, 2::4] = True
    view = prepare_view(frame.keep(grid), OPTIONS)
    assert view.z.shape == (60, 80)
    assert view.planar_fraction > 0.8


def test_saturated_pixels_do_not_darken_their_neighbours() -> None:
    frame = wall(Pinhole(640, 480, 840.0, 840.0, 319.5, 239.5), amplitude=None)  # halved
    color = np.full((480, 640, 3), 200, np.uint8)
    whole = prepare_view(replace(frame, color_image=color.copy()), OPTIONS).albedo[..., 0]
    color[:, 301:340] = 255
    holed = prepare_view(replace(frame, color_image=color), OPTIONS).albedo[..., 0]
    assert np.isnan(holed).sum() > np.isnan(whole).sum()
    assert np.nanmax(np.abs(holed - whole)) < 0.01


def test_connected_gaps_keep_resolution() -> None:
    camera = Pinhole(320, 240, 420.0, 420.0, 159.5, 119.5)
    frame = wall(camera, 0.005)
    kept = np.ones(frame.depth.shape, bool)
    kept[60:180, 40:200] = False
    blocks = np.random.default_rng(5).random((30, 40)) >= 0.4
    scattered = np.kron(blocks, np.ones((8, 8), bool))
    assert prepare_view(frame.keep(scattered), OPTIONS).z.shape == (240, 320)
    assert prepare_view(frame.keep(kept), OPTIONS).z.shape == (240, 320)
    assert prepare_view(frame.keep(np.zeros_like(kept)), OPTIONS).z.shape == (240, 320)


def test_stated_noise_is_used_up_to_a_factor():
    frame = wall(sigma=0.004)
    ramp = np.linspace(0.5, 2, 72, dtype=np.float32)[:, None].repeat(88, 1)
    view = prepare_view(replace(frame, sigma_image=0.0003 * ramp), OPTIONS)
    ratio = view.sigma / ramp * ray_lengths(CAMERA)
    np.testing.assert_allclose(ratio, ratio[0, 0], rtol=1e-5)
    assert ratio[0, 0] > 0.001  # the view reveals 4 mm at places


def test_stated_variance_matches_errors():
    offs = []
    for seed in range(4):
        view = prepare_view(wall(sigma=0.005, seed=seed), OPTIONS)
        true = view.rays.astype(float) @ PLANE[:2] + PLANE[2]
        good = view.planes[..., 3] > 0
        offs.append(((view.planes[..., 3] - true) / np.sqrt(view.plane_variance + 1e-30))[good])
    assert np.concatenate(offs).std() == pytest.approx(1, rel=0.15)


@pytest.mark.parametrize("kind", ["z", "range"])
def test_planes_match_scene_for_any_depth_kind(kind):
    view = prepare_view(wall(kind=kind), OPTIONS)
    assert view.index == 3
    assert view.planar_fraction > 0.9
    assert np.abs(view.planes[inside(view)][..., :3] - PLANE).max() < 1e-3
    unit = PLANE / np.linalg.norm(PLANE)
    assert np.abs(view.normals[inside(view)] - unit).max() < 1e-3
    assert (view.normals[view.planes[..., 3] == 0] == 0).all()


def test_saturated_pixels_have_no_albedo():
    frame = wall()
    light = frame.amplitude_image.copy()
    light[30:40, 30:40] = SATURATED_AMPLITUDE
    view = prepare_view(replace(frame, amplitude_image=light), OPTIONS)
    assert np.isnan(view.albedo[30:40, 30:40]).all()
    good = np.isfinite(view.albedo[..., 0])
    assert np.ptp(view.albedo[good][:, 0]) < 0.05


@pytest.mark.parametrize("columns", [88, 44])
def test_ray_table_with_unknown_rays(columns):
    lens = BrownConrady(88, 72, 115.0, 115.0, 43.5, 35.5, k1=-0.2)
    table = lens.rays().copy()
    table[:6, :6] = np.nan
    table[41, 50] = np.nan  # one of four, when halved
    bent = wall(lens)
    view = prepare_view(replace(bent, camera=RayTable(table)), SurfaceOptions(columns=columns))
    whole = prepare_view(bent, SurfaceOptions(columns=columns))
    step = 88 // columns
    assert view.z.shape == (72 // step, columns)
    assert (view.planes[: 4 // step, : 4 // step] == 0).all()
    for name in ("planes", "plane_variance", "sigma"):
        assert np.isfinite(getattr(view, name)).all(), name
    # Far from the gaps the result is unchanged.
    far = np.s_[-20 // step :, : 60 // step]
    np.testing.assert_allclose(view.planes[far], whole.planes[far], atol=1e-4)
    assert view.planar_fraction > 0.7


@pytest.mark.parametrize("columns", [320, 44])
@pytest.mark.parametrize("amplitude", ["raw", "range_compensated", None])
def test_view_without_valid_pixels_has_no_surface(columns, amplitude):
    frame = wall(amplitude=amplitude)
    blank = replace(frame, depth=np.zeros_like(frame.depth))
    view = prepare_view(blank, SurfaceOptions(columns=columns))
    assert view.planar_fraction == 0
    assert np.isfinite(view.sigma).all()
    assert np.isnan(view.albedo).all()


@pytest.mark.parametrize("shape", [(2, 2), (2, 40), (40, 2), (5, 5), (3, 100)])
def test_tiny_images_are_prepared(shape):
    camera = Pinhole(shape[1], shape[0], 50.0, 50.0, shape[1] / 2, shape[0] / 2)
    view = prepare_view(wall(camera), SurfaceOptions(columns=16))
    assert view.planes.shape == (*view.z.shape, 4)
    assert np.isfinite(view.planes).all()
    assert 0 <= view.planar_fraction <= 1


def test_frame_of_invalid_values_is_prepared():
    rng = np.random.default_rng(5)
    depth = rng.choice([0, 1e-30, 1e-3, 1.0, 1e4, 1e30, np.inf, np.nan, -1], (72, 88))
    light = rng.choice([0, -1, 1.0, 1e30, np.inf, np.nan], (72, 88)).astype(np.float32)
    sigma = rng.choice([0, -1, 1.0, 1e-30, 1e30, np.inf, np.nan], (72, 88)).astype(np.float32)
    base = RangeFrame(0, 0.0, CAMERA, depth.astype(np.float32), amplitude_image=light)
    for frame in (base, replace(base, sigma_image=sigma)):
        assert np.isfinite(prepare_view(frame, OPTIONS).planes).all()


def test_result_is_independent_of_threads():
    frame = wall(sigma=0.005)
    with threads(1):
        one = prepare_view(frame, OPTIONS)
    with threads(2):
        two = prepare_view(frame, OPTIONS)
    for name in ("planes", "plane_variance", "albedo", "sigma"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


@pytest.mark.parametrize("columns", [320, 50])
def test_stated_range_noise_is_converted_to_z_at_any_resolution(columns):
    """Regardless of the view, which has no noise here."""
    camera = Pinhole(88, 72, 60.0, 60.0, 43.5, 35.5)
    frame = wall(camera)
    view = prepare_view(
        replace(frame, sigma_image=np.full((72, 88), 0.01, np.float32)),
        replace(OPTIONS, columns=columns),
    )
    wanted = 0.01 / ray_lengths(camera)
    if columns < 88:
        # Means of four pixels with independent noise.
        wanted = wanted.reshape(36, 2, 44, 2).mean((1, 3)) / 2
    np.testing.assert_allclose(view.sigma, wanted, rtol=2e-3)


def smoothed(sigma, seed):
    """A wall with waves on the right, with noise that neighbouring pixels share."""
    rays = CAMERA.rays().astype(float)
    z = 1.5 + 0.03 * np.sin(25 * np.maximum(rays[..., 0] - 0.1, 0)) + 0.2 * rays[..., 1]
    noise = np.random.default_rng(seed).normal(size=z.shape)
    noise = cv2.GaussianBlur(noise, (0, 0), 8.0)
    return RangeFrame(0, 0.0, CAMERA, (z + noise * sigma / noise.std()).astype(np.float32))


def test_curved_surface_is_planar_within_stated_noise():
    frame = smoothed(0.01, 1)
    strict = replace(OPTIONS, flatness=0.0, fine_scale=NEVER)
    without_sigma = prepare_view(frame, strict)
    with_sigma = prepare_view(
        replace(frame, sigma_image=np.full((72, 88), 0.01, np.float32)), strict
    )
    waves = np.s_[4:-4, 60:-4]
    low, high = ((v.planes[waves][..., 3] > 0).mean() for v in (without_sigma, with_sigma))
    assert low < 0.75 < 0.95 < high


def test_nearly_flat_surface_is_planar_without_noise():
    """Waves of 3 cm are within 0.2 % of the depth of a plane, over the wider windows."""
    frame = smoothed(0.0005, 1)
    waves = np.s_[4:-4, 60:-4]
    strict, default = (
        prepare_view(frame, replace(OPTIONS, flatness=f, fine_scale=NEVER)) for f in (0.0, 0.002)
    )
    strict, default = ((v.planes[waves][..., 3] > 0).mean() for v in (strict, default))
    assert strict < 0.75 < 0.95 < default


def test_small_shapes_are_kept_if_camera_smooths_its_noise():
    """A bar of five pixels before a wall has its own planes then, but none with pixel noise."""
    frame = smoothed(0.0005, 1)
    depth = frame.depth.copy()
    depth[:, 20:25] = 1.2
    noise = np.random.default_rng(2).normal(size=depth.shape) * 0.004
    quiet, never, noisy = (
        prepare_view(replace(frame, depth=(depth + n).astype(np.float32)), options)
        for n, options in (
            (0 * noise, OPTIONS),
            (0 * noise, replace(OPTIONS, fine_scale=NEVER)),
            (noise, OPTIONS),
        )
    )
    bar = np.s_[8:-8, 21:24]
    for view, least, most in ((quiet, 0.9, 1.0), (never, 0.0, 0.0), (noisy, 0.0, 0.0)):
        assert least <= (view.planes[bar][..., 3] > 0).mean() <= most
    z = 1 / quiet.planes[bar][..., 3]
    np.testing.assert_allclose(z[:, 1], 1.2, atol=1e-3)


def test_noise_is_no_edge():
    """At 1.5 m, 4 cm between neighbours is noise here, while a step of 40 cm remains an edge."""
    frame = wall(sigma=0.04, seed=2)
    strict, default = (
        prepare_view(frame, replace(OPTIONS, edge_sigmas=k)).planar_fraction for k in (0.0, 3.0)
    )
    assert strict < 0.3 < 0.75 < default
    step = frame.depth.copy()
    step[:, 44:] += 0.4
    planes = prepare_view(replace(frame, depth=step), OPTIONS).planes[4:-4, :, 3]
    assert (planes[:, 43:45] > 0).mean() < 0.2
    assert (planes[:, 10:30] > 0).mean() > 0.7


def test_pixels_of_reduced_view_are_weighted_by_stated_noise():
    """With a uniform sigma, planes follow the noisy pixels; with the true one, the precise ones."""
    camera = Pinhole(176, 144, 230.0, 230.0, 87.5, 71.5)
    sigma = np.where(np.arange(176) % 4 < 2, 0.002, 0.03).astype(np.float32)[None].repeat(144, 0)
    clean = wall(camera)
    noise = np.random.default_rng(2).normal(size=sigma.shape) * sigma
    frame = replace(clean, depth=(clean.depth + noise).astype(np.float32))
    options = replace(OPTIONS, columns=88)
    off = {}
    for name, stated in (("right", sigma), ("even", np.full_like(sigma, 0.02))):
        view = prepare_view(replace(frame, sigma_image=stated), options)
        middle = inside(view)
        exact = view.rays @ PLANE[:2] + PLANE[2]
        known = view.planes[..., 3][middle] > 0
        assert known.mean() > 0.8
        off[name] = float(np.std((view.planes[..., 3] - exact)[middle][known]))
    assert off["right"] < 0.25 * off["even"]


def painted(shift=0.0, gain=1.0, *, color=True):
    """A flat wall, 1.5 m away, with a pattern, seen by a camera moved to the right by `shift`."""
    camera = Pinhole(160, 120, 180.0, 180.0, 79.5, 59.5)
    rays = camera.rays().astype(float)
    x, y = 1.5 * rays[..., 0] + shift, 1.5 * rays[..., 1]
    linear = 0.2 + 0.15 * np.sin(9 * x + 2 * y) * np.sin(8 * y - 3 * x) + 0.1 * np.sin(4 * x)
    coded = 255 * np.clip(gain * np.maximum(linear, 0), 0, 1) ** (1 / 2.2)
    noise = np.random.default_rng(int(1000 * shift)).normal(size=(2, *rays.shape[:2]))
    image = np.clip(np.rint(coded + noise[0]), 0, 255).astype(np.uint8)
    return RangeFrame(
        round(100 * shift),
        0.0,
        camera,
        (1.5 + 0.003 * noise[1]).astype(np.float32),
        color_image=np.repeat(image[..., None], 3, 2) if color else None,
    )


@pytest.mark.parametrize("gain", [1.0, 1.8, 0.6])
def test_colour_constrains_pose_before_flat_wall_at_any_exposure(gain):
    shift, true = 0.05, np.eye(4)
    true[0, 3] = shift
    views = [prepare_view(f, OPTIONS) for f in (painted(), painted(shift, gain))]
    aligned = align(views[1], [Target(views[0], np.eye(4))], np.eye(4), ProjectiveOptions())
    assert aligned.photometric
    assert len(aligned.unobservable) == 0
    assert np.linalg.norm((aligned.T_world_source - true)[:3, 3]) < 0.003
    # Of coded values: includes the exponent of the gamma.
    assert aligned.exposure == pytest.approx(-np.log(gain) / 2.2, abs=0.02)
    bare = [prepare_view(f, OPTIONS) for f in (painted(color=False), painted(shift, color=False))]
    without_amplitude = align(bare[1], [Target(bare[0], np.eye(4))], np.eye(4), ProjectiveOptions())
    assert len(without_amplitude.unobservable) == 3


def test_saturated_and_dark_colour_is_invalid():
    frame = painted()
    color = frame.color_image.copy()
    color[40:60, 40:60, 1] = 255
    color[80:100, 80:100] = 2
    view = prepare_view(replace(frame, color_image=color), OPTIONS)
    assert np.isnan(view.albedo[44:56, 44:56]).all()
    assert np.isnan(view.albedo[84:96, 84:96]).all()
    assert np.isfinite(view.albedo[44:56, 84:96]).all()


def test_unregistered_colour_is_not_used():
    view = prepare_view(replace(painted(), color_registered=False), OPTIONS)
    assert not view.has_albedo


def test_amplitude_is_preferred_to_colour():
    frame = replace(wall(amplitude="raw", texture=1.0), color_image=np.zeros((72, 88, 3), np.uint8))
    plain = prepare_view(replace(frame, color_image=None), OPTIONS)
    np.testing.assert_array_equal(prepare_view(frame, OPTIONS).albedo, plain.albedo)


def test_shared_error_is_not_averaged_out() -> None:
    """Pixels with a shared error weigh as much as one of them, whatever their noise."""
    frame = wall(sigma=0.004)
    plain = prepare_view(frame, OPTIONS)
    shared = np.zeros((72, 88), np.float32)
    shared[:, 44:] = 0.005
    view = prepare_view(replace(frame, shared_sigma_image=shared), OPTIONS)
    np.testing.assert_array_equal(view.planes, plain.planes)
    np.testing.assert_array_equal(view.sigma, plain.sigma)
    np.testing.assert_array_equal(view.plane_variance[:, :44], plain.plane_variance[:, :44])
    added = (view.plane_variance - plain.plane_variance)[:, 44:]
    w = view.planes[:, 44:, 3]
    seen = w > 0
    assert seen.sum() > 2000
    # A hundred pixels together know z no better than to the 5 mm along the ray.
    along = 0.005 / ray_lengths(CAMERA)[:, 44:]
    np.testing.assert_allclose(np.sqrt(added / 100)[seen], (along * w * w)[seen], rtol=0.01)

    bad = np.full((72, 88), np.nan, np.float32)
    bad[::2] = -1
    unknown = prepare_view(replace(frame, shared_sigma_image=bad), OPTIONS)
    np.testing.assert_array_equal(unknown.plane_variance, plain.plane_variance)


def test_planes_are_extended_to_edges_but_not_to_flying_pixels():
    """A slanted wall with a bar in front, whose left border has flying pixels."""
    frame = wall(sigma=0.004, seed=5)
    depth = frame.depth.copy()
    truth = wall().depth.copy()
    depth[:, 40:60] -= 0.8
    truth[:, 40:60] -= 0.8
    depth[:, 40] += 0.4
    frame = replace(frame, depth=depth)
    view = prepare_view(frame, OPTIONS)
    more = with_extended_planes(view, frame, OPTIONS)
    before, after = (v.planes[6:-6, :, 3] > 0 for v in (view, more))
    assert not before[:, [*range(37, 43), *range(58, 62)]].any()
    assert not after[:, 40].any()
    assert after[:, [36, 37, 38, 41, 42, 43, 57, 58]].mean() > 0.95
    np.testing.assert_array_equal(more.planes[view.planes[..., 3] > 0][:, 3] > 0, True)
    # They match the surfaces, within their stated uncertainty.
    new = after & ~before
    off = 1 / more.planes[6:-6, :, 3][new] - truth[6:-6][new]
    assert np.abs(off).mean() < 0.003
    sigma = np.sqrt(more.plane_variance[6:-6][new]) * truth[6:-6][new] ** 2
    assert 0.5 < np.std(off / sigma) < 1.6
    assert np.median(sigma) > 1.2 * np.median(np.sqrt(view.plane_variance[before.nonzero()]) * 4)
