"""Poses of clouds by feature matching, also where nearly all matches are wrong.

Sets of compatible matches (`clouds.robust_motion`) have the right rotation more often than the
right pose. At a rotation each match gives a translation, and those of right matches coincide; so
matches need not be as selected: each point has several, mutual or not. All poses are then settled
by a few steps of ICP, and ranked by how well the views fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.clouds.fpfh import SEEDS, MatchedPair, fitting, matched, most_similar
from tofuse.engine.clouds.robust_motion import (
    ConsensusOptions,
    consensus,
    distinct,
    refined,
    unlike,
)
from tofuse.engine.frames import Frame
from tofuse.engine.geometry import se3

# Points of the source that vote, and matches of each.
_VOTERS, _VOTES = 2000, 5
# Minimum cosine between the normals of matched points.
_MIN_NORMAL_COSINE = 0.85
# Angle (rad) below which a rotation is taken for another one, edge of the cells that are voted for
# in resolutions, and translations of each rotation.
_SAME_RAD, _CELL, _TRANSLATIONS = 0.26, 2.0, 3
# Fullest cells that may be in the middle of a peak.
_FULLEST = 64
# Poses that are settled, points of the source, and the reach of each step in resolutions.
_SETTLED, _SETTLED_POINTS, _REACHES = 60, 300, (4.0, 4.0, 3.0, 3.0, 2.0)
# Damping of a step relative to the mean information: few points leave some motions open.
_DAMPING = 0.01
_AROUND = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3, indexing="ij"), -1).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Proposals:
    """Distinct poses T_target_source (k, 4, 4), in order of their scores."""

    pair: MatchedPair
    motions: Float64


def proposals(source: Frame, target: Frame, *, signed: bool) -> Proposals:
    """Return poses at which features of two views match.

    Parameters
    ----------
    source, target
        Views.
    signed
        Whether the orientation of the normals is known, from the views' origins.

    Raises
    ------
    RegistrationError
        If too few matches agree on a motion.
    """
    pair = matched(source, target, signed=signed, options=ConsensusOptions(seeds=SEEDS))
    compatible = consensus(pair.pairs, pair.options)
    motions = np.array([c.T_target_source for c in compatible])
    voted = refined(pair.pairs, _voted(pair, motions[:, :3, :3]), pair.options.sigmas)
    motions, score = _best(pair, np.concatenate([motions, voted]))
    settled = motions
    for reach in _REACHES:
        settled = _settled(pair, settled, reach * pair.size)
    after, _ = pair.evaluated(settled)
    motions = np.where((after > score)[:, None, None], settled, motions)
    score = np.maximum(after, score)
    return Proposals(pair, motions[_distinct(pair, motions, score)])


def _best(pair: MatchedPair, motions: Float64) -> tuple[Float64, Float64]:
    """Return the distinct motions with the highest scores, and these."""
    score, _ = pair.evaluated(motions)
    best = _distinct(pair, motions, score)
    return motions[best], score[best]


def _distinct(pair: MatchedPair, motions: Float64, score: Float64) -> Int64:
    return distinct(motions, score, pair.source.points, pair.options, _SETTLED)


def _voted(pair: MatchedPair, rotations: Float64) -> Float64:
    """Return the motions (k, 4, 4) that most matches agree with at some of the rotations."""
    i = np.arange(0, len(pair.source.points), max(1, len(pair.source.points) // _VOTERS))
    j = most_similar(pair.source.histograms[i], pair.target.histograms, _VOTES)
    i, j = np.repeat(i, j.shape[1]), j.ravel()
    points, normals = pair.source.points[i], pair.source.normals[i]
    matched_points, matched_normals = pair.target.points[j], pair.target.normals[j]
    motions = [np.zeros((0, 4, 4))]
    for R in _distinct_rotations(rotations):
        cosine = ((normals @ R.T) * matched_normals).sum(1)
        agree = (cosine if pair.target.sphere is not None else np.abs(cosine)) > _MIN_NORMAL_COSINE
        votes = matched_points[agree] - points[agree] @ R.T
        peaks = _peaks(votes, _CELL * pair.size)
        motions.append(se3.pose(np.broadcast_to(R, (len(peaks), 3, 3)), peaks))
    return np.concatenate(motions)


def _distinct_rotations(rotations: Float64) -> Float64:
    """Return the rotations (m, 3, 3) that differ from all before them."""
    flat = rotations.reshape(-1, 9)
    alike = flat @ flat.T > 1 + 2 * np.cos(_SAME_RAD)  # traces
    return rotations[unlike(alike, np.arange(len(flat)))]


def _peaks(votes: Float64, edge: float) -> Float64:
    """Return the places (k, 3) where votes (n, 3) are densest: their means in blocks of cells."""
    if not len(votes):
        return np.zeros((0, 3))
    cells = np.floor((votes - votes.min(0)) / edge).astype(np.int64) + 1
    strides = np.array([1, *np.cumprod(cells.max(0) + 2)[:2]])
    keys, first, counts = np.unique(cells @ strides, return_index=True, return_counts=True)
    fullest = np.argsort(-counts, kind="stable")[:_FULLEST]
    around = keys[fullest, None] + _AROUND @ strides
    at = np.minimum(np.searchsorted(keys, around), len(keys) - 1)
    total = np.where(keys[at] == around, counts[at], 0).sum(1)
    centres = cells[first[fullest[np.argsort(-total, kind="stable")]]]
    peaks = list[Float64]()
    while len(centres) and len(peaks) < _TRANSLATIONS:
        peaks.append(votes[(np.abs(cells - centres[0]) <= 1).all(1)].mean(0))
        centres = centres[(np.abs(centres - centres[0]) > 2).any(1)]
    return np.array(peaks)


def _settled(pair: MatchedPair, motions: Float64, reach_m: float) -> Float64:
    """Return motions (k, 4, 4) after a step of point-to-plane ICP with Tukey's weights."""
    points, nearest, fit = fitting(
        pair.source.thinned(_SETTLED_POINTS), pair.target, motions, reach_m
    )
    normals, weight = pair.target.normals[nearest], fit**2
    residuals = ((points - pair.target.points[nearest]) * normals).sum(2)
    total = np.maximum(weight.sum(1), np.finfo(float).tiny)[:, None]
    centre = (weight[..., None] * points).sum(1) / total
    arms = points - centre[:, None]
    radius = pair.size + np.sqrt((weight * (arms**2).sum(2)).sum(1) / total[:, 0])[:, None, None]
    J = np.concatenate([normals, np.cross(arms / radius, normals)], 2)
    information = J.swapaxes(1, 2) @ (weight[..., None] * J)
    information += _DAMPING * (total[..., None] + 1) * np.eye(6)
    step = np.linalg.solve(information, J.swapaxes(1, 2) @ (weight * residuals)[..., None])[..., 0]
    step[:, 3:] /= radius[:, 0]
    T_target_centre = se3.pose(np.broadcast_to(np.eye(3), (len(motions), 3, 3)), centre)
    return T_target_centre @ se3.exp(-step) @ se3.inverse(T_target_centre) @ motions
