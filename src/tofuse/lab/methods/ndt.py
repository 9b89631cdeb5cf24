"""The normal distributions transform, point-to-distribution (Magnusson 2009, chapter 6)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from tofuse.engine.alignment import Registrar, Registration
from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import Frame
from tofuse.engine.geometry import KdTree, se3
from tofuse.engine.icp import icp_kernels, icp_parts, interfaces
from tofuse.engine.parts import part

# Min points of a cell, and its min variance relative to the largest.
_MIN_POINTS, _MIN_VARIANCE_RATIO = 6, 1e-3
# Outlier ratio (section 6.2.1: p_o).
_OUTLIER_RATIO = 0.55
_MAX_HALVINGS = 12


@dataclass(frozen=True, eq=False)
class _Cells:
    """Normal distributions of the target's points in grid cells."""

    size: float
    tree: KdTree
    mean: Float64
    precision: Float64

    @property
    def constants(self) -> tuple[float, float]:
        """d_1 and d_2 of eq 6.8: Gaussian approximation of a mixture with uniform outliers."""
        c1, c2 = 10 * (1 - _OUTLIER_RATIO), _OUTLIER_RATIO / self.size**3
        d3 = -math.log(c2)
        d1 = -math.log(c1 + c2) - d3
        return d1, -2 * math.log((-math.log(c1 * math.exp(-0.5) + c2) - d3) / d1)


@part("registration", "ndt", label="validated")
@dataclass(frozen=True)
class Ndt(Bounded, Registrar):
    """Coarse-to-fine alignment of the source's points to normal distributions of the target's.

    The target is divided into cells, each with the mean and covariance of its points. The score ::

        s(T) = -sum d_1 exp(-d_2 / 2 (T p - mu)^T Sigma^-1 (T p - mu))

    of the points, each in the cell with the nearest mean, is maximised (d_1 < 0) by Newton's method
    with the analytic gradient and Hessian (eigenvalues made positive) and step halving. The cell
    size is halved from level to level. Eigenvalues of the covariances are at least a thousandth of
    the largest (section 6.2.3).

    Attributes
    ----------
    resolution
        Typical distance between neighbouring points, m.
    points
        Random points of the source (None: all), against all of the target.
    coarsest, finest
        First and last cell size, in resolutions.
    max_iterations
        Of each level.
    """

    resolution: float = 0.01
    points: int | None = 1000
    coarsest: Annotated[float, Bounds(0, exclusive=True)] = 40.0
    finest: Annotated[float, Bounds(0, exclusive=True)] = 5.0
    max_iterations: int = 30

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.finest > self.coarsest:
            raise ValueError(f"finest must be at most {self.coarsest:g}, not {self.finest!r}")

    def register(
        self, source: Frame, target: Frame, guess: Float64, rng: np.random.Generator
    ) -> Registration:
        """See `Registrar.register`; correspondences are points in cells of the finest level.

        Raises
        ------
        RegistrationError
            If fewer than six points of the source lie in cells of the target.
        """
        data = interfaces.Points.of(
            source, icp_parts.at_most(self.points).select(source, rng)
        ).points
        model = target.points.astype(np.float64)
        T, size = se3.orthonormalise(guess), self.coarsest * self.resolution
        iterations = 0
        while True:
            cells = _cells(model, size)
            T, count, converged = self._level(data, cells, T)
            iterations += count
            if size <= self.finest * self.resolution:
                break
            size = max(size / 2, self.finest * self.resolution)
        index, mahalanobis2, r, precision = _associate(data, cells, T)
        if len(index) < _MIN_POINTS:
            raise RegistrationError(f"only {len(index)} points lie in cells of the target's")
        d2 = cells.constants[1]
        weight = np.exp(-d2 / 2 * mahalanobis2)
        J = _jacobian(data[index], T)
        information = np.einsum("n,nki,nkl,nlj->ij", weight, J, precision, J)
        distance = np.linalg.norm(r, axis=1)
        return Registration(
            T_target_source=T,
            converged=converged,
            iterations=iterations,
            correspondences=len(index),
            points=len(data),
            error=float(distance.sum()) / (len(data) * self.resolution),
            rms_m=float(np.sqrt((distance**2).mean())),
            information=(information + information.T) / 2,
        )

    def _level(self, data: Float64, cells: _Cells, T: Float64) -> tuple[Float64, int, bool]:
        centroid = data.mean(0)
        T_source_centred = se3.translation(centroid)
        centred = data - centroid
        radius = max(float(np.sqrt((centred**2).sum(1).mean())), self.resolution)
        units = np.array([1, 1, 1, 1 / radius, 1 / radius, 1 / radius])
        value, g, H = _score(centred, cells, T @ T_source_centred)
        for k in range(self.max_iterations):
            if value == 0.0:
                return T, k, False
            values, vectors = np.linalg.eigh(H * units[:, None] * units)
            shifted = np.maximum(np.abs(values), 1e-6 * np.abs(values).max())
            step = -units * (vectors @ ((vectors.T @ (g * units)) / shifted))
            length = float(np.linalg.norm(step / units))
            # The quadratic model is invalid beyond a cell.
            step *= min(1.0, cells.size / max(length, 1e-300))
            for _ in range(_MAX_HALVINGS):
                candidate = se3.orthonormalise(T @ se3.about(centroid, se3.exp(step)))
                trial = _score(centred, cells, candidate @ T_source_centred)
                if trial[0] < value:
                    break
                step = step / 2
            else:
                return T, k + 1, True
            T, (value, g, H) = candidate, trial
            if np.linalg.norm(step / units) < 1e-3 * self.resolution:
                return T, k + 1, True
        return T, self.max_iterations, False


