"""Which poses of a result are wrong, which of those are marked as doubtful, and what was joined.

Definitions, for poses that are given in one common frame (a *part*: the main component with all
that is joined to it, or a component of its own), against true poses:

- The part is aligned to the truth by one rigid motion: of the motions that put one of its frames
  exactly right, that with which most frames are right, then the mean over those. So a part that
  broke in two is aligned to its larger piece, not to something between. As covariances are relative
  to the first frame, the motion that fits the piece with the first frame is tried as well, and the
  one with fewer unmarked wrong poses counts: what is said of the later piece covers the break.
  The stricter count, with the larger piece alone, is given beside it.
- A pose is *wrong* if it is then off by more than 5 cm or 3 degrees.
- It is *marked* if its frame is not called tracked; or the error is within three sigma of the
  covariance that the frame states; or what is left of the error without the directions that the
  frame calls unobservable is no longer wrong; or a reason of the run names its frame.
- Frames are tied where their relative pose is off by no more than 5 cm and 3 degrees, and what
  hangs together by ties is a *side*, which drift does not break. A *join is wrong* where two sides
  of three or more frames of one part are off against each other by more than 20 cm or 10 degrees
  (median over pairs of frames).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components

from tofuse.arrays import Bool, Float64, Intp
from tofuse.evaluation.trajectory import mean_rotation
from tofuse.geometry import se3

OFF_M, OFF_RAD = 0.05, np.radians(3.0)
JOIN_M, JOIN_RAD = 0.20, np.radians(10.0)
SIGMAS = 3.0
SMALLEST_SIDE = 3


@dataclass(frozen=True, eq=False)
class Part:
    """Poses that a result gives in one common frame.

    Attributes
    ----------
    poses
        (N, 4, 4) T_world_camera by position in the recording, NaN where it has none.
    records
        What the result says of the frames, by position; None where nothing.
    reasons
        Those of the run that the part is of.
    by_motion
        Whether something was joined to it by motion alone.
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
        Those with a pose in the main component.
    overlapping, covered
        Frames that overlap others, and those of them that are in one part with their group.
    wrong, unmarked
        Wrong poses of all parts, and those that nothing marks.
    unmarked_strict
        Those that nothing marks where parts are aligned to their larger piece alone.
    by_reason
        Wrong poses that only a reason of the run marks.
    joins, joins_by_motion
        Wrong joins, and those of parts in which something was joined by motion alone.
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
    """What is wrong: beyond `off_m` or `off_rad`. References that are not exact add their own."""

    off_m: float = OFF_M
    off_rad: float = OFF_RAD
    join_m: float = JOIN_M
    join_rad: float = JOIN_RAD

    def beside(self, reference_m: float, reference_rad: float) -> Tolerance:
        """Return the tolerance for a reference that may be off itself."""
        return Tolerance(
            self.off_m + reference_m,
            self.off_rad + reference_rad,
            self.join_m + reference_m,
            self.join_rad + reference_rad,
        )


