"""Errors of rays and depth, estimated from the distortion of planes.

In inverse depth ``w = 1/z`` a plane is linear in the ray coordinates: ``w = a x + b y + c``. Radial
range recorded as z has ``w = L^-1 (a x + b y + c)``, with the length L of the ray (x, y, 1) (eq 2.3
of the thesis), and vice versa; rays that are wrong by a factor ``q = 1 + t1 rho^2 + t2 rho^4``
(Brown 1966; rho is the distance from the axis in units of the image's corner) distort
``a x + b y`` but not a fronto-parallel wall. So the two can be distinguished. All smooth regions
are fitted jointly, each with its own plane, all with the same three parameters, by Gauss-Newton
with the planes eliminated:

    kind:   w L^alpha        = a x q + b y q + c      (alpha, t1, t2)
    range:  w L(x p) / L(x)  = a x p + b y p + c      (s, t1, t2), with p = s + q

and "z" is the first with alpha = 0. The last is for radial range, whose z depends on the rays:
there a wrong focal length distorts planes too. Not for z: a wrong focal length stretches the
world, and planes stay planes. Along a corridor alpha and t1 are equivalent; then neither is known.

Their covariance is computed from the disagreement of the surfaces (sandwich estimator: White 1980),
which includes errors of the camera beyond noise, such as wiggling and rounded corners. Regions at
the same place in several frames count as one surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import ndtr, stdtrit  # scipy.stats takes long to import

from tofuse.engine.arrays import Bool, Float64, Int64
from tofuse.engine.compute import tukey_kernels as tukey
from tofuse.engine.connections import NEIGHBOURS, parts_of_image
from tofuse.engine.normal import robust_sigma
from tofuse.engine.views import PreparedView

Model = Literal["kind", "z", "range"]

# Neighbouring pixels belong to one surface if their normals differ by less than this angle, and
# their planes predict each other's depth within this number of sigmas or this fraction of it.
_MIN_NORMAL_COSINE = np.cos(np.radians(10.0))
_MAX_PLANE_SIGMAS, _MAX_PLANE_FRACTION = 3.0, 0.01
# Smaller regions, as a fraction of the image, are not distorted enough to be informative.
_MIN_FRACTION = 0.02
_MAX_POINTS = 1500
# Errors are correlated over patches of about this number of pixels.
_CORRELATED_PIXELS = 25.0
_ITERATIONS = 6
# Regions of different frames belong to one surface if they are within this distance in ray
# coordinates, with similar normals.
_MAX_PLACE_DISTANCE, _MIN_PLACE_COSINE = 0.12, np.cos(np.radians(12.0))
_CUTOFF_SIGMAS = 3.0
# Prior standard deviations of the three parameters.
_PRIOR: dict[Model, Float64] = {
    "kind": np.array([3.0, 0.15, 0.15]),
    "z": np.array([1e-9, 0.15, 0.15]),
    "range": np.array([0.7, 0.15, 0.15]),
}
_MAX_STEP = 0.5


@dataclass(frozen=True, eq=False)
class Region:
    """A smooth region of a view, possibly planar.

    Attributes
    ----------
    frame
        Its position in the sample.
    x, y, w, sigma
        (N,) ray coordinates, inverse z in 1/m and its standard deviation.
    fraction
        Of the valid pixels of the view.
    normal
        (3,) mean unit normal away from the camera.
    """

    frame: int
    x: Float64
    y: Float64
    w: Float64
    sigma: Float64
    fraction: float
    normal: Float64

    @property
    def misfit(self) -> float:
        """Robust deviation from a plane, relative to the depth."""
        B = np.stack([self.x, self.y, np.ones_like(self.x)], 1)
        e = self.w - B @ np.linalg.lstsq(B, self.w, rcond=None)[0]
        return _spread(e / self.w)


def regions_of(view: PreparedView, frame: int) -> list[Region]:
    """Return the smooth regions of a view, without edges and creases, for frame number `frame`."""
    w = view.planes[..., 3]
    is_valid = (w > 0) & (view.z > 0) & (view.sigma > 0) & np.isfinite(view.sigma)
    is_valid &= np.isfinite(view.normals).all(-1) & np.isfinite(view.rays).all(-1)
    labels = _labels(view, is_valid)
    counts = np.bincount(labels[is_valid]) if is_valid.any() else np.zeros(0, int)
    regions = []
    n_valid = max(int(np.count_nonzero(view.z > 0)), 1)
    for label in np.flatnonzero(counts >= _MIN_FRACTION * is_valid.size):
        v, u = np.nonzero(is_valid & (labels == label))
        step = -(-len(v) // _MAX_POINTS)
        v, u = v[::step], u[::step]
        z = view.z[v, u].astype(float)
        x, y = view.rays[v, u].astype(float).T
        sigma = view.sigma[v, u].astype(float) / z**2
        normal = view.normals[v, u].astype(float).mean(0)
        normal /= np.linalg.norm(normal)
        regions.append(Region(frame, x, y, 1 / z, sigma, float(counts[label]) / n_valid, normal))
    return regions


def _labels(view: PreparedView, is_valid: Bool) -> Int64:
    """(H, W) label of the region of each pixel."""
    normals, planes, rays = view.normals, view.planes, view.rays
    tolerance = np.hypot(
        _MAX_PLANE_FRACTION, _MAX_PLANE_SIGMAS * view.sigma / np.maximum(view.z, 1e-3)
    )
    links = []
    for a, b in NEIGHBOURS:
        is_same = is_valid[a] & is_valid[b]
        is_same &= (normals[a] * normals[b]).sum(-1) > _MIN_NORMAL_COSINE
        predicted_w = (planes[b][..., :2] * rays[a]).sum(-1) + planes[b][..., 2]
        is_same &= np.abs(predicted_w - planes[a][..., 3]) < tolerance[a] * planes[a][..., 3]
        links.append(is_same)
    return parts_of_image(is_valid.shape, links)


@dataclass(frozen=True, eq=False)
class Distortion:
    """The distortion of the planes of a recording.

    Attributes
    ----------
    values
        (3,) parameters, see the module: alpha or s, then t1, t2.
    covariance
        (3, 3) of them.
    surfaces
        Number of different surfaces.
    rms_before, rms_after
        Of the distances from the planes relative to z, before and after the fit.
    """

    values: Float64
    covariance: Float64
    surfaces: int
    rms_before: float
    rms_after: float

    @property
    def first(self) -> tuple[float, float]:
        """Alpha or s, and its standard deviation."""
        return float(self.values[0]), float(np.sqrt(self.covariance[0, 0]))

    @property
    def stretch(self) -> tuple[float, float]:
        """Relative displacement of rays at the corner by distortion, and its standard deviation.

        Without the effect of the focal length.
        """
        g = np.array([0.0, 1.0, 1.0])
        return float(g @ self.values), float(np.sqrt(g @ self.covariance @ g))

    def quantile(self, sigmas: float) -> float:
        """Return the multiple of a standard deviation with the probability of `sigmas` if normal.

        Standard deviations are estimated from few surfaces: Student's t distribution.
        """
        return float(stdtrit(max(self.surfaces - len(self.values), 1), ndtr(sigmas)))

    @property
    def folds(self) -> bool:
        """Whether it maps two rays of the image onto one, which no lens does.

        Such a fit follows surfaces that are not planar.
        """
        r2 = np.linspace(0, 1, 21)
        _, t1, t2 = self.values
        return bool((1 + 3 * t1 * r2 + 5 * t2 * r2**2).min() <= 0)


def fit_distortion(regions: Sequence[Region], radius: float, model: Model) -> Distortion | None:
    """Fit the three parameters; None if there are no regions.

    Parameters
    ----------
    regions
        Of all views.
    radius
        Largest distance of the camera's rays from the axis, at the corner of the image.
    model
        The kind of error, see the module.
    """
    if not regions:
        return None
    prior = _PRIOR[model]
    theta = np.zeros(3)
    bounds = [np.inf] * len(regions)
    H, scores = np.eye(3), np.zeros((len(regions), 3))
    misfit: list[float] = []
    for _ in range(_ITERATIONS):
        H, g = np.diag(prior**-2.0), -theta / prior**2
        squares = count = 0.0
        for n, region in enumerate(regions):
            e, G, weight, bounds[n] = _residuals(region, theta, radius, model, bounds[n])
            H += G.T @ (G * weight[:, None])
            scores[n] = -(G * weight[:, None]).T @ e
            kept = weight > 0
            squares += float(((e / region.w)[kept] ** 2).sum())
            count += float(np.count_nonzero(kept))
        g += scores.sum(0)
        misfit.append(float(np.sqrt(squares / max(count, 1))))
        step = np.linalg.solve(H, g)
        theta = theta + step * min(1.0, _MAX_STEP / max(float(np.abs(step).max()), 1e-12))
    inverse = np.linalg.inv(H)
    group = _same_surface(regions)
    n = int(group.max()) + 1
    sums = np.zeros((n, 3))
    np.add.at(sums, group, scores)
    sandwich = inverse @ (sums.T @ sums) @ inverse * (n / max(n - 3, 0.5))
    return Distortion(theta, inverse + sandwich, n, misfit[0], misfit[-1])


def _same_surface(regions: Sequence[Region]) -> Int64:
    """(R,) surface number of each region; overlapping regions of different frames share one."""
    surface_of = np.zeros(len(regions), np.int64)
    latest: list[Region] = []
    for n, region in enumerate(regions):
        nearby = [
            (float(np.hypot(region.x.mean() - r.x.mean(), region.y.mean() - r.y.mean())), k)
            for k, r in enumerate(latest)
            if r.frame != region.frame and float(region.normal @ r.normal) > _MIN_PLACE_COSINE
        ]
        distance, k = min(nearby, default=(np.inf, 0))
        if distance > _MAX_PLACE_DISTANCE:
            k = len(latest)
            latest.append(region)
        latest[k] = region
        surface_of[n] = k
    return surface_of


def _residuals(
    region: Region, theta: Float64, radius: float, model: Model, bound: float
) -> tuple[Float64, Float64, Float64, float]:
    """Residuals (N,) from the plane, their Jacobian (N, 3), weights (N,), and the next bound."""
    x, y = region.x, region.y
    r2 = x * x + y * y
    rho2 = r2 / radius**2
    length = 0.5 * np.log1p(r2)
    stretch = 1 + theta[1] * rho2 + theta[2] * rho2**2
    if model != "range":
        observed = region.w * np.exp(theta[0] * length)
    else:
        stretch = stretch + theta[0]
        observed = region.w * np.sqrt((1 + r2 * stretch**2) / (1 + r2))
    B = np.stack([x * stretch, y * stretch, np.ones_like(x)], 1)
    base = 1 / region.sigma**2
    weight = base
    for _ in range(2 if np.isfinite(bound) else 5):
        root = np.sqrt(weight)
        plane = np.linalg.lstsq(B * root[:, None], observed * root, rcond=None)[0]
        e = observed - B @ plane
        cutoff = bound if np.isfinite(bound) else _CUTOFF_SIGMAS * _spread(e)
        weight = base * tukey.weights((e / cutoff) ** 2)
    slope = plane[0] * x + plane[1] * y
    if model != "range":
        by_first, by_stretch = observed * length, -slope
    else:
        by_stretch = observed * r2 * stretch / (1 + r2 * stretch**2) - slope
        by_first = by_stretch
    G = np.stack([by_first, by_stretch * rho2, by_stretch * rho2**2], 1)
    # Project out the plane's parameters.
    root = np.sqrt(weight)[:, None]
    G = G - B @ np.linalg.lstsq(B * root, G * root, rcond=None)[0]
    # Rescaled to the actual noise: the stated one may be wrong by a factor, and is correlated.
    scale = max(_spread(e / region.sigma), 0.3)
    return e, G, weight / (scale**2 * _CORRELATED_PIXELS), _CUTOFF_SIGMAS * _spread(e)


def _spread(e: Float64) -> float:
    return max(robust_sigma(e), 1e-9)
