"""The surfaces that reflect light onto each other, and their radiometry, for multipath.

Those in the image are at the nodes of a coarse grid; illuminated ones outside of it are mapped from
earlier views, or extrapolated.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tofuse.engine.arrays import Bool, Complex128, Float32, Float64
from tofuse.engine.geometry import se3
from tofuse.engine.sensor import multipath_kernels as kernels
from tofuse.engine.sensor.multipath_kernels import COLUMNS, PATCH, A, W, X, Y

# Upper limit of the illumination angle, rad.
_MAX_LAMP_ANGLE = np.pi / 3
# Cells along the image's width of the grid around it.
_CELLS = 12
# Rows and columns of nodes at the image's border that are extrapolated.
_BORDER = 3
# A view is added when the camera has moved by this angle (rad), or distance relative to the depth,
# since the last one; and the maximum number of views.
_ANGLE, _DISTANCE, _VIEWS = 0.1, 0.05, 100
# Smallest cosine of incidence of surfaces that are added.
_MIN_INCIDENCE = 0.25

# Relative distance from the median depth of a block at which a pixel is on another surface.
_JUMP = 0.03
# Largest rms misfit of a plane, relative to the depth.
_MAX_MISFIT = 0.006


def block_nodes(z: Float32, rays: Float32, amplitude: Float32, step: int) -> Float64:
    """Return the nodes (Hn, Wn, COLUMNS) of an image without planes, see `multipath_kernels`."""
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
        kernels.surface_radiometry(nodes, factor, has_plane, points, normals, values)
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
    Sources as in `multipath_kernels.add_irradiance`.
    """
    out = np.empty((surfaces.has_plane.size, 9), np.float32)
    count = kernels.visible_sources(
        surfaces.has_plane, surfaces.points, surfaces.normals, surfaces.area, radiosity, out
    )
    return out[:count]


class ReflectorMap:
    """Map of the reflecting surfaces of recent views, spaced by the motion of the camera.

    Attributes
    ----------
    patches
        (N, PATCH) in the world frame, see `multipath_kernels.project_patches`.
    """

    def __init__(self) -> None:
        self._views: deque[Float32] = deque(maxlen=_VIEWS)
        self._T: Float64 | None = None  # of the newest view
        self.patches = np.zeros((0, PATCH), np.float32)

    def add(self, surfaces: Surfaces, static: Bool, T_world_camera: Float64) -> None:
        """Add the surfaces of a view at every other node, unless the last view was close.

        Parameters
        ----------
        surfaces
            Of the view.
        static
            (Hn, Wn) nodes that belong to the static scene.
        T_world_camera
            (4, 4) pose of the view.
        """
        illuminated = surfaces.has_plane & (surfaces.albedo > 0)
        if not illuminated.any():
            return
        if self._T is not None:
            motion = se3.inverse(self._T) @ T_world_camera
            min_distance = _DISTANCE * float(np.median(surfaces.range_m[illuminated]))
            if se3.is_within(motion, min_distance, _ANGLE):
                return
        selected = np.zeros_like(illuminated)
        selected[::2, ::2] = (illuminated & static)[::2, ::2]
        points, normals, albedo = (
            values[selected] for values in (surfaces.points, surfaces.normals, surfaces.albedo)
        )
        cosine = -(points * normals).sum(-1) / surfaces.range_m[selected]
        table = np.concatenate([points, normals, albedo[:, None], cosine[:, None]], 1)
        table = table[cosine > _MIN_INCIDENCE]
        R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
        # einsum, not a matrix product: BLAS may sum differently with more threads.
        table[:, :3] = np.einsum("nc,dc->nd", table[:, :3], R) + t
        table[:, 3:6] = np.einsum("nc,dc->nd", table[:, 3:6], R)
        self._views.append(table.astype(np.float32))
        self._T = T_world_camera
        self.patches = np.concatenate(list(self._views))


