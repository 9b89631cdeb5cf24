"""What is known at a moment of a scan: surfaces, keyframes, and how certain their poses are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from tofuse.apps.certainty.surfaces import Seen, Surfaces, pair_information, scales
from tofuse.engine.arrays import Bool, Float32, Float64, Intp
from tofuse.engine.connections import parts_of
from tofuse.engine.frames import Frame, RangeFrame, evenly_spaced
from tofuse.engine.geometry import se3
from tofuse.engine.graph import PoseGraph, graph_covariances
from tofuse.engine.progress import OnlineMap
from tofuse.engine.quality import pose_accuracy
from tofuse.engine.refinement import joint_alignment, pairwise_measurements
from tofuse.engine.results import Reconstruction
from tofuse.engine.stored_views import PosedView, SampledView, pair_equations
from tofuse.engine.views import PreparedView

_KEYFRAMES = 40
# Number of pairs from which the scales of their information are estimated.
_PAIRS_SAMPLED = 10
# Pairs are selected and compared as by the refinement, at the present poses.
_ALIGNMENT = pair_equations.RefineOptions(rounds=(pair_equations.Round(2, 0.0, 0.0),), points=600)
_OVERLAP, _NEIGHBOURS = _ALIGNMENT.overlap, _ALIGNMENT.neighbours


@dataclass(frozen=True, eq=False)
class Known:
    """Keyframes of a scan, the latest frame last.

    Motions of keyframes are small ones in the world, about the mean of their positions.

    Attributes
    ----------
    surfaces, responses
        Known surfaces, and `Surfaces.responses`.
    poses, ages_s, frames
        (K, 4, 4), (K,) time since then, and (K,) frame indices.
    centre
        (3,) mean of the positions in the world; `poses` and `surfaces` are relative to it.
    seen
        What they see.
    covariance
        (6K, 6K) of their motions, with the predicted ones where none was measured.
    parts
        (K,) number of the part of each: no measurement bounds the motion between two parts.
    scales
        (2,) see `surfaces.scales`.
    partners
        (K,) number of views that each one is compared with: pairs of a view share its errors.
    views_each
        Number of views that each keyframe stands for.
    bound_m
        Present 95 % bound.
    other_squares
        The part of its square that is due to the calibration of the camera, which more views don't
        improve, relative to the rest.
    """

    surfaces: Surfaces
    responses: Float32
    poses: Float64
    ages_s: Float64
    frames: Intp
    centre: Float64
    seen: Seen
    covariance: Float64
    parts: Intp
    scales: Float64
    partners: Float64
    views_each: float
    bound_m: float
    other_squares: float = 0.0

    @classmethod
    def of_map(cls, known: OnlineMap) -> Self | None:
        """Return what a mapper knows; None if that is too little."""
        graph = known.graph
        row = {int(index): k for k, index in enumerate(graph.ids)}
        steady = row.keys() - known.degenerate
        views = [v for v in known.views if v.index in steady]
        if len(views) < 2:
            return None
        chosen = evenly_spaced(views, _KEYFRAMES - 1)
        positions = np.array([row[v.index] for v in chosen], np.intp)
        centre = graph.poses[positions, :3, 3].mean(0)
        graph = graph.with_poses(_about(centre, graph.poses))
        surfaces = Surfaces.of_views(chosen, graph.poses[positions])
        sampled = _measured_pairs(chosen, graph.poses[positions])
        each = len(views) / len(chosen)
        is_open = np.isin(graph.ids, [*known.degenerate])
        ends = is_open[graph.edges]
        bounded = ~np.where(graph.loop, ends.any(1), ends[:, 1])
        parts = parts_of(len(graph.ids), graph.edges[bounded])
        found = cls._of_graph(
            graph, positions, known.timestamps, surfaces, centre, each, sampled, parts
        )
        return None if found is None else found._with_pairs()

    @classmethod
    def of_result(cls, result: Reconstruction, frame: Frame | None) -> Self | None:
        """Return what a result knows, with the field of view of a frame, if there is one."""
        rays = frame.camera.rays() if isinstance(frame, RangeFrame) else None
        field = (
            None if rays is None else np.array([np.nanmin(rays, (0, 1)), np.nanmax(rays, (0, 1))])
        )
        graph, mesh, cloud = result.graph, result.mesh, result.cloud
        points, normals = cloud.points, cloud.normals
        if mesh is not None and len(mesh.vertices):
            points, normals = mesh.vertices, mesh.normals
        degree = np.bincount(graph.edges.ravel(), minlength=len(graph.ids))
        core = np.flatnonzero(degree > 1)
        if len(core) < 2 or normals is None or not len(normals):
            return None
        positions = evenly_spaced(core, _KEYFRAMES - 1)
        centre = graph.poses[positions, :3, 3].mean(0)
        graph = graph.with_poses(_about(centre, graph.poses))
        surfaces = Surfaces.of_points(
            np.asarray(points - centre, np.float32), normals, graph.poses[positions], field
        )
        time = {r.index: r.timestamp for r in result.diagnostics.frames}
        unobservable = {r.index: r.unobservable for r in result.diagnostics.frames}
        times = np.array([time[i] for i in graph.ids.tolist()])
        each = len(core) / len(positions)
        among = np.flatnonzero((degree[graph.edges] > 1).all(1))
        edges = evenly_spaced(among, _PAIRS_SAMPLED)
        i, j = graph.edges[edges].T
        sampled = _Pairs(
            graph.poses[i],
            graph.poses[j],
            graph.information[edges] * (0.5 * (degree[i] + degree[j]))[:, None, None],
        )
        # Unbounded frames share their error up to the next one with a degenerate direction.
        is_open = np.array([len(unobservable[i]) > 0 for i in graph.ids.tolist()])
        unbounded = np.isin(graph.ids, result.diagnostics.accuracy.unbounded)
        parts = np.where(unbounded, 1 + np.cumsum(is_open), 0)
        found = cls._of_graph(graph, positions, times, surfaces, centre, each, sampled, parts)
        if found is None:
            return None
        found = replace(
            found, partners=np.maximum(degree[np.searchsorted(graph.ids, found.frames)], 1.0)
        )
        causes = result.diagnostics.accuracy.causes_m
        calibration = causes.get("calibration", 0.0) ** 2
        others = sum(c**2 for c in causes.values()) - calibration
        return replace(
            found,
            bound_m=result.diagnostics.accuracy.position_m,
            other_squares=calibration / others if others > 0 else 0.0,
        )

    @classmethod
    def _of_graph(
        cls,
        graph: PoseGraph,
        positions: Intp,
        times: Float64,
        surfaces: Surfaces,
        centre: Float64,
        each: float,
        sampled: _Pairs,
        parts: Intp,
    ) -> Self | None:
        positions = np.union1d(positions, [len(graph.ids) - 1])
        C = graph_covariances.GraphCovariances(graph).joint(positions)
        if C is None:
            return None
        poses, k = graph.poses[positions], len(positions)
        A = se3.adjoint(poses)
        blocks = A[:, None] @ C.reshape(k, 6, k, 6).swapaxes(1, 2) @ np.swapaxes(A, 1, 2)[None]
        responses = surfaces.responses()
        known = cls(
            surfaces,
            responses,
            poses,
            times[-1] - times[positions],
            graph.ids[positions],
            centre,
            surfaces.seen_from(poses),
            blocks.swapaxes(1, 2).reshape(6 * k, 6 * k),
            parts[positions],
            sampled.scales(surfaces, responses),
            np.ones(k),
            each,
            0.0,
        )
        return replace(known, bound_m=known.bound(known.covariance))

    @property
    def gaps(self) -> Intp:
        """Positions of keyframes, the motion from which to the next one is not bounded."""
        return np.flatnonzero(np.diff(self.parts))

    def _with_pairs(self) -> Self:
        """Return it with all pairs of keyframes that overlap, as the refinement will compare."""
        overlapping = self._overlapping(self.seen, self.poses, self.seen, self.poses)
        pairs = np.argwhere(np.triu(overlapping, 1))
        pairs = joint_alignment.spread_evenly(pairs, _NEIGHBOURS)
        if not len(pairs):
            return self
        partners = np.maximum(np.bincount(pairs.ravel(), minlength=len(self.poses)), 1.0)
        i, j = pairs.T
        H = self._information(self.seen.of(i), self.seen.of(j))
        H *= (self.views_each / (0.5 * (partners[i] + partners[j])))[:, None, None]
        L = _laplacian(len(self.poses), pairs, H)
        C = np.linalg.solve(np.eye(len(L)) + self.covariance @ L, self.covariance)
        known = replace(self, covariance=0.5 * (C + C.T), partners=partners)
        return replace(known, bound_m=known.bound(known.covariance))

    @property
    def _jacobians(self) -> Float64:
        """(K, 3, 6) position of each keyframe by its motion."""
        one = np.broadcast_to(np.eye(3), (len(self.poses), 3, 3))
        return np.concatenate([one, -se3.hat(self.poses[:, :3, 3])], 2)

    @property
    def _to_positions(self) -> Float64:
        """(3K, 6K) positions by motions, less a rigid motion of all."""
        J, k = self._jacobians, len(self.poses)
        motion = J.reshape(3 * k, 6)
        blocks = np.zeros((k, 3, k, 6))
        blocks[np.arange(k), :, np.arange(k)] = J
        spread = blocks.reshape(3 * k, 6 * k)
        return spread - motion @ (np.linalg.pinv(motion, rcond=1e-9) @ spread)

    @property
    def mean_square(self) -> float:
        """Mean square of the errors of position, by the covariance alone."""
        P = self._to_positions
        return float(((P @ self.covariance) * P).sum()) / len(self.poses)

    @property
    def position_variances(self) -> Float64:
        """(K,) mean squares of the errors of each position, relative to the graph's first pose."""
        k, J = len(self.poses), self._jacobians
        C = self.covariance.reshape(k, 6, k, 6)[np.arange(k), :, np.arange(k), :]
        return np.asarray(np.einsum("kij,kjl,kil->k", J, C, J), np.float64)

    @property
    def step_squares(self) -> Float64:
        """(K - 1,) mean squares of the errors of position from each keyframe to the next."""
        k = len(self.poses)
        D = np.kron(np.diff(np.eye(k), axis=0), np.eye(6))
        blocks = (D @ self.covariance @ D.T).reshape(k - 1, 6, k - 1, 6)
        C = blocks[np.arange(k - 1), :, np.arange(k - 1), :]
        J = self._jacobians[1:]
        return np.asarray(np.einsum("kij,kjl,kil->k", J, C, J), np.float64)

    def bound(self, covariance: Float64) -> float:
        """Return the 95 % bound on the rms error of the positions, by a covariance alone.

        None of them has one if some motion has none.
        """
        if len(self.gaps):
            return np.inf
        P = self._to_positions
        return pose_accuracy.bound_by_covariance(P @ covariance @ P.T)

    def factors(
        self, poses: Float64, ways: Sequence[Sequence[int]], views: Sequence[float]
    ) -> Float64:
        """(W,) factors by which uncertainty falls by scanning along each of some ways.

        Parameters
        ----------
        poses
            (M, 4, 4) relative to the centre.
        ways
            Positions in `poses` of each way, in its order.
        views
            Numbers of views from the target, the last pose of a way, and from each one before.
        """
        P, C = self._to_positions, self.covariance
        seen = self.surfaces.seen_from(poses)
        together = np.zeros((len(poses), len(poses)), np.bool_)
        for way in ways:
            together[np.ix_(way, way)] = True
        links = np.argwhere(np.triu(self._overlapping(seen, poses, seen, poses) & together, 1))
        H_links = self._information(seen.of(links[:, 0]), seen.of(links[:, 1]))
        pairs = np.argwhere(self._overlapping(self.seen, self.poses, seen, poses))
        pairs = joint_alignment.spread_evenly(pairs, _NEIGHBOURS)
        H_pairs = self._information(self.seen.of(pairs[:, 0]), seen.of(pairs[:, 1]))
        PC = P @ C
        before = float((PC * P).sum())
        squares = np.full(len(ways), before)
        for k, way in enumerate(ways):
            to_known, among = np.isin(pairs[:, 1], way), np.isin(links, way).all(1)
            rows = np.unique(pairs[to_known, 0])
            if len(rows) < 2:
                continue
            number = np.zeros(len(poses), np.intp)
            number[list(way)] = len(rows) + np.arange(len(way))
            known = np.searchsorted(rows, pairs[to_known, 0])
            edges = np.concatenate(
                [np.stack([known, number[pairs[to_known, 1]]], 1), number[links[among]]]
            )
            count = len(rows) + len(way)
            partners = np.bincount(edges.ravel(), minlength=count).astype(float)
            partners[: len(rows)] = self.partners[rows]
            n_views = np.append(np.full(count - 1, views[1]), views[0])
            n_views[: len(rows)] = np.inf
            weights = n_views[edges].min(1) / (0.5 * partners[edges].sum(1))
            H = np.concatenate([H_pairs[to_known], H_links[among]]) * weights[:, None, None]
            full, q = _laplacian(count, edges, H), 6 * len(rows)
            solved = np.linalg.pinv(full[q:, q:], rcond=1e-12, hermitian=True) @ full[q:, :q]
            L = full[:q, :q] - full[:q, q:] @ solved
            which = (6 * rows[:, None] + np.arange(6)).ravel()
            inner = L @ np.linalg.inv(np.eye(q) + C[np.ix_(which, which)] @ L)
            squares[k] = before - float(((PC[:, which] @ inner) * PC[:, which]).sum())
        ratio = np.maximum(squares, 0.0) / before if before > 0 else np.ones(len(squares))
        return np.sqrt((ratio + self.other_squares) / (1 + self.other_squares))

    def _overlapping(self, a: Seen, poses: Float64, b: Seen, others: Float64) -> Bool:
        """(M, N) whether views at poses are compared with those at others."""
        similar = poses[:, :3, 2] @ others[:, :3, 2].T > 0
        return np.asarray((a.overlap(b) >= _OVERLAP) & similar, np.bool_)

    def _information(self, a: Seen, b: Seen) -> Float64:
        """(M, 6, 6) information of pairs of views."""
        return np.einsum("k,mkab->mab", self.scales, pair_information(a, b, self.responses))


