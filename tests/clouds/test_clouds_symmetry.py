"""Symmetric clouds fit in several poses: the answer says so, whatever the start."""

from __future__ import annotations

import numpy as np
import pytest

import tofuse
from registration_scenes import rng, stone
from tofuse.engine.clouds.cloud_pair import symmetries
from tofuse.engine.frames import CloudFrame
from tofuse.engine.fusion import GeometryRecord
from tofuse.engine.geometry import se3
from tofuse.formats.geometry import surface_points
from tofuse.lab.world import mesh as meshes

GUESS_ERROR = se3.exp([0.02, -0.01, 0.01, 0.03, -0.02, 0.02])


def prism(corners):
    profile = [(0, 0), (0.3, 0), (0.3, 0.5), (0, 0.5)]
    return meshes.lathe(profile, corners).translated(0, 0, -0.25)


def table(width, depth):
    legs = [
        meshes.box((0.05, 0.05, 0.7), (0.45 * x * width, 0.45 * y * depth, 0.35))
        for x in (-1, 1)
        for y in (-1, 1)
    ]
    return meshes.joined([meshes.box((width, depth, 0.04), (0, 0, 0.72)), *legs])


def square_room():
    return meshes.inside_out(meshes.box((4, 4, 2.5), (0, 0, 1.25)))


# Each with a turn about z that maps it to itself, in degrees.
BODIES = {
    "box": (lambda: meshes.box((0.6, 0.4, 0.3)), 180),
    "cube": (lambda: meshes.box((0.4, 0.4, 0.4)), 90),
    "hexagonal prism": (lambda: prism(6), 60),
    "square room": (square_room, 90),
    "square table": (lambda: table(1.0, 1.0), 90),
}


def pair(name):
    """Two samples of a body that was turned by its symmetry, and the true pose."""
    make, degrees = BODIES[name]
    mesh = make()
    world = surface_points(GeometryRecord(mesh.vertices, mesh.faces), name, 8000)
    world = rng(5).permutation(world)
    T = se3.exp([0, 0, 0, 0, 0, np.radians(degrees)])
    source, target = world[::2], world[1::2]
    noise = rng(6).normal(0, 0.002, (2, 4000, 3))
    return se3.transform(se3.inverse(T), source) + noise[0], target + noise[1], T


@pytest.mark.parametrize("name", BODIES)
def test_symmetric_body_is_accepted_only_given_the_guess(name):
    source, target, T = pair(name)
    for guess, expected in ((np.eye(4), np.eye(4)), (T @ GUESS_ERROR, T)):
        found = tofuse.register(source, target, guess=guess)
        assert found.believed
        assert found.given_guess
        assert "given the guess" in repr(found)
        assert found.runner_up is not None
        assert se3.is_within(se3.inverse(expected) @ found.T_target_source, 0.02, 0.02)


@pytest.mark.nightly_part
@pytest.mark.parametrize("name", BODIES)
def test_symmetric_body_is_not_accepted_without_guess(name):
    source, target, _ = pair(name)
    assert not tofuse.register(source, target).believed


def test_body_without_symmetry_does_not_need_its_guess():
    source, target = stone(4000, 1, 0.002), stone(4000, 2, 0.002)
    found = tofuse.register(source, target, guess=GUESS_ERROR)
    assert found.believed
    assert not found.given_guess


def test_symmetries_are_found_once():
    mesh = prism(5)
    points = surface_points(GeometryRecord(mesh.vertices, mesh.faces), "prism", 6000)
    view = CloudFrame.of(rng(1).permutation(points))
    found = symmetries(view)
    assert symmetries(view) is found
    assert np.abs(np.degrees(se3.angle(found)) - 72).min() < 1.5  # no half or quarter turn
    assert len(symmetries(CloudFrame.of(stone(3000, 0)))) == 0
