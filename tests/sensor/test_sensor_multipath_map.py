"""Surfaces out of view: taken from earlier views, placed by the camera motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from multipath_corner import CAMERA, FLOOR, GAIN, LEFT, PERIOD_M, RIGHT, Plane, Seen
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.sensor.multipath import MultipathModel, ToFImage
from tofuse.engine.sensor.multipath_correction import Multipath
from tofuse.engine.sensor.multipath_kernels import PATCH
from tofuse.engine.sensor.multipath_surfaces import (
    OffscreenCells,
    ReflectorMap,
    Surfaces,
    block_nodes,
    fit_planes,
)

ALBEDO = 0.6


def surfaces_of(seen: Seen, step: int = 1) -> Surfaces:
    """Surfaces of a view without multipath."""
    z = (seen.range / seen.length).astype(np.float32)
    nodes = block_nodes(z, seen.camera.rays(), seen.own.astype(np.float32), step)
    fit_planes(nodes)
    return Surfaces.of(nodes, np.ones(nodes.shape[:2]))


def everywhere(surfaces: Surfaces) -> np.ndarray:
    return np.ones(surfaces.has_plane.shape, bool)


def turned(angle_rad: float) -> np.ndarray:
    """T_world_camera of a camera rotated to the right."""
    return se3.exp(np.array([0, 0, 0, 0, angle_rad, 0]))


def seen_from(T: np.ndarray, *planes: Plane) -> Seen:
    """Infinite planes of the world, seen from a pose."""
    moved = []
    for normal, d in planes:
        n = np.array(normal) / np.linalg.norm(normal)
        moved.append((tuple(n @ T[:3, :3]), (d - n @ T[:3, 3])))
    return Seen(*moved, albedo=ALBEDO)  # type: ignore[arg-type]


def test_cells_tile_surroundings_of_image_up_to_lamp_cone() -> None:
    rays = CAMERA.rays().astype(float)
    half = 0.5 / CAMERA.fx
    low, high = rays.min((0, 1)) - half, rays.max((0, 1)) + half
    around = OffscreenCells.of(CAMERA.rays(), 1.3)
    left, right = around.rays - around.pitch / 2, around.rays + around.pitch / 2
    overlap = np.clip(np.minimum(right, high) - np.maximum(left, low), 0, None).prod(1)
    assert overlap.max() < 1e-6
    # Whole cells next to the image, so that there is no gap.
    beside = np.isclose(right[:, 0], low[0], atol=1e-6)
    inside = (around.rays[:, 1] > low[1]) & (around.rays[:, 1] < high[1])
    assert around.fraction[beside & inside].sum() * around.pitch[1] == pytest.approx(
        high[1] - low[1]
    )
    corner = np.arctan(np.hypot(*np.maximum(np.abs(low), np.abs(high))))
    lit = np.pi * np.tan(1.3 * corner) ** 2 - (high - low).prod()
    assert around.fraction.sum() * around.pitch.prod() == pytest.approx(lit, rel=0.01)


@pytest.mark.nightly_part
def test_map_recalls_planes_and_albedo_after_rotation() -> None:
    known = ReflectorMap()
    # Back and forth, so that the newest view is the one in the middle.
    for angle in (-0.5, 0.5, 0.0):
        T = turned(angle)
        surfaces = surfaces_of(seen_from(T, LEFT, RIGHT, FLOOR))
        known.add(surfaces, everywhere(surfaces), T)
    around = OffscreenCells.of(CAMERA.rays(), 1.3)
    assert not around.albedo.any()
    around.add_reflectors(known, np.eye(4))
    found = around.albedo > 0
    sides = np.abs(around.rays[:, 0]) > 0.6
    assert found[sides & (np.abs(around.rays[:, 1]) < 0.3)].all()
    off = np.abs(around.albedo[found] / (ALBEDO * GAIN) - 1)
    # Next to an edge a node may be assigned to the other plane.
    assert np.percentile(off, 95) < 0.01
    near = found & (np.abs(around.rays[:, 1]) < 0.2)
    normals = -around.planes / np.linalg.norm(around.planes, axis=1, keepdims=True).clip(1e-9)
    for side, (normal, d) in ((-1, LEFT), (1, RIGHT)):
        pick = near & (np.sign(around.rays[:, 0]) == side)
        assert pick.sum() > 3
        np.testing.assert_allclose(normals[pick], np.tile(normal, (pick.sum(), 1)), atol=0.01)
        np.testing.assert_allclose(
            around.planes[pick], np.tile(np.array(normal) / d, (pick.sum(), 1)), atol=0.01
        )


def test_mapped_wall_improves_compensation() -> None:
    whole = Seen(LEFT, RIGHT, FLOOR)
    known = ReflectorMap()
    surfaces = surfaces_of(whole)
    known.add(surfaces, everywhere(surfaces), np.eye(4))
    # The image ends before the corner; the light of the cropped part remains.
    part = np.s_[:, :26]
    image = whole.image
    cut = ToFImage(
        np.ascontiguousarray(image.z[part]),
        np.ascontiguousarray(image.rays[part]),
        np.ascontiguousarray(image.amplitude[part]),
        PERIOD_M,
    )
    reflections = MultipathModel(columns=26, lamp=1.0)
    errors = []
    for T in (None, np.eye(4)):
        found = reflections.solve(cut, GAIN, known, T)
        assert found is not None
        errors.append(np.abs((found.z - (whole.range / whole.length)[part]) * whole.length[part]))
    assert np.median(errors[1]) < 0.5 * np.median(errors[0])
    assert np.median(errors[1]) < 0.2 * np.median(whole.bias[part])


def test_views_are_stored_by_motion_up_to_a_limit() -> None:
    known = ReflectorMap()
    surfaces = surfaces_of(Seen(LEFT, RIGHT, FLOOR))
    trusted = everywhere(surfaces)
    known.add(surfaces, trusted, np.eye(4))
    one = len(known.patches)
    assert known.patches.shape[1] == PATCH
    assert 100 < one < surfaces.has_plane.sum() / 3
    known.add(surfaces, trusted, turned(0.05))
    assert len(known.patches) == one
    known.add(surfaces, trusted, turned(0.15))
    assert len(known.patches) == 2 * one
    sizes = []
    for k in range(130):
        T = np.eye(4)
        T[0, 3] = k + 1
        known.add(surfaces, trusted, T)
        sizes.append(len(known.patches))
    assert sizes[-1] == sizes[-20] == max(sizes) < 110 * one
    # The oldest ones were removed.
    assert known.patches[:, 0].min() > 20


@pytest.mark.nightly_part
def test_correction_uses_map_only_with_poses() -> None:
    world = (LEFT, RIGHT, FLOOR)
    T = turned(0.45)
    first = replace(seen_from(T, *world).frame(), index=0)
    second = replace(Seen(*world).frame(), index=1)

    def corrected(placed: bool, T_expected: np.ndarray | None) -> np.ndarray:
        corrector = Multipath(gain=GAIN).start(MultipathModel(columns=30))
        corrector.apply(first, None)
        if placed:
            # The pose of another frame is ignored.
            corrector.add_pose(second, np.eye(4))
            corrector.add_pose(first, T)
        fixed = corrector.apply(second, T_expected)
        assert isinstance(fixed, RangeFrame)
        return fixed.depth

    guessed = corrected(False, np.eye(4))
    np.testing.assert_array_equal(corrected(True, None), guessed)
    assert np.abs(corrected(True, np.eye(4)) - guessed).max() > 2e-4
    # The filters removed the whole view.
    corrector = Multipath(gain=GAIN).start(MultipathModel(columns=30))
    corrector.apply(first, None)
    corrector.add_pose(first.keep(np.zeros(first.depth.shape, bool)), T)
    fixed = corrector.apply(second, np.eye(4))
    assert isinstance(fixed, RangeFrame)
    np.testing.assert_array_equal(fixed.depth, guessed)
