"""The surfaces known so far, and what views of them would tell of each other's pose.

A surface is a set of points with normals. A view sees those that are in its field and not behind
others. A pair of views measures how far each point that both see lies from the other's surface, and
less accurately where it lies along it, by its brightness: information of two kinds, whose scales
the pairs of the recording show (`scales`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from tofuse.engine.arrays import Float32, Float64, Intp
from tofuse.engine.geometry import se3
from tofuse.engine.stored_views import PosedView, sampled_points
from tofuse.engine.views import PreparedView, residual_kernels

# Points of a view and of all surfaces; their spacing as a fraction of the reach.
_VIEW_POINTS, _MAX_POINTS, _SPACING = 120, 3000, 0.04
# Cells of a view's depth image; a point is hidden behind one that is nearer by this fraction.
_CELLS, _BEHIND = np.array([16, 12]), 0.1
_MIN_COSINE, _MIN_FRACTION_OF_REACH = 0.15, 0.03
# Half widths of the field of a camera that is not known, as x/z and y/z.
_USUAL_FIELD = np.array([[-0.58, -0.43], [0.58, 0.43]])
# Relative to the strongest direction, information below this is noise.
_NOISE = 1e-6


@dataclass(frozen=True, eq=False)
class Seen:
    """What M views see of P points.

    Attributes
    ----------
    pixels
        (M, P) number of pixels on each point, up to a factor; 0 if it is not seen.
    information
        (M, P) the same over the variance of their depth, which grows with the square of the depth.
    """

    pixels: Float32
    information: Float32

    def of(self, rows: Sequence[int] | Intp) -> Seen:
        """Return that of some views."""
        return Seen(self.pixels[rows], self.information[rows])

    def overlap(self, other: Seen) -> Float64:
        """(M, N) overlap with other views: the smaller of both fractions that the other sees."""
        fractions = []
        for a, b in ((self.pixels, other.pixels), (other.pixels, self.pixels)):
            total = np.maximum(a.sum(1, keepdims=True), 1e-9)
            fractions.append((a / total) @ (b > 0).astype(np.float32).T)
        return np.minimum(fractions[0], fractions[1].T).astype(np.float64)


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Points of all surfaces.

    Attributes
    ----------
    points, normals
        (P, 3), normals away from the cameras.
    reach_m
        Largest depth at which surfaces are measured.
    field
        (2, 2) smallest and largest x/z, y/z of the camera's pixels.
    """

    points: Float32
    normals: Float32
    reach_m: float
    field: Float64

    @classmethod
    def of_views(cls, views: Sequence[PosedView[PreparedView]], poses: Float64) -> Self:
        """Return those of views at poses (N, 4, 4)."""
        points, normals, depths = [], [], []
        k = residual_kernels
        for posed, T in zip(views, poses, strict=True):
            view = posed.view
            sampled = sampled_points(view, _VIEW_POINTS).astype(float)
            depths.append(sampled[:, k.POINT + 2])
            points.append(se3.transform(T, sampled[:, k.POINT : k.POINT + 3]))
            normals.append(sampled[:, k.NORMAL : k.NORMAL + 3] @ T[:3, :3].T)
        field = np.array(view.projection.ray_bounds, float)
        reach = float(np.quantile(np.concatenate(depths), 0.95))
        return cls(*_thinned(np.concatenate(points), np.concatenate(normals), reach), reach, field)

    @classmethod
    def of_points(
        cls, points: Float32, normals: Float32, poses: Float64, field: Float64 | None
    ) -> Self:
        """Return those of a model, with its normals towards the cameras, at poses (N, 4, 4)."""
        stride = max(1, len(points) // (10 * _MAX_POINTS))
        points, normals = points[::stride], normals[::stride]
        reach = float(np.quantile(np.linalg.norm(points - poses[:, :3, 3].mean(0), axis=1), 0.95))
        thinned = _thinned(points, -normals, reach)
        return cls(*thinned, reach, _USUAL_FIELD if field is None else field)

    def seen_from(self, poses: Float64) -> Seen:
        """Return what views at poses (M, 4, 4) see."""
        m = len(poses)
        R, t = poses[:, :3, :3].astype(np.float32), poses[:, :3, 3].astype(np.float32)
        arm = self.points - t[:, None]
        x, y, z = np.moveaxis(arm @ R, 2, 0)
        inside = (z > _MIN_FRACTION_OF_REACH * self.reach_m) & (z < self.reach_m)
        depth = np.where(inside, z, 1.0)
        relative = np.stack([x / depth, y / depth], -1) - self.field[0].astype(np.float32)
        cell = np.floor(relative * (_CELLS / np.ptp(self.field, axis=0)).astype(np.float32))
        inside &= ((cell >= 0) & (cell < _CELLS)).all(-1)
        cosine = np.einsum("mpk,pk->mp", arm, self.normals) / np.linalg.norm(arm, axis=2)
        inside &= cosine > _MIN_COSINE
        row, column = np.nonzero(inside)
        u, v = cell[row, column].astype(np.intp).T
        flat = (row * _CELLS[1] + v) * _CELLS[0] + u
        nearest = np.full(m * int(_CELLS.prod()), np.inf, np.float32)
        np.minimum.at(nearest, flat, z[row, column])
        in_front = z[row, column] < (1 + _BEHIND) * nearest[flat]
        row, column = row[in_front], column[in_front]
        pixels, information = (np.zeros(z.shape, np.float32) for _ in range(2))
        z2 = z[row, column] ** 2
        pixels[row, column] = cosine[row, column] / z2
        information[row, column] = pixels[row, column] / z2
        return Seen(pixels, information)

    def responses(self) -> Float32:
        """(P, 2, 6, 6) information of a point along its normal, and along the surface.

        It is that of small motions of a view in the world: translation, and rotation about the
        origin.
        """
        normal, p = self.normals.astype(float), self.points.astype(float)
        along = np.concatenate([normal, np.cross(p, normal)], 1)
        J = np.concatenate([np.broadcast_to(np.eye(3), (len(p), 3, 3)), -se3.hat(p)], 2)
        first = along[:, :, None] * along[:, None]
        return np.stack([first, np.swapaxes(J, 1, 2) @ J - first], 1).astype(np.float32)


def pair_information(a: Seen, b: Seen, responses: Float32) -> Float64:
    """(M, 2, 6, 6) information of each pair of views (M) by kind, up to its scale."""
    common = np.minimum(a.information, b.information)
    flat = responses.reshape(len(responses), -1)
    return (common @ flat).reshape(-1, 2, 6, 6).astype(np.float64)


def scales(measured: Float64, predicted: Float64) -> Float64:
    """Scales (2,) of the two kinds of information at which predictions are nearest to measured.

    In the median over the pairs, each compared in the units of its own measured information.

    Parameters
    ----------
    measured, predicted
        (M, 6, 6) and (M, 2, 6, 6).
    """
    size = np.trace(measured, axis1=1, axis2=2)[:, None, None]
    L = np.linalg.inv(np.linalg.cholesky(measured + _NOISE * size * np.eye(6)))
    whitened = (L[:, None] @ predicted @ np.swapaxes(L, 1, 2)[:, None]).reshape(-1, 2, 36)
    products = whitened @ np.swapaxes(whitened, 1, 2)
    target = whitened @ np.eye(6).ravel()
    found = np.array([_not_negative(A, b) for A, b in zip(products, target, strict=True)])
    return np.asarray(np.median(found, axis=0), np.float64)


def _not_negative(A: Float64, b: Float64) -> Float64:
    """Minimiser x >= 0 (2,) of x A x / 2 - b x."""
    x = np.asarray(np.linalg.lstsq(A, b, rcond=1e-12)[0], np.float64)
    if (x >= 0).all():
        return x
    single = np.maximum(b / np.maximum(np.diag(A), 1e-300), 0)
    return np.where(np.arange(2) == np.argmax(single * b), single, 0.0)


def _thinned(
    points: Float64 | Float32, normals: Float64 | Float32, reach: float
) -> tuple[Float32, Float32]:
    """Return one point per cell of space, and at most `_MAX_POINTS`."""
    known = np.isfinite(points).all(1) & (np.linalg.norm(normals, axis=1) > 0.5)
    points, normals = points[known], normals[known]
    cells = np.floor(points / (_SPACING * reach)).astype(np.int64)
    # Both sides of a thin wall are kept.
    _, kept = np.unique(np.column_stack([cells, normals > 0]), axis=0, return_index=True)
    kept = kept[:: -(-len(kept) // _MAX_POINTS)]
    return points[kept].astype(np.float32), normals[kept].astype(np.float32)
