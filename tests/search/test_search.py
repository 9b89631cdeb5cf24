"""Large steps between views: evidence for a pose in both images, and the exhaustive search."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pose_errors import pose_error
from searched_pair import TRUE, A, B, camera, seen
from tofuse.engine.geometry import se3
from tofuse.engine.search import search_kernels as kernels
from tofuse.engine.search.pair_agreement import agreement
from tofuse.engine.search.plane_detection import find_floor, find_floors
from tofuse.engine.search.search import Search, SearchOptions
from tofuse.engine.views.extended_planes import with_rough_planes
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions
from tofuse.formats.poses.trajectory import read_tum
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.record import simulate_recording


def view(*arguments, **options):
    return prepare_view(seen(*arguments, **options), SurfaceOptions())


def search(source, target, options=None):
    views = Search.of(source, target, options)
    return None if views is None else views.exhaustive()


@pytest.fixture(scope="module")
def pair():
    """Source and target."""
    return view(B, seed=1), view(A, seed=2)


# The kernels compared with NumPy


def random_image(rng, shape=(9, 12)):
    """A grid of planes in front of the camera, holes, and depths without a plane; with albedo."""
    frame = np.array([-0.6, -0.4, 10.0, 10.0])
    y, x = np.mgrid[: shape[0], : shape[1]] / 10.0
    rays = np.dstack([x - 0.6, y - 0.4, np.ones(shape)])
    normals = np.dstack([rng.normal(0, 0.2, (*shape, 2)), np.ones(shape)])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    grid = np.dstack([normals, (normals * rays).sum(-1) * rng.uniform(1.5, 2.5, shape)])
    kind = rng.random(shape)
    grid[kind < 0.1] = 0
    grid[kind > 0.85, :3] = 0
    grid[kind > 0.85, 3] = -2.0
    light = np.where(rng.random(shape) < 0.1, np.nan, rng.normal(0, 0.3, shape))
    return np.dstack([grid, light]).astype(np.float32), frame


def random_points(rng, count):
    p = rng.uniform([-1.2, -0.8, 1.0], [1.2, 0.8, 3.0], (count, 3))
    p[0] = 0, 0, -1  # behind the camera
    n = np.column_stack([rng.normal(0, 0.4, (count, 2)), np.ones(count)])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return p.astype(np.float32), n.astype(np.float32)


def looked_up(p, grid, frame):
    """(N, 5) entries of the grid at the projections of points, and whether they are inside."""
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.floor((p[:, 0] / p[:, 2] - frame[0]) * frame[2] + 0.5)
        v = np.floor((p[:, 1] / p[:, 2] - frame[1]) * frame[3] + 0.5)
    rows, columns = grid.shape[:2]
    inside = (p[:, 2] > 0.05) & (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
    u, v = np.where(inside, u, 0).astype(int), np.where(inside, v, 0).astype(int)
    return grid[v, u].astype(float), inside


def scored(p, n, light, grid, frame, T, reach):
    """One direction of `score_grid`, point by point; weights and differences of albedo."""
    q, m = se3.transform(T, p.astype(float)), n @ T[:3, :3].T
    plane, inside = looked_up(q, grid, frame)
    r = (plane[:, :3] * q).sum(1) - plane[:, 3]
    known, raw = inside & (plane[:, 3] > 0), inside & (plane[:, 3] < 0)
    through = (known & (r < -reach)) | (raw & (q[:, 2] < -plane[:, 3] - reach))
    fits = known & (np.abs(r) < reach)
    cosine = np.maximum((plane[:, :3] * m).sum(1), 0)
    weight = fits * cosine * (1 - (r / reach) ** 2)
    lighter = plane[:, 4] - light
    is_compared = np.isfinite(lighter)
    return weight.sum() - 2.0 * through.sum(), weight[is_compared], lighter[is_compared]


def small_poses(rng, count):
    return np.stack([se3.exp(rng.normal(0, 0.15, 6)) for _ in range(count)])


def test_poses_of_grid_are_scored_in_both_directions():
    rng = np.random.default_rng(3)
    grids = [random_image(rng), random_image(rng, (11, 10))]
    source, target = random_points(rng, 60), random_points(rng, 50)
    lights = [
        np.where(rng.random(n) < 0.2, np.nan, rng.normal(0, 0.3, n)).astype(np.float32)
        for n in (60, 50)
    ]
    poses = small_poses(rng, 6)
    rotations, moves = poses[:, :3, :3].copy(), poses[:4, :3, 3].copy()
    scores = np.full((6, 4), np.nan, np.float32)
    views = (
        kernels.Resampled(*source, lights[0], *grids[0]),
        kernels.Resampled(*target, lights[1], *grids[1]),
    )
    kernels.score_grid(*views, rotations, moves[None], 0.4, 0.3, scores, 0, 6)
    most = 0
    for a in range(6):
        for b in range(4):
            T = se3.pose(rotations[a], moves[b])
            there, w, d = scored(*source, lights[0], *grids[1], T, 0.4)
            back, v, e = scored(*target, lights[1], *grids[0], se3.inverse(T), 0.4)
            w, d = np.append(w, v), np.append(d, -e)
            spread = (w * (d - (w * d).sum() / w.sum()) ** 2).sum() / 0.3**2
            against = min(spread, 2 * w.sum())
            most += against < spread
            assert scores[a, b] == pytest.approx((there + back - against) / 110, abs=1e-5)
    assert scores.std() > 0.01
    assert 2 < most < 22
    # A longer exposure changes nothing.
    brighter = grids[0][0].copy()
    brighter[..., 4] += 0.7
    longer = kernels.Resampled(*source, lights[0] + np.float32(0.7), brighter, grids[0][1])
    again = np.full((6, 4), np.nan, np.float32)
    kernels.score_grid(longer, views[1], rotations, moves[None], 0.4, 0.3, again, 0, 6)
    np.testing.assert_allclose(again, scores, atol=1e-5)
    # A separate translation for each rotation.
    single = np.full((4, 1), np.nan, np.float32)
    own = np.ascontiguousarray(moves[:, None])
    kernels.score_grid(*views, rotations[:4], own, 0.4, 0.3, single, 0, 4)
    np.testing.assert_allclose(single[:, 0], scores[np.arange(4), np.arange(4)], atol=1e-6)


def residuals(p, n, grid, frame, T, forward, reach, cosine, xi):
    """Residuals at T exp(xi) of the points used at T, and their weights."""

    def at(pose):
        return se3.transform(pose if forward else se3.inverse(pose), p.astype(float))

    q = at(T)
    R = T[:3, :3] if forward else T[:3, :3].T
    plane, inside = looked_up(q, grid, frame)
    r = (plane[:, :3] * q).sum(1) - plane[:, 3]
    used = inside & (plane[:, 3] > 0) & (np.abs(r) < reach)
    used &= (plane[:, :3] * (n @ R.T)).sum(1) >= cosine
    moved = (plane[:, :3] * at(T @ se3.exp(xi))).sum(1) - plane[:, 3]
    return moved[used], ((1 - (r / reach) ** 2) ** 2)[used]


def test_icp_step_solves_equations_of_both_directions():
    """Its Jacobians compared with central differences, its solution with NumPy's."""
    rng = np.random.default_rng(5)
    grids = [random_image(rng), random_image(rng)]
    source, target = random_points(rng, 150), random_points(rng, 150)
    T = se3.exp(rng.normal(0, 0.05, 6))
    reach, cosine, unit = 0.5, 0.6, 1.7
    H, g = np.zeros((6, 6)), np.zeros(6)
    for points, image, forward in ((source, grids[1], True), (target, grids[0], False)):
        arguments = (*points, *image, T, forward, reach, cosine)
        r, w = residuals(*arguments, np.zeros(6))
        step = np.eye(6) * 1e-6
        J = np.stack(
            [(residuals(*arguments, d)[0] - residuals(*arguments, -d)[0]) / 2e-6 for d in step], 1
        )
        H += (J * w[:, None]).T @ J
        g += (J * w[:, None]).T @ r
        assert len(r) > 20
    damping = 1e-3 * np.trace(H[:3, :3]) + 1e-9
    H += np.diag([damping] * 3 + [damping * unit**2] * 3)
    expected = T @ se3.exp(-np.linalg.solve(H, g))
    poses = np.stack([np.eye(4), T])
    dark = np.zeros(150, np.float32)
    views = [
        kernels.Resampled(*points, dark, *image)
        for points, image in zip((source, target), grids, strict=True)
    ]
    kernels.refine_poses(*views, np.array([reach]), cosine, unit, poses, 1, 2)
    np.testing.assert_allclose(poses[1], expected, atol=2e-5)
    np.testing.assert_array_equal(poses[0], np.eye(4))  # outside the given range


