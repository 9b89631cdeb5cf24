"""95 % bounds on the errors of the poses, from the recording itself.

All evidence is the mean square of an error, and one quantile is taken of the sum. The joint
covariance of the poses models noise and the errors that the patches of a view share, of a usual
camera; halves of the images measure those of this one, but not what both halves share. Added are
the correction by the refinement, the excess disagreement of views far apart in time, and the
displacement by errors of the camera that the views indicate: each may be an error of the poses or
not, and counts in part. What neither shows, as multipath on a walk through rooms, is added by its
expected size. The quantile allows for the sum being an estimate itself, see
`docs/uncertainty.md`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.special import bdtrc, chdtri, fdtri

from tofuse.engine.alignment import UncertaintyOptions, projective
from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.compute import run_all
from tofuse.engine.frames import evenly_spaced
from tofuse.engine.geometry import se3
from tofuse.engine.graph import PoseGraph, graph_covariances
from tofuse.engine.stored_views import PosedView
from tofuse.engine.views import PreparedView

_LEVEL = 0.95
# Error that all patches of a view have in common, relative to the rest.
_COMMON = UncertaintyOptions().offset
# Evenly spaced poses that the rms is computed from, and the least certain ones in addition.
_EVENLY_SPACED, _WORST = 50, 10
# Standard deviations of an unmeasured direction, practically unbounded: m and rad.
_UNMEASURED_SIGMA = np.array([30.0] * 3 + [10.0] * 3)
# In a large model, errors of this fraction of its diagonal count as unbounded.
_UNMEASURED_FRACTION = 0.05
# Mean square of a fraction of which nothing is known: uniform between none and all.
UNKNOWN_FRACTION = 1 / 3
# The mean square error is known as well as from that many errors: by the covariance alone, whose
# model is that of another camera, and if halves of the images measured it.
_MODEL_DOF, _MEASURED_DOF = 5.0, 15.0
# With covariances larger by these factors, 95 % of such errors (6,) are in the ellipsoid of 95 % of
# a normal distribution.
_MODEL_FACTOR, COVARIANCE_FACTOR = 2.36, 1.33
# Directions of two frames are distinct above this fraction of the strongest.
_DISTINCT = 0.1
_NO_DIRECTIONS = np.zeros((0, 6))
# Number of pairs over degenerate frames that are aligned again, the shortest first: at the end of a
# long one the camera came back, which a loop closure verifies.
_MAX_SPANNING = 2000
# Probability that a pair without information along a degenerate direction seems to have some.
_CHANCE_OF_PAIR = 0.05
# Significance level of the number of such pairs of a view. It admits the only pair of a view.
_SIGNIFICANCE = 0.05 + 1e-9
# Fraction of the edges that disagree anywhere, and the significance of more about some frames.
_DISAGREEING, _CONTRADICTED = 0.01, 0.001
# Near the final pose. A direction with no smaller sigma than the prior is not measured.
_ALIGNMENT = projective.ProjectiveOptions()
# Standard deviation, in `UNITS`, that an error along a degenerate direction causes in the others.
_LEAK = _DISTINCT * _ALIGNMENT.prior_m / projective.UNITS[0]


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
    by_motion
        Those between bounded ones, whose pose would be unbounded if the speed were.
    causes_m
        Rms error of the positions by its cause: "noise", correction by the "refinement",
        "disagreement" of views far apart in time, "calibration" of the camera, errors of the
        "range" that differ from place to place; empty if they are not bounded.
    degrees
        Degrees of freedom of the mean square of the positions as an estimate.
    camera_sigmas
        Standard deviations of errors of the camera, by their name; empty if its images were not
        compared.
    surface_m
        Rms distance between the surfaces of overlapping views, m; None if there are none.
    """

    position_m: float = np.inf
    rotation_rad: float = np.inf
    relative: float = np.inf
    assessed: bool = False
    worst: WorstFrame | None = None
    unbounded: tuple[int, ...] = ()
    by_odometry: tuple[int, ...] = ()
    by_motion: tuple[int, ...] = ()
    causes_m: dict[str, float] = field(default_factory=dict)
    degrees: float = _MODEL_DOF
    camera_sigmas: dict[str, float] = field(default_factory=dict)
    surface_m: float | None = None

    @property
    def limited_by(self) -> str:
        """The cause of most of the bound of the positions; empty if they are not bounded."""
        return max(self.causes_m, key=self.causes_m.__getitem__, default="")

    @property
    def moved_m(self) -> float:
        """Rms by which the refinement moved the positions, m; 0 if they are not bounded."""
        return self.causes_m.get("refinement", 0.0) / float(np.sqrt(UNKNOWN_FRACTION))

    def without_bound(self) -> Accuracy:
        """Return the accuracy where an error is known that its evidence does not cover."""
        return replace(
            self, position_m=np.inf, rotation_rad=np.inf, relative=np.inf, worst=None, causes_m={}
        )


