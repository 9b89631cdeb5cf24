"""The two kinds of view: a depth image of a camera, and a cloud.

Both have N valid points with columns, in a frame of their own, which is all that the registration
of clouds needs. All arrays are read-only by convention: methods return new frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofuse.engine import quantities
from tofuse.engine.arrays import Bool, Float32, Float64, UInt8
from tofuse.engine.bounds import Bounds
from tofuse.engine.cameras import Camera, depth_conversion, unknown_rays
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
from tofuse.engine.parts import check_number
from tofuse.engine.times import check_frame_time

DepthKind = Literal["z", "range"]
AmplitudeKind = Literal["raw", "range_compensated", "ir"]

SATURATED_AMPLITUDE = 65535.0
# Minimum fraction of points behind the origin that excludes a camera.
_MIN_BEHIND = 0.1
# Largest difference of the length of a direction from 1.
_MAX_UNIT_ERROR = 0.1


# Names of all images of a `RangeFrame`, which have one size.
IMAGES = (
    "depth",
    "amplitude_image",
    "confidence_image",
    "color_image",
    "sigma_image",
    "shared_sigma_image",
    "normal_image",
)


_METRES = ("depth", "sigma_image", "shared_sigma_image")


# Names of the columns (N, ...) of a `CloudFrame`.
COLUMNS = ("points", "normals", "sigma", "amplitude", "color")


@dataclass(frozen=True, eq=False)
class RangeFrame:
    """One image of a depth camera.

    Attributes
    ----------
    index
        Index in the recording, before any selection.
    timestamp
        Seconds.
    camera
        Rays of the pixels.
    depth
        (H, W) float32 in m, 0 where invalid: radial range or z depth, see `depth_kind`.
    depth_kind
        "z" or "range".
    amplitude_image
        (H, W) float32 in counts, 0 where there is none, `SATURATED_AMPLITUDE` where saturated.
    confidence_image
        (H, W) uint8; higher is better.
    color_image
        (H, W, 3) uint8 RGB at the pixels of depth.
    sigma_image
        (H, W) float32, standard deviation of the range in m.
    shared_sigma_image
        (H, W) float32, standard deviation of the range error in m that is correlated between
        neighbouring pixels, so that it does not average out; in addition to `sigma_image`.
    normal_image
        (H, W, 3) float32 unit normals towards the camera, NaN where unknown.
    amplitude_kind
        "raw": the received modulated light, which decreases with the square of the range;
        "range_compensated": multiplied by the square of the range (and divided by the falloff of
        lens and illumination), which is the albedo times the cosine of incidence; "ir": active
        brightness by the manufacturer's own mapping, treated as raw.
    ambiguity_m
        Range in m after which the phase repeats; None if not known.
    color_registered
        Whether the colour of a pixel is that of its point; if not, it is used only for display.
    """

    index: int
    timestamp: float
    camera: Camera
    depth: Float32
    depth_kind: DepthKind = "z"
    amplitude_image: Float32 | None = None
    confidence_image: UInt8 | None = None
    color_image: UInt8 | None = None
    sigma_image: Float32 | None = None
    normal_image: Float32 | None = None
    amplitude_kind: AmplitudeKind = "raw"
    ambiguity_m: float | None = None
    color_registered: bool = True
    shared_sigma_image: Float32 | None = None

    def __repr__(self) -> str:
        size = f"{self.camera.width} x {self.camera.height}"
        return f"RangeFrame {self.index}: {size} at {self.timestamp:.3f} s, {len(self):,} valid"

    def __post_init__(self) -> None:
        _check_frame(self)
        where = f"frame {self.index}"
        if not isinstance(self.camera, Camera):
            raise InputError(
                f"is {quantities.one(type(self.camera).__name__)}, not a camera",
                where=f"{where}: camera",
                remedy="pass a camera, such as tofuse.Pinhole",
            )
        for kind, known in (("depth_kind", DepthKind), ("amplitude_kind", AmplitudeKind)):
            value, choices = getattr(self, kind), get_args(known)
            if not isinstance(value, str) or value not in choices:
                remedy = f"use one of {', '.join(choices)}"
                raise InputError(f"is {value!r}", where=f"{where}: {kind}", remedy=remedy)
        if self.ambiguity_m is not None:
            positive = Bounds(0, exclusive=True)
            check_number(self.ambiguity_m, positive, f"{where}: ambiguity_m")
        shape = (self.camera.height, self.camera.width)
        for name in IMAGES:
            image = getattr(self, name)
            if image is None:
                continue
            last = (3,) if name in ("color_image", "normal_image") else ()
            if isinstance(image, np.ma.MaskedArray):  # a masked pixel has no value
                image = image.filled(np.nan if name == "normal_image" else 0)
                object.__setattr__(self, name, image)
            is_array = isinstance(image, np.ndarray) and image.dtype.kind in "biuf"
            if not is_array or image.ndim != 2 + len(last) or image.shape[2:] != last:
                given = f"an array of shape {image.shape}" if is_array else type(image).__name__
                raise InputError(
                    f"is {given}",
                    where=f"{where}: {name}",
                    remedy=f"pass a NumPy array of numbers (H, W{', 3' if last else ''})",
                )
            # Integers are in another unit than metres, and floats of colour may end at 1.
            if name in _METRES and image.dtype.kind != "f":
                remedy = "use floats in metres: divide integers in millimetres by 1000"
                raise InputError(f"is {image.dtype}", where=f"{where}: {name}", remedy=remedy)
            if name in ("color_image", "confidence_image") and image.dtype != np.uint8:
                remedy = "use uint8, from 0 to 255"
                raise InputError(f"is {image.dtype}", where=f"{where}: {name}", remedy=remedy)
            if image.shape[:2] != shape:
                raise InputError(
                    f"{name} is {image.shape[1]} x {image.shape[0]}, the camera "
                    f"{shape[1]} x {shape[0]}",
                    where=where,
                    remedy="use the camera of these images",
                )
        depth = np.asarray(self.depth, np.float32)
        # Frames of readers rarely need this copy.
        valid = (depth >= 0) & (depth < np.inf)
        if not valid.all():
            depth = np.where(valid, depth, np.float32(0))
        object.__setattr__(self, "depth", depth)
        amplitude = self.amplitude_image
        if amplitude is not None and ((amplitude < 0) | (amplitude == np.inf)).any():
            amplitude = np.where(amplitude < 0, 0, amplitude)
            amplitude = np.where(amplitude == np.inf, SATURATED_AMPLITUDE, amplitude)
            object.__setattr__(self, "amplitude_image", amplitude.astype(np.float32))

    @property
    def shift(self) -> Float64:
        """Zero (3,): the coordinates of an image are those of its camera."""
        return np.zeros(3)

    @cached_property
    def valid(self) -> Bool:
        """(H, W) mask of pixels with a measurement and a known ray."""
        unknown = unknown_rays(self.camera)
        return self.depth > 0 if unknown is None else (self.depth > 0) & ~unknown

    @cached_property
    def z(self) -> Float32:
        """(H, W) z depth in m, 0 where invalid."""
        if self.depth_kind == "z":
            return self.depth
        return depth_conversion.z_from_range(self.camera, self.depth)

    @cached_property
    def radial_range(self) -> Float32:
        """(H, W) radial range in m, 0 where invalid."""
        if self.depth_kind == "range":
            return self.depth
        return depth_conversion.range_from_z(self.camera, self.depth)

    @cached_property
    def point_image(self) -> Float32:
        """(H, W, 3) points in m in the camera frame, the origin where invalid."""
        return depth_conversion.points_from_z(self.camera, self.z)

    @cached_property
    def points(self) -> Float32:
        """(N, 3) valid points in m, in row-major order of their pixels."""
        return self.point_image[self.valid]

    @property
    def normals(self) -> Float32 | None:
        """(N, 3) unit normals towards the sensor, NaN where unknown; None if not computed."""
        return None if self.normal_image is None else self.normal_image[self.valid]

    @property
    def sigma(self) -> Float32 | None:
        """(N,) standard deviation of the range in m; None if not known."""
        return None if self.sigma_image is None else self.sigma_image[self.valid]

    @property
    def amplitude(self) -> Float32 | None:
        """(N,) amplitude in the recording's counts; None if not recorded."""
        return None if self.amplitude_image is None else self.amplitude_image[self.valid]

    @property
    def color(self) -> UInt8 | None:
        """(N, 3) uint8 RGB; None if not recorded."""
        return None if self.color_image is None else self.color_image[self.valid]

    @property
    def origin(self) -> Float64:
        """(3,) position of the sensor in the frame's own coordinates: the optical centre."""
        return np.zeros(3)

    @property
    def mean_depth(self) -> float:
        """The mean of the valid depth, m; 0 if there is none."""
        depth = self.depth[self.valid]
        return float(depth.mean(dtype=np.float64)) if len(depth) else 0.0

    def __len__(self) -> int:
        return int(np.count_nonzero(self.valid))

    def keep(self, mask: Bool) -> Self:
        """Return the frame with every pixel outside the (H, W) mask made invalid."""
        return _unchecked(self, depth=np.where(mask, self.depth, np.float32(0)))

    def copy(self) -> Self:
        """Return the frame with arrays of its own."""
        return _unchecked(self, **_copies(self, IMAGES))


