"""Phase unwrapping for cameras with a single modulation frequency.

With the ambiguity range P, a surface at r + P is measured at r. Two cues identify it. Its amplitude
is that of a far surface: raw amplitude falls with the squared range, so that the albedo implied at
r is too small by (r / (r + P))^2, a factor of 36 at r = 1 m and P = 5 m. And it is continuous: a
floor that leaves one period enters the next.

Pixels with a weak signal have random ranges, and would get random wrap counts. Therefore only
pixels that measure a surface together with their neighbours (`on_surface`) are unwrapped and used.

Both cues are costs of a Markov random field over the image, which is minimised by belief
propagation (Droeschel et al. 2010; McClure et al. 2010 for the amplitude).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Self

import numpy as np
import scipy  # loads its parts when they are used
from numpy.typing import NDArray

from tofuse.engine.arrays import Bool, Float32, Float64, Int32, Intp
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.compute import run_chunks
from tofuse.engine.connections import NEIGHBOURS, parts_of
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.parts import part
from tofuse.engine.sensor.base import FrameCorrection
from tofuse.engine.sensor.raw_amplitude import pixel_pitch, range_and_amplitude
from tofuse.engine.sensor.unwrap_kernels import pass_messages

_ROUNDS = 4

# Fraction of pixels that may be brighter than white, due to gloss and noise.
_GLOSSY_FRACTION = 0.01
# Slopes are differences between blocks at this distance on either side, of the phase averaged over
# windows of this size; and the lower limit of the cosine of incidence.
_REACH, _WINDOW, _MIN_COSINE = 2, 5, 0.25
_MAX_ITERATIONS = 100
# Neighbours on one surface differ by less than this fraction of the period; and the minimum
# fraction of such neighbours, which a random pixel exceeds with a probability of 1 % (binomial, 0.2
# each).
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
    valid_amplitude = valid & (amplitude > 0)
    if not valid_amplitude.any():
        return 0.0
    at_1_m = (
        amplitude[valid_amplitude].astype(float) * radial_range[valid_amplitude].astype(float) ** 2
    )
    return float(np.quantile(at_1_m, 1 - _GLOSSY_FRACTION))


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
    valid = radial_range > 0
    ranges, padded_valid = np.pad(radial_range, 1), np.pad(valid, 1)
    height, width = valid.shape
    similar = np.zeros(valid.shape, np.int32)
    neighbours = np.zeros(valid.shape, np.int32)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            if not (down or right):
                continue
            window = np.s_[1 + down : 1 + down + height, 1 + right : 1 + right + width]
            difference = ranges[window] - radial_range
            difference -= period_m * np.rint(difference / period_m)
            neighbours += padded_valid[window]
            similar += padded_valid[window] & (np.abs(difference) < _SAME_SURFACE * period_m)
    return np.asarray(
        valid & (neighbours >= _MIN_NEIGHBOURS) & (similar > _MIN_AGREEING * neighbours), np.bool_
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
        See `UnwrapOptions`.
    """
    out = np.zeros(radial_range.shape, np.int32)
    if white <= 0 or not (radial_range > 0).any():
        return out
    side = max(1, round(radial_range.shape[1] / options.columns))
    surfaces = np.where(on_surface(radial_range, period_m), radial_range, np.float32(0))
    blocks = _Blocks.of(surfaces, amplitude, period_m, side)
    unary = _albedo_cost(blocks, period_m, white, pitch * side, options)
    messages = np.zeros((4, *unary.shape), np.float32)

    def update(start: int, stop: int, parity: int) -> None:
        pass_messages(
            blocks.range_m, blocks.valid, unary, period_m, options.scale * period_m,
            options.max_difference_cost, start, stop, parity, messages,
        )  # fmt: skip

    for step in range(2 * options.iterations):
        run_chunks(partial(update, parity=step % 2), len(unary))
    best = np.argmin(unary + messages.sum(0), axis=2)
    best = _shift_surfaces(blocks, unary, best, period_m, options)
    best = _reset_isolated(blocks, best, period_m, options)
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
        padding = ((0, rows * side - height), (0, columns * side - width))

        def summed(image: NDArray[np.floating]) -> Float64:
            padded = np.pad(image.astype(float), padding)
            return padded.reshape(rows, side, columns, side).sum((1, 3))

        valid = radial_range > 0
        # Weighted by the root of the amplitude, so that bright surfaces don't dominate dark ones.
        weight = np.where(valid, np.sqrt(np.maximum(amplitude, 0)) + 1e-3, 0)
        phase = 2 * np.pi * radial_range.astype(float) / period
        range_m = _range_of(summed(weight * np.cos(phase)), summed(weight * np.sin(phase)), period)
        count = summed(valid.astype(float))
        mean = summed(np.where(valid, amplitude, 0)) / np.maximum(count, 1)
        return cls(range_m, mean.astype(np.float32), count >= 0.5 * side * side)


def _range_of(real: Float64, imaginary: Float64, period: float) -> Float32:
    angle = np.mod(np.arctan2(imaginary, real), 2 * np.pi)
    return (angle * period / (2 * np.pi)).astype(np.float32)