@dataclass(frozen=True)
class ObservedErrors:
    """Errors that the recording reveals and the covariance does not include.

    Attributes
    ----------
    moved_m, moved_rad
        Rms by which the refinement moved the poses, after alignment.
    excess_m
        Rms by which views far apart in time disagree, beyond consecutive ones.
    calibration_m, calibration_rad
        Rms error of the poses due to the calibration of the camera.
    split
        Rms errors (m, rad) by halves of the images, see `split_half`: those of the covariance and
        more. None if they were not compared.
    range_m
        Rms error by errors of the range that differ from place to place, see `error_by_range`.
    corrected
        Whether the camera was corrected by its own views: halves share the correction's error.
    """

    moved_m: float = 0.0
    moved_rad: float = 0.0
    excess_m: float = 0.0
    calibration_m: float = 0.0
    calibration_rad: float = 0.0
    split: tuple[float, float] | None = None
    range_m: float = 0.0
    corrected: bool = False

    @property
    def scale_degrees(self) -> float:
        """Degrees of freedom of the mean squares as estimates."""
        return _MODEL_DOF if self.split is None or self.corrected else _MEASURED_DOF

    def of_other_sensors(self) -> ObservedErrors:
        """Return those that remain if the covariance is scaled by `scale_of_registrations`."""
        return ObservedErrors(self.moved_m, self.moved_rad, self.excess_m)

    def mean_squares(self, by_covariance: Float64) -> dict[str, Float64]:
        """Return the mean squares (2,) of the errors, m^2 and rad^2, by their cause.

        Parameters
        ----------
        by_covariance
            (2,) mean squares by the covariance.
        """
        noise = by_covariance
        if self.split is not None:
            split = np.square(self.split)
            # If halves show less, neither is wrong for certain: their mean.
            noise = np.maximum(split, 0.5 * (split + by_covariance))
        return {
            "noise": noise,
            "refinement": UNKNOWN_FRACTION * np.array([self.moved_m, self.moved_rad]) ** 2,
            "disagreement": UNKNOWN_FRACTION * np.array([self.excess_m, 0.0]) ** 2,
            "calibration": np.array([self.calibration_m, self.calibration_rad]) ** 2,
            "range": np.array([self.range_m, 0.0]) ** 2,
        }