@dataclass(eq=False)
class OffscreenCells:
    """Illuminated directions outside an image, as cells of the plane z = 1.

    Attributes
    ----------
    pitch
        (2,) sides of a cell.
    rays
        (M, 2) x/z and y/z of the cells' centres.
    fraction
        (M,) illuminated fraction of a cell.
    planes
        (M, 3) a, b, c of the mapped plane 1/z = a x + b y + c in the cell; 0 where unknown.
    albedo
        (M,) its albedo in counts.
    """

    pitch: Float64
    rays: Float64
    fraction: Float64
    planes: Float64
    albedo: Float64

    @classmethod
    def of(cls, rays: Float32, lamp: float) -> OffscreenCells:
        """Build the cells around an image.

        Parameters
        ----------
        rays
            (H, W, 2) x/z and y/z of the image's pixels, NaN where unknown.
        lamp
            Illumination angle relative to that of the image's corner.
        """
        left, right, top, bottom = kernels.ray_bounds(rays).tolist()
        # Rays are those of pixel centres.
        x = (right - left) / (2 * max(rays.shape[1] - 1, 1))
        y = (bottom - top) / (2 * max(rays.shape[0] - 1, 1))
        cells = _cells(left - x, top - y, right + x, bottom + y, lamp)
        return cls(*cells, np.zeros((len(cells[1]), 3)), np.zeros(len(cells[1])))

    def add_reflectors(self, reflectors: ReflectorMap, T_world_camera: Float64) -> None:
        """Set the planes of the cells that contain surfaces of a map."""
        if len(self.rays) and len(reflectors.patches):
            kernels.project_patches(
                reflectors.patches,
                se3.inverse(T_world_camera),
                self.rays,
                self.pitch,
                self.planes,
                self.albedo,
            )

    def sources(self, surfaces: Surfaces, gain: float, wave_number: float) -> Float32:
        """Return light sources (S, 9) outside the image, see `multipath_kernels.add_irradiance`.

        Cells without a mapped surface extrapolate the plane and albedo of the nearest node at the
        image's border.

        Parameters
        ----------
        surfaces
            Of the image.
        gain
            Counts of a white wall at 1 m.
        wave_number
            Phase in rad per m of path.
        """
        border = surfaces.has_plane & (surfaces.albedo > 0)
        border[_BORDER:-_BORDER, _BORDER:-_BORDER] = False
        out = np.empty((len(self.rays), 9), np.float32)
        areas, of_border = self.fraction * self.pitch.prod(), surfaces.albedo[border] / gain
        cells = self.rays, areas, self.planes, self.albedo / gain
        count = kernels.offscreen_sources(
            *cells, surfaces.nodes[border], of_border, wave_number, out
        )
        return out[:count]


@lru_cache(maxsize=16)
def _cells(
    left: float, top: float, right: float, bottom: float, lamp: float
) -> tuple[Float64, Float64, Float64]:
    """Return pitch (2,), rays (M, 2) and illuminated fraction (M,) of the cells."""
    low, high = np.array([left, top]), np.array([right, bottom])
    width, height = high - low
    if not (width > 0 and height > 0):
        return np.ones(2), np.zeros((0, 2)), np.zeros(0)
    count = np.array([_CELLS, max(1, round(_CELLS * height / width))])
    pitch = (high - low) / count
    corner = float(np.arctan(np.sqrt(np.maximum(low**2, high**2).sum())))
    limit = float(np.tan(min(lamp * corner, _MAX_LAMP_ANGLE)))
    first, last = np.floor((-limit - low) / pitch), np.ceil((limit - low) / pitch)
    i, j = (np.arange(a, b) for a, b in zip(first, last, strict=True))
    all_i, all_j = (g.ravel() for g in np.meshgrid(i, j))
    outside = (all_i < 0) | (all_i >= count[0]) | (all_j < 0) | (all_j >= count[1])
    rays = low + (np.stack([all_i, all_j], 1)[outside] + 0.5) * pitch
    # Cells on the border of the illumination are weighted by their illuminated fraction.
    fraction = np.clip((limit - np.sqrt((rays**2).sum(1))) / pitch.mean() + 0.5, 0, 1)
    return pitch, rays[fraction > 0], fraction[fraction > 0]
