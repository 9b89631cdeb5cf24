"""How the camera moves, and what moves in front of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from tofuse.arrays import Float64
from tofuse.inspection import channels
from tofuse.inspection.finding import Finding
from tofuse.inspection.motion import Pair
from tofuse.inspection.sample import Sample

# A camera that moved by no more than this stood still.
_STILL_M, _STILL_RAD = 0.01, np.radians(0.5)
_FEWEST_FRAMES = 3
# Neighbours that share less than this part of the image, or move by more than this part of it.
_OVERLAP, _FAST = 0.5, 0.2
# Part of the image that something new stands in, in this part of the pairs.
_MOVED, _OFTEN = 0.015, 0.5
_FITS_WELL = 0.65
# Part of the pixels of a view of a single plane that are on it.
_WALL_SHARE = 0.8
# Misfit of a plane, as a share of the depth.
_FLAT = 0.02


def check_still(sample: Sample) -> Iterator[Finding]:
    """Does the camera move at all?"""
    if sample.turning or len(sample.maps) < _FEWEST_FRAMES or not sample.pairs:
        return
    if _stands_still(sample):
        yield Finding(
            "static",
            f"The camera does not move in the {len(sample.maps)} frames looked at: the model will "
            "be what one view sees.",
            "Move the camera; average still frames by --average-still; or, if a thing turns in "
            "front of it, give --object.",
            {"frames": len(sample.maps)},
        )


def _stands_still(sample: Sample) -> bool:
    """Whether neither neighbours nor frames far from each other tell of a motion."""
    if not sample.pairs or not all(_still(p) for p in sample.pairs):
        return False
    if not all(_still(p) for p in sample.apart):
        return False
    # An alignment stays where it began where it sees no way to go; edges tell more.
    images = sample.images
    return not any(channels.shifted(images[0], image) for image in images[1:])


def _still(pair: Pair) -> bool:
    way = float(np.linalg.norm(pair.T[:3, 3]))
    return pair.found.overlap > _OVERLAP and way < _STILL_M and pair.angle < _STILL_RAD


def check_motion(sample: Sample) -> Iterator[Finding]:
    """Do neighbours overlap, and does the camera move slowly enough for the frame rate?"""
    pairs = sample.pairs
    if sample.turning or len(pairs) < 2:
        return
    lost = [p for p in pairs if not p.fits or p.found.overlap < _OVERLAP]
    if 2 * len(lost) >= len(pairs):
        yield Finding(
            "little_overlap",
            f"{len(lost)} of {len(pairs)} pairs of consecutive frames see too little in common, or "
            "don't fit each other.",
            "Record at a higher rate or move more slowly; use a smaller --every.",
            {
                "pairs": len(pairs),
                "without_overlap": len(lost),
                "median_overlap": float(np.median([p.found.overlap for p in pairs])),
            },
        )
        return
    shift = float(np.median([p.shift for p in pairs if p.fits]))
    if shift > _FAST:
        angle = float(np.degrees(np.median([p.angle for p in pairs if p.fits])))
        yield Finding(
            "fast_motion",
            f"The camera moves fast for the frame rate: from one frame to the next the image moves "
            f"by {shift:.0%} of its size ({angle:.1f} degrees).",
            "Move more slowly, record at a higher rate, or use a smaller --every.",
            {"shift_share": shift, "angle_deg": angle},
        )


def check_moving_objects(sample: Sample) -> Iterator[Finding]:
    """Does something stand where the frame before, or the next, saw through?"""
    if sample.turning or not sample.pairs:
        return
    # What moves slowly shows after a while, if the camera stands still. Edges that moved do not
    # tell whether it does: they may be those of the thing.
    still = [p for p in sample.apart if _still(p)]
    apart = _moved(still) if len(still) >= _OFTEN * len(sample.apart) else np.zeros(0)
    shares = max(
        _moved(sample.pairs),
        apart,
        key=lambda found: np.mean(found > _MOVED) if len(found) else 0.0,
    )
    often = float(np.mean(shares > _MOVED)) if len(shares) else 0.0
    if often >= _OFTEN:
        yield Finding(
            "moving_objects",
            f"Something moves in front of the camera: in {often:.0%} of the pairs of frames "
            f"{np.median(shares):.1%} of the image stands where the other saw through.",
            "Record while nothing moves, or cut it off (--max-depth); if it is the thing to be "
            "modelled, turning before a still camera, give --object.",
            {"moved_share": float(np.median(shares)), "pairs_share": often},
        )


def _moved(pairs: Sequence[Pair]) -> Float64:
    """Of pairs that fit, how much of the image moved; nothing if too few do."""
    fit = [p for p in pairs if p.found.score > _FITS_WELL and p.fits and p.shift < _FAST]
    if len(fit) < max(2, _OFTEN * len(pairs)):
        return np.zeros(0)
    return np.array([p.moved_share for p in fit])


def check_walls(sample: Sample) -> Iterator[Finding]:
    """Is there more to see than one plane?"""
    if not sample.maps:
        return
    largest = dict.fromkeys(sample.maps, 0.0)
    for region in sample.regions:
        if region.misfit > _FLAT:
            continue
        largest[region.frame] = max(largest[region.frame], region.share)
    bare = [share > _WALL_SHARE for share in largest.values()]
    if np.mean(bare) >= _OFTEN:
        yield Finding(
            "wall_only",
            f"{sum(bare)} of {len(bare)} frames see a single plane, along which the camera can "
            "slide and turn unnoticed.",
            "Keep a corner, furniture or texture in view.",
            {"frames": len(bare), "single_plane": sum(bare)},
        )
