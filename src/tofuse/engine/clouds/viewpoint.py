"""Detection of a cloud's viewpoint at its origin, and its range image from there.

From the sensor's position each direction has a single range, and the points are spaced more evenly
in direction than over the surfaces. A cloud with a known viewpoint defines free space, and can be
compared like an image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import cv2
import numpy as np

from tofuse.engine.arrays import Float32, Float64, Intp
from tofuse.engine.cameras import Camera, Pinhole
from tofuse.engine.frames import CloudFrame, Frame, RangeFrame
from tofuse.engine.geometry import KdTree, se3
from tofuse.engine.icp import reduced, spacing

# Maximum number of points, of samples among them, and of neighbours for the local density.
_MAX_POINTS, _SAMPLES, _NEIGHBOURS = 50_000, 2000, 8
# Maximum standard deviation of the log distance to the last neighbour in direction, for images and
# for spheres: random pixels of an image have about 0.2, a scanner's grid with its poles 0.3, other
# viewpoints mostly more. The last number limits it relative to the spread over the surfaces.
_MAX_SPREAD_IMAGE, _MAX_SPREAD_SPHERE, _MAX_SPREAD_RATIO = 0.25, 0.35, 0.55
# Maximum length of the mean direction of points that surround the viewpoint.
_MAX_MEAN_DIRECTION = 0.5
# Relative range difference of neighbours in direction on different surfaces, and maximum fraction
# of points at such depth edges.
_JUMP, _MAX_JUMP_FRACTION = 0.1, 0.12
_QUARTILES = 1.349  # of a normal distribution, in standard deviations
# Half the maximum field of view of an image, rad, and maximum fraction of the points outside.
_MAX_HALF_FOV, _MAX_OUTSIDE = 0.9, 0.01
# Pixel size of a cloud's image in spacings of the points, and maximum pixels along a side.
_PIXEL, _MAX_PIXELS = 1.25, 640
# Relative depth difference of points on the same surface; half the baseline in pixels of the
# slopes, and number of their iterations.
_SAME_SURFACE, _HALF_BASELINE, _SLOPE_ITERATIONS = 0.03, 2, 3
# Of a cloud that is fused from several views: maximum number of averaged points; maximum fraction
# of them that are hidden from the viewpoint; number of other places among the points, and the
# percentile of what is hidden from these.
_HIDING_POINTS, _MAX_HIDDEN, _PLACES, _PLACES_PERCENTILE = 3000, 0.3, 30, 33
# A point is hidden behind another in its cell, in spacings, by more spacings and this fraction of
# its range.
_HIDING_CELL, _BEHIND, _BEHIND_RANGE = 1.5, 3.0, 0.05
# Cell size of a range sphere in spacings of the points, and its minimum, rad.
_CELL, _MIN_CELL = 2.0, 0.006
_NEIGHBOURHOOD = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Sensor position `origin` (3,) in m, and the angular spacing of the points in rad.

    That of a cloud that was `fused` from several views is the first of several positions.
    """

    origin: Float64
    spacing: float
    fused: bool = False


# Cache: a view is registered to several others, as an image and as a cloud.
_viewpoints: WeakKeyDictionary[Frame, Viewpoint | None] = WeakKeyDictionary()
_fused_viewpoints: WeakKeyDictionary[Frame, Viewpoint | None] = WeakKeyDictionary()


def viewpoint_of(view: Frame) -> Viewpoint | None:
    """Return the viewpoint of a view; None for a cloud not seen from its origin."""
    if isinstance(view, RangeFrame):
        return Viewpoint(np.zeros(3), _angle_of_pixel(view.camera))
    if view not in _viewpoints:
        _viewpoints[view] = _detected(view)
    return _viewpoints[view]


