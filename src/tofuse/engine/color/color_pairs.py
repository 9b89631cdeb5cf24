"""Motions between views by their colour images, from patches of one that the other shows.

`with_color` adds them to a pose graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.special import bdtrc

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.color.color_views import SEARCHES, ColorView, Search, matched
from tofuse.engine.compute import run_all
from tofuse.engine.frames import evenly_spaced
from tofuse.engine.geometry import homogeneous, se3
from tofuse.engine.graph import Measured, Optimiser, PoseGraph, graph_covariances

# Earlier partners of a view, evenly spread over those that show this fraction of its patches.
_PARTNERS, _OVERLAP = 5, 0.3
# Patches are found if they correlate better than this fraction of those that were looked for in a
# wrong place; a pair is measured if with at most this probability so many are found by chance.
_BETTER, _BY_CHANCE = 0.95, 1e-6
# Medians of chi-squared variables with two and six degrees of freedom, and the quantile of the
# first beyond which matches are false.
_MEDIAN_2, _MEDIAN_6, _LIMIT = 1.386, 5.348, 18.0
_ITERATIONS, _CONVERGED = 30, 1e-2  # in `UNITS`
# Standard deviation of the times of a rolling shutter's rows, which usually takes up to 20 ms; the
# times of colour and depth differ by no more.
_SHUTTER_S = 0.006
# Relative error of the depth that all patches share, as makers specify, and so of translations.
_DEPTH_SCALE = 0.01
_MIN_PIXELS = 0.05  # standard deviation of matches: no interpolation is better


@dataclass(frozen=True, eq=False)
class _Matches:
    """Patches of a source found in a target, at pixels (N, 2), with scores and those by chance."""

    found: Float64
    score: Float64
    chance: Float64


def measured_pairs(
    views: Sequence[ColorView], poses: Float64, search: Search
) -> tuple[Measured, ...]:
    """Measure the motions between views that show the same patches.

    The errors of a pair are those of its reprojections, estimated from them and from the triangles
    of pairs, that of the scale of the depth, and the motion of its cameras while their shutters
    roll. As all pairs of a view share
    its errors, the information is divided by their number.

    Parameters
    ----------
    views
        N views in the order of time.
    poses
        (N, 4, 4) T_world_camera, by which patches are predicted.
    search
        How patches are found.

    Returns
    -------
    One measurement of each pair, from the later to the earlier frame.
    """
    pairs = _overlapping(views, poses)
    if not len(pairs):
        return ()
    start = se3.inverse(poses[pairs[:, 0]]) @ poses[pairs[:, 1]]
    views = [view.thinned(search.every) for view in views]
    ends = [(views[i], views[j]) for i, j in pairs]
    matches = run_all(
        [partial(_match, *end, T, search) for end, T in zip(ends, start, strict=True)]
    )
    fits = run_all(
        [
            partial(_fit, *end, T, both, used)
            for end, T, both, used in zip(ends, start, matches, _accepted(matches), strict=True)
        ]
    )
    pairs = pairs[[fit is not None for fit in fits]]
    if not len(pairs):
        return ()
    T, information = (np.stack(column) for column in zip(*filter(None, fits), strict=True))
    C = np.linalg.inv(information + np.diag(projective.WEAK / projective.UNITS**2))
    variance = (_SHUTTER_S * np.array([view.speed for view in views])) ** 2
    C *= _disagreement(pairs, T, C)
    shared = (np.swapaxes(T[:, :3, :3], 1, 2) @ T[:, :3, 3:])[..., 0] * _DEPTH_SCALE
    C[:, :3, :3] += shared[:, :, None] * shared[:, None]
    partners = np.bincount(pairs.ravel(), minlength=len(views))
    C *= 0.5 * partners[pairs].sum(1)[:, None, None]
    C += np.repeat(variance[pairs].sum(1), 3, 1)[:, :, None] * np.eye(6)
    information = np.linalg.inv(C)
    return tuple(
        Measured(views[j].index, views[i].index, T_j_i, H)
        for (i, j), T_j_i, H in zip(pairs, *_reversed(T, information), strict=True)
    )


def _overlapping(views: Sequence[ColorView], poses: Float64) -> Intp:
    """(M, 2) pairs i < j of views that show patches of each other, a few earlier i for each j."""
    shown = np.zeros((len(views), len(views)))
    world = [se3.transform(T, view.points[::4]) for T, view in zip(poses, views, strict=True)]
    ends = np.cumsum([0] + [len(p) for p in world])
    points = np.concatenate([np.zeros((0, 3)), *world])
    for k, view in enumerate(views):
        inside = view.shows(view.project(se3.transform(se3.inverse(poses[k]), points)))
        shown[k] = [inside[a:b].sum() / max(b - a, 1) for a, b in pairwise(ends)]
    overlap = np.minimum(shown, shown.T) >= _OVERLAP
    pairs = [
        (int(i), j)
        for j in range(len(views))
        for i in evenly_spaced(np.flatnonzero(overlap[:j, j]), _PARTNERS)
    ]
    return np.array(pairs, np.intp).reshape(-1, 2)


def _match(i: ColorView, j: ColorView, T_i_j: Float64, search: Search) -> tuple[_Matches, _Matches]:
    """Find the patches of j in i, and those of i in j."""
    return (
        _Matches(*matched(j, i, T_i_j, search)),
        _Matches(*matched(i, j, se3.inverse(T_i_j), search)),
    )


def _accepted(matches: Sequence[tuple[_Matches, _Matches]]) -> list[tuple[Bool, Bool] | None]:
    """Return which patches of each pair are found; None where chance explains their number."""
    chance = np.concatenate([m.chance[m.chance > -1] for both in matches for m in both])
    limit = float(np.quantile(chance, _BETTER)) if len(chance) else 1.0
    out: list[tuple[Bool, Bool] | None] = []
    for both in matches:
        first, second = (np.asarray(m.score > limit, np.bool_) for m in both)
        tried = sum(int((m.score > -1).sum()) for m in both)
        found = int(first.sum() + second.sum())
        by_chance = float(bdtrc(max(found - 1, 0), max(tried, 1), 1 - _BETTER))
        out.append((first, second) if by_chance < _BY_CHANCE else None)
    return out


def _fit(
    i: ColorView,
    j: ColorView,
    T_i_j: Float64,
    both: tuple[_Matches, _Matches],
    used: tuple[Bool, Bool] | None,
) -> tuple[Float64, Float64] | None:
    """Return T_i_j and the information of its right perturbation; None if it is not measured.

    Iterated least squares of the reprojections in both directions, with Tukey's weights. The error
    of a match is that of its position, estimated from all, and that of the depth of its patch.
    """
    if used is None:
        return None
    forward = _Reprojection.of(j, i, both[0].found, used[0])
    backward = _Reprojection.of(i, j, both[1].found, used[1])
    sigma = np.inf
    for _ in range(_ITERATIONS):
        r, J, d = forward.residuals(T_i_j)
        r_back, J_back, d_back = backward.residuals(se3.inverse(T_i_j))
        r, d = np.concatenate([r, r_back]), np.concatenate([d, d_back])
        # A perturbation of T_i_j is the opposite one of T_j_i, in the other frame.
        J = np.concatenate([J, -J_back @ se3.adjoint(T_i_j)])
        if np.isinf(sigma):
            sigma = float(np.sqrt(np.median((r**2).sum(1)) / _MEDIAN_2))
        dd = (d**2).sum(1)
        for _ in range(2):  # the scale depends on itself, as the error of the depth does not
            along = (r * d).sum(1) ** 2 / (sigma**2 + dd)
            squared = ((r**2).sum(1) - along) / sigma**2
            sigma = max(sigma * float(np.sqrt(np.median(squared) / _MEDIAN_2)), _MIN_PIXELS)
        weight = np.maximum(1 - squared / _LIMIT, 0) ** 2 / sigma**2
        by_depth = weight / (sigma**2 + dd)
        Jd, rd = np.einsum("nik,ni->nk", J, d), (r * d).sum(1)
        H = np.einsum("nik,n,nil->kl", J, weight, J) - np.einsum("nk,n,nl->kl", Jd, by_depth, Jd)
        g = np.einsum("nik,n,ni->k", J, weight, r) - Jd.T @ (by_depth * rd)
        step, _ = projective.step_with_weak_prior(H, g)
        T_i_j = se3.orthonormalise(T_i_j @ se3.exp(step))
        if np.abs(step / projective.UNITS).max() < _CONVERGED:
            return T_i_j, H
    return None


@dataclass(frozen=True, eq=False)
class _Reprojection:
    """Matched points of a source, at z = 1, with inverse depths, and where a target shows them."""

    points: Float64
    inverse_depth: Float64
    sigma: Float64
    seen: Float64
    focal: float

    @classmethod
    def of(cls, source: ColorView, target: ColorView, found: Float64, used: Bool) -> _Reprojection:
        return cls(
            homogeneous(source.rays[used]),
            source.inverse_depth[used],
            source.sigma[used],
            target.rays_at(found[used]),
            target.focal,
        )

    def residuals(self, T_target_source: Float64) -> tuple[Float64, Float64, Float64]:
        """Return residuals (N, 2), Jacobians (N, 2, 6) and the errors by depth (N, 2), in pixels.

        The Jacobians are by a right perturbation, the errors those of one sigma of the depth.
        """
        points = self.points / self.inverse_depth[:, None]
        q = se3.transform(T_target_source, points)
        z = np.maximum(q[:, 2:], 1e-3)
        project = np.zeros((len(q), 2, 3))
        project[:, [0, 1], [0, 1]] = self.focal / z
        project[:, :, 2] = -self.focal * q[:, :2] / z**2
        by_point = project @ T_target_source[:3, :3]
        J = np.concatenate([by_point, -by_point @ se3.hat(points)], 2)
        relative = (self.sigma / self.inverse_depth)[:, None]
        d = (by_point @ (-points * relative)[..., None])[..., 0]
        return self.focal * (q[:, :2] / z - self.seen), J, d


def _reversed(T_i_j: Float64, information: Float64) -> tuple[Float64, Float64]:
    """Return T_j_i, and the information of its right perturbation."""
    A = se3.adjoint(se3.inverse(T_i_j))
    return se3.inverse(T_i_j), np.swapaxes(A, 1, 2) @ information @ A


def _disagreement(pairs: Intp, T: Float64, C: Float64) -> float:
    """Return the factor of the variances, 1 or more, by which triangles of pairs close."""
    row = {(int(i), int(j)): k for k, (i, j) in enumerate(pairs)}
    found = []
    for (i, j), ij in row.items():
        for k in range(j + 1, int(pairs.max()) + 1):
            jk, ik = row.get((j, k)), row.get((i, k))
            if jk is None or ik is None:
                continue
            A = se3.adjoint(se3.inverse(T[jk]))
            error = se3.log(se3.inverse(T[ik]) @ T[ij] @ T[jk])
            total = A @ C[ij] @ A.T + C[jk] + C[ik]
            found.append(float(error @ np.linalg.solve(total, error)))
    return max(1.0, float(np.median(found)) / _MEDIAN_6) if found else 1.0


def with_color(
    graph: PoseGraph, views: Sequence[ColorView], optimiser: Optimiser
) -> tuple[PoseGraph, tuple[Measured, ...]]:
    """Return the optimised graph with the motions between views, and these edges.

    Each search predicts by the poses of the one before. Motions that contradict the others are
    rejected, as repeated patterns may be mistaken.

    Parameters
    ----------
    graph
        Poses and edges by depth. The views are of some of its frames.
    views
        In the order of time.
    optimiser
        Solves the graph.
    """
    row = {int(index): k for k, index in enumerate(graph.ids)}
    rows = [row[view.index] for view in views]
    poses = graph.poses
    accepted: tuple[Measured, ...] = ()
    for search in SEARCHES:
        measured = measured_pairs(views, poses[rows], search)
        if not measured:
            return graph, ()
        extended = graph.with_poses(poses).with_edges(measured)
        suspected = np.arange(len(extended.edges)) >= len(graph.edges)
        done = optimiser.optimise(replace(extended, loop=suspected))
        weights = np.ones(len(suspected)) if done.weights is None else done.weights
        kept = np.flatnonzero(weights[len(graph.edges) :] >= graph_covariances.MIN_WEIGHT)
        poses, accepted = done.graph.poses, tuple(measured[k] for k in kept.tolist())
    return graph.with_poses(poses).with_edges(accepted), accepted