def _albedo_cost(
    blocks: _Blocks, period: float, white: float, pitch: float, options: UnwrapOptions
) -> Float32:
    """Return the cost (h, w, K) of each wrap count by the albedo that it implies."""
    phase = 2 * np.pi * blocks.range_m.astype(float) / period
    real = scipy.ndimage.uniform_filter(np.where(blocks.valid, np.cos(phase), 0), _WINDOW)
    imaginary = scipy.ndimage.uniform_filter(np.where(blocks.valid, np.sin(phase), 0), _WINDOW)
    slope = _slope(_range_of(real, imaginary, period), period) / pitch
    cost = np.empty((*blocks.range_m.shape, options.periods + 1), np.float32)
    for k in range(options.periods + 1):
        unwrapped = np.maximum(blocks.range_m + k * period, 1e-6)
        # The slope implied by neighbouring ranges depends on the size of a pixel at that range.
        cosine = np.maximum(1 / np.sqrt(1 + (slope / unwrapped) ** 2), _MIN_COSINE)
        albedo = np.maximum(blocks.amplitude * unwrapped**2 / (white * cosine), 1e-6)
        prior_cost = 0.5 * (np.log(albedo / options.albedo) / options.spread) ** 2
        cost[..., k] = np.minimum(prior_cost, options.max_albedo_cost) + options.wrap_cost * k
    return np.float32(options.albedo_weight) * cost


def _slope(range_m: Float32, period: float) -> Float32:
    """Return the gradient magnitude (h, w) of the range per block, modulo the period."""
    squares = np.zeros(range_m.shape, np.float32)
    for axis in (0, 1):
        padding = [(_REACH, _REACH) if a == axis else (0, 0) for a in (0, 1)]
        padded = np.pad(range_m, padding, "edge")
        count = padded.shape[axis]
        ahead = np.take(padded, np.arange(2 * _REACH, count), axis)
        difference = ahead - np.take(padded, np.arange(count - 2 * _REACH), axis)
        difference -= period * np.rint(difference / period)
        squares += (difference / (2 * _REACH)) ** 2
    return np.sqrt(squares)


def _shift_surfaces(
    blocks: _Blocks, unary: Float32, best: Intp, period: float, options: UnwrapOptions
) -> Intp:
    """Shift entire surfaces by periods while that decreases the cost.

    Loopy belief propagation may converge with part of a surface wrong by a period. Surfaces are the
    components connected without jumps. Those with the largest gain are shifted first, and adjacent
    ones never in the same iteration.
    """
    height, width = best.shape
    index = np.arange(height * width).reshape(height, width)
    adjacent = ((index[:, :-1], index[:, 1:]), (index[:-1], index[1:]))
    a, b = (np.concatenate([pair[side].ravel() for pair in adjacent]) for side in (0, 1))
    valid = blocks.valid.ravel()
    a, b = a[valid[a] & valid[b]], b[valid[a] & valid[b]]
    range_m, costs = blocks.range_m.ravel().astype(float), unary.reshape(-1, unary.shape[2])
    periods = best.ravel().copy()
    max_periods = unary.shape[2] - 1
    shifts = [s for s in range(-max_periods, max_periods + 1) if s]

    def difference_cost(difference: Float64) -> Float64:
        scaled = np.abs(difference) / (options.scale * period)
        return np.minimum(scaled, options.max_difference_cost)

    for _ in range(_MAX_ITERATIONS):
        unwrapped = range_m + periods * period
        difference = unwrapped[b] - unwrapped[a]
        edge_cost = difference_cost(difference)
        connected = edge_cost < options.max_difference_cost
        surface = parts_of(index.size, np.stack([a[connected], b[connected]], 1))
        count = int(surface.max()) + 1
        crossing = surface[a] != surface[b]
        surface_a, surface_b = surface[a][crossing], surface[b][crossing]
        at_boundary, boundary_cost = difference[crossing], edge_cost[crossing]
        gain, moves = np.zeros(count), np.zeros(count, np.intp)
        for shift in shifts:
            shifted = periods + shift
            allowed = (shifted >= 0) & (shifted <= max_periods)
            change = costs[np.arange(index.size), np.clip(shifted, 0, max_periods)]
            change = change - costs[np.arange(index.size), periods]
            total = np.bincount(surface, np.where(valid, change, 0), count)
            for of_side, moved in ((surface_a, -shift * period), (surface_b, shift * period)):
                cost = difference_cost(at_boundary + moved) - boundary_cost
                total += np.bincount(of_side, cost, count)
            total[surface[valid & ~allowed]] = np.inf
            better = -total > gain + 1e-6
            gain[better], moves[better] = -total[better], shift
        if not moves.any():
            break
        # Only those with a larger gain than their neighbours; ties go to the first.
        order = np.lexsort((np.arange(count), -gain))
        rank = np.empty(count, np.intp)
        rank[order] = np.arange(count)
        first = rank.copy()
        np.minimum.at(first, surface_a, rank[surface_b])
        np.minimum.at(first, surface_b, rank[surface_a])
        moves[first < rank] = 0
        periods = np.where(valid, periods + moves[surface], periods)
    return periods.reshape(best.shape)


