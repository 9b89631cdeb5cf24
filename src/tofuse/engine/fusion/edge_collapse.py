"""Edge collapse by quadric error (Garland and Heckbert 1997), by fast-simplification."""

from __future__ import annotations

from threading import Lock

import numpy as np

from tofuse.engine.arrays import Float32, Float64, Int32, Intp

# The library collapses edges in 100 passes: in pass k those with an error, the sum of squared
# distances from planes, below 1e-9 (k + 3) ** _GROWTH. So the limit of a distance starts at 1.6e-4
# and grows 200-fold. With a slow growth edges are collapsed nearly in the order of their errors.
_AGGRESSIVENESS = 3
# Unit of length in the library, relative to the spacing of the vertices: the limit starts at 3 % of
# the spacing, whatever the size of the object.
_UNITS_PER_SPACING = 200.0
# If these passes do not suffice, more follow with a larger unit, unless they remove hardly any.
_UNIT_FACTOR, _MIN_REMOVED = 100.0, 0.1

# The library's state is global.
_LOCK = Lock()


def collapse_edges(
    vertices: Float32, faces: Int32, count: int, spacing: float
) -> tuple[Intp, Float64]:
    """Collapse edges until at most `count` triangles remain, or no more can be removed.

    Parameters
    ----------
    vertices
        (N, 3) m, finite.
    faces
        (M, 3) rows of vertices. None is degenerate.
    count
        Number of triangles to reach.
    spacing
        Distance between neighbouring vertices, m.

    Returns
    -------
    group
        (N,) number of the group of vertices that were merged into one.
    positions
        (G, 3) position of each group, m.
    """
    from fast_simplification import simplify  # slow to import

    centroid = vertices.mean(0, dtype=float)
    positions = vertices - centroid
    merged_into = np.arange(len(vertices))
    unit = _UNITS_PER_SPACING * spacing
    while len(faces) > count:
        with _LOCK:
            new_positions, remaining, collapses = simplify(
                positions / unit,
                faces,
                target_count=count,
                agg=_AGGRESSIVENESS,
                return_collapses=True,
            )
        parent = np.arange(len(vertices))
        parent[collapses[:, 1]] = collapses[:, 0]
        while (parent[parent] != parent).any():
            parent = parent[parent]
        merged_into = parent[merged_into]
        reduced = len(remaining) <= max(count, (1 - _MIN_REMOVED) * len(faces))
        # The library numbers the remaining vertices in the order of their old numbers.
        faces = with_distinct_corners(parent[faces])
        positions[np.unique(faces)] = new_positions * unit
        if not reduced:
            break
        unit *= _UNIT_FACTOR
    kept, group = np.unique(merged_into, return_inverse=True)
    return group, positions[kept] + centroid


def with_distinct_corners(faces: Intp) -> Int32:
    """Return the triangles of three different vertices."""
    a, b, c = faces.T
    return faces[(a != b) & (b != c) & (c != a)].astype(np.int32)
