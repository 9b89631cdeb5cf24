"""What single pixels tell: the unit of depth, holes, saturation, wraps, flying pixels."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tofuse.arrays import Bool, Float32
from tofuse.inspection.finding import Finding
from tofuse.inspection.sample import Sample
from tofuse.recordings.frames import SATURATED_AMPLITUDE, Frame, RangeFrame
from tofuse.sensor.unwrap import on_surface

# Typical distances in m that ToF cameras hardly have.
_NEAREST_M, _FARTHEST_M = 0.15, 12.0
_FEW_VALID, _MANY_SATURATED = 0.1, 0.05
# Two surfaces so many pixels to both sides are far from each other if they differ by this share,
# and even if they change by less than a share of that over two pixels; in between is what is
# further than a share of that from both.
_REACH, _STEP, _INSIDE, _EVEN = 4, 0.15, 0.2, 0.1
_WIDE, _MANY_FLYING = 4.5, 0.01
# A wrap joins ranges above and below these shares of the period.
_LATE, _EARLY = 0.85, 0.15
_SEAM_SHARE = 0.003
# A pixel that reflects this little, next to the rest, and is near, is one from beyond the period.
_DARK, _NEAR = 0.12, 0.5
_DARK_SHARE = 0.08
# So many steps in depth make a share of flying pixels.
_FEWEST_EDGES = 100


def depths_of(frame: Frame) -> Float32:
    """Valid distances (N,) of a view, m."""
    if isinstance(frame, RangeFrame):
        return frame.depth[frame.valid]
    return np.linalg.norm(frame.points - frame.origin.astype(np.float32), axis=1)


def check_unit(sample: Sample) -> Iterator[Finding]:
    """Is the typical distance one that a ToF camera measures?"""
    depths = np.concatenate([depths_of(f) for f in sample.frames])
    if len(depths) == 0:
        yield Finding(
            "few_valid",
            "There is no valid point in the frames looked at: is the depth unit right?",
            "Check depth_unit_m, and that the depth images are 16 bits deep.",
            {"valid_share": 0.0},
        )
        return
    middle = float(np.median(depths))
    period = sample.period_m
    evidence = {"median_m": middle, "far_m": float(np.percentile(depths, 99))}
    if period is not None and middle > period:
        what = f"and the phase of this camera repeats after {period:.3g} m"
    elif middle > _FARTHEST_M:
        what = "farther than ToF cameras measure"
    elif middle < _NEAREST_M:
        what = "nearer than ToF cameras measure"
    else:
        return
    yield Finding(
        "depth_unit",
        f"The median depth is {middle:.3g} m, {what}.",
        f"Check depth_unit_m: it may be wrong by a factor of {_factor(middle):g}.",
        evidence | {"factor": _factor(middle)},
    )


def _factor(middle: float) -> float:
    """Power of ten that brings a distance nearest to 2 m."""
    return float(10.0 ** np.round(np.log10(middle / 2.0)))


def check_valid(sample: Sample) -> Iterator[Finding]:
    """Do enough pixels hold a measurement?"""
    share = float(np.mean([len(f) / max(f.valid.size, 1) for f in sample.frames]))
    if 0 < share < _FEW_VALID:
        yield Finding(
            "few_valid",
            f"Only {share:.1%} of the pixels are valid.",
            "Move closer, use a longer exposure, or check the threshold of the confidence.",
            {"valid_share": share},
        )


def check_saturation(sample: Sample) -> Iterator[Finding]:
    """Count pixels that were given too much light."""
    shares = [
        float(np.mean(f.amplitude_image >= SATURATED_AMPLITUDE))
        for f in sample.images
        if f.amplitude_image is not None
    ]
    if shares and (share := float(np.mean(shares))) > _MANY_SATURATED:
        yield Finding(
            "saturated",
            f"{share:.0%} of the pixels are saturated and hold no measurement.",
            "Use a shorter exposure, or keep farther from shiny and bright things.",
            {"saturated_share": share},
        )


def check_flying(sample: Sample) -> Iterator[Finding]:
    """How wide are the edges of things, and how much of the image is in between near and far?"""
    flying = edges = valid = 0
    for frame in sample.images:
        between, across = _between(frame.radial_range, frame.valid)
        flying += int(np.count_nonzero(between))
        edges += int(np.count_nonzero(across))
        valid += len(frame)
    if edges < _FEWEST_EDGES * max(len(sample.images), 1):
        return
    wide, share = 2 * _REACH * flying / edges, flying / valid
    if wide > _WIDE and share > _MANY_FLYING:
        yield Finding(
            "flying_pixels",
            f"{share:.1%} of the pixels fly between near and far things, where nothing is: edges "
            f"are {wide:.1f} pixels wide.",
            "Keep the filters against flying pixels on; clean the lens, and check its focus.",
            {"flying_share": share, "edge_width_px": wide},
        )


def fliers(frame: RangeFrame) -> Bool:
    """(H, W) mask of the pixels in between near and far things."""
    return _between(frame.radial_range, frame.valid)[0]


def _between(r: Float32, valid: Bool) -> tuple[Bool, Bool]:
    """Pixels in between those a few to both sides, and all pixels at such an edge.

    An edge is where two surfaces, each even by itself, are far from each other.
    """
    between, across = np.zeros(r.shape, bool), np.zeros(r.shape, bool)
    far = _REACH + 2
    for axis in (0, 1):
        n = r.shape[axis]
        if n <= 2 * far:
            continue

        def at(shift: int, axis: int = axis, n: int = n) -> tuple[slice, ...]:
            part = slice(far + shift, n - far + shift)
            return (part, slice(None)) if axis == 0 else (slice(None), part)

        here, a, b = r[at(0)], r[at(-_REACH)], r[at(_REACH)]
        gap = np.abs(b - a)
        known = valid[at(0)] & valid[at(-_REACH)] & valid[at(_REACH)]
        known &= valid[at(-far)] & valid[at(far)]
        edge = known & (gap > _STEP * np.minimum(a, b))
        edge &= (np.abs(a - r[at(-far)]) < _EVEN * gap) & (np.abs(b - r[at(far)]) < _EVEN * gap)
        # Noise does not make surfaces that are even in both directions.
        for side in (-_REACH, _REACH):
            for beside in (-1, 1):
                other = np.roll(r, beside, 1 - axis)[at(side)]
                edge &= np.abs(r[at(side)] - other) < _EVEN * gap
        across[at(0)] |= edge
        inner = np.minimum(np.abs(here - a), np.abs(b - here)) > _INSIDE * gap
        between[at(0)] |= edge & inner & ((here - a) * (b - here) > 0)
    return between, across


def check_wrap(sample: Sample) -> Iterator[Finding]:
    """Look for seams at which the range starts again, and for near things that reflect too little.

    A surface that goes on beyond the camera's period comes back at range 0, so far and near touch;
    and what is that far returns less light than its false range would make it (its apparent
    albedo, amplitude times the squared range, is small). Pixels too weak to be measured come at any
    range and are dark as well: only those count that make a surface with their neighbours.
    """
    period = sample.period_m
    if period is None:
        return
    seams = dark = valid = lit = 0
    for frame in sample.images:
        r = frame.radial_range
        surface = on_surface(np.where(frame.valid, r, np.float32(0)), period)
        late, early = surface & (r > _LATE * period), surface & (r < _EARLY * period)
        for a, b in ((np.s_[:, :-2], np.s_[:, 2:]), (np.s_[:-2], np.s_[2:])):
            seams += int(np.count_nonzero((late[a] & early[b]) | (early[a] & late[b])))
        valid += len(frame)
        albedo = _apparent_albedo(frame, r)
        if albedo is None:
            continue
        known = frame.valid & (albedo > 0)
        lit += int(np.count_nonzero(known))
        if not known.any():
            continue
        typical = float(np.median(albedo[known]))
        near = known & surface & (r < _NEAR * period)
        dark += int(np.count_nonzero(near & (albedo < _DARK * typical)))
    seam_share, dark_share = seams / max(valid, 1), dark / max(lit, 1)
    if seam_share > _SEAM_SHARE or dark_share > _DARK_SHARE:
        yield Finding(
            "phase_wrap",
            f"Surfaces beyond {period:.3g} m, after which the phase of this camera repeats, are "
            f"measured as near ones: {seam_share:.2%} of the pixels are at seams from far to "
            f"near, and {dark_share:.1%} are near and yet {1 / _DARK:.0f} times darker than the "
            "rest.",
            "Give --unwrap (it needs the amplitude), record with a lower modulation frequency, or "
            "drop weak pixels by a filter of the amplitude.",
            {"seam_share": seam_share, "dark_share": dark_share, "period_m": period},
        )


def _apparent_albedo(frame: RangeFrame, r: Float32) -> Float32 | None:
    light = frame.amplitude_image
    if light is None:
        return None
    light = np.where(light < SATURATED_AMPLITUDE, light, np.float32(0))
    return light if frame.amplitude_kind == "range_compensated" else light * r * r
