"""95 % bounds on the errors of the poses, from the recording itself.

The joint covariance of the poses covers noise and the errors that the patches of a view share.
Three terms are added. The motion of the trajectory in the refinement measures the correlated errors
of single registrations, and the remaining error is in proportion to it; if halves of the images
show more than the covariance and this together, that takes their place. If poses are wrong, views
far apart in time that see the same surface disagree by more than consecutive ones. And a loop that
another calibration would close, or views that agree better with it, show that this one bends the
path. The factor for errors that show in none of these is derived in `docs/uncertainty.md`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaincinv

from tofuse.arrays import Bool, Float64, Intp
from tofuse.geometry import se3
from tofuse.kernels.threads import run_chunks
from tofuse.posegraph.covariances import GraphCovariances
from tofuse.posegraph.graph import PoseGraph
from tofuse.posegraph.view_store import PosedView
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.projective import UNITS, ProjectiveOptions, Target, align, span

_LEVEL = 0.95
# Evenly spaced poses that the rms is computed from, and the least certain ones in addition.
_EVEN, _WORST = 50, 10
# Standard deviations of an unmeasured direction, practically unbounded: m and rad.
_OPEN = np.array([30.0] * 3 + [10.0] * 3)
# In a large model, errors of this fraction of its diagonal count as unbounded.
_UNMEASURED_FRACTION = 0.05
# Ratio of the total error to that in which views differ: errors of the sensor that all views of a
# place share are invisible.
UNOBSERVED_ERROR_FACTOR = 1.6
# Directions of two frames are distinct above this fraction of the strongest.
_DISTINCT = 0.1
_NONE = np.zeros((0, 6))
# Number of pairs over degenerate frames that are aligned again, the shortest first: at the end of a
# long one the camera came back, which a loop closure verifies.
_MAX_SPANNING = 2000
# Near the final pose. A direction with no smaller sigma than the prior is not measured.
_ALIGNMENT = ProjectiveOptions()
# Standard deviation, in `UNITS`, that an error along a degenerate direction causes in the others.
_LEAK = _DISTINCT * _ALIGNMENT.prior_m / UNITS[0]


@dataclass(frozen=True)
class WorstFrame:
    """The frame whose pose is least certain, and its 95 % bounds: m and rad, inf if unbounded."""

    frame: int
    position_m: float
    rotation_rad: float


@dataclass(frozen=True)
class Accuracy:
    """95 % bounds on the errors of the poses.

    Attributes
    ----------
    position_m, rotation_rad
        Of the rms error over the frames, after the best rigid alignment; inf if no measurement
        bounds some direction.
    relative
        `position_m` as a fraction of the model's diagonal.
    assessed
        False if nothing was registered, or if registrations don't state their errors; then the
        bounds are inf.
    worst
        The least certain frame; None if nothing was assessed.
    unbounded
        Indices of the frames whose pose is unbounded in some direction.
    by_odometry
        Indices of the frames whose pose would be unbounded without the recorded odometry.
    """

    position_m: float = np.inf
    rotation_rad: float = np.inf
    relative: float = np.inf
    assessed: bool = False
    worst: WorstFrame | None = None
    unbounded: tuple[int, ...] = ()
    by_odometry: tuple[int, ...] = ()


@dataclass(frozen=True)
class ObservedErrors:
    """Errors that the recording shows and the covariance does not include.

    Attributes
    ----------
    moved_m, moved_rad
        Rms by which the refinement moved the poses, after alignment.
    excess_m
        Rms by which views far apart in time disagree, beyond consecutive ones.
    calibration_m, calibration_rad
        Error of the poses due to the calibration of the camera, 95 %.
    split_m, split_rad
        Rms errors by halves of the images, see `split_half`: those of the covariance and those that
        `moved` stands for.
    """

    moved_m: float = 0.0
    moved_rad: float = 0.0
    excess_m: float = 0.0
    calibration_m: float = 0.0
    calibration_rad: float = 0.0
    split_m: float = 0.0
    split_rad: float = 0.0

    def beyond(self, stated: _Stated | None) -> Float64:
        """Return the combined errors (2,) in m and rad that are missing in the covariance.

        Parameters
        ----------
        stated
            Errors by the covariance; None if it bounds nothing.
        """
        correlated = np.array([self.moved_m, self.moved_rad])
        if stated is not None:
            # As likely to be exceeded as the bounds are.
            quantile = stated.bounds / np.maximum(stated.rms, 1e-12)
            split = np.array([self.split_m, self.split_rad]) * quantile
            missing = np.sqrt(np.maximum(split**2 - stated.bounds**2, 0.0))
            correlated = np.maximum(correlated, missing)
        excess = np.array([self.excess_m, 0.0])
        calibration = np.array([self.calibration_m, self.calibration_rad])
        return np.asarray(np.sqrt(correlated**2 + excess**2 + calibration**2))


@dataclass(frozen=True, eq=False)
class _Stated:
    """Errors by the covariance alone, in m and rad.

    Attributes
    ----------
    positions
        (m,) positions of the poses that were looked at.
    bounds, rms
        (2,) 95 % bounds on the rms errors of all poses, and expected rms.
    single
        (m, 2) 95 % bounds on the errors of these poses.
    """

    positions: Intp
    bounds: Float64
    rms: Float64
    single: Float64

    @classmethod
    def by(cls, covariances: GraphCovariances, more: Intp | None = None) -> _Stated | None:
        """Look at evenly spaced poses and `more`; None if the graph does not constrain all poses.

        The rms is that of the evenly spaced ones.
        """
        graph = covariances.graph
        n = len(graph.ids)
        even = np.unique(np.linspace(0, n - 1, min(n, _EVEN)).round().astype(int))
        positions = even if more is None else np.union1d(even, more)
        C = covariances.joint(positions) if n > 1 else None
        if C is None:
            return None
        chosen = np.isin(positions, even)
        found = [_bounds(part, chosen) for part in _aligned(C, graph.poses[positions], chosen)]
        bounds, rms, single = zip(*found, strict=True)
        return cls(positions, np.array(bounds), np.array(rms), np.stack(single, 1))


def degenerate_directions(
    graph: PoseGraph,
    unobservable: Mapping[int, Float64],
    own: Collection[tuple[int, int]],
    views: Mapping[int, PosedView[PreparedView]],
    stated: Collection[tuple[int, int]] = (),
) -> list[Float64]:
    """Return the degenerate directions of every edge: (k, 6), right perturbations of j.

    Those of the tracker's registrations are known. A pair of the refinement is aligned again if
    tracking was degenerate in one of its views or between them: after an unnoticed slide along a
    wall, later views overlap with earlier ones at wrong poses.

    Parameters
    ----------
    graph
        After refinement.
    unobservable
        (k, 6) degenerate directions of frames, by their index: right perturbations, m and rad.
    own
        Pairs (i, j) that are the registrations of j in tracking.
    views
        Prepared views by frame index.
    stated
        Pairs (i, j) that do not come from the overlap of the two views: never degenerate.
    """
    degenerate = np.array(sorted(unobservable), np.intp)
    out: list[Float64] = []
    compared: list[int] = []  # edges to align again
    spanning: list[tuple[int, int]] = []  # those over degenerate frames, and their length
    for (a, b), T_i_j in zip(graph.edges, graph.measurements, strict=True):
        i, j = int(graph.ids[a]), int(graph.ids[b])
        if (i, j) in stated:
            out.append(_NONE)
            continue
        # A perturbation of i is the opposite one of j, by the adjoint.
        there = unobservable.get(i, _NONE) @ se3.adjoint(se3.inverse(T_i_j)).T
        here = unobservable.get(j, _NONE)
        known = np.concatenate([there, here])
        if (i, j) in own:
            known = known if len(here) else _NONE
        elif i in views and j in views:
            if len(known):
                compared.append(len(out))
            elif np.diff(np.searchsorted(degenerate, sorted((i, j)))).any():
                spanning.append((abs(j - i), len(out)))
        out.append(known)
    compared += [k for _, k in sorted(spanning)[:_MAX_SPANNING]]

    def work(start: int, stop: int) -> None:
        for k in compared[start:stop]:
            i, j = (views[int(graph.ids[end])].view.without_caches() for end in graph.edges[k])
            target = [Target(i, np.eye(4))]
            found = align(j, target, graph.measurements[k], _ALIGNMENT).unobservable * UNITS
            # Directions are known to a few degrees only, and the remainder would look measured: a
            # degenerate pair is taken to be degenerate in all directions of its views.
            out[k] = np.concatenate([found, out[k]]) if len(found) else _NONE

    run_chunks(work, len(compared), -(-len(compared) // 16))
    return out


def without_degenerate(
    graph: PoseGraph,
    directions: Sequence[Float64],
    unmeasured: Collection[tuple[int, int]] = (),
) -> PoseGraph:
    """Return the graph without information of its edges along their degenerate directions.

    Information there comes from noise (`uncertainty`) or from the prediction. These directions get
    practically unbounded variances. They are known to a few degrees only, and differ that much
    between edges, which together would seem to constrain them. So the error along them, up to the
    smallest that counts as unbounded, is also part of the error in the other directions.

    Parameters
    ----------
    graph
        After refinement.
    directions
        Of every edge, see `degenerate_directions`.
    unmeasured
        Pairs of frames with only extrapolated motion between them.
    """
    information = graph.information.copy()
    open_variance = np.diag((_OPEN / UNITS) ** 2)
    for k, ((a, b), weak) in enumerate(zip(graph.edges, directions, strict=True)):
        i, j = int(graph.ids[a]), int(graph.ids[b])
        if (i, j) in unmeasured or (j, i) in unmeasured:
            information[k] = np.diag(_OPEN**-2.0)
            continue
        if not len(weak):
            continue
        u = span(weak, _DISTINCT)
        H = information[k] * np.outer(UNITS, UNITS)
        scaled = H - H @ u @ np.linalg.pinv(u.T @ H @ u, hermitian=True) @ u.T @ H
        free = u @ np.linalg.inv(u.T @ open_variance @ u) @ u.T
        measured = scaled + free
        measured = np.linalg.solve(np.eye(6) + _LEAK**2 * measured, measured)
        information[k] = 0.5 * (measured + measured.T) / np.outer(UNITS, UNITS)
    return replace(graph, information=information)


def accuracy_of(
    covariances: GraphCovariances, shown: ObservedErrors, diagonal_m: float
) -> Accuracy:
    """Return the bounds on the errors of the poses of a graph.

    Parameters
    ----------
    covariances
        Of a graph after refinement; its information is that of measurements alone, see
        `without_degenerate`.
    shown
        Further errors that the recording shows.
    diagonal_m
        Of the model, m.
    """
    graph = covariances.graph
    if len(graph.ids) < 2:
        return Accuracy()
    least_m, least_rad = _ALIGNMENT.prior_m, _ALIGNMENT.prior_rad
    limits = np.array([max(least_m, _UNMEASURED_FRACTION * diagonal_m), least_rad])
    single, unbounded = _single(covariances, limits)
    free = tuple(graph.ids[unbounded.any(1)].tolist())
    size = np.nan_to_num(np.trace(single[:, :3, :3], axis1=1, axis2=2), nan=np.inf)
    stated = _Stated.by(covariances, np.argsort(-size, kind="stable")[:_WORST])
    if stated is None:
        first = WorstFrame(free[0] if free else int(graph.ids[-1]), np.inf, np.inf)
        return Accuracy(assessed=True, worst=first, unbounded=free)
    extra = shown.beyond(stated)
    of_all = UNOBSERVED_ERROR_FACTOR * np.hypot(stated.bounds, extra)
    of_each = UNOBSERVED_ERROR_FACTOR * np.hypot(stated.single, extra)
    of_each = np.where(unbounded[stated.positions], np.inf, of_each)
    worst = int(np.argmax((of_each / limits).max(1)))
    position, rotation = np.where(unbounded.any(0), np.inf, of_all).tolist()
    return Accuracy(
        position,
        rotation,
        position / diagonal_m if diagonal_m > 0 else np.inf,
        True,
        WorstFrame(int(graph.ids[stated.positions[worst]]), *of_each[worst].tolist()),
        free,
    )


def covariances_of(covariances: GraphCovariances, shown: ObservedErrors) -> Float64:
    """(N, 6, 6) covariances of single poses relative to the first, as right perturbations.

    NaN where a pose is not connected to the first. An unbounded direction has a sigma of tens of
    metres.
    """
    more = np.repeat(shown.beyond(_Stated.by(covariances)) ** 2 / 3, 3)
    C = covariances.of_poses.copy()
    C[1:] += np.diag(more)
    return UNOBSERVED_ERROR_FACTOR**2 * C


def _single(covariances: GraphCovariances, limits: Float64) -> tuple[Float64, Bool]:
    """Covariances (N, 6, 6) of the poses, and whether position and rotation are unbounded, (N, 2).

    Relative to the first one, or to another if the first is one of few unbounded ones.
    """
    first = covariances.of_poses
    unbounded = _is_unbounded(first, limits)
    if 2 * unbounded.any(1).sum() > len(unbounded):
        many = np.flatnonzero(unbounded.any(1))
        other = GraphCovariances(covariances.graph, int(many[len(many) // 2])).of_poses
        others = _is_unbounded(other, limits)
        if others.any(1).sum() < unbounded.any(1).sum():
            return other, others
    return first, unbounded


def _is_unbounded(covariances: Float64, limits: Float64) -> Bool:
    """(N, 2) whether the largest sigma of position or rotation exceeds the limits."""
    known = np.isfinite(covariances).all((1, 2))
    out = np.ones((len(covariances), 2), np.bool_)
    C = covariances[known]
    for k, part in enumerate((C[:, :3, :3], C[:, 3:, 3:])):
        out[known, k] = np.linalg.eigvalsh(part)[:, -1] > limits[k] ** 2
    return out


def _aligned(C: Float64, poses: Float64, rms: Bool) -> tuple[Float64, Float64]:
    """Covariances (3m, 3m) of positions and rotations in the world, less a rigid motion of all.

    Parameters
    ----------
    C
        (6m, 6m) of right perturbations.
    poses
        (m, 4, 4).
    rms
        (m,) poses that are aligned.
    """
    m = len(poses)
    C = C.reshape(m, 6, m, 6)
    R, p = poses[:, :3, :3], poses[:, :3, 3]
    positions, rotations = (
        np.einsum("iab,ibjc,jdc->iajd", R, C[:, part, :, part], R, optimize=True).reshape(3 * m, -1)
        for part in (np.s_[:3], np.s_[3:])
    )
    turn = np.tile(np.eye(3), (m, 1, 1))
    motion = np.concatenate([turn, -se3.hat(p - p[rms].mean(0))], 2)
    return _without(positions, motion, rms), _without(rotations, turn, rms)


def _without(C: Float64, motion: Float64, rms: Bool) -> Float64:
    """Covariance (3m, 3m) after the best fit of motions (m, 3, k) of the chosen ones is removed."""
    k = motion.shape[2]
    flat = motion.reshape(-1, k)
    chosen = np.where(np.repeat(rms, 3)[:, None], flat, 0.0)
    left = np.eye(len(flat)) - flat @ np.linalg.pinv(chosen, rcond=1e-9)
    return np.asarray(left @ C @ left.T, np.float64)


def _bounds(C: Float64, rms: Bool) -> tuple[float, float, Float64]:
    """95 % bound of the rms over the chosen ones, its expectation, and bounds of each (m,)."""
    m, count = len(rms), int(rms.sum())
    chosen = np.repeat(rms, 3)
    own = C[np.ix_(chosen, chosen)]
    blocks = C.reshape(m, 3, m, 3)[np.arange(m), :, np.arange(m), :]
    return (
        float(np.sqrt(_quantile(own) / count)),
        float(np.sqrt(np.trace(own) / count)),
        np.sqrt([_quantile(block) for block in blocks]),
    )


def _quantile(C: Float64) -> float:
    """95 % quantile of the squared length of a normal vector with this covariance.

    A sum of squares is distributed nearly as a gamma variable of the same mean and variance
    (Satterthwaite 1946).
    """
    mean, variance = float(np.trace(C)), 2 * float((C * C).sum())
    if mean <= 0 or variance <= 0:
        return 0.0
    degrees = 2 * mean**2 / variance
    chi_squared = 2 * gammaincinv(degrees / 2, _LEVEL)  # scipy.stats takes long to import
    return float(chi_squared * mean / degrees)
