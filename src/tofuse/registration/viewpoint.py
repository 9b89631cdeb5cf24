"""The viewpoint of a cloud: whether it is the origin, and the image seen from there.

From a sensor's position each direction shows one surface, and the points are spaced more evenly in
direction than over the surfaces. A cloud with a known viewpoint also shows free space, and can be
compared like an image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import cv2
import numpy as np

from tofuse.arrays import Float32, Float64, Intp
from tofuse.geometry.cameras import Camera, Pinhole
from tofuse.kernels.kdtree import KdTree
from tofuse.recordings.frames import CloudFrame, Frame, RangeFrame

# Points that are looked at, and neighbours whose distance shows how dense points are.
_LOOKED_AT, _SAMPLE, _NEIGHBOURS = 50_000, 2000, 8
# Spread of the logarithm of that distance, as a standard deviation: points of an image that are
# chosen at random have about 0.2, those of a scanner's grid with its poles 0.3. Surfaces that are
# seen from elsewhere mostly have more; this share of the spread along the surfaces is the most.
_EVEN_IMAGE, _EVEN_SPHERE, _MORE_EVEN = 0.25, 0.35, 0.55
# Length of the mean direction of what surrounds the viewpoint.
_ALL_AROUND = 0.5
# Neighbours in direction that differ by this share of the range are on different surfaces, and the
# share of points where that may be: outlines.
_JUMP, _OUTLINES = 0.1, 0.12
_QUARTILES = 1.349  # of a normal distribution, in standard deviations
# Half the angle of a cone that an image can show, rad, and the share of points outside at most.
_WIDEST, _OUTSIDE = 0.9, 0.01
# Pixels of an image made of a cloud, in spacings of the points, and along a side at most.
_PIXEL, _MOST_PIXELS = 1.25, 640
# Points of one pixel that differ by less than this share are on the same surface; slopes are
# measured between pixels so many steps to either side, in so many rounds.
_SAME, _BESIDE, _ROUNDS = 0.03, 2, 3
# Cells of a sphere in spacings of the points, and at least, rad.
_CELL, _FINEST = 2.0, 0.006
_AROUND = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """That a view was seen from its origin, with a spacing of directions in rad."""

    origin: Float64
    spacing: float


# A view is registered to several others, as an image and as a cloud.
_known: WeakKeyDictionary[Frame, Viewpoint | None] = WeakKeyDictionary()


def viewpoint_of(view: Frame) -> Viewpoint | None:
    """Return where a view was seen from, None where nothing shows that it was its origin."""
    if isinstance(view, RangeFrame):
        return Viewpoint(np.zeros(3), _angle_of_pixel(view.camera))
    if view not in _known:
        _known[view] = _found(view)
    return _known[view]


def _found(view: CloudFrame) -> Viewpoint | None:
    """The viewpoint of a cloud, from how its points are spread."""
    origin = np.asarray(view.origin, np.float64)
    points = view.points[:: max(1, len(view) // _LOOKED_AT)].astype(np.float64) - origin
    ranges = np.linalg.norm(points, axis=1)
    points, ranges = points[ranges > 0], ranges[ranges > 0]
    if len(points) < 4 * _NEIGHBOURS:
        return None
    directions = points / ranges[:, None]
    some = slice(None, None, max(1, len(points) // _SAMPLE))
    near, squared = KdTree(directions).neighbours(directions[some], _NEIGHBOURS + 1)
    beside = ranges[near]
    jumps = np.abs(beside[:, 1:] - beside[:, :1]) > _JUMP * beside[:, :1]
    apart = np.sqrt(squared[:, -1])
    _, along = KdTree(points).neighbours(points[some], _NEIGHBOURS + 1)
    even, over = _spread(apart), _spread(np.sqrt(along[:, -1]))
    around = np.linalg.norm(directions.mean(0)) < _ALL_AROUND
    most = _EVEN_SPHERE if around else _EVEN_IMAGE
    if jumps.mean() > _OUTLINES or even > min(most, _MORE_EVEN * over):
        return None
    # So many points share the circle around one; all points of the view are closer together.
    thinned = np.sqrt(len(points) / max(len(view), 1))
    spacing = float(np.median(apart)) * np.sqrt(np.pi / _NEIGHBOURS) * thinned
    return Viewpoint(origin, spacing) if spacing > 0 else None


def _angle_of_pixel(camera: Camera) -> float:
    """In rad, in the middle of the image."""
    steps = np.abs(np.diff(camera.rays()[camera.height // 2, :, 0]))
    steps = steps[np.isfinite(steps) & (steps > 0)]
    return float(np.median(steps)) if len(steps) else _FINEST


def _spread(distances: Float64) -> float:
    """Robust standard deviation of the logarithm; inf where half of them are 0."""
    if not np.percentile(distances, 25) > 0:
        return np.inf
    low, high = np.log(np.percentile(distances, [25, 75]))
    return float(high - low) / _QUARTILES


@dataclass(frozen=True, eq=False)
class RangeSphere:
    """The nearest range in m of each direction around a viewpoint, NaN where nothing was seen.

    Rows are elevations about the y axis, columns azimuths. Poles lie where cells are smaller than
    the spacing of the points, so that some of them are empty: these say nothing.
    """

    origin: Float64
    cell: float
    ranges: Float32

    @classmethod
    def of(cls, view: Frame, viewpoint: Viewpoint) -> RangeSphere:
        """Take the nearest range in each cell and those beside it."""
        cell = max(_CELL * viewpoint.spacing, _FINEST)
        shape = int(np.ceil(np.pi / cell)), int(np.ceil(2 * np.pi / cell))
        points = view.points.astype(np.float64) - viewpoint.origin
        ranges = np.linalg.norm(points, axis=1)
        seen = ranges > 0
        at = _cells(points[seen], ranges[seen], cell, shape)
        nearest = np.full(shape, np.inf, np.float32)
        np.minimum.at(nearest.reshape(-1), at, ranges[seen].astype(np.float32))
        least = cv2.erode(nearest, _AROUND)
        return cls(viewpoint.origin, cell, np.where(np.isfinite(nearest), least, np.nan))

    def before(self, points: Float64) -> Float64:
        """(n,) how far in m points (n, 3) lie in front of what was seen; NaN in unseen directions.

        Relative to the nearest surface of the cell and of those beside it.
        """
        points = points - self.origin
        ranges = np.linalg.norm(points, axis=1)
        at = _cells(points, np.maximum(ranges, 1e-12), self.cell, self.ranges.shape)
        return np.asarray(self.ranges.reshape(-1)[at] - ranges, np.float64)


def _cells(points: Float64, ranges: Float64, cell: float, shape: tuple[int, ...]) -> Intp:
    elevation = np.arcsin(np.clip(points[:, 1] / ranges, -1, 1)) + np.pi / 2
    azimuth = np.arctan2(points[:, 0], points[:, 2]) + np.pi
    row = np.minimum((elevation / cell).astype(np.intp), shape[0] - 1)
    column = np.minimum((azimuth / cell).astype(np.intp), shape[1] - 1)
    return np.asarray(row * shape[1] + column, np.intp)


def as_image(
    view: Frame, viewpoint: Viewpoint, camera: Pinhole | None = None
) -> tuple[RangeFrame, Float64] | None:
    """Return the image that a camera at the viewpoint sees, and its pose T_view_camera (4, 4).

    None where the view is wider than an image can be. The axes of the camera are those of the
    view where it looks along its z axis, as cameras do; else y points down the view's z axis.

    Parameters
    ----------
    camera
        One that suits the view unless given; points outside its image are left out.
    """
    if isinstance(view, RangeFrame):
        return view, np.eye(4)
    points = view.points.astype(np.float64) - viewpoint.origin
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = _axes(points), viewpoint.origin
    seen = points @ T[:3, :3]
    if camera is None:
        camera = _camera_of(seen, viewpoint.spacing)
    if camera is None:
        return None
    return rendered(replace(view, points=seen.astype(np.float32)), camera), T


def rendered(view: CloudFrame, camera: Pinhole) -> RangeFrame:
    """Return the image of a cloud in the camera's frame: the nearest surface in each pixel."""
    depth, nearest = _rendered(view.points.astype(np.float64), camera)
    color, amplitude, seen = None, None, nearest >= 0
    if view.color is not None:
        color = np.zeros((*depth.shape, 3), np.uint8)
        color[seen] = view.color[nearest[seen]]
    if view.amplitude is not None:
        amplitude = np.zeros(depth.shape, np.float32)
        amplitude[seen] = view.amplitude[nearest[seen]]
    return RangeFrame(
        view.index,
        view.timestamp,
        camera,
        depth,
        color_image=color,
        amplitude_image=amplitude,
        # Files don't say how it was made of the light that came back.
        amplitude_kind="ir",
    )


