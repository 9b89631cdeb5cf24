"""The cameras of clouds that were images: organised ones, and deprojected ones.

Organised clouds have points in rows and columns, on the rays of a camera's pixels. Programs that
export a depth image as a cloud often drop the pixels without a measurement, and so the grid. The
points are still on the rays of the pixels, whose slopes x/z and y/z form a lattice that is smoothly
distorted by the lens. It is traced from its centre outwards: a polynomial from slopes to columns
and rows is fitted to increasingly large parts of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Bool, Float32, Float64, Intp
from tofuse.engine.cameras import Camera, RayTable
from tofuse.engine.errors import InputError
from tofuse.engine.frames import CloudFrame, RangeFrame
from tofuse.engine.fusion import GeometryRecord
from tofuse.engine.geometry import KdTree, se3

SAMPLES = 8
# Largest distance of a point from its pixel's ray: errors of rounding to 0.1 mm and float32.
TOLERANCE_M = 5e-4
TOLERANCE_FRACTION = 1e-4
# Largest deviation from a pinhole camera to be considered one: 0.01 px is 0.2 mm at 10 m.
PINHOLE_PIXELS = 0.01
MAX_SLOPE = 100.0  # of a ray: 89.4 degrees off the axis
# Largest mean deviation of x/z along a column of pixels, as a fraction of its range in the image.
COLUMN_FRACTION = 0.05
MIN_CELLS = 256
_REMEDY = "keep the clouds of each camera apart"
MIN_SPREAD_M = 0.1  # of z in a pixel, to determine the origin of its ray


S = TypeVar("S")


def samples(count: int, read: Callable[[int], S]) -> Iterator[S]:
    """Yield what `read` returns for evenly spaced ones of `count` frames, if they can be read."""
    for k in range(0, count, max(1, count // SAMPLES))[:SAMPLES]:
        with suppress(InputError):
            yield read(k)


@dataclass(frozen=True)
class Raster:
    """The arrangement of points in rows and columns.

    Attributes
    ----------
    width, height
        Of the image in pixels.
    signs
        Factors of x, y and z that make x right, y down and z forward.
    """

    width: int
    height: int
    signs: tuple[int, int, int] = (1, 1, 1)

    @property
    def reversed_axes(self) -> str:
        """The axes that are reversed, in words; empty if none."""
        names = [name for name, sign in zip("xyz", self.signs, strict=True) if sign < 0]
        return f"{' and '.join(names)} run{'s'[: len(names) == 1]}" if names else ""

    def image(self, points: Float32) -> Float32:
        """Return points (N, 3) as an image (H, W, 3) with corrected signs."""
        return points.reshape(self.height, self.width, 3) * np.array(self.signs, np.float32)


def find_raster(points: Float32, width: int | None = None) -> Raster | None:
    """Return the raster of points (N, 3) that are stored row by row; None if they form no image.

    Unless given, the width is the divisor of N with which x/z varies least along columns, for
    aspect ratios up to 2.
    """
    count = len(points)
    measured = np.isfinite(points).all(1) & (points[:, 2] != 0)
    if count < MIN_CELLS or measured.sum() < 0.05 * count:
        return None
    forward = np.median(np.sign(points[measured, 2])) >= 0
    with np.errstate(all="ignore"):
        slopes = points[:, :2] / np.abs(points[:, 2:])
        measured &= (np.abs(slopes) < MAX_SLOPE).all(1)
        slopes[~measured] = np.nan
    widths = [width] if width else range(math.isqrt(count // 2), math.isqrt(2 * count) + 1)
    best: tuple[float, Raster] | None = None
    for candidate in widths:
        if candidate < 2 or count % candidate:
            continue
        fit = _raster_fit(slopes.reshape(-1, candidate, 2), 1 if forward else -1)
        if fit is not None and (best is None or fit[0] < best[0]):
            best = fit
    return None if best is None else best[1]


def _raster_fit(slopes: NDArray[np.floating], z_sign: int) -> tuple[float, Raster] | None:
    """The variation of slopes (H, W, 2) along columns and rows, and the raster; None if none."""
    height, width = slopes.shape[:2]
    signs, worst = [], 0.0
    for axis in (0, 1):
        lines = slopes[..., axis] if axis == 0 else slopes[..., axis].T
        lines = lines[:: max(1, len(lines) // 64)]
        used = np.isfinite(lines).sum(0) >= 2
        if used.sum() < 0.5 * lines.shape[1]:
            return None
        centre = np.nanmedian(lines[:, used], axis=0)
        spread = float(np.nanpercentile(centre, 95) - np.nanpercentile(centre, 5))
        deviation = float(np.nanmean(np.abs(lines[:, used] - centre)))
        rising = np.diff(centre)
        sign = 1 if np.median(rising) > 0 else -1
        if not deviation < COLUMN_FRACTION * spread or np.mean(rising * sign > 0) < 0.8:
            return None
        signs.append(sign)
        worst = max(worst, deviation / spread)
    return worst, Raster(width, height, (signs[0], signs[1], z_sign))


def ray_origin_offset(images: Sequence[Float32]) -> float:
    """Return the distance in m at which the pixels' rays meet behind the origin; 0 if unknown.

    Determined from pixels whose z varies between images (H, W, 3): x = a (z + distance).
    """
    if len({image.shape for image in images}) != 1:
        return 0.0
    z = np.stack([np.where(_measured(image), image[..., 2], np.nan) for image in images])
    z = z.astype(float)
    numerator = denominator = 0.0
    with np.errstate(all="ignore"):
        count = np.isfinite(z).sum(0)
        mean = np.nansum(z, 0) / count
        centred = np.where(np.isfinite(z), z - mean, 0.0)
        spread = (centred**2).sum(0)
        usable = (count > 1) & (spread > MIN_SPREAD_M**2)
        for axis in (0, 1):
            x = np.stack([image[..., axis] for image in images]).astype(float)
            x = np.where(np.isfinite(z), x, 0.0)
            slope = (centred * x).sum(0) / spread
            intercept = x.sum(0) / count - slope * mean
            numerator += float((spread * slope * intercept)[usable].sum())
            denominator += float((spread * slope**2)[usable].sum())
    return numerator / denominator if denominator > 0 else 0.0


def common_camera(images: Sequence[Float32]) -> Camera | None:
    """Return the camera whose pixels' rays contain the points (H, W, 3) of all images, or None."""
    if not images or len({image.shape for image in images}) > 1:
        return None
    rays = _common_rays(images)
    if rays is None:
        return None
    try:
        table = RayTable(rays)
        fit = table.fit
    except (InputError, np.linalg.LinAlgError):
        return None
    if min(fit.fx, fit.fy) < 0.1:
        return table
    has_ray = np.asarray(np.isfinite(rays).all(-1))
    error = np.abs((fit.rays() - rays)[has_ray]) * (fit.fx, fit.fy)
    return fit if error.max() < PINHOLE_PIXELS else table


