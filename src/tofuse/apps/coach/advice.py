"""Where to look or walk next: candidates, their gains, and words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.apps.certainty import Known
from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError, signals_as_themselves
from tofuse.engine.frames import evenly_spaced
from tofuse.engine.geometry import se3
from tofuse.engine.mapping import Mapper
from tofuse.engine.progress import OnlineMap
from tofuse.engine.quantities import length
from tofuse.engine.results import Reconstruction

# Turns of the camera at its place, in degrees to the right and upwards, each from the one before.
_TURNS = (
    *(tuple((side * yaw, 0) for yaw in range(30, 181, 30)) for side in (-1, 1)),
    *(((yaw, pitch),) for yaw in (-45, 0, 45) for pitch in (-35, 35)),
)
# Earlier places to go to: evenly spaced keyframes, and halfway between successive ones that are
# known worst relative to each other. On the way there is a look after at most this angle (rad) and
# part of the reach, within limits.
_REVISITS, _WEAK, _STEP_ANGLE, _STEP, _MAX_LOOKS = 8, 5, 0.6, 0.2, 5
# A surface so near to the straight way, relative to its length, is in the way.
_BLOCKED = 0.08
# Numbers of views from there, one to two seconds of a moving camera, and from each look before.
_VIEWS = 8.0, 2.0
# Of candidates whose gain is at least this fraction of the largest, the nearest is advised.
_NEARLY_BEST = 0.9
# A keyframe within this fraction of the reach is a turn away.
_SAME_PLACE = 0.1
# Degrees that are not named, and that are half a turn; share of a step that is named.
_SMALL_DEGREES, _AROUND, _MIN_SHARE = 10.0, 155.0, 0.35


@dataclass(frozen=True, eq=False)
class Advice:
    """What to do next.

    Attributes
    ----------
    bound_m
        Present 95 % bound on the rms error of the positions; inf if there is none.
    expected_m
        The bound expected after following the advice; `bound_m` if there is nothing to advise.
    words
        The advice as a sentence.
    T_world_camera
        (4, 4) pose to take; None if there is nothing to advise.
    frame
        The earlier frame that was nearest to it; None for a turn.
    gaps
        Frames before and after those whose motion no measurement bounds.
    """

    bound_m: float
    expected_m: float
    words: str
    T_world_camera: Float64 | None = None
    frame: int | None = None
    gaps: tuple[tuple[int, int], ...] = ()

    @property
    def gain_m(self) -> float:
        """Expected fall of the bound; 0 where there is none."""
        return self.bound_m - self.expected_m if np.isfinite(self.bound_m) else 0.0


@signals_as_themselves()
def advise(source: Mapper | Reconstruction) -> Advice | None:
    """Say where to look or walk next so that the bound on the errors of the poses falls.

    Candidates are turns of the camera at its latest place, and earlier places of its path. For each
    the views that it overlaps with are predicted from the surfaces known so far, and the
    information of these pairs, which lowers the bound.

    Parameters
    ----------
    source
        A `Mapper` between two frames, or a finished result.

    Returns
    -------
    The advice; None if too little is known.

    Raises
    ------
    InputError
        If it is neither.
    """
    if isinstance(source, Mapper):
        return advise_on(source.so_far())
    if not isinstance(source, Reconstruction):
        raise InputError(
            f"is {quantities.one(type(source).__name__)}, neither a mapper nor a result",
            where="source",
            remedy="pass a tofuse.Mapper, or a result of tofuse.reconstruct or tofuse.load",
        )
    recording = getattr(source, "source", None)
    known = Known.of_result(source, None if recording is None else recording.first_readable())
    return None if known is None else best(known)


def advise_on(so_far: OnlineMap) -> Advice | None:
    """Do as `advise` does, for the map that a mapper has so far."""
    known = Known.of_map(so_far)
    return None if known is None else best(known)


def best(known: Known) -> Advice:
    """Return the best advice by what is known."""
    poses, moves = candidates(known)
    factors = known.factors(poses, [move.way for move in moves], _VIEWS)
    good = np.flatnonzero(1 - factors >= _NEARLY_BEST * (1 - factors.min()))
    chosen = min(good.tolist(), key=lambda k: moves[k].effort)
    move, factor, bound_m = moves[chosen], float(factors[chosen]), known.bound_m
    expected_m = factor * bound_m
    before, after = length(bound_m), length(expected_m)
    gain = f"{before} to {after}"
    if not np.isfinite(bound_m):
        gain = f"{100 * (1 - factor):.0f} % less uncertain"
        if len(known.gaps):
            gain += f", but nothing bounds the motion {_ago(known.ages_s[known.gaps[-1]])}"
    elif before == after:
        return Advice(bound_m, bound_m, f"go on: no look back would lower the {before}")
    pose = poses[move.way[-1]].copy()
    pose[:3, 3] += known.centre
    gaps = tuple((int(known.frames[k]), int(known.frames[k + 1])) for k in known.gaps)
    return Advice(bound_m, expected_m, f"{move.words}: {gain}", pose, move.frame, gaps)


@dataclass(frozen=True)
class Candidate:
    """A way: positions in the poses of all candidates.

    `effort` grows with the motion: its length relative to the reach, and its angle in rad.
    """

    way: tuple[int, ...]
    words: str
    effort: float
    frame: int | None = None


def candidates(known: Known) -> tuple[Float64, list[Candidate]]:
    """Return poses (M, 4, 4) relative to the centre, and turns and ways to earlier places."""
    now = known.poses[-1]
    poses: list[Float64] = []
    moves = []
    for turns in _TURNS:
        first = len(poses)
        for yaw, pitch in turns:
            w = np.radians([[0, yaw, 0], [pitch, 0, 0]])
            R = se3.exp([0, 0, 0, *w[0]]) @ se3.exp([0, 0, 0, *w[1]])
            poses.append(now @ R)
            way = tuple(range(first, len(poses)))
            moves.append(Candidate(way, _turn(yaw, pitch), float(se3.angle(R))))
    earlier = np.arange(len(known.poses) - 1)
    weakest = np.argsort(-known.step_squares, kind="stable")[:_WEAK]
    halfway = se3.interpolate(
        known.poses[weakest], known.poses[weakest + 1], np.full(len(weakest), 0.5)
    )
    even = evenly_spaced(earlier, _REVISITS)
    targets = np.concatenate([known.poses[even], halfway])
    for k, target in zip([*even.tolist(), *weakest.tolist()], targets, strict=True):
        looks, words, effort = _way_to(known, k, target)
        way = tuple(range(len(poses), len(poses) + len(looks)))
        poses += [*looks]
        moves.append(Candidate(way, words, effort, int(known.frames[k])))
    return np.stack(poses), moves


def _way_to(known: Known, k: int, target: Float64) -> tuple[Float64, str, float]:
    """Return looks (n, 4, 4) on the way to a target at keyframe k, its words and its effort."""
    now, reach = known.poses[-1], known.surfaces.reach_m
    motion = se3.inverse(now) @ target
    step, angle = float(np.linalg.norm(motion[:3, 3])), float(se3.angle(motion))
    seconds = _ago(known.ages_s[k])
    looks = int(np.clip(np.ceil(max(angle / _STEP_ANGLE, step / reach / _STEP)), 1, _MAX_LOOKS))
    if step < _SAME_PLACE * reach:
        turn = _turn(*_direction(motion[:3, 2]))
        words = f"{turn}, to what you saw {seconds}" if turn else "stay here"
    else:
        words = f"go to where you were {seconds}, {_way(motion[:3, 3])}"
    effort = step / reach + angle
    if not _is_blocked(known, now[:3, 3], target[:3, 3]):
        return se3.interpolate(now, target, np.arange(1, looks + 1) / looks), words, effort
    words = f"go back the way you came, to where you were {seconds}"
    back = np.arange(k, len(known.poses) - 1)[::-1]
    looked = back[np.linspace(0, len(back) - 1, looks).round().astype(np.intp)]
    return np.concatenate([known.poses[looked[:-1]], target[None]]), words, effort


def _is_blocked(known: Known, start: Float64, end: Float64) -> bool:
    """Whether a known surface lies on the straight way, apart from its ends."""
    step = end - start
    length = max(float(np.linalg.norm(step)), 1e-9)
    arm = known.surfaces.points - start
    fraction = arm @ step / length**2
    distance = np.linalg.norm(arm - fraction[:, None] * step, axis=1)
    between = (fraction > _BLOCKED) & (fraction < 1 - _BLOCKED)
    return bool((between & (distance < _BLOCKED * length)).any())


def _direction(v: Float64) -> tuple[float, float]:
    """Degrees to the right and upwards of a vector in the camera's frame."""
    yaw = np.degrees(np.arctan2(v[0], v[2]))
    return float(yaw), float(np.degrees(np.arctan2(-v[1], np.hypot(v[0], v[2]))))


