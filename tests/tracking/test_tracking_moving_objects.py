"""Moving objects are segmented; a static scene and wrong poses give no segments."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from ray_casting import rays_at, to_box
from tofuse.engine.alignment.projective import ProjectiveOptions, Target, align
from tofuse.engine.cameras.cameras import Pinhole, ray_lengths
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.geometry.rigid_motion_kernels import distance_and_angle
from tofuse.engine.search.pair_agreement import agreement
from tofuse.engine.tracking.keyframes import Keyframes
from tofuse.engine.tracking.moving_objects import Moving, MovingObjects, without_pixels
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import camera_model
from tofuse.lab.simulation.render import render
from tofuse.lab.world.scene import FRAME_RATE_HZ, build

FRAMES = 18
NEAR = 1.3  # m


def followed(objects: MovingObjects, *pair: object) -> Moving:
    """Compare a view with a reference and keep the result."""
    moving = objects.compare(*pair)
    objects.update(moving)
    return moving


@pytest.fixture(scope="module")
def room():
    """Frames of a static room from a turning camera, their true poses, and the noise at 1 m."""
    scene, path = build("room")
    indices = range(0, 2 * FRAMES, 2)
    effects = Effects.none(shot_noise=True)
    frames = [
        replace(render(scene, path, camera_model("sr4000"), k, effects=effects).frame, index=n)
        for n, k in enumerate(indices)
    ]
    poses = [path.T_world_camera(k / FRAME_RATE_HZ, 0.0) for k in indices]
    view, frame = prepare_view(frames[0], SurfaceOptions()), frames[0]
    known = (view.planes[..., 3] > 0) & frame.valid
    squared = (frame.z * ray_lengths(frame.camera))[known] ** 2
    noise = float(np.median(view.sigma[known] * frame.amplitude_image[known] / squared))
    return frames, poses, noise


def with_box(frame, centre, half, noise, seed):
    """Add a box with flying pixels at its edges to a frame; return the frame and the mask."""
    rng = np.random.default_rng(seed)
    origin, d = rays_at(np.eye(4), frame.camera)
    near, _ = to_box(origin, d, centre - half, centre + half)
    mask = near < np.where(frame.valid, frame.z, np.inf)
    r2 = np.where(mask, near, 1) ** 2 * (d**2).sum(-1)
    amplitude = frame.amplitude_image.copy()
    amplitude[mask] = 0.6 * np.median(amplitude[frame.valid])
    noisy = near + rng.normal(0, 1, near.shape) * noise * r2 / np.maximum(amplitude, 1)
    depth = np.where(mask, noisy, frame.depth).astype(np.float32)
    ones = np.ones((3, 3), np.uint8)
    ring = (cv2.dilate(mask.astype(np.uint8), ones) > 0) & ~mask & frame.valid
    mixed = rng.uniform(0, 1, depth.shape).astype(np.float32)
    beside = cv2.dilate(np.where(mask, depth, np.float32(0)), ones)
    depth = np.where(ring, mixed * depth + (1 - mixed) * beside, depth)
    return replace(frame, depth=depth, amplitude_image=amplitude), mask


def trajectory(motion, cover, frame):
    """Centres (n, 3) in the camera's frame and half sides (3,) of a box of part of the image."""
    area = np.prod(np.ptp(frame.camera.rays().reshape(-1, 2), axis=0))
    side = np.sqrt(cover * area) * NEAR / 2
    t = np.linspace(0, 1, FRAMES)[:, None]
    start, end = {
        "sideways": ([-0.2, 0, NEAR], [0.2, 0, NEAR]),
        "towards": ([0, 0, NEAR + 0.3], [0, 0, NEAR]),
        "away": ([0, 0, NEAR], [0, 0, NEAR + 0.3]),
        "through": ([-1.2, 0, NEAR], [1.2, 0, NEAR]),
    }[motion]
    return (1 - t) * np.array(start) + t * np.array(end), np.array([side, side, 0.1])


