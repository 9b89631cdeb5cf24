"""Segmentation of a moving object from the background of a stationary camera, and its filter."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Annotated, ClassVar

import numpy as np
from scipy import ndimage

from tofuse.engine.arrays import Bool, Float32, Float64, Int32
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.connections import NEIGHBOURS, parts_of_image
from tofuse.engine.errors import InputError
from tofuse.engine.filters.base import Filter
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.normal import MEDIAN_OF_NORMAL
from tofuse.engine.parts import part

# A surface exists where this fraction of the frames, and this number, agree on its depth.
_MIN_FRACTION, _MIN_AGREEING = 0.15, 3
# Depths agree within this number of sigmas plus this fraction of the depth.
_SIGMAS, _RELATIVE = 5.0, 0.01
_OPTION = "--object"
_LEAVE = "leave it out if the camera moves; else "
_CUT = "crop the background with --max-depth, a box or a mask"
_MIN_FRAMES = 6
# Neighbouring depths that differ by more than this fraction are on different surfaces.
_JUMP = 0.04
# A pixel is static if its background is visible in this fraction of the frames, and swept by the
# object if it is not visible in this fraction.
_STATIC, _SWEPT = 0.8, 0.04
# What is visible in a smaller fraction of the frames is mostly hidden.
_VISIBLE = 0.5
# Fraction of an image border that must be static.
_STATIC_BORDER = 0.6
# Smallest fraction of foreground pixels of an object.
_MIN_OBJECT = 0.002
# The object's rim has mixed pixels; its depth is taken from the interior within this distance.
_FILL_PIXELS = 6
# A support (table, floor, wall) is a plane of static pixels that covers this fraction of the border
# of the image. Numbers of samples of three points, and of points that they are tested with.
_SUPPORT_BORDER, _SAMPLES, _SAMPLED_POINTS = 0.1, 500, 2000
_MAX_SUPPORTS = 4
# Smallest fraction of the rim of an object's segment that must continue the passing object.
_MIN_JOINED = 0.25
# Foreground components smaller than this fraction of the largest are speckle.
_SPECKLE = 0.02
# Fraction of the outline of the foreground at which its surface must end.
_MIN_OUTLINE = 0.5
# Fraction of the foreground that must be farther than a pixel from its outline.
_MIN_INNER = 0.4
# Percentiles of the depths of the object, and the relative margin around their interval. Mixed
# pixels of object and background can have any depth, even nearer than both.
_DEPTH_PERCENTILES = (2, 98)
_MARGIN = 0.5


@part("filter", "background")
@dataclass(frozen=True)
class Background(Bounded, Filter):
    """Keep points in front of the background of a static camera.

    The background of a pixel is the farthest surface that it measures in several frames, sampled
    over the entire recording. Where the object always occludes the background, that surface belongs
    to the object: its depth differs from the surroundings, and continues the object at neighbouring
    pixels, or is as near as the object and mostly hidden. A plane that reaches the border of the
    image, such as a table, is background.

    Attributes
    ----------
    sigmas, fraction
        Smallest distance of a point in front of the background: the sum of this number of standard
        deviations of the background's depth, and this fraction of it.
    """

    sigmas: Annotated[float, Bounds(0, exclusive=True)] = 4.0
    fraction: Annotated[float, Bounds(0, 1)] = 0.02

    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    @property
    def needs_fit(self) -> bool:
        """See `Filter.needs_fit`."""
        return True

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`; InputError, as the background has not been estimated."""
        raise InputError(
            "is not fitted to a recording",
            where="filter 'background'",
            remedy="use the filter that its `fit` returns, or tofuse.reconstruct",
        )

    def fit(self, frames: Sequence[Frame]) -> Filter:
        """See `Filter.fit`.

        Raises
        ------
        InputError
            If the camera moves, nothing moves, or the object can't be segmented from its support.
        """
        images = [frame for frame in frames if isinstance(frame, RangeFrame)]
        return FittedBackground(self, moving_object(images, self.sigmas, self.fraction))


