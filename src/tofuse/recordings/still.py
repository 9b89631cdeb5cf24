"""Where the camera stood still, and one better frame of each such stretch.

Noise is independent from pixel to pixel, or nearly so; motion moves neighbouring pixels alike.
Both are told apart by averaging frame differences over blocks of two sizes: the variance of block
means falls with the block's area for noise, and not at all for motion. No threshold in metres is
needed, so the test holds for a camera of any noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import Bool, Float32, Float64, Intp, UInt8
from tofuse.geometry.cameras import Camera, RayTable
from tofuse.recordings.frames import SATURATED_AMPLITUDE, Frame, RangeFrame
from tofuse.recordings.noise import noise_model_for
from tofuse.recordings.recording import Recording
from tofuse.sensor.noise import NoiseModel

# Motion below these shares of the noise of a pixel is no motion.
_COHERENT = 0.15
_MOVED_BLOCK, _MOVED_SHARE = 0.6, 0.03
_LEAST_PIXELS = 100
_RATIO = 3  # side of a large block in small ones
_OUTLIER = 3.0
_MOST_FRAMES = 48
_NORMAL_MEDIAN = 0.6745


@dataclass(frozen=True)
class Motion:
    """What changed between two images, as shares of the noise of the difference of a pixel.

    Attributes
    ----------
    coherent
        Standard deviation of what whole blocks have in common: motion of the camera.
    moved_share
        Share of the blocks that changed clearly: motion of things.
    identical
        Whether nothing at all changed: a copy.
    """

    coherent: float
    moved_share: float
    identical: bool = False

    @property
    def still(self) -> bool:
        """Whether neither camera nor things moved by more than the noise hides."""
        return self.coherent < _COHERENT and self.moved_share < _MOVED_SHARE


def motion_between(a: RangeFrame, b: RangeFrame, model: NoiseModel) -> Motion:
    """Measure what changed from one frame of a camera to another.

    Parameters
    ----------
    a, b
        Frames of one size.
    model
        Only says which pixels are noisier than others.
    """
    if a.depth.shape != b.depth.shape:
        return Motion(1.0, 1.0)
    both = a.valid & b.valid
    if both.sum() < _LEAST_PIXELS:
        return Motion(1.0, 1.0)
    sigma = np.where(both, model.sigma(a), 1)
    change = np.where(both, b.radial_range - a.radial_range, 0)
    found = [_coherence(change / sigma, both)]
    if a.amplitude_image is not None and b.amplitude_image is not None:
        lit = both & _lit(a.amplitude_image) & _lit(b.amplitude_image)
        if lit.sum() >= _LEAST_PIXELS:
            ratio = np.where(lit, b.amplitude_image, 1) / np.where(lit, a.amplitude_image, 1)
            change = np.log(ratio)
            # Exposure changes all pixels alike.
            change -= np.median(change[lit])
            # The phasor's noise is as large across as along: range and log of amplitude alike.
            found.append(_coherence(change / sigma, lit))
    return Motion(
        max(m.coherent for m in found),
        max(m.moved_share for m in found),
        all(m.identical for m in found),
    )


def _lit(amplitude: Float32) -> Bool:
    return np.asarray((amplitude > 0) & (amplitude < SATURATED_AMPLITUDE))


def _coherence(change: NDArray[Any], ok: Bool) -> Motion:
    """Measure what blocks of a difference image (H, W), in units of its noise, have in common."""
    values = np.abs(change[ok])
    if not values.any():
        return Motion(0.0, 0.0, identical=True)
    typical = float(np.median(values)) / _NORMAL_MEDIAN
    limit = 2.5 * typical if typical > 0 else float(values.max())
    clipped = np.where(ok, np.clip(change, -limit, limit), 0).astype(float)
    noise = float(np.sqrt((clipped[ok] ** 2).mean()))
    small = max(2, min(8, min(ok.shape) // (6 * _RATIO)))
    fine = _block_means(clipped, ok, small)
    coarse = _block_means(clipped, ok, small * _RATIO)
    if len(coarse) < 4:
        return Motion(1.0, 1.0)
    of_fine, of_coarse = (float((x**2).mean()) for x in (fine, coarse))
    area = _RATIO * _RATIO
    common = max(area * of_coarse - of_fine, 0.0) / (area - 1)
    # A block at an edge that flickers is noisier than others, and its mean with it.
    own = np.maximum(_block_means(clipped**2, ok, small * _RATIO), noise**2)
    moved = float((coarse**2 > _MOVED_BLOCK**2 * own).mean())
    return Motion(float(np.sqrt(common)) / noise, moved)


def _block_means(values: Float64, ok: Bool, size: int) -> Float64:
    """Return the means of the square blocks that are at least half valid."""
    rows, columns = values.shape[0] // size, values.shape[1] // size

    def sums(x: NDArray[Any]) -> Float64:
        cut = x[: rows * size, : columns * size]
        return cut.reshape(rows, size, columns, size).sum((1, 3), dtype=float)

    count = sums(ok)
    full = count >= size * size / 2
    return sums(values)[full] / count[full]


def still_stretches(recording: Recording, model: NoiseModel | None = None) -> list[tuple[int, int]]:
    """Cut a recording into stretches in which nothing moves.

    A stretch lasts as long as no frame differs from its first one, so that slow motion can't add
    up. Frames that can't be read, clouds, and frames in motion are stretches of their own.

    Parameters
    ----------
    recording
        Is read once.
    model
        Its noise; chosen by `noise_model_for` if not given.

    Returns
    -------
    (start, stop) positions in the recording, in order, without gaps.
    """
    model = model or noise_model_for(recording)
    out: list[tuple[int, int]] = []
    start, first = 0, None
    for k, item in enumerate(recording.read_all()):
        frame = item if isinstance(item, RangeFrame) else None
        if k > 0 and not (
            first is not None and frame is not None and motion_between(first, frame, model).still
        ):
            out.append((start, k))
            start, first = k, None
        first = first or frame
    out.append((start, len(recording)))
    return out


def average_still(recording: Recording, model: NoiseModel | None = None) -> Recording:
    """Replace each still stretch by one frame with less noise.

    A frame of the result has the timestamp and reference poses of the middle of its stretch, and
    a sigma that fell with the root of the number of measurements. Frames in motion stay as they
    are.

    Parameters
    ----------
    recording
        Is read once now, and each stretch again when its frame is read.
    model
        Its noise; chosen by `noise_model_for` if not given.
    """
    model = model or noise_model_for(recording)
    source = _AveragedSource(recording, still_stretches(recording, model), model)
    return Recording.of(source, recording.path, recording.format)


class _AveragedSource:
    """A source with one frame for each stretch of another."""

    def __init__(
        self, recording: Recording, stretches: Sequence[tuple[int, int]], model: NoiseModel
    ) -> None:
        self._recording, self._stretches, self._model = recording, list(stretches), model
        middle = np.array([(a + b - 1) // 2 for a, b in stretches], np.intp)
        self.timestamps: Float64 = recording.timestamps[middle]
        reference, odometry = recording.reference, recording.odometry
        gravity = recording.gravity
        self.reference = None if reference is None else reference[middle]
        self.odometry = None if odometry is None else odometry[middle]
        self.gravity = None if gravity is None else gravity[middle]
        self.metadata: dict[str, Any] = {
            **recording.metadata,
            "averaged": [b - a for a, b in stretches],
        }
        self.warnings = list(recording.warnings)
        if len(stretches) < len(recording):
            self.warnings.append(
                f"{len(recording)} frames averaged to {len(stretches)}, where nothing moved"
            )

    def read(self, index: int) -> Frame:
        """See `Source.read`."""
        start, stop = self._stretches[index]
        time = float(self.timestamps[index])
        if stop - start == 1:
            return replace(self._recording[start], index=index, timestamp=time)
        frames = list(self._frames(start, stop))
        return replace(average_of(frames, self._model), index=index, timestamp=time)

    def _frames(self, start: int, stop: int) -> Iterator[RangeFrame]:
        """Read a stretch, or as many frames of it, evenly spread, as are worth their memory."""
        for k in np.unique(np.linspace(start, stop - 1, _MOST_FRAMES).round().astype(int)):
            frame = self._recording[int(k)]
            if isinstance(frame, RangeFrame):
                yield frame


def average_of(frames: Sequence[RangeFrame], model: NoiseModel) -> RangeFrame:
    """Make one frame of several that show the same.

    Depth is the mean of the measurements within three sigmas of the pixel's median, where at least
    half of the frames have one; amplitude and colour are means, confidence is the highest. Copies
    of the frame before add nothing, and are left out.

    Parameters
    ----------
    frames
        At least one, of one size, in order.
    model
        Gives the sigma of each frame, and so of the mean.
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
    off = np.abs(depth - centre)
    # How much noisier than the model these frames are, that no good value is called an outlier.
    wrong = float(np.median(off[valid] / sigma[valid])) / _NORMAL_MEDIAN if valid.any() else 1.0
    near = valid & (off <= _OUTLIER * max(wrong, 1.0) * sigma)
    kept = near.sum(0)
    enough = (2 * count >= len(frames)) & (kept > 0)
    number = np.maximum(kept, 1)
    mean = (depth * near).sum(0, dtype=float) / number
    variance = (sigma.astype(float) ** 2 * near).sum(0) / number
    averaged = np.sqrt(variance / number)
    return replace(
        middle,
        camera=_mean_camera(frames),
        depth=np.where(enough, mean, 0).astype(np.float32),
        sigma_image=np.where(enough, averaged, 0).astype(np.float32),
        amplitude_image=_mean_amplitude(frames, near),
        confidence_image=_best_confidence(frames, near),
        color_image=_mean_color(frames),
        normal_image=None,
    )


