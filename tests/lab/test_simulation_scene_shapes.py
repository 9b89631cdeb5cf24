"""Meshes, their normals, and the triangulation of blended bodies."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.geometry import se3
from tofuse.lab.scenes import blends, torso
from tofuse.lab.world import mesh as meshes
from tofuse.lab.world.scene import Scene
from tofuse.lab.world.texture import Material


def directed_edges(faces):
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def is_closed(mesh):
    """Each edge occurs equally often in both directions."""
    edges = directed_edges(mesh.faces)
    there, count = np.unique(edges, axis=0, return_counts=True)
    back, back_count = np.unique(edges[:, ::-1], axis=0, return_counts=True)
    return there.shape == back.shape and (there == back).all() and (count == back_count).all()


def volume(mesh):
    a, b, c = mesh.corners().transpose(1, 0, 2)
    return float((a * np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize(
    ("mesh", "wanted"),
    [
        (meshes.box((1, 2, 3), (5, 0, 0)), 6.0),
        (meshes.lathe([(0, 0), (1, 0), (1, 2), (0, 2)], 200), 2 * np.pi),
        (meshes.rod((1, 2, 3), (1, 2, 5), 0.5, segments=200), np.pi / 2),
        (meshes.rod((0, 0, 0), (3, 0, 0), 1.0, 0.5, segments=200), np.pi * 1.75),
        (meshes.superellipsoid((2, 4, 6), segments=(60, 120)), 4 / 3 * np.pi * 6),
    ],
)
def test_solids_are_closed_and_face_outward(mesh, wanted):
    assert is_closed(mesh)
    assert volume(mesh) == pytest.approx(wanted, rel=3e-3)
    assert volume(meshes.inside_out(mesh)) == pytest.approx(-wanted, rel=3e-3)


def test_normals_are_smooth_on_curved_surfaces_and_sharp_at_edges():
    ball = meshes.superellipsoid((2, 2, 2), segments=(16, 32))
    middle = ball.corners()
    wanted = middle / np.linalg.norm(middle, axis=-1, keepdims=True)
    cosine = (meshes.corner_normals(ball) * wanted).sum(-1)
    assert np.rad2deg(np.arccos(cosine.clip(-1, 1))).max() < 4.0
    cube = meshes.box((1, 1, 1))
    np.testing.assert_allclose(
        meshes.corner_normals(cube), np.repeat(meshes.face_normals(cube)[:, None], 3, 1)
    )


def test_joined_meshes_keep_surfaces_and_positions():
    a = meshes.box((1, 1, 1)).of_surface(3)
    b = meshes.box((1, 1, 1)).transformed(se3.exp([5, 0, 0, 0, 0, 1])).of_surface(4)
    both = meshes.joined([a, b])
    assert list(np.unique(both.surface)) == [3, 4]
    np.testing.assert_allclose(both.corners()[12:], b.corners())
    assert volume(both) == pytest.approx(2.0)


def test_surface_net_of_ball_is_closed_and_accurate():
    ball = blends.surface_net(
        blends.ellipsoid((0.1, 0, 0), (0.5, 0.5, 0.5)), (-1, -1, -1), (1, 1, 1), 0.08
    )
    assert is_closed(ball)
    radius = np.linalg.norm(ball.vertices - (0.1, 0, 0), axis=1)
    assert np.abs(radius - 0.5).max() < 1e-5
    assert volume(ball) == pytest.approx(4 / 3 * np.pi * 0.125, rel=0.02)


def test_blending_is_local():
    a = blends.ellipsoid((-0.5, 0, 0), (0.4, 0.4, 0.4))
    b = blends.limb((0.5, 0, 0), (1.0, 0, 0), 0.4, 0.2)
    both = blends.blend([(a, 0.0), (b, 0.3)])
    gap = np.array([[0.0, 0.0, 0.0]])
    assert a(gap)[0] > 0
    assert b(gap)[0] > 0
    assert both(gap)[0] < min(a(gap)[0], b(gap)[0])
    far = np.array([[-1.0, 0, 0], [1.3, 0, 0]])
    np.testing.assert_allclose(both(far), [a(far)[0], b(far)[1]])
    assert b(np.array([[1.2, 0, 0]]))[0] == pytest.approx(0.0, abs=1e-12)


@pytest.fixture(scope="module")
def person():
    return torso.person()


def test_person_is_closed_and_human_sized(person):
    mesh, _ = person
    assert is_closed(mesh)
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    assert 0.85 < high[2] - 0.47 < 0.95  # sitting height above the seat
    chest = mesh.vertices[(np.abs(mesh.vertices[:, 2] - 1.02) < 0.02)]
    assert 0.40 < np.ptp(chest[:, 1]) < 0.52  # across the shoulders
    assert low[0] > -0.25  # the grid does not crop the person
    assert high[0] < 0.66
    # A person of 60 to 85 kg has about the density of water.
    assert 0.055 < volume(mesh) < 0.085


def test_person_is_asymmetric(person):
    mesh, materials = person
    head = mesh.vertices[(mesh.vertices[:, 2] > 1.15)]
    assert head[:, 0].max() > 0.12 > 0.11 > -head[:, 0].min()
    left = mesh.vertices[mesh.vertices[:, 1] > 0.2]
    right = mesh.vertices[mesh.vertices[:, 1] < -0.2]
    assert abs(left[:, 2].min() - right[:, 2].min()) > 0.005
    middle = mesh.corners().mean(1)
    names = [m.name for m in materials]
    hair = middle[mesh.surface == names.index("hair")]
    skin = middle[mesh.surface == names.index("skin")]
    face = skin[skin[:, 2] > 1.2]
    assert face[:, 0].mean() > hair[hair[:, 2] > 1.2][:, 0].mean() + 0.05


def test_no_ray_leaves_the_person(person):
    mesh, materials = person
    scene = Scene("person", materials, mesh)
    rng = np.random.default_rng([0, 21])
    d = rng.normal(size=(20000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    for inside in ((0, 0, 0.9), (0.01, 0, 1.27)):
        assert np.isfinite(scene.cast(inside, d).distance).all()


def test_smooth_normals_face_rays_at_silhouettes():
    ball = meshes.superellipsoid((2, 2, 2), segments=(12, 24))
    scene = Scene("ball", [Material("ball", 0.5)], ball)
    y, z = np.meshgrid(np.linspace(-1, 1, 400), np.linspace(-1, 1, 400))
    origins = np.stack([np.full(y.size, -3.0), y.ravel(), z.ravel()], -1)
    d = np.tile([1.0, 0, 0], (len(origins), 1))
    hits = scene.cast(origins, d)
    on = np.isfinite(hits.distance)
    assert (hits.normal[on] @ d[0] < 0).all()
    np.testing.assert_allclose(np.linalg.norm(hits.normal[on], axis=1), 1, atol=1e-6)
    assert (hits.normal[~on] == 0).all()
    assert (hits.surface[~on] == -1).all()
    assert (hits.albedo[~on] == 0).all()
    p = origins[on] + hits.distance[on, None] * d[0]
    cosine = (hits.normal[on] * p).sum(1) / np.linalg.norm(p, axis=1)
    assert np.rad2deg(np.arccos(np.clip(np.median(cosine), -1, 1))) < 1.0