def segment(frames, poses):
    """Segment each frame against keyframes as a tracker does; return views and segments."""
    views = [prepare_view(frame, SurfaceOptions()) for frame in frames]
    objects, key, found = MovingObjects(), 0, []
    for n in range(1, len(frames)):
        predicted = objects.predicted_mask(poses[n], views[n])
        found.append(
            (key, predicted, followed(objects, views[n], poses[n], views[key], poses[key]))
        )
        distance, angle = distance_and_angle(poses[key], poses[n])
        if angle > 0.2 or distance > 0.1 * views[key].depth:
            key = n
    return views, found


def test_static_room_has_no_moving_objects(room):
    frames, poses, _ = room
    found = segment(frames, poses)[1]
    typical_scale = np.median([moving.scale for _, _, moving in found])
    for _, predicted, moving in found:
        assert moving.reliable
        assert moving.fraction == 0
        assert not moving.view.any()
        assert not moving.reference.any()
        assert not predicted.any()
        assert moving.agreement > 0.99
        assert 0.5 < moving.scale / typical_scale < 2


def segmented(room, motion, cover):
    """The images of a moving box with its masks, their views, and what is found in these."""
    frames, poses, noise = room
    centres, half = trajectory(motion, cover, frames[0])
    made = [
        with_box(frame, centre, half, noise, n)
        for n, (frame, centre) in enumerate(zip(frames, centres, strict=True))
    ]
    return made, *segment([frame for frame, _ in made], poses)


@pytest.mark.parametrize(("motion", "cover"), [("sideways", 0.1), ("towards", 0.25), ("away", 0.4)])
def test_moving_box_is_segmented(room, motion, cover):
    made, views, found = segmented(room, motion, cover)
    late = range(FRAMES - 5, FRAMES)
    truth, right, wrong, valid, vacated, predicted = np.zeros(6)
    for n in late:
        key, guess, moving = found[n - 1]
        mask = made[n][1]
        surface = views[n].planes[..., 3] > 0
        truth += np.count_nonzero(mask & surface)
        right += np.count_nonzero(moving.view & mask & surface)
        predicted += np.count_nonzero(guess & mask & surface)
        wrong += np.count_nonzero(moving.view & ~mask & surface)
        valid += np.count_nonzero(~mask & surface)
        vacated += np.count_nonzero(moving.reference & made[key][1]) / made[key][1].sum()
        assert moving.reliable
        assert moving.agreement > 0.9
        assert moving.fraction == pytest.approx(made[n][1][views[n].z > 0].mean(), abs=0.1)
    assert right / truth > 0.97
    assert predicted / truth > 0.9
    assert wrong / valid < 0.03
    assert vacated / len(late) > 0.9


def test_entering_object_is_segmented_and_forgotten_after_leaving(room):
    made, views, found = segmented(room, "through", 0.1)
    seen = [n for n in range(1, FRAMES) if made[n][1].mean() > 0.03]
    assert seen[0] > 3  # it is not there at first
    for n in range(1, seen[0] - 1):
        assert found[n - 1][2].fraction == 0
    n = seen[2]
    mask = made[n][1] & (views[n].planes[..., 3] > 0)
    assert np.count_nonzero(found[n - 1][2].view & mask) > 0.9 * mask.sum()
    assert seen[-1] < FRAMES - 1
    assert found[-1][2].fraction < 0.01


