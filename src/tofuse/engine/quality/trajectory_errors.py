"""Errors of a trajectory against a reference: absolute and relative errors, and coverage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
from tofuse.engine.times import MAX_GAP_S, associate

RPE_FRAMES = (1, 30)
# Weight of orientations in the alignment, as a spread of positions in m^2: (10 um)^2.
_ORIENTATION_WEIGHT = 1e-10


@dataclass(frozen=True)
class RelativeError:
    """Relative pose error over a number of frames (Sturm et al. 2012).

    Attributes
    ----------
    frames
        Distance between the two poses of a pair, counted in associated poses.
    pairs
        Number of pairs.
    translation_rms_m, rotation_rms_rad
        Root mean square over the pairs; NaN if there are none.
    """

    frames: int
    pairs: int
    translation_rms_m: float
    rotation_rms_rad: float

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, angles in degrees; None instead of NaN."""
        return {
            "frames": self.frames,
            "pairs": self.pairs,
            "translation_rms_m": finite_or_none(self.translation_rms_m),
            "rotation_rms_deg": finite_or_none(np.degrees(self.rotation_rms_rad)),
        }


@dataclass(frozen=True, eq=False)
class TrajectoryError:
    """Errors of an estimated trajectory against a reference.

    Attributes
    ----------
    associated
        Number of poses that were associated by time.
    coverage
        Fraction of the frames with a reference pose that have an estimated one, 0 to 1.
    ate_rms_m
        Root mean square distance of the positions after alignment, m; NaN, as all errors, if a
        single pose is associated, which any other fits.
    ate_max_m
        The largest of these distances, m.
    rotation_rms_rad
        Root mean square angle between the orientations, rad, after alignment by one rotation that
        is estimated from the orientations alone: positions hardly constrain it where a camera
        rotates in place.
    relative
        Relative pose errors over 1 and 30 frames.
    T_reference_estimate
        (4, 4) the alignment: maps the estimate's world into the reference's.
    pairs
        (A, 2) rows of the associated poses in the estimate and in the reference.
    estimated
        Number of estimated poses, associated or not.
    """

    associated: int
    coverage: float
    ate_rms_m: float
    ate_max_m: float
    rotation_rms_rad: float
    relative: tuple[RelativeError, ...]
    T_reference_estimate: Float64
    pairs: Intp
    estimated: int

    @property
    def mostly_unmatched(self) -> bool:
        """Whether most poses of both have no counterpart, as if the clocks differed."""
        return self.associated < 0.5 * self.estimated and self.coverage < 0.5

    def ate_within(self, reference_m: float) -> tuple[float, float]:
        """Return bounds of the true ATE in m, for a reference with an rms error of `reference_m`.

        The rms distance after alignment obeys the triangle inequality.
        """
        return max(self.ate_rms_m - reference_m, 0.0), self.ate_rms_m + reference_m

    def to_dict(self) -> dict[str, Any]:
        """Return the figures as plain data, angles in degrees."""
        return {
            "associated": self.associated,
            "estimated": self.estimated,
            "coverage": self.coverage,
            "ate_rms_m": finite_or_none(self.ate_rms_m),
            "ate_max_m": finite_or_none(self.ate_max_m),
            "rotation_rms_deg": finite_or_none(np.degrees(self.rotation_rms_rad)),
            "rpe": [error.to_dict() for error in self.relative],
            "T_reference_estimate": self.T_reference_estimate.tolist(),
        }


def evaluate_trajectory(
    estimate_times: ArrayLike,
    estimate: ArrayLike,
    reference_times: ArrayLike,
    reference: ArrayLike,
    frame_times: ArrayLike | None = None,
) -> TrajectoryError:
    """Compare a trajectory with a reference.

    Parameters
    ----------
    estimate_times, estimate
        (N,) s and (N, 4, 4) T_world_camera, NaN where there is none.
    reference_times, reference
        (M,) s and (M, 4, 4), in its own world frame, NaN where there is none.
    frame_times
        (F,) s of the recording's frames, if known. Coverage is then counted over the frames with
        a reference pose; else over the reference poses.

    Raises
    ------
    InputError
        If nothing can be associated.
    """
    estimate, reference = _poses(estimate, "estimate"), _poses(reference, "reference")
    pairs = associate(
        _times(estimate_times, estimate, "estimate"),
        _times(reference_times, reference, "reference"),
    )
    if len(pairs) == 0:
        raise InputError(
            f"no pose is within {MAX_GAP_S} s of a reference pose: "
            + spans(estimate_times, reference_times),
            where="timestamps",
            remedy="use trajectories of the same recording and clock, with times in seconds",
        )
    T_estimate, T_reference = estimate[pairs[:, 0]], reference[pairs[:, 1]]
    T_align = align(T_estimate, T_reference)
    errors = (T_align @ T_estimate)[:, :3, 3] - T_reference[:, :3, 3]
    distances = np.linalg.norm(errors, axis=1)
    angles = angles_between(T_estimate, T_reference)
    if len(pairs) == 1:
        distances, angles = distances * np.nan, angles * np.nan
    return TrajectoryError(
        associated=len(pairs),
        coverage=_coverage(estimate_times, estimate, reference_times, reference, frame_times),
        ate_rms_m=_rms(distances),
        ate_max_m=float(distances.max()),
        rotation_rms_rad=_rms(angles),
        relative=tuple(relative_error(T_estimate, T_reference, k) for k in RPE_FRAMES),
        T_reference_estimate=T_align,
        pairs=pairs,
        estimated=int(np.isfinite(estimate).all((1, 2)).sum()),
    )


