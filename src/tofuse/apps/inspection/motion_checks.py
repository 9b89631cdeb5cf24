"""Checks of the camera's motion, of moving objects, and of single-plane views."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from tofuse.apps.inspection import channels
from tofuse.apps.inspection.finding import Finding
from tofuse.apps.inspection.sample import Pair, Sample
from tofuse.engine.arrays import Float64

# Smaller motions count as standing still.
_STILL_M, _STILL_RAD = 0.01, np.radians(0.5)
_MIN_FRAMES = 3
# Minimum overlap of neighbours, and maximum image motion, as fractions of the image.
_MIN_OVERLAP, _MAX_SHIFT = 0.5, 0.2
# Minimum fraction of the image with moving objects, and minimum fraction of pairs with such motion.
_MIN_MOVED, _MIN_FREQUENCY = 0.015, 0.5
_MIN_SCORE = 0.65
# Minimum fraction of the pixels on the largest plane in a single-plane view.
_MIN_WALL_FRACTION = 0.8
# Maximum misfit of a plane, relative to the depth.
_MAX_MISFIT = 0.02


def check_still(sample: Sample) -> Iterator[Finding]:
    """Check whether the camera moves at all."""
    if sample.turning or len(sample.views) < _MIN_FRAMES or not sample.pairs:
        return
    # In degenerate directions an alignment keeps its initial pose, so edges are compared too.
    first, *others = sample.images
    if (
        all(_still(p) for p in sample.pairs)
        and all(_still(p) for p in sample.distant_pairs)
        and not any(channels.shifted(first, image) for image in others)
    ):
        yield Finding(
            "static",
            f"The camera does not move in the {len(sample.views)} sampled frames: the model will "
            "contain only what one view shows.",
            "Move the camera; average static frames with --average-still; or, if an object turns "
            "in front of it, use --object.",
            {"frames": len(sample.views)},
        )


def _still(pair: Pair) -> bool:
    distance = float(np.linalg.norm(pair.T_first_second[:3, 3]))
    return pair.alignment.overlap > _MIN_OVERLAP and distance < _STILL_M and pair.angle < _STILL_RAD


def check_motion(sample: Sample) -> Iterator[Finding]:
    """Check that neighbours overlap, and that motion is slow enough for the frame rate."""
    pairs = sample.pairs
    if sample.turning or len(pairs) < 2:
        return
    lost = [p for p in pairs if not p.fits or p.alignment.overlap < _MIN_OVERLAP]
    if 2 * len(lost) >= len(pairs):
        yield Finding(
            "little_overlap",
            f"{len(lost)} of {len(pairs)} pairs of consecutive frames overlap too little, or are "
            "inconsistent.",
            "Record at a higher rate or move more slowly; use a smaller --every.",
            {
                "pairs": len(pairs),
                "without_overlap": len(lost),
                "median_overlap": float(np.median([p.alignment.overlap for p in pairs])),
            },
        )
        return
    shift = float(np.median([p.shift for p in pairs if p.fits]))
    if shift > _MAX_SHIFT:
        angle = float(np.degrees(np.median([p.angle for p in pairs if p.fits])))
        yield Finding(
            "fast_motion",
            f"The camera moves fast for the frame rate: from one frame to the next the image moves "
            f"by {shift:.0%} of its size ({angle:.1f} degrees).",
            "Move more slowly, record at a higher rate, or use a smaller --every.",
            {"shift_fraction": shift, "angle_deg": angle},
        )


def check_moving_objects(sample: Sample) -> Iterator[Finding]:
    """Check for objects that move by themselves."""
    if sample.turning or not sample.pairs:
        return
    # Slow motion is visible between distant frames, if the camera stands still. Shifted edges don't
    # decide that: they may be those of the object.
    still_pairs = [p for p in sample.distant_pairs if _still(p)]
    distant_fractions = (
        _moved_fractions(still_pairs)
        if len(still_pairs) >= _MIN_FREQUENCY * len(sample.distant_pairs)
        else np.zeros(0)
    )
    fractions = max(
        _moved_fractions(sample.pairs),
        distant_fractions,
        key=lambda moved: np.mean(moved > _MIN_MOVED) if len(moved) else 0.0,
    )
    frequency = float(np.mean(fractions > _MIN_MOVED)) if len(fractions) else 0.0
    if frequency >= _MIN_FREQUENCY:
        yield Finding(
            "moving_objects",
            f"Something moves in front of the camera: in {frequency:.0%} of the pairs of frames "
            f"{np.median(fractions):.1%} of the image is in the other's free space.",
            "Record while nothing moves, or crop it (--max-depth); if it is the object to be "
            "modelled, turning in front of a stationary camera, use --object.",
            {"moved_fraction": float(np.median(fractions)), "pairs_fraction": frequency},
        )


def _moved_fractions(pairs: Sequence[Pair]) -> Float64:
    """Fraction of the image that moved, for each consistent pair; empty with too few pairs."""
    consistent = [
        p for p in pairs if p.alignment.score > _MIN_SCORE and p.fits and p.shift < _MAX_SHIFT
    ]
    if len(consistent) < max(2, _MIN_FREQUENCY * len(pairs)):
        return np.zeros(0)
    return np.array([p.moved_fraction for p in consistent])


def check_walls(sample: Sample) -> Iterator[Finding]:
    """Check for views of a single plane."""
    if not sample.views:
        return
    planar = {
        region.frame
        for region in sample.regions
        if region.fraction > _MIN_WALL_FRACTION and region.misfit <= _MAX_MISFIT
    }
    single_plane = [frame in planar for frame in sample.views]
    if np.mean(single_plane) >= _MIN_FREQUENCY:
        yield Finding(
            "wall_only",
            f"{sum(single_plane)} of {len(single_plane)} frames show a single plane, along which "
            "the motion of the camera is not observable.",
            "Keep a corner, furniture or texture in view.",
            {"frames": len(single_plane), "single_plane": sum(single_plane)},
        )
