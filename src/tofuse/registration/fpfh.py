"""Global registration of clouds by matching fast point feature histograms."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np

from tofuse.arrays import Bool, Float64, Int64
from tofuse.bounds import Bounded, Bounds
from tofuse.errors import RegistrationError
from tofuse.geometry import se3
from tofuse.kernels import fpfh as kernels
from tofuse.kernels.kdtree import KdTree
from tofuse.kernels.threads import run_chunks
from tofuse.parts import part
from tofuse.recordings.frames import CloudFrame, Frame
from tofuse.registration.base import Registrar, Registration
from tofuse.registration.coarse_to_fine import CoarseToFine, spacing
from tofuse.registration.reduce import reduced
from tofuse.registration.sample_consensus import (
    Consensus,
    ConsensusOptions,
    Method,
    Pairs,
    are_distinct,
    consensus,
    motion_of,
    registration_of,
)
from tofuse.registration.shape import shape_at

_BINS = 11
# Resolution of the averaged views in spacings of the points: averages are less noisy than samples.
_COARSER = 2.0
# Maximum number of neighbours within reach.
_MAX_NEAR = 60
# Sampling noise of an averaged point along each axis, and maximum distance of points that fit, in
# resolutions.
_SCATTER, _FITS = 0.4, 1.5
# Maximum extent of a surface across relative to that along it.
_ROUGHEST = 0.6
# Motions that differ by more are distinct: resolutions, and rad (rotations from matches are
# inaccurate).
_DISTINCT, _DISTINCT_RAD = 4.0, 0.3
# Reach of ICP per iteration, resolutions, and minimum number of correspondences.
_REACHES, _FEWEST = (4.0, 3.0, 3.0, 2.0, 2.0, 2.0), 6
# Minimum cosine of the angle between normals that fit.
_ALIKE = 0.8


@part("registration", "fpfh")
@dataclass(frozen=True)
class Fpfh(Bounded, Registrar):
    """Fast point feature histograms (Rusu et al. 2009) with robust consensus of the matches.

    Both views are averaged to the same resolution. Each point is described by histograms of angles
    between normals, which are invariant to rigid motion; mutual nearest neighbours are matched,
    and nearly all matches may be outliers. Of the consensus motions the one under which most points
    of the source fit is chosen and refined. The guess is not used.

    Attributes
    ----------
    points
        Maximum number of points of each averaged view.
    reach
        Radius of the histograms' neighbourhood, in resolutions of the averaged views.
    neighbours
        Points of each plane fit.
    signed
        Whether the orientation of the normals is known. Arrays of points are assumed to be seen
        from their origin.
    method, inliers, seeds
        Options of the consensus, see `ConsensusOptions`.
    refine
        Whether the pose is refined by generalised ICP (`CoarseToFine`, starting at the resolution
        of the averaged views); else it is that of the matches.
    """

    points: Annotated[int, Bounds(20, 20_000)] = 4000
    reach: Annotated[float, Bounds(1, 100)] = 5.0
    neighbours: Annotated[int, Bounds(4, 1000)] = 12
    signed: bool = False
    method: Method = "compatible"
    inliers: int = 6
    seeds: int = 100
    refine: bool = True
    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

    def __post_init__(self) -> None:
        super().__post_init__()
        self._consensus(1.0)

    def _consensus(self, size: float) -> ConsensusOptions:
        return ConsensusOptions(
            self.method,
            inliers=self.inliers,
            seeds=self.seeds,
            distinct_m=_DISTINCT * size,
            distinct_rad=_DISTINCT_RAD,
        )

    def register(
        self, source: Frame, target: Frame, guess: Float64, rng: np.random.Generator
    ) -> Registration:
        """See `Registrar.register`; without `refine` its points are the matches.

        `margin` is the lead in the fraction of the averaged points that fit.

        Raises
        ------
        RegistrationError
            If too few matches agree on a motion, or, once refined, too few points correspond.
        """
        found = self.candidates(source, target, rng)
        best = found.poses[0]
        rival = found.poses[1].inlier_ratio if len(found.poses) > 1 else 0.0
        first = registration_of(found.pairs, best.agreed, best.inlier_ratio - rival)
        if not self.refine:
            return first
        fine = CoarseToFine(coarsest=found.size)
        finer = fine.register(source, target, best.T_target_source, rng)
        return replace(finer, margin=first.margin)

    def candidates(self, source: Frame, target: Frame, rng: np.random.Generator) -> Candidates:
        """Return the consensus poses of the matches, and how well the averaged views fit there.

        Raises
        ------
        RegistrationError
            If too few matches agree on a motion.
        """
        size = _COARSER * max(spacing(source), spacing(target))
        size, data, model = reduced(source, target, size, self.points)
        there, here = self._described(data, size), self._described(model, size)
        i, j = mutually_nearest(there.histograms, here.histograms)
        variance = np.full(len(i), 2 * (_SCATTER * size) ** 2)
        pairs = Pairs(there.points[i], here.points[j], variance)
        tree = KdTree(here.points)
        refined = [
            Candidate(*_refined(there, here, tree, c.T_target_source, size), c)
            for c in consensus(pairs, self._consensus(size), rng)
        ]
        distinct: list[Candidate] = []
        for one in sorted(refined, key=lambda c: -c.inlier_ratio):
            # Discard poses that converge to a better one.
            if all(
                are_distinct(
                    one.T_target_source,
                    c.T_target_source,
                    there.points,
                    metres=_DISTINCT * size,
                    rad=_DISTINCT_RAD,
                )
                for c in distinct
            ):
                distinct.append(one)
        return Candidates(size, pairs, tuple(distinct))

    def _described(self, view: CloudFrame, size: float) -> Described:
        shape = shape_at(view, np.arange(len(view)), self.neighbours)
        # Points that are on no surface have no descriptor and corrupt those of their neighbours.
        known = np.isfinite(shape.normals).all(1) & (shape.roughness < _ROUGHEST)
        points, normals = view.points[known].astype(np.float64), shape.normals[known]
        if len(points) < self.inliers:
            raise RegistrationError(
                f"has {len(points)} points on surfaces, too few to be matched",
                where=f"frame {view.index}",
            )
        return Described(points, normals, fpfh(points, normals, self.reach * size, self.signed))


@dataclass(frozen=True, eq=False)
class Described:
    """Points (n, 3) of a view, their normals (n, 3), and histograms (n, 33)."""

    points: Float64
    normals: Float64
    histograms: Float64


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose T_target_source (4, 4), the fraction of averaged points that fit, and its matches."""

    T_target_source: Float64
    inlier_ratio: float
    agreed: Consensus


