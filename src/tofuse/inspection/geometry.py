"""Is the world right: z or range, the lens, its focal length and centre."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tofuse.geometry.cameras import Camera, Pinhole, RayTable
from tofuse.inspection.finding import Finding
from tofuse.inspection.planar import Bending, bending
from tofuse.inspection.sample import Sample

# Of the exponent that says z (0) from range (1 or -1): how far off it may be, how well known.
_KIND_WITHIN, _KIND_SIGMA = 0.3, 0.12
# Rays off by less don't matter; by less than so many standard deviations they may not be.
_STRETCH, _FOCAL = 0.045, 0.05
_STRETCH_SIGMAS, _SIGMAS = 3.0, 4.0
_SMALLEST = -0.8
_FEWEST_SURFACES = 4
# Planes that fit worse than this, as a share of the depth, under any lens, are none.
_FLAT = 0.012
# A centre of the image this far from its middle, as a share of its size, is another image's.
_OFF_CENTRE = 0.2
# Focal lengths, as shares of the width: 150 and 12 degrees.
_SHORTEST, _LONGEST = 0.13, 4.8


def check_kind(sample: Sample) -> Iterator[Finding]:
    """Do walls bulge as they do when z is taken for range, or the reverse?"""
    found = _bending(sample)
    if found is None:
        return
    kind, b = sample.images[0].depth_kind, found
    (alpha, sigma) = b.first
    wrong = 1.0 if kind == "z" else -1.0
    if sigma > _KIND_SIGMA or abs(alpha - wrong) > _KIND_WITHIN:
        return
    evidence = {
        "exponent": alpha,
        "sigma": sigma,
        "rms_share": b.rms_before,
        "rms_share_if_corrected": b.rms_after,
    }
    surfaces = f"{b.surfaces} surfaces"
    if kind == "z":
        yield Finding(
            "range_taken_for_z",
            f"Walls bulge as they do when radial range is taken for z: of {surfaces} planes fit to "
            f"{b.rms_after:.2%} of the depth with the one, {b.rms_before:.2%} with the other.",
            'Set depth_kind to "range".',
            evidence,
        )
    else:
        yield Finding(
            "z_taken_for_range",
            f"Walls are hollow as they are when z is taken for radial range: of {surfaces} planes "
            f"fit to {b.rms_after:.2%} of the depth with the one, {b.rms_before:.2%} with the "
            "other.",
            'Set depth_kind to "z".',
            evidence,
        )


def check_lens(sample: Sample) -> Iterator[Finding]:
    """Do planes bend as under a lens that is not corrected, or with a wrong focal length?"""
    if any(check_kind(sample)):
        return  # planes bend anyway
    found = _bending(sample)
    kind = sample.images[0].depth_kind if sample.images else "z"
    lens = None if found is None else bending(sample.regions, sample.radius, kind)
    if lens is None or lens.rms_after > _FLAT:
        return  # too little, or no planes at all
    stretch, sigma = lens.stretch
    scale, scale_sigma = lens.first
    if (
        kind == "range"
        and abs(scale) > max(_FOCAL, _SIGMAS * scale_sigma)
        and scale > _SMALLEST
        and abs(scale) / scale_sigma > abs(stretch) / sigma
    ):
        yield wrong_focal(1 / (1 + scale), scale_sigma, "planes bend")
        return
    if abs(stretch) > max(_STRETCH, _STRETCH_SIGMAS * sigma):
        yield Finding(
            "lens_distortion",
            f"Planes bend as under a lens that is not corrected: rays at the corners are off by "
            f"{stretch:+.1%} (+-{sigma:.1%}).",
            "Give the distortion of the lens, or its rays, in camera.json; or, where depth is "
            "undistorted already, take them out.",
            {"stretch": stretch, "sigma": sigma},
        )


def wrong_focal(factor: float, sigma: float, why: str) -> Finding:
    """Say that the focal length is wrong by a factor; `why` says what happens least with it."""
    return Finding(
        "focal_length",
        f"The focal length is not that of these images: {why} least with {factor:.2f} times the "
        f"one given (+-{sigma:.2f}).",
        "Use the intrinsics of the depth camera, at this resolution; not those of the colour "
        "camera.",
        {"factor": factor, "sigma": sigma},
    )


def _bending(sample: Sample) -> Bending | None:
    """How surfaces bend, where there are enough of them to tell."""
    found = sample.bending if sample.images else None
    return found if found is not None and found.surfaces >= _FEWEST_SURFACES else None


def check_intrinsics(sample: Sample) -> Iterator[Finding]:
    """Are the numbers of the lens possible at all for images of this size?"""
    if not sample.images:
        return
    camera = sample.images[0].camera
    lens = _pinhole(camera)
    if lens is None:
        return
    off_x = (lens.cx - (lens.width - 1) / 2) / lens.width
    off_y = (lens.cy - (lens.height - 1) / 2) / lens.height
    evidence = {
        "cx_off_share": off_x,
        "cy_off_share": off_y,
        "fx_share": lens.fx / lens.width,
        "fx_over_fy": lens.fx / lens.fy,
    }
    where = "Give the intrinsics of the depth camera for this resolution."
    if max(abs(off_x), abs(off_y)) > _OFF_CENTRE:
        text = (
            f"The centre of projection ({lens.cx:.0f}, {lens.cy:.0f}) is far from the middle of "
            f"images of {lens.width} x {lens.height}: these are intrinsics of another resolution "
            "or another camera."
        )
    elif not _SHORTEST < lens.fx / lens.width < _LONGEST:
        text = (
            f"A focal length of {lens.fx:.4g} pixels gives images of {lens.width} columns a field "
            f"of view of {2 * np.degrees(np.arctan(lens.width / 2 / lens.fx)):.0f} degrees: these "
            "are intrinsics of another resolution or another camera."
        )
    else:
        return
    yield Finding("other_intrinsics", text, where, evidence)


def _pinhole(camera: Camera) -> Pinhole | None:
    if isinstance(camera, RayTable):
        return camera.fit
    return camera if isinstance(camera, Pinhole) else None
