"""Surfaces and light at the nodes of a coarse grid, and the sources that they make."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Bool, Complex128, Float32, Float64
from tofuse.kernels import multipath as kernels
from tofuse.kernels.multipath import COLUMNS, A, W, X, Y

# Light in a pixel falls as the cosine of its angle to the axis to this power, in the lens and from
# the lamp together, and half of it in each.
FALLOFF = 4.0

# Depths of a block further than this share from its median are another surface.
_JUMP = 0.03
# A plane fits where the misfit is below this share of the depth.
_FLAT = 0.006
# The own light of slanter surfaces is too weak and too uncertain to divide by.
LEAST_COSINE = 0.12


def block_nodes(z: Float32, rays: Float32, light: Float32, step: int) -> Float64:
    """Nodes (Hn, Wn, COLUMNS) of an image, see `kernels.multipath`; planes are not yet fitted."""
    size = -(-z.shape[0] // step), -(-z.shape[1] // step)
    nodes = np.empty((*size, COLUMNS))
    kernels.block_means(z, rays, light, step, _JUMP, nodes)
    return nodes


def fit_planes(
    nodes: Float64, measured: Float64 | None = None, shift: Float64 | None = None
) -> None:
    """Fit a plane to every node that lies on one, in windows of 5 and then of 3 nodes.

    Parameters
    ----------
    measured, shift
        (Hn, Wn) radial range in m that was measured, and the bias by which the nodes' depth has
        been corrected; none unless given.
    """
    if measured is None or shift is None:
        measured = ray_ranges(nodes)
        shift = np.zeros_like(measured)
    nodes[..., A:] = 0
    planes = np.zeros((*nodes.shape[:2], 4))
    for radius in (2, 1):
        kernels.window_planes(nodes, radius, planes)
        kernels.choose_planes(nodes, planes, radius, _FLAT, measured, shift)


def ray_ranges(nodes: Float64) -> Float64:
    """Radial range (Hn, Wn) in m of the nodes, 0 where there is none."""
    w = nodes[..., W]
    length = np.sqrt(1 + nodes[..., X] ** 2 + nodes[..., Y] ** 2)
    return np.where(w > 0, length / np.where(w > 0, w, 1), 0)


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Geometry and light at the nodes, all (Hn, Wn, ...).

    Attributes
    ----------
    nodes
        As of `block_nodes`, with planes.
    good
        Where a plane fits; the others mean nothing elsewhere.
    points, normals
        In m in the camera frame; unit, towards the camera.
    range_m
        Radial range in m.
    area
        Of the block's piece of the surface, m^2.
    lit
        Light of the lamp on the surface, relative to a surface that faces it 1 m away on the axis.
    radiosity
        What the surface was measured to send out, in counts: amplitude without the lens's falloff.
    albedo
        Quotient of its own radiosity (without indirect light) and `lit`, in counts.
    """

    nodes: Float64
    good: Bool
    points: Float64
    normals: Float64
    range_m: Float64
    area: Float64
    lit: Float64
    radiosity: Float64
    albedo: Float64

    @classmethod
    def of(cls, nodes: Float64, factor: Float64) -> Surfaces:
        """Derive the surfaces from nodes with planes.

        Parameters
        ----------
        factor
            (Hn, Wn) by which indirect light has raised the amplitude, as far as known.
        """
        shape = nodes.shape[:2]
        good = np.empty(shape, bool)
        points, normals = np.empty((*shape, 3)), np.empty((*shape, 3))
        values = np.empty((5, *shape))
        kernels.surface_radiometry(
            nodes, factor, FALLOFF, LEAST_COSINE, good, points, normals, values
        )
        return cls(nodes, good, points, normals, *values)

    def bright(self) -> float:
        """Albedo in counts that a tenth of the surface's area exceeds; 0 without light."""
        pick = self.good & (self.albedo > 0)
        if not pick.any():
            return 0.0
        albedo, area = self.albedo[pick], self.area[pick]
        order = np.argsort(albedo, kind="stable")
        share = np.cumsum(area[order])
        return float(albedo[order][np.searchsorted(share, 0.9 * share[-1])])


def visible_sources(surfaces: Surfaces, radiosity: Complex128) -> Float32:
    """Sources (S, 9) as `kernels.multipath.exchange` takes them: 2 x 2 nodes, one where alike.

    Parameters
    ----------
    radiosity
        (Hn, Wn) of the light that the nodes send out, with its phase on leaving.
    """
    out = np.empty((surfaces.good.size, 9), np.float32)
    count = kernels.visible_sources(
        surfaces.good, surfaces.points, surfaces.normals, surfaces.area, radiosity, out
    )
    return out[:count]
