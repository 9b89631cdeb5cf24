"""What moved, and what a camera measures differently from view to view.

Depth that a network has smoothed varies from view to view by some percent, and so does that of dark
or distant surfaces. Nothing moved there: a surface remains connected to what is beside it, or
separate from it. What has moved is separate from its surroundings in one view, and in the other
there is the connected surface behind it. So an object's outline is an edge in exactly one of two
views, wherever it does not overlap itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64, Intp
from tofuse.engine.geometry import se3
from tofuse.engine.tracking.moving_objects import stride_of
from tofuse.engine.views import PreparedView

# Surfaces are connected if one continues the other's plane, or its depth, to within this fraction
# of the depth somewhere near, at a distance of up to this number of cells.
_MAX_GAP, _NEAR = 0.02, 3
# Fraction of a segment's outline that must be an edge in exactly one view.
_MIN_OUTLINED = 0.5
# Squares of cells around one, by their radius.
_SQUARE = [np.ones((2 * radius + 1, 2 * radius + 1), np.uint8) for radius in range(_NEAR + 1)]


def moved_fraction(
    moving: Bool,
    view: PreparedView,
    T_world_camera: Float64,
    other: PreparedView,
    T_world_other: Float64,
) -> float:
    """Return the fraction of a view's image on segments that moved, whatever the camera's errors.

    Parameters
    ----------
    moving
        (H, W) pixels of the view that disagree with the other one.
    view, T_world_camera
        The view, with all its pixels, and its (4, 4) pose.
    other, T_world_other
        The other one and its (4, 4) pose.
    """
    stride = stride_of(view)
    moving = moving[::stride, ::stride]
    z, rays = view.z[::stride, ::stride], view.rays[::stride, ::stride]
    seen = _Surfaces(z, rays, view.planes[::stride, ::stride])
    other_seen = _seen_at(other, se3.inverse(T_world_other) @ T_world_camera, z, rays)
    beside = ~moving & (z > 0) & (other_seen.z > 0)
    outline = moving & (z > 0) & (other_seen.z > 0)
    outline &= cv2.dilate((~moving).view(np.uint8), _SQUARE[1]) > 0
    outline &= cv2.dilate(beside.view(np.uint8), _SQUARE[_NEAR]) > 0
    at = np.nonzero(outline)
    edge = seen.are_connected(beside, at) != other_seen.are_connected(beside, at)
    count, labels = cv2.connectedComponents(moving.view(np.uint8), connectivity=4)
    lengths = np.bincount(labels[at], minlength=count)
    edges = np.bincount(labels[at][edge], minlength=count)
    moved = (edges >= _MIN_OUTLINED * lengths) & (lengths > 0)
    moved[0] = False
    return float((moved[labels] & (z > 0)).sum() / max((z > 0).sum(), 1))


@dataclass(frozen=True, eq=False)
class _Surfaces:
    """What is seen at the cells of a view: z (A, B) in m, 0 without; rays, planes as of a view."""

    z: Float32
    rays: Float32
    planes: Float32

    def are_connected(self, beside: Bool, at: tuple[Intp, ...]) -> Bool:
        """Return which cells continue to one of the cells `beside` near them.

        Parameters
        ----------
        beside
            (A, B) cells.
        at
            (K,) rows and (K,) columns of the cells that are tested.
        """
        connected = np.zeros(len(at[0]), np.bool_)
        inverse = np.pad(np.where(beside, 1 / np.maximum(self.z, 1e-6), 0), _NEAR)
        x, y = (np.pad(self.rays[..., k], _NEAR) for k in (0, 1))
        z, (a, b, c, _) = self.z[at], self.planes[at].T
        for down in range(2 * _NEAR + 1):
            for right in range(2 * _NEAR + 1):
                near = at[0] + down, at[1] + right
                known = inverse[near] > 0
                depth = np.abs(inverse[near] * z - 1) < _MAX_GAP
                plane = a * x[near] + b * y[near] + c
                connected |= known & (depth | (np.abs(plane - inverse[near]) < _MAX_GAP * plane))
        return connected


def _seen_at(view: PreparedView, T_view_other: Float64, z: Float32, rays: Float32) -> _Surfaces:
    """Return what a view sees in the directions of another one's points: z and rays (A, B)."""
    points = np.concatenate([rays, np.ones_like(z)[..., None]], -1) * z[..., None]
    x, y, depth = se3.transform(T_view_other, points.reshape(-1, 3).astype(np.float64)).T
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = ((v / depth).reshape(z.shape) for v in (x, y))
    x0, y0, per_x, per_y = view.projection.frame
    u, v = ((x - x0) * per_x).astype(np.float32), ((y - y0) * per_y).astype(np.float32)
    pixels = cv2.remap(view.projection.lookup, u, v, cv2.INTER_LINEAR, borderValue=(-1e6, -1e6))
    column, row = np.moveaxis(np.rint(pixels), -1, 0)
    inside = (depth.reshape(z.shape) > 0) & (z > 0)
    inside &= (row >= 0) & (column >= 0) & (row < view.z.shape[0]) & (column < view.z.shape[1])
    at = np.where(inside, row, 0).astype(np.intp), np.where(inside, column, 0).astype(np.intp)
    return _Surfaces(view.z[at] * inside, view.rays[at], view.planes[at])