def _camera_of(points: Float64, spacing: float) -> Pinhole | None:
    """A camera that sees nearly all points (n, 3) of its frame, with pixels that hold them."""
    wide = np.arctan2(np.abs(points[:, :2]), points[:, 2:])
    if np.mean(wide.max(1) > _WIDEST) > _OUTSIDE:
        return None
    reach = np.tan(np.minimum(np.percentile(wide, 100 * (1 - _OUTSIDE), axis=0), _WIDEST))
    pixel = max(_PIXEL * spacing, 2 * float(reach.max()) / _MOST_PIXELS)
    width, height = (max(int(2 * r / pixel), 16) for r in reach)
    return Pinhole(width, height, 1 / pixel, 1 / pixel, (width - 1) / 2, (height - 1) / 2)


def _axes(points: Float64) -> Float64:
    """(3, 3) axes of a camera that sees the points: columns x right, y down, z forward."""
    forward = points.mean(0)
    forward = forward / max(float(np.linalg.norm(forward)), 1e-12)
    if forward[2] > np.cos(_WIDEST / 2):
        return np.eye(3)
    down = np.array([0.0, 0.0, -1.0]) if abs(forward[2]) < np.cos(_WIDEST / 2) else np.eye(3)[1]
    y = down - forward * (down @ forward)
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, forward), y, forward], axis=1)


