"""Phase unwrapping for cameras with a single modulation frequency.

With the ambiguity range P, a surface at r + P is measured at r. Two cues identify it. Its amplitude
is that of a far surface: raw amplitude falls with the squared range, so that the albedo implied at
r is too small by (r / (r + P))^2, a factor of thirty at r = 1 m and P = 5 m. And it is continuous:
a floor that leaves one period enters the next.

Pixels with a weak signal have random ranges, and would get random wraps. Therefore only pixels that
measure a surface together with their neighbours (`on_surface`) are unwrapped and used.

Both cues are costs of a Markov random field over the image, which is minimised by belief
propagation (Droeschel et al. 2010; McClure et al. 2010 for the amplitude). For several frequencies
see `tofuse.sensor.frequencies`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label, uniform_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tofuse.arrays import Bool, Float32, Float64, Int32, Intp
from tofuse.kernels.threads import run_chunks
from tofuse.kernels.unwrap import pass_messages

# Fraction of pixels that may be brighter than white, due to gloss and noise.
_GLOSSY = 0.01
# Slopes are differences between blocks at this distance on either side, of the phase averaged over
# windows of this size; and the lower limit of the cosine of incidence.
_REACH, _WIDE, _MIN_COSINE = 2, 5, 0.25
_MAX_MOVES = 100
# Neighbours on one surface differ by less than this fraction of the period, and more than this
# fraction of the neighbours do: a random pixel has that many with a probability of 1 % (binomial,
# 0.2 each).
_SAME_SURFACE, _MIN_AGREEING = 0.1, 0.5
# Smallest number of valid neighbours.
_MIN_NEIGHBOURS = 3


@dataclass(frozen=True)
class UnwrapOptions:
    """Costs and limits of phase unwrapping.

    Attributes
    ----------
    periods
        Largest wrap count.
    albedo, spread
        Median of the log-normal albedo prior, and standard deviation of its logarithm.
    max_albedo_cost
        Upper limit of the albedo cost of a block.
    wrap_cost
        Cost of each wrap, which favours unwrapped surfaces in the absence of evidence.
    albedo_weight
        Weight of these costs, below 1 as the albedos of a surface's blocks are correlated.
    scale
        Difference between neighbours that costs 1, relative to the period.
    max_difference_cost
        Upper limit of the cost of a difference, reached at depth edges.
    min_entry
        Smallest fraction of a wrapped surface's boundary that continues an unwrapped surface across
        the period. Otherwise the surface is dark, not wrapped.
    columns
        Blocks along the image's width.
    iterations
        Of the message passing: the distance in blocks over which information propagates.
    """

    periods: int = 2
    albedo: float = 0.5
    spread: float = 0.6
    max_albedo_cost: float = 4.0
    wrap_cost: float = 0.1
    albedo_weight: float = 0.1
    scale: float = 0.05
    max_difference_cost: float = 3.0
    min_entry: float = 0.05
    columns: int = 88
    iterations: int = 60


_DEFAULT = UnwrapOptions()


def white_amplitude(amplitude: Float32, radial_range: Float32, valid: Bool) -> float:
    """Estimate the raw amplitude of a white surface at 1 m from the brightest pixels; 0 if unknown.

    Wrapped pixels appear too dark, so they have no effect unless most pixels are wrapped.

    Parameters
    ----------
    amplitude, radial_range, valid
        (H, W) raw amplitude, radial range in m, and mask.
    """
    seen = valid & (amplitude > 0)
    if not seen.any():
        return 0.0
    at_1_m = amplitude[seen].astype(float) * radial_range[seen].astype(float) ** 2
    return float(np.quantile(at_1_m, 1 - _GLOSSY))


def on_surface(radial_range: Float32, period_m: float) -> Bool:
    """Return the mask (H, W) of pixels that measure a surface together with their neighbours.

    Differences are taken modulo the period. Pixels with a weak signal have random ranges, and are
    on no surface.

    Parameters
    ----------
    radial_range
        (H, W) in m, 0 where invalid.
    period_m
        Ambiguity range.
    """
    seen = radial_range > 0
    ranges, known = np.pad(radial_range, 1), np.pad(seen, 1)
    height, width = seen.shape
    alike = np.zeros(seen.shape, np.int32)
    beside = np.zeros(seen.shape, np.int32)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            if not (down or right):
                continue
            at = np.s_[1 + down : 1 + down + height, 1 + right : 1 + right + width]
            away = ranges[at] - radial_range
            away -= period_m * np.rint(away / period_m)
            beside += known[at]
            alike += known[at] & (np.abs(away) < _SAME_SURFACE * period_m)
    return np.asarray(
        seen & (beside >= _MIN_NEIGHBOURS) & (alike > _MIN_AGREEING * beside), np.bool_
    )


def count_periods(
    radial_range: Float32,
    amplitude: Float32,
    period_m: float,
    white: float,
    pitch: float,
    options: UnwrapOptions = _DEFAULT,
) -> Int32:
    """Return the wrap count (H, W): the number of periods to add to each pixel's range.

    Parameters
    ----------
    radial_range
        (H, W) in m, in [0, period), 0 where invalid.
    amplitude
        (H, W) raw amplitude, not compensated for range; 0 where unknown.
    period_m
        Ambiguity range.
    white
        Raw amplitude of a white surface at 1 m, see `white_amplitude`; 0 if unknown.
    pitch
        Angle between neighbouring pixels, rad.
    options
        See there.
    """
    out = np.zeros(radial_range.shape, np.int32)
    if white <= 0 or not (radial_range > 0).any():
        return out
    side = max(1, round(radial_range.shape[1] / options.columns))
    surfaces = np.where(on_surface(radial_range, period_m), radial_range, np.float32(0))
    blocks = _Blocks.of(surfaces, amplitude, period_m, side)
    unary = _albedo_cost(blocks, period_m, white, pitch * side, options)
    messages = np.zeros((4, *unary.shape), np.float32)

    def renew(start: int, stop: int, parity: int) -> None:
        pass_messages(
            blocks.range_m, blocks.valid, unary, period_m, options.scale * period_m,
            options.max_difference_cost, 1.0, start, stop, parity, messages,
        )  # fmt: skip

    for step in range(2 * options.iterations):
        run_chunks(partial(renew, parity=step % 2), len(unary))
    best = np.argmin(unary + messages.sum(0), axis=2)
    best = _with_surfaces_moved(blocks, unary, best, period_m, options)
    best = _without_unentered(blocks, best, period_m, options)
    return _upsample(surfaces, blocks, best, period_m, side, options.periods)


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Range (h, w) in [0, period), mean amplitude and validity of square blocks of pixels."""

    range_m: Float32
    amplitude: Float32
    valid: Bool

    @classmethod
    def of(cls, radial_range: Float32, amplitude: Float32, period: float, side: int) -> Self:
        height, width = radial_range.shape
        rows, columns = -(-height // side), -(-width // side)
        spare = ((0, rows * side - height), (0, columns * side - width))

        def summed(image: NDArray[np.floating]) -> Float64:
            whole = np.pad(image.astype(float), spare)
            return whole.reshape(rows, side, columns, side).sum((1, 3))

        seen = radial_range > 0
        # Weighted by the root of the amplitude, so that bright surfaces don't dominate dark ones.
        strength = np.where(seen, np.sqrt(np.maximum(amplitude, 0)) + 1e-3, 0)
        phase = 2 * np.pi * radial_range.astype(float) / period
        range_m = _range_of(
            summed(strength * np.cos(phase)), summed(strength * np.sin(phase)), period
        )
        count = summed(seen.astype(float))
        mean = summed(np.where(seen, amplitude, 0)) / np.maximum(count, 1)
        return cls(range_m, mean.astype(np.float32), count >= 0.5 * side * side)


def _range_of(real: Float64, imaginary: Float64, period: float) -> Float32:
    angle = np.mod(np.arctan2(imaginary, real), 2 * np.pi)
    return (angle * period / (2 * np.pi)).astype(np.float32)


def _albedo_cost(
    blocks: _Blocks, period: float, white: float, pitch: float, options: UnwrapOptions
) -> Float32:
    """Return the cost (h, w, K) of each wrap count by the albedo that it implies."""
    phase = 2 * np.pi * blocks.range_m.astype(float) / period
    real = uniform_filter(np.where(blocks.valid, np.cos(phase), 0), _WIDE)
    imaginary = uniform_filter(np.where(blocks.valid, np.sin(phase), 0), _WIDE)
    slope = _slope(_range_of(real, imaginary, period), period) / pitch
    cost = np.empty((*blocks.range_m.shape, options.periods + 1), np.float32)
    for k in range(options.periods + 1):
        beyond = np.maximum(blocks.range_m + k * period, 1e-6)
        # The slope implied by neighbouring ranges depends on the size of a pixel at that range.
        cosine = np.maximum(1 / np.sqrt(1 + (slope / beyond) ** 2), _MIN_COSINE)
        albedo = np.maximum(blocks.amplitude * beyond**2 / (white * cosine), 1e-6)
        unlikely = 0.5 * (np.log(albedo / options.albedo) / options.spread) ** 2
        cost[..., k] = np.minimum(unlikely, options.max_albedo_cost) + options.wrap_cost * k
    return np.float32(options.albedo_weight) * cost


def _slope(range_m: Float32, period: float) -> Float32:
    """Return the gradient magnitude (h, w) of the range per block, modulo the period."""
    squares = np.zeros(range_m.shape, np.float32)
    for axis in (0, 1):
        wide = [(_REACH, _REACH) if a == axis else (0, 0) for a in (0, 1)]
        padded = np.pad(range_m, wide, "edge")
        count = padded.shape[axis]
        ahead = np.take(padded, np.arange(2 * _REACH, count), axis)
        difference = ahead - np.take(padded, np.arange(count - 2 * _REACH), axis)
        difference -= period * np.rint(difference / period)
        squares += (difference / (2 * _REACH)) ** 2
    return np.sqrt(squares)


def _with_surfaces_moved(
    blocks: _Blocks, unary: Float32, best: Intp, period: float, options: UnwrapOptions
) -> Intp:
    """Shift whole surfaces by periods while that decreases the cost.

    Loopy belief propagation may converge with a part of a surface a period off. Surfaces are the
    components connected without jumps. Those with the largest gain are shifted first, and none that
    is adjacent to one shifted in the same iteration.
    """
    height, width = best.shape
    index = np.arange(height * width).reshape(height, width)
    beside = ((index[:, :-1], index[:, 1:]), (index[:-1], index[1:]))
    a, b = (np.concatenate([pair[side].ravel() for pair in beside]) for side in (0, 1))
    known = blocks.valid.ravel()
    a, b = a[known[a] & known[b]], b[known[a] & known[b]]
    range_m, costs = blocks.range_m.ravel().astype(float), unary.reshape(-1, unary.shape[2])
    periods = best.ravel().copy()
    most = unary.shape[2] - 1
    shifts = [s for s in range(-most, most + 1) if s]

    def jump(difference: Float64) -> Float64:
        away = np.abs(difference) / (options.scale * period)
        return np.minimum(away, options.max_difference_cost)

    for _ in range(_MAX_MOVES):
        at = range_m + periods * period
        difference = at[b] - at[a]
        now = jump(difference)
        joined = now < options.max_difference_cost
        graph = coo_array((np.ones(joined.sum()), (a[joined], b[joined])), (index.size, index.size))
        count, piece = connected_components(graph, directed=False)
        cut = piece[a] != piece[b]
        pa, pb, gap, paid = piece[a][cut], piece[b][cut], difference[cut], now[cut]
        gain, move = np.zeros(count), np.zeros(count, np.intp)
        for shift in shifts:
            to = periods + shift
            inside = (to >= 0) & (to <= most)
            change = costs[np.arange(index.size), np.clip(to, 0, most)]
            change = change - costs[np.arange(index.size), periods]
            total = np.bincount(piece, np.where(known, change, 0), count)
            total += np.bincount(pa, jump(gap - shift * period) - paid, count)
            total += np.bincount(pb, jump(gap + shift * period) - paid, count)
            total[piece[known & ~inside]] = np.inf
            better = -total > gain + 1e-6
            gain[better], move[better] = -total[better], shift
        if not move.any():
            break
        # Only those with a larger gain than their neighbours; ties go to the first.
        order = np.lexsort((np.arange(count), -gain))
        rank = np.empty(count, np.intp)
        rank[order] = np.arange(count)
        first = rank.copy()
        np.minimum.at(first, pa, rank[pb])
        np.minimum.at(first, pb, rank[pa])
        move[first < rank] = 0
        periods = np.where(known, periods + move[piece], periods)
    return periods.reshape(best.shape)


def _without_unentered(blocks: _Blocks, best: Intp, period: float, options: UnwrapOptions) -> Intp:
    """Reset wrapped components that no surface continues into across the period."""
    moved = (best > 0) & blocks.valid
    pieces, count = label(moved)
    rim = np.zeros(count + 1)
    entries = np.zeros(count + 1)
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        for inside, outside in ((a, b), (b, a)):
            edge = moved[inside] & ~moved[outside] & blocks.valid[outside]
            far = blocks.range_m[inside] + best[inside] * period
            near = blocks.range_m[outside] + best[outside] * period
            goes_on = edge & (np.abs(far - near) < options.scale * period)
            rim += np.bincount(pieces[inside][edge], minlength=count + 1)
            entries += np.bincount(pieces[inside][goes_on], minlength=count + 1)
    kept = entries > np.maximum(options.min_entry * rim, 2)
    return np.where(kept[pieces], best, 0)


def _upsample(
    radial_range: Float32,
    blocks: _Blocks,
    best: Intp,
    period: float,
    side: int,
    most: int,
) -> Int32:
    """Return the wrap count (H, W) of pixels: that of the nearest block in range around them."""
    height, width = radial_range.shape
    rows, columns = best.shape
    out = np.zeros((height, width), np.int64)
    nearest = np.full((height, width), np.inf)
    at_row, at_column = np.arange(height) // side, np.arange(width) // side
    for down in (0, -1, 1):
        for right in (0, -1, 1):
            here = np.ix_(
                np.clip(at_row + down, 0, rows - 1), np.clip(at_column + right, 0, columns - 1)
            )
            difference = blocks.range_m[here] - radial_range
            across = np.rint(difference / period)
            # A pixel's own block is preferred unless another one is clearly nearer.
            off = np.abs(difference - across * period) + (0.02 * period if down or right else 0)
            better = blocks.valid[here] & (off < nearest)
            out[better] = (best[here] + across.astype(np.int64))[better]
            nearest[better] = off[better]
    return np.where(radial_range > 0, np.clip(out, 0, most), 0).astype(np.int32)
