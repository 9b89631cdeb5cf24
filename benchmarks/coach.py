"""Advice of the coach against random views, on simulated walks.

Of each walk (a scene, a path and a seed; 80 x 60 pixels) the first frames are mapped. Then the walk
goes on with the same number of frames: to the view that `advise` names, or to each of some of its
candidates by chance, for two thirds of the frames on the way and then looking. All these recordings
are reconstructed. Printed are, in mm, the true rms error of the first part of the walk and the
stated bound, before and after (by chance: the medians), and the expected bound; then in how many
pairs of an advised and a random view the advised one is better. Walks in which some motion has no
bound, or tracking has just begun anew, are named.

    python benchmarks/coach.py [--seeds 1 2] [--frames 18] [--draws 3]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

import unusual
from tofuse.apps.certainty.known import Known
from tofuse.apps.coach.advice import Advice, Candidate, best, candidates
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


def recording(walk: Walk, seed: int, looks: Float64 | None = None, count: int = 0) -> Recording:
    """Simulate the first part of a walk, and a way along looks (n, 4, 4) relative to its end."""
    last = walk.path((walk.frames - 1) / RATE_HZ)
    stops = last[None] if looks is None else last @ np.concatenate([np.eye(4)[None], looks])
    moving = 2 * count // 3
    sway = unusual.handheld(np.random.default_rng([seed, 5]), 0.02, 1.5)

    def path(t: float) -> Float64:
        frame = t * RATE_HZ - walk.frames + 1
        if frame <= 0 or len(stops) == 1:
            return walk.path(t) @ sway(t)
        at = min(frame / moving, 1.0) * (len(stops) - 1)
        first = min(int(at), len(stops) - 2)
        return se3.interpolate(stops[first], stops[first + 1], np.array(at - first)) @ sway(t)

    one = Unusual(
        unusual.known(walk.scene),
        lambda _: path,
        CAMERA,
        walk.frames + count,
        RATE_HZ,
    )
    return unusual.record(one, seed)


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
    poses, moves = candidates(known)
    return looks_of(known, poses, next(m for m in moves if np.allclose(poses[m.way[-1]], target)))


def looks_of(known: Known, poses: Float64, move: Candidate) -> Float64:
    return se3.inverse(known.poses[-1]) @ poses[list(move.way)]


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


@dataclass(frozen=True)
class Compared:
    """Advice and chance on one walk, and the bound that the advice expects."""

    words: str
    before: Outcome
    random: list[Outcome]
    advised: Outcome
    expected_m: float

    @property
    def columns(self) -> list[float]:
        """The columns of the table, in mm."""
        chance = np.median([(each.error_m, each.bound_m) for each in self.random], axis=0)
        ends = [(each.error_m, each.bound_m) for each in (self.before, self.advised)]
        return [1e3 * v for v in (*ends[0], *chance.tolist(), *ends[1], self.expected_m)]


def compared(name: str, seed: int, count: int, draws: int) -> Compared | None:
    """Compare advice and chance on one walk.

    None where the first part has no bound, or too little is known for advice.
    """
    walk = WALKS[name]
    made = recording(walk, seed)
    known, before = known_of(made), outcome(made, walk.frames)
    if known is None or not np.isfinite([known.bound_m, before.bound_m]).all():
        return None
    poses, moves = candidates(known)
    advice = best(known)

    def after(looks: Float64 | None) -> Outcome:
        return outcome(recording(walk, seed, looks, count), walk.frames)

    rng = np.random.default_rng([seed, 6, len(name)])
    chosen = rng.choice(len(moves), draws, replace=False)
    random = [after(looks_of(known, poses, moves[k])) for k in chosen]
    # Who is told to go on stays where he is here.
    advised = after(np.eye(4)[None] if advice.T_world_camera is None else way_of(known, advice))
    expected_m = before.bound_m * advice.expected_m / advice.bound_m
    return Compared(advice.words, before, random, advised, expected_m)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--frames", type=int, default=18, help="after the first part")
    parser.add_argument("--draws", type=int, default=3, help="random views of each walk")
    parser.add_argument("--names", nargs="+", default=[""], help="walks whose names contain these")
    options = parser.parse_args()
    found: list[Compared] = []
    left_out = []
    print(HEAD, flush=True)
    for name in WALKS:
        for seed in options.seeds if any(part in name for part in options.names) else ():
            one = compared(name, seed, options.frames, options.draws)
            if one is None:
                left_out.append(f"{name}, {seed}")
                continue
            found.append(one)
            columns = " | ".join(f"{value:.1f}" for value in one.columns)
            print(f"| {name}, {seed} | {one.words} | {columns} |", flush=True)
    columns = " | ".join(f"{v:.1f}" for v in np.median([one.columns for one in found], axis=0))
    print(f"| median | | {columns} |\n")
    pairs = [(one.advised, other) for one in found for other in one.random]
    for what in ("bound_m", "error_m"):
        a, b = np.array([[getattr(each, what) for each in pair] for pair in pairs]).T
        ratio = np.median(a / b)
        print(f"{what}: lower as advised in {(a < b).sum()} of {len(a)}, median ratio {ratio:.2f}")
    off = np.array([one.advised.bound_m / one.expected_m for one in found])
    print(f"bound / expected {off.min():.2f} to {off.max():.2f}, median {np.median(off):.2f}")
    print(f"left out: {'; '.join(left_out)}")


if __name__ == "__main__":
    main()
