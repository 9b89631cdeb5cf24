"""Wrong poses of a result, whether they are marked as uncertain, and wrong joins.

Definitions, for poses in a common frame (a *part*: the main component with all components joined to
it, or a separate component), compared with true poses:

- A part is aligned to the ground truth by one rigid motion: among the motions that align one of its
  frames exactly, the one with the most right frames, then the mean over those. A part that broke in
  two is thus aligned to its larger piece, not to a compromise. As covariances are relative to the
  first frame, the alignment to the piece with the first frame is tried as well, and the one with
  fewer unmarked wrong poses is used: statements about the later piece then cover the break. The
  strict count uses the larger piece only.
- A pose is *wrong* if its error is then above 5 cm or 3 degrees.
- It is *marked* if its frame is not `tracked`; or the error is within three sigma of the frame's
  covariance; or the error without the frame's unobservable directions is not wrong; or a reason of
  the run names the frame.
- Two frames are tied if their relative pose is accurate to 5 cm and 3 degrees. Connected components
  of ties are *sides*, which drift does not break. A *join is wrong* if two sides of three or more
  frames of one part are displaced against each other by more than 20 cm or 10 degrees (median over
  pairs of frames).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components

from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.geometry import se3
from tofuse.engine.quality.trajectory_errors import mean_rotation

MAX_ERROR_M, MAX_ERROR_RAD = 0.05, np.radians(3.0)
JOIN_M, JOIN_RAD = 0.20, np.radians(10.0)
SIGMAS = 3.0
SMALLEST_SIDE = 3


@dataclass(frozen=True, eq=False)
class Part:
    """Poses of a result in a common frame.

    Attributes
    ----------
    poses
        (N, 4, 4) T_world_camera by position in the recording, NaN if missing.
    records
        Records of the frames in the result, by position; None if missing.
    reasons
        Reasons of the run that the part belongs to.
    by_motion
        Whether a component was joined to it by motion alone.
    """

    poses: Float64
    records: tuple[Any, ...]
    reasons: tuple[Any, ...] = ()
    by_motion: bool = False

    @property
    def posed(self) -> Bool:
        """(N,) mask of the frames with a pose."""
        return np.isfinite(self.poses).all((1, 2))


@dataclass(frozen=True)
class Score:
    """Counts of one run.

    Attributes
    ----------
    frames
        Readable frames.
    main
        Frames with a pose in the main component.
    overlapping, covered
        Frames that overlap others, and those of them in the same part as their group.
    wrong, unmarked
        Wrong poses of all parts, and those that are not marked.
    unmarked_strict
        Unmarked wrong poses if parts are aligned to their larger piece only.
    by_reason
        Wrong poses that are marked by a reason only.
    joins, joins_by_motion
        Wrong joins, and those in parts with components joined by motion alone.
    ate_m
        Rms distance of the main component's positions after the alignment; NaN without poses.
    """

    frames: int
    main: int
    overlapping: int
    covered: int
    wrong: int
    unmarked: int
    unmarked_strict: int
    by_reason: int
    joins: int
    joins_by_motion: int
    ate_m: float


@dataclass(frozen=True)
class Tolerance:
    """Largest errors of a right pose. Inexact references add their own."""

    max_m: float = MAX_ERROR_M
    max_rad: float = MAX_ERROR_RAD
    join_m: float = JOIN_M
    join_rad: float = JOIN_RAD

    def widened(self, reference_m: float, reference_rad: float) -> Tolerance:
        """Return the tolerance for an inexact reference."""
        return Tolerance(
            self.max_m + reference_m,
            self.max_rad + reference_rad,
            self.join_m + reference_m,
            self.join_rad + reference_rad,
        )


def parts_of(result: Any, indices: Iterable[int]) -> list[Part]:
    """Return the main component, with all components joined to it, and the separate components.

    Results without components have one part.

    Parameters
    ----------
    result
        A `Reconstruction`.
    indices
        `Frame.index` of the recording's frames, in order.
    """
    position = {int(index): k for k, index in enumerate(indices)}
    components = tuple(getattr(result, "components", ()) or ())
    by_motion = any(getattr(c, "joined", None) == "motion" for c in components[1:])
    found = [_part(result, position, by_motion=by_motion)]
    for component in components[1:]:
        own = getattr(component, "result", None)
        if own is not None and getattr(component, "T_main_component", None) is None:
            found.append(_part(own, position, ranges(component.frames)))
    return found


def _part(
    result: Any,
    position: dict[int, int],
    frames: list[tuple[int, int]] | None = None,
    *,
    by_motion: bool = False,
) -> Part:
    poses = np.full((len(position), 4, 4), np.nan)
    records: list[Any] = [None] * len(position)
    indices = [int(record.index) for record in result.diagnostics.frames]
    if frames is not None:
        members = [k for a, b in frames for k in range(a, b + 1)]
        # A separate result may count its frames from its first one.
        if not set(indices) <= set(members) and len(indices) == len(members):
            indices = members
    for k, index in enumerate(indices):
        at = position.get(index)
        if at is not None:
            poses[at], records[at] = result.trajectory[k], result.diagnostics.frames[k]
    return Part(poses, tuple(records), tuple(result.diagnostics.reasons), by_motion)


def ranges(frames: Any) -> list[tuple[int, int]]:
    """Return (first, last) ranges, of one range or of several."""
    found = np.asarray(frames, int).reshape(-1, 2)
    return [(int(a), int(b)) for a, b in found]


def relative_errors(estimate: Float64, truth: Float64) -> tuple[Float64, Float64]:
    """Errors (N, N) in m and rad of pose j if pose i is aligned exactly."""
    n = len(estimate)
    T_truth_world = truth @ se3.inverse(estimate)
    T_camera_truth = se3.inverse(truth)
    metres, radians = np.empty((n, n)), np.empty((n, n))
    for i in range(n):
        error = T_camera_truth @ (T_truth_world[i] @ estimate)
        metres[i] = np.linalg.norm(error[:, :3, 3], axis=1)
        radians[i] = se3.angle(error)
    return metres, radians


def aligned(
    estimate: Float64, truth: Float64, tolerance: Tolerance, *, to_first: bool = False
) -> Float64:
    """Motion (4, 4) that maps the estimate's world into that of the truth; see the top.

    `to_first` selects the alignment to the piece with the first frame.
    """
    metres, radians = relative_errors(estimate, truth)
    right = (metres <= tolerance.max_m) & (radians <= tolerance.max_rad)
    count = right.sum(1)
    spread = np.where(right, metres, 0).sum(1) / np.maximum(count, 1)
    tried = np.flatnonzero(right[0]) if to_first else np.arange(len(estimate))
    best = min(tried, key=lambda i: (-count[i], spread[i], i))
    T = truth[right[best]] @ se3.inverse(estimate[right[best]])
    out = se3.pose(mean_rotation(T[:, :3, :3]))
    # Average over camera positions, not over positions of the world origin.
    centre = estimate[right[best]][:, :3, 3].mean(0)
    out[:3, 3] = truth[right[best]][:, :3, 3].mean(0) - out[:3, :3] @ centre
    return out


def errors(
    estimate: Float64, truth: Float64, tolerance: Tolerance, *, to_first: bool = False
) -> Float64:
    """Errors (N, 6) of poses after the alignment: twists in the camera's frame, m and rad."""
    T = aligned(estimate, truth, tolerance, to_first=to_first)
    return se3.log(se3.inverse(truth) @ T @ estimate)


