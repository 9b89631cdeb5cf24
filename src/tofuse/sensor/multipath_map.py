"""The surfaces that the lamp lights and the image does not show: remembered, or guessed."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofuse.geometry import se3
from tofuse.kernels import multipath as kernels
from tofuse.kernels.multipath import COLUMNS, PATCH, A, C, W, X, Y
from tofuse.sensor.multipath_surfaces import FALLOFF, LEAST_COSINE, Surfaces

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

# The lamp is taken to light no wider than this.
_WIDEST_LAMP = np.pi / 3
# Cells of the directions around the image, along its width.
_CELLS = 12
# Of the nodes along an image's border, this many rows and columns are taken to go on beyond it.
_BORDER = 3
# A plane that runs away, or into the camera, says nothing about what is there.
_LEAST_GROWTH, _MOST_GROWTH = 0.3, 3.0
# Views are remembered when the camera has moved so far since the last that was: rad, and as a share
# of the depth; and never more than so many.
_ANGLE, _DISTANCE, _VIEWS = 0.1, 0.05, 100
# A surface is remembered where it was lit no more askance than this.
_LEAST_LIT = 0.25


class LightMap:
    """What a camera has seen of the surfaces around it, as sources of light.

    Views are kept spaced by the motion of the camera, and the newest ones only.
    """

    def __init__(self) -> None:
        self._views: deque[Float32] = deque(maxlen=_VIEWS)
        self._T: Float64 | None = None  # of the newest view
        self._patches = np.zeros((0, PATCH), np.float32)

    @property
    def patches(self) -> Float32:
        """(N, PATCH) in the world frame, see `kernels.multipath.recall`."""
        return self._patches

    def add(self, surfaces: Surfaces, trusted: Bool, T_world_camera: Float64) -> None:
        """Remember the surfaces of a view at every other node, unless the last one was near.

        Parameters
        ----------
        trusted
            (Hn, Wn) nodes at which there is a surface that stands still in the world.
        """
        lit = surfaces.good & (surfaces.albedo > 0)
        if not lit.any():
            return
        if self._T is not None:
            motion = se3.inverse(self._T) @ T_world_camera
            reach = _DISTANCE * float(np.median(surfaces.range_m[lit]))
            if se3.angle(motion) < _ANGLE and np.linalg.norm(motion[:3, 3]) < reach:
                return
        cosine = -(surfaces.points * surfaces.normals).sum(-1) / surfaces.range_m
        pick = (lit & trusted & (cosine > _LEAST_LIT))[::2, ::2]
        points, normals, albedo, weight = (
            of[::2, ::2][pick]
            for of in (surfaces.points, surfaces.normals, surfaces.albedo, cosine)
        )
        R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
        # einsum, not a matrix product: BLAS may sum differently with more threads.
        placed = np.einsum("nc,dc->nd", points, R) + t
        turned = np.einsum("nc,dc->nd", normals, R)
        table = np.concatenate([placed, turned, albedo[:, None], weight[:, None]], 1)
        self._views.append(table.astype(np.float32))
        self._T = T_world_camera
        self._patches = np.concatenate(list(self._views))


@dataclass(eq=False)
class Around:
    """The directions around an image that the lamp lights as well, in a grid of cells.

    Attributes
    ----------
    pitch
        (2,) sides of a cell in the plane z = 1.
    rays
        (M, 2) x/z and y/z of the cells' centres.
    share
        (M,) of a cell that the lamp lights.
    planes
        (M, 3) a, b, c of the plane 1/z = a x + b y + c that is known to be there; 0 where none is.
    albedo
        (M,) in counts, as known of it.
    """

    pitch: Float64
    rays: Float64
    share: Float64
    planes: Float64
    albedo: Float64

    @classmethod
    def of(cls, nodes: Float64, lamp: float) -> Around:
        """Lay the grid around nodes (Hn, Wn, COLUMNS), whole cells to the image.

        Parameters
        ----------
        lamp
            Angle up to which the lamp lights, relative to that of the image's corner.
        """
        inside = nodes[..., W] > 0
        rays = nodes[inside][:, X : Y + 1]
        cells = np.zeros((0, 2))
        share = np.zeros(0)
        pitch = np.ones(2)
        if len(rays) > 1 and (np.ptp(rays, 0) > 0).all():
            # A node stands for the half block beyond it as well.
            half = np.ptp(rays, 0) / (2 * np.maximum(np.array(inside.shape[::-1]) - 1, 1))
            low, high = rays.min(0) - half, rays.max(0) + half
            count = np.array(
                [_CELLS, max(1, round(_CELLS * float(np.divide(*(high - low)[::-1]))))]
            )
            pitch = (high - low) / count
            corner = float(np.arctan(np.sqrt(np.maximum(low**2, high**2).sum())))
            widest = min(lamp * corner, _WIDEST_LAMP)
            limit = np.tan(widest)
            first = np.floor((-limit - low) / pitch)
            last = np.ceil((limit - low) / pitch)
            i, j = (np.arange(a, b) for a, b in zip(first, last, strict=True))
            gi, gj = (g.ravel() for g in np.meshgrid(i, j))
            outside = (gi < 0) | (gi >= count[0]) | (gj < 0) | (gj >= count[1])
            cells = low + (np.stack([gi, gj], 1)[outside] + 0.5) * pitch
            tangent = np.sqrt((cells**2).sum(1))
            share = np.clip((limit - tangent) / pitch.mean() + 0.5, 0, 1)
            cells, share = cells[share > 0], share[share > 0]
        return cls(pitch, cells, share, np.zeros((len(cells), 3)), np.zeros(len(cells)))

    def recall(self, known: LightMap, T_world_camera: Float64) -> None:
        """Set the planes of the cells that show a surface of the map."""
        if len(self.rays) and len(known.patches):
            kernels.recall(
                known.patches,
                se3.inverse(T_world_camera),
                self.rays,
                self.pitch,
                self.planes,
                self.albedo,
            )

    def sources(self, surfaces: Surfaces, gain: float, wave_number: float) -> Float32:
        """Sources (S, 9) as `kernels.multipath.exchange` takes them.

        Where nothing is known, the plane of the nearest node at the image's border is taken to go
        on, and its albedo.

        Parameters
        ----------
        gain
            Counts of a white wall at 1 m.
        wave_number
            Phase in rad per m of path.
        """
        gx, gy = self.rays.T
        planes, albedo = self.planes.copy(), self.albedo.copy()
        known = albedo > 0
        w = (planes[:, 0] * gx + planes[:, 1] * gy + planes[:, 2]) * known
        border = np.ones(surfaces.good.shape, bool)
        border[_BORDER:-_BORDER, _BORDER:-_BORDER] = False
        chosen = np.flatnonzero(border & surfaces.good & (surfaces.albedo > 0))
        new = np.flatnonzero(~known)
        if len(chosen) and len(new):
            nodes = surfaces.nodes.reshape(-1, COLUMNS)[chosen]
            places = np.ascontiguousarray(nodes[:, X : Y + 1])
            near = kernels.nearest(gx[new].copy(), gy[new].copy(), places)
            planes[new] = nodes[near, A : C + 1]
            albedo[new] = surfaces.albedo.reshape(-1)[chosen[near]]
            w[new] = planes[new, 0] * gx[new] + planes[new, 1] * gy[new] + planes[new, 2]
            growth = w[new] / nodes[near, W]
            w[new[(growth < _LEAST_GROWTH) | (growth > _MOST_GROWTH)]] = 0
        fine = w > 0
        w, gx, gy, planes, albedo = w[fine], gx[fine], gy[fine], planes[fine], albedo[fine]
        cell = self.share[fine] * self.pitch.prod()
        normals = -planes / np.sqrt((planes**2).sum(1))[:, None]
        points = np.stack([gx, gy, np.ones_like(gx)], -1) / w[:, None]
        r = np.sqrt((points**2).sum(1))
        cosine = np.clip(-(normals * points).sum(1) / r, LEAST_COSINE, 1)
        length = r * w
        lit = length ** (-FALLOFF / 2) * cosine / r**2
        radiosity = albedo / gain * lit
        phase = wave_number * r
        area = cell / (w * w * length * cosine)
        light = np.stack([area, radiosity * np.cos(phase), radiosity * np.sin(phase)], -1)
        return np.concatenate([points, normals, light], 1).astype(np.float32)
