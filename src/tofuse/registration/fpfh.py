"""Clouds without a guess: shapes around points that are alike, and the motion most agree on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import RegistrationError
from tofuse.geometry import se3
from tofuse.kernels.kdtree import KdTree
from tofuse.parts import part
from tofuse.recordings.frames import CloudFrame, Frame
from tofuse.registration.base import Registrar, Registration
from tofuse.registration.coarse_to_fine import CoarseToFine, spacing
from tofuse.registration.reduce import reduced
from tofuse.registration.sample_consensus import (
    ConsensusOptions,
    Pairs,
    Way,
    consensus,
    motion_of,
    registration_of,
)
from tofuse.registration.shape import shape_at

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

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
# Distances of descriptors are worked out for so many points at a time.
_ROWS = 256


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
        size = _COARSER * max(spacing(source), spacing(target))
        size, data, model = reduced(source, target, size, self.points)
        there, here = self._described(data, size), self._described(model, size)
        i, j = mutually_nearest(there.histograms, here.histograms)
        variance = np.full(len(i), 2 * (_SCATTER * size) ** 2)
        pairs = Pairs(there.points[i], here.points[j], variance)
        found = consensus(pairs, self._consensus(size), rng)
        tree = KdTree(here.points)
        settled = [_settled(there, here, tree, c.T_target_source, size) for c in found]
        order = sorted(range(len(found)), key=lambda k: (-settled[k][1], k))
        best = order[0]
        T = settled[best][0]
        # What settles where the best does is no rival.
        rivals = [settled[k][1] for k in order[1:] if _apart(settled[k][0], T, there, size)]
        first = registration_of(pairs, found[best], settled[best][1] - max(rivals, default=0.0))
        if not self.refine:
            return first
        finer = CoarseToFine(coarsest=size).register(source, target, T, rng)
        return replace(finer, margin=first.margin)

    def _described(self, view: CloudFrame, size: float) -> _Described:
        shape = shape_at(view, np.arange(len(view)), self.neighbours)
        # What is not on a surface has no shape around it, and spoils that of its neighbours.
        known = np.isfinite(shape.normals).all(1) & (shape.roughness < _ROUGHEST)
        points, normals = view.points[known].astype(np.float64), shape.normals[known]
        if len(points) < self.inliers:
            raise RegistrationError(
                f"has {len(points)} points on surfaces, too few to be matched",
                where=f"frame {view.index}",
            )
        return _Described(points, normals, fpfh(points, normals, self.reach * size, self.signed))


@dataclass(frozen=True, eq=False)
class _Described:
    """Points (n, 3) of a view, their normals (n, 3), and histograms (n, 33)."""

    points: Float64
    normals: Float64
    histograms: Float64


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
    i = np.repeat(np.arange(n), near.shape[1])
    j = near.ravel()
    distance = np.sqrt(squared.ravel())
    use = (i != j) & (distance > 0) & (distance <= reach)
    i, j, distance = i[use], j[use], distance[use]
    d = (points[j] - points[i]) / distance[:, None]
    u, other = normals[i], normals[j]
    v = np.cross(u, d)
    length = np.linalg.norm(v, axis=1)
    v /= np.maximum(length, 1e-12)[:, None]
    w = np.cross(u, v)
    alpha, phi = (v * other).sum(1), (u * d).sum(1)
    across, along = (w * other).sum(1), (u * other).sum(1)
    if signed:
        theta = np.arctan2(across, along) / np.pi
    else:
        alpha, phi = 2 * np.abs(alpha) - 1, 2 * np.abs(phi) - 1
        theta = 4 * np.arctan2(np.abs(across), np.abs(along)) / np.pi - 1
    own = np.zeros((n, 3, _BINS))
    for k, angle in enumerate((alpha, phi, theta)):
        place = np.clip(((angle + 1) / 2 * _BINS).astype(np.int64), 0, _BINS - 1)
        own[:, k] = np.bincount(i * _BINS + place, minlength=n * _BINS).reshape(n, _BINS)
    own = (own / np.maximum(own.sum(2, keepdims=True), 1)).reshape(n, 3 * _BINS)
    weight = reach / distance
    total = np.bincount(i, weight, minlength=n)
    shared = np.stack(
        [np.bincount(i, weight * own[j, k], minlength=n) for k in range(3 * _BINS)], axis=1
    )
    return own + shared / np.maximum(total, 1e-12)[:, None]


def mutually_nearest(a: Float64, b: Float64) -> tuple[Int64, Int64]:
    """Positions in a (n, d) and b (m, d) of rows that are nearest to each other."""
    there = _nearest(a, b)
    back = _nearest(b, a)
    i = np.flatnonzero(back[there] == np.arange(len(a)))
    return i.astype(np.int64), there[i]


def _nearest(a: Float64, b: Float64) -> Int64:
    """(n,) position in b (m, d) of the row nearest to each of a (n, d); the first of equals."""
    nearest = np.empty(len(a), np.int64)
    for k in range(0, len(a), _ROWS):
        apart = np.zeros((len(a[k : k + _ROWS]), len(b)))
        for axis in range(a.shape[1]):
            apart += (a[k : k + _ROWS, axis, None] - b[None, :, axis]) ** 2
        nearest[k : k + _ROWS] = np.argmin(apart, axis=1)
    return nearest


def _settled(
    source: _Described, target: _Described, tree: KdTree, T: Float64, size: float
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
    source: _Described, target: _Described, tree: KdTree, T: Float64, far: float
) -> tuple[NDArray[np.bool_], Int64]:
    """(n,) points of the source near a surface of the target that is turned alike, and which."""
    nearest, squared = tree.nearest(se3.transform(T, source.points))
    turned = source.normals @ T[:3, :3].T
    alike = np.abs((turned * target.normals[nearest]).sum(1)) > _ALIKE
    return (squared < far * far) & alike, nearest


def _apart(T: Float64, other: Float64, view: _Described, size: float) -> bool:
    """Whether two motions take a view to different places."""
    middle = np.median(view.points, 0)[None]
    shift = np.linalg.norm(se3.transform(T, middle) - se3.transform(other, middle))
    turned = se3.angle(se3.inverse(T) @ other)
    return bool(shift > _DISTINCT * size or turned > _DISTINCT_RAD)
