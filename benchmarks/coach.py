"""Advice of the coach against random views, on simulated walks.

Of each walk (a scene, a path and a seed; 80 x 60 pixels) the first frames are mapped. Then the walk
goes on in two ways with the same number of frames: to the view that `advise` names, or to one of
its candidates by chance, for two thirds of the frames on the way and then looking. All three
recordings are reconstructed. Printed are, in mm, the true rms error of the first part of the walk
and the stated bound, before and after, and the expected bound. Walks with motions that nothing
bounds go on in up to two such parts, and the frames without a bound are counted.

    python benchmarks/coach.py [--seeds 1 2] [--frames 18]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

import unusual
from tofuse.apps.certainty.known import Known
from tofuse.apps.coach.advice import Advice, Candidate, best, bridges, candidates
from tofuse.engine.arrays import Float64
from tofuse.engine.frames.recording import Recording
from tofuse.engine.geometry import se3
from tofuse.engine.mapping.adaptation import adapted
from tofuse.engine.mapping.mapper import Mapper
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.mapping.reconstructing import push_frames, reconstruct
from tofuse.engine.quality.trajectory_errors import align
from tofuse.lab.world import paths
from unusual import Unusual

RATE_HZ = 5.0
CAMERA = unusual.pinhole("ifm-o3r", 80, 60, 60)


def circling(
    t: float, outward: float, centre: tuple[float, float] = (0, 0), radius: float = 1.2
) -> Float64:
    """Walk along 300 degrees of a circle within 10 s, looking ahead and outward (rad)."""
    a = np.radians(300) * t / 10
    at = np.array([centre[0] + radius * np.cos(a), centre[1] + radius * np.sin(a), 1.3])
    d = a + np.pi / 2 - outward
    return paths.look_at(at, at + np.array([np.cos(d), np.sin(d), -0.15]))


IN_FLAT = unusual.scenes.build("flat", seed=0)[1].camera_path(3.0)[:2, 3]


@dataclass(frozen=True)
class Walk:
    """A scene, and a path whose first frames are mapped."""

    scene: str
    path: Callable[[float], Float64]
    frames: int = 50


WALKS = {
    "room, looking ahead": Walk("room", partial(circling, outward=0.0)),
    "room, looking outward": Walk("room", partial(circling, outward=0.6)),
    "empty room, looking ahead": Walk("empty-room", partial(circling, outward=0.0)),
    "empty room, looking outward": Walk("empty-room", partial(circling, outward=0.6)),
    "flat": Walk("flat", partial(circling, outward=0.3, centre=tuple(IN_FLAT), radius=0.7)),
}


@dataclass(frozen=True)
class Outcome:
    """True rms error of the first part, and the stated bound."""

    error_m: float
    bound_m: float


def recording(walk: Walk, seed: int, more: Float64) -> Recording:
    """Simulate the first part of a walk, and then the poses (n, 4, 4) in the room."""
    sway = unusual.handheld(np.random.default_rng([seed, 5]), 0.02, 1.5)

    def path(t: float) -> Float64:
        k = t * RATE_HZ - walk.frames + 1
        if k <= 0 or not len(more):
            return walk.path(t) @ sway(t)
        poses = np.concatenate([walk.path((walk.frames - 1) / RATE_HZ)[None], more])
        first = min(int(k), len(poses) - 2)
        return se3.interpolate(poses[first], poses[first + 1], np.array(k - first)) @ sway(t)

    one = Unusual(
        unusual.known(walk.scene),
        lambda _: path,
        CAMERA,
        walk.frames + len(more),
        RATE_HZ,
    )
    return unusual.record(one, seed)


def follow(walk: Walk, more: Float64, looks: Float64, count: int) -> Float64:
    """Add poses (count, 4, 4) in the room along looks (n, 4, 4) relative to the latest pose."""
    last = more[-1] if len(more) else walk.path((walk.frames - 1) / RATE_HZ)
    stops = last @ np.concatenate([np.eye(4)[None], looks])
    moving = 2 * count // 3
    at = np.minimum(np.arange(1, count + 1) / moving, 1.0) * len(looks)
    first = np.minimum(at.astype(int), len(looks) - 1)
    return np.concatenate([more, se3.interpolate(stops[first], stops[first + 1], at - first)])


def known_of(made: Recording) -> Known | None:
    config = adapted(from_method("default"), made, 1)
    mapper = Mapper(config, threads=1)
    push_frames(mapper, made, config.window)
    return Known.of_map(mapper.so_far())


def way_of(known: Known, advice: Advice) -> Float64:
    """Looks (n, 4, 4) relative to the latest pose."""
    assert advice.T_world_camera is not None
    target = advice.T_world_camera.copy()
    target[:3, 3] -= known.centre
    poses, moves = (bridges if advice.gaps else candidates)(known)
    return looks_of(known, poses, next(m for m in moves if np.allclose(poses[m.way[-1]], target)))


def looks_of(known: Known, poses: Float64, move: Candidate) -> Float64:
    return se3.inverse(known.now) @ poses[list(move.way)]


def without_bound(walk: Walk, seed: int, count: int, parts: int, advised: bool) -> list[str]:
    """Frames of a walk whose pose has no bound, before and after each part; mm where all have."""
    rng = np.random.default_rng([seed, 7])
    more, found = np.zeros((0, 4, 4)), []
    for part in range(parts + 1):
        made = recording(walk, seed, more)
        accuracy = reconstruct(made, threads=1).diagnostics.accuracy
        bounded = np.isfinite(accuracy.position_m)
        found.append(
            f"{1e3 * accuracy.position_m:.1f} mm" if bounded else f"{len(accuracy.unbounded)}"
        )
        known = None if bounded or part == parts else known_of(made)
        if known is None:
            break
        poses, moves = candidates(known)
        looks = looks_of(known, poses, moves[rng.integers(len(moves))])
        if advised:
            looks = way_of(known, best(known))
        more = follow(walk, more, looks, count)
    return found


def outcome(made: Recording, first: int) -> Outcome:
    result = reconstruct(made, threads=1)
    rows = np.flatnonzero(result.has_pose[:first])
    truth = made.reference[rows]
    aligned = align(result.trajectory[rows], truth) @ result.trajectory[rows]
    error = np.linalg.norm(aligned[:, :3, 3] - truth[:, :3, 3], axis=1)
    return Outcome(
        float(np.sqrt((error**2).mean())),
        result.diagnostics.accuracy.position_m,
    )


HEAD = (
    "| walk | advice | error | bound | random: error | bound | advice: error | bound | expected |\n"
    "|---|---|---|---|---|---|---|---|---|"
)


def numbers(name: str, seed: int, count: int) -> tuple[str, list[float]] | None:
    """Compare advice and chance on one walk: the advice, and the columns of the table in mm.

    None if too little is known for advice, as tracking has just begun anew, or some motion has no
    bound, see `without_bound`.
    """
    walk = WALKS[name]
    none = np.zeros((0, 4, 4))
    made = recording(walk, seed, none)
    known = known_of(made)
    if known is None or len(known.gaps):
        return None
    before = outcome(made, walk.frames)
    poses, moves = candidates(known)
    advice = best(known)
    by_chance = moves[np.random.default_rng([seed, 6, len(name)]).integers(len(moves))]
    looks = [looks_of(known, poses, by_chance)]
    if advice.T_world_camera is not None:
        looks.append(way_of(known, advice))
    after = [
        outcome(recording(walk, seed, follow(walk, none, each, count)), walk.frames)
        for each in looks
    ]
    expected = before.bound_m * advice.expected_m / advice.bound_m
    errors = [(each.error_m, each.bound_m) for each in (before, after[0], after[-1])]
    return advice.words, [1e3 * v for v in (*np.ravel(errors).tolist(), expected)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--frames", type=int, default=18, help="after the first part")
    parser.add_argument("--names", nargs="+", default=[""], help="walks whose names contain these")
    options = parser.parse_args()
    found: list[list[float]] = []
    gaps = []
    print(HEAD, flush=True)
    for name in WALKS:
        for seed in options.seeds if any(part in name for part in options.names) else ():
            compared = numbers(name, seed, options.frames)
            if compared is None:
                gaps.append((name, seed))
                continue
            words, row = compared
            found.append(row)
            columns = " | ".join(f"{value:.1f}" for value in row)
            print(f"| {name}, {seed} | {words} | {columns} |", flush=True)
    if found:
        columns = " | ".join(f"{value:.1f}" for value in np.median(found, axis=0))
        print(f"| median of {len(found)} | | {columns} |")
        falls = np.array([[row[1] - row[6], row[1] - row[5]] for row in found])
        expected, achieved = np.median(falls[np.isfinite(falls).all(1)], axis=0)
        print(f"expected fall of the bound {expected:.1f} mm, achieved {achieved:.1f} mm\n")
    print("| walk | way | frames without a bound, or the bound |\n|---|---|---|")
    for name, seed in gaps:
        for way in ("advised", "by chance"):
            after = without_bound(WALKS[name], seed, options.frames, 2, way == "advised")
            print(f"| {name}, {seed} | {way} | {', '.join(after)} |", flush=True)


if __name__ == "__main__":
    main()