def organised_frame(
    points: Float32, cloud: GeometryRecord, camera: Camera, index: int, timestamp: float
) -> RangeFrame:
    """Return points (H, W, 3) with the columns (H * W, ...) of a cloud as an image of `camera`.

    Raises
    ------
    InputError
        If the points are not on its rays.
    """
    shape = (camera.height, camera.width)
    if points.shape[:2] != shape:
        raise InputError(
            f"is organised as {points.shape[1]} x {points.shape[0]}, the previous clouds "
            f"{camera.width} x {camera.height}",
            remedy=_REMEDY,
        )
    z = points[..., 2]
    measured = _measured(points)
    rays = camera.rays()
    has_ray = np.asarray(np.isfinite(rays).all(-1))
    if not _fits(points, measured & has_ray, rays):
        raise InputError("has points off the rays of the previous clouds", remedy=_REMEDY)
    if (measured & ~has_ray).any():
        # Pixels without measurements in the sampled clouds get the ray of their point.
        point_slopes = points[..., :2] / np.where(measured, z, np.nan)[..., None]
        camera = RayTable(np.where(has_ray[..., None], rays, point_slopes))
    amplitude, color, normals = cloud.amplitude, cloud.color, cloud.normals
    return RangeFrame(
        index,
        timestamp,
        camera,
        np.where(measured, z, np.float32(0)),
        "z",
        amplitude_image=None if amplitude is None else np.nan_to_num(amplitude).reshape(shape),
        color_image=None if color is None else color.reshape(*shape, 3),
        normal_image=None if normals is None else normals.reshape(*shape, 3),
    )


