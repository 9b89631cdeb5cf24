"""From what a run saw of itself to a verdict. Nothing here knows a reference."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tofuse.evaluation.sightings import Sightings
from tofuse.geometry import se3
from tofuse.odometry.motion import Moment, jumps
from tofuse.posegraph.graph import LoopRecord, Optimisation
from tofuse.posegraph.outside import OutsideRecord
from tofuse.posegraph.refinement import Refinement
from tofuse.posegraph.suspicion import in_words
from tofuse.posegraph.trust import expected_error, loop_errors
from tofuse.registration.base import Registration
from tofuse.results.types import FrameRecord, Reason, Verdict
from tofuse.results.verdict import verdict_of

Float64 = NDArray[np.float64]

# Below this share of corresponding points a registration is a guess.
WEAK_SHARE = 0.05
# More registrations than this that ran out of iterations are a pattern.
UNSETTLED_SHARE = 0.05
# More frames than this that are not held in every direction build up drift.
UNHELD_SHARE = 0.1
# Typical depths in m that ToF cameras hardly have.
NEAREST_M, FARTHEST_M = 0.3, 12.0
# More jumps than a few, and than this share of the poses, are views in no order.
UNORDERED, UNORDERED_SHARE = 3, 0.2
# A camera that moved by no more than this stood still.
STILL_M, STILL_RAD = 0.01, np.radians(0.5)
# A result is good if its path is right to 1 cm and 1 % of its length: what the verdict promises.
GOOD_M, GOOD_SHARE = 0.01, 0.01
# Single poses are told that may be off by twice that, as the way from the first adds to them.
UNCERTAIN_TIMES, UNCERTAIN_RAD = 2.0, np.radians(2)
# So small a share of the frames says nothing of the path.
SELDOM = 0.02
# Path lengths are measured over so many poses: jitter from frame to frame is no way.
PATH_POSES = 60
# Loops miss where odometry leads by a chi-square variable with six degrees of freedom, if both
# know their errors: one in a thousand misses by more.
MISSED = 22.46
# Where errors aren't known, a loop may move the end by this share of the path, and these floors.
GAP_SHARE, GAP_FLOOR_M, GAP_FLOOR_RAD = 0.02, 0.03, np.radians(2)
# Of what overlapping images say of the poses, this share has to support them, or they are wrong;
# below that share of what neighbours reach, or above that much more rms, they differ.
CONTRADICTED_SHARE, AGREEMENT_RATIO, RMS_RATIO = 0.5, 0.9, 1.5


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the judgement rests on.

    Attributes
    ----------
    records, registrations
        Of every frame, in order; a registration is None for the first and for lost frames.
    loops
        Every loop that was considered.
    sequential
        (N, 4, 4) poses before optimisation, of the frames with a pose.
    optimisation
        The graph after it.
    sightings
        What overlapping images say of the final poses; None where there are too few.
    covariances
        (N, 6, 6) of those poses, see `trust.pose_covariances`; None where registrations don't know
        their errors, as ICP's don't.
    refinement
        What became of the refinement over all views.
    given
        Pairs (i, j) of loops given by hand.
    depths
        Median radial range of every frame with a pose, m.
    ambiguity_m
        Range after which the camera's phase repeats, if it is known.
    repeated
        Indices of the frames that are the same as the one before, to the last pixel.
    interruptions
        Positions among the records at which another recording begins.
    outside
        What became of sensors beside the camera.
    """

    records: tuple[FrameRecord, ...]
    registrations: tuple[Registration | None, ...]
    loops: tuple[LoopRecord, ...]
    sequential: Float64
    optimisation: Optimisation
    sightings: Sightings | None
    covariances: Float64 | None = None
    refinement: Refinement | None = None
    given: frozenset[tuple[int, int]] = frozenset()
    depths: tuple[float, ...] = ()
    ambiguity_m: float | None = None
    repeated: tuple[int, ...] = ()
    interruptions: tuple[int, ...] = ()
    outside: tuple[OutsideRecord, ...] = ()


def judge(evidence: Evidence) -> tuple[Verdict, tuple[Reason, ...]]:
    """Return the verdict and the reasons for it, gravest first as they are listed."""
    reasons = [
        *_poses(evidence),
        *_motion(evidence),
        *_depths(evidence),
        *_registrations(evidence),
        *_loops(evidence),
        *(_drift(evidence) if evidence.covariances is None else _uncertainty(evidence)),
        *_optimiser(evidence),
        *_outside(evidence),
        *_images(evidence),
    ]
    return verdict_of(reasons), tuple(reasons)


