"""What stands still before a still camera, and what moves in front of it."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tofuse.arrays import Bool, Float32, Float64, Int32
from tofuse.errors import InputError
from tofuse.recordings.frames import RangeFrame

# A surface is seen if this share of the frames, and as many frames, agree on its depth.
_LEAST_SHARE, _LEAST_FRAMES = 0.15, 3
# Depths agree if they lie within so many sigmas, and this share of the depth, of each other.
_SIGMAS, _SHARE = 5.0, 0.01
_NORMAL_MEDIAN = 0.6745

_OPTION = "--object"
_LEAVE = "leave it out if the camera moves; else "
_CUT = "cut the background off with --max-depth, a box or a mask"
_FEWEST = 6
# Neighbours whose depths differ by more than this share of the depth are two surfaces.
_JUMP = 0.04
# A pixel is still if this share of the frames see its background, and swept if this share do not.
_STILL, _SWEPT = 0.8, 0.04
# Share of a side of the image that must be still.
_STILL_SIDE = 0.6
# Share of the pixels before the background that is enough to be an object.
_LEAST_OBJECT = 0.002
# The rim of what passes mixes its light with that of the background; look as far for its inside.
_NEAR_PIXELS = 6
# Least share of the rim of a piece of the object that must continue what passes beside it.
_LEAST_JOINED = 0.25
# Pieces of the foreground smaller than this share of the largest are speckle.
_SPECKLE = 0.02
# Share of the outline of the foreground at which its surface must end.
_LEAST_OUTLINE = 0.5
# Share of the foreground that must not be within a pixel of its outline.
_LEAST_INNER = 0.4
# Percentiles between which the depths of the object lie, and by how much of that it may be larger.
# Light of object and background mixes to any depth, even one nearer than both.
_REACH = (2, 98)
_BEYOND = 0.5


@dataclass(frozen=True, eq=False)
class FarSurface:
    """The farthest surface of each pixel, over some frames of one still camera.

    Attributes
    ----------
    z
        (H, W) float32 its z depth in m: the median of the depths that agree; infinite where most
        frames measure nothing, 0 where no depths agree.
    sigma
        (H, W) float32 standard deviation in m of one measurement of it; 0 where there is none.
    share
        (H, W) float32, share of the frames that see nothing else: its depth, or nothing at all.
    """

    z: Float32
    sigma: Float32
    share: Float32


def far_surface(frames: Sequence[RangeFrame]) -> FarSurface:
    """Find the farthest surface that each pixel sees in several frames.

    Parameters
    ----------
    frames
        At least 3, of one size, in which things in front of the background have moved.
    """
    z = np.stack([frame.z for frame in frames])
    z[~np.stack([frame.valid for frame in frames])] = 0
    count = len(z)
    least = max(_LEAST_FRAMES, int(np.ceil(_LEAST_SHARE * count)))
    valid = z > 0
    falling = np.sort(z, axis=0)[::-1]
    tolerance = _SIGMAS * _spatial_sigma(z) + np.float32(_SHARE) * falling[0]
    middle = np.zeros_like(falling[0])
    found = np.zeros(middle.shape, bool)
    for k in range(count - least + 1):
        low = falling[k + least - 1]
        fits = ~found & (low > 0) & (falling[k] - low <= tolerance)
        middle[fits] = falling[k + least // 2][fits]
        found |= fits
    agree = valid & found & (np.abs(z - middle) <= tolerance)
    depth = _median(z, agree)
    sigma = _median(np.abs(z - depth), agree) / np.float32(_NORMAL_MEDIAN)
    nothing = ~valid
    empty = 2 * np.count_nonzero(nothing, axis=0) > count
    return FarSurface(
        np.where(empty, np.float32(np.inf), depth),
        np.where(empty, np.float32(0), sigma),
        np.where(empty, nothing, agree | nothing).mean(0, dtype=np.float32),
    )


@dataclass(frozen=True, eq=False)
class MovingObject:
    """What moves before a still background, as some frames of a recording show it.

    Attributes
    ----------
    far
        The farthest surface of each pixel.
    limit
        (H, W) float32 z in m: what is nearer is in front of the background. Infinite where the
        object always hides it.
    own
        (H, W) mask of the pixels at which it does.
    reach
        (near, far) depths in m of the object.
    """

    far: FarSurface
    limit: Float32
    own: Bool
    reach: tuple[float, float]

    def mask(self, z: Float32) -> Bool:
        """(H, W) mask of the pixels of a z image (0: invalid) that show the object."""
        near, far = self.reach
        more = _BEYOND * (far - near)
        reached = (z > 0) & (z >= near - more) & (z <= far + more)
        return _without_speckle(reached & (z < self.limit))


def moving_object(
    frames: Sequence[RangeFrame], sigmas: float = 4.0, share: float = 0.02
) -> MovingObject:
    """Tell an object that moves from the background of a camera that stands still.

    Parameters
    ----------
    frames
        Spread over the recording.
    sigmas, share
        How far in front of the background a point must be: in standard deviations of the
        background's depth, and as a share of it; both together.

    Raises
    ------
    InputError
        If the camera moves, nothing moves, or the object can't be told from what it stands on.
    """
    if len(frames) < _FEWEST:
        raise InputError(
            f"needs {_FEWEST} frames to learn what the background is, not {len(frames)}",
            where=_OPTION,
            remedy=_CUT,
        )
    if len({frame.depth.shape for frame in frames}) > 1:
        raise InputError("needs images of one size", where=_OPTION, remedy=_CUT)
    far = far_surface(frames)
    far_z = _spread(far.z)
    background = np.isfinite(far_z)
    limit = far_z.copy()
    limit[background] -= (sigmas * far.sigma + np.float32(share) * far_z)[background]
    z = np.stack([frame.z for frame in frames])
    z[~np.stack([frame.valid for frame in frames])] = 0
    front = np.stack([_without_speckle((image > 0) & (image < limit)) for image in z])
    often = front.mean(0)
    if background.any():
        _check_still(far, often)
    inner = np.stack([ndimage.binary_erosion(image, np.ones((3, 3))) for image in front])
    own = _own(ndimage.median_filter(far_z, 3), _spread(_median(z, inner)), often)
    limit[own] = np.inf
    depths = np.concatenate([z[inner], far.z[own & background & (far.z > 0)]])
    near, beyond = np.percentile(depths, _REACH) if len(depths) else (0.0, np.inf)
    found = MovingObject(far, limit, own, (float(near), float(beyond)))
    _check_whole([found.mask(image) for image in z], z)
    return found


def _spatial_sigma(z: Float32) -> Float32:
    """(H, W) noise of z (N, H, W): what neighbouring pixels do not have in common."""
    sides = []
    for axis in (1, 2):
        line = np.moveaxis(z, axis, 2)
        bend = np.full(line.shape, np.nan, np.float32)
        three = (line[..., 2:] > 0) & (line[..., 1:-1] > 0) & (line[..., :-2] > 0)
        second = np.abs(line[..., 2:] - 2 * line[..., 1:-1] + line[..., :-2])
        bend[..., 1:-1] = np.where(three, second, np.nan)
        sides.append(_median(np.moveaxis(bend, 2, axis), None))
    # The second difference of independent noise has six times its variance.
    sigma = np.fmin(*sides) / np.float32(np.sqrt(6) * _NORMAL_MEDIAN)
    known = sigma[np.isfinite(sigma)]
    typical = np.float32(np.median(known)) if len(known) else np.float32(0)
    return np.where(np.isfinite(sigma), sigma, typical)


def _median(values: Float32, where: Bool | None) -> Float32:
    """Median (H, W) over the first axis of (N, H, W), 0 (NaN without `where`) of none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of an empty slice
        if where is None:
            return np.nanmedian(values, axis=0).astype(np.float32)
        found = np.nanmedian(np.where(where, values, np.nan), axis=0)
    return np.nan_to_num(found).astype(np.float32)


