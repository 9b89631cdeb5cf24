"""The surface that is compared with: signed distances from its triangles, and its regions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tofuse.apps.compare.surface import Surface, spacing_of
from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.connections import parts_of
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import KdTree, unit_vectors
from tofuse.engine.geometry import triangles as triangle_geometry

# Longest edge of a triangle after its division, as a fraction of the diagonal, and with which there
# are at most this many triangles.
_EDGE_FRACTION, _MAX_TRIANGLES = 0.015, 300_000
# Nearest triangles by their centres of which the nearest one is taken, and points at a time.
_CANDIDATES, _CHUNK = 6, 50_000
# Surfaces facing further apart are different ones, as the two sides of a sheet.
_MIN_COSINE = 0.5
# Reach of a comparison: fraction of the diagonal, tolerances, and spacings of the points; beside a
# border, as a fraction of the distance, and in spacings.
_REACH_FRACTION, _REACH_TOLERANCES, _REACH_SPACINGS = 0.03, 5.0, 6.0
_BESIDE, _BESIDE_SPACINGS = 0.2, 2.0
# An edge between faces is sharp beyond this angle, rad.
_SHARP_RAD = 0.44
# A mesh with faces of this fraction of its area each, which cover most of it, has faces as a CAD
# model has; there are not more.
_MIN_FACE, _MIN_COVERED, _MAX_FACES = 0.002, 0.9, 300
# A surface is closed if its normals cancel up to this fraction of its area, and its volume is the
# same along all axes up to the second one, as along the axis of an open tube it is none. Thin walls
# have little volume beside what a crack changes.
_MAX_GAP, _MAX_VOLUME_GAP = 0.02, 0.25
# Vertices with which a mesh is not coarse.
_COARSE = 5000
# Edge of a region of other surfaces, as a fraction of the diagonal.
_REGION_FRACTION = 0.25
# Axes of the directions by which curved faces are divided; oblique, so that flat ones are not.
_AXES = np.linalg.qr(np.array([[1.0, 0.13, 0.29], [-0.17, 1.0, 0.21], [-0.23, -0.19, 1.0]]))[0]


@dataclass(frozen=True)
class Reach:
    """How far surfaces are compared, m: `along` the normal and `beside` a border or edge."""

    along: float
    beside: float

    @classmethod
    def of(cls, reference: Reference, spacing: float, tolerance_m: float | None = None) -> Reach:
        """Return the reach for points of a spacing, m."""
        limits = (
            _REACH_FRACTION * reference.diagonal,
            _REACH_TOLERANCES * (tolerance_m or 0.0),
            _REACH_SPACINGS * spacing,
        )
        return cls(max(limits), _BESIDE_SPACINGS * spacing)


@dataclass(frozen=True, eq=False)
class Distances:
    """Of n points from a surface.

    Attributes
    ----------
    signed
        (n,) m, positive on the outside; NaN where there is no surface to compare with.
    feet, normals
        (n, 3) nearest points of the surface, and its unit normals there.
    element
        (n,) the triangle, or point of a cloud.
    """

    signed: Float64
    feet: Float64
    normals: Float64
    element: Intp

    @cached_property
    def compared(self) -> Bool:
        """(n,) whether there is a surface."""
        return np.isfinite(self.signed)


@dataclass(frozen=True, eq=False)
class Reference:
    """A surface as small triangles, or as the planes of points.

    Attributes
    ----------
    surface
        As it was read.
    triangles
        (M, 3, 3); a cloud's are points, three times each.
    normals, area
        (M, 3) unit normals, and (M,) m^2.
    region
        (M,) number of the region, the largest first.
    edges
        (E, 3) points on the sharp edges and borders between faces.
    size
        Longest edge of a triangle, or spacing of a cloud, m.
    has_faces
        Whether regions are faces of a CAD model.
    sigma
        (M,) standard deviation of its own noise, m; None where not known.
    """

    surface: Surface
    triangles: Float64
    normals: Float64
    area: Float64
    region: Intp
    edges: Float64
    size: float
    has_faces: bool
    sigma: Float64 | None = None

    @classmethod
    def of(cls, surface: Surface) -> Reference:
        """Divide a surface; a solid whose faces are all inside out is turned."""
        if surface.faces is None:
            size = spacing_of(surface.points)
            points = np.repeat(surface.points[:, None], 3, axis=1)
            area = np.full(len(points), size**2)
            region = _cells(surface.points, surface.normals)
            none = np.zeros((0, 3))
            return cls(
                surface, points, surface.normals, area, region, none, size, False, surface.sigma
            )._sorted()
        corners = surface.points[surface.faces]
        cross = triangle_geometry.crosses(corners)
        area = 0.5 * np.linalg.norm(cross, axis=1)
        if not area.sum() > 0:
            raise InputError("has faces without area", where=surface.name)
        kept = area > 0
        corners, cross, area = corners[kept], cross[kept], area[kept]
        label, edges = _smooth_faces(corners, unit_vectors(cross))
        share = np.bincount(label, area) / area.sum()
        large = share >= _MIN_FACE
        has_faces = bool(share[large].sum() >= _MIN_COVERED and large.sum() <= _MAX_FACES)
        diagonal = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
        size = max(_EDGE_FRACTION * diagonal, 2 * float(np.sqrt(area.sum() / _MAX_TRIANGLES)))
        triangles, source = _divided(corners, size)
        normals = unit_vectors(cross)[source]
        if has_faces:
            region = label[source] * 6 + directions(normals @ _AXES)
        else:
            region, edges = _cells(triangles.mean(1), normals), np.zeros((0, 3))
        sigma = surface.sigma
        if sigma is not None:
            sigma = sigma[surface.faces].mean(1)[kept][source]
        parts = triangle_geometry.areas(triangles)
        made = cls(
            surface, triangles, normals, parts, region, edges, size, has_faces, sigma
        )._sorted()
        inside_out = made.is_solid and np.trace(made._moments) < 0
        return replace(made, normals=-made.normals) if inside_out else made

    def _sorted(self) -> Reference:
        """Number the regions by their area."""
        _, region = np.unique(self.region, return_inverse=True)
        rank = np.argsort(np.argsort(-np.bincount(region, self.area), kind="stable"))
        return replace(self, region=rank[region])

    @cached_property
    def centres(self) -> Float64:
        """(M, 3) of the triangles."""
        return np.asarray(self.triangles.mean(1))

    @cached_property
    def _tree(self) -> KdTree:
        return KdTree(self.centres)

    @cached_property
    def diagonal(self) -> float:
        """Of the box around the surface, m."""
        return float(np.linalg.norm(np.ptp(self.triangles.reshape(-1, 3), axis=0)))

    @cached_property
    def is_solid(self) -> bool:
        """Whether it encloses a volume, up to cracks between faces; by the divergence theorem."""
        if self.surface.faces is None:
            return False
        total = (self.area[:, None] * self.normals).sum(0)
        volume = np.trace(self._moments) / 3
        gap = np.abs(self._moments - volume * np.eye(3)).max()
        is_open = np.linalg.norm(total) > _MAX_GAP * self.area.sum()
        return bool(not is_open and gap <= _MAX_VOLUME_GAP * abs(volume))

    @cached_property
    def _moments(self) -> Float64:
        """(3, 3) integral of position times normal: the volume of a solid on the diagonal."""
        return (self.centres - self.centres.mean(0)).T @ (self.area[:, None] * self.normals)

    def nearest(self, points: Float64) -> Float64:
        """Return the nearest points (n, 3) of the surface, whichever way it faces."""
        parts = [
            self._nearest(part, np.zeros_like(part), False)[0]
            for part in (points[a : a + _CHUNK] for a in range(0, max(len(points), 1), _CHUNK))
        ]
        return np.concatenate(parts)

    def distances(
        self, points: Float64, normals: Float64, reach: Reach, *, oriented: bool = True
    ) -> Distances:
        """Return the distances of points (n, 3) with normals (n, 3), within reach.

        A surface that faces elsewhere is another one. Beyond a border there is none.
        """
        # Triangles beyond have no point within reach, and a search for them takes long.
        beside = max(reach.beside, _BESIDE * reach.along, self.size)
        limit = float(np.hypot(reach.along, beside)) + self.size
        parts = [
            self._nearest(points[a : a + _CHUNK], normals[a : a + _CHUNK], oriented, limit)
            for a in range(0, max(len(points), 1), _CHUNK)
        ]
        feet, element = (np.concatenate(each) for each in zip(*parts, strict=True))
        n = self.normals[element]
        offset = points - feet
        along = (offset * n).sum(1)
        beside = np.sqrt(np.maximum((offset**2).sum(1) - along**2, 0.0))
        # Noise moves points beside convex edges, and coarse facets are at angles.
        allowed = np.maximum(np.minimum(np.abs(along), reach.beside), _BESIDE * np.abs(along))
        if self.surface.faces is None:
            allowed = np.maximum(allowed, self.size)
        outside = (beside > allowed + 1e-9) | (np.abs(along) > reach.along)
        outside |= ~self._facing(n, normals, oriented)
        return Distances(np.where(outside, np.nan, along), feet, n, element)

    def _facing(self, n: Float64, normals: Float64, oriented: bool) -> Bool:
        cosine = (n * normals).sum(-1)
        if not (oriented and self.surface.oriented):
            cosine = np.abs(cosine)
        return np.asarray((cosine > _MIN_COSINE) | ~normals.any(-1))

    def _nearest(
        self, points: Float64, normals: Float64, oriented: bool, limit: float = np.inf
    ) -> tuple[Float64, Intp]:
        """Return the nearest point (n, 3) of triangles facing alike, and the triangle (n,).

        Any triangle if the centre of none is within the limit.
        """
        k = min(_CANDIDATES, len(self.triangles))
        index = self._tree.neighbours(points, k, limit)[0]
        index = np.where(index < 0, index[:, :1], index)
        if self.surface.faces is None:
            feet = self.centres[index]
        else:
            feet = triangle_geometry.closest_points(points[:, None], self.triangles[index])
        distance = np.linalg.norm(feet - points[:, None], axis=2)
        facing = self._facing(self.normals[index], normals[:, None], oriented)
        best = np.where(facing, distance, distance + 2 * self.diagonal).argmin(1)
        rows = np.arange(len(points))
        return feet[rows, best], index[rows, best]


def _divided(triangles: Float64, size: float) -> tuple[Float64, Intp]:
    """Halve triangles at their longest edge until it is at most `size`; also their sources."""
    source = np.arange(len(triangles))
    done: list[tuple[Float64, Intp]] = []
    while len(triangles):
        length = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2)
        small = length.max(1) <= size
        done.append((triangles[small], source[small]))
        triangles, source, length = triangles[~small], source[~small], length[~small]
        order = (length.argmax(1)[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(triangles, order[..., None], 1), 1, 0)
        middle = 0.5 * (a + b)
        triangles = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
        source = np.concatenate([source, source])
    parts, sources = zip(*done, strict=True)
    return np.concatenate(parts), np.concatenate(sources)


def _smooth_faces(corners: Float64, normals: Float64) -> tuple[Intp, Float64]:
    """Return the smooth face of each triangle, and points on sharp edges and borders."""
    scale = max(float(np.ptp(corners.reshape(-1, 3), axis=0).max()), 1e-12)
    rounded = np.round(corners.reshape(-1, 3) / (1e-6 * scale)).astype(np.int64)
    _, vertex = np.unique(rounded, axis=0, return_inverse=True)
    ends = vertex.reshape(-1, 3)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    places = corners[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2, 3)
    face = np.repeat(np.arange(len(corners)), 3)
    _, edge, count = np.unique(np.sort(ends, 1), axis=0, return_inverse=True, return_counts=True)
    edge = edge.ravel()
    order = np.argsort(edge, kind="stable")
    first = np.cumsum(count) - count
    paired = count == 2
    a, b = face[order[first[paired]]], face[order[first[paired] + 1]]
    smooth = (normals[a] * normals[b]).sum(1) > np.cos(_SHARP_RAD)
    label = parts_of(len(corners), np.stack([a[smooth], b[smooth]], 1))
    is_sharp = np.ones(len(count), bool)
    is_sharp[np.flatnonzero(paired)[smooth]] = False
    sharp = places[order[first[is_sharp]]]
    step = _EDGE_FRACTION * scale / 2
    steps = np.maximum(np.ceil(np.linalg.norm(sharp[:, 1] - sharp[:, 0], axis=1) / step), 1)
    row = np.repeat(np.arange(len(sharp)), steps.astype(int) + 1)
    along = (np.arange(len(row)) - np.searchsorted(row, row)) / steps[row]
    points = sharp[row, 0] + along[:, None] * (sharp[row, 1] - sharp[row, 0])
    return label, points


def _cells(points: Float64, normals: Float64) -> Intp:
    """Return the region of each place of a surface without faces: by its cell and direction."""
    edge = max(_REGION_FRACTION * float(np.linalg.norm(np.ptp(points, axis=0))), 1e-9)
    cell = np.floor((points - points.min(0)) / edge).astype(np.int64)
    place = (cell[:, 0] * 8 + cell[:, 1]) * 8 + cell[:, 2]
    return np.asarray(place * 6 + directions(normals @ _AXES))


def directions(normals: Float64) -> Intp:
    """(N,) number of the axis, and its sign, that each normal is nearest to."""
    axis = np.abs(normals).argmax(1)
    return np.asarray(2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] > 0))


def measured_points(surface: Surface, reference: Reference) -> Surface:
    """Return a surface whose points are spread over it, as those of a scan are.

    Vertices of a coarse mesh are at its corners: the centres of its parts replace them.
    """
    if surface.faces is None or len(surface.points) >= _COARSE:
        return surface
    corners = surface.points[surface.faces]
    triangles, source = _divided(corners, reference.size)
    normals = unit_vectors(triangle_geometry.crosses(corners[source]))
    sigma = None if surface.sigma is None else surface.sigma[surface.faces].mean(1)[source]
    return replace(surface, points=triangles.mean(1), normals=normals, faces=None, sigma=sigma)
