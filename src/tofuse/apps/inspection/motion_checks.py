"""Checks of the camera's motion, of single-plane views, and of the direction of gravity."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tofuse.apps.inspection.finding import Finding
from tofuse.apps.inspection.sample import Pair, Sample
from tofuse.engine.quantities import percent

# Smaller motions count as standing still.
_STILL_M, _STILL_RAD = 0.01, np.radians(0.5)
_MIN_FRAMES = 3
# Minimum overlap of neighbours, and maximum image motion, as fractions of the image.
_MIN_OVERLAP, _MAX_SHIFT = 0.5, 0.2
# Minimum fraction of the views that show a single plane.
_MIN_FREQUENCY = 0.5
# Minimum fraction of the pixels on the largest plane in a single-plane view.
_MIN_WALL_FRACTION = 0.8
# Gravity within 60 degrees of the top of the image: no camera on its side or facing down has that.
_MAX_DOWN = -0.5
# Maximum misfit of a plane, relative to the depth.
_MAX_MISFIT = 0.02


def check_still(sample: Sample) -> Iterator[Finding]:
    """Check whether the camera moves at all."""
    if sample.turning or len(sample.views) < _MIN_FRAMES or not sample.pairs:
        return
    if all(_still(p) for p in (*sample.pairs, *sample.distant_pairs)):
        yield Finding(
            "static",
            f"The camera does not move in the {len(sample.views)} sampled frames: the model will "
            "contain only what one view shows.",
            "Move the camera; average static frames with --average-still; or, if an object turns "
            "in front of it, use --object.",
            {"frames": len(sample.views)},
        )


def _still(pair: Pair) -> bool:
    is_same_place = pair.distance < _STILL_M and pair.angle < _STILL_RAD
    return pair.alignment.overlap > _MIN_OVERLAP and is_same_place


def check_motion(sample: Sample) -> Iterator[Finding]:
    """Check that neighbours overlap, and that motion is slow enough for the frame rate."""
    pairs = sample.pairs
    if sample.turning or len(pairs) < 2:
        return
    fitting = [p for p in pairs if p.fits]
    lost = len(pairs) - sum(p.alignment.overlap >= _MIN_OVERLAP for p in fitting)
    if 2 * lost >= len(pairs):
        yield Finding(
            "little_overlap",
            f"{lost} of {len(pairs)} pairs of consecutive frames overlap too little, or are "
            "inconsistent.",
            "Record at a higher rate or move more slowly; use a smaller --every.",
            {
                "pairs": len(pairs),
                "without_overlap": lost,
                "median_overlap": float(np.median([p.alignment.overlap for p in pairs])),
            },
        )
        return
    shift = float(np.median([p.shift for p in fitting]))
    if shift > _MAX_SHIFT:
        angle = float(np.degrees(np.median([p.angle for p in fitting])))
        yield Finding(
            "fast_motion",
            f"The camera moves fast for the frame rate: from one frame to the next the image moves "
            f"by {percent(shift)} of its size ({angle:.1f} degrees).",
            "Move more slowly, record at a higher rate, or use a smaller --every.",
            {"shift_fraction": shift, "angle_deg": angle},
        )


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


def check_gravity(sample: Sample) -> Iterator[Finding]:
    """Check that gravity points to the bottom of the images, as it does for an upright camera."""
    gravity = sample.recording.gravity
    if gravity is None or not np.isfinite(gravity).all(1).any():
        return
    down = float(np.nanmedian(gravity[:, 1]))
    if down < _MAX_DOWN:
        yield Finding(
            "upside_down",
            "Gravity points to the top of the images: the camera was upside down, or the "
            "accelerations are reversed.",
            "If it was upright, reverse their sign: ax, ay, az point up at rest, gravity_x, "
            "gravity_y, gravity_z down, in the camera's axes (y down). Else ignore this.",
            {"down_cosine": down},
        )
