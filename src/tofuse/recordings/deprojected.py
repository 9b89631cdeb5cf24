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
_SAMPLED, _MIN_SIDE, _MAX_SIDE = 8000, 24, 8192
# Number of central points that determine the spacing of the lattice; the radius of the part that is
# fitted first, in steps of the lattice; and the factor by which it grows.
_CENTRAL, _FIRST, _GROWTH = 400, 4.0, 1.2
# Relative variation of the steps to the nearest neighbours in the centre.
_REGULAR = 0.1
# Degree of the polynomial by the radius of the part, in steps. Brown's model has degree 7 in the
# slopes; other lenses are as smooth.
_DEGREES = ((8.0, 1), (16.0, 3), (48.0, 5), (np.inf, 7))
# Distance of points from their pixel's centre, in pixels, as coordinates are rounded: a quarter of
# randomly placed points are as near. While the fit grows most must be, as the polynomial is
# extrapolated; then all points of the clouds used, and nearly all of other frames.
_OFF, _WHILE_GROWING, _ON_CENTRES = 0.25, 0.9, 0.99
# Newton iterations from pixels to slopes.
_STEPS = 6
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
        at, good = self.lattice.pixels(points)
        if len(points) and good.mean() < _ON_CENTRES:
            raise InputError(
                "has points off the rays of the previous clouds",
                where=f"frame {cloud.index}",
                remedy="keep the clouds of each camera apart",
            )
        camera = self.camera
        shape = camera.height, camera.width
        good &= (at >= 0).all(1) & (at < (camera.width, camera.height)).all(1)
        column, row = at[good].T
        amplitude, color, normals = cloud.amplitude, cloud.color, cloud.normals
        depth = np.zeros(shape, np.float32)
        depth[row, column] = points[good, 2]
        if amplitude is not None:
            image = np.zeros(shape, np.float32)
            image[row, column] = amplitude[good]
            amplitude = image
        if color is not None:
            colors = np.zeros((*shape, 3), np.uint8)
            colors[row, column] = color[good]
            color = colors
        if normals is not None:
            vectors = np.full((*shape, 3), np.nan, np.float32)
            vectors[row, column] = normals[good]
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
    if not all(good.all() and len(np.unique(at, axis=0)) == len(at) for at, good in pixels):
        return None
    at = np.concatenate([at for at, _ in pixels])
    low, high = at.min(0), at.max(0)
    width, height = (int(n) for n in high - low + 1)
    if min(width, height) < _MIN_SIDE or max(width, height) > _MAX_SIDE:
        return None
    lattice = lattice.with_origin(low)
    camera = _camera(lattice, at - low, np.concatenate(slopes), width, height)
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
        quota = _SAMPLED // len(slopes)
        sample = np.concatenate(
            [s if len(s) <= quota else s[rng.choice(len(s), quota, replace=False)] for s in slopes]
        )
        spacing = _central_spacing(slopes[0])
        if spacing is None:
            return None
        centre, step = spacing
        # All points are needed around the centre; farther out a sample is sufficient.
        near = np.concatenate([s[(np.abs(s - centre) < 2 * _FIRST * step).all(1)] for s in slopes])
        lattice = cls(centre, 1.0, 1, np.concatenate([np.zeros((1, 2)), np.diag(1 / step)]))
        reach, farthest = _FIRST, float(np.abs((sample - centre) / step).max())
        while True:
            pool = near if reach < 2 * _FIRST else sample
            part = pool[(np.abs(pool - centre) <= reach * step).all(1)]
            fitted = lattice._refitted(part, reach * float(step.max()), reach)
            if fitted is not None:
                lattice = fitted
            elif len(part) > _CENTRAL:
                return None
            if reach >= farthest:
                return lattice
            reach *= _GROWTH

    def _refitted(self, slopes: Float64, reach: float, steps: float) -> _Lattice | None:
        """Fit to a part of the lattice that this one predicts approximately; None if it doesn't."""
        at = self(slopes)
        pixel = np.rint(at)
        good = (np.abs(at - pixel) < _OFF).all(1)
        degree = next(degree for limit, degree in _DEGREES if steps <= limit)
        size = (degree + 1) * (degree + 2) // 2
        if good.sum() < 2 * size or good.mean() < _WHILE_GROWING:
            return None
        variables = (slopes[good] - self.centre) / reach
        fit = np.linalg.lstsq(_powers(variables, degree), pixel[good], rcond=None)[0]
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
        at = self(points[:, :2].astype(np.float64) / points[:, 2:])
        pixel = np.rint(at)
        return pixel.astype(np.intp), np.asarray((np.abs(at - pixel) < _OFF).all(1))

    def with_origin(self, origin: Intp) -> _Lattice:
        """Return the lattice with columns and rows counted from `origin` (2,)."""
        terms = self.terms.copy()
        terms[0] -= origin
        return _Lattice(self.centre, self.reach, self.degree, terms)

    def slopes(self, pixels: Float64, start: Float64) -> Float64:
        """Return slopes (N, 2) of pixels (N, 2), by Newton's method from slopes `start`."""
        out, tiny = start, 1e-4 * self.reach
        right, down = np.array([tiny, 0]), np.array([0, tiny])
        for _ in range(_STEPS):
            off = self(out) - pixels
            by_x = (self(out + right) - self(out - right)) / (2 * tiny)
            by_y = (self(out + down) - self(out - down)) / (2 * tiny)
            jacobian = np.stack([by_x, by_y], axis=-1)
            out = out - np.linalg.solve(jacobian, off[..., None])[..., 0]
        return out


