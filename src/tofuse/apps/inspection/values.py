"""Checks of pixel values: unit of depth, invalid pixels, saturation, phase wraps, flying pixels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from tofuse.apps.inspection.finding import Finding
from tofuse.apps.inspection.sample import Sample
from tofuse.engine.arrays import Bool, Float32
from tofuse.engine.frames import SATURATED_AMPLITUDE, Frame, RangeFrame, frame_ranges
from tofuse.engine.quantities import percent
from tofuse.engine.sensor import Unwrap, on_surface

# Range of typical distances of ToF cameras, m.
_MIN_DISTANCE_M, _MAX_DISTANCE_M = 0.15, 12.0
_MIN_SCAN_M, _MAX_SCAN_M = 0.005, 1000.0  # of scanners, of small objects and from the air
_MIN_VALID, _MAX_SATURATED = 0.1, 0.05
# At an edge the surfaces _REACH pixels to both sides differ by the fraction _MIN_STEP of the depth,
# and each changes by less than the fraction _MAX_CHANGE of that difference over two pixels; flying
# pixels are farther than the fraction _MIN_INSIDE of it from both.
_REACH, _MIN_STEP, _MIN_INSIDE, _MAX_CHANGE = 4, 0.15, 0.2, 0.1
_MAX_EDGE_WIDTH, _MAX_FLYING = 4.5, 0.01
# At a seam of a phase wrap, ranges above and below these fractions of the period are adjacent.
_LATE, _EARLY = 0.85, 0.15
_MAX_SEAM_FRACTION = 0.003
# Pixels nearer than this fraction of the period with a lower apparent albedo, relative to the
# median, are wrapped.
_DARK, _NEAR = 0.12, 0.5
_MAX_DARK_FRACTION = 0.08
# Robust tracking follows the majority of the pixels: the wrapped ones must be fewer in this
# fraction of the views.
_MAX_WRAPPED, _MINORITY_VIEWS = 0.5, 0.9
# Largest fraction of a count by which stored depth differs from a whole number; and ratio of the
# mean differences of neighbours with swapped bytes to those as read, below which they are swapped.
_MAX_FRACTION, _MIN_SWAPPED_RATIO = 0.05, 0.2
_ROUGH = 0.01  # mean relative difference of neighbours below which depth is as smooth as any
# Ratio of typical distances of clouds above which they are in different units: half of that of cm.
_MIN_UNIT_RATIO = 50.0
# Minimum number of edge pixels per image to assess flying pixels.
_MIN_EDGES = 100


def depths_of(frame: Frame) -> Float32:
    """Return the valid depths or distances (N,) of a view, m; in a map, from its middle."""
    if isinstance(frame, RangeFrame):
        return frame.depth[frame.valid]
    centre = np.median(frame.points, axis=0) if frame.shift.any() else frame.origin
    return np.linalg.norm(frame.points - np.asarray(centre, np.float32), axis=1)


def valid_fraction(frames: Sequence[Frame]) -> float:
    """Return the mean fraction of valid pixels of views."""
    return float(np.mean([len(f) / max(f.valid.size, 1) for f in frames]))


def check_unit(sample: Sample) -> Iterator[Finding]:
    """Check that the typical distance is plausible for a ToF camera."""
    depths = np.concatenate([depths_of(f) for f in sample.frames])
    if len(depths) == 0:
        yield Finding(
            "few_valid",
            "There is no valid point in the sampled frames: is the depth unit right?",
            "Check depth_unit_m, and that the depth images have 16 bits.",
            {"valid_fraction": 0.0},
        )
        return
    unit = float(sample.recording.metadata.get("depth_unit_m", 0.001))
    if (ratio := _roughness_if_swapped(sample.images, unit)) < _MIN_SWAPPED_RATIO:
        yield Finding(
            "depth_unit",
            "The two bytes of each depth value are swapped: neighbouring pixels differ by "
            f"{1 / ratio:.0f} times as much as they do the other way round.",
            "Write 16-bit images in the byte order of their format (in Python: image.byteswap()).",
            {"roughness_if_swapped": ratio},
        )
        return
    mixed = _mixed_units([f for f in sample.frames if not isinstance(f, RangeFrame)])
    if mixed is not None:
        yield mixed
        return
    median = float(np.median(depths))
    period = sample.period_m
    evidence = {"median_m": median, "far_m": float(np.percentile(depths, 99))}
    if period is not None and median > period:
        problem = f"but the ambiguity range of this camera is {period:.3g} m"
    elif median > (_MAX_DISTANCE_M if sample.images else _MAX_SCAN_M):
        problem = f"farther than {'ToF cameras' if sample.images else 'scanners'} measure"
    elif median < (_MIN_DISTANCE_M if sample.images else _MIN_SCAN_M):
        problem = f"nearer than {'ToF cameras' if sample.images else 'scanners'} measure"
    else:
        return
    # The power of ten by which the distance is nearest to 2 m.
    factor = float(10.0 ** np.round(np.log10(median / 2.0)))
    correction = f"--factor {1 / factor:g}"
    remedy = (
        f"Check depth_unit_m: it may be wrong by a factor of {factor:g}; {correction} corrects it."
    )
    if factor == 1:
        remedy = "Check ambiguity_m: it is the range of one phase period."
    if not sample.images:
        remedy = (
            f"Coordinates are read as metres: multiply those in the files by {1 / factor:g}, as "
            f"{correction} does."
        )
    yield Finding(
        "depth_unit",
        f"The median depth is {median:.3g} m, {problem}.",
        remedy,
        evidence | {"factor": factor},
    )


def _mixed_units(clouds: Sequence[Frame]) -> Finding | None:
    """The finding that some clouds are in another unit than most; None if their distances agree."""
    typical = {f.index: float(np.median(depths_of(f))) for f in clouds if len(f)}
    distances = sorted(distance for distance in typical.values() if distance > 0)
    if not distances:
        return None
    usual = distances[(len(distances) - 1) // 2]
    off = [k for k, d in typical.items() if d and abs(np.log(d / usual)) > np.log(_MIN_UNIT_RATIO)]
    if not off:
        return None
    ratio = typical[off[0]] / usual
    where = frame_ranges.in_words(frame_ranges.runs_of(sorted(typical), off))
    return Finding(
        "depth_unit",
        f"The median distance of {where} is {typical[off[0]]:.3g} m, that of the others about "
        f"{usual:.3g} m: their units differ.",
        "Coordinates are read as metres: multiply those in the files of these frames by "
        f"{10.0 ** -np.round(np.log10(ratio)):g}.",
        {"ratio": ratio, "frames": float(len(off))},
    )


def _roughness_if_swapped(images: Sequence[RangeFrame], unit_m: float) -> float:
    """Return by how much smoother 16-bit depth is with swapped bytes: a ratio; 1 if not 16 bits."""
    ratios = []
    for image in images:
        counts = np.rint(image.depth[image.valid] / unit_m)
        if not len(counts) or counts.max() > np.iinfo(np.uint16).max:
            return 1.0
        stored = np.rint(np.where(image.valid, image.depth, 0) / unit_m).astype(np.uint16)
        if np.abs(image.depth[image.valid] / unit_m - counts).max() > _MAX_FRACTION:
            return 1.0
        both = image.valid[:, 1:] & image.valid[:, :-1]
        if not both.any():  # sparse depth
            continue
        as_read, swapped = (
            np.abs(np.diff(values.astype(float), axis=1))[both].mean() / values.mean()
            for values in (stored, stored.byteswap())
        )
        ratios.append(swapped / as_read if as_read > _ROUGH else 1.0)
    return float(np.median(ratios)) if ratios else 1.0


def check_valid(sample: Sample) -> Iterator[Finding]:
    """Check that enough pixels are valid."""
    valid = valid_fraction(sample.frames)
    if 0 < valid < _MIN_VALID:
        yield Finding(
            "few_valid",
            f"Only {percent(valid)} of the pixels are valid.",
            "Move closer, use a longer exposure, or check the confidence threshold.",
            {"valid_fraction": valid},
        )


def check_saturation(sample: Sample) -> Iterator[Finding]:
    """Check for saturated pixels."""
    saturated = [
        float(np.mean(f.amplitude_image >= SATURATED_AMPLITUDE))
        for f in sample.images
        if f.amplitude_image is not None
    ]
    if saturated and (fraction := float(np.mean(saturated))) > _MAX_SATURATED:
        yield Finding(
            "saturated",
            f"{percent(fraction)} of the pixels are saturated and invalid.",
            "Use a shorter exposure, or keep farther from shiny and bright objects.",
            {"saturated_fraction": fraction},
        )


def check_flying(sample: Sample) -> Iterator[Finding]:
    """Check the number of flying pixels and the width of depth edges."""
    flying = edges = valid = 0
    for frame in sample.images:
        along_rows = _flying(frame.radial_range, frame.valid)
        along_columns = _flying(frame.radial_range.T, frame.valid.T)
        is_flying, is_edge = (a | b.T for a, b in zip(along_rows, along_columns, strict=True))
        flying += int(np.count_nonzero(is_flying))
        edges += int(np.count_nonzero(is_edge))
        valid += len(frame)
    if edges < _MIN_EDGES * max(len(sample.images), 1):
        return
    width, fraction = 2 * _REACH * flying / edges, flying / valid
    if width > _MAX_EDGE_WIDTH and fraction > _MAX_FLYING:
        yield Finding(
            "flying_pixels",
            f"{percent(fraction)} of the pixels are flying pixels between near and far surfaces: "
            f"edges are {width:.1f} pixels wide.",
            "Keep the filters against flying pixels on. Phones and some other cameras smooth their "
            "depth; if this one does not, clean the lens and check its focus.",
            {"flying_fraction": fraction, "edge_width_px": width},
        )


def _flying(r: Float32, valid: Bool) -> tuple[Bool, Bool]:
    """Masks (H, W), along rows, of flying pixels and of all at edges between smooth surfaces."""
    is_flying, is_edge = np.zeros(r.shape, bool), np.zeros(r.shape, bool)
    margin = _REACH + 2
    inner = slice(margin, r.shape[1] - margin)
    if r.shape[1] <= 2 * margin:
        return is_flying, is_edge

    def shifted(image: Any, shift: int) -> Any:
        return image[:, margin + shift : image.shape[1] - margin + shift]

    center, a, b = (shifted(r, shift) for shift in (0, -_REACH, _REACH))
    gap = np.abs(b - a)
    edge = gap > _MIN_STEP * np.minimum(a, b)
    for shift in (0, -_REACH, _REACH, -margin, margin):
        edge &= shifted(valid, shift)
    for side, surface in ((-1, a), (1, b)):
        edge &= np.abs(surface - shifted(r, side * margin)) < _MAX_CHANGE * gap
        # Also smooth in the other direction, unlike noise.
        for offset in (-1, 1):
            neighbour = shifted(np.roll(r, offset, 0), side * _REACH)
            edge &= np.abs(surface - neighbour) < _MAX_CHANGE * gap
    between = (center - a) * (b - center) > 0
    between &= np.minimum(np.abs(center - a), np.abs(b - center)) > _MIN_INSIDE * gap
    is_edge[:, inner], is_flying[:, inner] = edge, edge & between
    return is_flying, is_edge


def check_wrap(sample: Sample) -> Iterator[Finding]:
    """Check for seams at which the range wraps, and for near surfaces of too low albedo.

    A surface that continues beyond the camera's period reappears at range 0, so far and near touch,
    and returns less light than its wrapped range implies: its apparent albedo, amplitude times the
    squared range, is small.

    Robust tracking follows the majority of the pixels, so it matters whether those are wrapped.
    That is known if unwrapping leaves neither seams nor dark pixels.
    """
    period = sample.period_m
    if period is None:
        return
    signs = _WrapSigns.of(sample.images, period)
    if not signs.are_many:
        return
    unwrap = Unwrap(period_m=period).fit(sample.images)
    unwrapped = [image for f in sample.images if isinstance(image := unwrap.apply(f), RangeFrame)]
    share = _wrapped_share(sample.images, unwrapped, period)
    is_minority = share < _MAX_WRAPPED and not _WrapSigns.of(unwrapped, period).are_many
    effect = (
        "Most of what the views show is nearer, and their poses follow that."
        if is_minority
        else "They may be most of what a view shows, and mislead its pose."
    )
    yield Finding(
        "some_phase_wrap" if is_minority else "phase_wrap",
        f"Phase wrapping: surfaces beyond the ambiguity range ({period:.3g} m) appear too "
        f"close: {100 * signs.seams:.2f} % of the pixels are at seams from far to near, and "
        f"{percent(signs.dark)} are near but {1 / _DARK:.0f} times darker than the rest. {effect}",
        "Use --unwrap (it needs the amplitude), record with a lower modulation frequency, or "
        "drop weak pixels by an amplitude filter.",
        {
            "seam_fraction": signs.seams,
            "dark_fraction": signs.dark,
            "period_m": period,
            "wrapped_fraction": share,
        },
    )


@dataclass(frozen=True)
class _WrapSigns:
    """Fractions of the pixels at seams, and of those that are near but dark."""

    seams: float
    dark: float

    @classmethod
    def of(cls, images: Sequence[RangeFrame], period: float) -> Self:
        """Count them on surfaces: pixels with too weak a signal are dark, at random ranges."""
        seams = dark = valid = with_albedo = 0
        for frame in images:
            r = frame.radial_range
            surface = _surface(frame, period)
            late, early = surface & (r > _LATE * period), surface & (r < _EARLY * period)
            for a, b in ((np.s_[:, :-2], np.s_[:, 2:]), (np.s_[:-2], np.s_[2:])):
                seams += int(np.count_nonzero((late[a] & early[b]) | (early[a] & late[b])))
            valid += len(frame)
            amplitude = frame.amplitude_image
            if amplitude is None:
                continue
            usable = frame.valid & (amplitude > 0) & (amplitude < SATURATED_AMPLITUDE)
            compensated = frame.amplitude_kind == "range_compensated"
            albedo = amplitude if compensated else amplitude * r * r
            with_albedo += int(np.count_nonzero(usable))
            if usable.any():
                near = usable & surface & (r < _NEAR * period)
                is_dark = albedo < _DARK * float(np.median(albedo[usable]))
                dark += int(np.count_nonzero(near & is_dark))
        return cls(seams / max(valid, 1), dark / max(with_albedo, 1))

    @property
    def are_many(self) -> bool:
        """Whether they are more than noise and dark materials leave."""
        return self.seams > _MAX_SEAM_FRACTION or self.dark > _MAX_DARK_FRACTION


def _surface(frame: RangeFrame, period: float) -> Bool:
    return on_surface(np.where(frame.valid, frame.radial_range, np.float32(0)), period)


def _wrapped_share(
    images: Sequence[RangeFrame], unwrapped: Sequence[RangeFrame], period: float
) -> float:
    """Return the fraction of wrapped surface that most images stay below."""
    shares = [
        float((after.depth > before.depth)[surface].mean())
        for before, after in zip(images, unwrapped, strict=True)
        if (surface := _surface(before, period)).any()
    ]
    return float(np.quantile(shares, _MINORITY_VIEWS)) if shares else 0.0
