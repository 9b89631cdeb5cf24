"""Scenes and paths: sizes, counts and motion of the test cases, and exact ground truth."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.geometry import se3
from tofuse.lab.world.mesh import Mesh
from tofuse.lab.world.scene import SCENES, Scene, build


def sr4000_rays(step=4):
    """Unit directions (N, 3) in the camera's frame: 43.6 x 34.6 degrees."""
    f = 88 / np.tan(np.deg2rad(43.6 / 2))
    v, u = np.mgrid[:144:step, :176:step].reshape(2, -1)
    d = np.stack([(u - 87.5) / f, (v - 71.5) / f, np.ones(len(u))], -1)
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def look(scene, sequence, t, rays):
    T = sequence.T_room_camera(t)
    return scene.cast(T[:3, 3], rays @ T[:3, :3].T, sequence.T_room_object(t))


def sphere_rays(count, seed=0):
    d = np.random.default_rng([seed, 30]).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def built():
    return {name: build(name) for name in SCENES}


@pytest.mark.parametrize(
    ("name", "raw", "stride", "used"),
    [
        ("rail", 315, 5, 63),
        ("room", 384, 3, 128),
        ("empty-room", 405, 3, 135),
        ("torso", 222, 6, 37),
        ("box", 570, 10, 57),
    ],
)
def test_frame_counts_match_thesis(built, name, raw, stride, used):
    sequence = built[name][1]
    assert (sequence.frames, sequence.stride) == (raw, stride)
    assert len(range(0, sequence.frames, sequence.stride)) == used


@pytest.mark.parametrize("name", SCENES)
def test_hits_are_valid(built, name):
    scene, sequence = built[name]
    rays = sr4000_rays()
    for t in np.linspace(0, sequence.frames / sequence.frame_rate_hz, 5):
        hits = look(scene, sequence, t, rays)
        assert np.isfinite(hits.distance).all()
        assert hits.distance.min() > 0.3
        d = rays @ sequence.T_room_camera(t)[:3, :3].T
        np.testing.assert_allclose(np.linalg.norm(hits.normal, axis=1), 1, atol=1e-5)
        assert ((hits.normal * d).sum(1) < 0).all()
        assert 0.02 <= hits.albedo.min() <= hits.albedo.max() <= 0.98
        assert 0.0 <= hits.gloss.min() <= hits.gloss.max() < 1.0
        assert (hits.surface >= 0).all()
        assert hits.surface.max() < len(scene.materials)


@pytest.mark.parametrize("name", ["room", "empty-room", "rail", "torso", "box", "corridor"])
def test_rooms_are_closed(built, name):
    scene, sequence = built[name]
    origin = sequence.T_room_camera(0)[:3, 3]
    assert np.isfinite(scene.cast(origin, sphere_rays(60000)).distance).all()


def test_rail_moves_90_cm_sideways_and_back_slower(built):
    _, sequence = built["rail"]
    times = np.arange(sequence.frames) / 30
    poses = np.array([sequence.T_world_camera(t) for t in times])
    x = poses[:, 0, 3]
    assert x.max() == pytest.approx(0.90, abs=1e-4)
    assert x.min() >= 0.0
    assert x[-1] < 0.01
    np.testing.assert_allclose(poses[:, 1:3, 3], 0, atol=1e-12)
    np.testing.assert_allclose(poses[:, :3, :3], np.tile(np.eye(3), (len(poses), 1, 1)), atol=1e-12)
    speed = np.diff(x) * 30
    assert speed.max() > 1.4 * -speed.min()
    assert np.abs(np.diff(speed)).max() * 30 < 1.0  # m/s^2: no jerks
    turning = np.argmax(x)
    assert turning < len(x) - turning


