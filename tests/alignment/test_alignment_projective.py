"""Alignment of prepared views with known motions, and unobservable directions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import pose_errors
from tofuse.engine.alignment.projective import UNITS, ProjectiveOptions, Target, align
from tofuse.engine.geometry import se3
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import camera_model
from tofuse.lab.simulation.render import render
from tofuse.lab.world.scene import FRAME_RATE_HZ, build

OPTIONS = ProjectiveOptions()
MODEL = camera_model("sr4000")
GEOMETRY = replace(OPTIONS, photometric=False)


class Pair:
    """Frames of a scene and their true poses; the first is the world."""

    def __init__(self, name, *indices, noise=False, texture=True):
        scene, sequence = build(name, texture=texture)
        effects = Effects.none(shot_noise=noise)
        self.frames = [render(scene, sequence, MODEL, k, effects=effects).frame for k in indices]
        self.views = [prepare_view(frame, SurfaceOptions()) for frame in self.frames]
        rate = FRAME_RATE_HZ
        self.poses = [sequence.T_world_camera(k / rate, indices[0] / rate) for k in indices]
        self.target = Target(self.views[0], np.eye(4))


@pytest.fixture(scope="module")
def room():
    return Pair("room", 0, 3, 6)


@pytest.fixture(scope="module")
def corner():
    return Pair("corner", 0, 6)


@pytest.fixture(scope="module")
def wall():
    """With noise, which must not be taken for constraints."""
    return Pair("wall", 0, 3, noise=True)


def assert_near(found, true, metres=0.001, degrees=0.02):
    pose_errors.assert_near(found.T_world_source, true, metres, degrees)


@pytest.mark.parametrize("options", [OPTIONS, GEOMETRY], ids=["albedo", "geometry"])
@pytest.mark.parametrize("scene", ["room", "corner"])
def test_known_motion_is_found(request, scene, options):
    pair = request.getfixturevalue(scene)
    found = align(pair.views[1], [pair.target], np.eye(4), options)
    assert se3.angle(pair.poses[1]) + np.linalg.norm(pair.poses[1][:3, 3]) > 0.01
    assert_near(found, pair.poses[1])
    assert found.converged
    assert len(found.unobservable) == 0
    assert found.inlier_ratio > 0.95
    assert found.in_front < 0.02 * found.compared
    assert 0.8 < found.overlap <= 1
    assert found.rms_m < 0.002


@pytest.mark.parametrize("size", [0.02, 0.05])
def test_convergence_basin_of_coarse_level(room, size):
    rng = np.random.default_rng(1)
    for _ in range(3):
        start = room.poses[1] @ se3.exp(size * rng.uniform(-1, 1, 6))
        found = align(room.views[1], [room.target], start, OPTIONS)
        assert_near(found, room.poses[1], 0.002, 0.04)


def test_albedo_constrains_pose_before_flat_wall(wall):
    true = wall.poses[1]
    assert np.linalg.norm(true[:3, 3]) > 0.005
    found = align(wall.views[1], [wall.target], np.eye(4), OPTIONS)
    assert len(found.unobservable) == 0
    assert_near(found, true, 0.001, 0.03)


def test_flat_wall_without_albedo_constrains_three_directions(wall):
    true = wall.poses[1]
    predicted = true @ se3.exp([0.03, -0.02, 0.015, 0.01, -0.015, 0.02])
    found = align(wall.views[1], [wall.target], predicted, GEOMETRY)
    assert found.unobservable.shape == (3, 6)
    np.testing.assert_allclose(found.unobservable @ found.unobservable.T, np.eye(3), atol=1e-9)
    # The camera slides along the wall and rotates about its normal: these are the three.
    R = found.T_world_source[:3, :3]
    normal = R.T @ np.median(wall.views[0].normals.reshape(-1, 3), axis=0)
    normal /= np.linalg.norm(normal)
    tangents = np.linalg.svd(normal[None])[2][1:]
    free = np.zeros((3, 6))
    free[:2, :3] = tangents
    free[2, 3:] = normal
    free /= UNITS
    basis = np.linalg.qr(free.T)[0]
    assert np.linalg.svd(found.unobservable @ basis)[1].min() > 0.98
    # They stay as predicted ...
    moved = se3.log(se3.inverse(predicted) @ found.T_world_source) / UNITS
    assert np.abs(found.unobservable @ moved).max() < 0.1
    # ... and the constrained ones are found: distance and tilt of the wall.
    left = se3.log(se3.inverse(true) @ found.T_world_source)
    assert abs(left[:3] @ normal) < 0.002
    tilt = left[3:] - (left[3:] @ normal) * normal
    assert np.degrees(np.linalg.norm(tilt)) < 0.05


def test_views_of_unequal_noise_constrain_each_other(room) -> None:
    """Errors common to both views count by the noise of both, as the measurements do."""
    sigma = np.full_like(room.frames[1].depth, 0.05)
    noisy = prepare_view(replace(room.frames[1], sigma_image=sigma), SurfaceOptions())
    true = se3.inverse(room.poses[0]) @ room.poses[1]
    for source, target, T in (
        (noisy, room.views[0], true),
        (room.views[0], noisy, se3.inverse(true)),
    ):
        assert not len(align(source, [Target(target)], T, GEOMETRY).unobservable)


def test_corridor_does_not_constrain_its_axis():
    pair = Pair("corridor", 0, 6, texture=False)
    found = align(pair.views[1], [pair.target], np.eye(4), GEOMETRY)
    assert len(found.unobservable) == 1
    assert np.argmax(np.abs(found.unobservable[0] * UNITS)[:3]) == 2
    assert np.abs(found.unobservable[0, 2]) > 0.9


def test_outliers_do_not_bias_pose(room):
    frame = room.frames[1]
    depth = frame.depth.copy()
    depth[40:90, 60:110] *= 0.7  # a person enters: a tenth of the image
    depth[100:130, 20:60] += 0.3
    light = frame.amplitude_image.copy()
    light[10:40, 30:90] *= 4
    view = prepare_view(replace(frame, depth=depth, amplitude_image=light), SurfaceOptions())
    found = align(view, [room.target], np.eye(4), OPTIONS)
    assert_near(found, room.poses[1], 0.003, 0.05)
    assert found.inlier_ratio < 0.95


def test_small_scene_is_equally_robust(room):
    """The tolerance of the coarse level is in m, but must not include nearby obstacles."""
    coarse = replace(GEOMETRY, levels=OPTIONS.levels[:1])
    scale = 0.1  # the room becomes 0.3 m deep
    target, source = room.frames[:2]
    depth = source.depth.copy()
    depth[30:100, 50:120] *= 0.85
    source = replace(source, depth=depth)
    found = []
    for size in (1.0, scale):
        views = [
            prepare_view(replace(f, depth=f.depth * np.float32(size)), SurfaceOptions())
            for f in (target, source)
        ]
        aligned = align(views[1], [Target(views[0], np.eye(4))], np.eye(4), coarse)
        T = aligned.T_world_source.copy()
        T[:3, 3] /= size
        found.append(pose_errors.pose_error(T, room.poses[1])[0])
    assert found[0] < 0.003
    assert found[1] < 0.003


@pytest.mark.parametrize("gain", [1.5, 0.5])
def test_changed_exposure_is_estimated(room, wall, gain):
    for pair in (room, wall):
        frame = pair.frames[1]
        brighter = replace(frame, amplitude_image=frame.amplitude_image * np.float32(gain))
        view = prepare_view(brighter, SurfaceOptions())
        found = align(view, [pair.target], np.eye(4), OPTIONS)
        assert found.exposure == pytest.approx(-np.log(gain), abs=0.01)
        assert_near(found, pair.poses[1], 0.001, 0.03)


def test_several_targets_are_combined(room):
    targets = [room.target, Target(room.views[1], se3.inverse(room.poses[1]))]
    both = align(room.views[2], targets, room.poses[1], OPTIONS)
    assert_near(both, room.poses[2])
    one = align(room.views[2], targets[:1], room.poses[1], OPTIONS)
    other = align(room.views[2], targets[1:], room.poses[1], OPTIONS)
    assert both.points == one.points + other.points
    assert abs(both.inliers - one.inliers - other.inliers) < 0.02 * both.inliers


def test_pose_of_world_is_arbitrary(room):
    T = se3.exp([3, -2, 1, 0.4, -0.8, 1.2])
    found = align(room.views[1], [Target(room.views[0], se3.inverse(T))], T, OPTIONS)
    assert_near(found, T @ room.poses[1])


def test_empty_view_stays_at_prediction(room):
    frame = room.frames[1]
    blank = prepare_view(replace(frame, depth=np.zeros_like(frame.depth)), SurfaceOptions())
    T = se3.exp([0.1, 0, 0, 0, 0.1, 0])
    for source, target in ((blank, room.target), (room.views[1], Target(blank, np.eye(4)))):
        found = align(source, [target], T, OPTIONS)
        assert found.inliers == 0
        assert len(found.unobservable) == 6
        np.testing.assert_allclose(found.T_world_source, T, atol=1e-9)


def test_view_with_infinite_planes_stays_at_prediction(room):
    planes = room.views[1].planes.copy()
    planes[60:70, :, :3] = np.inf
    found = align(replace(room.views[1], planes=planes), [room.target], room.poses[2], OPTIONS)
    np.testing.assert_array_equal(found.T_world_source, room.poses[2])
    assert not found.converged
    assert found.inliers == 0
    assert len(found.unobservable) == 6