def _rendered(points: Float64, camera: Pinhole) -> tuple[Float32, Intp]:
    """(H, W) depth of the nearest surface in each pixel, 0 without, and its nearest point."""
    shape = camera.height, camera.width
    at_pixel = camera.project(points)
    pixel = np.round(at_pixel)
    inside = (pixel >= 0).all(1) & (pixel < shape[::-1]).all(1)
    which = np.flatnonzero(inside)
    at = (pixel[which, 1] * camera.width + pixel[which, 0]).astype(np.intp)
    z = points[which, 2]
    order = np.lexsort((z, at))
    at, z, which = at[order], z[order], which[order]
    first = np.r_[True, at[1:] != at[:-1]] if len(at) else np.zeros(0, bool)
    size = camera.width * camera.height
    least = np.full(size, np.inf)
    least[at[first]] = z[first]
    same = z < (1 + _SAME) * least[at]
    count = np.maximum(np.bincount(at[same], minlength=size), 1)
    off = at_pixel[which] - pixel[which]
    inverse, u, v = (
        (np.bincount(at[same], value[same], minlength=size) / count).reshape(shape)
        for value in (1 / z, off[:, 0], off[:, 1])
    )
    nearest = np.full(size, -1, np.intp)
    nearest[at[first]] = which[first]
    at_centre = _at_centres(inverse, u, v)
    depth = np.where(at_centre > 0, 1 / np.where(at_centre > 0, at_centre, 1), 0)
    return depth.astype(np.float32), nearest.reshape(shape)


def _at_centres(inverse: Float64, u: Float64, v: Float64) -> Float64:
    """Inverse depth (H, W) at the centres of pixels, of points that are off by (u, v) pixels.

    Over a plane it is linear in the image. Its slopes are those between the pixels beside, where
    these are on the same surface; each round measures them again where the last one left them.
    """
    near = (1 + _SAME) ** (2 * _BESIDE)
    out = inverse
    for _ in range(_ROUNDS):
        padded = np.pad(out, _BESIDE)
        inside, back, on = slice(_BESIDE, -_BESIDE), slice(-2 * _BESIDE), slice(2 * _BESIDE, None)
        slopes = []
        for before, after in (
            (padded[inside, back], padded[inside, on]),
            (padded[back, inside], padded[on, inside]),
        ):
            low, high = np.minimum(before, after), np.maximum(before, after)
            same = (low > inverse / near) & (high < inverse * near)
            slopes.append(np.where(same, (after - before) / (2 * _BESIDE), 0))
        out = inverse - u * slopes[0] - v * slopes[1]
    return out
