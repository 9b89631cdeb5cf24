"""Planes of a model, and the regions of a plane through which views measure what is behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from tofuse.apps.mirrors.views import RAYS, Noise, View
from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.geometry import tangents, unit_rays

# Planes: number of hypotheses and of points that vote, fewest of them on a plane, and the
# smallest cosine between its normal and those of its points.
_HYPOTHESES, _VOTERS, _MIN_SHARE, _MIN_COSINE = 300, 6000, 0.01, 0.9
_MAX_PLANES = 16
_MIN_INCIDENCE = 0.08  # smallest cosine between a ray and the plane's normal
# An opening: minimum number of cells, of rays in a cell, share of an opening's convex hull that it
# fills, and share of its border where the plane is a surface; the last two also for a whole one,
# whose outline noise may fray, but whose border is closed.
_MIN_CELLS, _MIN_RAYS, _MIN_CONVEXITY, _MIN_FRAME = 12, 3, 0.7, 0.3
_WHOLE_CONVEXITY, _WHOLE_FRAME = 0.78, 0.8
_RING_M = 0.2  # of the surface around an opening


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane ``normal . p = offset`` with (3,) unit normal towards the cameras."""

    normal: Float64
    offset: float

    def height(self, points: Float64) -> Float64:
        """Signed distances (N,) of points (N, 3): above 0 in front."""
        return points @ self.normal - self.offset

    def reflected(self, points: Float64) -> Float64:
        """Mirror images (N, 3) of points."""
        return points - 2 * self.height(points)[..., None] * self.normal

    @property
    def axes(self) -> Float64:
        """(2, 3) orthonormal axes in the plane."""
        return tangents(self.normal)

    def crossings(self, origin: Float64, rays: Float64) -> Float64:
        """Distance (N,) along unit rays from a point in front; not finite where they miss it."""
        slope = -(rays @ self.normal)
        reached = slope > _MIN_INCIDENCE
        return np.where(reached, self.height(origin) / np.where(reached, slope, 1), np.inf)


def find_planes(
    points: Float64, normals: Float64, tolerance: float, rng: np.random.Generator
) -> list[Plane]:
    """Return the large planes of points (N, 3) with normals, the one with the most points first."""
    chosen = rng.permutation(len(points))[:_VOTERS]
    points, normals = points[chosen], normals[chosen]
    planes: list[Plane] = []
    while len(planes) < _MAX_PLANES and len(points) > max(3, _MIN_SHARE * len(chosen)):
        seeds = rng.integers(len(points), size=_HYPOTHESES)
        n = normals[seeds]
        d = (n * points[seeds]).sum(1)
        votes = (np.abs(points @ n.T - d) < tolerance) & (normals @ n.T > _MIN_COSINE)
        on = votes[:, votes.sum(0).argmax()]
        if on.sum() < max(3, _MIN_SHARE * len(chosen)):
            break
        mean = points[on].mean(0)
        normal = np.linalg.svd(points[on] - mean, full_matrices=False)[2][2]
        normal *= np.sign(normal @ normals[on].mean(0)) or 1.0
        planes.append(Plane(normal, float(normal @ mean)))
        points, normals = points[~on], normals[~on]
    return planes


@dataclass(frozen=True, eq=False)
class Opening:
    """A convex region of a plane through which something is seen.

    Attributes
    ----------
    outline
        (K, 2) corners in the axes of the plane, m.
    whole
        Whether it is convex and surrounded by surface; else it may be a part of an opening.
    """

    plane: Plane
    outline: Float64
    whole: bool

    @property
    def area_m2(self) -> float:
        """Of the outline."""
        return float(cv2.contourArea(self.outline.astype(np.float32)))

    @property
    def corners(self) -> Float64:
        """(K, 3) the outline in the world."""
        return self.outline @ self.plane.axes + self.plane.offset * self.plane.normal

    def contains(self, points: Float64) -> Bool:
        """Whether points (N, 3) of the plane are within the outline."""
        flat = points @ self.plane.axes.T
        ahead = np.roll(self.outline, -1, axis=0) - self.outline
        sides = [
            e[0] * (flat[:, 1] - p[1]) - e[1] * (flat[:, 0] - p[0])
            for p, e in zip(self.outline, ahead, strict=True)
        ]
        return np.all(np.array(sides) >= 0, axis=0) | np.all(np.array(sides) <= 0, axis=0)

    def behind(self, points: Float64, origins: Float64) -> Bool:
        """Whether each point (N, 3) is seen through the opening from one of the origins (M, 3)."""
        out = np.zeros(len(points), bool)
        rows = np.flatnonzero(self.plane.height(points) < 0)
        for origin in origins[self.plane.height(origins) > 0]:
            rays = points[rows] - origin
            at = self.plane.height(origin) / -(rays @ self.plane.normal)
            out[rows] = self.contains(origin + at[:, None] * rays)
            rows = rows[~out[rows]]
        return out

    def seen_by(self, view: View, margin: float) -> bool:
        """Whether a view from before the plane has a part of the opening in its image."""
        corners = self.corners
        inner = corners.mean(0) + np.linspace(0, 1, 5)[:, None, None] * (corners - corners.mean(0))
        in_image = view.project(inner.reshape(-1, 3))[2]
        return bool(self.plane.height(view.origin) > margin) and bool(in_image.any())

    def tilt_rad(self, points: Float64, normals: Float64, margin: float) -> float:
        """Angle between the plane and the surface (N, 3) around the opening that is in it.

        Infinite if most of what is there does not face the same way: the plane is no surface. Less
        than half of it may be furniture in front.
        """
        near = np.abs(self.plane.height(points)) < margin
        near[near] = self.grown(_RING_M).contains(points[near]) & ~self.contains(points[near])
        facing = normals[near] @ self.plane.normal > _MIN_COSINE
        if facing.sum() <= 0.5 * len(facing):
            return np.inf
        mean = normals[near][facing].sum(0)
        return float(np.arccos(min(1, mean @ self.plane.normal / np.linalg.norm(mean))))

    def crossed_by(self, path: Float64) -> bool:
        """Whether a camera that moves from each of the places (M, 3) to the next passes it."""
        height = self.plane.height(path)
        at = np.flatnonzero(height[:-1] * height[1:] < 0)
        part = height[at] / (height[at] - height[at + 1])
        places = path[at] + part[:, None] * (path[at + 1] - path[at])
        return bool(self.contains(places).any())

    def joined(self, other: Opening) -> Opening:
        """Return the smallest convex opening of both, in this one's plane."""
        corners = np.concatenate([self.corners, other.corners]) @ self.plane.axes.T
        return replace(self, outline=_hull(corners))

    def grown(self, margin: float) -> Opening:
        """Return the opening, larger by `margin` m to all sides."""
        turn = np.linspace(0, 2 * np.pi, 16, endpoint=False)
        circle = margin * np.stack([np.cos(turn), np.sin(turn)], -1)
        return replace(self, outline=_hull((self.outline[:, None] + circle).reshape(-1, 2)))


