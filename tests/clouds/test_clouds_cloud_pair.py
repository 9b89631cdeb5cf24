"""Global registration of clouds: viewpoints, evidence for a pose, and the pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import tofuse
from pose_errors import pose_error
from ray_casting import to_room
from registration_scenes import box_walls, bumpy_ball, rng, turn
from scanned_flat import scanned
from tofuse.engine.alignment.base import Registration
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.clouds import cloud_pair
from tofuse.engine.clouds import pair as any_pair
from tofuse.engine.clouds.cloud_agreement import CloudAgreement, CloudMap, cloud_agreement
from tofuse.engine.clouds.cloud_pair import register_clouds
from tofuse.engine.clouds.viewpoint import (
    RangeSphere,
    as_image,
    free_space_viewpoint,
    rendered,
    viewpoint_of,
)
from tofuse.engine.compute.thread_pool import threads
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames.frames import CloudFrame
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.engine.geometry import se3
from tofuse.engine.icp.coarse_to_fine import averaged
from tofuse.engine.search.pose_probability import ACCEPTED, CLOUDS, CloudEvidence
from tofuse.engine.tracking.pairwise import Pairwise
from tofuse.formats.geometry.ply import write_ply
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.peaks import peaks_views
from tofuse.lab.simulation.record import plan
from tofuse.lab.world import scene as scenes

ANYWHERE = se3.exp([1.0, -0.7, 0.4, 1.9, 0.3, -1.0])


def scan(at, heading, seed=0):
    T, points = scanned(at, heading, seed)
    return T, points.astype(np.float32)


@pytest.fixture(scope="module")
def scans():
    """Two scans of one room of the flat, from different places."""
    (T_a, a), (T_b, b) = scan([-2.6, -2.5, 1.3], 0.4), scan([-1.6, -2.2, 1.3], 2.6, seed=1)
    return b, a, se3.inverse(T_a) @ T_b


@pytest.fixture(scope="module")
def frames():
    """Two images of a furnished room, and the second one's pose in the first."""
    made = plan("room", every=16, frames=2, effects=Effects().without("multipath", "gloss"))
    rendered = [r.frame for r in made.frames(None)]
    return rendered[0], rendered[1], se3.inverse(made.poses[0]) @ made.poses[1]


@pytest.fixture(scope="module")
def clips():
    """Two fused clips of a turn in a furnished room that share a third of what they see."""
    built, sequence = scenes.build("room", seed=1)
    rng = np.random.default_rng(3)
    u, v = np.meshgrid(np.linspace(-0.55, 0.55, 96), np.linspace(-0.4, 0.4, 72))
    rays = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    fused = []
    for start in (0.0, 2.0):
        T_first = sequence.T_room_camera(start)
        points = []
        for t in np.linspace(start, start + 1, 6):
            T = sequence.T_room_camera(t)
            distance = built.cast(T[:3, 3], rays @ T[:3, :3].T).distance.astype(float)
            distance += rng.normal(0, 0.004, len(distance))
            seen = distance < 5
            hits = rays[seen] * distance[seen, None]
            points.append(se3.transform(se3.inverse(T_first) @ T, hits))
        thin = averaged(CloudFrame.of(np.concatenate(points)), 0.025)
        fused.append((T_first, thin.points.astype(float)))
    (T_a, a), (T_b, b) = fused
    return b, a, se3.inverse(T_a) @ T_b


# Viewpoints


def test_viewpoint_of_image_points_is_their_origin(frames):
    for frame in frames[:2]:
        found = viewpoint_of(CloudFrame.of(frame.points))
        assert found is not None
        pixel = viewpoint_of(frame)
        # Pixels at the borders are closer together in angle than those in the middle.
        assert 0.8 * pixel.spacing < found.spacing < 1.1 * pixel.spacing
        thinned = frame.points[np.random.default_rng(0).permutation(len(frame))[:5000]]
        found = viewpoint_of(CloudFrame.of(thinned))
        assert found.spacing == pytest.approx(pixel.spacing * np.sqrt(len(frame) / 5000), rel=0.2)