def too_far(error: Float64, tolerance: Tolerance) -> Bool:
    """Whether errors (..., 6) are beyond the tolerance."""
    metres = np.linalg.norm(error[..., :3], axis=-1)
    radians = np.linalg.norm(error[..., 3:], axis=-1)
    found: Bool = (metres > tolerance.max_m) | (radians > tolerance.max_rad)
    return found


def within_covariance(covariance: Float64 | None, error: Float64) -> bool:
    """Whether an error (6,) is within three sigma of a covariance (6, 6), by block."""
    if covariance is None or not np.isfinite(covariance).all():
        return False
    for k in (slice(0, 3), slice(3, 6)):
        sigma = np.sqrt(max(np.linalg.eigvalsh(covariance[k, k])[-1], 0.0))
        if np.linalg.norm(error[k]) > SIGMAS * sigma:
            return False
    return True


def seen_part(error: Float64, unobservable: Float64, tolerance: Tolerance) -> Float64:
    """Return an error (6,) without its components in directions (K, 6).

    Metres and radians are first scaled by the tolerance.
    """
    if len(unobservable) == 0:
        return error
    scale = np.repeat([tolerance.max_m, tolerance.max_rad], 3)
    directions, _ = np.linalg.qr((np.asarray(unobservable, float) / scale).T)
    scaled = error / scale
    return (scaled - directions @ (directions.T @ scaled)) * scale