def _detected(view: CloudFrame) -> Viewpoint | None:
    """Detect the viewpoint of a cloud from the distribution of its points."""
    origin = np.asarray(view.origin, np.float64)
    points = view.points[:: max(1, len(view) // _MAX_POINTS)].astype(np.float64) - origin
    ranges = np.linalg.norm(points, axis=1)
    points, ranges = points[ranges > 0], ranges[ranges > 0]
    if len(points) < 4 * _NEIGHBOURS:
        return None
    directions = points / ranges[:, None]
    sampled = slice(None, None, max(1, len(points) // _SAMPLES))
    neighbours, squared = KdTree(directions).neighbours(directions[sampled], _NEIGHBOURS + 1)
    neighbour_ranges = ranges[neighbours]
    jumps = (
        np.abs(neighbour_ranges[:, 1:] - neighbour_ranges[:, :1]) > _JUMP * neighbour_ranges[:, :1]
    )
    angles = np.sqrt(squared[:, -1])
    _, squared_along = KdTree(points).neighbours(points[sampled], _NEIGHBOURS + 1)
    angular_spread, surface_spread = _spread(angles), _spread(np.sqrt(squared_along[:, -1]))
    surrounds = np.linalg.norm(directions.mean(0)) < _MAX_MEAN_DIRECTION
    max_spread = _MAX_SPREAD_SPHERE if surrounds else _MAX_SPREAD_IMAGE
    if jumps.mean() > _MAX_JUMP_FRACTION or angular_spread > min(
        max_spread, _MAX_SPREAD_RATIO * surface_spread
    ):
        return None
    # Spacing from the neighbours' density, corrected for the subsampling of the view.
    subsampling = np.sqrt(len(points) / max(len(view), 1))
    spacing = float(np.median(angles)) * np.sqrt(np.pi / _NEIGHBOURS) * subsampling
    return Viewpoint(origin, spacing) if spacing > 0 else None


def free_space_viewpoint(view: Frame) -> Viewpoint | None:
    """Return the viewpoint of a view, also of one that is fused from several nearby.

    Such a cloud hides few of its points from its origin, fewer than from most other places.
    """
    detected = viewpoint_of(view)
    if detected is not None or not isinstance(view, CloudFrame):
        return detected
    if view not in _fused_viewpoints:
        _fused_viewpoints[view] = _fused(view)
    return _fused_viewpoints[view]


def _fused(view: CloudFrame) -> Viewpoint | None:
    spread = 2 * spacing(view)
    if len(view) < 4 * _NEIGHBOURS:
        return None
    spread, thin, _ = reduced(view, view, spread, _HIDING_POINTS)
    points, origin = thin.points.astype(np.float64), np.asarray(view.origin, np.float64)
    low, high = np.percentile(points, [2, 98], axis=0)
    ranges = np.linalg.norm(points - origin, axis=1)
    # From farther away than they extend, hardly any point is far enough behind another.
    if np.median(ranges) > np.linalg.norm(high - low):
        return None
    places = np.random.default_rng(0).uniform(low, high, (_PLACES, 3))
    hidden = _hidden_fraction(points - origin, spread)
    others = [_hidden_fraction(points - place, spread) for place in places]
    if hidden > min(_MAX_HIDDEN, float(np.percentile(others, _PLACES_PERCENTILE))):
        return None
    angle = spread / 2 / max(float(np.median(ranges)), spread)
    return Viewpoint(origin, angle, fused=True)


def _hidden_fraction(points: Float64, size: float) -> float:
    """Return the fraction of points (n, 3), `size` m apart, that others hide from the origin."""
    ranges = np.linalg.norm(points, axis=1)
    cell = max(_HIDING_CELL * size / max(float(np.median(ranges)), size), _MIN_CELL)
    shape = _shape_of(cell)
    index = _cells(points, np.maximum(ranges, 1e-12), cell, shape)
    nearest = np.full(shape[0] * shape[1], np.inf)
    np.minimum.at(nearest, index, ranges)
    behind = ranges - nearest[index]
    return float(np.mean(behind > _BEHIND * size + _BEHIND_RANGE * ranges))


def _angle_of_pixel(camera: Camera) -> float:
    """Return the angle between pixels at the image centre, rad."""
    steps = np.abs(np.diff(camera.rays()[camera.height // 2, :, 0]))
    steps = steps[np.isfinite(steps) & (steps > 0)]
    return float(np.median(steps)) if len(steps) else _MIN_CELL


def _spread(distances: Float64) -> float:
    """Return the robust standard deviation of log distances; inf if the lower quartile is 0."""
    if not np.percentile(distances, 25) > 0:
        return np.inf
    low, high = np.log(np.percentile(distances, [25, 75]))
    return float(high - low) / _QUARTILES


@dataclass(frozen=True, eq=False)
class RangeSphere:
    """Nearest range in m per direction around a viewpoint, NaN in unobserved directions.

    Rows are elevations about the y axis, columns azimuths. Near the poles cells are smaller than
    the spacing of the points, so that some of them are empty.
    """

    origin: Float64
    cell: float
    ranges: Float32

    @classmethod
    def of(cls, view: Frame, viewpoint: Viewpoint) -> RangeSphere:
        """Take the nearest range in each cell and its neighbours."""
        cell = max(_CELL * viewpoint.spacing, _MIN_CELL)
        shape = _shape_of(cell)
        points = view.points.astype(np.float64) - viewpoint.origin
        ranges = np.linalg.norm(points, axis=1)
        valid = ranges > 0
        cell_index = _cells(points[valid], ranges[valid], cell, shape)
        nearest = np.full(shape, np.inf, np.float32)
        np.minimum.at(nearest.reshape(-1), cell_index, ranges[valid].astype(np.float32))
        eroded = cv2.erode(nearest, _NEIGHBOURHOOD)
        return cls(viewpoint.origin, cell, np.where(np.isfinite(nearest), eroded, np.nan))

    def distance_in_front(self, points: Float64) -> Float64:
        """Return the distance (n,) in m of points (n, 3) in front of the observed range.

        Relative to the nearest surface of the cell and its neighbours; NaN in unobserved
        directions.
        """
        points = points - self.origin
        ranges = np.linalg.norm(points, axis=1)
        cell_index = _cells(points, np.maximum(ranges, 1e-12), self.cell, self.ranges.shape)
        return np.asarray(self.ranges.reshape(-1)[cell_index] - ranges, np.float64)


def _shape_of(cell: float) -> tuple[int, int]:
    """Return the numbers of elevations and azimuths of a sphere of cells of this size, rad."""
    return int(np.ceil(np.pi / cell)), int(np.ceil(2 * np.pi / cell))


def _cells(points: Float64, ranges: Float64, cell: float, shape: tuple[int, ...]) -> Intp:
    elevation = np.arcsin(np.clip(points[:, 1] / ranges, -1, 1)) + np.pi / 2
    azimuth = np.arctan2(points[:, 0], points[:, 2]) + np.pi
    row = np.minimum((elevation / cell).astype(np.intp), shape[0] - 1)
    column = np.minimum((azimuth / cell).astype(np.intp), shape[1] - 1)
    return np.asarray(row * shape[1] + column, np.intp)


def as_image(view: Frame, viewpoint: Viewpoint) -> tuple[RangeFrame, Float64] | None:
    """Render a view from its viewpoint; return the image and its pose T_view_camera (4, 4).

    None if the field of view is too wide for an image. The camera has the axes of the view if that
    looks along its z axis; else the camera's y axis points down the view's z axis.

    Parameters
    ----------
    view, viewpoint
        View and its viewpoint; range images are returned unchanged.
    """
    if isinstance(view, RangeFrame):
        return view, np.eye(4)
    points = view.points.astype(np.float64) - viewpoint.origin
    T = se3.pose(_axes(points), viewpoint.origin)
    camera_points = points @ T[:3, :3]
    camera = _camera_of(camera_points, viewpoint.spacing)
    if camera is None:
        return None
    return rendered(replace(view, points=camera_points.astype(np.float32)), camera), T


def rendered(view: CloudFrame, camera: Pinhole) -> RangeFrame:
    """Render a cloud given in the camera's frame: the nearest surface in each pixel."""
    depth, nearest = _rendered(view.points.astype(np.float64), camera)
    color, amplitude, visible = None, None, nearest >= 0
    if view.color is not None:
        color = np.zeros((*depth.shape, 3), np.uint8)
        color[visible] = view.color[nearest[visible]]
    if view.amplitude is not None:
        amplitude = np.zeros(depth.shape, np.float32)
        amplitude[visible] = view.amplitude[nearest[visible]]
    return RangeFrame(
        view.index,
        view.timestamp,
        camera,
        depth,
        color_image=color,
        amplitude_image=amplitude,
        # The relation to the received signal is unknown.
        amplitude_kind="ir",
    )


def _camera_of(points: Float64, spacing: float) -> Pinhole | None:
    """Return a camera for nearly all points (n, 3), at their spacing in rad; None if too wide."""
    angles = np.arctan2(np.abs(points[:, :2]), points[:, 2:])
    if np.mean(angles.max(1) > _MAX_HALF_FOV) > _MAX_OUTSIDE:
        return None
    half_size = np.tan(
        np.minimum(np.percentile(angles, 100 * (1 - _MAX_OUTSIDE), axis=0), _MAX_HALF_FOV)
    )
    pixel = max(_PIXEL * spacing, 2 * float(half_size.max()) / _MAX_PIXELS)
    width, height = (max(int(2 * r / pixel), 16) for r in half_size)
    return Pinhole(width, height, 1 / pixel, 1 / pixel, (width - 1) / 2, (height - 1) / 2)


def _axes(points: Float64) -> Float64:
    """Return the axes (3, 3) of a camera facing the points (n, 3): columns right, down, forward."""
    forward = points.mean(0)
    forward = forward / max(float(np.linalg.norm(forward)), 1e-12)
    if forward[2] > np.cos(_MAX_HALF_FOV / 2):
        return np.eye(3)
    down = (
        np.array([0.0, 0.0, -1.0]) if abs(forward[2]) < np.cos(_MAX_HALF_FOV / 2) else np.eye(3)[1]
    )
    y = down - forward * (down @ forward)
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, forward), y, forward], axis=1)


def _rendered(points: Float64, camera: Pinhole) -> tuple[Float32, Intp]:
    """Return depth (H, W) of the nearest surface, 0 if none, and its nearest point, -1 if none."""
    shape = camera.height, camera.width
    projected = camera.project(points)
    pixel = np.round(projected)
    index = np.flatnonzero((pixel >= 0).all(1) & (pixel < shape[::-1]).all(1))
    pixel_index = (pixel[index, 1] * camera.width + pixel[index, 0]).astype(np.intp)
    z = points[index, 2]
    order = np.lexsort((z, pixel_index))
    pixel_index, z, index = pixel_index[order], z[order], index[order]
    first = (
        np.r_[True, pixel_index[1:] != pixel_index[:-1]] if len(pixel_index) else np.zeros(0, bool)
    )
    size = camera.width * camera.height
    min_z = np.full(size, np.inf)
    min_z[pixel_index[first]] = z[first]
    same_surface = z < (1 + _SAME_SURFACE) * min_z[pixel_index]
    count = np.maximum(np.bincount(pixel_index[same_surface], minlength=size), 1)
    offset = projected[index] - pixel[index]
    inverse_depth, u, v = (
        (
            np.bincount(pixel_index[same_surface], value[same_surface], minlength=size) / count
        ).reshape(shape)
        for value in (1 / z, offset[:, 0], offset[:, 1])
    )
    nearest = np.full(size, -1, np.intp)
    nearest[pixel_index[first]] = index[first]
    centred = _at_centres(inverse_depth, u, v)
    depth = np.where(centred > 0, 1 / np.where(centred > 0, centred, 1), 0)
    return depth.astype(np.float32), nearest.reshape(shape)


def _at_centres(inverse_depth: Float64, u: Float64, v: Float64) -> Float64:
    """Return inverse depth (H, W) at the pixel centres, for points offset by (u, v) pixels.

    Inverse depth of a plane is linear in the image. Slopes are central differences where both
    neighbours are on the same surface, recomputed in each iteration.
    """
    max_ratio = (1 + _SAME_SURFACE) ** (2 * _HALF_BASELINE)
    result = inverse_depth
    for _ in range(_SLOPE_ITERATIONS):
        padded = np.pad(result, _HALF_BASELINE)
        centre = slice(_HALF_BASELINE, -_HALF_BASELINE)
        backward, forward = slice(-2 * _HALF_BASELINE), slice(2 * _HALF_BASELINE, None)
        slopes = []
        for previous, following in (
            (padded[centre, backward], padded[centre, forward]),
            (padded[backward, centre], padded[forward, centre]),
        ):
            low, high = np.minimum(previous, following), np.maximum(previous, following)
            same_surface = (low > inverse_depth / max_ratio) & (high < inverse_depth * max_ratio)
            slopes.append(np.where(same_surface, (following - previous) / (2 * _HALF_BASELINE), 0))
        result = inverse_depth - u * slopes[0] - v * slopes[1]
    return result
