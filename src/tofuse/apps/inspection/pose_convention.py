"""Checks of poses: their convention, and their scale relative to the depth or to a reference."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from tofuse.apps.inspection.finding import Finding, is_significant
from tofuse.apps.inspection.sample import Pair, Sample, prepare
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import UnreadableFrameError
from tofuse.engine.frames import RangeFrame, Recording
from tofuse.engine.geometry import quaternion, se3
from tofuse.engine.quality import trajectory_errors
from tofuse.formats.poses import OPENGL

# Minimum decrease of the error by another convention, rad and in standard errors; and the largest
# remaining one, as a fraction: with another wrong convention, some motions fit too. All within this
# factor of the best one are named, as about one axis some are the same.
_MIN_LEAD, _MIN_LEAD_SIGMAS, _MAX_REMAINING, _EQUAL = np.radians(1.5), 4.0, 0.35, 1.5
# Largest remaining difference of whole trajectories, rad: twice a large drift, and half of what
# remains by chance between unrelated ones in their best convention.
_MAX_DIFFERENCE = 0.2
_ROUNDING = 1e-4  # rad, of poses in text files with few digits
# Shortest distance from which the scale is estimated, as a fraction of the depth, and cosine of its
# directions; largest factor that is not reported: devices err by less; and within which of a unit's
# that unit is named.
_MIN_DISTANCE, _MIN_COSINE, _MAX_FACTOR, _MIN_FIT = 0.015, 0.9, 1.3, 1.2
# Of another scale are trajectories of the same shape up to this fraction of the extent, as slides
# along a corridor are shorter, too; from this factor on it is a unit in any case.
_MAX_SHAPE_ERROR, _MIN_UNIT = 0.1, 30.0
_UNITS = {"mm": 1000.0, "cm": 100.0, "inches": 39.37, "feet": 3.281}
# If depth were wrong by these factors, its median would show it.
_IMPLAUSIBLE_FOR_DEPTH = ("mm", "cm")
_MIN_PAIRS, _VIEWS = 3, 8
# Rotation between two views, rad, that shows the convention, and within which views overlap; and
# the number of frames among which it is sought.
_TURN, _MIN_TURN, _MAX_TURN, _MAX_STRIDE = 0.1, 0.03, 0.25, 60
# R_robot_camera: a robot has x forward, y left and z up.
_ROBOT = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_UNITY = np.diag([1.0, -1.0, 1.0, 1.0])


def _times(T_given_camera: Float64) -> Callable[[Float64], Float64]:
    return lambda poses: np.asarray(poses @ T_given_camera)


def _reordered(shift: int) -> Callable[[Float64], Float64]:
    """Return the poses whose quaternions (x, y, z, w) are shifted by one number."""

    def convert(T: Float64) -> Float64:
        out = T.copy()
        known = np.isfinite(T).all((1, 2))
        q = np.roll(quaternion.from_matrix(T[known, :3, :3]), shift, -1)
        out[known, :3, :3] = quaternion.to_matrix(q)
        return out

    return convert


# What poses may be, and the function to T_world_camera.
_CONVENTIONS: dict[str, Callable[[Float64], Float64]] = {
    "T_camera_world, the inverse": se3.inverse,
    "poses of a camera with the axes of OpenGL (y up, z backwards)": _times(OPENGL),
    "T_camera_world of a camera with the axes of OpenGL (y up, z backwards)": (
        lambda poses: np.asarray(se3.inverse(poses) @ OPENGL)
    ),
    "poses of a body with the axes of a robot (x forward, z up)": _times(_ROBOT),
    "poses with the left-handed axes of Unity (y up, z forward)": (
        lambda poses: np.asarray(_UNITY @ poses @ _UNITY)
    ),
    "poses with quaternions in the order w, x, y, z": _reordered(-1),
    "poses with quaternions in the order x, y, z, w": _reordered(1),
    **{
        f"poses of a camera that is turned by {90 * k} degrees about its viewing axis": (
            _times(se3.exp(np.array([0, 0, 0, 0, 0, k * np.pi / 2])))
        )
        for k in (1, 2, 3)
    },
}


def check_poses(sample: Sample) -> Iterator[Finding]:
    """Check the poses that come with the recording, if any, against aligned views."""
    poses = sample.recording.reference
    if poses is not None and not sample.turning:
        yield from misread_poses(sample, poses)


def convention_of(recording: Recording, poses: Float64) -> Finding | None:
    """Return in what other convention poses (N, 4, 4) of a recording fit it, if they do."""
    return next(misread_poses(Sample.of(recording, _VIEWS), poses), None)


def difference(estimate: Float64, reference: Float64) -> str | None:
    """Return what explains most of the difference of associated poses (N, 4, 4), if anything does.

    That is another convention, or another scale, of one of the two trajectories.
    """
    if len(estimate) <= _MIN_PAIRS:
        return None
    as_read = _errors(estimate, reference)
    converted = {
        name: {
            "the estimate": _errors(convert(estimate), reference),
            "the reference": _errors(estimate, convert(reference)),
        }
        for name, convert in _CONVENTIONS.items()
    }
    best = min(float(error.mean()) for sides in converted.values() for error in sides.values())
    if as_read.mean() > _MIN_LEAD + best and best <= min(
        _MAX_REMAINING * as_read.mean(), _MAX_DIFFERENCE
    ):
        ifs = []
        for name, sides in converted.items():
            fit = [
                side for side, error in sides.items() if error.mean() <= _EQUAL * best + _ROUNDING
            ]
            ifs += [f"{' or '.join(fit)} holds {name}"] if fit else []
        return (
            f"the poses differ by {np.degrees(as_read.mean()):.1f} degrees as they are read, and "
            f"by {np.degrees(best):.1f} if {', or '.join(ifs)}"
        )
    aligned = trajectory_errors.align(estimate, reference) @ estimate
    t, t_reference = (T[:, :3, 3] - T[:, :3, 3].mean(0) for T in (aligned, reference))
    product, squared = float((t * t_reference).sum()), float((t * t).sum())
    if product <= _MIN_COSINE * np.sqrt(squared * (t_reference * t_reference).sum()):
        return None
    scale = product / squared
    remaining = np.linalg.norm(t_reference - scale * t), np.linalg.norm(t_reference - t)
    factor, larger = max((1 / scale, "estimate"), (scale, "reference"))
    has_shape = remaining[0] <= _MAX_SHAPE_ERROR * np.linalg.norm(t_reference)
    shown = f"{factor:.3g}" if factor > 1.05 else f"{factor:.4g}"
    if remaining[0] > _MAX_REMAINING * remaining[1] or not (has_shape or factor > _MIN_UNIT):
        return None
    if shown == "1":  # equal trajectories differ by rounding
        return None
    unit = next((u for u, f in _UNITS.items() if 1 / _MIN_FIT < factor / f < _MIN_FIT), None)
    return (
        f"the {larger} is {shown} times as large as the other trajectory"
        + (f", as if it were in {unit}" if unit else "")
        + f": in the same scale the ATE would be {remaining[0] / np.sqrt(len(t)):.4f} m"
    )


def _errors(estimate: Float64, reference: Float64) -> Float64:
    """(N,) differences of associated poses in the best scale, rad.

    Positions count relative to the spread of the reference, or to 1 m if that is less.
    """
    spread, arm = (
        float(np.linalg.norm(T[:, :3, 3] - T[:, :3, 3].mean(0), axis=1).max())
        for T in (estimate, reference)
    )
    scaled = estimate.copy()
    scaled[:, :3, 3] *= arm / spread if spread > 0 else 1.0
    arm = max(arm, 1.0)
    error = se3.inverse(trajectory_errors.align(scaled, reference, arm) @ scaled) @ reference
    return np.hypot(se3.angle(error), np.linalg.norm(error[:, :3, 3], axis=1) / arm)


def _turned_frame(recording: Recording, poses: Float64, k: int) -> RangeFrame | None:
    """Return the later frame with the best rotation to frame k, which is one in all conventions."""
    angle = se3.angle(se3.inverse(poses[k]) @ poses[k + 1 : k + 1 + _MAX_STRIDE])
    usable = np.flatnonzero((angle > _MIN_TURN) & (angle < _MAX_TURN))
    if not len(usable):
        return None
    try:
        frame = recording[k + 1 + int(usable[np.abs(angle[usable] - _TURN).argmin()])]
    except UnreadableFrameError:
        return None
    return frame if isinstance(frame, RangeFrame) and frame.valid.any() else None


def misread_poses(sample: Sample, poses: Float64) -> Iterator[Finding]:
    """Check poses (N, 4, 4) of the frames of a sampled recording, NaN where there is none."""
    row = {index: k for k, index in enumerate(sample.recording.indices.tolist())}
    pairs = []
    for view in sample.views.values():
        other = _turned_frame(sample.recording, poses, row[view.index])
        if other is not None:
            pair = Pair.of(view, prepare(other))
            # Along a wall a view may lie anywhere.
            if pair.fits and not len(pair.alignment.unobservable):
                pairs.append((row[view.index], row[other.index], pair))
    if len(pairs) < _MIN_PAIRS:
        return
    first, second = (np.array([p[k] for p in pairs]) for k in (0, 1))
    measured = np.array([p.alignment.T_world_source for _, _, p in pairs])

    depth = np.array([p.first.depth for _, _, p in pairs])

    def between(T: Float64) -> Float64:
        return np.asarray(se3.inverse(T[first]) @ T[second])

    def errors(T: Float64) -> Float64:
        """Motion of the image by the error, rad, in the best scale."""
        t, t_measured = between(T)[:, :3, 3], measured[:, :3, 3]
        weight = depth**-2.0
        scale = (weight * (t * t_measured).sum(1)).sum() / max(
            (weight * (t * t).sum(1)).sum(), 1e-12
        )
        shift = np.linalg.norm(t_measured - max(scale, 0.0) * t, axis=1) / depth
        return np.hypot(se3.angle(se3.inverse(measured) @ between(T)), shift)

    as_read = errors(poses)
    found = {name: errors(convert(poses)) for name, convert in _CONVENTIONS.items()}
    best = min(found.values(), key=lambda error: float(error.mean()))
    is_clear = best.mean() <= _MAX_REMAINING * as_read.mean()
    if is_clear and is_significant(as_read - best, _MIN_LEAD, _MIN_LEAD_SIGMAS):
        names = [name for name, error in found.items() if error.mean() <= _EQUAL * best.mean()]
        yield Finding(
            "poses_misread",
            f"The poses fit the images if they are {', or '.join(names)}: views are off by "
            f"{np.degrees(best.mean()):.1f} degrees then, and by {np.degrees(as_read.mean()):.1f} "
            "as they are read.",
            "Convert them to T_world_camera with x right, y down and z forward.",
            {
                "error_deg": float(np.degrees(as_read.mean())),
                "error_if_converted_deg": float(np.degrees(best.mean())),
            },
        )
        return
    t_measured, t_given = measured[:, :3, 3], between(poses)[:, :3, 3]
    distances, given = (np.linalg.norm(t, axis=1) for t in (t_measured, t_given))
    # A scale does not change the direction.
    agrees = (t_measured * t_given).sum(1) > _MIN_COSINE * distances * given
    moves = (distances > _MIN_DISTANCE * depth) & agrees
    if moves.sum() < _MIN_PAIRS:
        return
    ratio = np.log(given[moves] / distances[moves])
    factor = float(np.exp(np.median(ratio)))
    if not is_significant(np.sign(np.log(factor)) * ratio, np.log(_MAX_FACTOR), _MIN_LEAD_SIGMAS):
        return
    unit = next((u for u, f in _UNITS.items() if 1 / _MIN_FIT < factor / f < _MIN_FIT), None)
    apart = f"The poses are {factor:.2g} times as far apart as the images show"
    if unit in _IMPLAUSIBLE_FOR_DEPTH:
        remedy = "Write their positions in metres."
        yield Finding("poses_misread", f"{apart}: they are in {unit}.", remedy, {"factor": factor})
        return
    sigma = factor * float(ratio.std(ddof=1) / np.sqrt(len(ratio)))
    wrong = f"{1 / factor:.2g} times too large" if factor < 1 else f"{factor:.2g} times too small"
    stated = sample.recording.metadata.get("depth_unit_m")
    yield Finding(
        "depth_scale",
        f"{apart}: either the depth is {wrong}, or "
        + (f"they are in {unit}." if unit else "their positions are not in metres."),
        f"If the poses are right, multiply the depth by {factor:.3g} (sigma {sigma:.1g})"
        + (f" (depth_unit_m: {stated * factor:.3g})" if isinstance(stated, float) else "")
        + "; else scale their positions.",
        {"factor": factor, "sigma": sigma},
    )
