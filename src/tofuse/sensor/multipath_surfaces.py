"""Surfaces and light at the nodes of a coarse grid, and the sources that they make."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofuse.kernels import multipath as kernels
from tofuse.kernels.multipath import AREA, COLUMNS, LIGHT, A, B, C, W, X, Y

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

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
        x, y = nodes[..., X], nodes[..., Y]
        slope = np.sqrt((nodes[..., A:] ** 2).sum(-1))
        w = nodes[..., A] * x + nodes[..., B] * y + nodes[..., C]
        good = (nodes[..., W] > 0) & (slope > 0) & (w > 0)
        w, slope = np.where(good, w, 1), np.where(good, slope, 1)
        length = np.sqrt(1 + x * x + y * y)
        cosine = np.clip(w / (slope * length), LEAST_COSINE, 1)
        r = length / w
        # length is 1 / cosine of the ray's angle to the axis.
        half = length ** (-FALLOFF / 2)
        radiosity = nodes[..., LIGHT] / half
        lit = half * cosine / r**2
        return cls(
            nodes,
            good,
            np.stack([x / w, y / w, 1 / w], -1),
            -nodes[..., A:] / slope[..., None],
            r,
            nodes[..., AREA] / (w * w * length * cosine),
            lit,
            radiosity,
            radiosity / lit / factor,
        )

    def bright(self) -> float:
        """Albedo in counts that a tenth of the surface's area exceeds; 0 without light."""
        pick = self.good & (self.albedo > 0)
        if not pick.any():
            return 0.0
        albedo, area = self.albedo[pick], self.area[pick]
        order = np.argsort(albedo, kind="stable")
        share = np.cumsum(area[order])
        return float(albedo[order][np.searchsorted(share, 0.9 * share[-1])])


def seen_sources(surfaces: Surfaces, radiosity: Float64, phase: Float64) -> Float32:
    """Sources (S, 9) as `kernels.multipath.exchange` takes them: 2 x 2 nodes, one where alike.

    Parameters
    ----------
    radiosity, phase
        (Hn, Wn) of the light that the nodes send out: strength, and phase in rad on leaving.
    """
    power = np.where(surfaces.good, surfaces.area * radiosity, 0)
    table = np.concatenate(
        [
            surfaces.points,
            surfaces.normals,
            np.where(surfaces.good, surfaces.area, 0)[..., None],
            (power * np.cos(phase))[..., None],
            (power * np.sin(phase))[..., None],
            power[..., None],
        ],
        -1,
    )
    rows, columns = (-(-n // 2) for n in surfaces.good.shape)
    padded = np.zeros((2 * rows, 2 * columns, 10))
    padded[: table.shape[0], : table.shape[1]] = table
    fours = padded.reshape(rows, 2, columns, 2, 10).transpose(0, 2, 1, 3, 4).reshape(-1, 4, 10)
    fours = fours[fours[..., 9].max(1) > 0]
    lead = fours[np.arange(len(fours)), fours[..., 9].argmax(1)]
    turn = np.einsum("gmc,gc->gm", fours[..., 3:6], lead[:, 3:6])
    off = np.abs(np.einsum("gmc,gc->gm", fours[..., :3] - lead[:, None, :3], lead[:, 3:6]))
    lit = fours[..., 9] > 0
    alike = lit & (turn > 0.97) & (off < 0.02 * np.linalg.norm(lead[:, :3], axis=1)[:, None])
    weight = np.where(alike, fours[..., 9], 0)
    mean = np.einsum("gm,gmc->gc", weight, fours[..., :6]) / weight.sum(1)[:, None]
    total = np.where(alike[..., None], fours[..., 6:9], 0).sum(1)
    out = np.concatenate([np.concatenate([mean, total], 1), fours[lit & ~alike][:, :9]])
    out[:, 3:6] /= np.linalg.norm(out[:, 3:6], axis=1, keepdims=True)
    out[:, 7:9] /= out[:, 6:7]
    return out.astype(np.float32)