def parts_of(result: Any, indices: Iterable[int]) -> list[Part]:
    """Return the main component, with all that is joined to it, and the components of their own.

    Works on results that know of no components: then there is one part.

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
        # Frames of a result of its own may be counted from its first one.
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
    """Errors (N, N) in m and rad of pose j where pose i is put exactly right."""
    n = len(estimate)
    T_truth_world = truth @ se3.inverse(estimate)
    T_camera_truth = se3.inverse(truth)
    metres, radians = np.empty((n, n)), np.empty((n, n))
    for i in range(n):
        off = T_camera_truth @ (T_truth_world[i] @ estimate)
        metres[i] = np.linalg.norm(off[:, :3, 3], axis=1)
        radians[i] = se3.angle(off)
    return metres, radians


def aligned(
    estimate: Float64, truth: Float64, tolerance: Tolerance, *, to_first: bool = False
) -> Float64:
    """Motion (4, 4) that maps the estimate's world into that of the truth; see the top.

    `to_first` asks for the motion that fits the piece with the first frame.
    """
    metres, radians = relative_errors(estimate, truth)
    right = (metres <= tolerance.off_m) & (radians <= tolerance.off_rad)
    count = right.sum(1)
    spread = np.where(right, metres, 0).sum(1) / np.maximum(count, 1)
    tried = np.flatnonzero(right[0]) if to_first else np.arange(len(estimate))
    best = min(tried, key=lambda i: (-count[i], spread[i], i))
    T = truth[right[best]] @ se3.inverse(estimate[right[best]])
    out = np.eye(4)
    out[:3, :3] = mean_rotation(T[:, :3, :3])
    # The mean of where the cameras are, not of where the world's origin comes to be.
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
    found: Bool = (metres > tolerance.off_m) | (radians > tolerance.off_rad)
    return found


def admits(covariance: Float64 | None, error: Float64) -> bool:
    """Whether a covariance (6, 6) allows an error (6,), position and rotation apart."""
    if covariance is None or not np.isfinite(covariance).all():
        return False
    for k in (slice(0, 3), slice(3, 6)):
        sigma = np.sqrt(max(np.linalg.eigvalsh(covariance[k, k])[-1], 0.0))
        if np.linalg.norm(error[k]) > SIGMAS * sigma:
            return False
    return True


def seen_part(error: Float64, unobservable: Float64, tolerance: Tolerance) -> Float64:
    """Return an error (6,) without what lies in directions (K, 6).

    Metres and radians are put on the scale of the tolerance first.
    """
    if len(unobservable) == 0:
        return error
    scale = np.repeat([tolerance.off_m, tolerance.off_rad], 3)
    directions, _ = np.linalg.qr((np.asarray(unobservable, float) / scale).T)
    scaled = error / scale
    return (scaled - directions @ (directions.T @ scaled)) * scale


def named(reasons: Iterable[Any], index: int) -> bool:
    """Whether a reason's frames contain a frame."""
    return any(a <= index <= b for reason in reasons for a, b in ranges(reason.frames))


def marks(part: Part, k: int, error: Float64, tolerance: Tolerance) -> set[str]:
    """What marks the pose of the frame at position k, which has an error (6,)."""
    record = part.records[k]
    found = set()
    if record.status != "tracked":
        found.add("status")
    if admits(record.covariance, error):
        found.add("covariance")
    if not too_far(seen_part(error, record.unobservable, tolerance), tolerance):
        found.add("unobservable")
    if named(part.reasons, record.index):
        found.add("reason")
    return found


def sides(estimate: Float64, truth: Float64, tolerance: Tolerance) -> Intp:
    """Label (N,) of the side that each pose is of."""
    metres, radians = relative_errors(estimate, truth)
    tied = (metres <= tolerance.off_m) & (radians <= tolerance.off_rad)
    _, label = connected_components(tied | tied.T, directed=False)
    return label.astype(np.intp)


def wrong_joins(estimate: Float64, truth: Float64, tolerance: Tolerance) -> int:
    """How many sides are joined wrongly to the largest one, or to another."""
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
    """What a result is compared with.

    Attributes
    ----------
    poses
        (N, 4, 4) true T_world_camera, NaN where not known. Places that have nothing in common lie
        far apart.
    groups
        (N,) number of the group of frames that can be connected; -1: nothing to connect it by.
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
            off = errors(estimate, reference, truth.tolerance, to_first=to_first)
            far = np.flatnonzero(too_far(off, truth.tolerance))
            found = [marks(part, int(at[k]), off[k], truth.tolerance) for k in far]
            bare = sum(not marked for marked in found)
            tried.append((bare, len(far), sum(marked == {"reason"} for marked in found), off))
        strict += tried[0][0]
        bare, far_count, alone, off = min(tried, key=lambda one: one[:2])
        unmarked, wrong, by_reason = unmarked + bare, wrong + far_count, by_reason + alone
        if number == 0:
            ate = float(np.sqrt((off[:, :3] ** 2).sum(1).mean()))
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