def _common_rays(images: Sequence[Float32]) -> Float32 | None:
    """Rays (H, W, 2) by least squares over the images, NaN where unknown; None if inconsistent."""
    numerator = np.zeros((*images[0].shape[:2], 2))
    denominator = np.zeros(images[0].shape[:2])
    masks = []
    for image in images:
        if (image[..., 2] < 0).any():
            return None
        measured = _measured(image)
        z = np.where(measured, image[..., 2], 0).astype(float)
        masks.append(measured)
        numerator += np.where(measured[..., None], image[..., :2], 0) * z[..., None]
        denominator += z**2
    with np.errstate(invalid="ignore", divide="ignore"):
        slopes = numerator / np.where(denominator > 0, denominator, np.nan)[..., None]
    if (np.abs(slopes) > MAX_SLOPE).any():
        return None
    rays = slopes.astype(np.float32)
    fits = all(_fits(image, mask, rays) for image, mask in zip(images, masks, strict=True))
    return rays if fits else None


def _fits(points: Float32, mask: Bool, rays: Float32) -> bool:
    z = points[mask][:, 2:]
    residual = np.abs(points[mask][:, :2] - rays[mask] * z)
    return bool((residual <= TOLERANCE_M + TOLERANCE_FRACTION * z).all())


def _measured(points: Float32) -> Bool:
    """Mask of valid points; some programs write the origin instead of NaN for missing ones."""
    return np.asarray((np.abs(points) < se3.MAX_COORDINATE_M).all(-1) & (points[..., 2] > 0))


# Largest number of points to fit, and limits of the columns and rows of an image.
_MAX_POINTS, _MIN_SIDE, _MAX_SIDE = 8000, 24, 8192
# Number of central points that determine the spacing of the lattice; the radius of the part that is
# fitted first, in steps of the lattice; and the factor by which it grows.
_CENTRAL_POINTS, _INITIAL_RADIUS, _GROWTH = 400, 4.0, 1.2
# Relative variation of the steps to the nearest neighbours in the centre.
_MAX_VARIATION = 0.1
# Degree of the polynomial by the radius of the part, in steps. Brown's model has degree 7 in the
# slopes; other lenses are as smooth.
_DEGREES = ((8.0, 1), (16.0, 3), (48.0, 5), (np.inf, 7))
# Largest offset of points from their pixel's centre, in pixels, due to rounding: a quarter of
# random points are within it. Minimum fraction of points within it: while the fit grows, as the
# polynomial is extrapolated; and in other frames. In the clouds used, all points must be.
_MAX_OFFSET_PX, _MIN_GROWING_FRACTION, _MIN_FRACTION = 0.25, 0.9, 0.99
# Newton iterations from pixels to slopes.
_NEWTON_ITERATIONS = 6
# From x right, y up, z backwards to the axes of a camera, and back.
_TURN = np.array([1, -1, -1], np.float32)
# Slopes mapped at a time, for the CPU cache.
_CHUNK = 8192


@dataclass(frozen=True, eq=False)
class Deprojection:
    """The camera that clouds were deprojected from.

    Attributes
    ----------
    camera
        Cropped to the columns and rows with measurements.
    lattice
        Maps slopes to its pixels.
    turned
        Whether the clouds have y up and z backwards, as those of the RealSense Viewer.
    """

    camera: Camera
    lattice: _Lattice
    turned: bool = False

    def image(self, cloud: CloudFrame) -> RangeFrame:
        """Return the image that a cloud was deprojected from.

        Raises
        ------
        InputError
            If its points are not on the rays of the pixels.
        """
        points, normals = cloud.points, cloud.normals
        if self.turned:
            points, normals = points * _TURN, None if normals is None else normals * _TURN
        pixel, on_lattice = self.lattice.pixels(points)
        if len(points) and on_lattice.mean() < _MIN_FRACTION:
            raise InputError("has points off the rays of the previous clouds", remedy=_REMEDY)
        camera = self.camera
        shape = camera.height, camera.width
        on_lattice &= (pixel >= 0).all(1) & (pixel < (camera.width, camera.height)).all(1)
        column, row = pixel[on_lattice].T
        # The relation of the amplitude to the received light is unknown.
        images: dict[str, Any] = {"amplitude_kind": "ir"}
        for name, values, missing in (
            ("depth", points[:, 2], 0),
            ("amplitude_image", cloud.amplitude, 0),
            ("color_image", cloud.color, 0),
            ("normal_image", normals, np.nan),
        ):
            if values is not None:
                image = np.full((*shape, *values.shape[1:]), missing, values.dtype)
                image[row, column] = values[on_lattice]
                images[name] = image
        return RangeFrame(cloud.index, cloud.timestamp, camera, **images)


def stored_cloud(frame: RangeFrame) -> CloudFrame:
    """Return the points of an image of a cloud that was turned, in the axes of its file."""
    return CloudFrame.of(
        frame.points * _TURN,
        index=frame.index,
        timestamp=frame.timestamp,
        normals=None if frame.normals is None else frame.normals * _TURN,
        amplitude=frame.amplitude,
        color=frame.color,
    )