@dataclass(frozen=True, eq=False)
class CloudFrame:
    """A view without a camera model: N points.

    Attributes
    ----------
    index, timestamp
        Frame index in the recording, and s.
    points
        (N, 3) m, in the sensor frame; those that are NaN, or masked, are dropped.
    normals
        (N, 3) unit normals; None where not known.
    sigma
        (N,) standard deviation of the range, m; None where not known.
    amplitude
        (N,) amplitude or intensity; None where not recorded.
    color
        (N, 3) RGB; None where not recorded.
    origin
        (3,) position of the sensor in the frame of the points, m.
    shift
        (3,) m, to add to the points, and to the origin, to get the coordinates of their file. Not
        zero for map coordinates, which exceed the precision of float32; of whole metres.
    up
        (3,) unit vector upwards in the frame of the points, where the format states it; or None.
    """

    index: int
    timestamp: float
    points: Float32
    normals: Float32 | None = None
    sigma: Float32 | None = None
    amplitude: Float32 | None = None
    color: UInt8 | None = None
    origin: Float64 = field(default_factory=lambda: np.zeros(3))
    shift: Float64 = field(default_factory=lambda: np.zeros(3))
    up: Float64 | None = None

    def __repr__(self) -> str:
        return f"CloudFrame {self.index}: {len(self):,} points at {self.timestamp:.3f} s"

    def __post_init__(self) -> None:
        _check_frame(self)
        is_array = isinstance(self.points, np.ndarray) and self.points.dtype.kind in "fiu"
        if not is_array or self.points.ndim != 2 or self.points.shape[1] != 3:
            given = (
                f"shape {self.points.shape}" if is_array else f"type {type(self.points).__name__}"
            )
            raise InputError(
                f"points have {given}",
                where=f"frame {self.index}",
                remedy="pass an (N, 3) array of numbers",
            )
        points = _filled(self.points)
        valid = ~np.isnan(points).any(1)
        largest = np.abs(points[valid]).max(initial=0)
        if largest > se3.MAX_COORDINATE_M:
            raise InputError(
                f"points have coordinates up to {largest:.0e} m",
                where=f"frame {self.index}",
                remedy="use metres, and leave out invalid points",
            )
        if points.dtype != np.float32 and map_shift(points[valid]).any():
            raise InputError(
                "are map coordinates, which exceed the precision of float32",
                where=f"frame {self.index}: points",
                remedy="use CloudFrame.of(points), which keeps what it subtracts as shift",
            )
        object.__setattr__(self, "points", np.asarray(points, np.float32))
        for name in ("origin", "shift"):
            place = getattr(self, name)
            if np.shape(place) != (3,) or not np.isfinite(place).all():
                problem = f"is {place!r}, not three finite numbers"
                raise InputError(problem, where=f"frame {self.index}: {name}", remedy="use metres")
        if self.up is not None and not (
            np.shape(self.up) == (3,) and abs(np.linalg.norm(self.up) - 1) < _MAX_UNIT_ERROR
        ):
            raise InputError(
                f"is {self.up!r}", where=f"frame {self.index}: up", remedy="pass a unit vector (3,)"
            )
        columns = {name: getattr(self, name) for name in COLUMNS}
        _check_columns(self.index, len(self.points), columns)
        for name, column in columns.items():
            if column is not None and not valid.all():
                object.__setattr__(self, name, np.asarray(column)[valid])

    @classmethod
    def of(
        cls,
        points: ArrayLike,
        *,
        index: int = 0,
        timestamp: float = 0.0,
        origin: Float64 | None = None,
        up: Float64 | None = None,
        **columns: NDArray[Any] | None,
    ) -> Self:
        """Make a view of points (N, 3) in m, in any coordinates, dropping invalid ones.

        Parameters
        ----------
        points
            (N, 3) m.
        index, timestamp
            Frame index, and s.
        origin
            (3,) m, in the coordinates of the points; None for their origin.
        up
            (3,) unit vector upwards; None where not known.
        columns
            `normals`, `amplitude` and `color` of all points.
        """
        array = _filled(points)
        if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
            raise InputError(
                f"is an array of shape {array.shape} and type {array.dtype}",
                where="points",
                remedy="pass (N, 3) numbers in metres",
            )
        _check_columns(index, len(array), columns)
        with np.errstate(over="ignore", invalid="ignore"):  # signalling NaN as well
            shift = map_shift(array)
            array = array - shift if shift.any() else array
            # False for NaN; the squares of the remaining coordinates fit into float32.
            valid = (np.abs(array) < se3.MAX_COORDINATE_M).all(1)
        if shift.any():
            _check_rounding(_filled(points).dtype, array[valid], shift)
        if not valid.all():
            array = array[valid]
            columns = {name: v if v is None else v[valid] for name, v in columns.items()}
        origin = (np.zeros(3) if origin is None else origin) - shift
        values: dict[str, Any] = {**columns, "origin": origin, "shift": shift, "up": up}
        return cls(index, timestamp, array.astype(np.float32), **values)

    @property
    def radial_range(self) -> Float64:
        """(N,) distance of the points from the sensor, m.

        Raises
        ------
        InputError
            For map coordinates without the position of the sensor.
        """
        if self.shift.any() and np.array_equal(self.origin, -self.shift):
            raise InputError(
                "is in map coordinates, and without the sensor's position there is no depth",
                where=f"frame {self.index}",
                remedy="leave out --min-depth, --max-depth and filters of distance",
            )
        ranges: Float64 = np.linalg.norm(self.points - self.origin, axis=1)
        return ranges

    @property
    def likely_up(self) -> Float64 | None:
        """(3,) upwards: as stated; z in map coordinates, and of a sensor that measures all around.

        None for others, as cameras look along z.
        """
        if self.up is not None:
            return np.asarray(self.up, np.float64)
        behind = float((self.points[:, 2] < self.origin[2]).mean()) if len(self) else 0.0
        z_is_up = self.shift.any() or _MIN_BEHIND <= behind <= 1 - _MIN_BEHIND
        return np.array([0.0, 0.0, 1.0]) if z_is_up else None

    def relative_to(self, shift: Float64) -> Self:
        """Return the view with another `shift` (3,), m, of the same coordinates of the file."""
        step = self.shift - shift
        if not step.any():
            return self
        points = (self.points.astype(np.float64) + step).astype(np.float32)
        return replace(self, points=points, origin=self.origin + step, shift=shift)

    @property
    def valid(self) -> Bool:
        """(N,) mask: all points of a cloud are valid."""
        return np.ones(len(self.points), bool)

    @property
    def mean_depth(self) -> float:
        """The mean distance of the points from the origin, m; 0 if there are none."""
        distances = np.linalg.norm(self.points - self.origin, axis=1)
        return float(distances.mean()) if len(distances) else 0.0

    def __len__(self) -> int:
        return len(self.points)

    def keep(self, mask: Bool) -> Self:
        """Return the view with only the points of the (N,) mask."""
        columns = {name: getattr(self, name) for name in COLUMNS}
        kept: dict[str, Any] = {n: v if v is None else v[mask] for n, v in columns.items()}
        return replace(self, **kept)

    def copy(self) -> Self:
        """Return the view with arrays of its own."""
        return _unchecked(self, **_copies(self, COLUMNS))


