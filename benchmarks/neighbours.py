"""Nearest neighbours by tofuse's k-d tree and by SciPy's: CPU time on one thread, and results.

    python benchmarks/neighbours.py

Points are two frames of the simulated room, and random ones. Each time is the median of seven runs,
warm. "Different" counts queries whose nearest point differs (equally near points are ties, of which
ours finds the one with the lowest index).
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).resolve().parent))

from sequences import DATA, KINDS
from tofuse.engine.arrays import Float64
from tofuse.engine.compute.thread_pool import threads
from tofuse.engine.geometry.kdtree import KdTree

_REPEATS, _K = 7, 12


def cases() -> Iterator[tuple[str, Float64, Float64]]:
    """Yield a name, points and queries."""
    recording = KINDS["room"].open(DATA)
    a, b = (recording[k].points.astype(float) for k in (0, 1))
    yield "a frame, 1000 points of the next", a, b[:: len(b) // 1000][:1000]
    yield "a frame, all points of the next", a, b
    rng = np.random.default_rng(0)
    yield "random", rng.normal(size=(300_000, 3)), rng.normal(size=(300_000, 3))


def milliseconds(work: Callable[[], object]) -> float:
    """Median CPU time."""
    work()
    taken = []
    for _ in range(_REPEATS):
        start = time.process_time()
        work()
        taken.append(time.process_time() - start)
    return 1e3 * float(np.median(taken))


def rows(name: str, points: Float64, queries: Float64) -> Iterator[str]:
    """Yield the rows of a case."""
    ours, theirs = KdTree(points), cKDTree(points)
    different = int((ours.nearest(queries)[0] != theirs.query(queries)[1]).sum())
    works: list[tuple[str, Callable[[], object], Callable[[], object], str]] = [
        ("build", lambda: KdTree(points), lambda: cKDTree(points), ""),
        (
            "nearest",
            lambda: ours.nearest(queries),
            lambda: theirs.query(queries),
            str(different),
        ),
        (
            f"{_K} nearest",
            lambda: ours.neighbours(queries, _K),
            lambda: theirs.query(queries, _K),
            "",
        ),
    ]
    for what, own, other, found in works:
        times = f"{milliseconds(own):.2f} | {milliseconds(other):.2f}"
        yield f"| {name}: {len(points)}, {len(queries)} | {what} | {times} | {found} |"


def main() -> None:
    print("| points, queries | | tofuse ms | SciPy ms | different |\n|---|---|---|---|---|")
    with threads(1):
        for case in cases():
            for row in rows(*case):
                print(row, flush=True)


if __name__ == "__main__":
    main()
