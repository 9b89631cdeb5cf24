"""Distinct surfaces: in ranks of proposals, and of rivals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.engine.clouds import cloud_pair, distinct_surfaces, fpfh
from tofuse.engine.clouds.cloud_agreement import CloudAgreement

X, Z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def plane(count: int, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points on a plane of 2 m through the origin, and their normals of either sign."""
    rng = np.random.default_rng(count)
    points = rng.uniform(-1, 1, (count, 3)) * (normal == 0)
    return points, np.where(rng.random((count, 1)) < 0.5, 1, -1) * normal


def test_all_points_on_one_plane_are_one_surface():
    walls = [plane(600, Z), plane(20, X)]
    points, normals = (np.concatenate(parts) for parts in zip(*walls, strict=True))
    shares = distinct_surfaces.shares(points, normals, 0.01)
    assert shares[:600].sum() == pytest.approx(1)
    assert shares[600:].sum() == pytest.approx(1)


def test_a_fit_of_many_surfaces_is_told_from_that_of_one():
    """As many points fit, but at one pose they are all on one wall."""
    wall, _ = plane(100, Z)
    turns = np.random.default_rng(0).normal(size=(100, 3))
    points = np.concatenate([wall, wall + 5.0 * Z])
    normals = np.concatenate([np.tile(Z, (100, 1)), turns / np.linalg.norm(turns, axis=1)[:, None]])
    histograms = np.zeros((200, 1))
    view = fpfh.DescribedCloud(points, normals, histograms)
    halves = [
        fpfh.DescribedCloud(points[rows], normals[rows], histograms[rows])
        for rows in (slice(100), slice(100, 200))
    ]
    (on_wall, _, one), (elsewhere, _, many) = (
        fpfh._fit(view, half, np.eye(4)[None], 0.05)[:, 0] for half in halves
    )
    assert on_wall == pytest.approx(elsewhere)
    assert many > 10 * one


@pytest.mark.parametrize(("coinciding", "counted"), [(6.0, 0.0), (12.0, 12.0)])
def test_free_space_discounts_rivals_of_which_less_coincides(coinciding, counted):
    pose = CloudAgreement(0.3, 0.3, 0.0, 0.0, 0.01, 100, 0.3, surfaces=10.0, near_surfaces=20.0)
    rival = replace(pose, surfaces=coinciding, violation=0.05, score=0.3 - 1.0)
    assert cloud_pair._surfaces_of(rival, pose) == pytest.approx(counted)
    # What free space contradicts by more than counts is none, however much coincides.
    assert cloud_pair._surfaces_of(replace(rival, violation=0.06), pose) == 0