def _laplacian(count: int, pairs: Intp, H: Float64) -> Float64:
    """Information (6n, 6n) of the motions of n views by pairs (M, 2) with information (M, 6, 6)."""
    L = np.zeros((count, count, 6, 6))
    i, j = pairs.T
    for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
        np.add.at(L, (a, b), sign * H)
    return L.swapaxes(1, 2).reshape(6 * count, 6 * count)


def _about(centre: Float64, poses: Float64) -> Float64:
    out = poses.copy()
    out[:, :3, 3] -= centre
    return out


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Some pairs: poses (M, 4, 4), and information (M, 6, 6) that is not shared with others."""

    first: Float64
    second: Float64
    information: Float64

    def scales(self, surfaces: Surfaces, responses: Float32) -> Float64:
        """Return the scales of the information of pairs, see `surfaces.scales`."""
        if not len(self.information):
            return np.zeros(2)
        first, second = surfaces.seen_from(self.first), surfaces.seen_from(self.second)
        A = se3.adjoint(se3.inverse(self.second))
        measured = np.swapaxes(A, 1, 2) @ self.information @ A
        return scales(measured, pair_information(first, second, responses))


def _measured_pairs(views: Sequence[PosedView[PreparedView]], poses: Float64) -> _Pairs:
    """Measure some pairs of successive views at poses (N, 4, 4) as the refinement does."""
    starts = evenly_spaced(np.arange(len(views) - 1), _PAIRS_SAMPLED)
    rows = np.union1d(starts, starts + 1)
    sampled = [
        SampledView.of(views[k].view.with_pixel_variance().without_caches(), _ALIGNMENT.points)
        for k in rows
    ]
    pairs = np.searchsorted(rows, np.stack([starts, starts + 1], 1))
    refined = joint_alignment.refine(sampled, poses[rows], _ALIGNMENT, pairs=pairs)
    edges = pairwise_measurements([*range(len(rows))], refined)
    partners = 0.5 * np.bincount(pairs.ravel())[pairs].sum(1)
    information = np.array([e.information for e in edges]) * partners[:, None, None]
    return _Pairs(poses[starts], poses[starts + 1], information)
