"""Camera models: the ray of each pixel, and the projection of points.

Camera axes are x right, y down, z forward; pixel centres lie at integer coordinates. A camera
offers `rays()`, the (H, W, 2) table of x/z and y/z, and `project()`. Everything else, such as
range to x, y, z (eqs 2.3 to 2.5), follows from the rays and is the same for every lens.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, runtime_checkable
from weakref import WeakKeyDictionary

import numpy as np
import scipy  # loads its parts when they are used
from numpy.typing import ArrayLike, NDArray

from tofuse.engine.arrays import Bool, Float32, Float64
from tofuse.engine.cameras import projection_kernels as kernels
from tofuse.engine.errors import InputError


@runtime_checkable
class Camera(Protocol):
    """The interface of all camera models."""

    @property
    def width(self) -> int:
        """Columns."""
        ...

    @property
    def height(self) -> int:
        """Rows."""
        ...

    def rays(self) -> Float32:
        """Return the (H, W, 2) table of x/z and y/z of every pixel; NaN where undefined."""
        ...

    def project(self, points: ArrayLike) -> Float64:
        """Return pixels (..., 2) = (u, v) of points (..., 3) in m; NaN where there is none."""
        ...


def ray_lengths(camera: Camera) -> Float32:
    """Return the length (H, W) of the rays (x/z, y/z, 1): radial range over z depth (eq 2.3)."""
    return _derived(camera)[0]


def unknown_rays(camera: Camera) -> Bool | None:
    """Return the mask (H, W) of pixels whose ray is unknown; None if there are none."""
    return _derived(camera)[1]


# Cache by camera, as these are needed for every frame.
_cache: WeakKeyDictionary[Camera, tuple[Float32, Bool | None]] = WeakKeyDictionary()


def _derived(camera: Camera) -> tuple[Float32, Bool | None]:
    derived = _cache.get(camera)
    if derived is None:
        rays = camera.rays()
        unknown: Bool = np.isnan(rays.sum(-1))
        lengths = _frozen(np.sqrt(1 + (rays * rays).sum(-1)))
        derived = (lengths, unknown if unknown.any() else None)
        _cache[camera] = derived
    return derived


_CHECKED_ANGLES = 2000  # to the axis, at which a lens is checked for a fold


@dataclass(frozen=True)
class Pinhole:
    """Pinhole camera (eq 2.1): u = fx x/z + cx, v = fy y/z + cy.

    Attributes
    ----------
    width, height
        Size of the image, pixels.
    fx, fy
        Focal lengths, pixels.
    cx, cy
        Principal point, pixels; (0, 0) is the centre of the first pixel.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    model = "pinhole"
    tangential_factor = 2.0  # how often the mixed terms of p1 and p2 count

    def __post_init__(self) -> None:
        check_intrinsics(self)

    def rays(self) -> Float32:
        """See `Camera.rays`."""
        return self._rays

    @cached_property
    def _rays(self) -> Float32:
        return _frozen(self._undistort(_pixel_grid(self)).astype(np.float32))

    def project(self, points: ArrayLike) -> Float64:
        """Project points (..., 3) in m; see `Camera.project`."""
        points = np.asarray(points, float)
        pixels = self.extrapolate(points)
        if np.isfinite(self._fold):
            beyond = np.hypot(points[..., 0], points[..., 1]) > self._fold * points[..., 2]
            pixels[beyond] = np.nan
        return pixels

    def extrapolate(self, points: ArrayLike) -> Float64:
        """Project points also beyond a fold of the distortion, as fits of its coefficients do."""
        points = np.asarray(points, float)
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        return kernels.project_by_lens(flat, self._lens).reshape(*points.shape[:-1], 2)

    @cached_property
    def _fold(self) -> float:
        """Length of (x/z, y/z) beyond which the distortion folds rays back; infinite without it."""
        if type(self) is Pinhole:
            return np.inf
        slope = np.tan(np.linspace(0, np.pi / 2, _CHECKED_ANGLES, endpoint=False))
        rays = np.stack([slope, np.zeros_like(slope)], -1)
        distorted = kernels.distort(rays, self._lens._replace(p1=0.0, p2=0.0))[:, 0]
        folded = np.flatnonzero(np.diff(distorted) <= 0)
        return float(slope[folded[0]]) if len(folded) else np.inf

    @cached_property
    def _lens(self) -> kernels.Lens:
        values = [float(getattr(self, name, 0.0)) for name in kernels.Lens._fields[:-2]]
        return kernels.Lens._make([*values, isinstance(self, Fisheye), self.tangential_factor])

    def _distort(self, xy: Float64) -> Float64:
        flat = np.ascontiguousarray(xy.reshape(-1, 2))
        return kernels.distort(flat, self._lens).reshape(xy.shape)

    def _undistort(self, xy: Float64) -> Float64:
        """Invert `_distort` by Newton's method with a numeric Jacobian; NaN where it fails."""
        if type(self) is Pinhole:
            return xy
        shape = xy.shape
        xy = xy.reshape(-1, 2)
        out = xy.copy()
        # Indices that have not converged; beyond a fold of the distortion, some never do.
        active = np.arange(len(xy))
        step = 1e-6
        for _ in range(30):
            guess = out[active]
            error = self._distort(guess) - xy[active]
            columns = [
                (self._distort(guess + d) - self._distort(guess - d)) / (2 * step)
                for d in np.eye(2) * step
            ]
            (a, c), (b, d) = (np.moveaxis(k, -1, 0) for k in columns)
            determinant = a * d - b * c
            e, f = error.T
            with np.errstate(all="ignore"):
                move = np.stack([d * e - b * f, a * f - c * e], -1) / determinant[..., None]
            out[active] = guess - np.clip(move, -0.5, 0.5)
            active = active[np.abs(move).max(-1) >= 1e-12]
            if len(active) == 0:
                break
        bad = ~(np.abs(self._distort(out) - xy).max(-1) < 1e-7)
        # A polynomial has other solutions beyond its fold, even on the opposite side.
        out[bad | (np.hypot(*out.T) > self._fold)] = np.nan
        return out.reshape(shape)


