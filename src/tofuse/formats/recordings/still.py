"""Detection of stationary intervals, and one averaged frame for each.

Noise is nearly independent between pixels; motion changes neighbouring pixels together. They are
distinguished by averaging frame differences over blocks of two sizes: the variance of block means
is inversely proportional to the block's area for noise, and does not depend on it for motion. No
threshold in metres is needed, so the test applies to cameras of any noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Bool, Float32, Float64, Intp, UInt8
from tofuse.engine.cameras import Camera, RayTable
from tofuse.engine.frames import SATURATED_AMPLITUDE, Frame, RangeFrame, Recording
from tofuse.engine.noise import NoiseModel, noise_model_for
from tofuse.engine.normal import robust_sigma

# Below these fractions of a pixel's noise, and of the blocks, nothing has moved.
_COHERENT = 0.15
_MOVED_BLOCK, _MOVED_FRACTION = 0.6, 0.03
_MIN_PIXELS = 100
_RATIO = 3  # of the side of a large block to that of a small one
_OUTLIER_SIGMAS = 3.0
_MAX_FRAMES = 48


@dataclass(frozen=True)
class ImageChange:
    """The change between two images, relative to the noise of a pixel's difference.

    Attributes
    ----------
    coherent
        Standard deviation of the change that whole blocks have in common: camera motion.
    moved_fraction
        Fraction of the blocks that changed significantly: object motion.
    identical
        Whether the images are equal: a repeated frame.
    """

    coherent: float
    moved_fraction: float
    identical: bool = False

    @property
    def still(self) -> bool:
        """Whether neither camera nor objects moved by more than the noise."""
        return self.coherent < _COHERENT and self.moved_fraction < _MOVED_FRACTION


def change_between(a: RangeFrame, b: RangeFrame, model: NoiseModel) -> ImageChange:
    """Measure the change from one frame of a camera to another.

    Parameters
    ----------
    a, b
        Frames of the same size.
    model
        Used only for the relative noise of the pixels.
    """
    if a.depth.shape != b.depth.shape:
        return ImageChange(1.0, 1.0)
    valid = a.valid & b.valid
    if valid.sum() < _MIN_PIXELS:
        return ImageChange(1.0, 1.0)
    sigma = np.where(valid, model.sigma(a), 1)
    change = np.where(valid, b.radial_range - a.radial_range, 0)
    changes = [_coherence(change / sigma, valid)]
    if a.amplitude_image is not None and b.amplitude_image is not None:
        usable = valid & _usable(a.amplitude_image) & _usable(b.amplitude_image)
        if usable.sum() >= _MIN_PIXELS:
            ratio = np.where(usable, b.amplitude_image, 1) / np.where(usable, a.amplitude_image, 1)
            change = np.log(ratio)
            # Exposure scales all pixels by the same factor.
            change -= np.median(change[usable])
            # The noise of the phasor is isotropic: equal for range and log amplitude.
            changes.append(_coherence(change / sigma, usable))
    return ImageChange(
        max(m.coherent for m in changes),
        max(m.moved_fraction for m in changes),
        all(m.identical for m in changes),
    )


def _usable(amplitude: Float32) -> Bool:
    return np.asarray((amplitude > 0) & (amplitude < SATURATED_AMPLITUDE))


def _coherence(change: NDArray[Any], valid: Bool) -> ImageChange:
    """The coherent part of a difference image (H, W) in units of its noise."""
    values = np.abs(change[valid])
    if not values.any():
        return ImageChange(0.0, 0.0, identical=True)
    scale = robust_sigma(values)
    limit = 2.5 * scale if scale > 0 else float(values.max())
    clipped = np.where(valid, np.clip(change, -limit, limit), 0).astype(float)
    noise = float(np.sqrt((clipped[valid] ** 2).mean()))
    small = max(2, min(8, min(valid.shape) // (6 * _RATIO)))
    fine = _block_means(clipped, valid, small)
    coarse = _block_means(clipped, valid, small * _RATIO)
    if len(coarse) < 4:
        return ImageChange(1.0, 1.0)
    fine_variance, coarse_variance = (float((x**2).mean()) for x in (fine, coarse))
    area = _RATIO * _RATIO
    coherent_variance = max(area * coarse_variance - fine_variance, 0.0) / (area - 1)
    # Blocks at flickering edges are noisier, and so are their means.
    block_variance = np.maximum(_block_means(clipped**2, valid, small * _RATIO), noise**2)
    moved = float((coarse**2 > _MOVED_BLOCK**2 * block_variance).mean())
    return ImageChange(float(np.sqrt(coherent_variance)) / noise, moved)


def _block_means(values: Float64, valid: Bool, size: int) -> Float64:
    """Means of the square blocks that are at least half valid."""
    rows, columns = values.shape[0] // size, values.shape[1] // size

    def sums(x: NDArray[Any]) -> Float64:
        cut = x[: rows * size, : columns * size]
        return cut.reshape(rows, size, columns, size).sum((1, 3), dtype=float)

    count = sums(valid)
    full = count >= size * size / 2
    return sums(values)[full] / count[full]


def stationary_intervals(
    recording: Recording, model: NoiseModel | None = None
) -> list[tuple[int, int]]:
    """Split a recording into intervals in which nothing moves.

    An interval lasts while no frame differs from its first one, so that slow motion can't
    accumulate. Unreadable frames, clouds, and frames in motion are intervals of one frame.

    Parameters
    ----------
    recording
        Read once.
    model
        Its noise; by `noise_model_for` unless given.

    Returns
    -------
    (start, stop) positions in the recording, contiguous.
    """
    model = model or noise_model_for(recording)
    intervals: list[tuple[int, int]] = []
    start, first = 0, None
    for k, item in enumerate(recording.read_all()):
        frame = item if isinstance(item, RangeFrame) else None
        if k > 0 and not (
            first is not None and frame is not None and change_between(first, frame, model).still
        ):
            intervals.append((start, k))
            start, first = k, None
        first = first or frame
    intervals.append((start, len(recording)))
    return intervals


def average_still(recording: Recording, model: NoiseModel | None = None) -> Recording:
    """Replace each stationary interval by one averaged frame.

    It has the timestamp and reference pose of the middle of the interval, and a sigma that is
    divided by the square root of the number of measurements. Frames in motion are unchanged.

    Parameters
    ----------
    recording
        Read once now, and each interval again when its frame is read.
    model
        Its noise; by `noise_model_for` unless given.
    """
    model = model or noise_model_for(recording)
    source = _AveragedSource(recording, stationary_intervals(recording, model), model)
    return Recording.of(source, recording.path, recording.format)


class _AveragedSource:
    """A source with one frame for each interval of another."""

    def __init__(
        self, recording: Recording, intervals: Sequence[tuple[int, int]], model: NoiseModel
    ) -> None:
        self._recording, self._intervals, self._model = recording, list(intervals), model
        positions = np.array([(a + b - 1) // 2 for a, b in intervals], np.intp)
        middle = replace(recording, indices=recording.indices[positions])
        self.timestamps, self.gravity = middle.timestamps, middle.gravity
        self.reference, self.odometry = middle.reference, middle.odometry
        self.metadata: dict[str, Any] = {
            **recording.metadata,
            "averaged": [b - a for a, b in intervals],
        }
        self.warnings = list(recording.warnings)
        if len(intervals) < len(recording):
            self.warnings.append(
                f"{len(recording)} frames averaged to {len(intervals)} in stationary intervals"
            )

    def read(self, index: int) -> Frame:
        """See `Source.read`."""
        start, stop = self._intervals[index]
        time = float(self.timestamps[index])
        if stop - start == 1:
            return replace(self._recording[start], index=index, timestamp=time)
        frames = list(self._frames(start, stop))
        return replace(average_of(frames, self._model), index=index, timestamp=time)

    def _frames(self, start: int, stop: int) -> Iterator[RangeFrame]:
        """Read up to `_MAX_FRAMES` evenly spaced frames of an interval."""
        for k in np.unique(np.linspace(start, stop - 1, _MAX_FRAMES).round().astype(int)):
            frame = self._recording[int(k)]
            if isinstance(frame, RangeFrame):
                yield frame


def average_of(frames: Sequence[RangeFrame], model: NoiseModel) -> RangeFrame:
    """Average frames of a static view.

    Depth is the mean of the measurements within three sigmas of the pixel's median, where at least
    half of the frames have one; amplitude and colour are means, confidence is the maximum. Repeated
    frames are ignored.

    Parameters
    ----------
    frames
        At least one, of the same size, in order.
    model
        Noise model, for the sigma of each frame and so of the mean.
    """
    frames = [
        f
        for k, f in enumerate(frames)
        if k == 0 or not np.array_equal(f.depth, frames[k - 1].depth)
    ]
    middle = frames[(len(frames) - 1) // 2]
    if len(frames) == 1:
        return middle
    depth = np.stack([np.where(f.valid, f.depth, 0) for f in frames])
    sigma = np.stack([model.sigma(f) for f in frames])
    valid = depth > 0
    count = valid.sum(0)
    centre = _median(depth, valid, count)
    residual = np.abs(depth - centre)
    # Scale of the actual noise relative to the model, so that inliers are not rejected.
    scale = robust_sigma(residual[valid] / sigma[valid]) if valid.any() else 1.0
    inlier = valid & (residual <= _OUTLIER_SIGMAS * max(scale, 1.0) * sigma)
    inlier_count = inlier.sum(0)
    enough = (2 * count >= len(frames)) & (inlier_count > 0)
    divisor = np.maximum(inlier_count, 1)
    mean = (depth * inlier).sum(0, dtype=float) / divisor
    variance = (sigma.astype(float) ** 2 * inlier).sum(0) / divisor
    sigma_of_mean = np.sqrt(variance / divisor)
    return replace(
        middle,
        camera=_mean_camera(frames),
        depth=np.where(enough, mean, 0).astype(np.float32),
        sigma_image=np.where(enough, sigma_of_mean, 0).astype(np.float32),
        amplitude_image=_mean_amplitude(frames, inlier),
        confidence_image=_best_confidence(frames, inlier),
        color_image=_mean_color(frames),
        normal_image=None,
    )


def _median(depth: Float32, valid: Bool, count: Intp) -> Float32:
    """The median (H, W) of the valid values of each pixel of (N, H, W); 0 without any."""
    ordered = np.sort(np.where(valid, depth, np.inf), axis=0)
    low = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
    high = np.take_along_axis(ordered, np.minimum(count // 2, len(depth) - 1)[None], axis=0)[0]
    return np.where(count > 0, (low + high) / 2, 0).astype(np.float32)


def _mean_camera(frames: Sequence[RangeFrame]) -> Camera:
    """The common camera of all frames, or the mean of their ray tables."""
    if all(f.camera is frames[0].camera for f in frames):
        return frames[0].camera
    rays = np.stack([f.camera.rays() for f in frames]).astype(float)
    valid = np.isfinite(rays).all(-1, keepdims=True)
    count = valid.sum(0)
    mean = np.where(valid, rays, 0).sum(0) / np.maximum(count, 1)
    return RayTable(np.where(count > 0, mean, np.nan).astype(np.float32))


def _mean_amplitude(frames: Sequence[RangeFrame], inlier: Bool) -> Float32 | None:
    """The mean over the frames whose depth was used; saturated where most of them are."""
    stack = _stack(frames, "amplitude_image")
    if stack is None:
        return None
    saturated = (stack >= SATURATED_AMPLITUDE) & inlier
    used = inlier & ~saturated
    count = used.sum(0)
    mean = np.where(used, stack, 0).sum(0, dtype=float) / np.maximum(count, 1)
    mean = np.where(inlier.any(0), mean, stack.mean(0, dtype=float))
    return np.where(saturated.sum(0) > count, SATURATED_AMPLITUDE, mean).astype(np.float32)


def _best_confidence(frames: Sequence[RangeFrame], inlier: Bool) -> UInt8 | None:
    stack = _stack(frames, "confidence_image")
    return None if stack is None else np.where(inlier, stack, 0).max(0).astype(np.uint8)


def _mean_color(frames: Sequence[RangeFrame]) -> UInt8 | None:
    stack = _stack(frames, "color_image")
    return None if stack is None else np.rint(stack.mean(0, dtype=float)).astype(np.uint8)


def _stack(frames: Sequence[RangeFrame], name: str) -> NDArray[Any] | None:
    """The images of a channel (N, H, W, ...); None if a frame has none."""
    images = [getattr(frame, name) for frame in frames]
    return None if any(image is None for image in images) else np.stack(images)
