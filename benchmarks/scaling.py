"""How time and memory of whole runs grow; and the tracker's kernels beside memory bandwidth.

Each row of a table is a run in a process of its own, without reading: a camera walks through a
simulated building (`hours.py`), whose images are made when they are asked for. Three quantities are
varied, one at a time:

- frames: 64 x 48 pixels, two rooms walked through in 1000 frames, again and again, with fresh
  noise;
- pixels: 64 x 48 to 1152 x 864 (1 megapixel), 60 frames of one room;
- rooms: 64 x 48 pixels, 300 frames a room.

Printed are wall time, CPU time in all and by stage, without that of making the images, peak memory,
and at the end of a table the exponent of each column: the slope of its logarithm against that of
what is varied, over the upper half of the rows. 1 is linear; fixed costs make it less.

    python benchmarks/scaling.py [frames pixels rooms] [--full] [--values 500 1000 ...]

The defaults end in about ten minutes; `--full` goes to 100,000 frames, 1 megapixel and 20 rooms,
which takes hours. `kernels` prints instead the CPU time of each kernel of the tracker on one
thread, with the lower bound from memory bandwidth, if each of its arrays is moved once; of a
synthetic room, or of a `--recording`.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

import hours
import tofuse
from stages import grouped
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.compute.thread_pool import run_chunks
from tofuse.engine.compute.thread_pool import threads as using_threads
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import Recording
from tofuse.engine.geometry import se3
from tofuse.engine.geometry.rays import homogeneous
from tofuse.engine.stopwatch import Stopwatch
from tofuse.engine.tracking.keyframes import Keyframes
from tofuse.formats.recordings.open import open_recording

LENGTH = 60  # frames of the sequence that is played forwards and backwards
BANDWIDTH_BYTES = 1 << 28


def made_pose(k: int) -> Float64:
    """T_world_camera (4, 4) of the k-th frame of the synthetic room."""
    return se3.exp([0.5 * np.sin(0.02 * k), 0, 0.004 * k, 0.1 * np.sin(0.05 * k), 0.012 * k, 0])


def made_frames(columns: int, count: int) -> list[RangeFrame]:
    """Frames of a room of 5 x 4 x 3 m with two boxes, with 2 mm of noise at 1 m."""
    rows = columns * 3 // 4
    camera = Pinhole(columns, rows, 0.9 * columns, 0.9 * columns, columns / 2 - 0.5, rows / 2 - 0.5)
    directions = homogeneous(camera.rays().reshape(-1, 2))
    frames = []
    for k in range(count):
        T = made_pose(k)
        outward = directions @ T[:3, :3].T
        z, axis = _room(T[:3, 3], outward)
        points = T[:3, 3] + z[:, None] * outward
        length = np.linalg.norm(outward, axis=1)
        cosine = np.abs(np.take_along_axis(outward, axis[:, None], 1)[:, 0]) / length
        albedo = 0.5 + 0.2 * np.sin(7 * points).sum(1) / 3
        signal = 4000 * albedo * cosine / (z * length) ** 2
        rng = np.random.default_rng([0, columns, k])
        z = z + 0.002 * z * z * rng.standard_normal(z.shape)
        signal = signal * (1 + 0.01 * rng.standard_normal(z.shape))
        depth, amplitude = (
            image.reshape(rows, columns).astype(np.float32) for image in (z, signal)
        )
        frames.append(RangeFrame(k, k / 30, camera, depth, amplitude_image=amplitude))
    return frames


def _room(origin: Float64, directions: Float64) -> tuple[Float64, Intp]:
    """Depths at which rays of unit z hit the room or two boxes, and the axis of the surface."""
    with np.errstate(divide="ignore"):
        inverse = 1 / directions
    low, high = np.array([-2.5, -1.5, -1.0]), np.array([2.5, 1.5, 3.0])
    walls = np.where(directions > 0, high - origin, low - origin) * inverse
    nearest, axis = walls.min(1), walls.argmin(1)
    for low, high in (
        (np.array([-1.2, 0.5, 1.2]), np.array([-0.4, 1.5, 2.0])),
        (np.array([0.6, 0.2, 1.8]), np.array([1.3, 1.5, 2.4])),
    ):
        a, b = (low - origin) * inverse, (high - origin) * inverse
        first = np.minimum(a, b)
        enter, leave = first.max(1), np.maximum(a, b).min(1)
        hit = (enter < leave) & (enter > 0) & (enter < nearest)
        nearest, axis = np.where(hit, enter, nearest), np.where(hit, first.argmax(1), axis)
    return nearest, axis


def recorded_frames(path: str, count: int) -> list[RangeFrame]:
    """Read the first frames of a recording."""
    frames = list(open_recording(path).select(end=count))
    return [f for f in frames if isinstance(f, RangeFrame)]


def tracker(columns: int) -> Any:
    """Return the default tracker, working at a number of columns."""
    options = Keyframes()
    return replace(options, views=replace(options.views, columns=columns)).start(0)


def forth_and_back(frames: Sequence[RangeFrame], count: int) -> Iterator[RangeFrame]:
    """Yield `count` frames: the sequence forwards, backwards, and so on."""
    period = [*range(len(frames)), *range(len(frames) - 2, 0, -1)]
    for k in range(count):
        yield replace(frames[period[k % len(period)]], index=k, timestamp=k / 30)


def timed(tracker: Any, frames: Iterator[RangeFrame]) -> tuple[Float64, int]:
    """Return the seconds of each push, and the number of frames with a pose."""
    seconds, posed = [], 0
    for frame in frames:
        start = time.perf_counter()
        step = tracker.push(frame)
        seconds.append(time.perf_counter() - start)
        posed += step.T_component_camera is not None and step.component == 0
    return np.array(seconds), posed


@dataclass
class Walk:
    """A source of images of a walk through a building, forwards, backwards and so on.

    `making_s` is the CPU time of making images.
    """

    rooms: int
    columns: int
    count: int
    per_room: int = 300
    reference: None = None
    odometry: None = None
    gravity: None = None
    warnings: list[str] = field(default_factory=list)
    metadata: dict[str, Any] = field(default_factory=dict)
    making_s: float = 0.0

    def __post_init__(self) -> None:
        self.timestamps = np.arange(self.count) / hours.RATE_HZ
        rows, focal = 3 * self.columns // 4, 0.65 * self.columns
        centre = self.columns / 2 - 0.5, rows / 2 - 0.5
        self._camera = Pinhole(self.columns, rows, focal, focal, *centre)
        self._scene = hours.building(self.rooms, 0)
        self._poses = hours.walk(self.rooms, self.per_room * self.rooms, 0)

    def read(self, index: int) -> RangeFrame:
        """Return image `index`."""
        start = time.thread_time()
        last = len(self._poses) - 1
        pose = self._poses[last - abs(last - index % (2 * last))]
        rng = np.random.default_rng([0, 2000, index])
        image = hours.image_of(self._scene, self._camera, pose, index, rng)
        self.making_s += time.thread_time() - start
        return image


# Of a value: what is walked through; and the values.
AXES = {
    "frames": (lambda n: Walk(2, 64, n, 500), (250, 500, 1000, 2000)),
    "pixels": (lambda n: Walk(1, n, 60), (64, 128, 256, 512)),
    "rooms": (lambda n: Walk(n, 64, 300 * n), (1, 2, 4)),
}
FULL = {
    "frames": (1000, 3000, 10_000, 30_000, 100_000),
    "pixels": (64, 128, 256, 512, 1152),
    "rooms": (1, 2, 5, 10, 20),
}


def whole_run(source: Walk, threads: int) -> None:
    """Reconstruct and write a result in this process, and print its figures for `growth`."""
    watch = Stopwatch()
    recording = Recording.of(source, "walk", "made")
    with watch.running(), tempfile.TemporaryDirectory() as folder:
        result = tofuse.reconstruct(recording, threads=threads)
        result.save(folder)
    stages = grouped(watch.cpu_seconds)
    # Images are made on other threads while the tracker works or waits.
    stages["tracking"] -= source.making_s
    figures = {"s": sum(watch.seconds.values()), "CPU s": sum(stages.values()), **stages}
    posed, loops = result.has_pose.mean(), sum(p.accepted for p in result.diagnostics.loops)
    print(json.dumps({"posed %": 100 * posed, "closed": loops, **figures}))


def growth(axis: str, values: Sequence[int], threads: int) -> Iterator[str]:
    """Lines of a table: a run for each value."""
    sizes, rows = [], []
    for value in values:
        command = [sys.executable, __file__, axis, "--values", str(value), "--run"]
        child = subprocess.Popen([*command, "--threads", str(threads)], stdout=subprocess.PIPE)
        assert child.stdout is not None
        printed = child.stdout.read()
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        if child.returncode:
            yield f"{value}: failed with status {child.returncode}"
            continue
        figures = json.loads(printed.splitlines()[-1]) | {"peak MB": usage.ru_maxrss / 1e3}
        if not rows:
            yield f"{axis:>8}" + "".join(f"{name:>11}" for name in figures)
        sizes.append(3 * value * value // 4 if axis == "pixels" else value)
        rows.append(list(figures.values()))
        yield f"{sizes[-1]:>8}" + "".join(f"{x:>11.{0 if x >= 100 else 2}f}" for x in rows[-1])
    upper = len(rows) // 2 - (len(rows) == 2)
    if len(rows) > 1:
        logs = np.log(np.maximum(rows[upper:], 1e-3))
        slopes = np.polyfit(np.log(sizes[upper:]), logs, 1)[0]
        yield f"{'exponent':>8}" + "".join(f"{slope:>11.2f}" for slope in slopes)


@dataclass
class KernelCost:
    """Cost of a kernel: calls, seconds, and the bytes of its arrays, each counted once."""

    calls: int = 0
    seconds: float = 0.0
    bytes: float = 0.0


@contextmanager
def watched_kernels() -> Iterator[dict[str, KernelCost]]:
    """Measure the CPU time of every kernel call from Python; kernels must be compiled."""
    costs: dict[str, KernelCost] = {}
    dispatcher = type(numba.njit(lambda: None))
    places = [
        (module, name, value)
        for key, module in list(sys.modules.items())
        if key.startswith("tofuse")
        for name, value in vars(module).items()
        if isinstance(value, dispatcher)
    ]
    for module, name, value in places:
        setattr(module, name, _watched(value, costs))
    try:
        yield costs
    finally:
        for module, name, value in places:
            setattr(module, name, value)


def _watched(function: Any, costs: dict[str, KernelCost]) -> Callable[..., Any]:
    def called(*arguments: Any) -> Any:
        start = time.thread_time()
        result = function(*arguments)
        seconds = time.thread_time() - start
        found = costs.setdefault(function.__name__, KernelCost())
        found.calls += 1
        found.seconds += seconds
        arrays = [a for a in _flat(arguments) if isinstance(a, np.ndarray)]
        # One call does all iterations of a level, and returns their number last.
        passes = result[-1] if function.__name__ == "iterate_level" else 1
        found.bytes += passes * _fraction(arguments, arrays) * sum(a.nbytes for a in arrays)
        return result

    return called


def _flat(arguments: Sequence[Any]) -> Iterator[Any]:
    for argument in arguments:
        yield from _flat(argument) if isinstance(argument, tuple) else (argument,)


def _fraction(arguments: Sequence[Any], arrays: Sequence[NDArray[Any]]) -> float:
    """Fraction of the rows that a call processes: the last arguments are (start, stop)."""
    ends = arguments[-2:]
    if len(ends) < 2 or not all(isinstance(e, int) for e in ends) or not arrays:
        return 1.0
    return float((ends[1] - ends[0]) / max(1, len(arrays[0])))


def bandwidth(count: int) -> float:
    """Bytes per second, read and written, of the fastest of ten copies of 256 MB.

    In CPU time on one thread, as the kernels are measured.
    """

    @numba.njit(nogil=True)
    def copy(source: Float64, target: Float64, start: int, stop: int) -> None:
        for i in range(start, stop):
            target[i] = source[i]

    source = np.ones(BANDWIDTH_BYTES // 8)
    target = np.zeros_like(source)
    copy(source, target, 0, 8)
    clock = time.thread_time if count == 1 else time.perf_counter
    best = np.inf
    with using_threads(count):
        for _ in range(10):
            start = clock()
            run_chunks(lambda a, b: copy(source, target, a, b), len(source), chunks=count)
            best = min(best, clock() - start)
    return 2 * BANDWIDTH_BYTES / best


def over_kernels(frames: Sequence[RangeFrame]) -> Iterator[str]:
    speed = bandwidth(1)
    yield f"copying moves {speed / 1e9:.1f} GB/s on one thread, {bandwidth(2) / 1e9:.1f} on two"
    columns = Keyframes().views.columns
    with using_threads(1):
        timed(tracker(columns), iter(frames[:3]))
        at_work = tracker(columns)
        with watched_kernels() as costs:
            start = time.thread_time()
            for frame in forth_and_back(frames, len(frames)):
                at_work.push(frame)
            whole = time.thread_time() - start
    n = len(frames)
    yield f"{'per frame':<20}{'calls':>7}{'ms':>8}{'MB':>8}{'bound, ms':>11}{'of the bound':>14}"
    for name, s in sorted(costs.items(), key=lambda item: -item[1].seconds):
        bound = s.bytes / speed
        yield (
            f"{name:<20}{s.calls / n:>7.1f}{1e3 * s.seconds / n:>8.2f}{s.bytes / n / 1e6:>8.2f}"
            f"{1e3 * bound / n:>11.2f}{s.seconds / bound:>13.1f}x"
        )
    inside = sum(s.seconds for s in costs.values())
    yield f"{'outside of kernels':<20}{'':>7}{1e3 * (whole - inside) / n:>8.2f}"
    yield f"{'in all':<20}{'':>7}{1e3 * whole / n:>8.2f}"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tables", nargs="*", choices=[*AXES, "kernels"])
    parser.add_argument("--values", type=int, nargs="+", help="frames, columns, or rooms")
    parser.add_argument("--full", action="store_true", help="to the largest sizes: hours")
    parser.add_argument("--recording", help="for kernels: instead of the synthetic room")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--run", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.run:
        whole_run(AXES[options.tables[0]][0](options.values[0]), options.threads)
        return
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    print(
        f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}; "
        f"{options.threads} threads{load}"
    )
    for table in options.tables or AXES:
        if table == "kernels":
            path = options.recording
            frames = recorded_frames(path, LENGTH) if path else made_frames(640, LENGTH)
            lines = over_kernels(frames)
        else:
            values = options.values or (FULL[table] if options.full else AXES[table][1])
            lines = growth(table, values, options.threads)
        print(f"\n{table}", flush=True)
        for line in lines:
            print(f"  {line}", flush=True)


if __name__ == "__main__":
    main()