def error_by_range(positions: Float64, shared_rms: float, depth_m: float) -> float:
    """Return the rms error of positions by errors of the range that differ from place to place, m.

    Multipath depends on where the camera is. Where its error grows as the camera approaches a
    surface, by a fraction of the way, all views agree on a way that is longer by this fraction.
    Only the part that differs between patches of the images leaves residuals. The part that all
    patches of a view have in common is taken to be larger by the same factor as in the covariance
    of a single alignment, and to change with the place over about the depth: the error of the
    distance of two poses is the integral of a random field with an exponential correlation. As it
    is one of the place, and not of the path, a loop does not show it.

    Parameters
    ----------
    positions
        (N, 3) of the poses, m.
    shared_rms
        See `Refinement.shared_rms`.
    depth_m
        Typical depth, m.
    """
    if not shared_rms or not depth_m:
        return 0.0
    some = positions[evenly_spaced(np.arange(len(positions)), _EVENLY_SPACED)] / depth_m
    distances = np.linalg.norm(some[:, None] - some, axis=2)
    # Half of the double integral of exp(-|s - t|) over the distance: the mean square difference of
    # two poses is twice the mean square deviation from their mean.
    squares = distances - 1 + np.exp(-distances)
    return _COMMON * shared_rms * depth_m * float(np.sqrt(squares.mean()))


@dataclass(frozen=True, eq=False)
class _CovarianceErrors:
    """Errors by the covariance alone, in m and rad.

    Attributes
    ----------
    positions
        (m,) positions of the evaluated poses.
    squares, degrees
        (2,) mean squares of the errors of all poses, and their degrees of freedom.
    single_squares, single_degrees
        (m, 2) the same of these poses.
    """

    positions: Intp
    squares: Float64
    degrees: Float64
    single_squares: Float64
    single_degrees: Float64

    @classmethod
    def of_graph(
        cls, covariances: graph_covariances.GraphCovariances, extra: Intp | None = None
    ) -> _CovarianceErrors | None:
        """Evaluate evenly spaced poses and `extra`; None if the graph does not constrain all poses.

        The rms is that of the evenly spaced ones.
        """
        graph = covariances.graph
        n = len(graph.ids)
        even = evenly_spaced(np.arange(n), _EVENLY_SPACED)
        positions = even if extra is None else np.union1d(even, extra)
        C = covariances.joint(positions) if n > 1 else None
        if C is None:
            return None
        is_even = np.isin(positions, even)
        parts = _aligned(C, graph.poses[positions], is_even)
        squares, degrees = np.stack([_of_chosen(part, is_even) for part in parts], 1)
        single = np.stack([_of_each(part) for part in parts], 2)
        return cls(positions, squares, degrees, single[0], single[1])


def degenerate_directions(
    graph: PoseGraph,
    unobservable: Mapping[int, Float64],
    tracked: Collection[tuple[int, int]],
    views: Mapping[int, PosedView[PreparedView]],
    non_overlap_edges: Collection[tuple[int, int]] = (),
) -> list[Float64]:
    """Return the degenerate directions of every edge: (k, 6), right perturbations of j.

    Those of the tracker's registrations are known. A pair of the refinement is aligned again if
    tracking was degenerate in one of its views or between them: after an unnoticed slide along a
    wall, later views overlap with earlier ones at wrong poses. Among many pairs of a degenerate
    view, some seem constrained by chance, and a single one would bound all later poses. So the
    pairs of such a view count as constrained only if they are more than chance explains.

    Parameters
    ----------
    graph
        After refinement.
    unobservable
        (k, 6) degenerate directions of frames, by their index: right perturbations, m and rad.
    tracked
        Pairs (i, j) that are the registrations of j in tracking.
    views
        Prepared views by frame index.
    non_overlap_edges
        Pairs (i, j) that do not come from the overlap of the two views: never degenerate.
    """
    degenerate = np.array(sorted(unobservable), np.intp)
    result: list[Float64] = []
    to_align: list[int] = []  # edges to align again
    spanning: list[tuple[int, int]] = []  # those over degenerate frames, and their length
    for (a, b), T_i_j in zip(graph.edges, graph.measurements, strict=True):
        i, j = int(graph.ids[a]), int(graph.ids[b])
        if (i, j) in non_overlap_edges:
            result.append(_NO_DIRECTIONS)
            continue
        # A perturbation of i is the opposite one of j, by the adjoint.
        of_i = unobservable.get(i, _NO_DIRECTIONS) @ se3.adjoint(se3.inverse(T_i_j)).T
        of_j = unobservable.get(j, _NO_DIRECTIONS)
        directions = np.concatenate([of_i, of_j])
        if (i, j) in tracked:
            directions = directions if len(of_j) else _NO_DIRECTIONS
        elif i in views and j in views:
            if len(directions):
                to_align.append(len(result))
            elif np.diff(np.searchsorted(degenerate, sorted((i, j)))).any():
                spanning.append((abs(j - i), len(result)))
        result.append(directions)
    to_align += [k for _, k in sorted(spanning)[:_MAX_SPANNING]]

    def align_again(k: int) -> None:
        i, j = (views[int(graph.ids[end])].view.without_caches() for end in graph.edges[k])
        target = [projective.Target(i)]
        realigned = projective.align(j, target, graph.measurements[k], _ALIGNMENT).unobservable
        # Directions are known to a few degrees only, and the remainder would look measured: a
        # degenerate pair is taken to be degenerate in all directions of its views.
        result[k] = (
            np.concatenate([realigned * projective.UNITS, result[k]])
            if len(realigned)
            else _NO_DIRECTIONS
        )

    of_views = list(result)
    run_all([partial(align_again, k) for k in to_align])
    aligned = np.array(to_align, np.intp)
    constrained = np.array([len(result[k]) == 0 for k in to_align], np.bool_)
    pairs = np.asarray(graph.ids, np.intp)[graph.edges[aligned]]
    for k in aligned[_constrained_by_chance(pairs, constrained, degenerate)]:
        result[k] = of_views[k]
    return result