@pytest.mark.nightly
def test_moved_points_have_no_viewpoint(frames, scans):
    """Mostly: from some places the surfaces of a small image are sampled as evenly."""
    rng = np.random.default_rng(4)
    for points in (frames[0].points, scans[0]):
        found = []
        for _ in range(20):
            T = se3.exp(np.r_[rng.uniform(-2, 2, 3), rng.uniform(-2, 2, 3)])
            found.append(viewpoint_of(CloudFrame.of(se3.transform(T, points.astype(float)))))
        assert sum(v is not None for v in found) <= 7


def test_evenly_sampled_surfaces_have_no_viewpoint(frames):
    assert viewpoint_of(averaged(CloudFrame.of(frames[0].points), 0.08)) is None
    assert viewpoint_of(CloudFrame.of(np.zeros((100, 3)))) is None
    assert viewpoint_of(CloudFrame.of(frames[0].points[:20])) is None


def test_fused_cloud_is_seen_from_its_origin(scans):
    """Evenly sampled surfaces have no viewpoint, but hide little from where they were seen."""
    even = averaged(CloudFrame.of(scans[0]), 0.08)
    assert viewpoint_of(even) is None
    assert free_space_viewpoint(even) is not None
    # Behind walls, under the floor, and far away, as in the coordinates of a site.
    for place in ([4, 0, 0], [-4, 0, 0], [0, 0, 2], [30, 9, 24], [312, 93, 0]):
        assert free_space_viewpoint(CloudFrame.of(even.points + np.float32(place))) is None


def test_image_of_cloud_matches_original_image(frames):
    frame = frames[0]
    color = np.random.default_rng(0).integers(0, 255, (*frame.depth.shape, 3)).astype(np.uint8)
    frame = replace(frame, color_image=color)
    cloud = CloudFrame(3, 4.0, frame.points, color=frame.color, amplitude=frame.amplitude)
    image, T = as_image(cloud, viewpoint_of(cloud))
    np.testing.assert_array_equal(T, np.eye(4))
    assert (image.index, image.timestamp) == (3, 4.0)
    assert 0.7 * frame.depth.shape[1] < image.depth.shape[1] <= frame.depth.shape[1]
    # Each point of the image is on the surface that the camera measured.
    pixel = np.round(frame.camera.project(image.points)).astype(int)
    inside = (pixel >= 0).all(1) & (pixel < frame.depth.shape[::-1]).all(1)
    z = frame.z[pixel[inside, 1], pixel[inside, 0]]
    assert np.mean(np.abs(image.points[inside, 2] - z) < 0.05 * z) > 0.95
    assert image.color_image[image.valid].any()
    assert np.isin(image.amplitude, frame.amplitude).all()


def test_pixels_of_slanted_plane_are_unbiased() -> None:
    """Points are anywhere in their pixels; their offsets must not displace the surface."""
    xy = np.random.default_rng(4).uniform(-0.5, 0.5, (60_000, 2))
    z = 2.0 / (1 - 0.6 * xy[:, 0] + 0.3 * xy[:, 1])  # a plane, slanted by more than 30 degrees
    points = np.column_stack([xy * z[:, None], z])
    camera = Pinhole(100, 100, 100.0, 100.0, 49.5, 49.5)
    image = rendered(CloudFrame.of(points), camera)
    rays = camera.rays()[3:-3, 3:-3]
    expected = 2.0 / (1 - 0.6 * rays[..., 0] + 0.3 * rays[..., 1])
    seen = image.depth[3:-3, 3:-3]
    off = np.abs(seen / expected - 1)[seen > 0]
    assert np.median(off) < 2e-5  # plain means of the points in each pixel are off by 7e-4
    assert np.quantile(off, 0.95) < 5e-4