def _poses(e: Evidence) -> Iterator[Reason]:
    readable = [r for r in e.records if r.status != "skipped"]
    lost = [r for r in readable if r.status == "lost"]
    everything = (e.records[0].index, e.records[-1].index)
    if 2 * len(lost) > len(readable):
        text = f"{len(lost)} of {len(readable)} readable frames have no pose."
        yield Reason("few_poses", everything, text)
    for first, last in stretches(e.records, "lost"):
        yield Reason("lost_frames", (first, last), f"{_frames(first, last)} no pose.")
    for first, last in stretches(e.records, "skipped"):
        text = f"{_frames(first, last)} not been read."
        yield Reason("unreadable_frames", (first, last), text)
    posed = [r for r in readable if r.status != "lost"]
    if len(posed) == 1:
        frame = posed[0].index
        text = f"Only frame {frame} has a pose, so there was nothing to register."
        yield Reason("single_frame", (frame, frame), text)


def _motion(e: Evidence) -> Iterator[Reason]:
    posed = iter(e.sequential)
    has_pose = [r.status in ("tracked", "predicted") for r in e.records]
    poses = [next(posed) if has else None for has in has_pose]
    moments = [Moment(r.index, r.timestamp) for r in e.records]
    found = jumps(poses, e.interruptions, moments)
    if len(found) > max(UNORDERED, UNORDERED_SHARE * sum(has_pose)):
        first, last = (e.records[found[k][0]].index for k in (0, -1))
        text = (
            f"{len(found)} of {sum(has_pose)} poses are not where the motion before leads to, as "
            "if the views were in no order; so no motion tells whether they are right."
        )
        yield Reason("jumped", (first, last), text)
        found = []
    for k, words in found:
        frame = e.records[k].index
        yield Reason("jumped", (frame, frame), f"Frame {frame} has a pose, but {words}.")
    for first, last in _runs(
        [r.index for r in e.records], [r.index in e.repeated for r in e.records]
    ):
        which = f"Frame {first} is" if first == last else f"Frames {first} to {last} are"
        text = f"{which} the same image as the one before: nothing new was measured."
        yield Reason("repeated_images", (first, last), text)
    T = e.optimisation.graph.poses
    moved = se3.inverse(T[:1]) @ T
    still = np.linalg.norm(moved[:, :3, 3], axis=1) < STILL_M
    if len(T) > 2 and (still & (se3.angle(moved) < STILL_RAD)).all():
        ids = e.optimisation.graph.ids
        text = f"The camera never moved in {len(T)} frames: the model is what one view sees."
        yield Reason("stood_still", (int(ids[0]), int(ids[-1])), text)


def _depths(e: Evidence) -> Iterator[Reason]:
    if not e.depths:
        return
    typical = float(np.median(e.depths))
    what = f"The typical distance is {typical:.3g} m"
    if e.ambiguity_m is not None and typical > e.ambiguity_m:
        text = f"{what}, but this camera's phase repeats after {e.ambiguity_m:.3g} m"
    elif typical > FARTHEST_M:
        text = f"{what}, farther than ToF cameras see"
    elif typical < NEAREST_M:
        text = f"{what}, nearer than most ToF cameras see"
    else:
        return
    everything = (e.records[0].index, e.records[-1].index)
    yield Reason("implausible_depth", everything, f"{text}: check the depth unit.")


def _registrations(e: Evidence) -> Iterator[Reason]:
    pairs = [
        (record.index, r)
        for record, r in zip(e.records, e.registrations, strict=True)
        if r is not None and record.status != "lost"
    ]
    if not pairs:
        return
    weak = [index for index, r in pairs if r.share < WEAK_SHARE]
    if weak:
        text = (
            f"{len(weak)} frames have a partner for fewer than {WEAK_SHARE:.0%} of the points "
            "that were compared."
        )
        yield Reason("weak_registration", (weak[0], weak[-1]), text)
    if e.covariances is not None:
        return  # what was not held, or did not settle, is in them
    unheld = [index for index, r in pairs if len(r.unobservable)]
    if len(unheld) > UNHELD_SHARE * len(pairs):
        text = (
            f"In {len(unheld)} of {len(pairs)} registrations the data does not hold the camera in "
            "every direction; there the pose is a prediction, and drifts."
        )
        yield Reason("unobserved_motion", (unheld[0], unheld[-1]), text)
    unsettled = [index for index, r in pairs if not r.converged]
    if len(unsettled) > UNSETTLED_SHARE * len(pairs):
        text = f"{len(unsettled)} of {len(pairs)} registrations stopped before they settled."
        yield Reason("not_converged", (unsettled[0], unsettled[-1]), text)


def _loops(e: Evidence) -> Iterator[Reason]:
    for loop in e.loops:
        if (loop.i, loop.j) in e.given and not loop.accepted:
            text = f"The loop {loop.i} to {loop.j} given by hand was not used: {loop.reason}."
            yield Reason("loop_rejected", (loop.i, loop.j), text)


