"""Do depth, amplitude and colour show the same thing at the same pixels?"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np

from tofuse.arrays import Float32, Float64
from tofuse.inspection.finding import Finding
from tofuse.inspection.sample import Sample
from tofuse.recordings.frames import SATURATED_AMPLITUDE, RangeFrame

# Images are looked at with so many columns at most.
_COLUMNS = 160
# How one channel may lie to the other.
_TURNS: dict[str, Callable[[Float32], Float32]] = {
    "as it is": lambda a: a,
    "mirrored left to right": lambda a: a[:, ::-1],
    "mirrored upside down": lambda a: a[::-1],
    "turned by 180 degrees": lambda a: a[::-1, ::-1],
}
# Correlation of the edges of two channels, and by how many standard deviations it must lead.
_LEAST_CORRELATION, _LEAD, _SIGMAS = 0.15, 0.06, 4.0
# Shift of colour that matters, as a share of the width, and what is looked for at most.
_SHIFT, _MOST_SHIFT = 0.02, 0.12
_FEWEST = 3
# What edges of colour must reach elsewhere, by how much more than where they are, and what share of
# it they may reach there, or anywhere that many pixels beside: edges in one direction fit at many
# places.
_COLOR_FITS, _COLOR_LEAD, _COLOR_HERE = 0.42, 0.16, 0.68
_ELSEWHERE, _BESIDE_PIXELS = 0.95, 4
# How much better edges correlate beside each other if the camera moved.
_BESIDE = 0.03


def check_mirrored(sample: Sample) -> Iterator[Finding]:
    """Do the edges of depth and of amplitude (else colour) coincide, or do they when turned?"""
    for name, light_of in (("amplitude", _amplitude), ("colour", _grey)):
        pairs = [(f, light) for f in sample.images if (light := light_of(f)) is not None]
        if len(pairs) < _FEWEST:
            continue
        edges = [(_edges(_inverse(f)), _edges(light)) for f, light in pairs]
        scores = {
            turn: np.array([_correlation(d, how(a)) for d, a in edges])
            for turn, how in _TURNS.items()
        }
        now = scores.pop("as it is")
        turn, best = max(scores.items(), key=lambda item: float(item[1].mean()))
        lead = best - now
        error = float(lead.std(ddof=1)) / np.sqrt(len(lead))
        if best.mean() > _LEAST_CORRELATION and lead.mean() > max(_LEAD, _SIGMAS * error):
            yield Finding(
                "mirrored",
                f"Depth and {name} do not show the same: their edges correlate by "
                f"{best.mean():.2f} with one of them {turn}, and by {now.mean():.2f} as they are.",
                "Turn one of them, and see that the rays (x right, y down) are those of the "
                "images.",
                {"correlation": float(now.mean()), "correlation_if_turned": float(best.mean())},
            )
            return


def check_color(sample: Sample) -> Iterator[Finding]:
    """Do the edges of colour lie on those of depth?"""
    pairs = [
        (f, grey) for f in sample.images if f.color_registered and (grey := _grey(f)) is not None
    ]
    if len(pairs) < _FEWEST:
        return
    columns = min(_COLUMNS, pairs[0][0].camera.width)
    reach = round(_MOST_SHIFT * columns)
    maps = np.stack([_shifted(_edges(_inverse(f)), _edges(grey), reach) for f, grey in pairs])
    mean = maps.mean(0)
    i, j = np.unravel_index(int(mean.argmax()), mean.shape)
    lead = maps[:, i, j] - maps[:, reach, reach]
    error = float(lead.std(ddof=1)) / np.sqrt(len(lead))
    shift = float(np.hypot(i - reach, j - reach)) / columns
    down, right = np.mgrid[: mean.shape[0], : mean.shape[1]]
    elsewhere = mean[np.hypot(down - i, right - j) > _BESIDE_PIXELS].max()
    if (
        mean[i, j] < _COLOR_FITS
        or mean[reach, reach] > _COLOR_HERE * mean[i, j]
        or elsewhere > _ELSEWHERE * mean[i, j]
    ):
        return
    if shift > _SHIFT and lead.mean() > max(_COLOR_LEAD, _SIGMAS * error):
        pixels = shift * pairs[0][0].camera.width
        yield Finding(
            "color_unregistered",
            f"Colour is not registered to depth: its edges lie {pixels:.0f} pixels beside those "
            "of depth.",
            "Give the colour camera's intrinsics and T_color_depth, or leave the colour out.",
            {"shift_px": pixels, "lead": float(lead.mean())},
        )


def shifted(first: RangeFrame, second: RangeFrame) -> bool:
    """Whether the edges of one image lie beside those of the other."""
    reach = 6
    best: list[bool] = []
    for light_of in (_amplitude, _inverse):
        a, b = light_of(first), light_of(second)
        if a is None or b is None:
            continue
        found = _shifted(_edges(a), _edges(b), reach)
        best.append(bool(found.max() - found[reach, reach] > _BESIDE))
    return any(best)


def _amplitude(frame: RangeFrame) -> Float32 | None:
    light = frame.amplitude_image
    if light is None:
        return None
    return np.log1p(np.where(light < SATURATED_AMPLITUDE, light, 0)).astype(np.float32)


def _grey(frame: RangeFrame) -> Float32 | None:
    if frame.color_image is None:
        return None
    grey = cv2.cvtColor(np.ascontiguousarray(frame.color_image), cv2.COLOR_RGB2GRAY)
    return np.log1p(grey.astype(np.float32))


def _inverse(frame: RangeFrame) -> Float32:
    """Logarithm of depth; holes are filled by what is around them, as they are no edges."""
    z = np.where(frame.valid, frame.z, 0).astype(np.float32)
    known = (z > 0).astype(np.float32)
    spread = cv2.GaussianBlur(np.log(np.maximum(z, 1e-3)) * known, (0, 0), 3)
    weight = cv2.GaussianBlur(known, (0, 0), 3)
    around = spread / np.maximum(weight, 1e-6)
    return np.where(known > 0, np.log(np.maximum(z, 1e-3)), around).astype(np.float32)


def _edges(image: Float32) -> Float32:
    """Strength of the edges (h, w) of an image, made smaller, from 0 to 1."""
    columns = min(_COLUMNS, image.shape[1])
    rows = max(round(image.shape[0] * columns / image.shape[1]), 2)
    small = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), 1.0)
    strength = np.hypot(cv2.Sobel(small, cv2.CV_32F, 1, 0), cv2.Sobel(small, cv2.CV_32F, 0, 1))
    # Strong edges count alike, however strong they are.
    strong = float(np.percentile(strength, 95)) or 1.0
    return np.minimum(strength / max(strong, 1e-6), 1.0).astype(np.float32)


def _correlation(a: Float32, b: Float32) -> float:
    a, b = a - a.mean(), b - b.mean()
    size = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / size if size > 0 else 0.0


def _shifted(a: Float32, b: Float32, reach: int) -> Float64:
    """Correlations (2 reach + 1)^2 of the middle of a with b, shifted by rows and columns."""
    inner = a[reach:-reach, reach:-reach]
    return cv2.matchTemplate(b, np.ascontiguousarray(inner), cv2.TM_CCOEFF_NORMED).astype(float)