def test_cloud_with_z_up_is_rendered_upright(frames):
    # x forward, y left, z up, as in scanners.
    axes = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float)
    cloud = CloudFrame.of(frames[0].points @ axes.T)
    image, T = as_image(cloud, viewpoint_of(cloud))
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    assert np.degrees(np.arccos(T[:3, 1] @ [0, 0, -1])) < 30  # y is down
    near, _ = tofuse.engine.geometry.kdtree.KdTree(cloud.points).nearest(
        se3.transform(T, image.points.astype(float)), 0.1
    )
    assert np.mean(near >= 0) > 0.95


def test_range_sphere_stores_free_space(scans):
    cloud = CloudFrame.of(scans[0])
    sphere = RangeSphere.of(cloud, viewpoint_of(cloud))
    points = scans[0][::50].astype(float)
    assert (
        np.nanmedian(sphere.distance_in_front(0.5 * points) / np.linalg.norm(0.5 * points, axis=1))
        > 0.9
    )
    assert np.mean(sphere.distance_in_front(points) <= 1e-3) > 0.99
    assert np.nanmax(sphere.distance_in_front(1.5 * points)) <= 0
    # No measurements straight down.
    assert np.isnan(sphere.distance_in_front(np.array([[0.0, 0, -1]]))).all()


# Agreement


def maps(source, target, size=0.12):
    views = CloudFrame.of(source), CloudFrame.of(target)
    return [CloudMap.of(averaged(v, size), size, v) for v in views]


def test_wrong_pose_is_contradicted_by_free_space(scans):
    source, target, true = scans
    views = maps(source, target)
    right = cloud_agreement(*views, true)
    for wrong in (turn([0, 0, 1], 180), se3.exp([0.6, 0, 0, 0, 0, 0]), turn([1, 0, 0], 20)):
        agreement = cloud_agreement(*views, true @ wrong)
        assert agreement.violation > 0.02
        assert agreement.score < right.score - 0.2
    # Without viewpoints, free space is unknown.
    without_viewpoint = [replace(view, sphere=None) for view in views]
    agreement = cloud_agreement(*without_viewpoint, turn([0, 0, 1], 180))
    assert agreement.violation == 0


def with_mixed_pixels(aside):
    """A disc before a wall, from a place `aside` m to the right; outline pixels mix both depths."""
    v, u = np.mgrid[-60:61, -80:81] * 0.005
    disc = [np.hypot(1.2 * (u + du) + aside, 1.2 * (v + dv)) < 0.3 for du, dv in SUBPIXELS]
    share = np.mean(disc, axis=0)
    z = 1.2 * share + 2.0 * (1 - share)
    points = np.stack([u * z, v * z, z], -1).reshape(-1, 3).astype(np.float32)
    return points, ((share > 0) & (share < 1)).ravel()


SUBPIXELS = [(du, dv) for du in (-0.002, 0, 0.002) for dv in (-0.002, 0, 0.002)]


def test_flying_pixels_do_not_contradict_correct_pose():
    (source, mixed), (target, _) = with_mixed_pixels(0.15), with_mixed_pixels(0.0)
    views = maps(source, target, 0.03)
    true = se3.exp([0.15, 0, 0, 0, 0, 0])
    assert cloud_agreement(*views, true).contradiction < 0.002
    # They do lie in free space of the other view.
    seen = se3.transform(true, source[mixed].astype(float))
    assert np.mean(views[1].sphere.distance_in_front(seen) > 0.1) > 0.1
    # Surfaces do contradict a wrong pose.
    assert cloud_agreement(*views, se3.exp([0.15, 0, -0.4, 0, 0, 0])).contradiction > 0.05


def test_agreement_is_symmetric(scans):
    source, target, true = scans
    a, b = maps(source, target)
    there, back = cloud_agreement(a, b, true), cloud_agreement(b, a, se3.inverse(true))
    assert there.score == pytest.approx(back.score, abs=1e-9)
    assert there.support == pytest.approx(back.support, abs=1e-9)