@pytest.mark.parametrize("moving", ["exclude", "ignore"])
def test_moving_objects_are_excluded_unless_ignored(room, moving):
    frames, _, noise = room
    centres, half = trajectory("sideways", 0.25, frames[0])
    tracker = Keyframes(moving=moving).start(0)
    steps = [
        tracker.push(with_box(frame, centre, half, noise, n)[0])
        for n, (frame, centre) in enumerate(zip(frames, centres, strict=True))
    ]
    masks = [step.moving for step in steps if step.moving is not None]
    assert (len(masks) > FRAMES // 2) == (moving == "exclude")
    if moving == "ignore":
        assert not masks
        assert not any(step.moved or step.rival for step in steps)


def test_what_comes_in_behind_the_front_of_an_object_moves_too(room):
    """As somebody's body behind an arm: since the arm came, none has seen behind both."""
    frames, poses, noise = room
    tracker, steps = Keyframes().start(0), []
    for n, frame in enumerate(frames):
        x = 0.9 - 0.1 * n
        made, _ = with_box(frame, np.array([x, 0, 0.7]), np.array([0.05, 0.6, 0.05]), noise, n)
        body = np.array([x + 0.35, 0, 1.0])
        made, behind = with_box(made, body, np.array([0.2, 0.6, 0.1]), noise, n)
        steps.append((tracker.push(made), behind))
    for n in range(11, 16):  # the body fills half of the image
        step, behind = steps[n]
        assert step.moving is not None
        assert (step.moving & behind).sum() > 0.95 * behind.sum()
    T = se3.inverse(poses[0]) @ poses[-1]
    distance, angle = distance_and_angle(T, steps[-1][0].T_component_camera)
    assert distance < 0.03
    assert np.degrees(angle) < 0.7


def varying_all_over(frame, percent):
    """Return a frame of which a tenth, in small squares all over the image, is farther."""
    rows, columns = (np.arange(n) // 8 for n in frame.valid.shape)
    squares = np.random.default_rng(5).random((rows[-1] + 1, columns[-1] + 1)) < 0.1
    farther = np.where(squares[np.ix_(rows, columns)], 1 + percent / 100, 1)
    return replace(frame, depth=frame.depth * farther.astype(np.float32))


def test_objects_explain_disagreement_unless_it_is_all_over_the_image(room):
    frames, poses, noise = room
    still = prepare_view(frames[0], SurfaceOptions())
    varied = prepare_view(varying_all_over(frames[0], 10), SurfaceOptions())
    box = np.array([0.1, 0, 0.9]), np.array([0.08, 0.15, 0.05])
    view = prepare_view(with_box(frames[1], *box, noise, 1)[0], SurfaceOptions())

    def found(reference, T):
        return MovingObjects().compare(view, T, reference, poses[0], suspected=True)

    wrong = poses[1] @ se3.exp([0.03, 0, 0, 0, 0.05, 0])
    results = found(still, poses[1]), found(varied, poses[1]), found(still, wrong)
    assert all(moving.reliable and moving.fraction > 0.05 for moving in results)
    assert [moving.explains_disagreement for moving in results] == [True, False, False]


def test_stopped_object_becomes_static(room):
    frames, poses, noise = room
    centres, half = trajectory("sideways", 0.15, frames[0])
    # The camera is static, too, so that only the keyframe changes.
    frames, poses = [replace(frames[0], index=n) for n in range(40)], [poses[0]] * 40
    made = [
        with_box(frame, centres[min(n, 8) * 2], half, noise, n)[0] for n, frame in enumerate(frames)
    ]
    views = [prepare_view(frame, SurfaceOptions()) for frame in made]
    objects = MovingObjects()
    fractions = [
        followed(objects, views[n], poses[n], views[0 if n < 12 else 11], poses[0]).fraction
        for n in range(1, 40)
    ]
    assert fractions[9] > 0.1
    assert fractions[-1] == 0


def test_masking_moving_objects_preserves_pose(room):
    frames, poses, noise = room
    centres, half = trajectory("towards", 0.25, frames[0])
    made = [
        with_box(frame, centre, half, noise, n)[0]
        for n, (frame, centre) in enumerate(zip(frames, centres, strict=True))
    ]
    views = [prepare_view(frame, SurfaceOptions()) for frame in made]
    objects, n = MovingObjects(), 6
    for k in range(1, n):
        followed(objects, views[k], poses[k], views[0], poses[0])
    mask = objects.predicted_mask(poses[n], views[n])
    whole, rest = (
        align(view, [Target(target, np.eye(4))], poses[n], ProjectiveOptions())
        for view, target in (
            (views[n], views[0]),
            (
                without_pixels(views[n], mask),
                without_pixels(views[0], objects.reference_mask(views[0])),
            ),
        )
    )
    errors = [
        np.linalg.norm((se3.inverse(poses[0] @ poses[n]) @ a.T_world_source)[:3, 3])
        for a in (whole, rest)
    ]
    assert rest.inlier_ratio > 0.95 > whole.inlier_ratio
    assert errors[1] < 0.02


@pytest.mark.parametrize(("metres", "degrees"), [(0.06, 2.0), (0.3, 10.0), (1.5, 50.0)])
def test_wrong_pose_causes_no_segments(room, metres, degrees):
    frames, poses, _ = room
    off = se3.exp(
        np.r_[np.array([0.8, -0.4, 0.4]) * metres, np.radians(degrees) * np.array([0.3, 0.9, 0.3])]
    )
    wrong = [T if n < 10 else T @ off for n, T in enumerate(poses)]
    views = [prepare_view(frame, SurfaceOptions()) for frame in frames]
    objects, scales = MovingObjects(), []
    for n in range(1, 13):
        key = 0 if n < 7 else 6
        moving = followed(objects, views[n], wrong[n], views[key], wrong[key])
        if n < 10:
            scales.append(moving.scale)
        else:
            assert moving.fraction < 0.05
            assert moving.scale > 1.5 * np.median(scales) or moving.agreement < 0.8


def test_unreliable_pair_does_not_update_state():
    views = [
        prepare_view(wall(depth, index), SurfaceOptions()) for index, depth in enumerate([2, 2, 1])
    ]
    objects = MovingObjects()
    still = np.eye(4)
    assert followed(objects, views[1], still, views[0], still).reliable
    for _ in range(3):
        moving = followed(objects, views[2], still, views[0], still)
        assert not moving.reliable
        assert moving.fraction == 0
        assert moving.agreement == 0


def test_comparison_does_not_change_state(room):
    frames, poses, noise = room
    centres, half = trajectory("towards", 0.25, frames[0])
    made = [with_box(frames[n], centres[n], half, noise, n)[0] for n in range(9)]
    views = [prepare_view(frame, SurfaceOptions()) for frame in made]
    off = se3.exp([0.05, 0.03, 0.05, 0.02, 0.03, 0.01])
    tried, untried = MovingObjects(), MovingObjects()
    for n in range(1, 9):
        pair = views[n], poses[n], views[0], poses[0]
        wrong = tried.compare(views[n], poses[n] @ off, views[0], poses[0])
        before = tried.compare(*pair)
        one, two = followed(tried, *pair), followed(untried, *pair)
        np.testing.assert_array_equal(one.view, two.view)
        np.testing.assert_array_equal(one.reference, two.reference)
        np.testing.assert_array_equal(one.view, before.view)
        assert wrong.scale > 1.2 * one.scale
    assert one.view.any()


def test_masks_of_keyframes_are_kept_up_to_limit(room):
    frames, poses, noise = room
    centres, half = trajectory("sideways", 0.25, frames[0])
    made = [with_box(frames[n], centres[n], half, noise, n)[0] for n in range(10)]
    views = [prepare_view(frame, SurfaceOptions()) for frame in made]
    objects = MovingObjects(max_references=1)
    for n in range(1, 9):
        moving = followed(objects, views[n], poses[n], views[0], poses[0])
    np.testing.assert_array_equal(objects.reference_mask(views[0]), moving.reference)
    np.testing.assert_array_equal(objects.reference_mask(views[8]), moving.view)
    assert objects.reference_mask(views[8]).any()
    followed(objects, views[9], poses[9], views[8], poses[8])
    assert not objects.reference_mask(views[0]).any()
    assert objects.reference_mask(views[8]).any()
    objects.reset()
    assert not objects.predicted_mask(poses[9], views[9]).any()


def wall(depth, index=0):
    camera = Pinhole(64, 48, 60.0, 60.0, 31.5, 23.5)
    z = np.full((camera.height, camera.width), depth, np.float32)
    noise = np.random.default_rng(index).normal(0, 0.002, z.shape)
    return RangeFrame(index, float(index), camera, (z + noise).astype(np.float32))


def test_masked_pixels_keep_free_space_but_no_surface(room):
    frames, poses, _ = room
    view, other = (prepare_view(frames[n], SurfaceOptions()) for n in (0, 1))
    mask = np.zeros(view.z.shape, bool)
    mask[:, :80] = True
    rest = without_pixels(view, mask)
    assert not (rest.planes[mask] != 0).any()
    assert not rest.sigma[mask].any()
    assert np.isnan(rest.albedo[mask]).all()
    assert not rest.target[mask].any()
    np.testing.assert_array_equal(rest.z, view.z)
    np.testing.assert_array_equal(rest.planes[~mask], view.planes[~mask])
    assert without_pixels(view, np.zeros_like(mask)) is view
    T = se3.inverse(poses[1]) @ poses[0]
    assert agreement(rest, other, T).violation <= agreement(view, other, T).violation + 0.01
    with pytest.raises(ValueError, match="the mask is"):
        without_pixels(view, mask[1:])


def pair(seed=3):
    """Two views of a slanted wall with a box that moves between them, and T_other_view."""
    camera = Pinhole(48, 36, 45.0, 45.0, 23.5, 17.5)
    rng = np.random.default_rng(seed)
    x, y = np.moveaxis(camera.rays(), -1, 0)
    T = se3.exp([0.02, -0.01, 0.015, 0.01, -0.02, 0.03])
    views = []
    for k, (left, pose) in enumerate(((20, np.eye(4)), (10, T))):
        n = np.array([0.1, 0.05, 0.5])
        # n . (R p + t) = 1
        m = pose[:3, :3].T @ n
        z = (1 - n @ pose[:3, 3]) / (m[0] * x + m[1] * y + m[2])
        z[8:28, left : left + 16] = 1.2 + 0.2 * k
        z += rng.normal(0, 0.003, z.shape)
        z[rng.random(z.shape) < 0.03] = 0
        frame = RangeFrame(k, float(k), camera, z.astype(np.float32))
        views.append(prepare_view(frame, SurfaceOptions()))
    return camera, views[1], views[0], T


def test_person_before_static_camera_is_segmented(shared_data):
    frames = list(open_recording(shared_data / "person_turning"))[:40:4]
    views = [prepare_view(frame, SurfaceOptions()) for frame in frames]
    objects, still = MovingObjects(), np.eye(4)
    found = [followed(objects, view, still, views[0], still) for view in views[1:]]
    # The person is nearer than the wall.
    person = views[-1].z < 0.5 * views[-1].z.max()
    person &= views[-1].planes[..., 3] > 0
    rest = (views[-1].planes[..., 3] > 0) & ~person
    assert np.count_nonzero(found[-1].view & person) > 0.9 * np.count_nonzero(person)
    assert np.count_nonzero(found[-1].view & rest) < 0.02 * np.count_nonzero(rest)
    assert found[-1].agreement > 0.95


def test_static_kitchen_has_no_moving_objects(shared_data):
    recording = open_recording(shared_data / "sevenscenes_kitchen")
    frames = [frame for _, frame in zip(range(40), recording, strict=False)][::4]
    views = [prepare_view(frame, SurfaceOptions()) for frame in frames]
    T = [np.eye(4)]
    for k in range(1, len(views)):
        target = Target(views[0], se3.inverse(T[0]))
        T.append(align(views[k], [target], T[-1], ProjectiveOptions()).T_world_source)
    objects = MovingObjects()
    for k in range(1, len(views)):
        moving = followed(objects, views[k], T[k], views[0], T[0])
        assert moving.fraction < 0.01
        assert moving.agreement > 0.95