@dataclass(frozen=True, eq=False)
class Candidates:
    """Consensus poses of the matches of two views.

    Attributes
    ----------
    size
        Resolution of the averaged views, m.
    pairs
        All matches.
    poses
        Distinct poses, in order of decreasing fit.
    """

    size: float
    pairs: Pairs
    poses: tuple[Candidate, ...]


def fpfh(points: Float64, normals: Float64, reach: float, signed: bool) -> Float64:
    """Return fast point feature histograms (n, 33).

    With p and q a point and a neighbour, d the unit vector from p to q, and u, v, w the axes
    ``n_p, u x d, u x v``, the angles are ``v . n_q``, ``u . d`` and ``atan2(w . n_q, u . n_q)``,
    each in 11 bins. A point's histogram is its own, and the mean of those of its neighbours,
    weighted by the inverse of their distances.

    Parameters
    ----------
    points, normals
        (n, 3) points in m, and unit normals.
    reach
        Maximum distance of neighbours, m.
    signed
        Whether normals are oriented. If not, the angles are folded so that a normal and its
        opposite give the same histogram.
    """
    n = len(points)
    near, squared = KdTree(points).neighbours(points, min(_MAX_NEAR + 1, n))
    own, around = np.empty((n, 3, _BINS)), np.empty((n, 3 * _BINS))
    run_chunks(
        lambda a, b: kernels.histograms(points, normals, near, squared, reach, signed, own, a, b), n
    )
    flat = own.reshape(n, 3 * _BINS)
    run_chunks(lambda a, b: kernels.weighted_means(flat, near, squared, reach, around, a, b), n)
    return flat + around


def mutually_nearest(a: Float64, b: Float64) -> tuple[Int64, Int64]:
    """Return the positions in a (n, d) and b (m, d) of mutual nearest neighbours."""
    there = _nearest(a, b)
    back = _nearest(b, a)
    i = np.flatnonzero(back[there] == np.arange(len(a)))
    return i.astype(np.int64), there[i]


def _nearest(a: Float64, b: Float64) -> Int64:
    """Return the position (n,) in b (m, d) of the nearest neighbour of each row of a (n, d)."""
    rows = np.ascontiguousarray(a, np.float32)
    columns = np.ascontiguousarray(b.T, np.float32)
    nearest = np.empty(len(a), np.int64)
    run_chunks(lambda i, j: kernels.nearest_rows(rows, columns, nearest, i, j), len(a))
    return nearest


def _refined(
    source: Described, target: Described, tree: KdTree, T: Float64, size: float
) -> tuple[Float64, float]:
    """Refine T (4, 4) by ICP over the averaged points; return it and the fraction that fits."""
    for far in _REACHES:
        fits, nearest = _fitting(source, target, tree, T, far * size)
        if np.count_nonzero(fits) < _FEWEST:
            break
        p, q = source.points[fits], target.points[nearest[fits]]
        T = motion_of(Pairs(p, q, np.ones(len(p))))
    fits, _ = _fitting(source, target, tree, T, _FITS * size)
    return T, float(np.mean(fits))


def _fitting(
    source: Described, target: Described, tree: KdTree, T: Float64, far: float
) -> tuple[Bool, Int64]:
    """Return which source points fit a target point with a similar normal (n,), and its index."""
    nearest, squared = tree.nearest(se3.transform(T, source.points), far)
    turned = source.normals @ T[:3, :3].T
    # Without a neighbour the squared distance is infinite and the normals are irrelevant.
    alike = np.abs((turned * target.normals[nearest]).sum(1)) > _ALIKE
    return (squared < far * far) & alike, nearest
