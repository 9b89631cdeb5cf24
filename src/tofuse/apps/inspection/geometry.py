"""Checks of the geometry: depth kind, lens distortion, focal length and principal point."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tofuse.apps.inspection.finding import Finding
from tofuse.apps.inspection.planar import Distortion, fit_distortion
from tofuse.apps.inspection.sample import Sample
from tofuse.engine.cameras import Pinhole, RayTable
from tofuse.engine.quantities import percent

# Tolerance and maximum standard deviation of the exponent: 0, or 1 or -1 for the wrong kind.
_KIND_TOLERANCE, _MAX_KIND_SIGMA = 0.3, 0.12
# Smaller errors of rays are irrelevant; below this number of standard deviations, insignificant.
_MIN_STRETCH, _MIN_FOCAL_ERROR = 0.045, 0.05
_MIN_STRETCH_SIGMAS, _MIN_FOCAL_SIGMAS = 3.0, 4.0
_MIN_SCALE = -0.8
_MIN_SURFACES = 4
# Surfaces with a larger misfit under every lens, relative to the depth, are not planar.
_MAX_MISFIT = 0.012
# Distortion is the main cause of a misfit of planes if it leaves a smaller fraction of it.
_MAX_UNEXPLAINED = 0.9
# Maximum offset of the principal point from the image centre, as a fraction of the image size.
_MAX_CENTRE_OFFSET = 0.2
# Limits of the focal length as fractions of the width: 150 and 12 degrees field of view.
_MIN_FOCAL, _MAX_FOCAL = 0.13, 4.8


def check_kind(sample: Sample) -> Iterator[Finding]:
    """Check that planes are not distorted as if z were taken for range, or the reverse."""
    distortion = _distortion(sample)
    if distortion is None:
        return
    kind = sample.images[0].depth_kind
    (alpha, sigma) = distortion.first
    wrong_exponent = 1.0 if kind == "z" else -1.0
    if sigma > _MAX_KIND_SIGMA or abs(alpha - wrong_exponent) > _KIND_TOLERANCE:
        return
    code, shape, declared, actual = (
        ("range_taken_for_z", "bulge as if radial range were taken for z", "z", "range")
        if kind == "z"
        else ("z_taken_for_range", "are concave as if z were taken for radial range", "range", "z")
    )
    yield Finding(
        code,
        f"Walls {shape}: planes fit {distortion.surfaces} surfaces to "
        f"{100 * distortion.rms_after:.2f} % of the depth as {actual}, and to "
        f"{100 * distortion.rms_before:.2f} % as {declared}.",
        f'Set depth_kind to "{actual}".',
        {
            "exponent": alpha,
            "sigma": sigma,
            "rms_fraction": distortion.rms_before,
            "rms_share_if_corrected": distortion.rms_after,
        },
    )


def check_lens(sample: Sample) -> Iterator[Finding]:
    """Check that planes are not distorted by the lens or a wrong focal length."""
    if any(check_kind(sample)):
        return  # the planes are distorted anyway
    distortion = _distortion(sample)
    kind = sample.images[0].depth_kind if sample.images else "z"
    lens = None if distortion is None else fit_distortion(sample.regions, sample.radius, kind)
    if lens is None or lens.rms_after > _MAX_MISFIT or lens.folds:
        return  # too few surfaces, or no planes
    stretch, sigma = lens.stretch
    focal_error, focal_sigma = lens.first
    # Other depth errors bend surfaces too, and few surfaces may be consistent by chance.
    explains = lens.rms_after < _MAX_UNEXPLAINED * lens.rms_before
    by_chance = 0.0 if explains else lens.quantile(_MIN_STRETCH_SIGMAS)
    if (
        kind == "range"
        and abs(focal_error)
        > max(_MIN_FOCAL_ERROR, max(_MIN_FOCAL_SIGMAS, by_chance) * focal_sigma)
        and focal_error > _MIN_SCALE
        and abs(focal_error) / focal_sigma > abs(stretch) / sigma
    ):
        factor = 1 / (1 + focal_error)
        yield Finding(
            "focal_length",
            "The focal length does not match these images: planes are distorted least at "
            f"{factor:.2f} times the stated one (sigma {focal_sigma:.2f}).",
            "Use the intrinsics of the depth camera, at this resolution; not those of the colour "
            "camera.",
            {"factor": factor, "sigma": focal_sigma},
        )
        return
    if abs(stretch) > max(_MIN_STRETCH, max(_MIN_STRETCH_SIGMAS, by_chance) * sigma):
        yield Finding(
            "lens_distortion",
            f"Planes are distorted as by an uncorrected lens: rays at the corners deviate by "
            f"{100 * stretch:+.1f} % (sigma {percent(sigma)}).",
            "Add the distortion of the lens, or its rays, to camera.json; or remove them if depth "
            "is undistorted already.",
            {"stretch": stretch, "sigma": sigma},
        )


def _distortion(sample: Sample) -> Distortion | None:
    """The distortion of planes, if there are enough surfaces."""
    distortion = sample.distortion if sample.images else None
    return distortion if distortion is not None and distortion.surfaces >= _MIN_SURFACES else None


def check_intrinsics(sample: Sample) -> Iterator[Finding]:
    """Check that the intrinsics are plausible for images of this size."""
    if not sample.images:
        return
    camera = sample.images[0].camera
    lens = camera.fit if isinstance(camera, RayTable) else camera
    if not isinstance(lens, Pinhole):
        return
    offset_x = (lens.cx - (lens.width - 1) / 2) / lens.width
    offset_y = (lens.cy - (lens.height - 1) / 2) / lens.height
    evidence = {
        "cx_off_fraction": offset_x,
        "cy_off_fraction": offset_y,
        "fx_fraction": lens.fx / lens.width,
        "fx_over_fy": lens.fx / lens.fy,
    }
    if max(abs(offset_x), abs(offset_y)) > _MAX_CENTRE_OFFSET:
        fault = (
            f"The principal point ({lens.cx:.0f}, {lens.cy:.0f}) is far from the centre of "
            f"images of {lens.width} x {lens.height}"
        )
    elif not _MIN_FOCAL < lens.fx / lens.width < _MAX_FOCAL:
        fault = (
            f"A focal length of {lens.fx:.4g} pixels gives images of {lens.width} columns a field "
            f"of view of {2 * np.degrees(np.arctan(lens.width / 2 / lens.fx)):.0f} degrees"
        )
    else:
        return
    yield Finding(
        "other_intrinsics",
        f"{fault}: these are intrinsics of another resolution or another camera.",
        "Use the intrinsics of the depth camera at this resolution.",
        evidence,
    )
