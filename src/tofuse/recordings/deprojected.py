"""Clouds deprojected from the images of a camera: the camera, recovered from the points.

Programs that export a depth image as a cloud leave out the pixels without a measurement, and with
them the grid. The points still lie on the rays of the pixels, whose slopes x/z and y/z form a
lattice that the lens has bent smoothly. It is followed from the middle outwards: a polynomial that
maps slopes to columns and rows is fitted to ever larger parts of it.
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

# Points that the polynomial is fitted to, at most, and columns and rows of an image.
_SAMPLED, _FEWEST, _MOST = 8000, 24, 8192
# Points in the middle that show the step of the lattice, and the part of it that is fitted first,
# in steps; each further part reaches so much further.
_MIDDLE, _FIRST, _FURTHER = 400, 4.0, 1.2
# The steps to the nearest neighbours in the middle vary by less than this share.
_REGULAR = 0.1
# Degree of the polynomial by the reach of the part, in steps. A lens of Brown's model is of degree
# 7 in the slopes; those of others are as smooth.
_DEGREES = ((8.0, 1), (16.0, 3), (48.0, 5), (np.inf, 7))
# How far points lie from their pixel's centre, in pixels: rounded coordinates shift them. Of points
# that are anywhere a quarter lie so near. On the way outwards most must, as the polynomial is
# extrapolated; then all points that the camera is recovered from, and nearly all of other frames.
_OFF, _ON_THE_WAY, _ON_CENTRES = 0.25, 0.9, 0.99
# Newton steps from pixels to slopes.
_STEPS = 6
# Slopes that are mapped at a time, for the processor's cache.
_CHUNK = 8192


@dataclass(frozen=True, eq=False)
class Deprojection:
    """The camera that clouds were deprojected from.

    Attributes
    ----------
    camera
        With just the columns and rows where something was measured.
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
                "has points off the rays of those before it",
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
        # Files don't say how the amplitude was made from the received light.
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
    """Return the camera that all of some clouds were deprojected from; None if there is none."""
    if any(np.any(cloud.origin) for cloud in clouds):
        return None
    points = [cloud.points for cloud in clouds if len(cloud)]
    if not points or not all(bool((p[:, 2] > 0).all()) for p in points):
        return None
    slopes = [p[:, :2].astype(np.float64) / p[:, 2:] for p in points]
    lattice = _Lattice.of(slopes)
    if lattice is None:
        return None
    placed = [lattice.pixels(p) for p in points]
    # Nothing may be lost: where points are off the rays, or share one, they are no image's.
    if not all(good.all() and len(np.unique(at, axis=0)) == len(at) for at, good in placed):
        return None
    at = np.concatenate([at for at, _ in placed])
    low, high = at.min(0), at.max(0)
    width, height = (int(n) for n in high - low + 1)
    if min(width, height) < _FEWEST or max(width, height) > _MOST:
        return None
    lattice = lattice.moved(low)
    camera = _camera(lattice, at - low, np.concatenate(slopes), width, height)
    return None if camera is None else Deprojection(camera, lattice)