def find_deprojection(clouds: Sequence[CloudFrame]) -> Deprojection | None:
    """Return the camera from which all clouds were deprojected; None if there is none."""
    if any(np.any(cloud.origin) for cloud in clouds):
        return None
    points = [cloud.points for cloud in clouds if len(cloud)]
    turned = bool(points) and bool((points[0][:, 2] < 0).all())
    if turned:
        points = [p * _TURN for p in points]
    if not points or not all(bool((p[:, 2] > 0).all()) for p in points):
        return None
    slopes = [p[:, :2].astype(np.float64) / p[:, 2:] for p in points]
    lattice = _Lattice.of(slopes)
    if lattice is None:
        return None
    pixels = [lattice.pixels(p) for p in points]
    # No point may be lost: points off the rays or on a common ray are not from an image.
    if not all(
        on_lattice.all() and len(np.unique(pixel, axis=0)) == len(pixel)
        for pixel, on_lattice in pixels
    ):
        return None
    pixel = np.concatenate([pixel for pixel, _ in pixels])
    low, high = pixel.min(0), pixel.max(0)
    width, height = (int(n) for n in high - low + 1)
    if min(width, height) < _MIN_SIDE or max(width, height) > _MAX_SIDE:
        return None
    lattice = lattice.with_origin(low)
    camera = _camera(lattice, pixel - low, np.concatenate(slopes), width, height)
    return None if camera is None else Deprojection(camera, lattice, turned)


@dataclass(frozen=True, eq=False)
class _Lattice:
    """A polynomial from slopes (N, 2) to columns and rows (N, 2).

    Attributes
    ----------
    centre, reach
        Origin (2,) and unit of its variables, as slopes.
    degree, terms
        Its degree, and (K, 2) coefficients.
    """

    centre: Float64
    reach: float
    degree: int
    terms: Float64

    @classmethod
    def of(cls, slopes: Sequence[Float64]) -> _Lattice | None:
        """Fit the lattice of the slopes (N, 2) of all clouds; None if there is none."""
        rng = np.random.default_rng(0)
        quota = _MAX_POINTS // len(slopes)
        sample = np.concatenate(
            [s if len(s) <= quota else s[rng.choice(len(s), quota, replace=False)] for s in slopes]
        )
        spacing = _central_spacing(slopes[0])
        if spacing is None:
            return None
        centre, step = spacing
        # All points are needed around the centre; farther out a sample is sufficient.
        central = np.concatenate(
            [s[(np.abs(s - centre) < 2 * _INITIAL_RADIUS * step).all(1)] for s in slopes]
        )
        lattice = cls(centre, 1.0, 1, np.concatenate([np.zeros((1, 2)), np.diag(1 / step)]))
        reach, farthest = _INITIAL_RADIUS, float(np.abs((sample - centre) / step).max())
        while True:
            candidates = central if reach < 2 * _INITIAL_RADIUS else sample
            part = candidates[(np.abs(candidates - centre) <= reach * step).all(1)]
            fitted = lattice._refitted(part, reach * float(step.max()), reach)
            if fitted is not None:
                lattice = fitted
            elif len(part) > _CENTRAL_POINTS:
                return None
            if reach >= farthest:
                return lattice
            reach *= _GROWTH

    def _refitted(self, slopes: Float64, reach: float, steps: float) -> _Lattice | None:
        """Fit to a part of the lattice that this one predicts approximately; None if it doesn't."""
        coordinates = self(slopes)
        pixel = np.rint(coordinates)
        consistent = (np.abs(coordinates - pixel) < _MAX_OFFSET_PX).all(1)
        degree = next(degree for limit, degree in _DEGREES if steps <= limit)
        size = (degree + 1) * (degree + 2) // 2
        if consistent.sum() < 2 * size or consistent.mean() < _MIN_GROWING_FRACTION:
            return None
        variables = (slopes[consistent] - self.centre) / reach
        fit = np.linalg.lstsq(_powers(variables, degree), pixel[consistent], rcond=None)[0]
        return _Lattice(self.centre, reach, degree, np.asarray(fit, np.float64))

    def __call__(self, slopes: Float64) -> Float64:
        """Return columns and rows (N, 2) of slopes (N, 2)."""
        out = np.empty((len(slopes), 2))
        for k in range(0, len(slopes), _CHUNK):
            part = slice(k, k + _CHUNK)
            variables = (slopes[part] - self.centre) / self.reach
            out[part] = _powers(variables, self.degree) @ self.terms
        return out

    def pixels(self, points: Float32) -> tuple[Intp, Bool]:
        """Return the nearest pixels (N, 2) of points (N, 3), and (N,) whether at their centres."""
        coordinates = self(points[:, :2].astype(np.float64) / points[:, 2:])
        pixel = np.rint(coordinates)
        return pixel.astype(np.intp), np.asarray(
            (np.abs(coordinates - pixel) < _MAX_OFFSET_PX).all(1)
        )

    def with_origin(self, origin: Intp) -> _Lattice:
        """Return the lattice with columns and rows counted from `origin` (2,)."""
        terms = self.terms.copy()
        terms[0] -= origin
        return _Lattice(self.centre, self.reach, self.degree, terms)

    def slopes(self, pixels: Float64, start: Float64) -> Float64:
        """Return slopes (N, 2) of pixels (N, 2), by Newton's method from slopes `start`."""
        out, delta = start, 1e-4 * self.reach
        right, down = np.array([delta, 0]), np.array([0, delta])
        for _ in range(_NEWTON_ITERATIONS):
            residual = self(out) - pixels
            d_dx = (self(out + right) - self(out - right)) / (2 * delta)
            d_dy = (self(out + down) - self(out - down)) / (2 * delta)
            jacobian = np.stack([d_dx, d_dy], axis=-1)
            out = out - np.linalg.solve(jacobian, residual[..., None])[..., 0]
        return out


