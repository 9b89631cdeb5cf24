"""The rotation that aligns a model with the axes, so that its width and height are meaningful."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from tofuse.arrays import Float64

_ANGLES = np.radians(np.arange(0, 90, 0.5))
_MIN_BOX_FILL = 0.9  # minimum fraction of a box in the hull of points that have its shape
_MAX_SAMPLES = 5000  # maximum number of sampled points


def upright_axes(points: Float64, outer: float) -> Float64:
    """Find the rotation about the vertical that minimises the bounding rectangle from above.

    Parameters
    ----------
    points
        (N, 3) in m, y vertical.
    outer
        Percent of the points at each end that are ignored.

    Returns
    -------
    (3, 3) rotation; its rows are the model's axes, as close to x, y, z as possible.
    """
    if len(points) < 3:
        return np.eye(3)
    sampled = points[:: -(-len(points) // _MAX_SAMPLES)]
    axes = _rotated_axes(np.array([0.0, 1.0, 0.0]))
    coordinates = np.einsum("aki,ni->akn", axes[:, ::2], sampled)
    extents = np.ptp(np.percentile(coordinates, [outer, 100 - outer], axis=2), axis=0)
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
    best, min_volume = np.eye(3), np.inf
    for face in faces[:400]:
        axes = _rotated_axes(hull.equations[face, :3])
        volumes = np.ptp(axes @ corners.T, axis=2).prod(1)
        k = int(volumes.argmin())
        # Earlier boxes are preferred to ones that are hardly smaller.
        if volumes[k] < (1 - 1e-6) * min_volume:
            best, min_volume = axes[k], float(volumes[k])
    if hull.volume < _MIN_BOX_FILL * min_volume:
        return upright_axes(points, 0.0)
    return _nearest_axes(best)


def _rotated_axes(vertical: Float64) -> Float64:
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
    best, max_trace = np.eye(3), -np.inf
    for order in permutations(range(3)):
        for signs in product((1, -1), repeat=3):
            R = axes[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(R) > 0 and np.trace(R) > max_trace:
                best, max_trace = R, float(np.trace(R))
    return best
