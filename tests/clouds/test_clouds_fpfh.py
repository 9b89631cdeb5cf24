"""Registration of clouds without a guess: histograms of normals, and their matches."""

from __future__ import annotations

import numpy as np
import pytest

import tofuse
from pose_errors import pose_error
from registration_scenes import rng, turn
from searched_pair import TRUE, clouds
from tofuse.engine.clouds.fpfh import fpfh, mutually_nearest
from tofuse.engine.geometry import se3
from tofuse.formats.geometry.ply import read_ply


def test_real_pair_of_lidar_scans_upside_down(shared_data):
    folder = shared_data / "lidar_pair_gt"
    source, target = (read_ply(folder / f"{name}.ply").points for name in ("source", "target"))
    T = np.loadtxt(folder / "T_target_source.txt")
    turned = turn([1.0, 0.4, 0.2], 160, centre=np.median(source, 0))
    moved = se3.transform(se3.inverse(turned), source)
    found = tofuse.register(moved, target)  # nothing to set up
    shift, angle = pose_error(found.T_target_source, T @ turned, moved)
    assert shift < 0.03
    assert angle < 0.5


@pytest.mark.nightly
def test_wrong_start_is_left_without_guess():
    source, target = clouds()
    turned = turn([0.2, 1, 0.3], 150, centre=np.median(source, 0) + 5)
    moved = se3.transform(se3.inverse(turned), source)
    found = tofuse.register(moved, target)
    assert pose_error(found.T_target_source, TRUE @ turned, moved)[0] < 0.01
    # A wrong guess is left as well; a start that leads to the pose is kept.
    far = tofuse.register(moved, target, guess=np.eye(4))
    assert pose_error(far.T_target_source, TRUE @ turned, moved)[0] < 0.01
    near = tofuse.register(source, target, guess=TRUE)
    assert pose_error(near.T_target_source, TRUE, source)[0] < 0.01
    again = tofuse.register(se3.transform(TRUE, source), target)
    assert pose_error(again.T_target_source, np.eye(4), source)[0] < 0.01


# The parts


def slow_fpfh(points, normals, reach, signed):
    n = len(points)
    distance = np.linalg.norm(points[:, None] - points, axis=2)
    own = np.zeros((n, 3, 11))
    for i in range(n):
        for j in range(n):
            if i == j or distance[i, j] > reach:
                continue
            d = (points[j] - points[i]) / distance[i, j]
            u = normals[i]
            v = np.cross(u, d)
            v /= np.linalg.norm(v)
            w = np.cross(u, v)
            values = [v @ normals[j], u @ d]
            if signed:
                values.append(np.arctan2(w @ normals[j], u @ normals[j]) / np.pi)
            else:
                values = [2 * abs(x) - 1 for x in values]
                angle = np.arctan2(abs(w @ normals[j]), abs(u @ normals[j]))
                values.append(2 * angle / (np.pi / 2) - 1)
            for k, value in enumerate(values):
                own[i, k, min(int((value + 1) / 2 * 11), 10)] += 1
        own[i] /= max(own[i, 0].sum(), 1)
    out = own.copy()
    for i in range(n):
        near = [j for j in range(n) if j != i and distance[i, j] <= reach]
        if near:
            weight = np.array([1 / distance[i, j] for j in near])
            out[i] += np.einsum("k,kab->ab", weight / weight.sum(), own[near])
    return out.reshape(n, 33)


def surface(n=40, seed=0):
    r = rng(seed)
    points = r.uniform(-1, 1, (n, 3))
    normals = r.normal(size=(n, 3))
    return points, normals / np.linalg.norm(normals, axis=1)[:, None]


@pytest.mark.parametrize("signed", [True, False])
def test_histograms_match_reference(signed):
    points, normals = surface()
    np.testing.assert_allclose(
        fpfh(points, normals, 0.9, signed), slow_fpfh(points, normals, 0.9, signed), atol=1e-12
    )


def test_rows_are_matched_mutually():
    a, b = rng(0).normal(size=(300, 5)), rng(1).normal(size=(280, 5))
    i, j = mutually_nearest(a, b)
    apart = ((a[:, None] - b) ** 2).sum(2)
    expected = [
        (k, int(apart[k].argmin())) for k in range(300) if apart[:, apart[k].argmin()].argmin() == k
    ]
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == expected


def test_several_nearest_rows_are_matched_mutually():
    a, b = rng(0).normal(size=(90, 5)), rng(1).normal(size=(80, 5))
    apart = ((a[:, None] - b) ** 2).sum(2)
    near_a = apart <= np.sort(apart, axis=1)[:, 1:2]
    near_b = apart <= np.sort(apart, axis=0)[1:2]
    i, j = mutually_nearest(a, b, 2)
    assert set(zip(i.tolist(), j.tolist(), strict=True)) == set(
        zip(*(k.tolist() for k in np.nonzero(near_a & near_b)), strict=True)
    )


def test_histograms_of_surroundings_are_those_of_all_points():
    points, normals = surface()
    np.testing.assert_allclose(
        fpfh(points, normals, 0.9, True, (points, normals)),
        fpfh(points, normals, 0.9, True),
        atol=1e-12,
    )