def _check_still(far: FarSurface, often: Float64) -> None:
    """Refuse a background that does not stay where it is around the image, and one that is all."""
    still = far.share >= _STILL
    sides = sorted(float(side.mean()) for side in (still[0], still[-1], still[:, 0], still[:, -1]))
    # The object may reach beyond one side of the image, as one that stands on the floor does.
    if sides[1] < _STILL_SIDE:
        raise InputError(
            "needs a camera that stands still and a background around the object, and "
            f"{sum(side < _STILL_SIDE for side in sides)} sides of the image change",
            where=_OPTION,
            remedy=_LEAVE + _CUT,
        )
    if often.mean() < _LEAST_OBJECT:
        raise InputError(
            "nothing moves before the background",
            where=_OPTION,
            remedy=_LEAVE + _CUT,
        )


def _check_whole(masks: Sequence[Bool], z: Float32) -> None:
    """Refuse an object of which only parts or the rim are found, as it stands on what is behind."""
    outline = float(np.mean([_outline(mask, image) for mask, image in zip(masks, z, strict=True)]))
    inner = sum(int(ndimage.binary_erosion(mask, np.ones((3, 3))).sum()) for mask in masks)
    if outline < _LEAST_OUTLINE or inner < _LEAST_INNER * np.sum(masks):
        raise InputError(
            "what moves can't be told from what is behind it",
            where=_OPTION,
            remedy=_CUT,
        )