def _powers(variables: Float64, degree: int) -> Float64:
    """(N, K) monomials of two variables (N, 2) up to a total degree, the constant first."""
    x, y = variables.T
    x_powers, y_powers = [np.ones(len(x))], [np.ones(len(y))]
    for _ in range(degree):
        x_powers.append(x_powers[-1] * x)
        y_powers.append(y_powers[-1] * y)
    return np.stack(
        [x_powers[n - i] * y_powers[i] for n in range(degree + 1) for i in range(n + 1)], axis=1
    )


def _central_spacing(slopes: Float64) -> tuple[Float64, Float64] | None:
    """The central slope (2,) of (N, 2), and the spacing (2,) of the lattice there, or None."""
    if len(slopes) < _MIN_SIDE**2:
        return None
    distance = np.abs(slopes - np.median(slopes, axis=0)).max(1)
    part = slopes[np.argpartition(distance, _CENTRAL_POINTS)[:_CENTRAL_POINTS]]
    flat = np.column_stack([part, np.zeros(len(part))])
    nearest, _ = KdTree(flat).neighbours(flat, 5)
    gaps = np.abs(part[nearest[:, 1:]] - part[:, None]).reshape(-1, 2)
    steps = []
    for axis in (0, 1):
        aligned = gaps[:, axis] > 3 * gaps[:, 1 - axis]
        if aligned.sum() < _MIN_SIDE:
            return None
        step = float(np.median(gaps[aligned, axis]))
        if not step > 0 or np.mean(np.abs(gaps[aligned, axis] / step - 1) < _MAX_VARIATION) < 0.5:
            return None
        steps.append(step)
    return part[np.argmin(np.abs(part - np.median(part, axis=0)).max(1))], np.array(steps)


def _camera(
    lattice: _Lattice, pixel: Intp, slopes: Float64, width: int, height: int
) -> Camera | None:
    """The camera with the mean slope (N, 2) of each pixel (N, 2); elsewhere that of the lattice."""
    cell = pixel @ (1, width)
    count = np.bincount(cell, minlength=width * height)
    sums = np.stack([np.bincount(cell, s, minlength=width * height) for s in slopes.T], axis=1)
    observed = count > 0
    mean = sums / np.maximum(count, 1)[:, None]
    row, column = np.divmod(np.arange(width * height), width)
    pixels = np.stack([column, row, np.ones_like(row)], axis=1).astype(np.float64)
    affine = np.linalg.lstsq(pixels[observed], mean[observed], rcond=None)[0]
    rays = mean
    try:
        rays[~observed] = lattice.slopes(pixels[~observed, :2], pixels[~observed] @ affine)
        table = RayTable(rays.reshape(height, width, 2).astype(np.float32))
        fit = table.fit
    except (InputError, np.linalg.LinAlgError):
        return None
    error = np.abs(fit.rays() - table.rays()) * (fit.fx, fit.fy)
    return fit if np.nanmax(error) < PINHOLE_PIXELS else table