def spans(times: ArrayLike, reference_times: ArrayLike) -> str:
    """Return in words which times (N,) and (M,), s, a trajectory and its reference span."""
    span, reference_span = (
        f"{np.min(t):.10g} to {np.max(t):.10g} s" if np.size(t) else "none"
        for t in (times, reference_times)
    )
    return f"times are {span}, those of the reference {reference_span}"


def align(estimate: ArrayLike, reference: ArrayLike, arm_m: float | None = None) -> Float64:
    """Return the rigid motion (4, 4) T_reference_estimate that aligns a trajectory with another.

    It minimises the squared distances of the positions of associated poses (N, 4, 4), without scale
    (Horn 1987; Arun et al. 1987; Umeyama 1991 with scale 1). Collinear positions leave one rotation
    unconstrained, coincident ones all: a rail, a camera rotating in place, one or two poses. There
    the orientations determine it. They always contribute, but with the weight of 10 um of spread,
    which is negligible wherever the positions constrain the rotation; or, with an arm, with the
    weight of the displacement by a rotation at this distance, m.
    """
    T_e, T_r = np.asarray(estimate, float), np.asarray(reference, float)
    centre_e, centre_r = T_e[:, :3, 3].mean(0), T_r[:, :3, 3].mean(0)
    cross_covariance = (T_r[:, :3, 3] - centre_r).T @ (T_e[:, :3, 3] - centre_e) / len(T_e)
    mean_rotation_matrix = (T_r[:, :3, :3] @ np.swapaxes(T_e[:, :3, :3], 1, 2)).mean(0)
    # The mean squared angle is half the mean squared difference of the matrices.
    weight = _ORIENTATION_WEIGHT if arm_m is None else arm_m**2 / 2
    R = se3.nearest_rotation(cross_covariance + weight * mean_rotation_matrix)
    return se3.pose(R, centre_r - R @ centre_e)


def distances_between(estimate: Float64, reference: Float64) -> Float64:
    """(N,) distances in m between positions of associated poses (N, 4, 4), after `align`."""
    aligned = align(estimate, reference) @ estimate
    return np.asarray(np.linalg.norm(aligned[:, :3, 3] - reference[:, :3, 3], axis=1), np.float64)


def angles_between(estimate: Float64, reference: Float64) -> Float64:
    """(N,) angles in rad between orientations of associated poses (N, 4, 4), after alignment."""
    R_estimate, R_reference = estimate[:, :3, :3], reference[:, :3, :3]
    R_reference_estimate = mean_rotation(R_reference @ np.swapaxes(R_estimate, 1, 2))
    return np.asarray(
        se3.angle(np.swapaxes(R_reference, 1, 2) @ (R_reference_estimate @ R_estimate)), np.float64
    )


def displacement(before: Float64, after: Float64) -> tuple[float, float]:
    """Rms differences of associated poses (N, 4, 4): positions (m), rotations (rad), aligned."""
    return _rms(distances_between(after, before)), _rms(angles_between(after, before))


def relative_error(estimate: Float64, reference: Float64, frames: int) -> RelativeError:
    """Compare the motions over `frames` poses of two associated trajectories (N, 4, 4)."""
    if len(estimate) <= frames:
        return RelativeError(frames, 0, np.nan, np.nan)
    motion_e = se3.inverse(estimate[:-frames]) @ estimate[frames:]
    motion_r = se3.inverse(reference[:-frames]) @ reference[frames:]
    error = se3.inverse(motion_r) @ motion_e
    translation = np.linalg.norm(error[:, :3, 3], axis=1)
    return RelativeError(frames, len(error), _rms(translation), _rms(se3.angle(error)))


def mean_rotation(rotations: Float64) -> Float64:
    """Return the rotation (3, 3) nearest to the mean of rotations (N, 3, 3) (chordal mean)."""
    return se3.nearest_rotation(rotations.mean(0))


def _coverage(
    estimate_times: ArrayLike,
    estimate: Float64,
    reference_times: ArrayLike,
    reference: Float64,
    frame_times: ArrayLike | None,
) -> float:
    times_e = _times(estimate_times, estimate, "estimate")
    times_r = _times(reference_times, reference, "reference")
    if frame_times is None:
        expected = times_r[np.isfinite(times_r)]
    else:
        frames = np.asarray(frame_times, float)
        expected = frames[associate(frames, times_r)[:, 0]]
    return len(associate(expected, times_e)) / len(expected) if len(expected) else 0.0


def _poses(poses: ArrayLike, name: str) -> Float64:
    T = np.asarray(poses, float)
    if T.ndim != 3 or T.shape[1:] != (4, 4):
        raise InputError(f"has shape {T.shape}", where=name, remedy="pass (N, 4, 4) poses")
    return T


def _times(times: ArrayLike, poses: Float64, name: str) -> Float64:
    """Times of the poses, NaN where there is no pose."""
    t = np.asarray(times, float)
    if t.shape != (len(poses),):
        raise InputError(
            f"has {t.size} times for {quantities.count(len(poses), 'pose')}",
            where=name,
            remedy="pass one per pose",
        )
    return np.where(np.isfinite(poses).all((1, 2)), t, np.nan)


def _rms(values: Float64) -> float:
    return float(np.sqrt(np.mean(values * values)))


def finite_or_none(value: float) -> float | None:
    """Return a number for JSON, which has no NaN."""
    return float(value) if np.isfinite(value) else None
