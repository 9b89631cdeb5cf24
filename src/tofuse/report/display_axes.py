"""The turn that lays a model straight, so that its width, height and depth mean something."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from tofuse.arrays import Float64

_ANGLES = np.radians(np.arange(0, 90, 0.5))
_BOXED = 0.9  # of a box is filled by the hull of points that have its shape
_MOST = 5000  # points or faces that are tried


def upright_axes(points: Float64, outer: float) -> Float64:
    """Find the turn about the vertical for which the model's rectangle from above is smallest.

    Parameters
    ----------
    points
        (N, 3) in m, y vertical.
    outer
        Percent of the points at each end that do not count.

    Returns
    -------
    (3, 3) rotation; its rows are the model's axes, as near to x, y, z as they can be.
    """
    if len(points) < 3:
        return np.eye(3)
    sample = points[:: -(-len(points) // _MOST)]
    axes = _turned(np.array([0.0, 1.0, 0.0]))
    along = np.einsum("aki,ni->akn", axes[:, ::2], sample)
    extents = np.ptp(np.percentile(along, [outer, 100 - outer], axis=2), axis=0)
    return _nearest_axes(axes[int(extents.prod(1).argmin())])


def box_axes(points: Float64) -> Float64:
    """Return the axes of the smallest box around exact points, with one side on a hull face.

    Like `upright_axes`, but any direction may be vertical if the points have the shape of a box;
    otherwise, and for coplanar points, only rotations about y are tried.
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return upright_axes(points, 0.0)
    corners = points[hull.vertices]
    faces = np.unique(np.round(np.abs(hull.equations[:, :3]), 2), axis=0, return_index=True)[1]
    best, least = np.eye(3), np.inf
    for face in faces[:400]:
        axes = _turned(hull.equations[face, :3])
        volumes = np.ptp(axes @ corners.T, axis=2).prod(1)
        k = int(volumes.argmin())
        # Earlier boxes are preferred to ones that are hardly smaller.
        if volumes[k] < (1 - 1e-6) * least:
            best, least = axes[k], float(volumes[k])
    if hull.volume < _BOXED * least:
        return upright_axes(points, 0.0)
    return _nearest_axes(best)


def _turned(vertical: Float64) -> Float64:
    """Return (A, 3, 3) axes with the second along `vertical`, rotated about it."""
    vertical = vertical / np.linalg.norm(vertical)
    helper = np.eye(3)[int(np.abs(vertical).argmin())]
    first = np.cross(helper, vertical)
    first /= np.linalg.norm(first)
    third = np.cross(first, vertical)
    c, s = np.cos(_ANGLES)[:, None], np.sin(_ANGLES)[:, None]
    a = c * first + s * third
    b = -s * first + c * third
    return np.stack([a, np.broadcast_to(vertical, a.shape), b], axis=1)


def _nearest_axes(axes: Float64) -> Float64:
    """Reorder and flip rows so that they are right-handed and closest to x, y and z."""
    best, closest = np.eye(3), -np.inf
    for order in permutations(range(3)):
        for signs in product((1, -1), repeat=3):
            R = axes[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(R) > 0 and np.trace(R) > closest:
                best, closest = R, float(np.trace(R))
    return best