def named(reasons: Iterable[Any], index: int) -> bool:
    """Whether any reason names a frame."""
    return any(a <= index <= b for reason in reasons for a, b in ranges(reason.frames))


def marks(part: Part, k: int, error: Float64, tolerance: Tolerance) -> set[str]:
    """Return what marks the pose of the frame at position k with error (6,)."""
    record = part.records[k]
    found = set()
    if record.status != "tracked":
        found.add("status")
    if within_covariance(record.covariance, error):
        found.add("covariance")
    if not too_far(seen_part(error, record.unobservable, tolerance), tolerance):
        found.add("unobservable")
    if named(part.reasons, record.index):
        found.add("reason")
    return found


def sides(estimate: Float64, truth: Float64, tolerance: Tolerance) -> Intp:
    """Label (N,) of the side of each pose."""
    metres, radians = relative_errors(estimate, truth)
    tied = (metres <= tolerance.max_m) & (radians <= tolerance.max_rad)
    _, label = connected_components(tied | tied.T, directed=False)
    return label.astype(np.intp)


def wrong_joins(estimate: Float64, truth: Float64, tolerance: Tolerance) -> int:
    """Count the sides that are wrongly joined to the largest one, or to another."""
    label = sides(estimate, truth, tolerance)
    large = [s for s in np.unique(label) if (label == s).sum() >= SMALLEST_SIDE]
    if len(large) < 2:
        return 0
    metres, radians = relative_errors(estimate, truth)
    apart = np.zeros((len(large), len(large)), bool)
    for i, a in enumerate(large):
        for j, b in enumerate(large):
            between = np.ix_(label == a, label == b)
            apart[i, j] = (
                np.median(metres[between]) > tolerance.join_m
                or np.median(radians[between]) > tolerance.join_rad
            )
    groups, _ = connected_components(~(apart | apart.T), directed=False)
    return int(groups) - 1


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth or reference of a recording.

    Attributes
    ----------
    poses
        (N, 4, 4) true T_world_camera, NaN if unknown. Places without a connection lie far apart.
    groups
        (N,) index of the group of connectable frames; -1: not connectable.
    """

    poses: Float64
    groups: Intp
    tolerance: Tolerance = field(default_factory=Tolerance)


def score(parts: list[Part], truth: Truth) -> Score:
    """Compare the parts of a result with the truth."""
    known = np.isfinite(truth.poses).all((1, 2))
    wrong = unmarked = strict = by_reason = joins = by_motion = 0
    ate = np.nan
    for number, part in enumerate(parts):
        at = np.flatnonzero(part.posed & known)
        if len(at) == 0:
            continue
        estimate, reference = part.poses[at], truth.poses[at]
        tried = []
        for to_first in (False, True):
            error = errors(estimate, reference, truth.tolerance, to_first=to_first)
            far = np.flatnonzero(too_far(error, truth.tolerance))
            found = [marks(part, int(at[k]), error[k], truth.tolerance) for k in far]
            bare = sum(not marked for marked in found)
            tried.append((bare, len(far), sum(marked == {"reason"} for marked in found), error))
        strict += tried[0][0]
        bare, far_count, alone, error = min(tried, key=lambda one: one[:2])
        unmarked, wrong, by_reason = unmarked + bare, wrong + far_count, by_reason + alone
        if number == 0:
            ate = float(np.sqrt((error[:, :3] ** 2).sum(1).mean()))
        count = wrong_joins(estimate, reference, truth.tolerance)
        joins += count
        by_motion += count if part.by_motion else 0
    covered = 0
    for group in np.unique(truth.groups[truth.groups >= 0]):
        members = truth.groups == group
        covered += max(int((members & part.posed).sum()) for part in parts)
    return Score(
        frames=len(truth.poses),
        main=int(parts[0].posed.sum()),
        overlapping=int((truth.groups >= 0).sum()),
        covered=covered,
        wrong=wrong,
        unmarked=unmarked,
        unmarked_strict=strict,
        by_reason=by_reason,
        joins=joins,
        joins_by_motion=by_motion,
        ate_m=ate,
    )


def roc_area(score: Float64, positive: Bool) -> float:
    """Area under the ROC curve: fraction of positive-negative pairs in the right order."""
    a, b = score[positive][:, None], score[~positive][None]
    return float(((a > b) + 0.5 * (a == b)).mean()) if a.size and b.size else float("nan")