@dataclass(frozen=True)
class BrownConrady(Pinhole):
    """Pinhole with radial k1, k2, k3 and tangential p1, p2 distortion (Brown 1966, OpenCV)."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    model = "brown"


@dataclass(frozen=True)
class Rational(BrownConrady):
    """Brown-Conrady over a denominator with k4, k5, k6 (OpenCV's rational model, Azure Kinect)."""

    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    model = "rational"


@dataclass(frozen=True)
class Fisheye(Pinhole):
    """Equidistant lens with k1, k2, k3, k4 on the angle (Kannala and Brandt 2006, OpenCV)."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    model = "fisheye"

    def _distorted_angle(self, theta: Float64) -> Float64:
        t2 = theta * theta
        return theta * (1 + t2 * (self.k1 + t2 * (self.k2 + t2 * (self.k3 + t2 * self.k4))))

    def _undistort(self, xy: Float64) -> Float64:
        # Solve for the angle, which has no pole, rather than for its tangent.
        distorted = np.sqrt((xy * xy).sum(-1))
        theta = np.minimum(distorted, 1.5)
        for _ in range(50):
            t2 = theta * theta
            estimate = self._distorted_angle(theta)
            slope = 1 + t2 * (
                3 * self.k1 + t2 * (5 * self.k2 + t2 * (7 * self.k3 + t2 * 9 * self.k4))
            )
            with np.errstate(all="ignore"):
                theta = theta - np.clip((estimate - distorted) / slope, -0.3, 0.3)
        estimate = self._distorted_angle(theta)
        converged = (
            (np.abs(estimate - distorted) < 1e-7)
            & (theta >= 0)
            & (theta < min(np.pi / 2 - 1e-3, np.arctan(self._fold)))
        )
        scale = np.where(
            distorted > 1e-9, np.tan(theta) / np.where(distorted > 1e-9, distorted, 1), 1.0
        )
        return np.where(converged[..., None], xy * scale[..., None], np.nan)


def _is_mirrored(table: NDArray[np.generic]) -> bool:
    """Whether rays (H, W, 2) are mirrored, by the sign of their Jacobian."""
    rays = np.asarray(table, float)
    by_u = rays[:-1, 1:] - rays[:-1, :-1]
    by_v = rays[1:, :-1] - rays[:-1, :-1]
    area = by_u[..., 0] * by_v[..., 1] - by_u[..., 1] * by_v[..., 0]
    return bool(np.count_nonzero(area < 0) > np.count_nonzero(area > 0))


@dataclass(frozen=True)
class RayTable:
    """A camera known only by its table of rays, (H, W, 2) x/z and y/z, NaN where unknown.

    Projection iterates from a pinhole fit by Newton's method.
    """

    table: Float32

    model = "rays"

    def __repr__(self) -> str:
        return f"RayTable: {self.width} x {self.height}"

    def __post_init__(self) -> None:
        table = np.asarray(self.table)
        if table.ndim != 3 or table.shape[2] != 2 or min(table.shape[:2]) < 2:
            raise InputError(f"has shape {table.shape}", where="rays", remedy="pass (H, W, 2)")
        if np.isfinite(table).all(-1).sum() < 16:
            raise InputError("contains no finite rays", where="rays")
        if _is_mirrored(table):
            raise InputError(
                "mirror the image: either x/z or y/z runs against the pixels",
                where="rays",
                remedy="negate one of the two: x is right and y is down, or both the other way",
            )
        object.__setattr__(self, "table", _frozen(np.array(table, np.float32)))

    @property
    def width(self) -> int:
        """Columns."""
        return int(self.table.shape[1])

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.table.shape[0])

    def __eq__(self, other: object) -> bool:
        return self is other or (
            isinstance(other, RayTable) and np.array_equal(self.table, other.table, equal_nan=True)
        )

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        # Equal tables must have equal hashes: -0 equals 0, and all NaN count as equal.
        return hash((self.table.shape, np.nan_to_num(self.table + np.float32(0)).tobytes()))

    def rays(self) -> Float32:
        """See `Camera.rays`."""
        return self.table

    @cached_property
    def fit(self) -> Pinhole:
        """Pinhole camera fitted to the table by least squares on pixel positions."""
        v, u = np.mgrid[0 : self.height, 0 : self.width]
        ok = np.isfinite(self.table).all(-1)
        x, y = self.table[ok].astype(float).T
        (fx, cx), (fy, cy) = (
            np.linalg.lstsq(np.stack([a, np.ones_like(a)], 1), b[ok].astype(float), rcond=None)[0]
            for a, b in ((x, u), (y, v))
        )
        return Pinhole(self.width, self.height, float(fx), float(fy), float(cx), float(cy))

    @cached_property
    def _filled(self) -> Float64:
        """The table in float64; unknown rays go on as the nearest ones with known neighbours do.

        A step in the table would be a second place for the rays at the rim of what is known.
        """
        rays = self.table.astype(float)
        unknown = ~np.isfinite(rays).all(-1)
        if not unknown.any():
            return rays
        by_row, by_column = np.gradient(rays, axis=(0, 1))
        smooth = np.isfinite(by_row + by_column).all(-1)
        if not smooth.any():
            return np.where(unknown[..., None], self.fit.rays(), rays)
        nearest = scipy.ndimage.distance_transform_edt(
            ~smooth, return_distances=False, return_indices=True
        )
        i, j = nearest[:, unknown]
        down, right = (np.argwhere(unknown) - np.stack([i, j], 1)).T[:, :, None]
        rays[unknown] = rays[i, j] + down * by_row[i, j] + right * by_column[i, j]
        return rays

    def project(self, points: ArrayLike) -> Float64:
        """Project points by Newton's method on the interpolated table; see `Camera.project`."""
        points = np.asarray(points, float)
        z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
        target = points[..., :2] / z[..., None]
        limits = np.array([self.width - 1.0, self.height - 1.0])
        uv = np.clip(self.fit.project(points), 0, limits)  # beyond it, the fit can be far off
        with np.errstate(all="ignore"):  # diverges for points that the camera does not see
            for _ in range(8):
                base = np.clip(np.nan_to_num(np.floor(uv)), 0, limits - 1).astype(np.intp)
                i, j = base[..., 1], base[..., 0]
                f = uv - base
                r00, r10 = self._filled[i, j], self._filled[i, j + 1]
                r01, r11 = self._filled[i + 1, j], self._filled[i + 1, j + 1]
                fu, fv = f[..., :1], f[..., 1:]
                along_u = (r10 - r00) * (1 - fv) + (r11 - r01) * fv
                along_v = (r01 - r00) * (1 - fu) + (r11 - r10) * fu
                bilinear = r00 + (r10 - r00) * fu + (r01 - r00) * fv
                error = bilinear + (r00 - r10 - r01 + r11) * fu * fv - target
                det = along_u[..., 0] * along_v[..., 1] - along_u[..., 1] * along_v[..., 0]
                du = (along_v[..., 1] * error[..., 0] - along_v[..., 0] * error[..., 1]) / det
                dv = (along_u[..., 0] * error[..., 1] - along_u[..., 1] * error[..., 0]) / det
                uv = uv - np.stack([du, dv], -1)
        return uv


MODELS: dict[str, type[Pinhole]] = {
    "pinhole": Pinhole,
    "brown": BrownConrady,
    "rational": Rational,
    "fisheye": Fisheye,
}

# Order of camera.json's "distortion" list, for each model.
DISTORTION_ORDER = {
    "pinhole": (),
    "brown": ("k1", "k2", "p1", "p2", "k3"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}


# Sizes of images in focal lengths: fields of view of 0.06 and 172 degrees, fisheyes of more.
_MIN_RATIO, _MAX_RATIO = 1e-3, 30.0


def check_intrinsics(camera: Pinhole) -> None:
    """Raise InputError if a parameter of the camera is not finite or implausible."""
    for f in fields(camera):
        value = getattr(camera, f.name)
        if isinstance(value, bool) or not isinstance(value, int | float | np.number):
            raise InputError(f"is {value!r}", where=f"camera {f.name}", remedy="use a number")
        if not np.isfinite(value):
            raise InputError(f"is {value}", where=f"camera {f.name}", remedy="use a finite number")
    if not (2 <= camera.width <= 16384 and 2 <= camera.height <= 16384):
        problem, remedy = f"is {camera.width} x {camera.height}", "set the image size in pixels"
        raise InputError(problem, where="camera width x height", remedy=remedy)
    if camera.fx <= 0 or camera.fy <= 0:
        problem, remedy = f"is {camera.fx}, {camera.fy}", "use positive focal lengths in pixels"
        raise InputError(problem, where="camera fx, fy", remedy=remedy)
    for name, size in (("fx", camera.width), ("fy", camera.height)):
        ratio = size / getattr(camera, name)
        if not _MIN_RATIO <= ratio <= _MAX_RATIO:
            raise InputError(
                f"is {getattr(camera, name):g} pixels, for an image of {size}: a field of view of "
                f"{np.degrees(2 * np.arctan(ratio / 2)):.4g} degrees",
                where=f"camera {name}",
                remedy="multiply normalised focal lengths by the size of the image"
                if ratio > 1
                else "use pixels of these images",
            )


def scaled(camera: Pinhole, width: int, height: int) -> Pinhole:
    """Return the same lens at another resolution (pixel centres at integer coordinates)."""
    sx, sy = width / camera.width, height / camera.height
    changes: dict[str, Any] = {
        "width": width,
        "height": height,
        "fx": camera.fx * sx,
        "fy": camera.fy * sy,
        "cx": (camera.cx + 0.5) * sx - 0.5,
        "cy": (camera.cy + 0.5) * sy - 0.5,
    }
    return replace(camera, **changes)


def _pixel_grid(camera: Pinhole) -> Float64:
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(float)
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], -1)