@pytest.mark.parametrize("noise", [0.001, 0.005, 0.01, 0.02])
def test_sigma_of_a_map_is_the_distance_of_its_points_from_their_plane(noise):
    """Also of a sheet thicker than a cell, of which the neighbourhoods are narrower."""
    rng = np.random.default_rng(0)
    sheet = rng.uniform(-1, 1, (20_000, 3)) * [1, 1, 0] + noise * rng.normal(size=(20_000, 3))
    view = CloudFrame.of(sheet + np.array([0, 0, 3]))
    found = CloudMap.of(averaged(view, 0.05), 0.05, view)
    spread = float(found.view.points[:, 2].std())
    assert 0.7 * spread < found.sigma < spread


def test_evidence_of_clouds_is_lead_in_distinct_surfaces():
    """Whatever fraction of the points walls cover, a room with the same walls is not believed."""

    def evidence(lead, near=40.0, contradiction=0.0, degenerate=0, free_space=True):
        return CloudEvidence(
            0.6, contradiction, 0.6, degenerate, CLOUDS, lead, near, free_space=free_space
        )

    right, few, walls, blind, contradicted, slides = cases = [
        evidence(25.0),
        evidence(2.0, near=8.0),
        evidence(1.0),
        evidence(25.0, free_space=False),
        evidence(25.0, contradiction=0.04),
        evidence(25.0, degenerate=1),
    ]
    assert right.probability > 0.9 > few.probability > walls.probability
    assert right.probability > blind.probability
    assert right.probability > contradicted.probability
    assert "degenerate" in slides.rejection_reason()
    assert "frames of their cameras" in " ".join(evidence(12.0, free_space=False).remedies)
    assert "frames of their cameras" not in " ".join(evidence(1.0, free_space=False).remedies)
    assert slides.remedies == ("another view, which overlaps both more",)
    assert all(evidence(lead).probability <= 0.5 for lead in (0.0, -3.0)), cases


def test_poses_are_ranked_by_distinct_surfaces_and_matches():
    """A wall with most of the points is one surface; what is in free space is none."""

    def pose(support, surfaces, matches=0.0, violation=0.0):
        score = support - 8 * violation
        agreement = CloudAgreement(
            0.7, support, violation, 0.0, 0.01, 1000, score, surfaces=surfaces, near_surfaces=50.0
        )
        return cloud_pair._Pose(np.eye(4), agreement, matches=matches)

    walls, furniture = pose(0.6, 4.0), pose(0.3, 30.0)
    assert walls.score > furniture.score
    assert furniture.rank > walls.rank
    assert pose(0.3, 30.0, violation=0.1).rank < walls.rank
    assert pose(0.6, 4.0, matches=400.0).rank > furniture.rank


def test_each_plane_counts_as_one_surface():
    """However many points it has."""
    rng = np.random.default_rng(0)
    boards = [
        (rng.uniform(-1, 1, (4000, 3)) * [size, size, 0] + [0, 0, z])
        for z, size in ((0.0, 3.0), (1.0, 1.0), (2.0, 0.6))
    ]
    for count in (1, 3):
        points = np.concatenate(boards[:count])
        agreement = cloud_agreement(*maps(points, points, 0.12), np.eye(4))
        assert agreement.surfaces == pytest.approx(count, rel=0.02)
        assert agreement.near_surfaces == pytest.approx(count, rel=0.02)
    shifted = cloud_agreement(*maps(points, points, 0.12), se3.exp([0, 0, 1, 0, 0, 0]))
    assert shifted.surfaces < 0.8 * count


# Registration


@pytest.fixture(scope="module")
def registered(scans):
    """The second scan registered to the first, by one thread."""
    with threads(1):
        return tofuse.register(*scans[:2])