def _optimiser(e: Evidence) -> Iterator[Reason]:
    if not e.optimisation.converged:
        text = "The optimiser ran out of iterations before it settled."
        yield Reason("optimiser_gave_up", _all_posed(e), text)
    tried = any(e.optimisation.objective) and not e.optimisation.improved
    if tried or any(part.before > 0 and not part.improved for part in e.optimisation.parts):
        text = "The optimiser found nothing better than the poses that it was given."
        yield Reason("not_improved", _all_posed(e), text)
    r = e.refinement
    if r is not None and r.pairs and not r.kept:
        text = "The refinement over all views made them agree worse, so it was not kept."
        yield Reason("not_refined", _all_posed(e), text)


def _outside(e: Evidence) -> Iterator[Reason]:
    for sensor in e.outside:
        if 2 * sensor.used < sensor.measured:
            text = f"{sensor.text[0].upper()}{sensor.text[1:]}."
            yield Reason("sensor_differs", _all_posed(e), text)


def _drift(e: Evidence) -> Iterator[Reason]:
    """Without known errors only loops tell of drift."""
    graph = e.optimisation.graph
    if len(graph.ids) > 1 and not graph.loop.any():
        text = "No loop was closed, so nothing checks how much error has built up."
        yield Reason("unchecked_drift", _all_posed(e), text)
    yield from _gap(e)


def _uncertainty(e: Evidence) -> Iterator[Reason]:
    """With known errors of the registrations, those of the path follow."""
    yield from _missed(e)
    yield from _suspected(e)
    graph = e.optimisation.graph
    assert e.covariances is not None
    if len(graph.ids) < 2:
        return
    promised = GOOD_M + GOOD_SHARE * _way(graph.poses)
    sigma, turn = _worst(e.covariances[:, :3, :3]), _worst(e.covariances[:, 3:, 3:])
    doubtful = ~((sigma <= UNCERTAIN_TIMES * promised) & (turn <= UNCERTAIN_RAD))
    found = _runs(graph.ids.tolist(), doubtful.tolist())
    seldom = bool(doubtful.sum() <= SELDOM * len(doubtful))
    if found:
        first, last = max(found, key=lambda ends: ends[1] - ends[0])
        here = (graph.ids >= first) & (graph.ids <= last)
        text = _doubt(first, last, float(sigma[here].max()), float(turn[here].max()))
        text += f" So are {len(found) - 1} other stretches." if len(found) > 1 else ""
        yield Reason("uncertain_frames" if seldom else "uncertain_poses", (first, last), text)
    if not seldom:
        return
    _, bound = expected_error(graph)
    if bound > promised:
        text = (
            f"The path may be off by {bound * 1e3:.0f} mm rms, by what was measured (two sigma). "
            f"To be called good it must be held to {promised * 1e3:.0f} mm: 1 cm and 1 % of its "
            "length."
        )
        yield Reason("uncertain_poses", _all_posed(e), text)


def _doubt(first: int, last: int, sigma: float, turn: float) -> str:
    which = f"Frame {first} is" if first == last else f"Frames {first} to {last} are"
    if not np.isfinite(sigma):
        return f"{which} not joined to the first by anything that was measured."
    if turn >= np.pi:  # no two rotations are further apart
        return f"{which} not held at all in at least one direction, by loops and structure."
    return (
        f"{which} held to no better than {sigma:.3f} m and {np.degrees(turn):.1f} degrees (one "
        "sigma in the worst direction), by loops and structure."
    )


def _worst(covariances: Float64) -> Float64:
    """(N,) standard deviations in the worst directions of (N, 3, 3); NaN where not known."""
    known = np.isfinite(covariances).all((1, 2))
    out = np.full(len(covariances), np.nan)
    out[known] = np.sqrt(np.linalg.eigvalsh(covariances[known])[:, -1])
    return out


def _missed(e: Evidence) -> Iterator[Reason]:
    """Errors of the camera that all views share bend the path, and no registration knows them."""
    graph = e.optimisation.graph
    errors = loop_errors(graph, e.sequential)
    known = np.isfinite(errors)
    # Half of the loops: a few may be wrong by themselves.
    if not known.any() or np.median(errors[known]) <= MISSED:
        return
    worst = int(np.nanargmax(errors))
    i, j = graph.edges[graph.loop][worst]
    gap = se3.inverse(graph.measurements[graph.loop][worst]) @ (
        se3.inverse(e.sequential[i]) @ e.sequential[j]
    )
    first, last = sorted((int(graph.ids[i]), int(graph.ids[j])))
    text = (
        f"The loop {first} to {last} misses by {np.linalg.norm(gap[:3, 3]):.3f} m and "
        f"{np.degrees(se3.angle(gap)):.1f} degrees, {np.sqrt(errors[worst] / 6):.1f} times what "
        "noise explains: the depth offset or the focal length of the camera may be wrong."
    )
    yield Reason("calibration_alarm", (first, last), text)