def _hull(points: Float64) -> Float64:
    """Corners (K, 2) of the convex hull of points (N, 2)."""
    return np.asarray(cv2.convexHull(points.astype(np.float32))[:, 0], np.float64)


def find_openings(plane: Plane, views: Sequence[View], noise: Noise) -> list[Opening]:
    """Return the openings of a plane: regions where more rays pass than end in it."""
    places, passed, pitches = [], [], []
    margin = 2 * noise.tolerance_m
    for view in views:
        if plane.height(view.origin) < 2 * margin:
            continue
        step = view.step
        measured = view.ranges[::step, ::step].ravel()
        rays = unit_rays(view.camera.rays()[::step, ::step].reshape(-1, 2))
        rays = rays @ view.T_world_camera[:3, :3].T
        reached = plane.crossings(view.origin, rays)
        depth = (measured - reached) * np.abs(rays @ plane.normal)
        # Where nothing returns, the plane is no surface either.
        depth[(measured <= 0) | view.too_short.ravel()] = np.inf
        used = np.isfinite(reached) & (depth > -margin)
        q = view.origin + reached[used, None] * rays[used]
        places.append(q @ plane.axes.T)
        passed.append(depth[used] > margin)
        pitches.append(np.median(reached[used]) if used.any() else np.nan)
    if not places or not sum(map(len, places)):
        return []
    flat, through = np.concatenate(places), np.concatenate(passed)
    ends = flat[~through]
    if len(ends) < _MIN_CELLS * _MIN_RAYS or not through.any():
        return []
    # What is far beyond the surface in the plane is not an opening in it.
    low, high = np.quantile(ends, 0.005, axis=0) - 0.1, np.quantile(ends, 0.995, axis=0) + 0.1
    field = np.tan(views[0].corner_rad) * 2 / np.sqrt(2 * min(RAYS, views[0].ranges.size))
    cell = float(max(field * np.nanmedian(pitches), (high - low).max() / 1000))
    shape = np.ceil((high - low) / cell).astype(int)
    return _regions(plane, flat, through, low, cell, shape)


def _regions(
    plane: Plane, flat: Float64, through: Bool, low: Float64, cell: float, shape: Float64
) -> list[Opening]:
    """Label the cells of a grid in the plane through which rays pass."""
    edges = [low[k] + cell * np.arange(shape[k] + 1) for k in range(2)]
    rays, passing = (
        cv2.boxFilter(
            np.histogram2d(p[:, 0], p[:, 1], bins=edges)[0],
            -1,
            (3, 3),
            normalize=False,
            borderType=cv2.BORDER_CONSTANT,
        )
        for p in (flat, flat[through])
    )
    is_open = ((rays >= _MIN_RAYS) & (passing > 0.5 * rays)).astype(np.uint8)
    is_surface = ((rays >= _MIN_RAYS) & (passing < 0.5 * rays)).astype(np.uint8)
    # Without what is thinner than three cells.
    count, labels = cv2.connectedComponents(
        cv2.morphologyEx(is_open, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    )
    openings = []
    for label in range(1, count):
        # Without holes: pixels of noise.
        contours, _ = cv2.findContours(
            (labels == label).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        region = cv2.drawContours(np.zeros(labels.shape, np.uint8), contours, -1, 1, cv2.FILLED)
        region = cv2.morphologyEx(region, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        cells = int(region.sum())
        if cells < _MIN_CELLS:
            continue
        rows, columns = np.nonzero(region)
        square = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
        hull = _hull((np.stack([rows, columns], 1)[:, None] + square).reshape(-1, 2))
        border = cv2.dilate(region, np.ones((5, 5), np.uint8)) > region
        convexity = cells / max(cv2.contourArea(hull.astype(np.float32)), 1e-9)
        framed = float(is_surface[border].mean()) if border.any() else 0.0
        if convexity < _MIN_CONVEXITY or framed < _MIN_FRAME:
            continue
        whole = convexity > _WHOLE_CONVEXITY and framed > _WHOLE_FRAME
        # Pixels that look partly into a mirror measure beyond its frame: by half of one, a cell.
        inner = _hull(np.stack([rows, columns], 1).astype(np.float64) + 0.5)
        openings.append(Opening(plane, low + cell * inner, whole))
    return openings
