"""Checks of the geometry: depth kind, lens distortion, focal length and principal point."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tofuse.geometry.cameras import Camera, Pinhole, RayTable
from tofuse.inspection.finding import Finding
from tofuse.inspection.planar import Distortion, fit_distortion
from tofuse.inspection.sample import Sample

# Tolerance and largest standard deviation of the exponent that is 0, or 1 or -1 for the wrong kind.
_KIND_WITHIN, _KIND_SIGMA = 0.3, 0.12
# Smaller errors of rays don't matter; those below this number of standard deviations are unproven.
_STRETCH, _FOCAL = 0.045, 0.05
_STRETCH_SIGMAS, _SIGMAS = 3.0, 4.0
_MIN_SCALE = -0.8
_MIN_SURFACES = 4
# Surfaces with a larger misfit, relative to the depth, under any lens are not planar.
_FLAT = 0.012
# Distortion that leaves a smaller fraction of the misfit of planes is its main cause.
_EXPLAINED = 0.9
# Largest offset of the principal point from the image centre, as a fraction of the image size.
_OFF_CENTRE = 0.2
# Limits of the focal length as fractions of the width: 150 and 12 degrees field of view.
_MIN_FOCAL, _MAX_FOCAL = 0.13, 4.8


def check_kind(sample: Sample) -> Iterator[Finding]:
    """Check that planes are not distorted as if z were taken for range, or the reverse."""
    b = _distortion(sample)
    if b is None:
        return
    kind = sample.images[0].depth_kind
    (alpha, sigma) = b.first
    wrong = 1.0 if kind == "z" else -1.0
    if sigma > _KIND_SIGMA or abs(alpha - wrong) > _KIND_WITHIN:
        return
    evidence = {
        "exponent": alpha,
        "sigma": sigma,
        "rms_fraction": b.rms_before,
        "rms_share_if_corrected": b.rms_after,
    }
    surfaces = f"{b.surfaces} surfaces"
    if kind == "z":
        yield Finding(
            "range_taken_for_z",
            f"Walls bulge as if radial range were taken for z: planes fit {surfaces} to "
            f"{b.rms_after:.2%} of the depth as range, and to {b.rms_before:.2%} as z.",
            'Set depth_kind to "range".',
            evidence,
        )
    else:
        yield Finding(
            "z_taken_for_range",
            f"Walls are concave as if z were taken for radial range: planes fit {surfaces} to "
            f"{b.rms_after:.2%} of the depth as z, and to {b.rms_before:.2%} as range.",
            'Set depth_kind to "z".',
            evidence,
        )


def check_lens(sample: Sample) -> Iterator[Finding]:
    """Check that planes are not distorted by the lens or a wrong focal length."""
    if any(check_kind(sample)):
        return  # the planes are distorted anyway
    found = _distortion(sample)
    kind = sample.images[0].depth_kind if sample.images else "z"
    lens = None if found is None else fit_distortion(sample.regions, sample.radius, kind)
    if lens is None or lens.rms_after > _FLAT or lens.folds:
        return  # too few surfaces, or no planes
    stretch, sigma = lens.stretch
    scale, scale_sigma = lens.first
    # Other errors of the depth bend surfaces as well, and few surfaces may agree by chance.
    explains = lens.rms_after < _EXPLAINED * lens.rms_before
    by_chance = 0.0 if explains else lens.quantile(_STRETCH_SIGMAS)
    if (
        kind == "range"
        and abs(scale) > max(_FOCAL, max(_SIGMAS, by_chance) * scale_sigma)
        and scale > _MIN_SCALE
        and abs(scale) / scale_sigma > abs(stretch) / sigma
    ):
        yield wrong_focal(1 / (1 + scale), scale_sigma, "planes are distorted")
        return
    if abs(stretch) > max(_STRETCH, max(_STRETCH_SIGMAS, by_chance) * sigma):
        yield Finding(
            "lens_distortion",
            f"Planes are distorted as by an uncorrected lens: rays at the corners deviate by "
            f"{stretch:+.1%} (+-{sigma:.1%}).",
            "Add the distortion of the lens, or its rays, to camera.json; or remove them if depth "
            "is undistorted already.",
            {"stretch": stretch, "sigma": sigma},
        )


def wrong_focal(factor: float, sigma: float, why: str) -> Finding:
    """Return the finding that the focal length is wrong by `factor`, at which `why` is weakest."""
    return Finding(
        "focal_length",
        f"The focal length does not match these images: {why} least at {factor:.2f} times the "
        f"stated one (+-{sigma:.2f}).",
        "Use the intrinsics of the depth camera, at this resolution; not those of the colour "
        "camera.",
        {"factor": factor, "sigma": sigma},
    )


def _distortion(sample: Sample) -> Distortion | None:
    """The distortion of planes, if there are enough surfaces."""
    found = sample.distortion if sample.images else None
    return found if found is not None and found.surfaces >= _MIN_SURFACES else None


def check_intrinsics(sample: Sample) -> Iterator[Finding]:
    """Check that the intrinsics are plausible for images of this size."""
    if not sample.images:
        return
    camera = sample.images[0].camera
    lens = _pinhole(camera)
    if lens is None:
        return
    off_x = (lens.cx - (lens.width - 1) / 2) / lens.width
    off_y = (lens.cy - (lens.height - 1) / 2) / lens.height
    evidence = {
        "cx_off_fraction": off_x,
        "cy_off_fraction": off_y,
        "fx_fraction": lens.fx / lens.width,
        "fx_over_fy": lens.fx / lens.fy,
    }
    where = "Use the intrinsics of the depth camera at this resolution."
    if max(abs(off_x), abs(off_y)) > _OFF_CENTRE:
        text = (
            f"The principal point ({lens.cx:.0f}, {lens.cy:.0f}) is far from the centre of "
            f"images of {lens.width} x {lens.height}: these are intrinsics of another resolution "
            "or another camera."
        )
    elif not _MIN_FOCAL < lens.fx / lens.width < _MAX_FOCAL:
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
