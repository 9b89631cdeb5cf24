"""Clouds without a guess: shapes around points that are alike, and the motion most agree on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from tofuse.arrays import Bool, Float64, Int64
from tofuse.errors import RegistrationError
from tofuse.geometry import se3
from tofuse.kernels import cloud_matching as kernels
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
    Pairs,
    Way,
    are_distinct,
    consensus,
    motion_of,
    registration_of,
)
from tofuse.registration.shape import shape_at

_BINS = 11
# Resolution of the averaged views in spacings of the points: of samples taken by chance, means of
# several say more about the surface.
_COARSER = 2.0
# Neighbours of a point at most, of those within reach.
_MOST_NEAR = 60
# Points of an averaged cloud lie by chance within a cell: what two that are taken for the same
# differ by along each axis, and how far they may be apart to fit, in resolutions.
_SCATTER, _FITS = 0.4, 1.5
# Extent of a surface across relative to that along it, at most.
_ROUGHEST = 0.6
# Motions are rivals that differ by more: resolutions, and rad. Matches turn a body roughly.
_DISTINCT, _DISTINCT_RAD = 4.0, 0.3
# How far ICP looks at each iteration, resolutions, and the fewest points that it goes on with.
_REACHES, _FEWEST = (4.0, 3.0, 3.0, 2.0, 2.0, 2.0), 6
# Cosine of the angle between normals that fit.
_ALIKE = 0.8


@part("registration", "fpfh")
@dataclass(frozen=True)
class Fpfh(Registrar):
    """Fast point feature histograms (Rusu et al. 2009), and the motion that most matches agree on.

    Both views are averaged alike to few points. What the surface is like around each is told by
    histograms of angles between normals, which no motion changes. Points whose histograms are most
    alike, both ways, are matched; nearly all matches may be wrong. Of the motions that many agree
    on that is taken under which most points of the source fit, and refined. The guess is not used.

    Attributes
    ----------
    points
        Of either view, at most, once they are averaged.
    reach
        How far around a point its histogram looks, in resolutions of the averaged views.
    neighbours
        Points of each plane fit.
    signed
        Whether it is known on which side of a surface the sensor was. Arrays of points are taken
        to be seen from their origin.
    way, inliers, leaders
        How the motion is found that most matches agree on, see `ConsensusOptions`.
    refine
        Whether generalised ICP makes the pose exact (`CoarseToFine`, from the resolution of the
        averaged views on); else it is what the matches say.
    """

    points: int = 4000
    reach: float = 5.0
    neighbours: int = 12
    signed: bool = False
    way: Way = "compatible"
    inliers: int = 6
    leaders: int = 100
    refine: bool = True
    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

    def __post_init__(self) -> None:
        if not 20 <= self.points <= 20_000:
            raise ValueError(f"points is {self.points}, not 20 to 20000")
        if not 1 <= self.reach <= 100:
            raise ValueError(f"reach is {self.reach}, not 1 to 100")
        if not 4 <= self.neighbours <= 1000:
            raise ValueError(f"neighbours is {self.neighbours}, not 4 to 1000")
        self._consensus(1.0)

    def _consensus(self, size: float) -> ConsensusOptions:
        return ConsensusOptions(
            self.way,
            inliers=self.inliers,
            leaders=self.leaders,
            distinct_m=_DISTINCT * size,
            distinct_rad=_DISTINCT_RAD,
        )

    def register(
        self, source: Frame, target: Frame, guess: Float64, rng: np.random.Generator
    ) -> Registration:
        """See `Registrar.register`; without `refine` its points are the matches.

        `margin` is the lead in the share of the averaged points that fit.

        Raises
        ------
        RegistrationError
            If too few matches agree on a motion, or, once refined, too few points correspond.
        """
        found = self.candidates(source, target, rng)
        best = found.poses[0]
        rival = found.poses[1].share if len(found.poses) > 1 else 0.0
        first = registration_of(found.pairs, best.agreed, best.share - rival)
        if not self.refine:
            return first
        fine = CoarseToFine(coarsest=found.size)
        finer = fine.register(source, target, best.T_target_source, rng)
        return replace(finer, margin=first.margin)

    def candidates(self, source: Frame, target: Frame, rng: np.random.Generator) -> Candidates:
        """Find the poses that many matches agree on, and how well the averaged views fit there.

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
        settled = [
            Candidate(*_settled(there, here, tree, c.T_target_source, size), c)
            for c in consensus(pairs, self._consensus(size), rng)
        ]
        distinct: list[Candidate] = []
        for one in sorted(settled, key=lambda c: -c.share):
            # What settles where a better one does is no rival.
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
        # What is not on a surface has no shape around it, and spoils that of its neighbours.
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
    """A pose T_target_source (4, 4), the share of averaged points that fit, and its matches."""

    T_target_source: Float64
    share: float
    agreed: Consensus