# Agreement of two images


@pytest.mark.parametrize("aside", [0.15, -0.15])
def test_wrong_pose_violates_free_space(pair, aside):
    """Too near, source points are in front of the target's surfaces; too far, vice versa."""
    wrong = TRUE.copy()
    wrong[2, 3] += aside
    right, found = agreement(*pair, TRUE), agreement(*pair, wrong)
    assert found.violation > 0.15
    assert found.score < right.score - 0.5


def test_agreement_is_symmetric(pair):
    T = TRUE @ se3.exp([0.03, 0.01, 0, 0, 0.02, 0])
    there, back = agreement(*pair, T), agreement(pair[1], pair[0], se3.inverse(T))
    assert back.score == pytest.approx(there.score, abs=1e-3)


def test_opposite_views_do_not_overlap(pair):
    found = agreement(*pair, se3.exp([0, 0, 0, 0, np.pi, 0]))
    assert (found.overlap, found.support, found.score) == (0, 0, 0)
    assert found.rms_m == np.inf


# The floor


def test_floor_is_found_below_table():
    table = [((0.0, 0.2, 1.6), (1.2, 0.02, 0.5), 0.0)]
    T = camera(0.0, 0.0, 0.0)
    floor = find_floor(view(T, boxes=table), np.array([0.0, 1.0, 0.0]))
    assert floor is not None
    assert floor.height == pytest.approx(1.0, abs=0.01)
    down = T[:3, :3].T @ [0, 1, 0]
    assert np.degrees(np.arccos(floor.normal @ down)) < 0.5


