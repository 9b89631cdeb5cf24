"""How far the pose between two clouds can be trusted.

As for images (`registration.uncertainty`) the covariance is that of an M-estimate, ``X^-1 B X^-1``
(Huber 1981, ch. 6): X the slope of the gradient, from the product of both views' normals, in which
their noise cancels, and B the covariance of the gradient. Where clouds come from and what is wrong
with them is not known, so that B is learnt from the residuals at the final pose alone. Both clouds
are bent against each other, by multipath, an error over range, or by points
that stand for surfaces they are not quite on: a random field of displacements, whose parts along
any axis have the covariance ``s^2 exp(-d / l)`` over the distance d. On top of it is noise. A
residual is the displacement along its normal, plus noise.

What the field has in common with a motion the pose has taken up, and no residual shows it; but s
and l, learnt from what the pose could not take up, tell how large it is (restricted likelihood:
Patterson and Thompson 1971). They are not known exactly: the covariance is the mean over all of
them, by how likely they make the residuals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Float64
from tofuse.geometry import se3
from tofuse.registration.cloud_agreement import NEIGHBOURS, CloudMap
from tofuse.registration.pairs import (
    FEWEST_PAIRS,
    SurfacePairs,
    loss_weights,
    unobservable_directions,
)

# How far a point may be from the nearest one of its surface, in resolutions, and the cosine of the
# largest angle between their normals.
_NEAR, _ALIKE = 3.0, 0.75
# Patches: edge in resolutions at least, how many at most, and how many to learn from.
_EDGE, _LARGER = 2.0, 1.05
_MOST_PATCHES, _LEAST_PATCHES = 120, 12
# Variances of the field that are tried, relative to that of the noise of a patch.
_SHARES = np.r_[0.0, np.geomspace(0.03, 300.0, 9)]
# Lengths of correlation that are tried, from the patches' edge to this many sizes of the overlap:
# what bends a view may reach further than what both views share of it.
_LENGTHS, _FURTHEST = 5, 4.0
# Least slope of the gradient, as a share of what the matches and their weights say, and points of
# which it is measured.
_STEEPNESS, _TRIED = 0.1, 1500
# Residuals below this share of the resolution say nothing about the true error of the points.
_LEAST_SIGMA = 1e-3
# Sigma along directions that nothing holds, in sizes of the overlap, or in rad.
_UNBOUNDED = 100.0


def cloud_information(
    source: CloudMap, target: CloudMap, T_target_source: Float64, unobservable: Float64
) -> Float64:
    """(6, 6) information of a pose (4, 4), in 1/m and 1/rad, right perturbation in the source.

    The inverse of the covariance, but for the `unobservable` directions (k, 6): there is none along
    these, to speak of.
    """
    pairs = _Pairs.of(source, target, T_target_source)
    if pairs is None:
        size = max(float(np.linalg.norm(np.ptp(source.view.points, axis=0))), source.size)
        return np.diag((_UNBOUNDED * np.r_[[size] * 3, [1.0] * 3]) ** -2.0)
    shift = np.eye(4)
    shift[:3, 3] = -pairs.centre
    # From the perturbation about the origin to that about the centroid, in units in which turns
    # move the points as far as slides.
    unit = np.array([1, 1, 1, *[1 / pairs.size] * 3])
    to_centre = se3.adjoint(shift) / unit[:, None]
    slope = _slope(source, target, T_target_source, pairs, unit)
    H = to_centre.T @ _information(pairs, slope, unit, unobservable @ to_centre.T) @ to_centre
    return np.asarray(0.5 * (H + H.T), np.float64)


def cloud_unobservable(source: CloudMap, target: CloudMap, T_target_source: Float64) -> Float64:
    """(k, 6) directions of the right perturbation that two clouds don't hold at a pose (4, 4)."""
    pairs = _Pairs.of(source, target, T_target_source)
    if pairs is None:
        return np.eye(6)
    surface = SurfacePairs(
        T_target_source,
        pairs.centre,
        pairs.points,
        pairs.residual[:, None] * pairs.normals,
        pairs.target_normals,
        pairs.source_normals,
        pairs.weight,
        pairs.resolution,
    )
    return unobservable_directions(surface, pairs.noise**2)


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Points of the source and what they miss the target by, in the source's frame.

    Attributes
    ----------
    centre, size
        (3,) centroid of the points, and their rms distance from it, m.
    points
        (m, 3) relative to it.
    residual
        (m,) distance along the normal, m.
    normals, target_normals, source_normals
        (m, 3) mean of both, and each; all to one side.
    weight
        (m,) of the robust loss.
    resolution
        m.
    """

    centre: Float64
    size: float
    points: Float64
    residual: Float64
    normals: Float64
    target_normals: Float64
    source_normals: Float64
    weight: Float64
    resolution: float

    @classmethod
    def of(cls, source: CloudMap, target: CloudMap, T: Float64, every: int = 1) -> _Pairs | None:
        """Match every so manieth point with the nearest of the target; None if few are near."""
        size = max(source.size, target.size)
        p = source.view.points[::every].astype(np.float64)
        nearest, _ = target.tree.nearest(se3.transform(T, p), _NEAR * size)
        R, j = T[:3, :3], np.maximum(nearest, 0)
        a, b = target.normals[j] @ R, source.normals[::every]
        q = se3.transform(se3.inverse(T), target.view.points[j].astype(np.float64))
        together = (a * b).sum(1)
        good = (nearest >= 0) & (np.abs(together) > _ALIKE)  # nan is not
        if np.count_nonzero(good) < FEWEST_PAIRS:
            return None
        p, q, a = p[good], q[good], a[good]
        b = b[good] * np.sign(together[good])[:, None]
        # Of a normal and its opposite the one with its largest component positive.
        n = a + b
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        largest = np.take_along_axis(n, np.abs(n).argmax(1)[:, None], 1)
        n, a, b = (v * np.sign(largest) for v in (n, a, b))
        r = ((p - q) * n).sum(1)
        centre = p.mean(0)
        p = p - centre
        spread = max(float(np.sqrt((p**2).sum(1).mean())), size)
        return cls(centre, spread, p, r, n, a, b, loss_weights("tukey", r, size), size)

    @property
    def noise(self) -> float:
        """Robust standard deviation of the residuals, m."""
        return max(1.4826 * float(np.median(np.abs(self.residual))), _LEAST_SIGMA * self.resolution)

    def kept(self, unit: Float64) -> Float64:
        """(6, 6) sum of w times the symmetrised product of both Jacobians: noise cancels in it."""
        Ja = _jacobian(self.points, self.target_normals) * unit
        Jb = _jacobian(self.points, self.source_normals) * unit
        X = (Ja * self.weight[:, None]).T @ Jb
        return np.asarray(0.5 * (X + X.T), np.float64)

    def weighed(self, unit: Float64) -> Float64:
        """(6, 6) sum of w J^T J."""
        J = _jacobian(self.points, self.normals) * unit
        return np.asarray((J * self.weight[:, None]).T @ J, np.float64)

    def gradient(self, centre: Float64, unit: Float64) -> Float64:
        """(6,) sum of w J r, about another centre (3,)."""
        J = _jacobian(self.points + (self.centre - centre), self.normals) * unit
        return np.asarray((self.weight * self.residual) @ J, np.float64)


def _jacobian(points: Float64, normals: Float64) -> Float64:
    """(m, 6) derivative of the distances along normals (m, 3) by the right perturbation."""
    return np.concatenate([normals, np.cross(points, normals)], axis=1)


@dataclass(frozen=True, eq=False)
class _Patches:
    """Means over patches of the overlap.

    Attributes
    ----------
    places, normals
        (n, 3) m, and mean normals, shorter than 1 where the surface is bent.
    residual
        (n,) m.
    responses
        (n, 6) mean J.
    weight
        (n,) sums of w.
    edge
        Of the patches, m.
    """

    places: Float64
    normals: Float64
    residual: Float64
    responses: Float64
    weight: Float64
    edge: float

    @classmethod
    def of(cls, pairs: _Pairs, unit: Float64) -> _Patches:
        """Divide the points into cubes, and those of a cube by the axis that their normals face."""
        facing = np.abs(pairs.normals).argmax(1).astype(np.int64)
        edge = _EDGE * pairs.resolution
        while True:
            cell = np.floor(pairs.points / edge).astype(np.int64)
            cell -= cell.min(0)
            _, rows, layers = cell.max(0) + 1
            key = ((cell[:, 0] * rows + cell[:, 1]) * layers + cell[:, 2]) * 3 + facing
            patch = np.unique(key, return_inverse=True)[1]
            count = int(patch.max()) + 1
            if count <= _MOST_PATCHES:
                break
            edge *= _LARGER * float(np.sqrt(count / _MOST_PATCHES))
        total = np.bincount(patch, pairs.weight)
        told = total > 0

        def mean(values: Float64) -> Float64:
            columns = values.reshape(len(values), -1).T
            sums = [np.bincount(patch, pairs.weight * c) for c in columns]
            return np.stack(sums, -1)[told] / total[told, None]

        J = _jacobian(pairs.points, pairs.normals) * unit
        return cls(
            mean(pairs.points),
            mean(pairs.normals),
            mean(pairs.residual)[:, 0],
            mean(J),
            np.asarray(total[told], np.float64),
            edge,
        )


def _information(pairs: _Pairs, slope: Float64, unit: Float64, free: Float64) -> Float64:
    """(6, 6) about the centroid, without directions (k, 6) that are free."""
    held = np.eye(6)
    H = np.zeros((6, 6))
    if len(free):
        _, s, vt = np.linalg.svd(free)
        count = int((s > 1e-9 * s[0]).sum())
        held = vt[count:].T
        H += vt[:count].T @ vt[:count] / (_UNBOUNDED * pairs.size) ** 2
    if not held.shape[1]:
        return H
    patches = _Patches.of(pairs, unit)
    if len(patches.residual) >= _LEAST_PATCHES:
        meat = _learnt(patches, patches.responses @ held)
    else:  # nothing can be learnt of what they share: as few independent points as there may be
        meat = NEIGHBOURS * pairs.noise**2 * held.T @ pairs.weighed(unit) @ held
    bread = np.linalg.inv(held.T @ slope @ held)
    # A pose that was found in another way differs from where the points would take it: half of the
    # square is the variance that two estimates of the same share.
    step = bread @ held.T @ pairs.gradient(pairs.centre, unit)
    C = bread @ meat @ bread + 0.5 * np.outer(step, step)
    C += (_LEAST_SIGMA * pairs.resolution) ** 2 / len(pairs.points) * np.eye(len(C))
    return np.asarray(H + held @ np.linalg.inv(C) @ held.T, np.float64)


def _slope(source: CloudMap, target: CloudMap, T: Float64, pairs: _Pairs, unit: Float64) -> Float64:
    """X (6, 6): how the gradient ``sum w J r`` changes with the pose, points matched anew.

    Where noise is as large as the spacing of the points, each finds a nearest one that it misses by
    less, wherever the pose is: the gradient is less steep than its matches say. So it is measured.
    """
    every = max(1, len(source.view.points) // _TRIED)
    to, back = np.eye(4), np.eye(4)
    to[:3, 3], back[:3, 3] = pairs.centre, -pairs.centre
    weighed, kept = pairs.weighed(unit), pairs.kept(unit)
    values, vectors = np.linalg.eigh(weighed)
    values = np.maximum(values, 1e-9 * values[-1])
    root, inverse = (vectors * np.sqrt(values)) @ vectors.T, (vectors / np.sqrt(values)) @ vectors.T
    step = pairs.noise
    measured = np.zeros((6, 6))
    total = 0.0
    for k, direction in enumerate(vectors.T):
        ends = []
        for sign in (1.0, -1.0):
            moved = T @ to @ se3.exp(sign * step * direction * unit) @ back
            there = _Pairs.of(source, target, moved, every)
            if there is None:
                break
            ends.append(there.gradient(pairs.centre, unit))
            total += float(there.weight.sum()) / 12
        if len(ends) == 2:
            measured[:, k] = (ends[0] - ends[1]) / (2 * step)
    measured = measured @ vectors.T * (pairs.weight.sum() / max(total, 1e-12))
    steep = _bounded(inverse @ (0.5 * (measured + measured.T)) @ inverse, _STEEPNESS)
    real = _bounded(inverse @ kept @ inverse, _STEEPNESS)
    values, vectors = np.linalg.eigh(real)
    half = (vectors * np.sqrt(values)) @ vectors.T
    return np.asarray(root @ half @ steep @ half @ root, np.float64)


def _bounded(S: Float64, least: float) -> Float64:
    """A symmetric matrix with eigenvalues from `least` to 1."""
    values, vectors = np.linalg.eigh(S)
    return np.asarray((vectors * np.clip(values, least, 1.0)) @ vectors.T, np.float64)


def _learnt(patches: _Patches, J: Float64) -> Float64:
    """Mean of ``J^T W V W J`` over the covariances V that the residuals make likely."""
    n, held = J.shape
    root = np.sqrt(patches.weight)
    y, A = root * patches.residual, root[:, None] * J
    apart = np.linalg.norm(patches.places[:, None] - patches.places, axis=2)
    along = (patches.normals @ patches.normals.T) * np.outer(root, root) / np.mean(root**2)
    largest = max(_FURTHEST * float(np.percentile(apart, 90)), 2 * patches.edge)
    freedom = max(n - held, 1)
    likely, meat = [], []
    for length in np.geomspace(patches.edge, largest, _LENGTHS):
        values, vectors = np.linalg.eigh(along * np.exp(-apart / length))
        values = np.maximum(values, 0.0)
        seen, at = vectors.T @ y, vectors.T @ A
        noise, field = at.T @ at, (at.T * values) @ at
        for share in _SHARES:
            variance = 1 + share * values
            inner = (at.T / variance) @ at
            fit = np.linalg.pinv(inner, hermitian=True) @ ((at.T / variance) @ seen)
            square = float(((seen - at @ fit) ** 2 / variance).sum())
            logs = np.log(variance).sum() + np.linalg.slogdet(inner)[1]
            likely.append(-0.5 * logs - 0.5 * freedom * np.log(max(square, 1e-300)))
            # The scale's posterior mean, with the prior 1 / scale.
            meat.append((noise + share * field) * square / max(freedom - 2, 1))
    weight = np.exp(np.array(likely) - max(likely))
    return np.asarray(np.tensordot(weight / weight.sum(), np.array(meat), 1), np.float64)
