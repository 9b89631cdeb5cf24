"""Large steps between views: how often the search finds the pose, how fast, and what it tells.

Neighbours of recordings of which only every so many-th view is taken are searched for without a
hint, beside pairs that share nothing: views of different scenes, and views of one scene that look
elsewhere. What is right is known from the reference: within 0.15 m and 4 degrees.

    python benchmarks/large_steps.py [--sequences kinect kitchen room] [--mode auto both]
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent))

import sequences
from tofuse.geometry import se3
from tofuse.kernels.threads import threads
from tofuse.maps.surface_map import SurfaceMap, SurfaceOptions, surface_map
from tofuse.odometry.keyframes import Recovery
from tofuse.registration.agreement import agreement
from tofuse.registration.search import SearchOptions, search

Float64 = NDArray[np.float64]

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
RIGHT_M, RIGHT_DEG = 0.15, 4.0
# Pairs that share nothing, of each kind; views that share less than this see different places.
DECOYS, APART = 12, 0.02


@dataclass(frozen=True)
class Steps:
    """Which views of a sequence are taken: by index, or by how far the camera has moved."""

    sequence: str
    title: str
    every: int | None = None
    degrees: float = 13.0
    metres: float = 0.5
    most: int = 17
    closing: bool = False

    def choose(self, reference: Float64) -> list[int]:
        if self.every:
            return list(range(0, len(reference), self.every))[: self.most]
        chosen = [0]
        for k in range(len(reference)):
            step = se3.inverse(reference[chosen[-1]]) @ reference[k]
            far = np.linalg.norm(step[:3, 3]) >= self.metres
            if far or np.degrees(se3.angle(step)) >= self.degrees:
                chosen.append(k)
        return chosen[: self.most]


TAKEN = [
    Steps("kinect", "every view, and the loop's two ends", 1, closing=True),
    Steps("kitchen", "13 degrees or 0.5 m", most=17),
    Steps("room", "every 8th view, 22 degrees", 8),
    Steps("room", "every 10th view, 28 degrees", 10),
    Steps("room", "every 12th view, 34 degrees", 12),
    Steps("empty-room", "every 8th view", 8),
]


@dataclass(frozen=True)
class Outcome:
    """Of one pair: does the best pose agree with the reference, and what was said of it."""

    right: bool
    score: float
    margin: float
    believed: bool
    seconds: float


@dataclass(frozen=True)
class Views:
    steps: Steps
    views: list[SurfaceMap]
    reference: Float64


def load(steps: Steps, data: Path) -> Views:
    sequence = sequences.load(steps.sequence, data)
    chosen = steps.choose(sequence.reference)
    views = [surface_map(sequence.frames[k], SurfaceOptions()) for k in chosen]
    return Views(steps, views, sequence.reference[chosen])


def look(
    source: SurfaceMap, target: SurfaceMap, true: Float64 | None, options: SearchOptions
) -> Outcome:
    """Search for one pair on one core."""
    with threads(1):
        start = time.process_time()
        found = search(source, target, options)
        seconds = time.process_time() - start
    if found is None:
        return Outcome(False, 0.0, 0.0, False, seconds)
    right = False
    if true is not None:
        off = se3.inverse(true) @ found.T_target_source
        near = np.linalg.norm(off[:3, 3]) < RIGHT_M
        right = bool(near and np.degrees(se3.angle(off)) < RIGHT_DEG)
    return Outcome(right, found.score, found.margin, Recovery().believes(found), seconds)


def neighbours(taken: Views, options: SearchOptions) -> list[Outcome]:
    n = len(taken.views)
    pairs = [(k + 1, k) for k in range(n - 1)] + ([(n - 1, 0)] if taken.steps.closing else [])
    T = taken.reference
    look(taken.views[0], taken.views[0], None, options)  # warm
    return [
        look(taken.views[i], taken.views[j], se3.inverse(T[j]) @ T[i], options) for i, j in pairs
    ]


def decoys(all_taken: list[Views], options: SearchOptions) -> list[Outcome]:
    """Pairs of different scenes, and of views of one scene that share nothing."""
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
                    if i <= j or agreement(u, v, T).overlap > APART:
                        continue
                outcomes.append(look(u, v, None, options))
                taken += 1
                if taken == DECOYS:
                    break
    return outcomes


def roc_area(right: list[Outcome], wrong: list[Outcome], of: Callable[[Outcome], float]) -> float:
    """Share of pairs of a right and a wrong answer that a figure ranks rightly."""
    a = np.array([of(outcome) for outcome in right])[:, None]
    b = np.array([of(outcome) for outcome in wrong])[None]
    return float(((a > b) + 0.5 * (a == b)).mean()) if a.size and b.size else float("nan")


def print_table(title: str, outcomes: list[Outcome]) -> None:
    right = sum(o.right for o in outcomes)
    believed = sum(o.right and o.believed for o in outcomes)
    wrong = sum(o.believed and not o.right for o in outcomes)
    seconds = np.median([o.seconds for o in outcomes])
    print(
        f"| {title} | {right} of {len(outcomes)} | {believed} | {wrong} | {seconds:.2f} |",
        flush=True,
    )


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--sequences", nargs="*", default=["kinect", "kitchen", "room"])
    parser.add_argument("--mode", nargs="*", default=["auto", "both"])
    given = parser.parse_args(arguments)
    taken = []
    for steps in TAKEN:
        if steps.sequence in given.sequences:
            try:
                taken.append(load(steps, given.data))
            except FileNotFoundError:
                print(f"{steps.sequence}: no data")
    for mode in given.mode:
        options = SearchOptions(mode=mode)
        print(f"\nMode {mode}\n")
        print("| Views | Right | Believed and right | Believed and wrong | s a pair, one core |")
        print("|---|---|---|---|---|")
        outcomes = []
        for views in taken:
            mine = neighbours(views, options)
            outcomes += mine
            title = sequences.KINDS[views.steps.sequence].title
            print_table(f"{title}: {views.steps.title}", mine)
        nothing = decoys(taken, options)
        print_table("pairs that share nothing", nothing)
        right = [o for o in outcomes if o.right]
        wrong = [o for o in outcomes if not o.right] + nothing
        print(f"\n{len(right)} right answers, {len(wrong)} wrong ones; ROC area:", end=" ")
        print(f"score {roc_area(right, wrong, lambda o: o.score):.3f},", end=" ")
        print(f"margin {roc_area(right, wrong, lambda o: o.margin):.3f}\n")
        print("| Margin at least | right kept, score 0.2 | wrong kept | 0.3 | | 0.4 | |")
        print("|---|---|---|---|---|---|---|")
        for margin in (0.0, 0.01, 0.02, 0.03, 0.05, 0.1):
            cells = []
            for score in (0.2, 0.3, 0.4):
                for group in (right, wrong):
                    kept = sum(o.score >= score and o.margin >= margin for o in group)
                    cells.append(f"{kept / max(len(group), 1):.0%}")
            print(f"| {margin} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
