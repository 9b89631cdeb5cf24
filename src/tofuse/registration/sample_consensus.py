"""Robust estimation of a rigid motion from point pairs with outliers.

Two methods. RANSAC (Fischler and Bolles 1981; section 2.5.2 of the thesis) draws random triples
until one of them is free of outliers with the required confidence. With few inliers, such as one
in fifty, that takes too many samples; but inliers preserve distances, so that they are pairwise
compatible. The second method groups the pairs that share the most compatible pairs (second-order
compatibility: Chen et al. 2022, "SC2-PCR"), and is deterministic.

Residuals are normalised by each pair's own standard deviation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from scipy.spatial.distance import cdist

from tofuse.arrays import Bool, Float64, Int64
from tofuse.bounds import Bounded, Bounds
from tofuse.errors import RegistrationError
from tofuse.geometry import se3
from tofuse.registration.base import Registration

Method = Literal["samples", "compatible"]

_SAMPLE_SIZE = 3
_BATCH = 256
# Minimum ratio of a sampled triangle's area to its squared side: thin ones don't constrain the
# rotation.
_MIN_AREA_RATIO = 0.1
# Inlier threshold of each round of least squares, relative to the final one: wide at first, as the
# motion of a minimal sample is inaccurate.
_INLIER_GATES = (2.0, 1.5, 1.0, 1.0, 1.0)
# Maximum number of distinct motions that are refined before the best is selected.
_MAX_REFINED = 20
# Minimum side of a sampled triangle, in standard deviations of its length.
_MIN_SIDE_SIGMAS = 4.0
# Size of the consensus set of a seed (SC2-PCR: its nearest neighbours in compatibility).
_CONSENSUS_SIZE = 20
# Maximum number of pairs in the compatibility matrix, whose memory is quadratic.
_MAX_COMPATIBLE_PAIRS = 2000
# A direction is constrained if its sigma is at most 1 cm, or 1 degree.
_UNITS = np.array([0.01] * 3 + [np.radians(1.0)] * 3)


@dataclass(frozen=True)
class ConsensusOptions(Bounded):
    """Options of the consensus search.

    Attributes
    ----------
    method
        "samples": RANSAC; "compatible": second-order compatibility.
    sigmas
        Inlier threshold, in standard deviations of the pair.
    inliers
        Minimum number of inliers of a motion.
    confidence
        Probability that at least one of the drawn samples is free of outliers.
    most_samples
        Maximum number of samples.
    seeds
        Maximum number of seeds of consensus sets.
    distinct_m, distinct_rad
        Motions that differ by more are distinct hypotheses.
    """

    method: Method = "samples"
    sigmas: Annotated[float, Bounds(0, 1000, exclusive=True)] = 3.0
    inliers: Annotated[int, Bounds(3, 1_000_000)] = 6
    confidence: Annotated[float, Bounds(0, 1, exclusive=True)] = 0.999
    most_samples: Annotated[int, Bounds(1, 1_000_000)] = 5000
    seeds: Annotated[int, Bounds(1, 1_000_000)] = 100
    distinct_m: Annotated[float, Bounds(0, 1000, exclusive=True)] = 0.1
    distinct_rad: Annotated[float, Bounds(0, 1000, exclusive=True)] = 0.0873


@dataclass(frozen=True, eq=False)
class Pairs:
    """m putative point correspondences.

    Attributes
    ----------
    source, target
        (m, 3) points in the frames of the two views, m.
    variance
        (m,) variance of the difference of aligned points along each axis, m^2.
    """

    source: Float64
    target: Float64
    variance: Float64

    def __len__(self) -> int:
        return len(self.source)

    def select(self, selection: Int64 | Bool) -> Pairs:
        """Return the pairs selected by a mask (m,) or by positions (k,)."""
        return Pairs(self.source[selection], self.target[selection], self.variance[selection])


@dataclass(frozen=True, eq=False)
class Consensus:
    """A motion and its inliers.

    Attributes
    ----------
    T_target_source
        (4, 4) weighted least squares estimate over the inliers.
    inliers
        (m,) inlier mask.
    score
        MSAC score: sum over the pairs of their fit, 0 to 1 each.
    hypotheses
        Number of hypotheses evaluated.
    """

    T_target_source: Float64
    inliers: Bool
    score: float
    hypotheses: int

    @property
    def count(self) -> int:
        """Number of inliers."""
        return int(np.count_nonzero(self.inliers))


def consensus(pairs: Pairs, options: ConsensusOptions, rng: np.random.Generator) -> list[Consensus]:
    """Return the rigid motions with the largest consensus, distinct ones only, the best first.

    Parameters
    ----------
    pairs
        Putative correspondences.
    rng
        Source of the random samples.

    Raises
    ------
    RegistrationError
        If no motion has enough inliers.
    """
    ranked: list[Consensus] = []
    if len(pairs) >= options.inliers:
        motions = (_sampled_motions if options.method == "samples" else _compatible_motions)(
            pairs, options, rng
        )
        ranked = [c for c in _ranked(pairs, motions, options) if c.count >= options.inliers]
    if not ranked:
        raise RegistrationError(
            f"of {len(pairs)} pairs of points not even {options.inliers} agree on a motion"
        )
    return ranked


def are_distinct(
    T: Float64, T_other: Float64, points: Float64, *, metres: float, rad: float
) -> bool:
    """Whether two motions (4, 4) differ by more than `metres` at the median of points, or `rad`."""
    centre = np.median(points, 0)[None]
    shift = np.linalg.norm(se3.transform(T, centre) - se3.transform(T_other, centre))
    angle = se3.angle(se3.inverse(T) @ T_other)
    return bool(shift > metres or angle > rad)


def motion_of(pairs: Pairs) -> Float64:
    """Return the weighted least squares motion (4, 4) (Arun et al. 1987, Umeyama 1991).

    Weights are inverse variances.
    """
    weight = 1 / pairs.variance
    return _motions(pairs.source[None], pairs.target[None], weight[None])[0]


def information_of(pairs: Pairs, T_target_source: Float64) -> Float64:
    """Return the information ``sum J^T J / v`` (6, 6), ``J = [I, -hat(p)]``: right perturbation.

    The variance v is that of the pairs, scaled up to that of the residuals if these are larger.
    """
    p = pairs.source
    residual = se3.transform(T_target_source, p) - pairs.target
    degrees_of_freedom = max(3 * len(p) - 6, 1)
    scale = max(1.0, float((residual**2 / pairs.variance[:, None]).sum()) / degrees_of_freedom)
    J = np.zeros((len(p), 3, 6))
    J[:, :, :3] = np.eye(3)
    J[:, 0, 4], J[:, 0, 5] = p[:, 2], -p[:, 1]
    J[:, 1, 3], J[:, 1, 5] = -p[:, 2], p[:, 0]
    J[:, 2, 3], J[:, 2, 4] = p[:, 1], -p[:, 0]
    weight = 1 / (scale * pairs.variance)
    return np.asarray(np.einsum("kai,kaj,k->ij", J, J, weight), np.float64)


def weakly_constrained_directions(information: Float64) -> Float64:
    """Return the unit directions (k, 6) whose sigma exceeds 1 cm or 1 degree."""
    values, vectors = np.linalg.eigh(information * _UNITS[:, None] * _UNITS)
    weak = vectors[:, values < 1].T * _UNITS
    return np.asarray(weak / np.linalg.norm(weak, axis=1, keepdims=True), np.float64)


def registration_of(pairs: Pairs, estimate: Consensus, margin: float) -> Registration:
    """Return a consensus as a registration: points are pairs, correspondences are inliers."""
    inliers = pairs.select(estimate.inliers)
    T = estimate.T_target_source
    distance = np.linalg.norm(se3.transform(T, inliers.source) - inliers.target, axis=1)
    information = information_of(inliers, T)
    typical_sigma = float(np.sqrt(np.median(pairs.variance)))
    return Registration(
        T_target_source=T,
        converged=True,
        iterations=estimate.hypotheses,
        correspondences=estimate.count,
        points=len(pairs),
        error=float(distance.sum() / (len(pairs) * typical_sigma)),
        rms_m=float(np.sqrt((distance**2).mean())),
        information=information,
        unobservable=weakly_constrained_directions(information),
        margin=margin,
    )


def _sampled_motions(pairs: Pairs, options: ConsensusOptions, rng: np.random.Generator) -> Float64:
    """Return the motions (k, 4, 4) of random triples that are congruent in both views."""
    n = len(pairs)
    required, drawn, max_inliers = float(options.most_samples), 0, 0
    motions = []
    while drawn < min(required, options.most_samples):
        drawn += _BATCH
        triples = rng.integers(0, n, (_BATCH, _SAMPLE_SIZE))
        a, b, c = triples.T
        triples = triples[(a != b) & (b != c) & (a != c)]
        triples = triples[_are_congruent(pairs, triples, options.sigmas)]
        if not len(triples):
            continue
        p, q = pairs.source[triples], pairs.target[triples]
        hypotheses = _motions(p, q, 1 / pairs.variance[triples])
        motions.append(hypotheses)
        max_inliers = max(
            max_inliers,
            int((_squared_residuals(pairs, hypotheses) < options.sigmas**2).sum(1).max()),
        )
        all_inliers = (max_inliers / n) ** _SAMPLE_SIZE
        if all_inliers > 0:
            required = math.log(1 - options.confidence) / math.log(max(1 - all_inliers, 1e-12))
    return np.concatenate(motions) if motions else np.zeros((0, 4, 4))


def _are_congruent(pairs: Pairs, triples: Int64, sigmas: float) -> Bool:
    """Whether triangles (k, 3) have equal sides in both views and are not degenerate, (k,)."""
    congruent = np.ones(len(triples), bool)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        i, j = triples[:, a], triples[:, b]
        source_side = np.linalg.norm(pairs.source[i] - pairs.source[j], axis=1)
        target_side = np.linalg.norm(pairs.target[i] - pairs.target[j], axis=1)
        sigma = np.sqrt(pairs.variance[i] + pairs.variance[j])
        congruent &= (np.abs(source_side - target_side) < sigmas * sigma) & (
            np.minimum(source_side, target_side) > _MIN_SIDE_SIGMAS * sigma
        )
    p = pairs.source[triples]
    sides = p[:, 1:] - p[:, :1]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    longest = np.maximum((sides**2).sum(2).max(1), 1e-12)
    return congruent & (area > _MIN_AREA_RATIO * longest)


def _compatible_motions(
    pairs: Pairs, options: ConsensusOptions, _rng: np.random.Generator
) -> Float64:
    """Return the motions (k, 4, 4) of sets of pairwise compatible pairs."""
    if len(pairs) > _MAX_COMPATIBLE_PAIRS:
        pairs = pairs.select(np.linspace(0, len(pairs) - 1, _MAX_COMPATIBLE_PAIRS).astype(np.int64))
    p, q = pairs.source, pairs.target
    source_distance, target_distance = (cdist(x, x) for x in (p, q))
    sigma = np.sqrt(pairs.variance[:, None] + pairs.variance)
    # Coincident points are compatible with the same pairs and don't constrain the rotation.
    separated = np.minimum(source_distance, target_distance) > 2 * options.sigmas * sigma
    compatible = (
        (np.abs(source_distance - target_distance) < options.sigmas * sigma) & separated
    ).astype(np.float32)
    second_order = compatible * (compatible @ compatible)
    seeds = np.argsort(-second_order.sum(1), kind="stable")[: options.seeds]
    set_size = min(_CONSENSUS_SIZE, len(pairs))
    motions = []
    for seed in seeds:
        row = second_order[seed]
        nearest = np.argsort(-row, kind="stable")[: set_size - 1]
        members = np.concatenate([[seed], nearest[row[nearest] > 0]])
        if len(members) < _SAMPLE_SIZE:
            continue
        motions.append(motion_of(pairs.select(members)))
    return np.stack(motions) if motions else np.zeros((0, 4, 4))


def _motions(p: Float64, q: Float64, weight: Float64) -> Float64:
    """Return least squares motions (k, 4, 4) of k lists of n pairs (k, n, 3), weights (k, n)."""
    relative = (weight / weight.sum(1, keepdims=True))[..., None]
    p0, q0 = (relative * p).sum(1), (relative * q).sum(1)
    H = np.einsum("kni,knj->kij", relative * (p - p0[:, None]), q - q0[:, None])
    U, _, Vt = np.linalg.svd(H)
    mirrored = np.linalg.det(U) * np.linalg.det(Vt) < 0
    Vt[mirrored, 2] *= -1
    R = np.einsum("kji,klj->kil", Vt, U)
    T = np.tile(np.eye(4), (len(p), 1, 1))
    T[:, :3, :3] = R
    T[:, :3, 3] = q0 - np.einsum("kij,kj->ki", R, p0)
    return T


def _squared_residuals(pairs: Pairs, motions: Float64) -> Float64:
    """Return the normalised squared residuals (k, m) of motions (k, 4, 4)."""
    transformed = (
        np.einsum("kij,mj->kmi", motions[:, :3, :3], pairs.source) + motions[:, None, :3, 3]
    )
    return np.asarray(((transformed - pairs.target) ** 2).sum(2) / pairs.variance, np.float64)


def _score(squared: Float64, sigmas: float) -> Float64:
    """Return the MSAC scores (k,) of squared residuals (k, m) (Torr and Zisserman 2000)."""
    return np.asarray(np.maximum(1 - squared / sigmas**2, 0).sum(-1), np.float64)


def _ranked(pairs: Pairs, motions: Float64, options: ConsensusOptions) -> list[Consensus]:
    """Return the distinct motions, the best first, each refined on its inliers."""
    remaining = np.ones(len(motions), bool)
    score = (
        _score(_squared_residuals(pairs, motions), options.sigmas) if len(motions) else np.zeros(0)
    )
    refined: list[Consensus] = []
    order = np.argsort(-score, kind="stable")
    for k in order:
        if not remaining[k]:
            continue
        remaining &= _are_distinct(motions, motions[k], pairs, options)
        T, inliers = _refined(pairs, motions[k], options.sigmas)
        refined_score = float(_score(_squared_residuals(pairs, T[None]), options.sigmas)[0])
        refined.append(Consensus(T, inliers, refined_score, len(motions)))
        if len(refined) == _MAX_REFINED:
            break
    distinct: list[Consensus] = []
    for candidate in sorted(refined, key=lambda c: -c.score):
        accepted = (
            np.stack([o.T_target_source for o in distinct]) if distinct else np.zeros((0, 4, 4))
        )
        if _are_distinct(accepted, candidate.T_target_source, pairs, options).all():
            distinct.append(candidate)
    return distinct


def _refined(pairs: Pairs, T: Float64, sigmas: float) -> tuple[Float64, Bool]:
    """Refine T by iterated least squares over its inliers; return the best motion and its mask."""
    best, best_score = T, -1.0
    for gate in _INLIER_GATES:
        squared = _squared_residuals(pairs, T[None])[0]
        score = float(_score(squared, sigmas))
        if score > best_score:
            best, best_score = T, score
        inliers = squared < (gate * sigmas) ** 2
        if np.count_nonzero(inliers) < _SAMPLE_SIZE:
            break
        T = motion_of(pairs.select(inliers))
    if float(_score(_squared_residuals(pairs, T[None])[0], sigmas)) > best_score:
        best = T
    return best, _squared_residuals(pairs, best[None])[0] < sigmas**2


def _are_distinct(motions: Float64, T: Float64, pairs: Pairs, options: ConsensusOptions) -> Bool:
    """Whether motions (k, 4, 4) are distinct from T (4, 4), (k,)."""
    centre = np.median(pairs.source, 0)
    ends = motions[:, :3, :3] @ centre + motions[:, :3, 3]
    end = T[:3, :3] @ centre + T[:3, 3]
    cosine = (np.einsum("kij,ij->k", motions[:, :3, :3], T[:3, :3]) - 1) / 2
    angle = np.arccos(np.clip(cosine, -1, 1))
    return (np.linalg.norm(ends - end, axis=1) > options.distinct_m) | (
        angle > options.distinct_rad
    )