def _frozen(a: Float32) -> Float32:
    a.flags.writeable = False
    return a


_MAX_SKEW_PX = 0.005  # a smaller displacement of pixels by skew is neglected
# Images have another order of axes if the principal point is farther from their centre than this
# fraction of their size, and than this multiple of that fraction for the other order.
_MIN_OFFSET, _MIN_OFFSET_RATIO = 0.1, 3.0


def pinhole_values(K: Float64, shape: tuple[int, ...], where: str | Path) -> dict[str, float]:
    """Return fx, fy, cx and cy of a matrix K (3, 3).

    Parameters
    ----------
    K
        The matrix.
    shape
        (N, H, W) of its images, or (H, W): H decides whether a skew is negligible.
    where
        The file or argument, for errors.

    Raises
    ------
    InputError
        If it is not such a matrix, or has skew, which a pinhole camera has not; if it shows that
        the images are transposed, or stacked along the last axis.
    """
    if K.shape != (3, 3) or not np.allclose(K[2], (0, 0, 1)) or K[1, 0] != 0:
        raise InputError(
            f"is not a matrix K: {K.tolist()}" if K.size < 20 else f"has shape {K.shape}",
            where=where,
            remedy="use [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels of the depth images",
        )
    if abs(K[0, 1]) * shape[-2] > _MAX_SKEW_PX * abs(K[1, 1]):
        raise InputError(
            f"has a skew of {K[0, 1]:.3g} px",
            where=where,
            remedy="use the rays of the pixels (rays, RayTable), or 0 if it is negligible",
        )
    if len(shape) == 3:
        _check_order(K[:2, 2], shape, where)
    (fx, _, cx), (_, fy, cy) = K[:2, :3].astype(float).tolist()
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy}


def _check_order(centre: Float64, shape: tuple[int, ...], where: str | Path) -> None:
    """Refuse images (N, H, W) that are centred on the principal point in another order of axes."""

    def offset(width: int, height: int) -> float:
        return float(np.abs(centre / (width, height) - 0.5).max())

    for width, height, order, remedy in (
        (shape[1], shape[0], "frames come first", "numpy.moveaxis(depth, -1, 0)"),
        (shape[1], shape[2], "rows come before columns", "numpy.swapaxes(depth, 1, 2)"),
    ):
        other = offset(width, height)
        if offset(shape[2], shape[1]) > max(_MIN_OFFSET, _MIN_OFFSET_RATIO * other):
            raise InputError(
                f"is that of images of {width} x {height} pixels, and depth has shape {shape}: "
                f"{order}",
                where=where,
                remedy=f"pass {remedy}",
            )