def _own(z: Float32, passing: Float32, often: Float64) -> Bool:
    """Say where the far surface z (H, W) is the object's own, as it hides the background always.

    Such a piece of the far surface lies nearer than the pieces around it. Where the object passes
    before these (in the share `often` of the frames), it is about as near as the piece (`passing`,
    0 where unknown). Only part of the rim must be like that: the object may stand on something.
    """
    label = _pieces(z)
    count = int(label.max()) + 1
    rim, joined = np.zeros(count), np.zeros(count)
    for a, b in _neighbours():
        for p, q in ((a, b), (b, a)):
            apart = label[p] != label[q]
            here, own = label[p][apart], z[p][apart]
            behind = np.minimum(z[q][apart], 2 * own)  # even where there is nothing
            before, seen = passing[q][apart], often[q][apart]
            # Nearer to the piece than to what it passes before.
            near = np.abs(before - own) < 0.5 * np.abs(behind - own)
            continues = (own < behind) & (seen > _SWEPT) & near
            rim += np.bincount(here, minlength=count)
            joined += np.bincount(here, weights=continues, minlength=count)
    is_own = joined > _LEAST_JOINED * np.maximum(rim, 1)
    is_own[0] = False
    return np.asarray(is_own[label])


def _spread(z: Float32) -> Float32:
    """Fill the zeros of an image (H, W) from the nearest pixel that has a value, if it is near."""
    away, nearest = ndimage.distance_transform_edt(z <= 0, return_indices=True)
    return np.where(away <= _NEAR_PIXELS, z[tuple(nearest)], np.float32(0))


def _pieces(z: Float32) -> Int32:
    """Number the pieces of a depth image (H, W) that have no jumps in them, from 1; 0 where z is 0.

    Pixels at a jump count to the piece on their side of it.
    """
    rows, columns = z.shape
    pixel = np.arange(rows * columns).reshape(rows, columns)
    pairs = []
    for a, b in _neighbours():
        with np.errstate(invalid="ignore"):
            near = np.abs(z[a] - z[b]) <= _JUMP * np.minimum(z[a], z[b])
        near |= np.isinf(z[a]) & np.isinf(z[b])
        near &= (z[a] > 0) & (z[b] > 0)
        pairs.append(np.stack([pixel[a][near], pixel[b][near]]))
    i, j = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(i), np.int8), (i, j)), shape=(z.size, z.size))
    _, label = connected_components(graph, directed=False)
    return np.where(z > 0, label.reshape(z.shape) + 1, 0).astype(np.int32)


def _neighbours() -> tuple[tuple[tuple[slice, slice], tuple[slice, slice]], ...]:
    """Index every pair of neighbouring pixels: along the rows, and along the columns."""
    return ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:, :], np.s_[:-1, :]))


def _without_speckle(mask: Bool) -> Bool:
    """Drop the small pieces of a mask."""
    label, count = ndimage.label(mask)
    if count < 2:
        return mask
    size = np.bincount(label.ravel())
    size[0] = 0
    return np.asarray((size >= _SPECKLE * size.max())[label] & mask)


def _outline(mask: Bool, z: Float32) -> float:
    """Share of a mask's outline at which the surface ends: beyond lies nothing, or another one."""
    total = ends = 0
    for a, b in _neighbours():
        for p, q in ((a, b), (b, a)):
            rim = mask[p] & ~mask[q]
            here, there = z[p][rim], z[q][rim]
            total += len(here)
            ends += int(np.count_nonzero((there <= 0) | (np.abs(there - here) > _JUMP * here)))
    return ends / total if total else 1.0