def _median(depth: Float32, valid: Bool, count: Intp) -> Float32:
    """Return the median (H, W) over the valid values of each pixel of (N, H, W); 0 without any."""
    ordered = np.sort(np.where(valid, depth, np.inf), axis=0)
    low = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
    high = np.take_along_axis(ordered, np.minimum(count // 2, len(depth) - 1)[None], axis=0)[0]
    return np.where(count > 0, (low + high) / 2, 0).astype(np.float32)


def _mean_camera(frames: Sequence[RangeFrame]) -> Camera:
    """Return the camera of all frames, or the mean of their ray tables where each has its own."""
    if all(f.camera is frames[0].camera for f in frames):
        return frames[0].camera
    rays = np.stack([f.camera.rays() for f in frames]).astype(float)
    known = np.isfinite(rays).all(-1, keepdims=True)
    count = known.sum(0)
    mean = np.where(known, rays, 0).sum(0) / np.maximum(count, 1)
    return RayTable(np.where(count > 0, mean, np.nan).astype(np.float32))


def _mean_amplitude(frames: Sequence[RangeFrame], near: Bool) -> Float32 | None:
    """Return the mean over the frames whose depth was used; saturated where most of them are."""
    images = [f.amplitude_image for f in frames if f.amplitude_image is not None]
    if len(images) < len(frames):
        return None
    stack = np.stack(images)
    full = (stack >= SATURATED_AMPLITUDE) & near
    used = near & ~full
    count = used.sum(0)
    mean = np.where(used, stack, 0).sum(0, dtype=float) / np.maximum(count, 1)
    mean = np.where(near.any(0), mean, stack.mean(0, dtype=float))
    return np.where(full.sum(0) > count, SATURATED_AMPLITUDE, mean).astype(np.float32)


def _best_confidence(frames: Sequence[RangeFrame], near: Bool) -> UInt8 | None:
    images = [f.confidence_image for f in frames if f.confidence_image is not None]
    if len(images) < len(frames):
        return None
    return np.where(near, np.stack(images), 0).max(0).astype(np.uint8)


def _mean_color(frames: Sequence[RangeFrame]) -> UInt8 | None:
    images = [f.color_image for f in frames if f.color_image is not None]
    if len(images) < len(frames):
        return None
    total = np.zeros(images[0].shape)
    for image in images:
        total += image
    return np.rint(total / len(images)).astype(np.uint8)
