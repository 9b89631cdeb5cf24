"""Joint alignment of all overlapping views (eq 2.8), and self-calibration.

Every pair of overlapping views gives the normal equations of its relative pose. The adjoint turns
them into equations in both poses, and one sparse system updates all poses. Correspondences are
then found anew, until convergence: the iteration that chapter 8 of the thesis suggests, with
planes and albedo in place of points. Errors of the camera that all views share can be unknowns of
the same system.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from tofuse.arrays import Float64, Int64, Intp
from tofuse.geometry import se3
from tofuse.kernels import refinement as kernels
from tofuse.kernels import steps
from tofuse.kernels.alignment import POINT_SIZE
from tofuse.kernels.shared_error import discount_shared_errors
from tofuse.kernels.threads import run_chunks
from tofuse.posegraph import robust, shared_error
from tofuse.posegraph.descent import vertical
from tofuse.posegraph.graph import Gravity
from tofuse.posegraph.sparse import PairSystem
from tofuse.posegraph.view_store import KeptView, overlaps

UNITS = np.array([0.01] * 3 + [np.radians(1.0)] * 3)
_PAIRS_A_CHUNK = 8
# Approximate number of pairs from which the disagreement of patches is estimated.
_PAIRS_SAMPLED = 200
# Residuals that an estimate of scale needs.
_MIN_COMPARED = 50
_UPPER = np.triu_indices(kernels.UNKNOWNS)
# Information of a weak prior at the current estimate, for poses in units of 1 cm and 1 degree, and
# for errors in units of 0.01.
_WEAK_PRIOR, _ERROR_UNIT = 1e-3, 0.01
_DAMPING = 1e-6
# Overlaps are computed anew after a larger motion, in these units.
_MAX_MOTION = 2.0
_PAIR_ITERATIONS = 8  # of Gauss-Newton


@dataclass(frozen=True)
class Round:
    """Iterations with the same noise inflation: as in `registration.projective.Level`."""

    iterations: int
    inflation_m: float
    photometric_inflation: float


@dataclass(frozen=True)
class RefineOptions:
    """Options of the joint alignment.

    Attributes
    ----------
    rounds
        From coarse to fine. Before each, overlaps are computed anew if any view has moved by more
        than about 2 cm or 2 degrees.
    overlap
        Smallest overlap of a pair, as a fraction of the views.
    neighbours
        Largest number of earlier partners of each view, spread evenly over those that overlap.
    points
        Approximate number of points of each view.
    robust, max_angle, photometric, max_sigma_m
        As in `ProjectiveOptions`.
    convergence
        Iterations end when no view moves by more, in units of 1 cm and 1 degree.
    shared
        Depth errors that the pixels of a patch share, as a multiple of the disagreement of the
        patches; 0: none. Only in the last round, between views with albedo, and where no error of
        the camera is estimated. See `shared_error`.
    """

    rounds: tuple[Round, ...] = (Round(2, 0.02, 0.1), Round(2, 0.005, 0.03), Round(5, 0.0, 0.0))
    overlap: float = 0.3
    neighbours: int = 10
    points: int = 1500
    robust: float = 3.5
    max_angle: float = 0.7
    photometric: bool = True
    max_sigma_m: float = 0.02
    convergence: float = 0.02
    shared: float = 1.0


@dataclass(frozen=True, eq=False)
class Support:
    """Support of each directed pair.

    Attributes
    ----------
    target, source
        (P,) positions of the views.
    good
        (P,) sum over its residuals, each from 1 (zero) to 0 (at the robust limit or beyond), minus
        twice the number of points in free space.
    terms
        (P,) number of its residuals.
    """

    target: Intp
    source: Intp
    good: Float64
    terms: Float64

    def of_views(self, count: int) -> Float64:
        """(N,) support of each of `count` views by all overlapping ones, 1 at most."""
        total, terms = np.zeros(count), np.zeros(count)
        for ends in (self.target, self.source):
            np.add.at(total, ends, self.good)
            np.add.at(terms, ends, self.terms)
        return total / np.maximum(terms, 1)


@dataclass(frozen=True, eq=False)
class Refined:
    """Result of a joint alignment.

    Attributes
    ----------
    poses
        (N, 4, 4) T_world_camera; the first has not moved.
    start
        (N, 4, 4) poses that the alignment started from.
    errors
        (ERRORS,) of the camera, in the order of `kernels.refinement`; 0 where not estimated.
    pairs
        (M, 2) positions of the overlapping views i < j.
    moved
        Largest motion of each iteration, in units of 1 cm and 1 degree.
    before, after
        Support at the initial and at the refined poses, with the same sigmas.
    measured, information
        (M, 4, 4) T_i_j that minimises the residuals of each pair alone, and (M, 6, 6) information
        of its right perturbation, from the noise of the views and the errors that patches share.
    scales
        (2M, 3) exposure, and factors of the sigmas of distance and albedo, of the pairs (i, j),
        then of the pairs (j, i).
    """

    poses: Float64
    start: Float64
    errors: Float64
    pairs: Intp
    moved: tuple[float, ...]
    before: Support
    after: Support
    measured: Float64
    information: Float64
    scales: Float64


@dataclass(frozen=True, eq=False)
class Priors:
    """Measurements of the poses that don't come from the views: odometry, gravity.

    Attributes
    ----------
    pairs, measured, information
        (M, 2) positions i, j of views, (M, 4, 4) T_i_j and (M, 6, 6) its information.
    gravity
        Directions of gravity, or None.
    """

    pairs: Intp
    measured: Float64
    information: Float64
    gravity: Gravity | None = None

    @classmethod
    def none(cls) -> Priors:
        """Return no priors."""
        return cls(np.zeros((0, 2), np.intp), np.zeros((0, 4, 4)), np.zeros((0, 6, 6)))


@dataclass(frozen=True, eq=False)
class Bodies:
    """Rigid bodies of views, as those of a rig's cameras at one instant.

    Attributes
    ----------
    of
        (N,) number of the body of each view; 0 is that of the first.
    T_body_view
        (N, 4, 4) pose of each view in its body.
    """

    of: Intp
    T_body_view: Float64

    def poses(self, views: Float64) -> Float64:
        """(M, 4, 4) T_world_body, by the poses (N, 4, 4) of their first views."""
        _, first = np.unique(self.of, return_index=True)
        return views[first] @ se3.inverse(self.T_body_view[first])

    def views(self, bodies: Float64) -> Float64:
        """(N, 4, 4) T_world_view, by the poses (M, 4, 4) of their bodies."""
        return np.asarray(bodies[self.of] @ self.T_body_view, np.float64)

    def across(self, pairs: Intp) -> Intp:
        """Those of the pairs (M, 2) of views that belong to different bodies."""
        i, j = self.of[pairs].T
        return pairs[i != j]


@dataclass(eq=False)
class _Pairs:
    """Directed pairs, the scales of each, and its latest normal equations: whole, and by patch."""

    target: Intp
    source: Intp
    exposure: Float64
    scale_g: Float64
    scale_p: Float64
    max_scale: Float64
    system: PairSystem
    sources: kernels.SourcePoints
    rows: Float64 = field(default_factory=lambda: np.zeros((0, kernels.SIZE)))
    sums: Float64 = field(default_factory=lambda: np.zeros((0, 0, kernels.PATCH_SIZE)))


def refine(
    views: Sequence[KeptView],
    poses: Float64,
    options: RefineOptions,
    *,
    calibrate: Sequence[int] = (),
    priors: Priors | None = None,
    pairs: Intp | None = None,
    bodies: Bodies | None = None,
) -> Refined:
    """Align all views jointly with the views that they overlap with.

    Parameters
    ----------
    views
        N views of one recording.
    poses
        (N, 4, 4) initial T_world_camera; the first stays.
    options
        See `RefineOptions`.
    calibrate
        Errors of the camera to estimate as well, by their number in `kernels.refinement`.
    priors
        Measurements by other sensors.
    pairs
        (M, 2) positions of the views i < j to compare; by default those that overlap, computed
        anew before a round if views have moved.
    bodies
        Views that move rigidly together, if any. `priors` then refers to the bodies.
    """
    if bodies is not None:
        poses = bodies.views(bodies.poses(poses))
    start = poses
    found = align_views(
        views,
        poses,
        options,
        calibrate=calibrate,
        priors=priors,
        pairs=pairs,
        bodies=bodies,
    )
    poses, errors, state, known = found.poses, found.errors, found.state, found.known
    half = len(state.target) // 2
    pairs = np.stack([state.target[:half], state.source[:half]], 1)
    last = options.rounds[-1]
    by_patch = not calibrate and _depends_on_patches(state, options)
    after = _support(views, poses, errors, known, state, last, options, by_patch=by_patch)
    if by_patch:
        _allow_for_shared(views, poses, state, options)
    measured = _pairwise_measurements(poses, pairs, state)
    before = _support(views, start, np.zeros_like(errors), known, state, last, options)
    scales = np.stack([state.exposure, state.scale_g, state.scale_p], 1)
    return Refined(poses, start, errors, pairs, found.moved, before, after, *measured, scales)


@dataclass(frozen=True, eq=False)
class AlignedViews:
    """Result of the last iteration.

    Attributes
    ----------
    poses, errors
        (N, 4, 4) T_world_camera and (ERRORS,) errors of the camera.
    state
        Residuals and scales of the pairs.
    known
        (ERRORS,) 0 for the errors that were estimated, else 1.
    moved
        Largest motion of a view in each iteration, in units of 1 cm and 1 degree.
    """

    poses: Float64
    errors: Float64
    state: _Pairs
    known: Int64
    moved: tuple[float, ...]


def align_views(
    views: Sequence[KeptView],
    poses: Float64,
    options: RefineOptions,
    *,
    calibrate: Sequence[int] = (),
    errors: Float64 | None = None,
    priors: Priors | None = None,
    pairs: Intp | None = None,
    bodies: Bodies | None = None,
) -> AlignedViews:
    """Do as `refine` does, without measuring the support and the pairs of the result.

    Gauss-Newton on all residuals, with correspondences found anew. The parameters are those of
    `refine`.
    """
    priors = priors or Priors.none()
    errors = np.zeros(kernels.ERRORS) if errors is None else errors
    known = np.ones(kernels.ERRORS, np.int64)
    known[list(calibrate)] = 0
    moved: list[float] = []
    state = _no_pairs()
    since = np.inf
    for stage in options.rounds:
        if since >= _MAX_MOTION:
            near = pairs
            if near is None:
                near = overlaps(views, poses, options.overlap)[0]
                near = near if bodies is None else bodies.across(near)
                near = spread_evenly(near, options.neighbours)
            state = _directed(views, near, options, state, priors, bodies)
            since = 0.0
        for _ in range(stage.iterations if len(state.target) else 0):
            last = stage is options.rounds[-1] and not calibrate
            by_patch = last and _depends_on_patches(state, options)
            _evaluate(views, poses, errors, known, state, stage, options, by_patch=by_patch)
            if by_patch:
                _allow_for_shared(views, poses, state, options)
            step, change = _solve(poses, state, known, priors, bodies)
            poses = _moved(poses, step, bodies)
            errors = errors + change
            _rescale(state, stage)
            moved.append(float(np.abs(step / UNITS).max()))
            since += moved[-1] if pairs is None else 0.0
            if moved[-1] < options.convergence:
                break
    return AlignedViews(poses, errors, state, known, tuple(moved))


def support_of(
    views: Sequence[KeptView], poses: Float64, refined: Refined, options: RefineOptions
) -> Support:
    """Support of the same pairs at other poses (N, 4, 4), with the same sigmas."""
    state = _directed(views, refined.pairs, options, _no_pairs(), Priors.none())
    state.exposure, state.scale_g, state.scale_p = refined.scales.T.copy()
    known = (refined.errors == 0).astype(np.int64)
    return _support(views, poses, refined.errors, known, state, options.rounds[-1], options)


@dataclass(frozen=True, eq=False)
class Response:
    """Sensitivity of each pair to single errors of the camera, all poses being free to follow.

    Attributes
    ----------
    gradient, information
        (M, ERRORS) of each pair i < j, both directions together: first derivative of half its
        squared residuals at zero error, and half the second.
    motion
        (ERRORS, N, 6) twist by which each pose follows, per unit of the error.
    """

    gradient: Float64
    information: Float64
    motion: Float64

    def estimate(self) -> Float64:
        """(ERRORS,) least-squares estimate of each error alone, by one Gauss-Newton step."""
        return np.asarray(
            -self.gradient.sum(0) / np.maximum(self.information.sum(0), 1e-12), np.float64
        )

    def sigma(self, pairs: Intp, views: int) -> Float64:
        """(ERRORS,) standard deviations, from the spread between views (sandwich estimator).

        It includes noise that neighbouring pixels share and errors of single views, but not errors
        that all views have in common.

        Parameters
        ----------
        pairs
            (M, 2) positions of the views.
        views
            Number of views.
        """
        left = self.gradient + self.information * self.estimate()
        of_view = np.zeros((views, left.shape[1]))
        for ends in pairs.T:
            np.add.at(of_view, ends, left)
        spread = np.sqrt((of_view**2).sum(0))
        return np.asarray(spread / np.maximum(self.information.sum(0), 1e-12), np.float64)


def response(
    views: Sequence[KeptView],
    poses: Float64,
    pairs: Intp,
    options: RefineOptions,
    *,
    priors: Priors | None = None,
) -> Response:
    """Compute the sensitivity of refined views to errors of the camera that they share.

    Parameters
    ----------
    views, options
        As for `refine`.
    poses
        (N, 4, 4) T_world_camera, refined without any error.
    pairs
        (M, 2) positions of views i < j.
    priors
        Measurements by other sensors.
    """
    priors = priors or Priors.none()
    none, asked = np.zeros(kernels.ERRORS), np.zeros(kernels.ERRORS, np.int64)
    stage = options.rounds[-1]
    state = _directed(views, pairs, options, _no_pairs(), priors)
    _evaluate(views, poses, none, np.ones_like(asked), state, stage, options)
    _without_exposure(state)
    _rescale(state, stage)
    _evaluate(views, poses, none, asked, state, stage, options)
    H, g = _without_exposure(state)
    m = len(priors.pairs)
    i, j = state.system.pairs.T
    T_i_j = se3.inverse(poses[i]) @ poses[j]
    more_H, more_g = _steps(T_i_j[len(H) :], priors)
    n = len(poses)
    prior = np.tile(np.diag(_WEAK_PRIOR / UNITS**2), (n, 1, 1)), np.zeros((n, 6))
    matrix, gradient = state.system.relative(
        np.concatenate([H[:, :6, :6], more_H]), np.concatenate([g[:, :6], more_g]), T_i_j, prior
    )
    factor = state.system.factor(matrix, gradient, _DAMPING)
    assert factor is not None, "every pose has a prior, so the system is not singular"
    A = se3.adjoint(se3.inverse(T_i_j[: len(H)]))

    def relative(step: Float64) -> Float64:
        return step[state.source] - (A @ step[state.target][..., None])[..., 0]

    rest = relative(_finite(factor.step()))
    slope = g[:, :6] + (H[:, :6, :6] @ rest[..., None])[..., 0]
    first, second = np.empty((len(H), kernels.ERRORS)), np.empty((len(H), kernels.ERRORS))
    motion = np.empty((kernels.ERRORS, n, 6))
    for k in range(kernels.ERRORS):
        mixed = H[:, :6, 6 + k]
        column = state.system.gradient(np.concatenate([mixed, np.zeros((m, 6))]), T_i_j)
        motion[k] = _finite(factor.solve(column))
        follow = relative(motion[k])
        first[:, k] = g[:, 6 + k] + (mixed * rest).sum(1) + (slope * follow).sum(1)
        second[:, k] = H[:, 6 + k, 6 + k] + 2 * (mixed * follow).sum(1)
        second[:, k] += np.einsum("mi,mij,mj->m", follow, H[:, :6, :6], follow)
    half = len(pairs)
    return Response(first[:half] + first[half:], second[:half] + second[half:], motion)


def align_pairs(
    views: Sequence[KeptView],
    pairs: Intp,
    T_i_j: Float64,
    options: RefineOptions,
    errors: Float64,
) -> Float64:
    """(M, 4, 4) relative poses T_i_j of pairs, each aligned by itself.

    Parameters
    ----------
    views, options
        As for `refine`.
    pairs
        (M, 2) positions of views.
    T_i_j
        (M, 4, 4) initial guesses.
    errors
        (ERRORS,) assumed errors of the camera.
    """
    count = len(pairs)
    both = [views[int(k)] for k in pairs.ravel()]
    poses = np.tile(np.eye(4), (2 * count, 1, 1))
    poses[1::2] = T_i_j
    state = _directed(
        both, np.arange(2 * count).reshape(-1, 2), options, _no_pairs(), Priors.none()
    )
    known, stage = (errors == 0).astype(np.int64), options.rounds[-1]
    for _ in range(_PAIR_ITERATIONS):
        _evaluate(both, poses, errors, known, state, stage, options)
        step, _ = _solve(poses, state, np.ones_like(known), Priors.none())
        poses = se3.orthonormalise(poses @ se3.exp(step))
        _rescale(state, stage)
    return np.asarray(se3.inverse(poses[::2]) @ poses[1::2], np.float64)


def spread_evenly(pairs: Intp, neighbours: int) -> Intp:
    """At most `neighbours` earlier partners of each view, evenly spread, first and last included.

    `pairs` are (M, 2) positions i < j.
    """
    keep = [np.zeros(0, np.intp)]
    order = np.argsort(pairs[:, 1], kind="stable")
    _, begin = np.unique(pairs[order, 1], return_index=True)
    for rows in np.split(order, begin[1:]):
        if len(rows) > neighbours:
            rows = rows[np.unique(np.linspace(0, len(rows) - 1, neighbours).round().astype(int))]
        keep.append(rows)
    return pairs[np.concatenate(keep)]


def _moved(poses: Float64, step: Float64, bodies: Bodies | None) -> Float64:
    """Apply a step to the views, or to their bodies; the first stays."""
    free = poses if bodies is None else bodies.poses(poses)
    out = se3.orthonormalise(free @ se3.exp(step))
    out[0] = free[0]
    return out if bodies is None else bodies.views(out)


def _no_pairs() -> _Pairs:
    none, nothing = np.zeros(0, np.intp), np.zeros(0)
    system = PairSystem(1, none.reshape(0, 2))
    return _Pairs(
        none, none, nothing, nothing, nothing, nothing, system, _sources([], by_patch=False)
    )


def _directed(
    views: Sequence[KeptView],
    pairs: Intp,
    options: RefineOptions,
    before: _Pairs,
    priors: Priors,
    bodies: Bodies | None = None,
) -> _Pairs:
    """Both directions of each pair, with their scales so far."""
    target = np.concatenate([pairs[:, 0], pairs[:, 1]])
    source = np.concatenate([pairs[:, 1], pairs[:, 0]])
    n = len(target)
    max_scale = np.maximum(3.0, options.max_sigma_m / np.array([v.sigma for v in views]))
    ends = np.stack([target, source], 1)
    count = len(views)
    if bodies is not None:
        ends, count = bodies.of[ends], int(bodies.of.max()) + 1
    first = np.arange(count) == 0
    system = PairSystem(count, np.concatenate([ends, priors.pairs]), fixed=first)
    unknown = np.zeros(n), np.ones(n), np.full(n, 0.1)
    photometric = np.array([v.surface.has_albedo for v in views]) & options.photometric
    sources = _sources(views, by_patch=options.shared > 0 and bool(photometric.any()))
    state = _Pairs(target, source, *unknown, max_scale[source], system, sources)
    state.scale_p[~(photometric[target] & photometric[source])] = 0.0
    row = {ts: k for k, ts in enumerate(zip(before.target, before.source, strict=True))}
    old = np.array([row.get(ts, -1) for ts in zip(target, source, strict=True)], np.intp)
    for name in ("exposure", "scale_g", "scale_p"):
        getattr(state, name)[old >= 0] = getattr(before, name)[old[old >= 0]]
    return state


def _sources(views: Sequence[KeptView], *, by_patch: bool) -> kernels.SourcePoints:
    """Points of views; of those that occur several times only once."""
    different = {id(v): v for v in views}
    row = {key: k for k, key in enumerate(different)}
    of = np.array([row[id(v)] for v in views], np.intp)
    points = [np.zeros((0, POINT_SIZE), np.float32), *(v.points for v in different.values())]
    patches = [v.patches for v in different.values()] if by_patch else []
    ends = np.cumsum([len(p) for p in points])
    return kernels.SourcePoints(
        np.concatenate(points),
        np.concatenate([np.zeros(0, np.int64), *patches]),
        ends[of],
        ends[of + 1],
        np.array([v.surface.measures_range for v in views], np.bool_),
    )


def _evaluate(
    views: Sequence[KeptView],
    poses: Float64,
    errors: Float64,
    known: Int64,
    state: _Pairs,
    stage: Round,
    options: RefineOptions,
    *,
    by_patch: bool = False,
) -> None:
    """Sum the normal equations of every directed pair, and over patches if needed."""
    T_target_source = se3.inverse(poses[state.target]) @ poses[state.source]
    rows = np.empty((len(state.target), kernels.SIZE))
    sums = np.empty((len(rows), shared_error.PATCHES if by_patch else 0, kernels.PATCH_SIZE))
    cosine = float(np.cos(options.max_angle))
    # All sources of a target in succession, so that it stays in the cache.
    order = np.argsort(state.target, kind="stable")
    targets, begin = np.unique(state.target[order], return_index=True)
    end = np.append(begin[1:], len(order))

    def work(a: int, b: int) -> None:
        for k in range(a, b):
            pairs = order[begin[k] : end[k]]
            target = views[targets[k]].surface
            found = np.empty((len(pairs), kernels.SIZE))
            of_patches = np.empty((len(pairs), *sums.shape[1:]))
            kernels.target_equations(
                state.sources,
                state.source[pairs],
                target.target_image,
                T_target_source[pairs],
                kernels.PairResiduals(
                    state.exposure[pairs],
                    state.scale_g[pairs],
                    state.scale_p[pairs],
                    stage.inflation_m,
                    options.robust,
                    cosine,
                ),
                errors,
                known,
                target.measures_range,
                found,
                of_patches,
            )
            rows[pairs], sums[pairs] = found, of_patches

    run_chunks(work, len(targets), -(-len(rows) // _PAIRS_A_CHUNK))
    state.rows, state.sums = rows, sums


def _depends_on_patches(state: _Pairs, options: RefineOptions) -> bool:
    """Whether errors that patches share are allowed for.

    Only where there are photometric residuals: without them nothing more accurate is left.
    """
    return options.shared > 0 and bool((state.scale_p > 0).any())


def _allow_for_shared(
    views: Sequence[KeptView], poses: Float64, state: _Pairs, options: RefineOptions
) -> None:
    """Remove from the normal equations what depth errors shared by patches could explain."""
    photometric = np.flatnonzero(state.scale_p > 0)
    T = se3.inverse(poses[state.target[photometric]]) @ poses[state.source[photometric]]
    depth = np.array([v.surface.depth for v in views])[state.target[photometric]]
    growth = shared_error.growth(depth, se3.angle(T), np.linalg.norm(T[:, :3, 3], axis=1))
    # Views of one recording come from one camera: their errors are alike.
    alike = shared_error.alike(views[0].surface)
    some = np.arange(0, len(photometric), -(-len(photometric) // _PAIRS_SAMPLED))
    sampled = photometric[some]
    found = shared_error.disagreement(state.sums[sampled], state.rows[sampled], alike)
    variance = options.shared**2 * found.variance(growth[some]) * growth
    if not variance.any():
        return

    def work(a: int, b: int) -> None:
        discount_shared_errors(state.sums, alike, variance[a:b], photometric[a:b], state.rows)

    run_chunks(work, len(photometric), -(-len(photometric) // _PAIRS_A_CHUNK))


def _support(
    views: Sequence[KeptView],
    poses: Float64,
    errors: Float64,
    known: Int64,
    state: _Pairs,
    stage: Round,
    options: RefineOptions,
    *,
    by_patch: bool = False,
) -> Support:
    _evaluate(views, poses, errors, known, state, stage, options, by_patch=by_patch)
    good = state.rows[:, kernels.SUPPORT] - 2 * state.rows[:, kernels.IN_FRONT]
    # A copy, as a view would keep the equations of all pairs in memory.
    return Support(state.target, state.source, good, state.rows[:, kernels.TERMS].copy())


def _pairwise_measurements(poses: Float64, pairs: Intp, state: _Pairs) -> tuple[Float64, Float64]:
    """T_i_j that each pair alone measures, and its information."""
    H, g = _without_exposure(state)
    H, g = H[:, :6, :6], g[:, :6]
    half = len(pairs)
    T_i_j = se3.inverse(poses[pairs[:, 0]]) @ poses[pairs[:, 1]]
    # A perturbation of T_i_j is the opposite one of T_j_i, in the other frame.
    A = -se3.adjoint(T_i_j)
    At = np.swapaxes(A, 1, 2)
    H = H[:half] + At @ H[half:] @ A
    g = g[:half] + (At @ g[half:, :, None])[..., 0]
    scaled = H * np.outer(UNITS, UNITS) + _WEAK_PRIOR * np.eye(6)
    step = -np.linalg.solve(scaled, (g * UNITS)[..., None])[..., 0] * UNITS
    return T_i_j @ se3.exp(step), scaled / np.outer(UNITS, UNITS)


def _solve(
    poses: Float64, state: _Pairs, known: Int64, priors: Priors, bodies: Bodies | None = None
) -> tuple[Float64, Float64]:
    """One Gauss-Newton step: (N, 6) right perturbations of views or bodies, and of the errors."""
    H, g = _without_exposure(state)
    if bodies is not None:
        # A perturbation of the body is one of its view, by the adjoint.
        A = np.tile(np.eye(H.shape[1]), (len(H), 1, 1))
        A[:, :6, :6] = se3.adjoint(se3.inverse(bodies.T_body_view[state.source]))
        At = np.swapaxes(A, 1, 2)
        H, g = At @ H @ A, (At @ g[..., None])[..., 0]
        poses = bodies.poses(poses)
    free = 6 + np.flatnonzero(known == 0)
    n, m = len(poses), len(priors.pairs)
    system = state.system
    i, j = system.pairs.T
    T_i_j = se3.inverse(poses[i]) @ poses[j]
    more_H, more_g = _steps(T_i_j[len(H) :], priors)
    # Just enough that an unconstrained view stays.
    prior = np.tile(np.diag(_WEAK_PRIOR / UNITS**2), (n, 1, 1)), np.zeros((n, 6))
    shared = _Shared(
        [system.gradient(np.concatenate([H[:, :6, k], np.zeros((m, 6))]), T_i_j) for k in free],
        H[:, free[:, None], free].sum(0),
        g[:, free].sum(0),
    )
    damping = _WEAK_PRIOR / _ERROR_UNIT**2 + _DAMPING * shared.small.diagonal()
    if priors.gravity is not None:
        damping = np.append(damping, np.zeros(2))
        _add_gravity(poses, priors.gravity, prior, shared, system)
    matrix, gradient = system.relative(
        np.concatenate([H[:, :6, :6], more_H]), np.concatenate([g[:, :6], more_g]), T_i_j, prior
    )
    factor = system.factor(matrix, gradient, _DAMPING)
    assert factor is not None, "every pose has a prior, so the system is not singular"
    # Schur complement: the shared unknowns have a small dense system.
    columns, small, right = shared.columns, shared.small, shared.right
    step = _finite(factor.step())
    follow = np.zeros((len(columns), n, 6))
    for k, column in enumerate(columns):
        follow[k] = _finite(factor.solve(column))
        right[k] += column.ravel() @ step[system.free].ravel()
    for k, column in enumerate(columns):
        small[k] += follow[:, system.free].reshape(len(columns), -1) @ column.ravel()
    small[np.diag_indices(len(columns))] += damping
    change = -np.linalg.solve(small, right)
    errors = np.zeros(kernels.ERRORS)
    errors[free - 6] = change[: len(free)]
    return step + np.tensordot(change, follow, 1), errors


@dataclass(eq=False)
class _Shared:
    """Normal equations of unknowns that all poses share: columns, own block, and gradient."""

    columns: list[Float64]
    small: Float64
    right: Float64


def _steps(T_i_j: Float64, priors: Priors) -> tuple[Float64, Float64]:
    """Normal equations of the priors on relative poses."""
    e = se3.log(se3.inverse(priors.measured) @ T_i_j)
    J = se3.jacobian_inverse(e)
    JtW = np.swapaxes(J, 1, 2) @ priors.information
    return JtW @ J, (JtW @ e[..., None])[..., 0]


def _add_gravity(
    poses: Float64,
    gravity: Gravity,
    single: tuple[Float64, Float64],
    shared: _Shared,
    system: PairSystem,
) -> None:
    """Add gravity's equations of single poses, and of the world's vertical, which they share."""
    at, d = gravity.vertices, gravity.directions
    R = poses[at, :3, :3]
    seen = (R @ d[..., None])[..., 0]
    down = vertical(seen, gravity)
    down /= np.linalg.norm(down)
    across = np.linalg.svd(down[None])[2][1:].T  # (3, 2) tangent directions
    e = seen - down
    known = 1 / gravity.sigma**2
    if np.isfinite(gravity.gate):
        known = known * robust.weight("geman-mcclure", (e * e).sum(1) * known, gravity.gate)
    J = -R @ se3.hat(d)
    Jt = known[:, None, None] * np.swapaxes(J, 1, 2)
    np.add.at(single[0][:, 3:, 3:], at, Jt @ J)
    np.add.at(single[1][:, 3:], at, (Jt @ e[..., None])[..., 0])
    cross = np.zeros((2, len(poses), 6))
    for k in range(2):
        np.add.at(cross[k][:, 3:], at, -Jt @ across[:, k])
    shared.columns += [column[system.free] for column in cross]
    own = len(shared.small)
    small = np.zeros((own + 2, own + 2))
    small[:own, :own] = shared.small
    small[own:, own:] = known.sum() * np.eye(2)
    shared.small = small
    shared.right = np.append(shared.right, -across.T @ (known[:, None] * e).sum(0))


def _finite(step: Float64 | None) -> Float64:
    assert step is not None, "the system is finite"
    return step


def _without_exposure(state: _Pairs) -> tuple[Float64, Float64]:
    """Normal equations of each pair without its exposure, which is eliminated and updated."""
    m, e = len(state.target), kernels.EXPOSURE
    H = np.zeros((m, kernels.UNKNOWNS, kernels.UNKNOWNS))
    H[:, _UPPER[0], _UPPER[1]] = state.rows[:, kernels.H : kernels.G]
    H[:, _UPPER[1], _UPPER[0]] = state.rows[:, kernels.H : kernels.G]
    g = state.rows[:, kernels.G : kernels.G + kernels.UNKNOWNS]
    pivot = np.maximum(H[:, e, e], 1e-9)
    state.exposure -= np.clip(g[:, e] / pivot, -0.3, 0.3)
    rest = np.delete(np.arange(kernels.UNKNOWNS), e)
    lever = H[:, rest, e] / pivot[:, None]
    return (
        H[:, rest[:, None], rest] - lever[:, :, None] * H[:, None, e, rest],
        g[:, rest] - lever * g[:, [e]],
    )


def _rescale(state: _Pairs, stage: Round) -> None:
    """Estimate the sigmas of each pair from its residuals, as the tracker does."""
    counts = np.ascontiguousarray(state.rows[:, kernels.HISTOGRAM :])
    enough = counts.sum(1) >= _MIN_COMPARED
    seen = np.array([steps.scale_of_distances(row) for row in counts[enough]])
    state.scale_g[enough] = np.clip(seen, 0.7, state.max_scale[enough])
    weight = state.rows[:, kernels.WEIGHT_P]
    seen = np.sqrt(state.rows[:, kernels.SQUARES_P] / np.maximum(weight, 1e-9) / 0.72)
    used = (weight > 0) & (state.scale_p > 0)
    scale = np.clip(np.hypot(seen, stage.photometric_inflation), 0.005, 0.5)
    state.scale_p[used] = scale[used]
