"""Surfaces and their radiometry at the nodes of a coarse grid, for multipath."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Bool, Complex128, Float32, Float64
from tofuse.engine.sensor import multipath_kernels as kernels
from tofuse.engine.sensor.multipath_kernels import COLUMNS, A, W, X, Y

# Exponent of the cosine to the optical axis by which amplitude falls off: half of it is due to the
# lens, half of it due to the lamp.
FALLOFF = 4.0

# Relative distance from the median depth of a block at which a pixel is on another surface.
_JUMP = 0.03
# Largest rms misfit of a plane, relative to the depth.
_MAX_MISFIT = 0.006
# Lower limit of the cosine of incidence; the direct light of more oblique surfaces is too
# uncertain.
MIN_COSINE = 0.12


def block_nodes(z: Float32, rays: Float32, amplitude: Float32, step: int) -> Float64:
    """Return the nodes (Hn, Wn, COLUMNS) of an image without planes, see `kernels.multipath`."""
    size = -(-z.shape[0] // step), -(-z.shape[1] // step)
    nodes = np.empty((*size, COLUMNS))
    kernels.block_means(z, rays, amplitude, step, _JUMP, nodes)
    return nodes


def fit_planes(
    nodes: Float64, measured: Float64 | None = None, shift: Float64 | None = None
) -> None:
    """Fit planes to the nodes, in windows of 5 x 5 and then of 3 x 3 nodes.

    Parameters
    ----------
    nodes
        (Hn, Wn, COLUMNS), updated.
    measured, shift
        (Hn, Wn) measured radial range in m, and the bias by which the nodes' depth has been
        corrected; None if it has not been corrected.
    """
    if measured is None or shift is None:
        measured = ray_ranges(nodes)
        shift = np.zeros_like(measured)
    nodes[..., A:] = 0
    planes = np.zeros((*nodes.shape[:2], 4))
    for radius in (2, 1):
        kernels.window_planes(nodes, radius, planes)
        kernels.choose_planes(nodes, planes, radius, _MAX_MISFIT, measured, shift)


def ray_ranges(nodes: Float64) -> Float64:
    """Return the radial range (Hn, Wn) in m of the nodes, 0 where invalid."""
    w = nodes[..., W]
    length = np.sqrt(1 + nodes[..., X] ** 2 + nodes[..., Y] ** 2)
    return np.where(w > 0, length / np.where(w > 0, w, 1), 0)


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Geometry and radiometry at the nodes, all (Hn, Wn, ...).

    Attributes
    ----------
    nodes
        As of `block_nodes`, with planes.
    has_plane
        Whether a plane fits; the other attributes are undefined elsewhere.
    points, normals
        In m in the camera frame; unit, towards the camera.
    range_m
        Radial range in m.
    area
        Of the block on the surface, m^2.
    irradiance
        Direct irradiance, relative to a surface facing the lamp at 1 m on the axis.
    radiosity
        Measured radiosity in counts: amplitude without the falloff of the lens.
    albedo
        Direct radiosity (without indirect light) divided by `irradiance`, in counts.
    """

    nodes: Float64
    has_plane: Bool
    points: Float64
    normals: Float64
    range_m: Float64
    area: Float64
    irradiance: Float64
    radiosity: Float64
    albedo: Float64

    @classmethod
    def of(cls, nodes: Float64, factor: Float64) -> Surfaces:
        """Derive the surfaces from nodes with planes.

        Parameters
        ----------
        factor
            (Hn, Wn) current estimate of the factor by which multipath has raised the amplitude.
        """
        shape = nodes.shape[:2]
        has_plane = np.empty(shape, bool)
        points, normals = np.empty((*shape, 3)), np.empty((*shape, 3))
        values = np.empty((5, *shape))
        kernels.surface_radiometry(
            nodes, factor, FALLOFF, MIN_COSINE, has_plane, points, normals, values
        )
        return cls(nodes, has_plane, points, normals, *values)

    def bright_albedo(self) -> float:
        """Return the area-weighted 90 % quantile of the albedo in counts; 0 if unknown."""
        valid = self.has_plane & (self.albedo > 0)
        if not valid.any():
            return 0.0
        albedo, area = self.albedo[valid], self.area[valid]
        order = np.argsort(albedo, kind="stable")
        cumulative = np.cumsum(area[order])
        return float(albedo[order][np.searchsorted(cumulative, 0.9 * cumulative[-1])])


def visible_sources(surfaces: Surfaces, radiosity: Complex128) -> Float32:
    """Return the light sources (S, 9) of the surfaces, merging similar ones of 2 x 2 nodes.

    Parameters
    ----------
    surfaces
        Of the image.
    radiosity
        (Hn, Wn) complex radiosity, with the phase on leaving.

    Returns
    -------
    Sources as in `kernels.multipath.add_irradiance`.
    """
    out = np.empty((surfaces.has_plane.size, 9), np.float32)
    count = kernels.visible_sources(
        surfaces.has_plane, surfaces.points, surfaces.normals, surfaces.area, radiosity, out
    )
    return out[:count]
