"""What the global part costs: loops, the pose graph and the refinement of all views together.

Images of 640 x 480 (the recorded kitchen) go there and back again, as often as it takes, so that
there are loops. Printed are

- how fast pairs of views that overlap are aligned and verified: there and back, with covariance,
  from the poses that the tracker gave them,
- for so many frames, the seconds of each part, the views and pairs that took part, and the
  refinement's time for each pair.

Times are wall clock on the given number of threads, with process time beside them for pairs. The
kernels have been compiled before.

    python benchmarks/global_speed.py [--frames 250 500 1000] [--pairs 1000] [--threads 2]
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import sequences
from tofuse.fusion.options import Fusion
from tofuse.kernels.threads import run_chunks, threads
from tofuse.maps.surface_map import SurfaceMap, surface_map
from tofuse.odometry.keyframes import Keyframes
from tofuse.pipeline.config import from_method
from tofuse.pipeline.mapper import Mapper
from tofuse.posegraph.revisits import Revisits
from tofuse.posegraph.views import KeptView, Spacing, ViewStore, overlaps
from tofuse.recordings.frames import RangeFrame
from tofuse.results.types import Reconstruction


def there_and_back(frames: list[RangeFrame], count: int) -> Iterator[RangeFrame]:
    """So many frames, from the first to the last and back again, as often as it takes."""
    order = [*range(len(frames)), *range(len(frames) - 2, 0, -1)]
    for k in range(count):
        yield replace(frames[order[k % len(order)]], index=k, timestamp=k / 30)


def mapped(frames: list[RangeFrame], count: int) -> Reconstruction:
    """The default method, all but the model: voxels are coarse, and nothing is filtered for it."""
    config = replace(from_method("default"), model_filters=(), fusion=Fusion(voxel_m=0.1))
    mapper = Mapper(config)
    for frame in there_and_back(frames, count):
        mapper.push(frame)
    return mapper.finish()


def pairs(frames: list[RangeFrame], result: Reconstruction, most: int) -> str:
    """Align and verify pairs of views that overlap by a half, as if they were loops."""
    closer = Revisits(spacing=Spacing(0.03, 0.015, 200))
    loops = closer.start(0)
    store: ViewStore[SurfaceMap] = ViewStore(closer.spacing)
    poses = result.diagnostics.sequential
    options = Keyframes().surface
    for k, frame in enumerate(there_and_back(frames, len(frames))):
        if result.has_pose[k]:
            surface = surface_map(frame, options).thinned(200)
            loops.push(frame, poses[k], surface)
            store.push(surface, poses[k])
    views = [KeptView.of(surface, 600) for surface in store.views]
    at = np.array([view.surface.index for view in views])
    found = overlaps(views, poses[at], 0.5)[0]
    chosen = found[np.unique(np.linspace(0, len(found) - 1, min(most, len(found))).astype(int))]

    def work(a: int, _: int) -> bool:
        i, j = chosen[a]
        loop = loops._confirm(views[i].surface, views[j].surface)
        return loop.record.accepted

    wall, cpu = time.perf_counter(), time.process_time()
    accepted = sum(run_chunks(work, len(chosen), len(chosen)))
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    n = max(len(chosen), 1)
    return (
        f"{n} pairs in {wall:.1f} s: {1e3 * wall / n:.1f} ms a pair, {1e3 * cpu / n:.1f} ms of "
        f"process time; {accepted} accepted"
    )


def row(result: Reconstruction) -> str:
    """One line of the table."""
    d = result.diagnostics
    loops, graph, refinement = (
        d.seconds.get(name, 0.0) for name in ("loops", "optimisation", "refinement")
    )
    count = d.refinement.pairs
    return (
        f"{len(result.trajectory):6} {len(d.loops):6} {loops:8.1f} {graph:6.1f} "
        f"{d.refinement.views:6} {count:6} {refinement:11.1f} "
        f"{1e3 * refinement / max(count, 1):10.2f} {loops + graph + refinement:8.1f}"
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
        print(f"{missing}: not there, so nothing is measured", file=sys.stderr)
        return 0
    half = recording.select(end=max(options.frames) // 2 + 1)
    frames = [f for f in half if isinstance(f, RangeFrame)]
    with threads(options.threads):
        print(
            f"{'frames':>6} {'loops':>6} {'loops s':>8} {'graph':>6} {'views':>6} {'pairs':>6} "
            f"{'refinement':>11} {'ms a pair':>10} {'all s':>8}"
        )
        mapped(frames, 30)
        for count in options.frames:
            result = mapped(frames, count)
            print(row(result), flush=True)
        print(pairs(frames, result, options.pairs))
    return 0


if __name__ == "__main__":
    sys.exit(main())
