"""Cost of the back end: loop closure, pose graph and joint refinement of all views.

Images of 640 x 480 (the recorded kitchen) are played forwards and backwards, so that there are
loops. Printed are

- the speed of aligning and verifying pairs of overlapping views: in both directions, with
  covariance, from the tracker's poses,
- for each number of frames, the seconds of each stage, the number of views and pairs, and the
  refinement's time per pair.

Times are wall-clock times on the given number of threads, and CPU times, which depend less on other
load. All kernels are compiled beforehand.

    python benchmarks/global_speed.py [--frames 250 500 1000] [--pairs 1000] [--threads 2]
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import sequences
from scaling import forth_and_back
from tofuse.engine.compute.thread_pool import run_chunks, threads
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.fusion.options import Fusion
from tofuse.engine.loops.revisits import Revisits
from tofuse.engine.mapping.mapper import Mapper
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.results.types import Reconstruction
from tofuse.engine.search.search import Search
from tofuse.engine.stored_views.view_store import SampledView, Spacing, ViewStore, overlaps
from tofuse.engine.tracking.keyframes import Keyframes
from tofuse.engine.views.prepared_view import PreparedView, prepare_view


def mapped(frames: list[RangeFrame], count: int) -> Reconstruction:
    """Run the default method with a minimal model: coarse voxels, no filters."""
    config = replace(from_method("default"), model_filters=(), fusion=Fusion(voxel_m=0.1))
    mapper = Mapper(config)
    for frame in forth_and_back(frames, count):
        mapper.push(frame)
    return mapper.finish()


def pairs(frames: list[RangeFrame], result: Reconstruction, max_pairs: int) -> str:
    """Align and verify pairs of views with an overlap of one half, as for loop closures."""
    closer = Spacing(0.03, 0.015, 200)
    store: ViewStore[PreparedView] = ViewStore(closer)
    loops = Revisits().start(0, (), store, spacing=closer)
    poses = result.diagnostics.sequential
    options = Keyframes().views.surface
    for k, frame in enumerate(forth_and_back(frames, len(frames))):
        if result.has_pose[k]:
            surface = prepare_view(frame, options).subsampled(200)
            store.push(surface, poses[k])
            loops.push(frame, poses[k])
    views = [SampledView.of(posed.view, 600) for posed in store.views]
    at = np.array([view.index for view in views])
    found = overlaps(views, poses[at], 0.5)[0]
    chosen = found[
        np.unique(np.linspace(0, len(found) - 1, min(max_pairs, len(found))).astype(int))
    ]

    def work(a: int, _: int) -> bool:
        i, j = chosen[a]
        loop = loops._confirm(store.views[i], store.views[j])
        return loop.record.accepted

    wall, cpu = time.perf_counter(), time.process_time()
    accepted = sum(run_chunks(work, len(chosen), len(chosen)))
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    n = max(len(chosen), 1)
    return (
        f"{n} pairs in {wall:.1f} s: {1e3 * wall / n:.1f} ms per pair, {1e3 * cpu / n:.1f} ms of "
        f"CPU time; {accepted} accepted"
    )


PARTS = ("loops", "optimisation", "refinement")


def row(result: Reconstruction) -> str:
    """One line of the table: wall / CPU seconds."""
    d = result.diagnostics
    wall, cpu = ([of.get(part, 0.0) for part in PARTS] for of in (d.seconds, d.cpu_seconds))
    count = d.refinement.pairs
    both = [f"{a:.1f} / {b:.1f}" for a, b in zip(wall, cpu, strict=True)]
    return (
        f"{len(result.trajectory):6} {len(d.loops):6} {both[0]:>12} {both[1]:>12} "
        f"{d.refinement.views:6} {count:6} {both[2]:>13} "
        f"{1e3 * cpu[2] / max(count, 1):10.2f} {f'{sum(wall):.1f} / {sum(cpu):.1f}':>13}"
    )


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, nargs="+", default=[250, 500, 1000])
    parser.add_argument("--pairs", type=int, default=1000)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--data", type=Path, default=sequences.DATA)
    options = parser.parse_args(arguments)
    try:
        recording = sequences.KINDS["kitchen"].open(options.data)
    except FileNotFoundError as missing:
        print(f"{missing}: no data, nothing is measured", file=sys.stderr)
        return 0
    half = recording.select(end=max(options.frames) // 2 + 1)
    frames = [f for f in half if isinstance(f, RangeFrame)]
    with threads(options.threads):
        print(
            "wall / CPU seconds; CPU ms per pair\n"
            f"{'frames':>6} {'loops':>6} {'detection':>12} {'graph':>12} {'views':>6} "
            f"{'pairs':>6} {'refinement':>13} {'ms/pair':>10} {'all':>13}"
        )
        mapped(frames, 30)
        ends = [prepare_view(frames[k], Keyframes().views.surface) for k in (0, -1)]
        search = Search.of(ends[0], ends[1])
        assert search is not None
        search.exhaustive()
        for count in options.frames:
            result = mapped(frames, count)
            print(row(result), flush=True)
        print(pairs(frames, result, options.pairs))
    return 0


if __name__ == "__main__":
    sys.exit(main())
