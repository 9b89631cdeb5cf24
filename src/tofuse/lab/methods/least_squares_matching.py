"""Least squares 3D surface matching, LS3D (Gruen and Akca 2005; intensity: Akca 2007)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from tofuse.engine.alignment import Registrar, Registration
from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import Frame
from tofuse.engine.geometry import se3
from tofuse.engine.icp import icp_parts, interfaces
from tofuse.engine.parts import part
from tofuse.lab.methods.neighbourhoods import neighbourhood

_MIN_POINTS = 8
# Max side length of a triangle in resolutions; longer ones bridge a gap.
_MAX_SIDE = 5.0
_CONVERGENCE = 1e-4  # largest change of a parameter, in resolutions
_MIN_SIGMA = 1e-3


@dataclass(frozen=True, eq=False)
class SimilarityMatch(Registration):
    """A registration that may also estimate the scale.

    Attributes
    ----------
    precision
        (7,) standard deviations: translation (m), rotation (rad), scale; about the centroid of the
        source's points.
    """

    precision: Float64 = field(default_factory=lambda: np.zeros(7))


@dataclass(frozen=True, eq=False)
class _FootPoints:
    """Foot points on the triangles of the target, for the points that have one."""

    point: Int64
    distance: Float64
    normal: Float64
    intensity: Float64
    gradient: Float64


@part("registration", "ls3d", label="validated")
@dataclass(frozen=True)
class LeastSquaresMatching(Bounded, Registrar):
    """Generalised Gauss-Markov model of the distances between two surfaces.

    The target is a surface of planar triangles (fans of each point's neighbours). Each point of the
    source has an observation equation (eq 8 of the paper, here with a moving source)::

        -e_i = n_i . (t + w x (m p_i) + dm p_i) - l_i

    with l_i the distance to the triangle on which the point's foot lies and n_i its normal, the
    numeric derivatives of the surface. The seven parameters of a similarity are observations as
    well, with individual weights: that of the scale decides whether it is free. Points whose foot
    lies on no triangle are beyond the surface's boundary; in each iteration, observations with
    residuals beyond `outlier` standard deviations are rejected (section 2.3). With `intensity`, a
    second surface is matched, whose height is the intensity (Akca 2007).

    Attributes
    ----------
    resolution
        Typical distance between neighbouring points, m.
    points
        Random points of the source (None: all), against all of the target.
    reach
        Largest distance of a point from its foot, in resolutions.
    outlier
        K of section 2.3: residuals beyond K sigma_0 are rejected.
    scale_sigma
        Relative standard deviation of the scale's observation; 0 fixes the scale to one.
    intensity
        Height in m of the intensity surface per median amplitude of the target; 0: not used.
    max_iterations
        Maximum number of iterations.
    """

    resolution: Annotated[float, Bounds(0, exclusive=True)] = 0.01
    points: int | None = 1000
    reach: Annotated[float, Bounds(0, exclusive=True)] = 5.0
    outlier: Annotated[float, Bounds(0, exclusive=True)] = 4.0
    scale_sigma: Annotated[float, Bounds(0)] = 0.0
    intensity: Annotated[float, Bounds(0)] = 0.0
    max_iterations: Annotated[int, Bounds(1)] = 50

    def register(
        self, source: Frame, target: Frame, guess: Float64, rng: np.random.Generator
    ) -> SimilarityMatch:
        """See `Registrar.register`.

        Raises
        ------
        RegistrationError
            If fewer than eight points have a foot on the target's surface.
        """
        data = interfaces.Points.of(source, icp_parts.at_most(self.points).select(source, rng))
        model = interfaces.Points.of(target, icp_parts.All().select(target, rng))
        intensity = (data.amplitude, model.amplitude) if self.intensity else None
        centroid = data.points.mean(0)
        centred = data.points - centroid
        radius = float(np.sqrt((centred**2).sum(1).mean()))
        units = np.r_[1, 1, 1, radius, radius, radius, radius]
        T, scale = se3.orthonormalise(guess), 1.0
        errors: list[float] = []
        converged = False
        while not converged and len(errors) < self.max_iterations:
            rotated = scale * centred @ T[:3, :3].T
            centre = T[:3, :3] @ centroid + T[:3, 3]
            foot = self._foot_points(rotated + centre, model, intensity)
            if len(foot.point) < _MIN_POINTS:
                raise RegistrationError(
                    f"only {len(foot.point)} points lie on the target's surface, "
                    f"{_MIN_POINTS} needed"
                )
            N, g = self._normal_equations(rotated[foot.point], foot, intensity, scale)
            step = np.zeros(7)
            dof = 7 if self.scale_sigma else 6
            step[:dof] = np.linalg.lstsq(N[:dof, :dof], g[:dof], rcond=1e-12)[0]
            T = se3.orthonormalise(se3.about(centre, se3.exp(step[:6])) @ T)
            scale *= 1 + step[6]
            errors.append(float(np.abs(foot.distance).sum()) / (len(data) * self.resolution))
            converged = bool(np.abs(step * units).max() < _CONVERGENCE * self.resolution)
        covariance = np.zeros((7, 7))
        covariance[:dof, :dof] = np.linalg.pinv(N[:dof, :dof])
        sigma = np.sqrt(np.diag(covariance))
        # The scale applies before T, about the source's origin.
        T = T @ se3.translation((1 - scale) * centroid)
        return SimilarityMatch(
            T_target_source=T,
            converged=converged,
            iterations=len(errors),
            correspondences=len(foot.point),
            points=len(data),
            error=errors[-1],
            rms_m=float(np.sqrt((foot.distance**2).mean())),
            information=_information_in_source(N[:dof, :dof], T, scale * centroid),
            errors=tuple(errors),
            scale=scale,
            scale_sigma=float(sigma[6]) if self.scale_sigma else None,
            precision=sigma,
        )

    def _normal_equations(
        self,
        centred: Float64,
        foot: _FootPoints,
        intensity: tuple[Float64, Float64] | None,
        scale: float,
    ) -> tuple[Float64, Float64]:
        """N (7, 7) and right-hand side (7,) of the inlier observations, and the scale's.

        `centred` (k, 3) are the source's points relative to their centroid, in the target's axes.
        """
        A, height = self._equations(centred, foot, intensity)
        inlier = np.abs(height) <= self.outlier * _sigma(height)
        A, height = A[inlier], height[inlier]
        weight = 1 / max(_sigma(height), _MIN_SIGMA * self.resolution) ** 2
        N, g = weight * A.T @ A, -weight * A.T @ height
        if self.scale_sigma:
            N[6, 6] += self.scale_sigma**-2
            g[6] -= (scale - 1) * self.scale_sigma**-2
        return N, g

    def _equations(
        self, centred: Float64, foot: _FootPoints, intensity: tuple[Float64, Float64] | None
    ) -> tuple[Float64, Float64]:
        """Design matrix (k, 7) and distances (k,) in m, of geometry and intensity."""
        A = _jacobian(centred, foot.normal)
        if intensity is None:
            return A, foot.distance
        unit = self.intensity / max(float(np.median(intensity[1])), 1e-12)
        r = unit * (foot.intensity - intensity[0][foot.point])
        return np.vstack([A, _jacobian(centred, unit * foot.gradient)]), np.r_[foot.distance, r]

    def _foot_points(
        self, x: Float64, model: interfaces.Points, intensity: tuple[Float64, Float64] | None
    ) -> _FootPoints:
        """Foot points of x (n, 3) on the triangles around the nearest points of the target."""
        surface = neighbourhood(model)
        nearest, _ = surface.tree.nearest(x, self.reach * self.resolution)
        point = np.flatnonzero(nearest >= 0)
        q = nearest[point]
        fan = surface.fans[q]
        a = model.points[q][:, None]
        b, c = model.points[fan], model.points[np.roll(fan, -1, axis=1)]
        e1, e2 = b - a, c - a
        normal = np.cross(e1, e2)
        double_area = np.linalg.norm(normal, axis=2)
        offset = x[point][:, None] - a
        with np.errstate(invalid="ignore", divide="ignore"):
            normal = normal / double_area[..., None]
            # Barycentric coordinates of the foot.
            u = (np.cross(offset, e2) * normal).sum(2) / double_area
            v = (np.cross(e1, offset) * normal).sum(2) / double_area
        longest_side = np.maximum(np.linalg.norm(e1, axis=2), np.linalg.norm(e2, axis=2))
        height = (offset * normal).sum(2)
        inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (longest_side <= _MAX_SIDE * self.resolution)
        height = np.where(inside & np.isfinite(height), height, np.inf)
        best = np.argmin(np.abs(height), axis=1)
        row = np.arange(len(point))
        has_foot = np.isfinite(height[row, best])
        row, best = row[has_foot], best[has_foot]
        n, d = normal[row, best], height[row, best]
        value, gradient = np.zeros(len(row)), np.zeros((len(row), 3))
        if intensity is not None:
            A = intensity[1][q[row]]
            B, C = (intensity[1][f[row, best]] for f in (fan, np.roll(fan, -1, axis=1)))
            value = A + u[row, best] * (B - A) + v[row, best] * (C - A)
            E1, E2, foot_double_area = e1[row, best], e2[row, best], double_area[row, best][:, None]
            gradient = (
                np.cross(E2, n) * (B - A)[:, None] + np.cross(n, E1) * (C - A)[:, None]
            ) / foot_double_area
        return _FootPoints(point[row], d, n, value, gradient)


def _information_in_source(N: Float64, T_target_source: Float64, centroid: Float64) -> Float64:
    """Convert information (6, 6) about `centroid`, in the target's axes, to `Registration`'s.

    Information (7, 7) is also of the scale, which is eliminated.
    """
    R = T_target_source[:3, :3]
    J = np.eye(len(N))
    J[:6, :6] = se3.adjoint(se3.pose(R) @ se3.translation(-centroid))
    J[:3, 6:] = (R @ centroid)[:, None]
    H = J.T @ N @ J
    H = H[:6, :6] - H[:6, 6:] @ np.linalg.pinv(H[6:, 6:]) @ H[6:, :6]
    return np.asarray((H + H.T) / 2)


def _jacobian(centred: Float64, n: Float64) -> Float64:
    """Derivatives (k, 7) of n . x by translation, rotation and scale about the centroid."""
    return np.column_stack([n, np.cross(centred, n), (centred * n).sum(1)])


def _sigma(residual: Float64) -> float:
    return float(np.sqrt((residual**2).sum() / max(len(residual) - 7, 1)))
