"""Measured surface of a part that its reference lacks or hides: deviations that can't be mapped.

A feature that is missing, additional or elsewhere leaves surface for which the reference has none
within reach. If the reference is a solid, such surface belongs to the part, or to something that
touches it; unless it is a support, as a table, with all of the part on its own seen side. A hole
that is not drawn, or a boss that is missing, reveals what is behind the reference for all cameras.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from tofuse.apps.compare.nearest import Distances, Reference, directions
from tofuse.apps.report import scene
from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.connections import parts_of
from tofuse.engine.geometry import KdTree, unit_vectors

# Points of a place.
FEWEST = 12
# A camera sees a surface from within this angle of its normal, which hides what is behind.
_MIN_COSINE = 0.5
# Parts of the reference that tell what is behind; places at a time.
_PARTS, _CHUNK = 3000, 200
# The angle from its normal up to which a surface may have been seen; elements of the reference that
# stop a ray, of the nearest ones, within a fraction of their size; those beside one; and cameras.
_MIN_SEEN_COSINE, _STOPPING, _STOPPED, _BESIDE, _MAX_EYES = 0.2, 8, 0.6, 9, 100
# Points are connected within this many edges, each with this number of the nearest ones.
_NEAR, _NEIGHBOURS = 2.0, 16


@dataclass(frozen=True)
class Unmatched:
    """Connected surface that the reference lacks or hides.

    Attributes
    ----------
    centre_m
        (x, y, z) in the coordinates of the reference, m.
    area_m2
        Its area.
    distance_m
        Largest distance of a point from the reference, or behind it, m.
    """

    centre_m: tuple[float, float, float]
    area_m2: float
    distance_m: float


def unmatched(
    reference: Reference,
    points: Float64,
    normals: Float64,
    found: Distances,
    oriented: bool,
    size: float,
    spacing: float,
    tolerance: float,
    noise: float,
    eyes: Float64,
) -> tuple[Unmatched, ...]:
    """Return the surface of a part that a solid reference lacks or hides, the largest first.

    Parameters
    ----------
    reference
        What was compared with; nothing is known of what is beyond one that is no solid.
    points, normals
        (N, 3) measured, in its coordinates.
    found
        Their distances: which have a counterpart, and where.
    oriented
        Whether the sides of the normals are known.
    size, spacing
        Edge of a place and of the surface of a point, m.
    tolerance, noise
        Distances that are allowed, and that noise explains, m.
    eyes
        (E, 3) places of the cameras; none if they are not known, and nothing is hidden then.
    """
    if not reference.is_solid:
        return ()
    # Rounding moves a surface at an edge by less than its spacing.
    known = spacing + noise
    behind = _behind(reference, points, normals, oriented, max(tolerance, known), eyes)
    distance = np.maximum(
        behind, _beyond(reference, points, normals, found, oriented, size, tolerance, known, noise)
    )
    kept = np.flatnonzero(distance)
    if not len(kept):
        return ()
    points_kept = points[kept]
    component = _components(points_kept, _NEAR * size)
    touching = KdTree(points[found.compared]).nearest(points_kept, _NEAR * size)[0] >= 0
    made = []
    for k in np.unique(component[touching]):
        of = component == k
        if of.sum() >= FEWEST:
            x, y, z = points_kept[of].mean(0).tolist()
            area = float(of.sum()) * spacing**2
            made.append(Unmatched((x, y, z), area, float(distance[kept][of].max())))
    return tuple(sorted(made, key=lambda each: -each.area_m2))


def _beyond(
    reference: Reference,
    points: Float64,
    normals: Float64,
    found: Distances,
    oriented: bool,
    size: float,
    tolerance: float,
    known: float,
    noise: float,
) -> Float64:
    """(N,) how far surface without counterpart extends from the reference, m.

    It is 0 where that may be a support, or is too near for what is known.
    """
    made = np.zeros(len(points))
    direction = directions(normals)
    rest = np.flatnonzero(~found.compared)
    # Places of one direction each: between a table and what stands on it there is none.
    key = np.column_stack([np.floor(points[rest] / size).astype(np.int64), direction[rest]])
    _, label, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    label = label.ravel()
    sums = [np.bincount(label, v) for v in (*points[rest].T, *normals[rest].T)]
    mean = np.stack(sums, 1) / np.maximum(count, 1)[:, None]
    hides = _hides(reference, mean[:, :3], unit_vectors(mean[:, 3:]), oriented)
    rest = rest[hides[label]]
    if len(rest) < FEWEST or not found.compared.any():
        return made
    apart = points + direction[:, None] * np.array([2 * np.ptp(points, axis=0).max(), 0, 0])
    near, distance2 = KdTree(apart[rest]).neighbours(apart[rest], FEWEST)
    distance = np.linalg.norm(points[rest] - reference.nearest(points[rest]), axis=1)[near]
    # A face that goes on beyond its border has distances from 0 to its width; so has what leads
    # from a border to a support, but not in the plane of the face.
    end = distance.mean(1) + 3**0.5 * distance.std(1)
    compared = np.flatnonzero(found.compared)
    beside = compared[KdTree(apart[compared]).nearest(apart[rest])[0]]
    off = ((points[rest] - found.feet[beside]) * found.normals[beside]).sum(1)[near]
    lacking = (np.abs(np.median(off, 1)) < noise) & (end > max(tolerance, known))
    lacking |= distance.mean(1) > tolerance + known
    made[rest] = np.where(lacking & (distance2[:, -1] < size**2), end, 0.0)
    return made


def _behind(
    reference: Reference,
    points: Float64,
    normals: Float64,
    oriented: bool,
    limit: float,
    eyes: Float64,
) -> Float64:
    """(N,) how far the reference is in front of a point for all cameras that it faces, m.

    It is 0 where one may have seen the point. The outline, which may be off by the limit, hides
    nothing.
    """
    if not len(eyes):
        return np.zeros(len(points))
    centre = reference.centres.mean(0)
    behind = np.full(len(points), np.inf)
    left = np.flatnonzero(np.linalg.norm(points - centre, axis=1) < reference.diagonal)
    parts, facing = reference.centres, reference.normals
    beside = KdTree(parts).neighbours(parts, min(_BESIDE, len(parts)))[0]
    # The other side of a sheet is near, but not beside.
    beside = np.where(
        (facing[beside] * facing[:, None]).sum(2) > -_MIN_COSINE, beside, beside[:, :1]
    )
    for eye in eyes[scene.random_subset(len(eyes), _MAX_EYES)]:
        offset = points[left] - eye
        cosine = -(unit_vectors(offset) * normals[left]).sum(1)
        sees = (cosine if oriented else np.abs(cosine)) > _MIN_SEEN_COSINE
        asked, far = left[sees], np.linalg.norm(offset[sees], axis=1)
        to_part = parts - eye
        depth = np.linalg.norm(to_part, axis=1)
        facing_eye = -(to_part * facing).sum(1) / depth
        outline = (facing_eye > 0) & (facing_eye[beside] < 0).any(1)
        front = facing_eye > _MIN_SEEN_COSINE
        front[front] = KdTree(parts[outline]).nearest(parts[front], limit)[0] < 0
        if not len(asked) or front.sum() < _STOPPING:
            behind[asked] = 0.0
        else:
            tree = KdTree(unit_vectors(to_part[front]))
            index, beside2 = tree.neighbours(unit_vectors(offset[sees]), _STOPPING)
            depth = depth[front][index]
            gap = (far[:, None] - depth) * facing_eye[front][index]
            stops = np.sqrt(beside2) * depth < _STOPPED * reference.size
            gap = np.where(stops & (gap > limit), gap, 0.0).max(1)
            behind[asked] = np.minimum(behind[asked], gap)
        left = left[behind[left] > 0]
        if len(left) < FEWEST:
            break
    return np.where(np.isfinite(behind), behind, 0.0)


def _hides(reference: Reference, places: Float64, facing: Float64, oriented: bool) -> Bool:
    """(K,) whether some of the reference is behind a place, for cameras that see the place."""
    parts = reference.centres[scene.random_subset(len(reference.centres), _PARTS)]
    hides = np.zeros(len(places), bool)
    for a in range(0, len(places), _CHUNK):
        at, n = places[a : a + _CHUNK], facing[a : a + _CHUNK]
        cosine = ((at * n).sum(1)[:, None] - n @ parts.T) / cdist(at, parts)
        hides[a : a + _CHUNK] = ((cosine if oriented else np.abs(cosine)) > _MIN_COSINE).any(1)
    return hides


def _components(places: Float64, limit: float) -> Intp:
    """Return the component (K,) of each place, of those connected by steps up to a limit."""
    index, distance2 = KdTree(places).neighbours(places, min(_NEIGHBOURS, len(places)))
    near = distance2 <= limit**2
    rows = np.broadcast_to(np.arange(len(places))[:, None], index.shape)[near]
    return parts_of(len(places), np.stack([rows, index[near]], 1))