@dataclass(frozen=True, eq=False)
class _Lattice:
    """A polynomial from slopes (N, 2) to columns and rows.

    Attributes
    ----------
    middle, reach
        Slopes that are the origin and the unit of its variables.
    degree, terms
        And (terms, 2) coefficients.
    """

    middle: Float64
    reach: float
    degree: int
    terms: Float64

    @classmethod
    def of(cls, slopes: Sequence[Float64]) -> _Lattice | None:
        """Follow the lattice that the slopes (N, 2) of all clouds are on; None if there is none."""
        rng = np.random.default_rng(0)
        share = _SAMPLED // len(slopes)
        some = np.concatenate(
            [s if len(s) <= share else s[rng.choice(len(s), share, replace=False)] for s in slopes]
        )
        found = _middle_of(slopes[0])
        if found is None:
            return None
        middle, step = found
        # Around the middle all points are needed; further out some are enough.
        near = np.concatenate([s[(np.abs(s - middle) < 2 * _FIRST * step).all(1)] for s in slopes])
        lattice = cls(middle, 1.0, 1, np.concatenate([np.zeros((1, 2)), np.diag(1 / step)]))
        reach, farthest = _FIRST, float(np.abs((some - middle) / step).max())
        while True:
            pool = near if reach < 2 * _FIRST else some
            part = pool[(np.abs(pool - middle) <= reach * step).all(1)]
            fitted = lattice._refined(part, reach * float(step.max()), reach)
            if fitted is not None:
                lattice = fitted
            elif len(part) > _MIDDLE:
                return None
            if reach >= farthest:
                return lattice
            reach *= _FURTHER

    def _refined(self, slopes: Float64, reach: float, steps: float) -> _Lattice | None:
        """Fit to a part of the lattice, that it is known to nearly; None where it isn't."""
        at = self(slopes)
        pixel = np.rint(at)
        good = (np.abs(at - pixel) < _OFF).all(1)
        degree = next(degree for most, degree in _DEGREES if steps <= most)
        size = (degree + 1) * (degree + 2) // 2
        if good.sum() < 2 * size or good.mean() < _ON_THE_WAY:
            return None
        variables = (slopes[good] - self.middle) / reach
        fit = np.linalg.lstsq(_powers(variables, degree), pixel[good], rcond=None)[0]
        terms = np.asarray(fit, np.float64)
        return _Lattice(self.middle, reach, degree, terms)

    def __call__(self, slopes: Float64) -> Float64:
        """(N, 2) columns and rows of slopes (N, 2)."""
        out = np.empty((len(slopes), 2))
        for k in range(0, len(slopes), _CHUNK):
            part = slice(k, k + _CHUNK)
            variables = (slopes[part] - self.middle) / self.reach
            out[part] = _powers(variables, self.degree) @ self.terms
        return out

    def pixels(self, points: Float32) -> tuple[Intp, Bool]:
        """(N, 2) nearest pixels of points (N, 3), and (N,) which points lie at their centres."""
        at = self(points[:, :2].astype(np.float64) / points[:, 2:])
        pixel = np.rint(at)
        return pixel.astype(np.intp), np.asarray((np.abs(at - pixel) < _OFF).all(1))

    def moved(self, origin: Intp) -> _Lattice:
        """Count columns and rows from `origin` (2,)."""
        terms = self.terms.copy()
        terms[0] -= origin
        return _Lattice(self.middle, self.reach, self.degree, terms)

    def slopes(self, pixels: Float64, start: Float64) -> Float64:
        """(N, 2) slopes of pixels (N, 2), by Newton's method from slopes near by."""
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
    """(N, terms) all products of powers of two variables (N, 2) up to a degree, 1 first."""
    x, y = variables.T
    by_x, by_y = [np.ones(len(x))], [np.ones(len(y))]
    for _ in range(degree):
        by_x.append(by_x[-1] * x)
        by_y.append(by_y[-1] * y)
    return np.stack(
        [by_x[n - i] * by_y[i] for n in range(degree + 1) for i in range(n + 1)], axis=1
    )


def _middle_of(slopes: Float64) -> tuple[Float64, Float64] | None:
    """A slope (2,) amid others (N, 2), and the steps (2,) from it to its neighbours, or None."""
    if len(slopes) < _FEWEST**2:
        return None
    off = np.abs(slopes - np.median(slopes, axis=0)).max(1)
    part = slopes[np.argpartition(off, _MIDDLE)[:_MIDDLE]]
    flat = np.column_stack([part, np.zeros(len(part))])
    beside, _ = KdTree(flat).neighbours(flat, 5)
    apart = np.abs(part[beside[:, 1:]] - part[:, None]).reshape(-1, 2)
    steps = []
    for along in (0, 1):
        lies = apart[:, along] > 3 * apart[:, 1 - along]
        if lies.sum() < _FEWEST:
            return None
        step = float(np.median(apart[lies, along]))
        if not step > 0 or np.mean(np.abs(apart[lies, along] / step - 1) < _REGULAR) < 0.5:
            return None
        steps.append(step)
    return part[np.argmin(np.abs(part - np.median(part, axis=0)).max(1))], np.array(steps)


def _camera(lattice: _Lattice, at: Intp, slopes: Float64, width: int, height: int) -> Camera | None:
    """The camera with the mean slope (N, 2) of each pixel (N, 2); of others as the lattice goes."""
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
