"""Registration of two clouds of unknown relative scale.

The source is tried at scales in small steps around that at which both have the same extent: at
each, features of the surroundings, whose size scales with it, are matched, and the matches must
agree on a motion (`clouds.fpfh`). The scales with the most such matches are refined by ICP of
points to planes over all seven parameters; of these the one counts at which most of *both* clouds
coincides, as a small cloud fits into any large one. At that scale the clouds are registered as any
others, where other scales are rivals.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from tofuse.engine.alignment import Registration
from tofuse.engine.arrays import Float64
from tofuse.engine.clouds.cloud_agreement import CloudMap, both_supports
from tofuse.engine.clouds.cloud_pair import register_clouds, scaled
from tofuse.engine.clouds.fpfh import POINTS, candidates
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import CloudFrame, Frame
from tofuse.engine.geometry import se3, unit_vectors
from tofuse.engine.icp import extent, reduced, spacing, surface_metrics
from tofuse.engine.search import pose_probability

# Scales relative to that of equal extents: a fourth to four times, in steps that matched features
# and distances between matches tolerate.
_RATIOS = np.geomspace(0.25, 4.0, 25)
# Points of each view that are described for a first idea, and that are compared; their resolution
# in spacings.
_COARSE_POINTS, _POINTS, _COARSER = 1200, 5000, 2.0
# Number of scales that are refined, and of poses at each.
_MAX_SCALES, _MAX_POSES = 5, 3
# Reach of the ICP in resolutions, from the first iteration to the last.
_REACHES = np.geomspace(6.0, 2.0, 25)
_MIN_NORMAL_COSINE = 0.7
# Scales that differ by more are distinct hypotheses.
_DISTINCT = 0.1
# Blocks along each axis that are left out in turn, for the variance of the scale.
_BLOCKS = 2


@dataclass(frozen=True, eq=False)
class Scaled:
    """A registration, and the source at the scale of the target, whose points it maps."""

    source: CloudFrame
    registration: Registration


@dataclass(frozen=True, eq=False)
class _Similarity:
    """q = T (scale p), and the harmonic mean of the fractions of both clouds that coincide."""

    scale: float
    T: Float64
    support: float = 0.0
    sigma: float = np.inf


def register_similar(source: Frame, target: Frame, rng: np.random.Generator) -> Scaled:
    """Register two clouds of unknown relative scale.

    Raises
    ------
    RegistrationError
        If the clouds fit at no scale.
    """
    found = sorted(_refined(source, target), key=lambda s: -s.support)
    if not found:
        raise RegistrationError(
            "fits the target at no scale", where=f"frame {source.index}", remedy="check the clouds"
        )
    best = found[0]
    rivals = [s for s in found if abs(np.log(s.scale / best.scale)) > _DISTINCT]
    at_scale = scaled(source, best.scale)
    registration = register_clouds(at_scale, target, None, rng)
    if rivals and best.support - rivals[0].support < pose_probability.MIN_LEAD:
        reason = (
            f"the clouds fit nearly as well with the source {rivals[0].scale:.3g} times as large"
        )
        probability = min(registration.probability or 0.0, 0.5)
        registration = replace(registration, believed=False, probability=probability, reason=reason)
    sigma = best.sigma if np.isfinite(best.sigma) else None
    return Scaled(at_scale, replace(registration, scale=best.scale, scale_sigma=sigma))


def _refined(source: Frame, target: Frame) -> Iterator[_Similarity]:
    """Yield similarities that were refined from the best hypotheses."""
    extents = extent(source.points), extent(target.points)
    if not min(extents) > 0:
        return
    unit = extents[1] / extents[0]
    coarse = [
        h for ratio in _RATIOS for h in _matched(source, target, unit * ratio, _COARSE_POINTS)
    ]
    for scale in _distinct_scales(sorted(coarse, key=lambda h: -h.support)):
        pair = _Pair.of(scaled(source, scale), target)
        for start in _matched(source, target, scale, POINTS):
            found = pair.refined(replace(start, scale=start.scale / scale))
            yield replace(found, scale=found.scale * scale, sigma=found.sigma * scale)


def _matched(source: Frame, target: Frame, scale: float, points: int) -> Iterator[_Similarity]:
    """Yield the similarities of matches near a scale; their support is the score of the matches."""
    try:
        found = candidates(scaled(source, scale), target, points=points)
    except RegistrationError:
        return
    for pose in found.poses[:_MAX_POSES]:
        pairs = found.pair.pairs.select(pose.consensus.inliers)
        spread = [np.linalg.norm(x - x.mean(0)) for x in (pairs.source, pairs.target)]
        factor = float(spread[1] / spread[0])
        T = pose.T_target_source.copy()
        # About the centroid: T (factor p) = factor R (p - c) + R c + t.
        T[:3, 3] += (1 - factor) * T[:3, :3] @ pairs.source.mean(0)
        yield _Similarity(scale * factor, T, pose.consensus.score)


def _distinct_scales(hypotheses: list[_Similarity]) -> list[float]:
    """Return the first distinct scales."""
    chosen: list[float] = []
    for h in hypotheses:
        if all(abs(np.log(h.scale / scale)) > _DISTINCT for scale in chosen):
            chosen.append(h.scale)
    return chosen[:_MAX_SCALES]


_Equations = tuple[Float64, Float64, Float64, Float64, float]


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two clouds averaged to one resolution."""

    source: CloudMap
    target: CloudMap

    @classmethod
    def of(cls, source: CloudFrame, target: Frame) -> _Pair:
        size = _COARSER * max(spacing(source), spacing(target))
        size, data, model = reduced(source, target, size, _POINTS)
        return cls(CloudMap.of(data, size, source), CloudMap.of(model, size, target))

    def refined(self, start: _Similarity) -> _Similarity:
        """Refine a similarity by ICP (Umeyama 1991 with distances to planes)."""
        T, scale = start.T, start.scale
        points = self.source.view.points.astype(np.float64)
        system = None
        for reach in _REACHES:
            system = self._equations(scale * points, T, reach * self.target.size)
            if system is None:
                return replace(start, support=0.0)
            J, r, weight, centre, size = system
            step = _solved(J, r, weight)
            T = se3.about(centre, se3.exp(step[:6] / np.r_[1, 1, 1, [size] * 3])) @ T
            growth = float(np.exp(step[6] / size))
            T[:3, 3] = growth * T[:3, 3] + (1 - growth) * centre
            scale *= growth
        if system is None:
            return start
        T = se3.orthonormalise(T)
        moved = CloudMap.of(
            replace(self.source.view, points=(points * scale).astype(np.float32)),
            self.source.size,
            self.source.view,
        )
        a, b = both_supports(moved, self.target, T)
        support = 2 * a * b / max(a + b, 1e-9)
        J, r, weight, _, size = system
        sigma = scale * _sigma(J, r, weight, points) / size
        return _Similarity(scale, T, support, sigma)

    def _equations(self, points: Float64, T: Float64, reach: float) -> _Equations | None:
        """Return J (n, 7) in m, residuals and weights (n,), their centroid and rms radius."""
        moved = se3.transform(T, points)
        nearest, _ = self.target.tree.nearest(moved, reach)
        normals = self.target.normals[np.maximum(nearest, 0)]
        own_normals = self.source.normals @ T[:3, :3].T
        cosine = (own_normals * normals).sum(1)
        matched = (nearest >= 0) & (np.abs(cosine) > _MIN_NORMAL_COSINE)
        if np.count_nonzero(matched) < surface_metrics.MIN_PAIRS:
            return None
        q = self.target.view.points[nearest[matched]].astype(np.float64)
        # With the mean normal, distances along a curved surface cancel (Rusinkiewicz 2019); with
        # one of both a convex body would grow.
        p = moved[matched]
        n = unit_vectors(normals[matched] + np.sign(cosine[matched, None]) * own_normals[matched])
        centre = p.mean(0)
        arm = p - centre
        size = float(np.sqrt((arm**2).sum(1).mean()))
        r = ((p - q) * n).sum(1)
        J = np.column_stack([n, np.cross(arm, n) / size, (arm * n).sum(1) / size])
        weight = surface_metrics.loss_weights("tukey", r, self.target.size)
        full = np.zeros(len(points))
        full[matched] = weight
        rows = np.zeros((len(points), 7))
        rows[matched] = J
        residuals = np.zeros(len(points))
        residuals[matched] = r
        return rows, residuals, full, centre, size


def _solved(J: Float64, r: Float64, weight: Float64) -> Float64:
    return np.asarray(
        -np.linalg.lstsq((J * weight[:, None]).T @ J, J.T @ (weight * r), rcond=1e-9)[0], np.float64
    )


def _sigma(J: Float64, r: Float64, weight: Float64, points: Float64) -> float:
    """Return the standard deviation of the seventh parameter by leaving out blocks of points.

    Errors of neighbouring points are correlated, those of distant blocks hardly (delete-a-group
    jackknife). The blocks are large, as those of plane fits at curved surfaces are correlated far.
    """
    low, high = points.min(0), points.max(0)
    cell = np.minimum((_BLOCKS * (points - low) / np.maximum(high - low, 1e-12)), _BLOCKS - 1)
    block = cell.astype(int) @ [_BLOCKS**2, _BLOCKS, 1]
    used = np.unique(block[weight > 0])
    estimates = [_solved(J, r, np.where(block == b, 0.0, weight))[6] for b in used]
    n = len(used)
    return float(np.sqrt((n - 1) / n * np.square(estimates - np.mean(estimates)).sum()))
