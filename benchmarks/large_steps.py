"""Wide baselines: success rates of methods that need no initial guess.

`steps` registers pairs of views with relative rotations of 10 to 60 degrees by every method that
needs no initial guess: exhaustive search, SIFT, ORB and FAST features, planes, and FPFH. `search`
tests the exhaustive search alone, with and without albedo, on consecutive views of subsampled
recordings and on pairs without overlap: views of different scenes, and of different parts of one
scene. A pose is right within 0.15 m and 4 degrees of the reference.

    python benchmarks/large_steps.py steps [--sequences room kitchen] [--pairs 8]
    python benchmarks/large_steps.py search [--sequences kinect kitchen room] [--mode both auto]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

import sequences
from scoring import roc_area
from tofuse.engine.arrays import Float64
from tofuse.engine.compute.thread_pool import threads
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.search.pair_agreement import agreement
from tofuse.engine.search.search_grid import SearchOptions
from tofuse.engine.search.view_pair import register_pair
from tofuse.engine.views.prepared_view import PreparedView, prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions
from tofuse.lab.methods.features import Features
from tofuse.lab.methods.fpfh import Fpfh
from tofuse.lab.methods.plane_sets import PlaneSets

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
RIGHT_M, RIGHT_DEG = 0.15, 4.0
# Views with less overlap than this show different places.
MIN_OVERLAP = 0.02


@dataclass(frozen=True)
class Steps:
    """Subsampling of a sequence: by index, or by camera motion."""

    sequence: str
    title: str
    every: int | None = None
    degrees: float = 13.0
    metres: float = 0.5
    max_views: int = 17
    closing: bool = False

    def choose(self, reference: Float64) -> list[int]:
        if self.every:
            return list(range(0, len(reference), self.every))[: self.max_views]
        chosen = [0]
        for k in range(len(reference)):
            step = se3.inverse(reference[chosen[-1]]) @ reference[k]
            far = np.linalg.norm(step[:3, 3]) >= self.metres
            if far or np.degrees(se3.angle(step)) >= self.degrees:
                chosen.append(k)
        return chosen[: self.max_views]


TAKEN = [
    Steps("room", "every 8th view, 22 degrees", 8),
    Steps("room", "every 10th view, 28 degrees", 10),
    Steps("room", "every 12th view, 34 degrees", 12),
    Steps("empty-room", "every 8th view, 22 degrees", 8),
    Steps("empty-room", "every 10th view, 27 degrees", 10),
    Steps("empty-room", "every 12th view, 32 degrees", 12),
    Steps("kinect", "every view, and the loop's two ends", 1, closing=True),
    Steps("kitchen", "13 degrees or 0.5 m"),
    Steps("kitchen", "26 degrees or 0.9 m", degrees=26.0, metres=0.9),
]


@dataclass(frozen=True)
class Outcome:
    """Result for one pair: correctness, stated probability, acceptance, and CPU seconds."""

    right: bool
    probability: float
    accepted: bool
    seconds: float


@dataclass(frozen=True)
class Views:
    steps: Steps
    views: list[PreparedView]
    reference: Float64


sequence_of = lru_cache(maxsize=1)(sequences.load)


def load(steps: Steps, data: Path) -> Views:
    sequence = sequence_of(steps.sequence, data)
    chosen = steps.choose(sequence.reference)
    views = [prepare_view(sequence.frames[k], SurfaceOptions()) for k in chosen]
    return Views(steps, views, sequence.reference[chosen])


def without_albedo(taken: Views) -> Views:
    """The same views as of a camera without amplitude."""
    bare = [
        replace(view, albedo=np.full_like(view.albedo, np.nan), has_albedo=False)
        for view in taken.views
    ]
    return replace(taken, views=bare)


def search_pair(
    source: PreparedView, target: PreparedView, true: Float64 | None, options: SearchOptions
) -> Outcome:
    """Search for the pose of one pair on one core."""
    with threads(1):
        start = time.process_time()
        found = register_pair(source, target, options=options, always_search=True)
        seconds = time.process_time() - start
    if found is None:
        return Outcome(False, 0.0, False, seconds)
    right = False
    if true is not None:
        right = is_right(found.T_target_source, true)
    return Outcome(right, found.probability or 0.0, bool(found.believed), seconds)


def neighbours(taken: Views, options: SearchOptions) -> list[Outcome]:
    n = len(taken.views)
    pairs = [(k + 1, k) for k in range(n - 1)] + ([(n - 1, 0)] if taken.steps.closing else [])
    T = taken.reference
    search_pair(taken.views[0], taken.views[0], None, options)  # warm
    return [
        search_pair(taken.views[i], taken.views[j], se3.inverse(T[j]) @ T[i], options)
        for i, j in pairs
    ]


def decoys(all_taken: list[Views], options: SearchOptions, max_pairs: int) -> list[Outcome]:
    """Search pairs without overlap, of different scenes and of one; `max_pairs` of each kind."""
    rng = np.random.default_rng([1, 2])
    outcomes = []
    for a, first in enumerate(all_taken):
        for second in all_taken[a:]:
            same = first.steps.sequence == second.steps.sequence
            if same and first is not second:
                continue
            pairs = [(i, j) for i in range(len(first.views)) for j in range(len(second.views))]
            rng.shuffle(pairs)
            taken = 0
            for i, j in pairs:
                u, v = first.views[i], second.views[j]
                if same:
                    T = se3.inverse(second.reference[j]) @ first.reference[i]
                    if i <= j or agreement(u, v, T).overlap > MIN_OVERLAP:
                        continue
                outcomes.append(search_pair(u, v, None, options))
                taken += 1
                if taken == max_pairs:
                    break
    return outcomes


def summary(outcomes: list[Outcome]) -> str:
    """Summarise how many are right, right and accepted, and wrong but accepted."""
    right = sum(o.right for o in outcomes)
    accepted = sum(o.right and o.accepted for o in outcomes)
    wrong = sum(o.accepted and not o.right for o in outcomes)
    return f"{right} of {len(outcomes)}, {accepted} accepted" + f", {wrong} wrong" * (wrong > 0)


def print_row(title: str, bare: list[Outcome], full: list[Outcome]) -> None:
    seconds = np.median([o.seconds for o in full])
    print(f"| {title} | {summary(bare)} | {summary(full)} | {seconds:.2f} |", flush=True)


# Relative rotations of the pairs and their tolerance, degrees.
TURNS, TURN_TOLERANCE = (10, 20, 30, 40, 50, 60), 4.0

Method = Callable[[RangeFrame, RangeFrame], Float64 | None]


def searched(source: RangeFrame, target: RangeFrame) -> Float64 | None:
    """The accepted pose of the exhaustive search, if any."""
    options = SurfaceOptions()
    views = prepare_view(source, options), prepare_view(target, options)
    found = register_pair(*views, options=SearchOptions(mode="auto"), always_search=True)
    return found.T_target_source if found is not None and found.believed else None


def by_part(part: Features | Fpfh | PlaneSets) -> Method:
    """A method that returns the pose found by a part, if any."""

    def found(source: RangeFrame, target: RangeFrame) -> Float64 | None:
        try:
            return part.register(
                source, target, np.eye(4), np.random.default_rng(0)
            ).T_target_source
        except RegistrationError:
            return None

    return found


METHODS: dict[str, Method] = {
    "exhaustive search": searched,
    "SIFT": by_part(Features("sift")),
    "ORB": by_part(Features("orb")),
    "FAST": by_part(Features("fast")),
    "planes": by_part(PlaneSets()),
    "FPFH": by_part(Fpfh()),
}


def turned(reference: Float64, degrees: float, max_pairs: int) -> list[tuple[int, int]]:
    """Pairs of views with about this relative rotation, evenly over the recording."""
    found = []
    for k in range(len(reference)):
        angles = np.degrees(se3.angle(se3.inverse(reference[k]) @ reference[k + 1 :]))
        near = np.flatnonzero(np.abs(angles - degrees) < TURN_TOLERANCE)
        if len(near):
            found.append((k, k + 1 + int(near[0])))
    return found[:: max(1, -(-len(found) // max_pairs))]


def print_steps(name: str, data: Path, frames: int | None, max_pairs: int) -> None:
    """Print right and wrong poses, and the number of pairs, by method and rotation."""
    sequence = sequences.load(name, data, frames)
    pairs = {degrees: turned(sequence.reference, degrees, max_pairs) for degrees in TURNS}
    print(f"\n{sequence.title}\n")
    print(f"| Method | {' | '.join(f'{d} degrees' for d in TURNS)} | s/pair, one core |")
    print(f"|---|{'---|' * (len(TURNS) + 1)}")
    T = sequence.reference
    for title, method in METHODS.items():
        cells, seconds = [], []
        method(sequence.frames[0], sequence.frames[1])  # warm
        for degrees in TURNS:
            right = wrong = 0
            for i, j in pairs[degrees]:
                with threads(1):
                    start = time.process_time()
                    found = method(sequence.frames[j], sequence.frames[i])
                    seconds.append(time.process_time() - start)
                if found is not None:
                    good = is_right(found, se3.inverse(T[i]) @ T[j])
                    right, wrong = right + good, wrong + (not good)
            cells.append(f"{right} of {len(pairs[degrees])}" + f", {wrong} wrong" * (wrong > 0))
        print(f"| {title} | {' | '.join(cells)} | {np.median(seconds):.2f} |", flush=True)


def is_right(found: Float64, true: Float64) -> bool:
    error = se3.inverse(true) @ found
    near = np.linalg.norm(error[:3, 3]) < RIGHT_M
    return bool(near and np.degrees(se3.angle(error)) < RIGHT_DEG)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["steps", "search"])
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--sequences", nargs="*", default=None)
    parser.add_argument(
        "--frames", type=int, default=None, help="frames of each sequence, in 'steps'"
    )
    parser.add_argument("--pairs", type=int, default=8, help="pairs per rotation, in 'steps'")
    parser.add_argument("--mode", nargs="*", default=["both"], help="in 'search'")
    parser.add_argument(
        "--decoys", type=int, default=2, help="pairs without overlap, of each kind, in 'search'"
    )
    given = parser.parse_args(arguments)
    if given.what == "steps":
        for name in given.sequences or ["room", "empty-room", "kitchen"]:
            try:
                print_steps(name, given.data, given.frames, given.pairs)
            except FileNotFoundError:
                print(f"{name}: no data")
        return
    names = given.sequences or ["room", "empty-room", "kinect", "kitchen"]
    print_search(names, given.data, given.mode, given.decoys)


def print_search(names: list[str], data: Path, modes: list[str], max_pairs: int) -> None:
    """Print success rates of the exhaustive search, and the ROC area of its probability."""
    taken = []
    for steps in TAKEN:
        if steps.sequence in names:
            try:
                taken.append(load(steps, data))
            except FileNotFoundError:
                print(f"{steps.sequence}: no data")
    for mode in modes:
        options = SearchOptions(mode=mode)
        print(f"\nMode {mode}\n")
        print("| Neighbours | geometry alone | with albedo | s/pair, one core |")
        print("|---|---|---|---|")
        outcomes = []
        for views in taken:
            mine = neighbours(views, options)
            outcomes += mine
            title = sequences.KINDS[views.steps.sequence].title
            bare = neighbours(without_albedo(views), options)
            print_row(f"{title}: {views.steps.title}", bare, mine)
        bare = decoys([without_albedo(views) for views in taken], options, max_pairs)
        decoy_outcomes = decoys(taken, options, max_pairs)
        print_row("pairs without overlap", bare, decoy_outcomes)
        every = outcomes + decoy_outcomes
        right = np.array([o.right for o in outcomes] + [False] * len(decoy_outcomes))
        area = roc_area(np.array([o.probability for o in every]), right)
        print(f"\n{right.sum()} right answers, {(~right).sum()} wrong ones; ", end="")
        print(f"ROC area: probability {area:.3f}")


if __name__ == "__main__":
    main()
