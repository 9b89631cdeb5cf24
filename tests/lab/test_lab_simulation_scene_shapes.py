"""Meshes, their normals, and the triangulation of blended bodies."""

from __future__ import annotations

import numpy as np
import pytest

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


def test_surface_net_of_ball_is_closed_and_accurate():
    ball = blends.surface_net(
        blends.ellipsoid((0.1, 0, 0), (0.5, 0.5, 0.5)), (-1, -1, -1), (1, 1, 1), 0.08
    )
    assert is_closed(ball)
    assert np.abs(np.linalg.norm(ball.vertices - (0.1, 0, 0), axis=1) - 0.5).max() < 1e-5
    assert volume(ball) == pytest.approx(4 / 3 * np.pi * 0.125, rel=0.02)


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


def test_no_ray_leaves_the_person(person):
    mesh, materials = person
    scene = Scene("person", materials, mesh)
    d = np.random.default_rng([0, 21]).normal(size=(20000, 3))
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
