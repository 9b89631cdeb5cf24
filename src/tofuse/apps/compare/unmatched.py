"""Measured surface of a part that its reference lacks: deviations too large to be mapped.

A feature that is missing, additional or elsewhere leaves surface for which the reference has none
within reach. If the reference is a solid, such surface belongs to the part, or to something that
touches it; unless it is a support, as a table, with all of the part on its own seen side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tofuse.apps.compare.nearest import Reference
from tofuse.apps.report import scene
from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.geometry import KdTree, unit_vectors

# Points of a place.
FEWEST = 12
# A camera sees a surface from within this angle of its normal, which hides what is behind.
_MIN_COSINE = 0.5
# Parts of the reference that tell what is behind; places at a time.
_PARTS, _CHUNK = 3000, 200
# Places are connected within this many edges, each with this number of the nearest ones.
_NEAR, _NEIGHBOURS = 2.0, 16


@dataclass(frozen=True)
class Unmatched:
    """Connected surface that the reference lacks.

    Attributes
    ----------
    centre_m
        (x, y, z) in the coordinates of the reference, m.
    area_m2
        Its area.
    distance_m
        Largest distance of a place from the reference, m.
    """

    centre_m: tuple[float, float, float]
    area_m2: float
    distance_m: float


def unmatched(
    reference: Reference,
    points: Float64,
    normals: Float64,
    compared: Bool,
    oriented: bool,
    size: float,
    spacing: float,
    limit: float,
) -> tuple[Unmatched, ...]:
    """Return the surface of a part that a solid reference lacks, the largest first.

    Parameters
    ----------
    reference
        What was compared with; nothing is known of what is beyond one that is no solid.
    points, normals
        (N, 3) measured, in its coordinates.
    compared
        (N,) which have a counterpart.
    oriented
        Whether the sides of the normals are known.
    size, spacing
        Edge of a place and of the surface of a point, m.
    limit
        Mean distance of a place from the reference, however it faces, that is no deviation, m.
    """
    if not reference.is_solid:
        return ()
    rest = np.flatnonzero(~compared)
    # Places of one direction each: between a table and what stands on it there is none.
    label, count = _cells(points[rest], normals[rest], size)
    distance = np.linalg.norm(points[rest] - reference.nearest(points[rest]), axis=1)
    sums = [np.bincount(label, v) for v in (*points[rest].T, *normals[rest].T, distance)]
    mean = np.stack(sums, 1) / np.maximum(count, 1)[:, None]
    kept = (count >= FEWEST) & (mean[:, 6] > limit)
    kept[kept] = _hides(reference, mean[kept, :3], unit_vectors(mean[kept, 3:6]), oriented)
    if not kept.any():
        return ()
    centres, count, distance = mean[kept, :3], count[kept], mean[kept, 6]
    component = _components(centres, _NEAR * size)
    touching = KdTree(points[compared]).nearest(centres, _NEAR * size)[0] >= 0
    found = []
    for k in np.unique(component[touching]):
        of = component == k
        x, y, z = np.average(centres[of], axis=0, weights=count[of]).tolist()
        area = float(count[of].sum()) * spacing**2
        found.append(Unmatched((x, y, z), area, float(distance[of].max())))
    return tuple(sorted(found, key=lambda each: -each.area_m2))


def _cells(points: Float64, normals: Float64, size: float) -> tuple[Intp, Intp]:
    """Return the cell (n,) of each point, by place and direction, and the points of each."""
    axis = np.abs(normals).argmax(1) if len(normals) else np.zeros(0, np.intp)
    sign = np.take_along_axis(normals, axis[:, None], 1)[:, 0] > 0
    key = np.column_stack([np.floor(points / size).astype(np.int64), axis, sign])
    _, label, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    return label.ravel(), count


def _hides(reference: Reference, places: Float64, facing: Float64, oriented: bool) -> Bool:
    """(K,) whether some of the reference is behind a place, for cameras that see the place."""
    parts = reference.centres[scene.random_subset(len(reference.centres), _PARTS)]
    hides = np.zeros(len(places), bool)
    for a in range(0, len(places), _CHUNK):
        offset = parts - places[a : a + _CHUNK, None]
        cosine = -(offset * facing[a : a + _CHUNK, None]).sum(-1) / np.linalg.norm(offset, axis=-1)
        hides[a : a + _CHUNK] = ((cosine if oriented else np.abs(cosine)) > _MIN_COSINE).any(1)
    return hides


def _components(places: Float64, limit: float) -> Intp:
    """Return the component (K,) of each place, of those connected by steps up to a limit."""
    index, distance2 = KdTree(places).neighbours(places, min(_NEIGHBOURS, len(places)))
    near = distance2 <= limit**2
    rows = np.broadcast_to(np.arange(len(places))[:, None], index.shape)[near]
    graph = coo_array((np.ones(len(rows)), (rows, index[near])), shape=(len(places),) * 2)
    return np.asarray(connected_components(graph, directed=False)[1], np.intp)
