"""Checks that depth, amplitude and colour are aligned to each other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import cv2
import numpy as np
from scipy import ndimage

from tofuse.apps.inspection.finding import Finding, is_significant
from tofuse.apps.inspection.sample import Sample
from tofuse.engine.arrays import Bool, Float32, Float64
from tofuse.engine.frames import SATURATED_AMPLITUDE, RangeFrame
from tofuse.engine.geometry import se3

# Images are downscaled to this width. Smaller ones, and flatter ones than this ratio of height to
# width, as of spinning scanners, have too few pixels to be shifted by as much as is tested below.
_COLUMNS, _MIN_COLUMNS, _MIN_RATIO = 160, 16, 0.5
# Orientations of one channel relative to the other.
_ORIENTATIONS: dict[str, Callable[[Float32], Float32]] = {
    "as it is": lambda a: a,
    "mirrored left to right": lambda a: a[:, ::-1],
    "mirrored upside down": lambda a: a[::-1],
    "rotated by 180 degrees": lambda a: a[::-1, ::-1],
}
# Minimum correlation of the edges of two channels, and its lead over the identity, also in standard
# errors.
_MIN_CORRELATION, _MIN_LEAD, _MIN_LEAD_SIGMAS = 0.1, 0.06, 4.0
# Maximum correlation of the edges of depth with the same ones mirrored: in a symmetric scene edges
# that only one of the channels has decide which orientation fits better.
_MAX_SYMMETRY = 0.75
# Minimum relevant and maximum tested shift of colour, as fractions of the width.
_MIN_SHIFT, _MAX_SHIFT = 0.02, 0.12
_MIN_FRAMES = 3
# Minimum correlation of edges at the best shift, its lead over no shift, and the maximum fraction
# of it without a shift, or at shifts farther than this number of pixels from the best: edges in one
# direction correlate at many shifts.
_MIN_COLOR_CORRELATION, _MIN_COLOR_LEAD, _MAX_COLOR_UNSHIFTED = 0.42, 0.16, 0.68
_MAX_ELSEWHERE, _PEAK_RADIUS_PX = 0.95, 4
# A delay shows if the image moves by at least a pixel of the downscaled images from frame to frame,
# and its edges by this many pixels; and by at most a fraction of the width.
_MIN_MOTION_PX, _MIN_DELAY_PX, _MAX_DELAY_SHIFT = 1.0, 1.5, 0.2
# Minimum and maximum delay in frames, over which the motion is taken as constant; and fraction of
# the images in which it explains the shift, up to half of it, as edges in one direction hardly
# determine the other. Few random shifts lie as near.
_MIN_DELAY, _MAX_DELAY, _MIN_DELAYED, _MAX_UNEXPLAINED = 0.7, 8.5, 0.6, 0.5
# What a delay leaves unexplained of the shifts is at most this multiple of what a constant does. It
# is less than once if the motion varies, and as much if it is steady.
_MAX_REMAINDER = 2.0


def check_mirrored(sample: Sample) -> Iterator[Finding]:
    """Check that edges of depth and amplitude (else colour) do not match better if mirrored."""
    for name, channel_of in (("amplitude", _amplitude), ("colour", _grey)):
        # Without the outline of what has a depth, which is no edge of depth.
        depicted = [
            (f, image) for f in _shiftable(sample.images) if (image := channel_of(f)) is not None
        ]
        images = [
            (_oriented_edges(_log_depth(f)), _filled(image, f.valid)) for f, image in depicted
        ]
        if len(images) < _MIN_FRAMES:
            continue
        turned = {
            label: [(depth, _oriented_edges(turn(image))) for depth, image in images]
            for label, turn in _ORIENTATIONS.items()
        }
        scores = {label: _correlations(edges, 0)[:, 0, 0] for label, edges in turned.items()}
        identity = scores.pop("as it is")
        orientation, best = max(scores.items(), key=lambda item: float(item[1].mean()))
        if best.mean() <= _MIN_CORRELATION or not is_significant(
            best - identity, _MIN_LEAD, _MIN_LEAD_SIGMAS
        ):
            continue
        turn = _ORIENTATIONS[orientation]
        symmetry = [
            (depth, _oriented_edges(turn(_log_depth(f))))
            for (depth, _), (f, _) in zip(images, depicted, strict=True)
        ]
        if _correlations(symmetry, 0).mean() > _MAX_SYMMETRY:
            continue
        # Unrelated edges in the same part of the images correlate too, but then those of another
        # frame or a shift fit as well.
        max_shift = round(_MAX_SHIFT * images[0][0].shape[1])
        from_peak = _from_peak(_correlations(turned[orientation], max_shift).mean(0))
        is_unshifted = from_peak[max_shift, max_shift] <= _PEAK_RADIUS_PX
        if not (is_unshifted or _match_own_frame(turned[orientation])):
            continue
        yield Finding(
            "mirrored",
            f"Depth and {name} do not match: their edges correlate by {best.mean():.2f} with one "
            f"of them {orientation}, and by {identity.mean():.2f} as they are.",
            "Mirror or rotate one of them, and check that the rays (x right, y down) are those of "
            "the images.",
            {"correlation": float(identity.mean()), "correlation_if_turned": float(best.mean())},
        )
        return


def _match_own_frame(edges: Sequence[tuple[Float32, Float32]]) -> bool:
    """Whether edges of depth match another channel of their frame better than that of others."""
    edges = edges[::2]  # neighbours hardly differ
    if len(edges) < _MIN_FRAMES:
        return False
    depth, other = (
        np.stack([((e - e.mean((0, 1))) / max(e.std(), 1e-9)).ravel() for e in channel])
        for channel in zip(*edges, strict=True)
    )
    scores = depth @ other.T
    own = np.diag(scores)
    of_others = (scores.sum(0) + scores.sum(1) - 2 * own) / (2 * (len(own) - 1))
    return is_significant(own - of_others, 0.0, _MIN_LEAD_SIGMAS)


def check_color(sample: Sample) -> Iterator[Finding]:
    """Check that the edges of colour coincide with those of depth."""
    images = _shiftable(sample.images)
    edges = _edge_pairs([f for f in images if f.color_registered], _grey)
    if len(edges) < _MIN_FRAMES:
        return
    columns = edges[0][0].shape[1]
    max_shift = round(_MAX_SHIFT * columns)
    correlations = _correlations(edges, max_shift)
    mean, unshifted = correlations.mean(0), correlations[:, max_shift, max_shift]
    from_peak = _from_peak(mean)
    best = correlations[:, from_peak == 0][:, 0]
    shift = float(from_peak[max_shift, max_shift]) / columns
    is_clear = (
        mean.max() >= _MIN_COLOR_CORRELATION
        and unshifted.mean() <= _MAX_COLOR_UNSHIFTED * mean.max()
        and mean[from_peak > _PEAK_RADIUS_PX].max() <= _MAX_ELSEWHERE * mean.max()
    )
    lead = best - unshifted
    if is_clear and shift > _MIN_SHIFT and is_significant(lead, _MIN_COLOR_LEAD, _MIN_LEAD_SIGMAS):
        pixels = shift * images[0].camera.width
        yield Finding(
            "color_unregistered",
            f"Colour is not registered to depth: its edges lie {pixels:.0f} pixels away from "
            "those of depth.",
            "Add the colour camera's intrinsics and T_color_depth, or remove the colour.",
            {"shift_px": pixels, "lead": float(lead.mean())},
        )


def check_delay(sample: Sample) -> Iterator[Finding]:
    """Check that amplitude and depth are of the same time: the later one lies behind in motion."""
    held = sum(_is_held(*images) for images in sample.consecutive_images)
    if held >= max(2, len(sample.steps) / 2):
        yield Finding(
            "delayed",
            f"Amplitude stays the same image, while depth changes, in {held} of "
            f"{len(sample.steps)} pairs of consecutive frames.",
            "Record again, or remove the amplitude.",
            {"held": held, "pairs": len(sample.steps)},
        )
        return
    images = {frame.index: frame for frame in _shiftable(sample.images)}
    moving = [
        (images[view.index], pair.alignment.T_world_source)
        for pair in sample.pairs
        if pair.fits
        for view in (pair.first, pair.second)
        if view.index in images
    ]
    shifts, motions = [], []
    for frame, T_first_second in moving:
        for edges in _edge_pairs([frame], _amplitude):
            columns = edges[0].shape[1]
            max_shift, scale = round(_MAX_DELAY_SHIFT * columns), columns / frame.camera.width
            scores = _correlations([edges], max_shift)[0]
            moved = scale * _image_motion(frame, T_first_second)
            if not _repeats(scores, moved):
                shifts.append(_peak(scores) - max_shift)
                motions.append(moved)
    shift, motion = np.reshape(shifts, (-1, 2)), np.reshape(motions, (-1, 2))
    moves = np.linalg.norm(motion, axis=1) >= _MIN_MOTION_PX
    shift, motion = shift[moves], motion[moves]
    if len(shift) < _MIN_FRAMES:
        return
    delay = _delay(shift, motion)
    if delay is not None:
        late, early = ("Amplitude", "depth") if delay > 0 else ("Depth", "amplitude")
        yield Finding(
            "delayed",
            f"{late} lags behind {early} by {abs(delay):.1f} frames: where the camera moves, their "
            "edges lie apart.",
            "Pair the images by their time stamps, and switch off filters over time in the camera.",
            {"delay_frames": delay},
        )


def _delay(shift: Float64, motion: Float64) -> float | None:
    """Return the delay in frames that explains shifts (N, 2) of edges by motions (N, 2) per frame.

    None without a clear one. Where things of one albedo stand upright, edges lie apart by as much
    however the camera moves: a shift that is constant while the motion is not is no delay.
    """
    delay = float(np.median(-(shift * motion).sum(1) / (motion * motion).sum(1)))
    expected = -delay * motion
    size = np.linalg.norm(expected, axis=1)
    remainder = np.linalg.norm(shift - expected, axis=1)
    spread = np.linalg.norm(shift - np.median(shift, axis=0), axis=1)
    is_clear = (
        np.median(size) >= _MIN_DELAY_PX
        and np.mean(remainder <= _MAX_UNEXPLAINED * size) >= _MIN_DELAYED
        and np.median(remainder) <= _MAX_REMAINDER * np.median(spread)
    )
    return delay if is_clear and _MIN_DELAY <= abs(delay) <= _MAX_DELAY else None


def _is_held(first: RangeFrame, second: RangeFrame) -> bool:
    """Whether amplitude, other than a uniform one, is the same in two frames of different depth."""
    a, b = first.amplitude_image, second.amplitude_image
    if a is None or b is None or np.ptp(a) == 0:
        return False
    return np.array_equal(a, b) and not np.array_equal(first.depth, second.depth)


def _image_motion(frame: RangeFrame, T_first_second: Float64) -> Float64:
    """Median motion (2,) of the image until the next frame, pixels."""
    z = frame.z[frame.valid]
    rays = frame.camera.rays()[frame.valid]
    points = np.column_stack([rays * z[:, None], z])
    moved = se3.transform(se3.inverse(T_first_second), points)
    focal = frame.camera.width / np.ptp(frame.camera.rays()[..., 0])
    return np.asarray(np.nanmedian(moved[:, :2] / moved[:, 2:] - rays, axis=0) * focal, np.float64)


def _peak(scores: Float64) -> Float64:
    """Position (2,) of the largest score, x and y, by parabolas through its neighbours."""
    row, column = np.unravel_index(int(scores.argmax()), scores.shape)
    along = scores[row, column - 1 : column + 2], scores[row - 1 : row + 2, column]
    return np.array([column, row]) + [_vertex(s) if len(s) == 3 else 0.0 for s in along]


def _vertex(scores: Float64) -> float:
    """Offset of the vertex of a parabola through three scores from the middle one."""
    before, at, after = scores
    curvature = before - 2 * at + after
    return float(0.5 * (before - after) / curvature) if curvature < 0 else 0.0


def _amplitude(frame: RangeFrame) -> Float32 | None:
    amplitude = frame.amplitude_image
    if amplitude is None:
        return None
    return np.log1p(np.where(amplitude < SATURATED_AMPLITUDE, amplitude, 0)).astype(np.float32)


def _grey(frame: RangeFrame) -> Float32 | None:
    if frame.color_image is None:
        return None
    grey = cv2.cvtColor(np.ascontiguousarray(frame.color_image), cv2.COLOR_RGB2GRAY)
    # Black is what the colour camera doesn't see.
    return _filled(np.log1p(grey.astype(np.float32)), grey > 0)


def _log_depth(frame: RangeFrame) -> Float32:
    """Logarithm of depth (H, W), without edges at holes."""
    return _filled(
        np.log(np.maximum(frame.z, 1e-3)).astype(np.float32), frame.valid & (frame.z > 0)
    )


def _filled(values: Float32, known: Bool) -> Float32:
    """Values (H, W) with unknown ones filled by a mean around the nearest known, without edges."""
    if not known.any():
        return np.zeros_like(values)
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), 3)
    blurred = cv2.GaussianBlur(np.where(known, values, 0).astype(np.float32), (0, 0), 3)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    filled = blurred[tuple(nearest)] / weight[tuple(nearest)]
    return np.where(known, values, filled).astype(np.float32)


def _edges(image: Float32) -> Float32:
    """Edge strength (h, w) of a downscaled image, 0 to 1."""
    return np.asarray(np.hypot(*_gradient(image)), np.float32)


def _oriented_edges(image: Float32) -> Float32:
    """Edges (h, w, 3) of a downscaled image: their strength times x x, y y and x y of their normal.

    Slightly blurred, as edges of two cameras don't coincide exactly.
    """
    x, y = _gradient(image)
    strength = np.maximum(np.hypot(x, y), 1e-9)
    return cv2.GaussianBlur(
        np.stack([x * x, y * y, np.sqrt(2) * x * y], -1) / strength[..., None], (0, 0), 1.5
    ).astype(np.float32)


def _gradient(image: Float32) -> tuple[Float32, Float32]:
    """Gradient (h, w) along x and y of a downscaled image; strong ones saturate at length 1."""
    columns = min(_COLUMNS, image.shape[1])
    rows = max(round(image.shape[0] * columns / image.shape[1]), 2)
    small = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), 1.0)
    x, y = cv2.Sobel(small, cv2.CV_32F, 1, 0), cv2.Sobel(small, cv2.CV_32F, 0, 1)
    strength = np.hypot(x, y)
    saturation = max(float(np.percentile(strength, 95)) or 1.0, 1e-6)
    scale = (1 / np.maximum(strength, saturation)).astype(np.float32)
    return np.asarray(x * scale, np.float32), np.asarray(y * scale, np.float32)


def _shiftable(images: Sequence[RangeFrame]) -> list[RangeFrame]:
    return [
        image
        for image in images
        if image.camera.width >= _MIN_COLUMNS
        and image.camera.height >= _MIN_RATIO * image.camera.width
    ]


def _edge_pairs(
    frames: Sequence[RangeFrame], channel_of: Callable[[RangeFrame], Float32 | None]
) -> list[tuple[Float32, Float32]]:
    """The edges of depth and of another channel, of the frames that have it."""
    return [
        (_edges(_log_depth(f)), _edges(image))
        for f in frames
        if (image := channel_of(f)) is not None
    ]


def _correlations(edges: Sequence[tuple[Float32, Float32]], max_shift: int) -> Float64:
    """Correlations of the centre of one image with the other, for shifts of up to some pixels.

    (N, 2 * max_shift + 1, 2 * max_shift + 1) of N pairs.
    """
    inner = slice(max_shift, -max_shift or None)
    maps = [
        cv2.matchTemplate(
            np.ascontiguousarray(b), np.ascontiguousarray(a[inner, inner]), cv2.TM_CCOEFF_NORMED
        )
        for a, b in edges
    ]
    return np.stack(maps).astype(float)


def _from_peak(scores: Float64) -> Float64:
    """Distance of each element of (H, W) scores from the largest one, pixels."""
    return np.asarray(np.hypot(*_offsets(scores)))


def _offsets(scores: Float64) -> tuple[Float64, Float64]:
    """Offsets of each element of (H, W) scores from the largest one, down and right, pixels."""
    i, j = np.unravel_index(int(scores.argmax()), scores.shape)
    down, right = np.indices(scores.shape, float)
    return down - i, right - j


def _repeats(scores: Float64, motion: Float64) -> bool:
    """Whether scores (H, W) are as large farther along a motion (2,): edges of stairs repeat."""
    down, right = _offsets(scores)
    x, y = motion / max(float(np.linalg.norm(motion)), 1e-9)
    along, across = np.abs(right * x + down * y), np.abs(right * y - down * x)
    farther = scores[(along > _PEAK_RADIUS_PX) & (across < 0.5 * _PEAK_RADIUS_PX)]
    return bool(farther.max(initial=0.0) > _MAX_ELSEWHERE * scores.max())