@pytest.mark.parametrize("name", ["room", "empty-room"])
def test_turn_closes_after_last_frame(built, name):
    _, sequence = built[name]
    whole = sequence.frames / 30
    np.testing.assert_array_equal(sequence.T_world_camera(0.0), np.eye(4))
    np.testing.assert_allclose(sequence.T_world_camera(whole), np.eye(4), atol=1e-9)
    last = sequence.T_world_camera((sequence.frames - sequence.stride) / 30)
    assert 1.0 < np.rad2deg(se3.angle(last)) < 4.0
    assert np.rad2deg(se3.angle(sequence.T_world_camera(whole / 2))) > 175
    # Turning to the right is positive about the camera's y axis, which points down.
    quarter = sequence.T_world_camera(whole / 4)
    np.testing.assert_allclose(quarter[:3, 2], [1, 0, 0], atol=0.03)
    np.testing.assert_allclose(quarter[:3, 3], 0, atol=1e-12)


@pytest.mark.parametrize("name", SCENES)
def test_visible_points_lie_on_truth_mesh(built, name):
    """Hits, mapped by the true pose into the world and back onto the truth mesh."""
    scene, sequence = built[name]
    vertices, faces = scene.truth_mesh()
    truth = se3.transform(sequence.T_world_truth(), vertices)
    moving = sequence.T_room_object(0.0) is not None
    rays = sr4000_rays(12)
    alone = Scene("truth", scene.materials, Mesh.of(truth, faces))
    for t in (0.0, 0.31 * sequence.frames / 30, 0.77 * sequence.frames / 30):
        hits = look(scene, sequence, t, rays)
        pose = sequence.T_world_camera(t)
        again = alone.cast(pose[:3, 3], rays @ pose[:3, :3].T)
        near = np.isfinite(again.distance) if moving else np.ones(len(rays), bool)
        assert near.mean() > 0.05
        np.testing.assert_allclose(again.distance[near], hits.distance[near], atol=1e-5)


def surface(scene, name):
    """The id of the first surface with this name."""
    return [material.name for material in scene.materials].index(name)


def test_box_is_300_by_300_by_400_mm_with_its_top_in_view(built):
    scene, sequence = built["box"]
    vertices, faces = scene.truth_mesh()
    box = surface(scene, "box")
    hits = look(scene, sequence, 0.0, sr4000_rays(1))
    top = (hits.surface == box) & (hits.normal[:, 2] > 0.999)
    assert top.sum() > 300
    side = (hits.surface == box) & (np.abs(hits.normal[:, 2]) < 1e-3)
    assert side.sum() > 2000
    corners = vertices[np.unique(faces[:12])]
    np.testing.assert_allclose(np.ptp(corners, axis=0), [0.3, 0.3, 0.4], atol=1e-15)
    # All of the box is in the picture, all around, and nearer than the cut; the rest is beyond.
    rays = sr4000_rays(4)
    for t in np.linspace(0, 19, 7):
        hits = look(scene, sequence, t, rays)
        edge = (np.abs(rays[:, 0] / rays[:, 2]) > 0.385) | (np.abs(rays[:, 1] / rays[:, 2]) > 0.30)
        assert not (hits.surface[edge] == box).any()
        on = hits.surface == box
        assert hits.distance[on].max() < scene.max_depth_m
        steel = hits.surface == surface(scene, "stand")
        beyond = (hits.distance * rays[:, 2])[~on & ~steel]
        assert beyond.min() > scene.max_depth_m


@pytest.mark.parametrize("name", ["torso", "box"])
def test_camera_orbits_moving_object_in_its_frame(built, name):
    _, sequence = built[name]
    np.testing.assert_array_equal(
        sequence.T_room_camera(0.0), sequence.T_room_camera(sequence.frames / 60)
    )
    T_object_world = se3.inverse(sequence.T_world_truth())
    whole = sequence.frames / 30
    centres = np.array(
        [(T_object_world @ sequence.T_world_camera(t))[:3, 3] for t in np.linspace(0, whole, 9)]
    )
    radius = np.hypot(centres[:, 0], centres[:, 1])
    assert radius.min() > 1.0
    np.testing.assert_allclose(radius, radius[0], atol=1e-9)
    np.testing.assert_allclose(centres[0], centres[-1], atol=1e-9)