def _constrained_by_chance(pairs: Intp, constrained: Bool, degenerate: Intp) -> Bool:
    """(n,) whether a pair seems constrained, but a degenerate frame of it has few such pairs.

    Parameters
    ----------
    pairs
        (n, 2) frames.
    constrained
        (n,) whether the alignment of a pair has no degenerate direction.
    degenerate
        Frames whose tracking is degenerate, ascending.
    """
    is_degenerate = np.isin(pairs, degenerate)
    row = np.searchsorted(degenerate, pairs)
    count = len(degenerate) + 1
    n_pairs = np.bincount(row[is_degenerate], minlength=count)
    n_constrained = np.bincount(row[is_degenerate & constrained[:, None]], minlength=count)
    # P(X >= n_constrained) of the binomial distribution.
    chance = np.where(n_constrained > 0, bdtrc(n_constrained - 1, n_pairs, _CHANCE_OF_PAIR), 1.0)
    found: Bool = constrained & (is_degenerate & (chance > _SIGNIFICANCE)[row]).any(1)
    return found


def contradicted_runs(graph: PoseGraph, frames: Intp, runs: Intp) -> set[int]:
    """Return the runs of frames about which edges of a graph disagree more than elsewhere.

    Where a registration slid, edges before and after the slide do.

    Parameters
    ----------
    graph
        After refinement, with the information that its edges claim.
    frames, runs
        (K,) frame indices, and number of the run that each belongs to.
    """
    ends = np.sort(np.asarray(graph.ids, np.intp)[graph.edges], axis=1)
    chi2 = graph.squared_errors()
    about = {
        int(run): (ends[:, 0] <= frames[runs == run].max())
        & (ends[:, 1] >= frames[runs == run].min())
        for run in np.unique(runs)
    }
    elsewhere = ~np.logical_or.reduce([*about.values()])
    limit = chdtri(6, _DISAGREEING)
    if elsewhere.any():
        limit = max(limit, float(np.quantile(chi2[elsewhere], 1 - _DISAGREEING)))
    disagrees = chi2 > limit
    return {
        run
        for run, which in about.items()
        if bdtrc((disagrees & which).sum() - 1, which.sum(), _DISAGREEING) < _CONTRADICTED
    }


