"""A registration as text, for the report and the terminal."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tofuse.apps.pairs.result import PairResult
from tofuse.engine.alignment import Registration
from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.engine.quantities import percent, probability

_MIN_AXIS_COSINE = 0.985  # minimum cosine to an axis for a direction to be named after it
_SMALL_RAD = 1e-6
_LARGE_M = 100.0  # more than what cameras scan, and less than things of a decimetre in mm


def decision(result: PairResult) -> tuple[str, str]:
    """Return whether the pose is accepted, and the remainder of the sentence."""
    registration = result.registration
    parts = []
    if registration.probability is not None:
        parts.append(f"probability {probability(registration.probability)}")
    if registration.believed:
        if registration.given_guess:
            near = "identity" if result.guess is None else "guess"
            rival = "none was tried" if registration.runner_up is None else "one fits as well"
            parts.append(f"given the {near}: of other poses {rival}")
        return "Accepted", "; ".join(parts)
    parts += [text] if (text := doubt(registration)) else []
    return "Not verified" if registration.believed is None else "Rejected", "; ".join(parts)


def doubt(registration: Registration) -> str:
    """Return why a pose is not accepted, and what would decide."""
    reason = registration.reason
    if registration.believed is None:
        reason = reason or "the method can't verify its result"
    remedy = f"{registration.remedy} would decide" if registration.remedy else ""
    return "; ".join(text for text in (reason, remedy) if text)


def lines(result: PairResult) -> list[tuple[str, str]]:
    """Return name and value of each property of the pose; values may have several lines."""
    t = result.T_target_source[:3, 3]
    translation = f"{vector(t, 4)} m, length {np.linalg.norm(t):.4f} m"
    center = result.source.frame.shift
    if center.any():
        displacement = f"displacement {vector(result.moved_m, 4)} m"
        translation += f"\n{displacement} at {vector(center, 0)}, the source's centre"
    rms_m = result.registration.rms_m
    found = [
        *scale(result.registration),
        ("translation", translation),
        ("rotation", rotation(result)),
        ("T_target_source", matrix(result)),
        ("overlap", overlap(result)),
        ("rms distance", f"{1000 * rms_m:.2f} mm" if np.isfinite(rms_m) else "unknown"),
    ]
    note = "1\N{GREEK SMALL LETTER SIGMA}, worst observable direction"
    if result.registration.believed is None:
        note += "; from point noise only, usually too small"
    found.append(("sigma", f"{sigma(result)} ({note})"))
    extent = np.linalg.norm(np.ptp(result.source.frame.points, axis=0))
    if extent > _LARGE_M:
        doubtful = f"m, by which the source extends over {extent:.0f} m"
        found.append(("unit", f"{doubtful}; if the files are in mm, all lengths are thousandths"))
    if free := unobservable(result):
        found.append(("unobservable", f"{free} (axes of the source)"))
    if rival := runner_up(result):
        found.append(("runner-up", rival))
    return found


def scale(registration: Registration) -> list[tuple[str, str]]:
    """Return name and value of the scale; nothing if it was neither estimated nor given."""
    sigma = registration.scale_sigma
    if sigma is None:
        return []
    factor = f"{registration.scale:.5g} \N{PLUS-MINUS SIGN} {sigma:.1g}"
    known = f"{factor} (1\N{GREEK SMALL LETTER SIGMA})" if sigma else f"{registration.scale:.9g}"
    return [("scale", f"{known}, factor of the source's points")]


def rotation(result: PairResult) -> str:
    """Return the rotation as text: angle and axis."""
    w = se3.so3_log(result.T_target_source[:3, :3])
    angle = float(np.linalg.norm(w))
    if angle < _SMALL_RAD:
        return "0.000\N{DEGREE SIGN}"
    return f"{np.degrees(angle):.3f}\N{DEGREE SIGN} about {vector(w / angle, 3)}"


def matrix(result: PairResult) -> str:
    """Return T_target_source as text, a line a row."""
    T = result.T_target_source
    width = max(len(f"{value:.6f}") for value in T[:3, 3])
    return "\n".join(
        " ".join(f"{v:12.9f}" for v in row[:3]) + f"  {row[3]:{width}.6f}" for row in T
    )


def overlap(result: PairResult) -> str:
    """Return overlap, support and contradiction as text, as far as the method provides them."""
    registration = result.registration
    parts = []
    if registration.overlap is not None:
        parts.append(f"{percent(registration.overlap)} of the points overlap")
    if registration.support is not None:
        parts.append(f"{percent(registration.support)} support the pose")
    if registration.contradiction is not None:
        parts.append(f"{percent(registration.contradiction)} contradict it")
    if not parts:
        return f"{percent(registration.inlier_ratio)} of the source's points have a correspondence"
    return ", ".join(parts)


def sigma(result: PairResult) -> str:
    """Return one standard deviation in the worst observable direction as text."""
    metres, radians = result.registration.sigma
    parts = []
    if metres is not None:
        parts.append(f"{1000 * metres:.2f} mm")
    if radians is not None:
        parts.append(f"{np.degrees(radians):.3f}\N{DEGREE SIGN}")
    return ", ".join(parts) or "unknown"


def unobservable(result: PairResult) -> str:
    """Return the unobservable motions as text, in the axes of the source; empty if none."""
    translations, rotations = result.free_motions
    parts = []
    if len(translations):
        parts.append(f"sliding {_directions(translations, 'along', 'in any direction')}")
    if len(rotations):
        parts.append(f"turning {_directions(rotations, 'about', 'about any axis')}")
    return " and ".join(parts)


def runner_up(result: PairResult) -> str:
    """Return the distance and the margin of the best rival pose as text; empty without one."""
    parts = []
    distance = result.runner_up_distance
    if distance is None and result.registration.margin is not None:
        return "no other pose fits"
    if distance is not None:
        metres, angle = distance
        parts.append(f"{metres:.3f} m and {np.degrees(angle):.1f}\N{DEGREE SIGN} away")
    if result.registration.margin is not None:
        margin = result.registration.margin
        parts.append(
            f"fits {percent(abs(margin))} {'more' if margin < 0 else 'fewer'} of the points"
        )
    return ", ".join(parts)


def vector(values: ArrayLike, digits: int) -> str:
    """Return three numbers in brackets as text."""
    rounded = np.round(np.asarray(values, float), digits) + 0.0
    return "(" + ", ".join(f"{value:.{digits}f}" for value in rounded) + ")"


def _directions(axes: Float64, preposition: str, unrestricted: str) -> str:
    """The span of axes (k, 3) as text."""
    if len(axes) >= 3:
        return unrestricted
    if len(axes) == 2:
        return f"{unrestricted} perpendicular to {_axis_name(np.cross(*axes))}"
    return f"{preposition} {_axis_name(axes[0])}"


def _axis_name(axis: Float64) -> str:
    """The name of the source's axis that a direction is close to, else its components."""
    axis = axis / max(float(np.linalg.norm(axis)), 1e-12)
    k = int(np.abs(axis).argmax())
    if abs(axis[k]) > _MIN_AXIS_COSINE:
        return f"{'xyz'[k]}"
    return vector(axis * np.sign(axis[k]), 2)