def _cells(points: Float64, size: float) -> _Cells:
    """Grid cells with six or more points each."""
    grid = np.floor((points - points.min(0)) / size).astype(np.int64)
    _, cell = np.unique(grid, axis=0, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell)
    mean = np.stack([np.bincount(cell, points[:, a]) for a in range(3)], 1) / count[:, None]
    centred = points - mean[cell]
    C = np.empty((len(count), 3, 3))
    for a in range(3):
        for b in range(3):
            C[:, a, b] = np.bincount(cell, centred[:, a] * centred[:, b]) / np.maximum(count - 1, 1)
    populated = count >= _MIN_POINTS
    if not populated.any():
        raise RegistrationError(f"no cell of {size:.3g} m has {_MIN_POINTS} points of the target")
    values, vectors = np.linalg.eigh(C[populated])
    values = np.maximum(values, np.maximum(_MIN_VARIANCE_RATIO * values[:, 2:], 1e-18))
    precision = np.einsum("nij,nj,nkj->nik", vectors, 1 / values, vectors)
    return _Cells(size, KdTree(mean[populated]), mean[populated], precision)


def _associate(p: Float64, cells: _Cells, T: Float64) -> tuple[Int64, Float64, Float64, Float64]:
    """Points (n, 3) with a cell: indices, squared Mahalanobis distances, residuals, precisions."""
    x = icp_kernels.transform_points(T, p)
    nearest, _ = cells.tree.nearest(x, cells.size)
    index = np.flatnonzero(nearest >= 0)
    r = x[index] - cells.mean[nearest[index]]
    precision = cells.precision[nearest[index]]
    return index, np.einsum("ni,nij,nj->n", r, precision, r), r, precision


def _score(p: Float64, cells: _Cells, T: Float64) -> tuple[float, Float64, Float64]:
    """Negative score, its gradient (6,) and Hessian (6, 6) of the right perturbation."""
    index, mahalanobis2, r, precision = _associate(p, cells, T)
    d1, d2 = cells.constants
    e = np.exp(-d2 / 2 * mahalanobis2)
    J = _jacobian(p[index], T)
    a = np.einsum("nki,nkl,nl->ni", J, precision, r)  # derivative of half the square
    c = d1 * d2 * e
    value = float(d1 * e.sum())
    g = -(c[:, None] * a).sum(0)
    # Eq 6.13, with the second derivative of exp(hat w) p at zero: (w w^T - |w|^2) p, symmetric.
    H = -np.einsum("n,nki,nkl,nlj->ij", c, J, precision, J) + d2 * np.einsum("n,ni,nj->ij", c, a, a)
    s = np.einsum("nij,nj->ni", precision, r) @ T[:3, :3]
    outer = np.einsum("n,ni,nj->ij", c, s, p[index])
    H[3:, 3:] -= (outer + outer.T) / 2 - np.trace(outer) * np.eye(3)
    return value, g, H


def _jacobian(p: Float64, T: Float64) -> Float64:
    """Derivative (n, 3, 6) of T exp(xi) p at zero."""
    return np.asarray(T[:3, :3] @ se3.point_jacobian(p))
