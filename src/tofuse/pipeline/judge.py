"""From what a run saw of itself to a verdict. Nothing here knows a reference."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tofuse.evaluation.consistency import Consistency
from tofuse.geometry import se3
from tofuse.odometry.motion import jumps
from tofuse.posegraph.graph import LoopRecord, Optimisation
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
# A camera that moved by no more than this stood still.
STILL_M, STILL_RAD = 0.01, np.radians(0.5)
# A loop that moves the end by more than this share of the path (and these floors) bends the path.
GAP_SHARE, GAP_FLOOR_M, GAP_FLOOR_RAD = 0.02, 0.03, np.radians(2)
# Inliers of overlapping images: below the first most of what they saw contradicts the poses;
# below the second share of what neighbours reach, or above that much more rms, they differ.
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
    agreement
        Of all overlapping images under the final poses; None where there are too few.
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
    """

    records: tuple[FrameRecord, ...]
    registrations: tuple[Registration | None, ...]
    loops: tuple[LoopRecord, ...]
    sequential: Float64
    optimisation: Optimisation
    agreement: Consistency | None
    given: frozenset[tuple[int, int]] = frozenset()
    depths: tuple[float, ...] = ()
    ambiguity_m: float | None = None
    repeated: tuple[int, ...] = ()
    interruptions: tuple[int, ...] = ()


def judge(evidence: Evidence) -> tuple[Verdict, tuple[Reason, ...]]:
    """Return the verdict and the reasons for it, gravest first as they are listed."""
    reasons = [
        *_poses(evidence),
        *_motion(evidence),
        *_depths(evidence),
        *_registrations(evidence),
        *_loops(evidence),
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
    for k, words in jumps(poses, e.interruptions):
        frame = e.records[k].index
        yield Reason("jumped", (frame, frame), f"Frame {frame} has a pose, but {words}.")
    for first, last in _runs(e.records, [r.index in e.repeated for r in e.records]):
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
    graph = e.optimisation.graph
    first, last = int(graph.ids[0]), int(graph.ids[-1])
    if len(graph.ids) > 1 and not graph.loop.any():
        text = "No loop was closed, so nothing checks how much error has built up."
        yield Reason("unchecked_drift", (first, last), text)
    for loop in e.loops:
        if (loop.i, loop.j) in e.given and not loop.accepted:
            text = f"The loop {loop.i} to {loop.j} given by hand was not used: {loop.reason}."
            yield Reason("loop_rejected", (loop.i, loop.j), text)
    yield from _gap(e)
    if not e.optimisation.converged:
        text = "The optimiser ran out of iterations before it settled."
        yield Reason("optimiser_gave_up", (first, last), text)


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
    a = e.agreement
    if a is None or a.pairs == 0:
        return
    frames = (int(e.optimisation.graph.ids[0]), int(e.optimisation.graph.ids[-1]))
    found = f"{a.inlier_share:.0%} of what overlapping images saw agrees"
    if np.isfinite(a.rms_m):
        found += f", with {a.rms_m * 1e3:.1f} mm rms"
    if a.inlier_share < CONTRADICTED_SHARE:
        yield Reason("images_disagree", frames, f"Only {found}.")
        return
    # Images next to each other see the same errors of the sensor, but hardly any drift.
    near = [p for p in a.agreements if p.j == p.i + 1]
    if not near:
        return
    compared, inliers = sum(p.compared for p in near), sum(p.inliers for p in near)
    share = inliers / max(compared, 1)
    rms = float(np.sqrt(sum(p.squares for p in near) / max(inliers, 1)))
    if a.inlier_share < AGREEMENT_RATIO * share or a.rms_m > RMS_RATIO * rms:
        text = f"{found}; images next to each other reach {share:.0%} and {rms * 1e3:.1f} mm."
        yield Reason("images_differ", frames, text)


def stretches(records: Sequence[FrameRecord], status: str) -> list[tuple[int, int]]:
    """Return (first, last) frame index of each unbroken stretch of frames with that status."""
    return _runs(records, [r.status == status for r in records])


def _runs(records: Sequence[FrameRecord], marked: Sequence[bool]) -> list[tuple[int, int]]:
    has = np.array([False, *marked, False])
    edges = np.flatnonzero([a != b for a, b in pairwise(has)])
    return [
        (records[a].index, records[b - 1].index)
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]


def _frames(first: int, last: int) -> str:
    return f"Frame {first} has" if first == last else f"Frames {first} to {last} have"
