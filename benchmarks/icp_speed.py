"""Throughput of Algorithm 1 on pairs of consecutive views, compared with its peers.

The views are those of the simulated room, or of a recording, after the filters of the thesis.
Simulation, reading and filtering are not timed; sampling the points, building the tree and all
iterations are. Every row is measured after a warm-up pair. Peers get the same sampled points,
distance threshold and initial guess, and use their own stopping criteria. Rows of one run are
comparable with each other, not with those of another machine.

    python benchmarks/icp_speed.py [RECORDING] [--frames 128] [--threads 1 2]
"""

from __future__ import annotations

import argparse
import importlib
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.compute.thread_pool import threads
from tofuse.engine.filters.base import apply_filters
from tofuse.engine.frames.frames import Frame
from tofuse.engine.geometry import se3
from tofuse.engine.icp.icp import algorithm_1
from tofuse.engine.icp.icp_parts import Random
from tofuse.engine.mapping.methods import thesis

POINTS = 1000
RESOLUTION_M = 0.01
EPSILON = 1e-4
MAX_ITERATIONS = 100


@dataclass(frozen=True)
class Answer:
    T_target_source: Float64
    iterations: int | None


# Registers view k to view k - 1.
Method = Callable[[int], Answer]


def tofuse(views: Sequence[Frame], points: int | None) -> Method:
    icp = algorithm_1(RESOLUTION_M, points, EPSILON, max_iterations=MAX_ITERATIONS)

    def register(k: int) -> Answer:
        found = icp.register(views[k], views[k - 1], np.eye(4), generator(k))
        return Answer(found.T_target_source, found.iterations)

    return register


def open3d(views: Sequence[Frame]) -> Method:
    o3d = importlib.import_module("open3d")
    method = o3d.pipelines.registration
    estimation = method.TransformationEstimationPointToPoint()
    criteria = method.ICPConvergenceCriteria(max_iteration=MAX_ITERATIONS)

    def register(k: int) -> Answer:
        source, target = (
            o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in drawn(views, k)
        )
        found = method.registration_icp(
            source, target, 2 * RESOLUTION_M, np.eye(4), estimation, criteria
        )
        return Answer(np.asarray(found.transformation), None)

    return register


def small_gicp(views: Sequence[Frame], count: int) -> Method:
    peer = importlib.import_module("small_gicp")

    def register(k: int) -> Answer:
        source, target = (peer.PointCloud(p) for p in drawn(views, k))
        found = peer.align(
            target,
            source,
            peer.KdTree(target, num_threads=count),
            registration_type="ICP",
            max_correspondence_distance=2 * RESOLUTION_M,
            num_threads=count,
            max_iterations=MAX_ITERATIONS,
        )
        return Answer(found.T_target_source, found.iterations)

    return register


def generator(k: int) -> np.random.Generator:
    return np.random.default_rng([0, 1, k, k - 1])


def drawn(views: Sequence[Frame], k: int) -> tuple[Float64, Float64]:
    """Return the points of source and target that tofuse samples for the pair."""
    rng, selector = generator(k), Random(POINTS)
    source = views[k].points[selector.select(views[k], rng)]
    target = views[k - 1].points[selector.select(views[k - 1], rng)]
    return source.astype(np.float64), target.astype(np.float64)


def filtered_views(path: str | None, frames: int) -> tuple[list[Frame], Float64 | None]:
    """Return the views after the filters of the thesis, and their true poses if known."""
    if path is None:
        from tofuse.lab.simulation.record import simulate_recording

        recording = simulate_recording("room", frames=frames)
    else:
        from tofuse.formats.recordings.open import open_recording

        recording = open_recording(path).select(end=frames)
    views = [apply_filters(thesis("range").filters, frame)[0] for frame in recording]
    return views, recording.reference


def row(name: str, count: int, points: str, method: Method, truth: Float64 | None, n: int) -> str:
    seconds, answers = [], []
    with threads(count):
        method(1)
        for k in range(1, n):
            start = time.perf_counter()
            answers.append(method(k))
            seconds.append(time.perf_counter() - start)
    iterations = [a.iterations for a in answers if a.iterations is not None]
    mean_iterations = f"{np.mean(iterations):.0f}" if iterations else "-"
    error = "-"
    if truth is not None:
        true = se3.inverse(truth[: n - 1]) @ truth[1:n]
        found = np.array([a.T_target_source for a in answers])
        error = f"{1e3 * np.nanmedian(np.linalg.norm((found - true)[:, :3, 3], axis=1)):.1f}"
    return (
        f"{name:<30}{count:>8}{points:>8}{mean_iterations:>12}"
        f"{1 / np.median(seconds):>16.0f}{len(seconds) / sum(seconds):>8.0f}{error:>17}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", nargs="?", help="instead of the simulated room")
    parser.add_argument("--frames", type=int, default=128)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    options = parser.parse_args()

    views, truth = filtered_views(options.recording, options.frames)
    sizes = [len(view) for view in views]
    print(f"{options.recording or 'simulated room'}: {len(views)} views of {np.median(sizes):.0f}")
    print(f"points after filters (median); res {RESOLUTION_M} m, epsilon {EPSILON}, warm,")
    print(f"initial guess: identity; {platform.machine()}, Python {platform.python_version()}\n")
    print(
        f"{'method':<30}{'threads':>8}{'points':>8}{'iterations':>12}"
        f"{'pairs/s: median':>16}{'mean':>8}{'median error, mm':>17}"
    )
    for count in options.threads:
        rows: list[tuple[str, str, Callable[[], Method]]] = [
            ("tofuse Algorithm 1", str(POINTS), lambda: tofuse(views, POINTS)),
            ("tofuse Algorithm 1", "all", lambda: tofuse(views, None)),
            ("Open3D point-to-point", str(POINTS), lambda: open3d(views)),
            ("small_gicp ICP", str(POINTS), lambda count=count: small_gicp(views, count)),
        ]
        for name, points, prepare in rows:
            try:
                method = prepare()
            except ImportError:
                print(f"{name:<30}{count:>8}{points:>8}  not installed")
                continue
            print(row(name, count, points, method, truth, len(views)))


if __name__ == "__main__":
    main()
