"""Advice of the coach against random views, on simulated walks.

Of each walk (a scene, a path and a seed; 80 x 60 pixels) the first frames are mapped. Then the
walk goes on in two ways with the same number of frames: to the view that `advise` names, or to one
of its candidates by chance, each reached in the same way (turning on the spot, or going back along
the path) and looked at to the end. All three recordings are reconstructed. Printed are the true rms
error of the first part of the walk and the stated bound, before and after, and the expected bound.

    python benchmarks/coach.py [--seeds 1 2 3] [--frames 20]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import unusual
from tofuse.apps.coach.advice import best, candidates
from tofuse.apps.coach.known import Known
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
# Going back is this much faster than the walk was.
SPEED = 2.0
CAMERA = unusual.pinhole("ifm-o3r", 80, 60, 60)


def _across(t: float) -> Float64:
    """Walk along 230 degrees of a circle of 1.2 m within 14 s, looking to the other side."""
    a = np.radians(230) * t / 14
    at = np.array([1.2 * np.cos(a), 1.2 * np.sin(a), 1.3])
    return paths.look_at(at, [-np.cos(a + 0.6), -np.sin(a + 0.6), 0.8])


_FLAT = unusual.scenes.build("flat", seed=0)[1].camera_path


@dataclass(frozen=True)
class Walk:
    """A scene, and a path whose first frames are mapped."""

    scene: str
    path: Callable[[float], Float64]
    frames: int = 70


WALKS = {
    "flat": Walk("flat", _FLAT, 80),
    "room": Walk("room", _across),
    "empty room": Walk("empty-room", _across),
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


def follow(walk: Walk, T_now_target: Float64, frame: int | None, count: int) -> Float64:
    """Poses (count, 4, 4) in the room to a target: two thirds of the way there, then looking."""
    last = (walk.frames - 1) / RATE_HZ
    moving = 2 * count // 3
    fractions = np.minimum(np.arange(1, count + 1) / moving, 1.0)
    if frame is None:
        now = walk.path(last)
        return se3.interpolate(now, now @ T_now_target, fractions)
    times = last + np.maximum(frame / RATE_HZ - last, -SPEED / RATE_HZ * np.arange(1, count + 1))
    return np.stack([walk.path(t) for t in times])


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


def numbers(name: str, seed: int, count: int) -> tuple[str, list[float]]:
    """Compare advice and chance on one walk: the advice, and the columns of the table in mm."""
    walk = WALKS[name]
    made = recording(walk, seed, np.zeros((0, 4, 4)))
    config = adapted(from_method("default"), made, 1)
    mapper = Mapper(config, threads=1)
    push_frames(mapper, made, config.window)
    known = Known.of_map(mapper.so_far())
    assert known is not None
    within_s = SPEED * (2 * count // 3) / RATE_HZ
    advice = best(known, within_s)
    before = outcome(made, walk.frames)
    moves = candidates(known, within_s)
    by_chance = moves[np.random.default_rng([seed, 6, len(name)]).integers(len(moves))]
    now = known.poses[-1].copy()
    T_now = se3.inverse(now)
    options = [(T_now @ by_chance.pose, by_chance.frame)]
    if advice.T_world_camera is not None:
        now[:3, 3] += known.centre
        options.append((se3.inverse(now) @ advice.T_world_camera, advice.frame))
    after = []
    for T, frame in options:
        more = follow(walk, T, frame, count)
        after.append(outcome(recording(walk, seed, more), walk.frames))
    expected = before.bound_m * advice.expected_m / advice.bound_m
    errors = [(each.error_m, each.bound_m) for each in (before, after[0], after[-1])]
    return advice.words, [1e3 * v for v in (*np.ravel(errors).tolist(), expected)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4])
    parser.add_argument("--frames", type=int, default=24, help="after the first part")
    parser.add_argument("--names", nargs="+", default=[""], help="walks whose names contain these")
    options = parser.parse_args()
    found = []
    print(HEAD, flush=True)
    for name in WALKS:
        for seed in options.seeds if any(part in name for part in options.names) else ():
            words, row = numbers(name, seed, options.frames)
            found.append(row)
            columns = " | ".join(f"{value:.1f}" for value in row)
            print(f"| {name}, {seed} | {words} | {columns} |", flush=True)
    columns = " | ".join(f"{value:.1f}" for value in np.median(found, axis=0))
    print(f"| median of {len(found)} | | {columns} |")
    falls = np.array(
        [[row[1] - row[6], row[1] - row[5]] for row in found if np.isfinite(row).all()]
    )
    expected, achieved = np.median(falls, axis=0)
    print(f"expected fall of the bound {expected:.1f} mm, achieved {achieved:.1f} mm")


if __name__ == "__main__":
    main()