def without_degenerate(
    graph: PoseGraph, directions: Sequence[Float64], unmeasured: Collection[tuple[int, int]] = ()
) -> PoseGraph:
    """Return the graph without information of its edges along their degenerate directions.

    Information there comes from noise (`uncertainty`) or from the prediction. These directions get
    practically unbounded variances. They are known to a few degrees only, and differ that much
    between edges, which together would seem to constrain them. So the error along them, up to the
    smallest that counts as unbounded, is also part of the error in the other directions. All
    degenerate pairs of a view share it: their number does not reduce it.

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
    unmeasured_variance = np.diag((_UNMEASURED_SIGMA / projective.UNITS) ** 2)
    is_degenerate = np.array([len(d) > 0 for d in directions], np.bool_)
    n_degenerate = np.bincount(graph.edges[is_degenerate].ravel(), minlength=len(graph.ids))
    for k, ((a, b), degenerate) in enumerate(zip(graph.edges, directions, strict=True)):
        i, j = int(graph.ids[a]), int(graph.ids[b])
        if (i, j) in unmeasured or (j, i) in unmeasured:
            information[k] = np.diag(_UNMEASURED_SIGMA**-2.0)
            continue
        if not len(degenerate):
            continue
        basis = projective.span(degenerate, _DISTINCT)
        H = information[k] * np.outer(projective.UNITS, projective.UNITS)
        scaled = projective.with_free_directions(H, basis)
        unbounded = basis @ np.linalg.inv(basis.T @ unmeasured_variance @ basis) @ basis.T
        measured = scaled + unbounded
        leak_variance = _LEAK**2 * max(n_degenerate[a], n_degenerate[b])
        measured = np.linalg.solve(np.eye(6) + leak_variance * measured, measured)
        information[k] = (
            0.5 * (measured + measured.T) / np.outer(projective.UNITS, projective.UNITS)
        )
    return replace(graph, information=information)


def accuracy_of(
    covariances: graph_covariances.GraphCovariances, observed: ObservedErrors, diagonal_m: float
) -> Accuracy:
    """Return the bounds on the errors of the poses of a graph.

    Parameters
    ----------
    covariances
        Of a graph after refinement; its information is that of measurements alone, see
        `without_degenerate`.
    observed
        Further errors that the recording reveals.
    diagonal_m
        Of the model, m.
    """
    graph = covariances.graph
    if len(graph.ids) < 2:
        return Accuracy()
    prior_m, prior_rad = _ALIGNMENT.prior_m, _ALIGNMENT.prior_rad
    limits = np.array([max(prior_m, _UNMEASURED_FRACTION * diagonal_m), prior_rad])
    pose_covariances, unbounded = _pose_covariances(covariances, limits)
    unbounded_frames = tuple(graph.ids[unbounded.any(1)].tolist())
    variance = np.nan_to_num(np.trace(pose_covariances[:, :3, :3], axis1=1, axis2=2), nan=np.inf)
    by_covariance = _CovarianceErrors.of_graph(
        covariances, np.argsort(-variance, kind="stable")[:_WORST]
    )
    if by_covariance is None:
        worst_frame = WorstFrame(
            unbounded_frames[0] if unbounded_frames else int(graph.ids[-1]), np.inf, np.inf
        )
        return Accuracy(assessed=True, worst=worst_frame, unbounded=unbounded_frames)
    causes = observed.mean_squares(by_covariance.squares)
    total = np.sum([*causes.values()], axis=0)
    rms_bounds = _bounds(total, by_covariance.degrees, observed.scale_degrees)
    noise = causes["noise"]
    pose_squares = by_covariance.single_squares * _ratio(noise, by_covariance.squares)
    pose_squares += total - noise
    pose_bounds = _bounds(pose_squares, by_covariance.single_degrees, observed.scale_degrees)
    pose_bounds = np.where(unbounded[by_covariance.positions], np.inf, pose_bounds)
    worst_row = int(np.argmax((pose_bounds / limits).max(1)))
    position, rotation = np.where(unbounded.any(0), np.inf, rms_bounds).tolist()
    causes_m = {cause: float(np.sqrt(squares[0])) for cause, squares in causes.items()}
    return Accuracy(
        position,
        rotation,
        position / diagonal_m if diagonal_m > 0 else np.inf,
        True,
        WorstFrame(
            int(graph.ids[by_covariance.positions[worst_row]]), *pose_bounds[worst_row].tolist()
        ),
        unbounded_frames,
        causes_m=causes_m if np.isfinite(position) else {},
        degrees=observed.scale_degrees,
    )


def scale_of_registrations(
    covariances: graph_covariances.GraphCovariances, observed: ObservedErrors
) -> tuple[float, float]:
    """Factors on the sigmas of a graph's registrations, of translation and of rotation.

    With them the covariance includes what halves of the images and the camera add to it, so that
    registrations can be combined with other measurements.

    Parameters
    ----------
    covariances
        Of the graph of registrations alone.
    observed
        Errors of its poses.
    """
    by_covariance = _CovarianceErrors.of_graph(covariances)
    if by_covariance is None:
        return 1.0, 1.0
    causes = observed.mean_squares(by_covariance.squares)
    of_camera = causes["noise"] + causes["calibration"] + causes["range"]
    ratio = _ratio(of_camera, by_covariance.squares)
    translation, rotation = np.sqrt(np.maximum(ratio, 1.0)).tolist()
    return translation, rotation


def bound_by_covariance(C: Float64) -> float:
    """95 % bound on the rms error of positions with covariance (3m, 3m), which is all evidence."""
    square, degrees = _of_chosen(C, np.ones(len(C) // 3, np.bool_))
    return float(_bounds(np.array(square), np.array(degrees), _MODEL_DOF))


def covariances_of(
    covariances: graph_covariances.GraphCovariances, observed: ObservedErrors
) -> Float64:
    """(N, 6, 6) covariances of single poses relative to the first, as right perturbations.

    NaN where a pose is not connected to the first. An unbounded direction has a sigma of tens of
    metres.
    """
    by_covariance = _CovarianceErrors.of_graph(covariances)
    squares = np.zeros(2) if by_covariance is None else by_covariance.squares
    causes = observed.mean_squares(squares)
    noise = causes.pop("noise")
    more = np.sum([*causes.values()], axis=0)
    # Halves of the images say little about single poses: these are not reduced.
    scale = np.repeat(np.sqrt(np.maximum(_ratio(noise, squares), 1.0)), 3)
    C = covariances.of_poses * np.outer(scale, scale)
    C[1:] += np.diag(np.repeat(more / 3, 3))
    return np.asarray(C * factor_of(observed.scale_degrees), np.float64)


def factor_of(degrees: float) -> float:
    """Factor by which covariances are larger, so that ellipsoids are as of normal errors."""
    return COVARIANCE_FACTOR if degrees > _MODEL_DOF else _MODEL_FACTOR


def _ratio(noise: Float64, by_covariance: Float64) -> Float64:
    """Ratios (2,) of mean squares, 1 where the covariance has none."""
    return np.divide(noise, by_covariance, out=np.ones(2), where=by_covariance > 0)


def _pose_covariances(
    covariances: graph_covariances.GraphCovariances, limits: Float64
) -> tuple[Float64, Bool]:
    """Covariances (N, 6, 6) of the poses, and whether position and rotation are unbounded, (N, 2).

    Relative to the first one, or to another if the first is one of few unbounded ones.
    """
    to_first = covariances.of_poses
    unbounded = _is_unbounded(to_first, limits)
    if 2 * unbounded.any(1).sum() > len(unbounded):
        unbounded_rows = np.flatnonzero(unbounded.any(1))
        to_other = graph_covariances.GraphCovariances(
            covariances.graph, int(unbounded_rows[len(unbounded_rows) // 2])
        ).of_poses
        other_unbounded = _is_unbounded(to_other, limits)
        if other_unbounded.any(1).sum() < unbounded.any(1).sum():
            return to_other, other_unbounded
    return to_first, unbounded


def _is_unbounded(covariances: Float64, limits: Float64) -> Bool:
    """(N, 2) whether the largest sigma of position or rotation exceeds the limits."""
    finite = np.isfinite(covariances).all((1, 2))
    out = np.ones((len(covariances), 2), np.bool_)
    C = covariances[finite]
    for k, part in enumerate((C[:, :3, :3], C[:, 3:, 3:])):
        out[finite, k] = np.linalg.eigvalsh(part)[:, -1] > limits[k] ** 2
    return out


def _aligned(C: Float64, poses: Float64, chosen: Bool) -> tuple[Float64, Float64]:
    """Covariances (3m, 3m) of positions and rotations in the world, less a rigid motion of all.

    Parameters
    ----------
    C
        (6m, 6m) of right perturbations.
    poses
        (m, 4, 4).
    chosen
        (m,) poses that are aligned.
    """
    m = len(poses)
    C = C.reshape(m, 6, m, 6)
    R, p = poses[:, :3, :3], poses[:, :3, 3]
    positions, rotations = (
        np.einsum("iab,ibjc,jdc->iajd", R, C[:, part, :, part], R, optimize=True).reshape(3 * m, -1)
        for part in (np.s_[:3], np.s_[3:])
    )
    rotation = np.tile(np.eye(3), (m, 1, 1))
    motion = np.concatenate([rotation, -se3.hat(p - p[chosen].mean(0))], 2)
    return _remove_motion(positions, motion, chosen), _remove_motion(rotations, rotation, chosen)


def _remove_motion(C: Float64, motion: Float64, chosen: Bool) -> Float64:
    """Covariance (3m, 3m) after the best fit of motions (m, 3, k) of the chosen ones is removed."""
    flat = motion.reshape(-1, motion.shape[2])
    chosen_motion = np.where(np.repeat(chosen, 3)[:, None], flat, 0.0)
    projector = np.eye(len(flat)) - flat @ np.linalg.pinv(chosen_motion, rcond=1e-9)
    return np.asarray(projector @ C @ projector.T, np.float64)


def _bounds(squares: Float64, degrees: Float64, scale_degrees: float) -> Float64:
    """95 % bounds on rms errors with these expected mean squares.

    The ratio of the mean square of errors with some degrees of freedom to an estimate of it with
    `scale_degrees` follows Fisher's F-distribution.
    """
    return np.asarray(np.sqrt(squares * fdtri(degrees, scale_degrees, _LEVEL)), np.float64)


def _of_chosen(C: Float64, chosen: Bool) -> tuple[float, float]:
    """Expected mean square of the chosen ones, and its degrees of freedom; C is (3m, 3m)."""
    rows = np.repeat(chosen, 3)
    C_chosen = C[np.ix_(rows, rows)]
    return float(np.trace(C_chosen)) / int(chosen.sum()), float(_degrees(C_chosen[None])[0])


def _of_each(C: Float64) -> tuple[Float64, Float64]:
    """(m,) expected squares of each, and their degrees of freedom; C is (3m, 3m)."""
    m = len(C) // 3
    blocks = C.reshape(m, 3, m, 3)[np.arange(m), :, np.arange(m), :]
    return np.trace(blocks, axis1=1, axis2=2), _degrees(blocks)


def _degrees(C: Float64) -> Float64:
    """Degrees of freedom (K,) of the squared length of normal vectors with covariances (K, n, n).

    A sum of squares is distributed nearly as a gamma variable of the same mean and variance
    (Satterthwaite 1946).
    """
    squares = (C * C).sum((1, 2))
    mean = np.trace(C, axis1=1, axis2=2)
    return np.divide(mean**2, squares, out=np.ones(len(C)), where=squares > 0)
