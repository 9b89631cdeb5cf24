"""Recovering the camera of clouds that were deprojected from depth images.

Programs that export a depth image as a cloud drop the pixels without a measurement, and so the
grid. The points are still on the rays of the pixels, whose slopes x/z and y/z form a lattice that
is smoothly distorted by the lens. It is traced from its centre outwards: a polynomial from slopes
to columns and rows is fitted to increasingly large parts of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Bool, Float32, Float64, Intp
from tofuse.errors import InputError
from tofuse.geometry.cameras import Camera, RayTable
from tofuse.kernels.kdtree import KdTree
from tofuse.recordings.frames import CloudFrame, RangeFrame
from tofuse.recordings.organised import PINHOLE_PIXELS

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
    """

    camera: Camera
    lattice: _Lattice

    def image(self, cloud: CloudFrame) -> RangeFrame:
        """Return the image that a cloud was deprojected from.

        Raises
        ------
        InputError
            If its points are not on the rays of the pixels.
        """
        points = cloud.points
        pixel, on_lattice = self.lattice.pixels(points)
        if len(points) and on_lattice.mean() < _MIN_FRACTION:
            raise InputError(
                "has points off the rays of the previous clouds",
                where=f"frame {cloud.index}",
                remedy="keep the clouds of each camera apart",
            )
        camera = self.camera
        shape = camera.height, camera.width
        on_lattice &= (pixel >= 0).all(1) & (pixel < (camera.width, camera.height)).all(1)
        column, row = pixel[on_lattice].T
        amplitude, color, normals = cloud.amplitude, cloud.color, cloud.normals
        depth = np.zeros(shape, np.float32)
        depth[row, column] = points[on_lattice, 2]
        if amplitude is not None:
            image = np.zeros(shape, np.float32)
            image[row, column] = amplitude[on_lattice]
            amplitude = image
        if color is not None:
            colors = np.zeros((*shape, 3), np.uint8)
            colors[row, column] = color[on_lattice]
            color = colors
        if normals is not None:
            vectors = np.full((*shape, 3), np.nan, np.float32)
            vectors[row, column] = normals[on_lattice]
            normals = vectors
        # The relation of the amplitude to the received light is unknown.
        return RangeFrame(
            cloud.index,
            cloud.timestamp,
            camera,
            depth,
            amplitude_image=amplitude,
            color_image=color,
            normal_image=normals,
            amplitude_kind="ir",
        )


def find_deprojection(clouds: Sequence[CloudFrame]) -> Deprojection | None:
    """Return the camera from which all clouds were deprojected; None if there is none."""
    if any(np.any(cloud.origin) for cloud in clouds):
        return None
    points = [cloud.points for cloud in clouds if len(cloud)]
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
    return None if camera is None else Deprojection(camera, lattice)


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
        terms = np.asarray(fit, np.float64)
        return _Lattice(self.centre, reach, degree, terms)

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
