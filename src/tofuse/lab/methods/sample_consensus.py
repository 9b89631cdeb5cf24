"""Rigid motions of point pairs from random samples (RANSAC).

RANSAC (Fischler and Bolles 1981; section 2.5.2 of the thesis) draws random triples until one of
them is free of outliers with the required confidence. With few inliers, such as one in fifty, that
takes too many samples (`clouds.robust_motion` takes sets of compatible pairs instead).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

import numpy as np

from tofuse.engine.alignment import Registration, projective
from tofuse.engine.arrays import Bool, Float64, Int64
from tofuse.engine.bounds import Bounds
from tofuse.engine.clouds import robust_motion
from tofuse.engine.geometry import se3, unit_vectors

Method = Literal["samples", "compatible"]

_BATCH = 256
# Minimum ratio of a sampled triangle's area to its squared side: thin ones don't constrain the
# rotation.
_MIN_AREA_RATIO = 0.1
# Minimum side of a sampled triangle, in standard deviations of its length.
_MIN_SIDE_SIGMAS = 4.0


@dataclass(frozen=True)
class SampleOptions(robust_motion.ConsensusOptions):
    """Options of the consensus search, with a choice of the method.

    Attributes
    ----------
    method
        "samples": RANSAC; "compatible": second-order compatibility.
    confidence
        Probability that at least one of the drawn samples is free of outliers.
    most_samples
        Maximum number of samples.
    """

    method: Method = "samples"
    confidence: Annotated[float, Bounds(0, 1, exclusive=True)] = 0.999
    most_samples: Annotated[int, Bounds(1, 1_000_000)] = 5000

    def motions(self, rng: np.random.Generator) -> robust_motion.Motions | None:
        """Return the function that proposes motions, see `consensus`; it draws from `rng`."""
        return (
            partial(_sampled_motions, options=self, rng=rng) if self.method == "samples" else None
        )


def information_of(pairs: robust_motion.Pairs, T_target_source: Float64) -> Float64:
    """Return the information ``sum J^T J / v`` (6, 6), ``J = [I, -hat(p)]``: right perturbation.

    The variance v is that of the pairs, scaled up to that of the residuals if these are larger.
    """
    p = pairs.source
    residual = se3.transform(T_target_source, p) - pairs.target
    degrees_of_freedom = max(3 * len(p) - 6, 1)
    scale = max(1.0, float((residual**2 / pairs.variance[:, None]).sum()) / degrees_of_freedom)
    J = se3.point_jacobian(p)
    return np.asarray(np.einsum("kai,kaj,k->ij", J, J, 1 / (scale * pairs.variance)), np.float64)


def weakly_constrained_directions(information: Float64) -> Float64:
    """Return the unit directions (k, 6) whose sigma exceeds 1 cm or 1 degree."""
    values, vectors = np.linalg.eigh(information * projective.UNITS[:, None] * projective.UNITS)
    return unit_vectors(vectors[:, values < 1].T * projective.UNITS)


def registration_of(
    pairs: robust_motion.Pairs, estimate: robust_motion.Consensus, margin: float
) -> Registration:
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


def _sampled_motions(
    pairs: robust_motion.Pairs, options: SampleOptions, rng: np.random.Generator
) -> Float64:
    """Return the motions (k, 4, 4) of random triples that are congruent in both views."""
    n = len(pairs)
    required, drawn, max_inliers = float(options.most_samples), 0, 0
    motions = []
    while drawn < min(required, options.most_samples):
        drawn += _BATCH
        triples = rng.integers(0, n, (_BATCH, robust_motion.MIN_PAIRS))
        a, b, c = triples.T
        triples = triples[(a != b) & (b != c) & (a != c)]
        triples = triples[_are_congruent(pairs, triples, options.sigmas)]
        if not len(triples):
            continue
        p, q = pairs.source[triples], pairs.target[triples]
        hypotheses = robust_motion.motions_of(p, q, 1 / pairs.variance[triples])
        motions.append(hypotheses)
        max_inliers = max(
            max_inliers,
            int(
                (robust_motion.squared_residuals(pairs, hypotheses) < options.sigmas**2)
                .sum(1)
                .max()
            ),
        )
        all_inliers = (max_inliers / n) ** robust_motion.MIN_PAIRS
        if all_inliers > 0:
            required = math.log(1 - options.confidence) / math.log(max(1 - all_inliers, 1e-12))
    return np.concatenate(motions) if motions else np.zeros((0, 4, 4))


def _are_congruent(pairs: robust_motion.Pairs, triples: Int64, sigmas: float) -> Bool:
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