@dataclass(frozen=True, eq=False)
class Candidates:
    """What matches of two views agree on.

    Attributes
    ----------
    size
        Resolution of the averaged views, m.
    pairs
        All matches.
    poses
        Distinct ones, that under which most points fit first.
    """

    size: float
    pairs: Pairs
    poses: tuple[Candidate, ...]


def fpfh(points: Float64, normals: Float64, reach: float, signed: bool) -> Float64:
    """(n, 33) fast point feature histograms.

    With p and q a point and a neighbour, d the unit vector from p to q, and u, v, w the axes
    ``n_p, u x d, u x v``, the angles are ``v . n_q``, ``u . d`` and ``atan2(w . n_q, u . n_q)``,
    each in 11 bins. A point's histogram is its own, and the mean of those of its neighbours,
    weighted by the inverse of their distances.

    Parameters
    ----------
    reach
        Neighbours are at most so far away, m.
    signed
        Whether normals point to a known side. If not, what changes with the side is left out: the
        angles are folded so that a normal and its opposite give the same.
    """
    n = len(points)
    near, squared = KdTree(points).neighbours(points, min(_MOST_NEAR + 1, n))
    own, around = np.empty((n, 3, _BINS)), np.empty((n, 3 * _BINS))
    run_chunks(
        lambda a, b: kernels.histograms(points, normals, near, squared, reach, signed, own, a, b), n
    )
    flat = own.reshape(n, 3 * _BINS)
    run_chunks(lambda a, b: kernels.weighted_means(flat, near, squared, reach, around, a, b), n)
    return flat + around


def mutually_nearest(a: Float64, b: Float64) -> tuple[Int64, Int64]:
    """Positions in a (n, d) and b (m, d) of rows that are nearest to each other."""
    there = _nearest(a, b)
    back = _nearest(b, a)
    i = np.flatnonzero(back[there] == np.arange(len(a)))
    return i.astype(np.int64), there[i]


def _nearest(a: Float64, b: Float64) -> Int64:
    """(n,) position in b (m, d) of the row nearest to each of a (n, d); the first of equals."""
    rows = np.ascontiguousarray(a, np.float32)
    columns = np.ascontiguousarray(b.T, np.float32)
    nearest = np.empty(len(a), np.int64)
    run_chunks(lambda i, j: kernels.nearest_rows(rows, columns, nearest, i, j), len(a))
    return nearest


def _settled(
    source: Described, target: Described, tree: KdTree, T: Float64, size: float
) -> tuple[Float64, float]:
    """Where ICP over the averaged points ends, and the share of the source's that then fit."""
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
    """(n,) points of the source near a surface of the target that is turned alike, and which."""
    nearest, squared = tree.nearest(se3.transform(T, source.points), far)
    turned = source.normals @ T[:3, :3].T
    # Where none is near, the square is infinite, and the last normal compared for nothing.
    alike = np.abs((turned * target.normals[nearest]).sum(1)) > _ALIKE
    return (squared < far * far) & alike, nearest