class FittedBackground(Background):
    """A `Background` with an estimated background."""

    _found: MovingObject

    def __init__(self, options: Background, fitted: MovingObject) -> None:
        super().__init__(**{f.name: getattr(options, f.name) for f in fields(options)})
        object.__setattr__(self, "_found", fitted)

    @property
    def needs_fit(self) -> bool:
        """See `Filter.needs_fit`."""
        return False

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`."""
        assert isinstance(frame, RangeFrame)
        rows, columns = self._found.limit.shape
        if frame.depth.shape != (rows, columns):
            raise InputError(
                f"is {frame.depth.shape[1]} x {frame.depth.shape[0]}, the background "
                f"{columns} x {rows}",
                where=f"frame {frame.index}",
                remedy="use images of one size",
            )
        return self._found.mask(frame.z)


@dataclass(frozen=True, eq=False)
class BackgroundSurface:
    """The farthest surface at each pixel over frames of a stationary camera.

    Attributes
    ----------
    z
        (H, W) float32 z depth in m: the median of the depths that agree; infinite where most frames
        have no measurement, 0 where no depths agree.
    sigma
        (H, W) float32 standard deviation in m of one measurement of it; 0 where there is none.
    static_fraction
        (H, W) float32 fraction of the frames with its depth or without a measurement.
    """

    z: Float32
    sigma: Float32
    static_fraction: Float32


def background_surface(frames: Sequence[RangeFrame]) -> BackgroundSurface:
    """Find the farthest surface that each pixel observes in several frames.

    Parameters
    ----------
    frames
        At least 3, of the same size, in which the objects in front of the background moved.
    """
    z = np.stack([frame.z for frame in frames])
    z[~np.stack([frame.valid for frame in frames])] = 0
    count = len(z)
    min_frames = max(_MIN_AGREEING, int(np.ceil(_MIN_FRACTION * count)))
    valid = z > 0
    descending = np.sort(z, axis=0)[::-1]
    tolerance = _SIGMAS * _spatial_sigma(z) + np.float32(_RELATIVE) * descending[0]
    centre = np.zeros_like(descending[0])
    assigned = np.zeros(centre.shape, bool)
    for k in range(count - min_frames + 1):
        low = descending[k + min_frames - 1]
        agreeing = ~assigned & (low > 0) & (descending[k] - low <= tolerance)
        centre[agreeing] = descending[k + min_frames // 2][agreeing]
        assigned |= agreeing
    agree = valid & assigned & (np.abs(z - centre) <= tolerance)
    depth = _median(z, agree)
    sigma = _median(np.abs(z - depth), agree) / np.float32(MEDIAN_OF_NORMAL)
    missing = ~valid
    empty = 2 * np.count_nonzero(missing, axis=0) > count
    return BackgroundSurface(
        np.where(empty, np.float32(np.inf), depth),
        np.where(empty, np.float32(0), sigma),
        np.where(empty, missing, agree | missing).mean(0, dtype=np.float32),
    )


@dataclass(frozen=True, eq=False)
class MovingObject:
    """An object that moves in front of a static background, segmented by its depth.

    Attributes
    ----------
    background
        The farthest surface at each pixel.
    limit
        (H, W) float32 z in m below which a point is in front of the background. Infinite where the
        object always occludes it.
    always_occluded
        (H, W) mask of the pixels at which the object always occludes the background.
    depth_range
        (min, max) z in m of the object.
    """

    background: BackgroundSurface
    limit: Float32
    always_occluded: Bool
    depth_range: tuple[float, float]

    def mask(self, z: Float32) -> Bool:
        """Return the (H, W) mask of the object in a z image (H, W), 0 where invalid."""
        near, far = self.depth_range
        margin = _MARGIN * (far - near)
        in_range = (z > 0) & (z >= near - margin) & (z <= far + margin)
        return _without_speckle(in_range & (z < self.limit))


def moving_object(
    frames: Sequence[RangeFrame], sigmas: float = 4.0, relative: float = 0.02
) -> MovingObject:
    """Segment a moving object from the background of a stationary camera.

    Parameters
    ----------
    frames
        Spread over the recording.
    sigmas, relative
        Distance of a point from the background, in standard deviations of the background's depth
        plus a fraction of this depth.

    Raises
    ------
    InputError
        If the camera moves, nothing moves, or the object can't be separated from its support.
    """
    if len(frames) < _MIN_FRAMES:
        raise InputError(
            f"needs {_MIN_FRAMES} frames to learn the background, not {len(frames)}",
            where=_OPTION,
            remedy=_CUT,
        )
    if len({frame.depth.shape for frame in frames}) > 1:
        raise InputError("needs images of the same size", where=_OPTION, remedy=_CUT)
    background = background_surface(frames)
    background_z = _filled(background.z)
    observed = np.isfinite(background_z)
    limit = background_z.copy()
    limit[observed] -= (sigmas * background.sigma + np.float32(relative) * background_z)[observed]
    z = np.stack([frame.z for frame in frames])
    z[~np.stack([frame.valid for frame in frames])] = 0
    front = np.stack([_without_speckle((image > 0) & (image < limit)) for image in z])
    frequency = front.mean(0)
    if observed.any():
        _check_static(background, frequency)
    interior = np.stack([ndimage.binary_erosion(image, np.ones((3, 3))) for image in front])
    smooth_z = ndimage.median_filter(background_z, 3)
    unswept = (background.static_fraction >= _STATIC) & (frequency <= _SWEPT)
    rays = frames[0].camera.rays().astype(float)
    finite_z = np.where(np.isfinite(smooth_z), smooth_z, 0)
    points = np.dstack([rays, np.ones(finite_z.shape)]) * finite_z[..., None]
    supports = _supports(points, unswept, relative)
    always_occluded = _always_occluded(smooth_z, supports, _filled(_median(z, interior)), frequency)
    if interior.any():
        # What is as near as the object, but mostly hidden, is the object's farthest surface.
        near, far = np.percentile(z[interior], _DEPTH_PERCENTILES)
        as_near = background_z <= far + _MARGIN * (far - near)
        always_occluded |= as_near & (background.static_fraction < _VISIBLE)
    always_occluded &= supports == 0
    limit[always_occluded] = np.inf
    depths = np.concatenate(
        [z[interior], background.z[always_occluded & observed & (background.z > 0)]]
    )
    low, high = np.percentile(depths, _DEPTH_PERCENTILES) if len(depths) else (0.0, np.inf)
    segmentation = MovingObject(background, limit, always_occluded, (float(low), float(high)))
    _check_complete([segmentation.mask(image) for image in z], z, supports > 0)
    return segmentation


def _spatial_sigma(z: Float32) -> Float32:
    """(H, W) noise of z (N, H, W), from second differences of neighbouring pixels."""
    by_axis = []
    for axis in (1, 2):
        lines = np.moveaxis(z, axis, 2)
        second_difference = np.full(lines.shape, np.nan, np.float32)
        valid = (lines[..., 2:] > 0) & (lines[..., 1:-1] > 0) & (lines[..., :-2] > 0)
        magnitude = np.abs(lines[..., 2:] - 2 * lines[..., 1:-1] + lines[..., :-2])
        second_difference[..., 1:-1] = np.where(valid, magnitude, np.nan)
        by_axis.append(_median(np.moveaxis(second_difference, 2, axis), None))
    # The second difference of independent noise has six times its variance.
    sigma = np.fmin(*by_axis) / np.float32(np.sqrt(6) * MEDIAN_OF_NORMAL)
    finite = sigma[np.isfinite(sigma)]
    typical = np.float32(np.median(finite)) if len(finite) else np.float32(0)
    return np.where(np.isfinite(sigma), sigma, typical)


def _median(values: Float32, where: Bool | None) -> Float32:
    """Median (H, W) over the first axis of (N, H, W); 0 (NaN without `where`) if there is none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # for empty slices
        if where is None:
            return np.nanmedian(values, axis=0).astype(np.float32)
        median = np.nanmedian(np.where(where, values, np.nan), axis=0)
    return np.nan_to_num(median).astype(np.float32)


def _check_static(background: BackgroundSurface, frequency: Float64) -> None:
    """Refuse images whose borders are not static, and those without a moving object."""
    static = background.static_fraction >= _STATIC
    borders = (static[0], static[-1], static[:, 0], static[:, -1])
    sides = sorted(float(border.mean()) for border in borders)
    # The object may extend beyond one border, for example if it stands on the floor.
    if sides[1] < _STATIC_BORDER:
        raise InputError(
            "needs a stationary camera and a background around the object, and "
            f"{sum(side < _STATIC_BORDER for side in sides)} image borders change",
            where=_OPTION,
            remedy=_LEAVE + _CUT,
        )
    if frequency.mean() < _MIN_OBJECT:
        raise InputError(
            "nothing moves in front of the background, or the object looks the same from all sides",
            where=_OPTION,
            remedy=_LEAVE + _CUT,
        )


def _check_complete(masks: Sequence[Bool], z: Float32, support: Bool) -> None:
    """Refuse an object of which only parts or the rim were segmented."""
    outlines = [_outline(mask, image, support) for mask, image in zip(masks, z, strict=True)]
    outline = float(np.mean(outlines))
    interior = sum(int(ndimage.binary_erosion(mask, np.ones((3, 3))).sum()) for mask in masks)
    if outline < _MIN_OUTLINE or interior < _MIN_INNER * np.sum(masks):
        raise InputError(
            "the moving object can't be separated from the background", where=_OPTION, remedy=_CUT
        )


def _supports(points: Float64, unswept: Bool, relative: float) -> Int32:
    """Label the pixels (H, W) on planes that the object may touch, from 1; 0 elsewhere.

    Where it stands on a table, no jump of the depth separates the two. Such a plane is seen next to
    the object, reaches the border of the image, and is flat: its `points` (H, W, 3) agree to the
    fraction `relative` of their depth.
    """
    label = np.zeros(unswept.shape, np.int32)
    border = np.ones(unswept.shape, bool)
    border[1:-1, 1:-1] = False
    usable = unswept & np.isfinite(points).all(2) & (points[..., 2] > 0)
    rng = np.random.default_rng(0)
    for support in range(1, _MAX_SUPPORTS + 1):
        free = points[usable & (label == 0)]
        reaching = points[usable & (label == 0) & border]
        if len(reaching) < _SUPPORT_BORDER * np.count_nonzero(border):
            break
        free = rng.choice(free, _SAMPLED_POINTS)
        # Two points at the border, as the plane has to reach it. It consists of the x with n x = 1.
        triples = [rng.choice(each, _SAMPLES) for each in (reaching, reaching, free)]
        normals = np.linalg.pinv(np.stack(triples, 1)).sum(2)
        agreeing = np.abs(free @ normals.T - 1) <= relative
        best = free[agreeing[:, np.argmax(agreeing.sum(0))]]
        normal = np.linalg.lstsq(best, np.ones(len(best)), rcond=None)[0]
        on_plane = (label == 0) & (np.abs(points @ normal - 1) <= relative)
        # Not where the plane happens to meet the object elsewhere.
        parts, _ = ndimage.label(on_plane)
        on_plane &= np.isin(parts, parts[on_plane & border])
        if np.count_nonzero(on_plane & border) < _SUPPORT_BORDER * np.count_nonzero(border):
            break
        label[on_plane] = support
    return label


def _always_occluded(z: Float32, apart: Int32, passing: Float32, frequency: Float64) -> Bool:
    """Mask (H, W) where the far surface z is the object: it always occludes the background.

    A segment of the object, apart from what it touches by the labels `apart`, is nearer than the
    adjacent segments. Where the object passes in front of these (in the fraction `frequency` of the
    frames), its depth (`passing`, 0 where unknown) is close to that of the segment. Only part of
    the rim must satisfy this: the object may stand on a support.
    """
    label = _segments(z, apart)
    count = int(label.max()) + 1
    rim, joined = np.zeros(count), np.zeros(count)
    for a, b in NEIGHBOURS:
        for p, q in ((a, b), (b, a)):
            boundary = label[p] != label[q]
            segment, z_segment = label[p][boundary], z[p][boundary]
            z_adjacent = np.minimum(
                z[q][boundary], 2 * z_segment
            )  # finite even where nothing is measured
            z_object, frequency_adjacent = passing[q][boundary], frequency[q][boundary]
            # Nearer to the segment than to the adjacent surface.
            nearer_to_segment = np.abs(z_object - z_segment) < 0.5 * np.abs(z_adjacent - z_segment)
            continues = (z_segment < z_adjacent) & (frequency_adjacent > _SWEPT) & nearer_to_segment
            rim += np.bincount(segment, minlength=count)
            joined += np.bincount(segment, weights=continues, minlength=count)
    is_object = joined > _MIN_JOINED * np.maximum(rim, 1)
    is_object[0] = False
    return np.asarray(is_object[label])


def _filled(z: Float32) -> Float32:
    """Fill the zeros of an image (H, W) from the nearest valid pixel within `_FILL_PIXELS`."""
    distance, nearest = ndimage.distance_transform_edt(z <= 0, return_indices=True)
    return np.where(distance <= _FILL_PIXELS, z[tuple(nearest)], np.float32(0))


def _segments(z: Float32, apart: Int32) -> Int32:
    """Label the segments of a depth image (H, W) without jumps, from 1; 0 where z is 0.

    Pixels with different labels `apart` are not connected. Pixels at a jump belong to the segment
    on their side of it.
    """

    def connected(a: Float32, b: Float32) -> Bool:
        with np.errstate(invalid="ignore"):
            alike = np.abs(a - b) <= _JUMP * np.minimum(a, b)
        return (alike | (np.isinf(a) & np.isinf(b))) & (a > 0) & (b > 0)

    label = parts_of_image(
        z.shape, (connected(z[a], z[b]) & (apart[a] == apart[b]) for a, b in NEIGHBOURS)
    )
    return np.where(z > 0, label + 1, 0).astype(np.int32)


def _without_speckle(mask: Bool) -> Bool:
    """Remove the small components of a mask."""
    label, count = ndimage.label(mask)
    if count < 2:
        return mask
    size = np.bincount(label.ravel())
    size[0] = 0
    return np.asarray((size >= _SPECKLE * size.max())[label] & mask)


def _outline(mask: Bool, z: Float32, support: Bool) -> float:
    """Fraction of a mask's outline at which the surface ends.

    There is a jump of the depth z, no measurement, or what the object stands on (`support`).
    """
    total = ends = 0
    for a, b in NEIGHBOURS:
        for p, q in ((a, b), (b, a)):
            rim = mask[p] & ~mask[q]
            inside, outside = z[p][rim], z[q][rim]
            jump = np.abs(outside - inside) > _JUMP * inside
            total += len(inside)
            ends += int(np.count_nonzero((outside <= 0) | jump | support[q][rim]))
    return ends / total if total else 1.0