def test_floor_is_found_by_camera_on_its_side():
    T = camera(0.0, 0.0, 0.0) @ se3.exp([0, 0, 0, 0, 0, np.pi / 2])
    views = view(T, seed=1), view(T, seed=2)
    floors = find_floors(*views)
    assert floors is not None
    down = T[:3, :3].T @ [0, 1, 0]
    for floor in floors:
        assert floor.height == pytest.approx(1.0, abs=0.02)
        assert np.degrees(np.arccos(floor.normal @ down)) < 1


def test_lowest_plane_has_most_points_and_few_below():
    rng = np.random.default_rng(3)
    p = rng.normal(size=(300, 3)) * [1, 0.4, 1] + [0, 0, 3]
    n = rng.normal(size=(300, 3)) * 0.2 + [0, 1, 0]
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    band, tried = 0.02 + 0.01 * p[:, 2], np.arange(0, 300, 3)
    for most, cosine in ((60.0, 0.97), (30.0, 0.9), (-1.0, 0.9)):
        r = p @ n[tried].T - (p[tried] * n[tried]).sum(1)
        on = ((np.abs(r) < band[:, None]) & (n @ n[tried].T > cosine)).sum(0)
        on[(r > 3 * band[:, None]).sum(0) > most] = 0
        assert kernels.lowest_plane(p, n, band, tried, cosine, most, 3.0) == tried[on.argmax()]


