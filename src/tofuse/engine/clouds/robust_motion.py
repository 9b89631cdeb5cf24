"""Robust estimation of a rigid motion from point pairs with outliers.

Inliers preserve distances, so that they are pairwise compatible. The pairs that share the most
compatible pairs are grouped (second-order compatibility: Chen et al. 2022, "SC2-PCR"), and each
group gives a motion. This is deterministic, and one inlier in fifty pairs is enough.

Residuals are normalised by each pair's own standard deviation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.spatial.distance import cdist

from tofuse.engine.arrays import Bool, Float64, Int64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.errors import RegistrationError
from tofuse.engine.geometry import se3

# Number of pairs that determine a motion.
MIN_PAIRS = 3
# Inlier threshold of each round of least squares, relative to the final one: wide at first, as the
# motion of a minimal sample is inaccurate.
_INLIER_GATES = (2.0, 1.5, 1.0, 1.0, 1.0)
# Maximum number of distinct motions that are refined before they are ranked.
_MAX_REFINED = 120
# Motions whose residuals are computed at once.
_BATCH = 256
# Size of the consensus set of a seed (SC2-PCR: its nearest neighbours in compatibility). Where
# views overlap little, right matches are so few that larger sets would contain outliers.
_CONSENSUS_SIZE = 8
# Maximum number of pairs in the compatibility matrix, whose memory is quadratic.
_MAX_COMPATIBLE_PAIRS = 2000


@dataclass(frozen=True)
class ConsensusOptions(Bounded):
    """Options of the consensus search.

    Attributes
    ----------
    sigmas
        Inlier threshold, in standard deviations of the pair.
    inliers
        Minimum number of inliers of a motion.
    seeds
        Maximum number of seeds of consensus sets.
    distinct_m, distinct_rad
        Motions that differ by more are distinct hypotheses.
    """

    sigmas: Annotated[float, Bounds(0, 1000, exclusive=True)] = 3.0
    inliers: Annotated[int, Bounds(3, 1_000_000)] = 6
    seeds: Annotated[int, Bounds(1, 1_000_000)] = 100
    distinct_m: Annotated[float, Bounds(0, exclusive=True)] = 0.1
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


Motions = Callable[[Pairs], Float64]


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


def consensus(
    pairs: Pairs, options: ConsensusOptions, motions: Motions | None = None
) -> list[Consensus]:
    """Return the rigid motions with the largest consensus, distinct ones only, the best first.

    Parameters
    ----------
    pairs
        Putative correspondences.
    motions
        Function that returns the motions (k, 4, 4) to choose from; None for those of sets of
        pairwise compatible pairs.

    Raises
    ------
    RegistrationError
        If no motion has enough inliers.
    """
    ranked: list[Consensus] = []
    if len(pairs) >= options.inliers:
        found = _compatible_motions(pairs, options) if motions is None else motions(pairs)
        ranked = [c for c in _ranked(pairs, found, options) if c.count >= options.inliers]
    if not ranked:
        raise RegistrationError(
            f"of {len(pairs)} pairs of points not even {options.inliers} agree on a motion"
        )
    return ranked


def are_distinct(
    motions: Float64, T: Float64, points: Float64, *, metres: float, rad: float
) -> Bool:
    """Whether each motion differs from another one by more than a distance or an angle, (k,).

    Parameters
    ----------
    motions, T
        (k, 4, 4), and (4, 4).
    points
        (n, 3) points that are moved, m.
    metres
        Distance at the median of the points.
    rad
        Angle between the rotations.
    """
    centre = np.median(points, 0)
    shift = motions[:, :3, :3] @ centre + motions[:, :3, 3] - se3.transform(T, centre[None])
    angle = se3.angle(se3.inverse(motions) @ T)
    return (np.linalg.norm(shift, axis=1) > metres) | (angle > rad)


def _compatible_motions(pairs: Pairs, options: ConsensusOptions) -> Float64:
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
    rows = second_order[seeds]
    size = min(_CONSENSUS_SIZE, len(pairs)) - 1
    members = np.argpartition(-rows, size - 1, axis=1)[:, :size]
    weight = (np.take_along_axis(rows, members, 1) > 0).astype(float)
    enough = weight.sum(1) >= MIN_PAIRS - 1
    members = np.column_stack([seeds, members])[enough]
    weight = np.column_stack([np.ones(len(seeds)), weight])[enough] / pairs.variance[members]
    return motions_of(p[members], q[members], weight)


def motions_of(p: Float64, q: Float64, weight: Float64) -> Float64:
    """Return least squares motions (k, 4, 4) of k lists of n pairs (k, n, 3), weights (k, n).

    After Arun et al. (1987) and Umeyama (1991).
    """
    relative = (weight / weight.sum(1, keepdims=True))[..., None]
    p0, q0 = (relative * p).sum(1), (relative * q).sum(1)
    H = np.einsum("kni,knj->kij", relative * (p - p0[:, None]), q - q0[:, None])
    return _motions_from(H, p0, q0)


def _motions_from(H: Float64, p0: Float64, q0: Float64) -> Float64:
    """Return motions (k, 4, 4) from covariances (k, 3, 3) and centroids (k, 3) of the pairs."""
    R = se3.nearest_rotation(np.swapaxes(H, 1, 2))
    return se3.pose(R, q0 - np.einsum("kij,kj->ki", R, p0))


def squared_residuals(pairs: Pairs, motions: Float64) -> Float64:
    """Return the normalised squared residuals (k, m) of motions (k, 4, 4)."""
    residual = se3.transform(motions, pairs.source) - pairs.target
    return np.einsum("kmi,kmi->km", residual, residual) / pairs.variance


def distinct(
    motions: Float64, score: Float64, points: Float64, options: ConsensusOptions, most: int
) -> Int64:
    """Return the positions of at most `most` distinct motions (k, 4, 4), highest scores (k,) first.

    Parameters
    ----------
    points
        (n, 3) points that are moved, m.
    """
    moved = se3.transform(motions, np.median(points, 0)[None])[:, 0]
    rotations = motions[:, :3, :3].reshape(-1, 9)
    alike = cdist(moved, moved) <= options.distinct_m
    alike &= rotations @ rotations.T >= 1 + 2 * np.cos(options.distinct_rad)  # traces
    return unlike(alike, np.argsort(-score, kind="stable"))[:most]


def unlike(alike: Bool, order: Int64) -> Int64:
    """Return the positions in an order, without those alike (n, n) to one before."""
    remaining, chosen = np.ones(len(alike), bool), list[int]()
    for k in order:
        if remaining[k]:
            chosen.append(int(k))
            remaining &= ~alike[k]
    return np.array(chosen, np.int64)


def _score(squared: Float64, sigmas: float) -> Float64:
    """Return the MSAC scores (k,) of squared residuals (k, m) (Torr and Zisserman 2000)."""
    return np.asarray(np.maximum(1 - squared / sigmas**2, 0).sum(-1), np.float64)


def match_scores(pairs: Pairs, motions: Float64, sigmas: float) -> Float64:
    """Return the MSAC scores (k,) of motions (k, 4, 4)."""
    batches = [motions[k : k + _BATCH] for k in range(0, len(motions), _BATCH)]
    scores = [_score(squared_residuals(pairs, batch), sigmas) for batch in batches]
    return np.concatenate(scores) if scores else np.zeros(0)


def _ranked(pairs: Pairs, motions: Float64, options: ConsensusOptions) -> list[Consensus]:
    """Return the distinct motions, the best first, each refined on its inliers."""
    count, sigmas = len(motions), options.sigmas
    score = match_scores(pairs, motions, sigmas)
    motions = motions[distinct(motions, score, pairs.source, options, _MAX_REFINED)]
    motions = refined(pairs, motions, sigmas)
    score = match_scores(pairs, motions, sigmas)
    return [
        Consensus(
            motions[k],
            squared_residuals(pairs, motions[k : k + 1])[0] < sigmas**2,
            float(score[k]),
            count,
        )
        for k in distinct(motions, score, pairs.source, options, _MAX_REFINED)
    ]


def refined(pairs: Pairs, motions: Float64, sigmas: float) -> Float64:
    """Refine motions (k, 4, 4) by iterated least squares over their inliers."""
    best, best_score = motions.copy(), match_scores(pairs, motions, sigmas)
    for gate in _INLIER_GATES:
        inliers = squared_residuals(pairs, motions) < (gate * sigmas) ** 2
        motions = np.where(
            (np.count_nonzero(inliers, axis=1) >= MIN_PAIRS)[:, None, None],
            _weighted_motions(pairs, inliers / pairs.variance),
            motions,
        )
        score = match_scores(pairs, motions, sigmas)
        better = score > best_score
        best[better], best_score[better] = motions[better], score[better]
    return best


def _weighted_motions(pairs: Pairs, weight: Float64) -> Float64:
    """Return least squares motions (k, 4, 4) of all pairs with different weights (k, m)."""
    relative = weight / np.maximum(weight.sum(1, keepdims=True), 1e-300)
    p0, q0 = pairs.source.mean(0), pairs.target.mean(0)
    p, q = pairs.source - p0, pairs.target - q0
    p_mean, q_mean = relative @ p, relative @ q
    products = relative @ (p[:, :, None] * q[:, None]).reshape(-1, 9)
    H = products.reshape(-1, 3, 3) - p_mean[:, :, None] * q_mean[:, None]
    return _motions_from(H, p_mean + p0, q_mean + q0)