Frame = RangeFrame | CloudFrame


def _unchecked(frame: Frame, **changes: Any) -> Any:
    """Return a frame that has passed the checks of __post_init__, with some fields replaced."""
    changed = object.__new__(type(frame))
    for attribute in fields(frame):
        value = changes.get(attribute.name, getattr(frame, attribute.name))
        object.__setattr__(changed, attribute.name, value)
    return changed


def _copies(frame: Frame, names: Sequence[str]) -> dict[str, Any]:
    arrays = {name: getattr(frame, name) for name in names}
    return {name: np.array(array) for name, array in arrays.items() if array is not None}


# The resolution of float32 is coarser than half a millimetre beyond.
_MAP_COORDINATES_M = 8192.0
_MAX_SAMPLED = 100_000  # points


def map_shift(points: NDArray[np.floating]) -> Float64:
    """Return the `shift` (3,) in m to subtract from points (N, 3): zero but for map coordinates.

    By the median of the plausible points, so that no stray point decides it. Poses relative to it
    act near the points, and not by long lever arms.
    """
    sampled = points[:: max(1, len(points) // _MAX_SAMPLED)]
    sampled = sampled[(np.abs(sampled) <= se3.MAX_COORDINATE_M).all(1)]  # false for NaN
    if not len(sampled):
        return np.zeros(3)
    centre = np.median(sampled.astype(np.float64), axis=0)
    if np.abs(centre).max() <= _MAP_COORDINATES_M:
        return np.zeros(3)
    return np.asarray(np.round(centre))


# Of the extent of a view: surfaces show no shape at coarser steps.
_MAX_STEP = 0.01


def _check_rounding(dtype: np.dtype[Any], points: Float64, shift: Float64) -> None:
    """Refuse map coordinates, of points about `shift`, that their type rounds too much."""
    if dtype.kind != "f":
        return
    step = float(np.spacing(np.abs(shift).max().astype(dtype)))
    if step > _MAX_STEP * np.median(np.abs(points).max(1, initial=0)):
        raise InputError(
            f"has map coordinates that {8 * dtype.itemsize}-bit floats round to {step:.2g} m",
            remedy="export it with double precision, or relative to a point nearby",
        )


def _filled(points: ArrayLike) -> NDArray[Any]:
    """The array of points, NaN where it is masked."""
    if not isinstance(points, np.ma.MaskedArray):
        return np.asarray(points)
    floats = np.asarray(points.data, np.result_type(points.data, np.float32))
    return np.where(np.ma.getmaskarray(points), np.float32(np.nan), floats)


def _check_columns(index: int, count: int, columns: Mapping[str, ArrayLike | None]) -> None:
    """Raise InputError if a column of a cloud doesn't suit its points, or colour isn't uint8."""
    for name, column in columns.items():
        shape = (count, 3) if name in ("points", "normals", "color") else (count,)
        if column is not None and np.shape(column) != shape:
            raise InputError(
                f"has shape {np.shape(column)}, not {shape}",
                where=f"frame {index}: {name}",
                remedy="pass a value for each point",
            )
        if name == "color" and column is not None and np.asarray(column).dtype != np.uint8:
            raise InputError(
                f"is {np.asarray(column).dtype}",
                where=f"frame {index}: color",
                remedy="use uint8, from 0 to 255",
            )


def _check_frame(frame: Frame) -> None:
    """Make index and timestamp plain numbers: differences of NumPy's of few bits overflow."""
    index, timestamp = check_frame_time(frame.index, frame.timestamp)
    object.__setattr__(frame, "index", index)
    object.__setattr__(frame, "timestamp", timestamp)