def _turn(yaw: float, pitch: float) -> str:
    """Return words for a turn by degrees to the right and upwards; none for a small one."""
    parts = []
    if abs(yaw) > _SMALL_DEGREES:
        side = "right" if yaw > 0 else "left"
        parts.append(
            "turn around" if abs(yaw) > _AROUND else f"turn {_tens(yaw)}\N{DEGREE SIGN} {side}"
        )
    if abs(pitch) > _SMALL_DEGREES:
        parts.append(f"look {_tens(pitch)}\N{DEGREE SIGN} {'up' if pitch > 0 else 'down'}")
    return " and ".join(parts)


def _ago(seconds: float) -> str:
    return f"{seconds:.0f} s ago" if seconds >= 1 else f"{seconds:.1f} s ago"


def _way(step: Float64) -> str:
    """Return words for a step in the camera's frame."""
    names = (("left", "right"), ("up", "down"), ("back", "ahead"))
    shares = np.abs(step) / np.linalg.norm(step)
    order = [axis for axis in np.argsort(-shares) if shares[axis] > _MIN_SHARE]
    words = " and ".join(names[axis][int(step[axis] > 0)] for axis in order[:2])
    return f"{np.linalg.norm(step):.1f} m {words}"


def _tens(degrees: float) -> int:
    return int(10 * round(abs(degrees) / 10))