def _powers(variables: Float64, degree: int) -> Float64:
    """(N, K) monomials of two variables (N, 2) up to a total degree, the constant first."""
    x, y = variables.T
    by_x, by_y = [np.ones(len(x))], [np.ones(len(y))]
    for _ in range(degree):
        by_x.append(by_x[-1] * x)
        by_y.append(by_y[-1] * y)
    return np.stack(
        [by_x[n - i] * by_y[i] for n in range(degree + 1) for i in range(n + 1)], axis=1
    )


def _central_spacing(slopes: Float64) -> tuple[Float64, Float64] | None:
    """The central slope (2,) of (N, 2), and the spacing (2,) of the lattice there, or None."""
    if len(slopes) < _MIN_SIDE**2:
        return None
    off = np.abs(slopes - np.median(slopes, axis=0)).max(1)
    part = slopes[np.argpartition(off, _CENTRAL)[:_CENTRAL]]
    flat = np.column_stack([part, np.zeros(len(part))])
    nearest, _ = KdTree(flat).neighbours(flat, 5)
    gaps = np.abs(part[nearest[:, 1:]] - part[:, None]).reshape(-1, 2)
    steps = []
    for along in (0, 1):
        aligned = gaps[:, along] > 3 * gaps[:, 1 - along]
        if aligned.sum() < _MIN_SIDE:
            return None
        step = float(np.median(gaps[aligned, along]))
        if not step > 0 or np.mean(np.abs(gaps[aligned, along] / step - 1) < _REGULAR) < 0.5:
            return None
        steps.append(step)
    return part[np.argmin(np.abs(part - np.median(part, axis=0)).max(1))], np.array(steps)


def _camera(lattice: _Lattice, at: Intp, slopes: Float64, width: int, height: int) -> Camera | None:
    """The camera with the mean slope (N, 2) of each pixel (N, 2); elsewhere that of the lattice."""
    cell = at @ (1, width)
    count = np.bincount(cell, minlength=width * height)
    sums = np.stack([np.bincount(cell, s, minlength=width * height) for s in slopes.T], axis=1)
    seen = count > 0
    mean = sums / np.maximum(count, 1)[:, None]
    row, column = np.divmod(np.arange(width * height), width)
    pixels = np.stack([column, row, np.ones_like(row)], axis=1).astype(np.float64)
    line = np.linalg.lstsq(pixels[seen], mean[seen], rcond=None)[0]
    rays = mean
    try:
        rays[~seen] = lattice.slopes(pixels[~seen, :2], pixels[~seen] @ line)
        table = RayTable(rays.reshape(height, width, 2).astype(np.float32))
        fit = table.fit
    except (InputError, np.linalg.LinAlgError):
        return None
    off = np.abs(fit.rays() - table.rays()) * (fit.fx, fit.fy)
    return fit if np.nanmax(off) < PINHOLE_PIXELS else table
