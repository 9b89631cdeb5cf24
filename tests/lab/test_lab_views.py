"""Methods for many views that no configuration uses: claims of their papers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from registration_scenes import MIDDLE, directions, rng, turn, view
from tofuse.engine import parts
from tofuse.engine.geometry import se3
from tofuse.engine.graph import build_graph, external_sensors
from tofuse.engine.icp.icp_kernels import transform_points
from tofuse.engine.stored_views.view_store import Spacing, ViewStore
from tofuse.engine.views.prepared_view import PreparedView
from tofuse.lab.methods.bergevin import Bergevin
from tofuse.lab.methods.multiview import Cloud, Pairs, relax_poses
from tofuse.lab.methods.pulli import Pulli, distribute_errors
from tofuse.lab.methods.simultaneous import SmallAngles, WilliamsBennamoun, solve_correspondences

METHODS = [Bergevin(), Pulli(), WilliamsBennamoun(), SmallAngles()]
VIEWS = 8


def rock(n, seed):
    """A body with a radius of half a metre without rotational symmetry."""
    d = directions(n, seed)
    radius = 0.5 + 0.05 * np.sin(9 * d[:, 0] + 1) * np.cos(8 * d[:, 1]) * np.sin(7 * d[:, 2] + 2)
    radius += 0.04 * np.sin(6 * d[:, 1] + 3 * d[:, 2]) + 0.06 * d[:, 0] * d[:, 2]
    return d * radius[:, None] + MIDDLE


@cache
def ring(noise=0.002):
    """A rock seen from all round, in views of 140 degrees each; true poses, clouds."""
    T, clouds = [], []
    for k in range(VIEWS):
        pose = turn([0, 1, 0], 360 * k / VIEWS)
        p = rock(5000, k)
        seen = transform_points(se3.inverse(pose), p)
        p = p[seen[:, 2] < 1.85] + rng(k, 9).normal(0, noise, (int((seen[:, 2] < 1.85).sum()), 3))
        T.append(pose)
        clouds.append(view(p, pose, index=k))
    return np.array(T), clouds


def drifted(T, degrees=1.0, shift=0.004):
    """Poses with drift along the chain."""
    out = [T[0]]
    for k in range(1, len(T)):
        slip = turn([0, 1, 0], degrees)
        slip[:3, 3] += shift * np.array([1.0, 0.5, -0.5])
        out.append(out[-1] @ se3.inverse(T[k - 1]) @ T[k] @ slip)
    return np.array(out)


def errors_of(poses, T):
    """Errors of the poses relative to the first, at the centre of the rock (m)."""
    middle = MIDDLE[None]
    gap = se3.inverse(T[0]) @ T
    here = se3.inverse(poses[0]) @ poses
    return np.array(
        [
            np.linalg.norm(transform_points(a, transform_points(se3.inverse(b), middle)) - middle)
            + np.linalg.norm(se3.so3_log(a[:3, :3] @ b[:3, :3].T)) * 0.5
            for a, b in zip(here, gap, strict=True)
        ]
    )


def motions(n, seed):
    """Poses of n views, the first at the origin, and exact correspondences of all with all."""
    poses = np.array([np.eye(4)] + [se3.exp(rng(seed, k).normal(0, 0.5, 6)) for k in range(1, n)])
    pairs = []
    for i in range(n):
        for j in range(i + 1, n):
            x = rng(seed, i, j).normal(size=(30, 3))
            p, q = (transform_points(se3.inverse(poses[k]), x) for k in (i, j))
            pairs.append(Pairs(i, j, p, q, np.full((30, 3), np.nan)))
    return poses, pairs


@pytest.mark.nightly
@pytest.mark.parametrize("method", METHODS, ids=parts.name_of)
def test_refinement_corrects_drift(method):
    T, clouds = ring()
    start = drifted(T)
    refiner = replace(method, points=2000).start(ViewStore[PreparedView](Spacing()))
    for cloud, pose in zip(clouds, start, strict=True):
        refiner.push(cloud, pose)
    graph = build_graph([c.index for c in clouds], start, [], [])
    found = refiner.finish(graph, external_sensors.SensorPriors())
    assert found.kept
    assert found.views == VIEWS
    assert found.support[1] > found.support[0]
    np.testing.assert_allclose(found.poses[0], T[0], atol=1e-9)
    assert errors_of(found.poses, T).max() < 0.25 * errors_of(start, T).max()


@pytest.mark.parametrize("first", [0, 1])
def test_pulli_aligns_a_view_that_sees_a_small_part_of_another(first):
    """Most points of the larger one have no partner: only the other way counts as a pair."""
    whole, part = rock(6000, 0), rock(6000, 1)
    part = part[np.linalg.norm(part - MIDDLE + [0, 0, 0.5], axis=1) < 0.22]
    T = np.array([np.eye(4), turn([0, 1, 0], 20)])
    clouds = [Cloud.of(view(p, pose)) for p, pose in zip((whole, part), T, strict=True)]
    order = [first, 1 - first]
    start = drifted(T[order])
    found = relax_poses(Pulli(), [clouds[k] for k in order], start)
    assert errors_of(start, T[order])[1] > 0.01
    assert errors_of(found, T[order])[1] < 0.003


def test_pulli_distributes_misfit_evenly_over_ring():
    """Section 4: a ring of pairwise alignments, all exact except one, ends with equal gaps."""
    n = 6
    T = np.array([turn([0, 1, 0], 60 * k, centre=np.zeros(3)) for k in range(n)])
    pairs = []
    for i in range(n):
        j = (i + 1) % n
        relative = se3.inverse(T[j]) @ T[i]
        if i == n - 1:
            relative = turn([0, 1, 0], 6, centre=np.zeros(3)) @ relative
        # Correspondences all around, so that each pair constrains the rotation equally.
        p = rng(i).normal(size=(100, 3))
        pairs.append(Pairs(i, j, p, transform_points(relative, p), np.full((100, 3), np.nan)))
    chain = [np.eye(4)]
    for p in pairs[:-1]:
        A = np.linalg.lstsq(np.c_[p.p_j, np.ones(100)], np.c_[p.p_i, np.ones(100)], rcond=None)[0].T
        chain.append(chain[-1] @ se3.orthonormalise(A))
    poses = distribute_errors(np.array(chain), pairs, 1e-7)
    gaps = [
        np.rad2deg(
            np.median(
                np.linalg.norm(
                    transform_points(poses[p.i], p.p_i) - transform_points(poses[p.j], p.p_j),
                    axis=1,
                )
            )
        )
        for p in pairs
    ]
    assert max(gaps) < 1.5 * min(gaps)


def test_williams_bennamoun_decreases_monotonically_to_truth():
    poses, pairs = motions(6, 0)
    start = poses @ np.array([np.eye(4)] + [se3.exp(rng(9, k).normal(0, 0.3, 6)) for k in range(5)])
    found, history = solve_correspondences(start, pairs, 200)
    assert (np.diff(history) <= 1e-9 * abs(history[-1])).all()
    np.testing.assert_allclose(found, poses, atol=1e-5)
    for p in pairs:
        gaps = se3.transform(found[p.i], p.p_i) - se3.transform(found[p.j], p.p_j)
        assert np.abs(gaps).max() < 1e-4