def _reset_isolated(blocks: _Blocks, best: Intp, period: float, options: UnwrapOptions) -> Intp:
    """Reset wrapped components that continue no unwrapped surface across the period."""
    wrapped = (best > 0) & blocks.valid
    components, count = scipy.ndimage.label(wrapped)
    boundary = np.zeros(count + 1)
    entries = np.zeros(count + 1)
    for a, b in NEIGHBOURS:
        for inside, outside in ((a, b), (b, a)):
            border = wrapped[inside] & ~wrapped[outside] & blocks.valid[outside]
            range_inside = blocks.range_m[inside] + best[inside] * period
            range_outside = blocks.range_m[outside] + best[outside] * period
            continues = border & (np.abs(range_inside - range_outside) < options.scale * period)
            boundary += np.bincount(components[inside][border], minlength=count + 1)
            entries += np.bincount(components[inside][continues], minlength=count + 1)
    kept = entries > np.maximum(options.min_entry * boundary, 2)
    return np.where(kept[components], best, 0)


def _upsample(
    radial_range: Float32, blocks: _Blocks, best: Intp, period: float, side: int, max_periods: int
) -> Int32:
    """Return the wrap count (H, W) of pixels: that of the adjacent block closest in range."""
    height, width = radial_range.shape
    rows, columns = best.shape
    out = np.zeros((height, width), np.int64)
    nearest = np.full((height, width), np.inf)
    at_row, at_column = np.arange(height) // side, np.arange(width) // side
    for down in (0, -1, 1):
        for right in (0, -1, 1):
            block = np.ix_(
                np.clip(at_row + down, 0, rows - 1), np.clip(at_column + right, 0, columns - 1)
            )
            difference = blocks.range_m[block] - radial_range
            periods = np.rint(difference / period)
            # A pixel's own block is preferred unless another one is clearly nearer.
            distance = np.abs(difference - periods * period) + (
                0.02 * period if down or right else 0
            )
            better = blocks.valid[block] & (distance < nearest)
            out[better] = (best[block] + periods.astype(np.int64))[better]
            nearest[better] = distance[better]
    return np.where(radial_range > 0, np.clip(out, 0, max_periods), 0).astype(np.int32)


@part("correction", "unwrap", label="validated")
@dataclass(frozen=True)
class Unwrap(Bounded, FrameCorrection):
    """Unwrap the phase by amplitude and continuity, see `tofuse.engine.sensor.unwrap`.

    Works on cameras with one modulation frequency that record amplitude; other views are passed
    through.

    Attributes
    ----------
    white
        Raw amplitude of a white wall at 1 m on the optical axis; None: estimated from the
        recording.
    period_m
        Ambiguity range; None: that of the frame.
    options
        Of the unwrapping.
    """

    white: Annotated[float | None, Bounds(0, exclusive=True)] = None
    period_m: Annotated[float | None, Bounds(0, exclusive=True)] = None
    options: UnwrapOptions = field(default_factory=UnwrapOptions)

    @property
    def needs_fit(self) -> bool:
        """See `Correction.needs_fit`."""
        return self.white is None

    def fit(self, frames: Sequence[Frame]) -> Self:
        """Return the part with the amplitude of white estimated from the brightest frames."""
        white = 0.0
        # Alternate with unwrapping, as most surfaces may be beyond the ambiguity range.
        for _ in range(_ROUNDS):
            estimates = [w for frame in frames if (w := self._white_of(frame, white)) > 0]
            if not estimates:
                return self
            previous, white = white, float(np.quantile(estimates, 0.9))
            if abs(white - previous) < 0.02 * white:
                break
        return replace(self, white=white)

    def _white_of(self, frame: Frame, white: float) -> float:
        signal = range_and_amplitude(frame, self.period_m)
        if signal is None:
            return 0.0
        radial, amplitude, period = signal
        periods = count_periods(radial, amplitude, period, white, pixel_pitch(frame), self.options)
        return white_amplitude(
            amplitude, (radial + periods * period).astype(np.float32), radial > 0
        )

    def apply(self, frame: Frame, T_world_camera: Float64 | None = None) -> Frame:
        """See `Corrector.apply`. Range-compensated amplitude is scaled to the new range."""
        signal = range_and_amplitude(frame, self.period_m)
        if signal is None or not isinstance(frame, RangeFrame):
            return frame
        radial, measured, period = signal
        white, pitch = self.white or 0.0, pixel_pitch(frame)
        periods = count_periods(radial, measured, period, white, pitch, self.options)
        if not periods.any():
            return frame
        factor = np.where(periods > 0, 1 + periods * period / np.where(radial > 0, radial, 1), 1)
        amplitude = frame.amplitude_image
        if amplitude is not None and frame.amplitude_kind == "range_compensated":
            amplitude = np.where(periods > 0, amplitude * factor**2, amplitude).astype(np.float32)
        return replace(
            frame,
            depth=(frame.depth * factor).astype(np.float32),
            amplitude_image=amplitude,
            ambiguity_m=frame.ambiguity_m,
        )