def test_no_floor_is_found_in_view_of_wall():
    level = view(camera(0.0, 2.4, 0.0, pitch=0.0), boxes=[])
    assert find_floors(level, level) is None


def test_rough_planes_fill_noisy_regions():
    """A view whose far part is much noisier than its noise model has planes only nearby."""
    frame = seen(A, sigma=0.001)
    rng = np.random.default_rng(2)
    far = frame.depth > 2.4
    noisy = frame.depth + np.where(far, 0.012 * rng.standard_normal(far.shape), 0)
    made = prepare_view(replace(frame, depth=noisy.astype(np.float32)), SurfaceOptions())
    filled = with_rough_planes(made)
    own = made.planes[..., 3] > 0
    np.testing.assert_array_equal(filled.planes[own], made.planes[own])
    new = ~own & (filled.planes[..., 3] > 0)
    assert new.sum() > 0.5 * (far & ~own).sum() > 500
    off = 1 / filled.planes[new][:, 3] - frame.depth[new]
    assert 1.48 * np.median(np.abs(off)) < 0.012


# The search


@pytest.mark.parametrize("mode", ["planar", "full", "auto", "both"])
def test_large_step_is_found_without_guess(pair, mode):
    found = search(*pair, SearchOptions(mode=mode))
    metres, degrees = pose_error(found.T_target_source, TRUE)
    assert metres < 0.02
    assert degrees < 0.5
    assert found.score > 0.4
    assert found.margin > 0.1
    assert found.mode == ("planar" if mode in ("planar", "auto") else "full")
    assert [c.score for c in found.candidates] == sorted(c.score for c in found.candidates)[::-1]
    assert found.agreement.violation < 0.01


@pytest.mark.nightly
def test_albedo_resolves_geometric_ambiguity():
    """Bare textured walls, 27 degrees apart."""
    effects = Effects.none(shot_noise=True)
    recording = simulate_recording("empty-room", every=30, frames=7, effects=effects).select(3)
    views = [prepare_view(frame, SurfaceOptions()) for frame in recording]
    dark = [
        prepare_view(replace(frame, amplitude_image=None), SurfaceOptions()) for frame in recording
    ]
    poses = recording.reference
    right = {"with": 0, "without": 0}
    for k in range(3):
        true = se3.inverse(poses[k]) @ poses[k + 1]
        assert 20 < np.degrees(se3.angle(true)) < 30
        for name, seen_by in (("with", views), ("without", dark)):
            found = search(seen_by[k + 1], seen_by[k])
            metres, degrees = pose_error(found.T_target_source, true)
            right[name] += metres < 0.1 and degrees < 3
            if name == "with":
                assert found.agreement.clash < 0.01
    assert right["with"] == 3
    assert right["without"] < 3


def test_empty_view_is_not_searched(pair):
    frame = seen(A)
    empty = prepare_view(replace(frame, depth=np.zeros_like(frame.depth)), SurfaceOptions())
    assert search(empty, pair[1]) is None
    assert search(pair[0], empty) is None


def test_recorded_views_are_found_without_guess(shared_data):
    """A Kinect v2 around boxes: neighbours 0.5 m and 26 degrees apart, and the ends of the loop."""
    recording = open_recording(shared_data / "kinectv2_loop" / "recording")
    _, poses = read_tum(shared_data / "kinectv2_loop" / "recording" / "reference_poses.txt")
    views = [prepare_view(frame, SurfaceOptions()) for frame in recording]
    for i, j in ((3, 2), (6, 5), (16, 0)):
        found = search(views[i], views[j])
        metres, degrees = pose_error(found.T_target_source, se3.inverse(poses[j]) @ poses[i])
        assert metres < 0.15, (i, j)
        assert degrees < 4, (i, j)