def _suspected(e: Evidence) -> Iterator[Reason]:
    """All views together may say what is wrong with the camera."""
    found = None if e.refinement is None else e.refinement.suspicion
    if found is None or not found.alarm or found.gap is None:
        return
    gap = found.gap
    (m, rad), (m_after, rad_after) = gap.before, gap.after
    text = (
        f"Neighbours alone miss the loop {gap.i} to {gap.j} by {m:.3f} m and "
        f"{np.degrees(rad):.1f} degrees; {' or '.join(in_words(found))} would leave "
        f"{m_after:.3f} m and {np.degrees(rad_after):.1f} degrees."
    )
    yield Reason("calibration_alarm", (gap.i, gap.j), text)


def _way(poses: Float64) -> float:
    """Length of the path in m."""
    n = len(poses)
    some = np.unique(np.linspace(0, n - 1, min(n, PATH_POSES)).round().astype(int))
    return float(np.linalg.norm(np.diff(poses[some, :3, 3], axis=0), axis=1).sum())


def _gap(e: Evidence) -> Iterator[Reason]:
    """Tell of the loop whose ends were furthest apart, compared with what its path allows."""
    graph = e.optimisation.graph
    steps = np.linalg.norm(np.diff(e.sequential[:, :3, 3], axis=0), axis=1)
    turns = se3.angle(se3.inverse(e.sequential[:-1]) @ e.sequential[1:])
    wide: list[tuple[float, int, int, float, float]] = []
    for (i, j), measured in zip(
        graph.edges[graph.loop], graph.measurements[graph.loop], strict=True
    ):
        a, b = min(i, j), max(i, j)
        gap = se3.inverse(measured) @ se3.inverse(e.sequential[i]) @ e.sequential[j]
        distance, angle = float(np.linalg.norm(gap[:3, 3])), float(se3.angle(gap))
        excess = max(
            distance / max(GAP_FLOOR_M, GAP_SHARE * float(steps[a:b].sum())),
            angle / max(GAP_FLOOR_RAD, GAP_SHARE * float(turns[a:b].sum())),
        )
        if excess > 1:
            wide.append((excess, int(graph.ids[a]), int(graph.ids[b]), distance, angle))
    if not wide:
        return
    _, first, last, distance, angle = max(wide)
    closed = int(graph.loop.sum())
    many = f" {len(wide)} of {closed} loops had too wide a gap; this is the worst." * (closed > 1)
    text = (
        f"Before the loop {first} to {last} was closed, its ends were {distance:.3f} m and "
        f"{np.degrees(angle):.1f} degrees from where it puts them.{many}"
    )
    yield Reason("loop_gap", (first, last), text)


def _images(e: Evidence) -> Iterator[Reason]:
    s = e.sightings
    if s is None or not np.isfinite(s.share()):
        return
    found = f"{s.share():.0%} of what overlapping images say supports the poses"
    if np.isfinite(s.rms_m()):
        found += f", with {s.rms_m() * 1e3:.1f} mm rms"
    if s.share() < CONTRADICTED_SHARE:
        yield Reason("images_disagree", _all_posed(e), f"Only {found}.")
        return
    alone = [share < CONTRADICTED_SHARE for share in s.share_of_views()]
    for first, last in _runs(s.frames, alone):
        text = f"Most of what other images say contradicts the poses of frames {first} to {last}."
        yield Reason("images_differ", (first, last), text)
    # Images next to each other see the same errors of the sensor, but hardly any drift.
    near = [p for p in s.pairs if p.j == p.i + 1]
    share, rms = s.share(near), s.rms_m(near)
    if s.share() < AGREEMENT_RATIO * share or s.rms_m() > RMS_RATIO * rms:
        text = f"{found}; images next to each other reach {share:.0%} and {rms * 1e3:.1f} mm."
        yield Reason("images_differ", _all_posed(e), text)


def _all_posed(e: Evidence) -> tuple[int, int]:
    ids = e.optimisation.graph.ids
    return int(ids[0]), int(ids[-1])


def stretches(records: Sequence[FrameRecord], status: str) -> list[tuple[int, int]]:
    """Return (first, last) frame index of each unbroken stretch of frames with that status."""
    return _runs([r.index for r in records], [r.status == status for r in records])


def _runs(frames: Sequence[int], marked: Sequence[bool]) -> list[tuple[int, int]]:
    """Return (first, last) of each unbroken stretch of frames that are marked."""
    has = np.array([False, *marked, False])
    edges = np.flatnonzero([a != b for a, b in pairwise(has)])
    return [
        (int(frames[a]), int(frames[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]


def _frames(first: int, last: int) -> str:
    return f"Frame {first} has" if first == last else f"Frames {first} to {last} have"
