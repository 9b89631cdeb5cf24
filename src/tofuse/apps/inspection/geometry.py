"""Checks of the geometry: depth kind, lens distortion, focal length and principal point."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from tofuse.apps.inspection.finding import Finding, is_significant
from tofuse.apps.inspection.planar import Distortion, fit_distortion
from tofuse.apps.inspection.sample import (
    VIEW_COLUMNS,
    Pair,
    Sample,
    aligned,
    aligned_pair,
    field_of_view,
    part_starts,
)
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import Pinhole, RayTable
from tofuse.engine.views import PreparedView, SurfaceOptions, prepare_view

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
# Desired rotation between views as a fraction of the field of view, and the minimum useful one.
_DESIRED_ROTATION, _MIN_ROTATION = 0.25, np.radians(4.0)
_MAX_GAP = 60  # frames between views
_MIN_PAIRS, _MAX_PAIRS = 6, 12
# Logarithms of the tested factors of the rays: multiples of the coarse step, for intrinsics of
# other resolutions (a third to three times the size), and around the best of these.
_COARSE_STEP, _COARSE_STEPS = 0.42, 4
_FINE = np.array([-0.42, -0.28, -0.14, 0.0, 0.14, 0.28, 0.42])
_NOMINAL = 3
# Minimum lead in score, also in standard errors, and significance of the scale.
_MIN_LEAD, _MIN_LEAD_SIGMAS, _MIN_SCALE_SIGMAS = 0.015, 1.5, 3.0
_MIN_LOG_SCALE, _MIN_SCORE, _MIN_MEAN_SCORE = 0.08, 0.5, 0.75
# Minimum lead of a coarse scale over the nominal one and those at the ends: without, views agree
# under any.
_MIN_COARSE_LEAD = 0.045


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
        f"Walls {shape}: planes fit {distortion.surfaces} surfaces to {distortion.rms_after:.2%} "
        f"of the depth as {actual}, and to {distortion.rms_before:.2%} as {declared}.",
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
        yield wrong_focal(1 / (1 + focal_error), focal_sigma, "planes are distorted")
        return
    if abs(stretch) > max(_MIN_STRETCH, max(_MIN_STRETCH_SIGMAS, by_chance) * sigma):
        yield Finding(
            "lens_distortion",
            f"Planes are distorted as by an uncorrected lens: rays at the corners deviate by "
            f"{stretch:+.1%} (+-{sigma:.1%}).",
            "Add the distortion of the lens, or its rays, to camera.json; or remove them if depth "
            "is undistorted already.",
            {"stretch": stretch, "sigma": sigma},
        )


def wrong_focal(factor: float, sigma: float, symptom: str) -> Finding:
    """Return the finding of a focal length wrong by `factor`, at which the symptom is weakest."""
    return Finding(
        "focal_length",
        f"The focal length does not match these images: {symptom} least at {factor:.2f} times the "
        f"stated one (+-{sigma:.2f}).",
        "Use the intrinsics of the depth camera, at this resolution; not those of the colour "
        "camera.",
        {"factor": factor, "sigma": sigma},
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


def check_focal(sample: Sample) -> Iterator[Finding]:
    """Check whether frames are more consistent under another focal length, for z depth.

    A wrong focal length stretches the world of a view laterally, and planes stay planes. But when
    the camera rotates, the stretched direction changes: the rotation from texture differs from that
    of the normals of walls, and no rigid motion fits both. So views are aligned again under several
    focal lengths, and the one with the best agreement is correct. Pure translation is not
    informative.
    """
    if not sample.images or sample.images[0].depth_kind != "z" or sample.turning:
        return
    if any(check_kind(sample)):
        return
    centre = _coarse_estimate(sample)
    scores = _consistent(
        [
            [_rescaled(pair, log_scale).alignment.score for log_scale in _FINE]
            for pair in _rotated_pairs(sample, centre)
        ]
    )
    if len(scores) < _MIN_PAIRS:
        return
    best = int(scores.mean(0).argmax())
    # At either end it may not be a maximum; with low scores it is not significant.
    if best in (0, len(_FINE) - 1) or scores[:, best].mean() < _MIN_MEAN_SCORE:
        return
    lead = scores[:, best] - scores[:, _NOMINAL]
    if not centre and not is_significant(lead, _MIN_LEAD, _MIN_LEAD_SIGMAS):
        return
    # Jackknife over the pairs (Efron 1982), at the same maximum.
    peaks = np.array(
        [_parabola_peak(np.delete(scores, k, 0).mean(0), best) for k in range(len(scores))]
    )
    sigma = float(np.sqrt((len(peaks) - 1) * peaks.var()))
    log_scale = centre + _parabola_peak(scores.mean(0), best)
    if abs(log_scale) > max(_MIN_LOG_SCALE, _MIN_SCALE_SIGMAS * sigma):
        factor = float(np.exp(-log_scale))
        yield wrong_focal(factor, factor * max(sigma, 0.01), "frames disagree")


def _parabola_peak(score: Float64, best: int) -> float:
    """The maximum of the parabola through an inner score and its neighbours."""
    a, b, c = score[best - 1 : best + 2]
    curvature = a - 2 * b + c
    shift = 0.0 if curvature >= 0 else 0.5 * (a - c) / curvature
    return float(_FINE[best] + np.clip(shift, -1.0, 1.0) * (_FINE[1] - _FINE[0]))


def _consistent(scores: Sequence[Sequence[float]]) -> Float64:
    """Scores (N, M) of the pairs that are consistent under any of M focal lengths.

    The others have a different fault.
    """
    return np.array([row for row in scores if max(row) > _MIN_SCORE])


def _coarse_estimate(sample: Sample) -> float:
    """The best of the coarse scales; 0.0, the stated focal length, if no other is better."""
    scores = _consistent([_coarse_scores(pair) for pair in _shifted_pairs(sample)])
    if len(scores) < _MIN_PAIRS:
        return 0.0
    mean = scores.mean(0)
    best = int(mean.argmax())
    lead = scores[:, best] - scores[:, _COARSE_STEPS]
    is_better = (
        is_significant(lead, _MIN_COARSE_LEAD, _MIN_LEAD_SIGMAS)
        and mean[best] - max(mean[0], mean[-1]) > _MIN_COARSE_LEAD
    )
    return (best - _COARSE_STEPS) * _COARSE_STEP if is_better else 0.0


def _coarse_scores(pair: Pair) -> list[float]:
    """Score under each of the coarse scales, each aligned from the pose under the previous one."""
    smaller, larger = [pair], [pair]
    for _ in range(_COARSE_STEPS):
        smaller.append(_rescaled(smaller[-1], -_COARSE_STEP))
        larger.append(_rescaled(larger[-1], _COARSE_STEP))
    return [p.alignment.score for p in (*smaller[:0:-1], *larger)]


def _shifted_pairs(sample: Sample) -> list[Pair]:
    """Pairs of views between which the image moves: rotations are known only at the true scale."""
    pairs = [
        _wider(sample, step, step.shift, _DESIRED_ROTATION, 0.5 * _DESIRED_ROTATION)
        for step in sample.pairs[:_MAX_PAIRS]
    ]
    return [pair for pair in pairs if pair is not None]


def _rotated_pairs(sample: Sample, log_scale: float) -> list[Pair]:
    """Pairs of views with enough rotation between them, under a scale."""
    pairs = []
    for nominal in sample.pairs[:_MAX_PAIRS]:
        step = _rescaled(nominal, log_scale) if log_scale else nominal
        desired = _DESIRED_ROTATION * field_of_view(step.first)
        pairs.append(_wider(sample, step, step.angle, desired, _MIN_ROTATION, log_scale))
    return [pair for pair in pairs if pair is not None]


def _wider(
    sample: Sample,
    step: Pair,
    motion: float,
    desired: float,
    minimum: float,
    log_scale: float = 0.0,
) -> Pair | None:
    """The pair of frames so far apart that a step's motion adds up; None if that is too little."""
    gap = int(np.clip(np.round(desired / max(motion, 1e-4)), 1, _MAX_GAP))
    if not step.fits or gap * motion < minimum:
        return None
    if gap == 1:
        return step
    # The same first frame, and one that is later, or earlier near the end.
    recording = sample.recording
    position = int(np.searchsorted(recording.indices, sample.frames[step.i].index))
    starts = [0, *part_starts(recording), len(recording)]
    part = int(np.searchsorted(starts, position, "right"))
    for k in (position + gap, position - gap):
        if not starts[part - 1] <= k < starts[part]:
            continue
        frame = recording.image(k)
        if frame is not None and len(frame):
            second = prepare_view(frame, SurfaceOptions(columns=VIEW_COLUMNS))
            return aligned_pair(step.first, _scaled(second, log_scale), step.i, k)
    return None


def _rescaled(pair: Pair, log_scale: float) -> Pair:
    """The pair with scaled rays, aligned again."""
    first, second = _scaled(pair.first, log_scale), _scaled(pair.second, log_scale)
    T_first_second = aligned(second, first, pair.T_first_second).T_world_source
    return Pair(pair.i, pair.j, first, second, aligned(second, first, T_first_second))


def _scaled(view: PreparedView, log_scale: float) -> PreparedView:
    """The view with its rays (x/z, y/z) multiplied by a factor."""
    scale = float(np.exp(log_scale))
    rays = view.rays * np.float32(scale)
    planes, albedo = view.planes.copy(), view.albedo.copy()
    planes[..., :2] /= np.float32(scale)
    albedo[..., 1:] /= np.float32(scale)
    x0, y0, per_x, per_y = view.projection.frame
    frame = np.array([x0 * scale, y0 * scale, per_x / scale, per_y / scale])
    projection = replace(view.projection, rays=rays, frame=frame)
    return replace(view, rays=rays, planes=planes, albedo=albedo, projection=projection)