def test_scans_with_any_heading(scans, registered):
    (source, _, true), found = scans, registered
    assert pose_error(found.T_target_source, true, source)[0] < 0.02
    assert pose_error(found.T_target_source, true, source)[1] < 0.5
    assert found.believed
    assert found.probability > 0.9
    assert found.contradiction < 0.01


@pytest.mark.nightly_part
def test_clouds_without_viewpoint_under_any_rotation(frames):
    target, source, true = frames
    moved = se3.transform(ANYWHERE, source.points.astype(float))
    found = tofuse.register(moved, target.points)
    shift, angle = pose_error(found.T_target_source, true @ se3.inverse(ANYWHERE), moved)
    assert shift < 0.1
    assert angle < 4


@pytest.mark.nightly
def test_clouds_of_different_density(scans):
    source, target, true = scans
    few = source[np.random.default_rng(2).permutation(len(source))[: len(source) // 10]]
    for pair, T in (((few, target), true), ((target, few), se3.inverse(true))):
        found = tofuse.register(*pair)
        assert pose_error(found.T_target_source, T, pair[0])[0] < 0.05
        assert pose_error(found.T_target_source, T, pair[0])[1] < 1.5


@pytest.mark.nightly_part
def test_views_without_overlap_are_rejected(scans):
    _, elsewhere = scan([2.5, -2.5, 1.3], 1.0, seed=3)
    for source, target, reason in (
        (elsewhere, scans[1], "another pose fits nearly as well"),
        (np.random.default_rng(0).normal(size=(3000, 3)), scans[1], "points of both views"),
    ):
        found = tofuse.register(source, target)
        assert found.believed is False
        assert reason in found.reason


def test_large_clouds_are_registered_by_a_part_of_their_points(scans, registered, monkeypatch):
    monkeypatch.setattr(any_pair, "_MAX_POINTS", 10_000)
    found = tofuse.register(*scans[:2])
    assert pose_error(found.T_target_source, registered.T_target_source, scans[0])[0] < 0.01


@pytest.mark.parametrize("moved", [False, True])
def test_fused_clips_that_overlap_little_are_registered(clips, moved):
    """Without a guess, wherever their origin is."""
    source, target, true = clips
    if moved:
        source, true = se3.transform(ANYWHERE, source), true @ se3.inverse(ANYWHERE)
    shift, angle = pose_error(tofuse.register(source, target).T_target_source, true, source)
    assert shift < 0.05
    assert angle < 2


def test_wrong_unit_is_found_with_few_points(scans, monkeypatch):
    """As fast as the registration of clouds in the right unit, however many points they have."""
    source, target, _ = scans
    sizes = []
    registered = cloud_pair._registered

    def counting(views, *arguments, **options):
        sizes.append((len(views.source), len(views.target)))
        return registered(views, *arguments, **options)

    monkeypatch.setattr(cloud_pair, "_registered", counting)
    many = np.random.default_rng(0).permutation(np.concatenate([source, source + 1e-4]))
    found = tofuse.register(1000 * many, target)
    assert found.believed is False
    assert found.reason == "the views fit with the source 0.001 times as large: check its unit"
    assert len(sizes) == 1
    assert max(sizes[0]) <= cloud_pair._UNIT_POINTS < len(many)


def test_views_of_different_extent_raise_error(scans, frames):
    ball = bumpy_ball(5000, 1)
    with pytest.raises(
        RegistrationError, match=r"about 0\.\d+ times .* does not fit; check the units"
    ):
        tofuse.register(ball, scans[0])
    with pytest.raises(RegistrationError, match="only 0 corresponding points"):
        tofuse.register(frames[0].points, ball * 4)


@pytest.mark.nightly_part
def test_ambiguous_corridor_is_rejected():
    """Two parallel walls and a floor: the pose along them is unobservable."""
    found = tofuse.register(box_walls(6000, 1, 0.003, "xy"), box_walls(6000, 0, 0.003, "xy"))
    assert found.believed is False
    assert "degenerate" in found.reason
    assert len(found.unobservable) >= 1


@pytest.mark.parametrize("scale", [0.001, 1000.0, 1 / 25.4])
def test_different_units_are_reported(scans, scale):
    source, target, _ = scans
    found = tofuse.register(source * scale, target)
    assert found.believed is False
    # No pose of the source as it is may be right, and none may enter a model.
    assert found.probability == 0
    assert f"{1 / scale:.4g} times as large" in found.reason
    assert "unit" in found.reason


def test_guess_resolves_symmetry():
    """An empty square room is the same after a rotation by 90 degrees."""
    walls = box_walls(8000, 0, 0.003, "xyz")
    other = box_walls(8000, 1, 0.003, "xyz")
    guess = se3.exp([0.02, -0.01, 0.01, 0.01, 0.02, -0.01])
    found = tofuse.register(other, walls, guess=guess)
    assert pose_error(found.T_target_source, np.eye(4), other)[0] < 0.01


def surface(boxes, seed):
    """Points on boxes (size, centre), with noise of 2 mm."""
    r = np.random.default_rng(seed)
    parts = []
    for size, centre in boxes:
        points = r.uniform(-0.5, 0.5, (4000, 3))
        points[np.arange(4000), np.arange(4000) % 3] = r.choice([-0.5, 0.5], 4000)
        parts.append(np.asarray(centre) + points * size)
    points = np.concatenate(parts)
    return points + r.normal(0, 0.002, points.shape)


LEGS = [((0.05, 0.05, 0.7), (x, y, 0.35)) for x in (-0.7, 0.7) for y in (-0.35, 0.35)]


@pytest.mark.parametrize(
    ("boxes", "degrees"),
    [
        ([((0.6, 0.4, 0.3), (0, 0, 0))], 180),
        ([((0.6, 0.4, 0.3), (0, 0, 0))], 178),
        ([((0.4, 0.4, 0.4), (0, 0, 0))], 90),
        ([((1.6, 0.8, 0.04), (0, 0, 0.72)), *LEGS], 180),  # without distinct features
    ],
)
def test_body_turned_by_its_symmetry_needs_guess(boxes, degrees) -> None:
    T = turn([0, 0, 1], degrees, np.zeros(3))
    source, target = se3.transform(se3.inverse(T), surface(boxes, 1)), surface(boxes, 2)
    found = tofuse.register(source, target)
    assert not found.believed
    assert found.runner_up is not None
    if len(boxes) == 1:  # thin legs leave room for doubt even at a guess
        assert found.remedy == "a guess near it"
        guessed = tofuse.register(source, target, guess=T)
        assert guessed.believed
        assert se3.is_within(se3.inverse(T) @ guessed.T_target_source, 0.01, 0.02)


def test_result_is_independent_of_threads(scans, registered):
    with threads(2):
        found = tofuse.register(*scans[:2])
    np.testing.assert_array_equal(found.T_target_source, registered.T_target_source)
    assert found.probability == registered.probability


def test_degenerate_clouds_are_not_accepted():
    rng = np.random.default_rng(0)
    plane = rng.uniform(-1, 1, (3000, 3)) * [1, 1, 0] + [0, 0, 2]
    for points in (plane, rng.normal(size=(10, 3))):
        found = tofuse.register(points, points)
        assert found.believed is False
        assert "3 directions are degenerate" in found.reason
    line = rng.uniform(-1, 1, (3000, 1)) * [1.0, 0.2, 0.1] + [0, 0, 2]
    with pytest.raises(RegistrationError, match="only 0 corresponding points"):
        tofuse.register(line, line)
    same = np.ones((3000, 3))
    with pytest.raises(RegistrationError, match="has 1 point, 3 are needed"):
        tofuse.register(same, same)


def test_image_is_registered_to_cloud(frames):
    target, source, true = frames
    found = tofuse.register(source, CloudFrame.of(target.points))
    assert pose_error(found.T_target_source, true, source.points)[0] < 0.05
    assert found.believed


def test_registration_in_other_frames():
    rng = np.random.default_rng(1)
    A = rng.normal(size=(6, 6))
    T, T_a, T_b = (se3.exp(rng.normal(size=6)) for _ in range(3))
    slide = np.array([[1.0, 0, 0, 0, 0, 0]])
    found = Registration(T, True, 1, 1, 1, 0.0, 0.0, A @ A.T, slide, runner_up=np.eye(4))
    moved = found.between(T_a, T_b)
    np.testing.assert_allclose(moved.T_target_source, T_a @ T @ T_b)
    np.testing.assert_allclose(moved.runner_up, T_a @ T_b)
    # A motion of b is the same motion in the source's frame.
    xi = 1e-6 * rng.normal(size=6)
    inside = se3.log(T_b @ se3.exp(xi) @ se3.inverse(T_b))
    assert xi @ moved.information @ xi == pytest.approx(inside @ found.information @ inside)
    there = se3.log(T_b @ se3.exp(1e-6 * moved.unobservable[0]) @ se3.inverse(T_b))
    np.testing.assert_allclose(np.abs(there / np.linalg.norm(there)), np.abs(slide[0]), atol=1e-6)


# Sequences of views


@pytest.mark.nightly
def test_views_are_chained_and_rejected_views_start_components(scans):
    source, target, true = scans
    tracker = Pairwise().start(0)
    views = [target, source, bumpy_ball(5000, 1), source + np.float32(1e-4)]
    steps = [tracker.push(replace(CloudFrame.of(p), index=k)) for k, p in enumerate(views)]
    assert [s.status for s in steps] == ["tracked"] * 4
    assert [s.component for s in steps] == [0, 0, 1, 2]
    assert pose_error(steps[1].T_component_camera, true, source)[0] < 0.02
    assert not steps[1].doubtful
    # The first view of the last component is linked to the first component.
    assert [(link.i, link.j) for link in steps[3].links] == [(1, 3)]
    assert pose_error(steps[3].links[0].T_i_j, np.eye(4), source)[0] < 0.01
    lost = tracker.push(replace(CloudFrame.of(target[:5]), index=4))
    assert lost.status == "lost"
    assert "5 valid points" in lost.reason
    for bad in ({"references": 0}, {"minimum_points": 0}, {"probable": 2.0}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            Pairwise(**bad)


@pytest.mark.nightly
def test_folder_of_scans_becomes_one_model(tmp_path):
    """Through a door, with any heading: neighbours are found, and walls keep their thickness."""
    places = (([-2.6, -2.5, 1.3], 0.4), ([-1.6, -2.2, 1.3], 2.6), ([-0.5, -2.3, 1.3], -1.0))
    taken = [scan(at, heading, seed=k) for k, (at, heading) in enumerate(places)]
    (tmp_path / "scans").mkdir()
    for k, (_, points) in enumerate(taken):
        write_ply(tmp_path / "scans" / f"{k}.ply", GeometryRecord(points))
    result = tofuse.reconstruct(tofuse.open(tmp_path / "scans"))
    assert [f.status for f in result.diagnostics.frames] == ["tracked"] * 3
    for k, (T, points) in enumerate(taken):
        true = se3.inverse(taken[0][0]) @ T
        assert pose_error(result.trajectory[k], true, points)[0] < 0.02
        assert pose_error(result.trajectory[k], true, points)[1] < 0.3


def corner_of_a_room(seed):
    """Points on three walls of a corner, and on boxes at random places before them."""
    parts, generator = [], rng(seed)
    for axis in range(3):
        wall = generator.uniform(0, 1, (666, 3)) * [6, 5, 3]
        wall[:, axis] = 0
        parts.append(wall)
    for _ in range(6):
        box = generator.uniform(0, 1, (166, 3))
        side = generator.integers(0, 3, len(box))
        box[np.arange(len(box)), side] = generator.integers(0, 2, len(box))
        corner = generator.uniform(0.5, 4, 3) * [1, 1, 0.3]
        parts.append(corner + box * generator.uniform(0.2, 0.9, 3))
    return generator.permutation(np.concatenate(parts))[:1500]


@pytest.mark.parametrize("seed", [12, 24])
def test_pose_that_all_first_proposals_lead_to_is_compared_with_others(seed):
    # The walls coincide in it, the furniture does not: one more proposal fits nearly as well.
    T = se3.exp([2.0, -1.0, 0.5, 0.4, -0.9, 1.3])
    found = tofuse.register(corner_of_a_room(seed), se3.transform(T, corner_of_a_room(seed + 1)))
    assert not found.believed


@pytest.mark.nightly
def test_candidates_of_same_pose_are_not_rivals():
    """With large noise, iterations stop slightly apart; such poses do not contradict each other."""
    views, _ = peaks_views(0.1, 101)
    assert register_clouds(views[1], views[0], None, np.random.default_rng(0)).probability > 0.5


def test_pose_contradicted_by_assumed_free_space_is_not_accepted(monkeypatch) -> None:
    """Either the pose is wrong, or the cloud was not seen from its origin."""
    found = Registration(np.eye(4), True, 1, 1, 1, 0.0, 0.0, np.eye(6), believed=False)
    of_views = iter(
        (replace(found, probability=0.4), replace(found, believed=True, probability=0.95))
    )
    monkeypatch.setattr(cloud_pair, "_best", lambda *_: next(of_views))
    monkeypatch.setattr(cloud_pair._CloudViews, "has_assumed_viewpoint", True)
    chosen = tofuse.register(corner_of_a_room(12), corner_of_a_room(13))
    assert not chosen.believed
    assert chosen.probability < ACCEPTED
    assert "its free space contradicts it" in chosen.reason


def two_rooms(at, heading, seed):
    """A scan, and its pose, of two rooms; there is a narrow door in the wall of 0.15 m between."""
    wall = [[-0.075, -2, 0], [0.075, 0.4, 2.7]], [[-0.075, 0.8, 0], [0.075, 2, 2.7]]
    boxes = [
        [[-3.9, -1.9, 0], [-2.6, -1.2, 0.8]],
        [[-1.8, 1.4, 0], [-0.9, 2.0, 1.9]],
        [[-0.5, -1.6, 0], [-0.075, -0.4, 1.2]],
        [[1.5, 1.3, 0], [2.9, 2.0, 0.5]],
        [[3.2, -1.9, 0], [4.4, -1.3, 2.0]],
        [[0.075, -1.9, 0], [0.6, -0.9, 0.7]],
    ]
    up, around = np.meshgrid(
        np.linspace(-1.0, 1.4, 160), np.linspace(-np.pi, np.pi, 400, False), indexing="ij"
    )
    rays = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], -1)
    rays = rays.reshape(-1, 3)
    T = se3.exp([0, 0, 0, 0, 0, heading])
    T[:3, 3] = at
    room = np.array([[-4.0, -2.0, 0.0], [4.6, 2.0, 2.7]])
    distance, _ = to_room(T[:3, 3], rays @ T[:3, :3].T, room, [*wall, *boxes])
    distance += np.random.default_rng(seed).normal(0, 0.002, len(distance))
    return T, (rays * distance[:, None]).astype(np.float32)


def test_two_sides_of_a_wall_are_not_laid_together():
    (T_a, a), (T_b, b) = two_rooms([-2.2, -0.6, 1.5], 0.4, 0), two_rooms([2.4, -0.6, 1.5], 2.0, 1)
    true = se3.inverse(T_a) @ T_b
    error = se3.inverse(true) @ tofuse.register(b, a, guess=true).T_target_source
    assert np.linalg.norm(error[:3, 3]) < 0.01
