"""Scaling of the tracker's time and memory, and its kernels compared with memory bandwidth.

Four tables: time per frame over resolution; time and memory over the number of frames, with the
sequence played forwards and backwards; compilation in a new process with an empty cache; and the
CPU time of each kernel on one thread, with the lower bound from memory bandwidth, if each of its
arrays is moved once. The frames are those of a synthetic room, or of a recording. All but the
compilation is measured warm.

With `--whole` the memory of whole runs is printed instead, without reading and writing.

    python benchmarks/scaling.py [RECORDING] [--columns 160 320 640] [--counts 500 1000 5000]
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.cameras.cameras import Pinhole, scaled
from tofuse.engine.compute.thread_pool import run_chunks
from tofuse.engine.compute.thread_pool import threads as using_threads
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.mapping.mapper import Mapper
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
    rays = camera.rays().astype(float)
    directions = np.concatenate([rays, np.ones((rows, columns, 1))], -1).reshape(-1, 3)
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


def reduced(frames: Sequence[RangeFrame], columns: int) -> list[RangeFrame]:
    """Return the frames subsampled to a number of columns."""
    step = max(1, frames[0].camera.width // columns)
    part = (slice(step // 2, None, step), slice(step // 2, None, step))
    found = []
    for frame in frames:
        depth = np.ascontiguousarray(frame.depth[part])
        amplitude = frame.amplitude_image
        assert isinstance(frame.camera, Pinhole)
        found.append(
            RangeFrame(
                frame.index,
                frame.timestamp,
                scaled(frame.camera, depth.shape[1], depth.shape[0]),
                depth,
                frame.depth_kind,
                amplitude_image=None
                if amplitude is None
                else np.ascontiguousarray(amplitude[part]),
                amplitude_kind=frame.amplitude_kind,
            )
        )
    return found


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


def over_resolution(frames: Sequence[RangeFrame], columns: Sequence[int]) -> Iterator[str]:
    yield f"{'columns':>8}{'rows':>6}{'worked on':>11}{'ms: median':>12}{'95 %':>8}{'posed':>7}"
    default = Keyframes().views.columns
    for wanted in columns:
        images = reduced(frames, wanted)
        width, height = images[0].camera.width, images[0].camera.height
        for worked in sorted({min(default, width), width}):
            timed(tracker(worked), iter(images[:3]))
            seconds, posed = timed(tracker(worked), forth_and_back(images, 2 * len(images)))
            ms = 1e3 * seconds[1:]
            yield (
                f"{width:>8}{height:>6}{worked:>11}{np.median(ms):>12.1f}"
                f"{np.percentile(ms, 95):>8.1f}{posed / len(seconds):>7.0%}"
            )


def over_count(frames: Sequence[RangeFrame], counts: Sequence[int]) -> Iterator[str]:
    columns = Keyframes().views.columns
    at_work = tracker(columns)
    source = forth_and_back(frames, max(counts))
    yield f"{'frames':>8}{'ms: median':>12}{'95 %':>8}{'posed':>7}{'memory, MB':>12}"
    done = 0
    for count in sorted(counts):
        seconds, posed = timed(at_work, (next(source) for _ in range(count - done)))
        ms = 1e3 * seconds[1:]
        fraction = posed / max(1, len(seconds))
        done = count
        yield (
            f"{count:>8}{np.median(ms):>12.1f}{np.percentile(ms, 95):>8.1f}"
            f"{fraction:>7.0%}{resident_bytes() / 1e6:>12.0f}"
        )


def whole_run(frames: Sequence[RangeFrame], counts: Sequence[int]) -> Iterator[str]:
    """Memory during a whole run, including loops, refinement and model."""
    mapper = Mapper()
    source = forth_and_back(frames, max(counts))
    yield f"{'frames':>8}{'CPU, s':>9}{'memory, MB':>12}"
    done = 0
    for count in sorted(counts):
        start = time.process_time()
        for _ in range(count - done):
            mapper.push(next(source))
        done = count
        cpu_s = time.process_time() - start
        yield f"{count:>8}{cpu_s:>9.1f}{resident_bytes() / 1e6:>12.0f}"
    start = time.process_time()
    result = mapper.finish()
    cpu_s = time.process_time() - start
    yield f"{'finished':>8}{cpu_s:>9.1f}{resident_bytes() / 1e6:>12.0f}"
    yield f"{result.has_pose.mean():.0%} posed, {len(result.diagnostics.loops)} loops considered"


def resident_bytes() -> int:
    """Resident memory now, or at its peak if the system reports only that."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else 1024 * peak
    return pages * os.sysconf("SC_PAGE_SIZE")


def compilation() -> Iterator[str]:
    """Track two small frames in a new process, with an empty and with a full cache."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        for name in ("first ever", "from the cache"):
            start = time.perf_counter()
            command = [sys.executable, __file__, "--compile-only"]
            done = subprocess.run(command, env=environment, capture_output=True, text=True)
            if done.returncode:
                yield f"{name}: failed: {done.stderr.strip().splitlines()[-1]}"
                return
            whole = time.perf_counter() - start
            yield f"{name:<16}{float(done.stdout):>8.1f} s for two frames,{whole:>7.1f} s in all"


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
    parser.add_argument(
        "recording", nargs="?", help="recording to use instead of the synthetic room"
    )
    parser.add_argument("--columns", type=int, nargs="+", default=[160, 320, 640])
    parser.add_argument("--counts", type=int, nargs="+", default=[500, 1000, 5000])
    parser.add_argument("--length", type=int, default=LENGTH, help="frames of the sequence")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--whole", action="store_true", help="print only the memory of a whole run")
    parser.add_argument("--compile-only", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.compile_only:
        start = time.perf_counter()
        timed(Keyframes().start(0), iter(made_frames(160, 2)))
        print(time.perf_counter() - start)
        return

    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    print(
        f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}; "
        f"{options.threads} threads{load}; {options.recording or 'synthetic room'}"
    )
    widest = max(options.columns)
    frames = (
        recorded_frames(options.recording, options.length)
        if options.recording
        else made_frames(widest, options.length)
    )
    if options.whole:
        _print("Whole run", whole_run(frames, options.counts))
        return
    with using_threads(options.threads):
        _print("Resolution", over_resolution(frames, options.columns))
        _print("Number of frames", over_count(frames, options.counts))
    _print("Compilation", compilation())
    _print("Kernels, on one thread", over_kernels(frames))


def _print(title: str, lines: Iterator[str]) -> None:
    print(f"\n{title}", flush=True)
    for line in lines:
        print(f"  {line}", flush=True)


if __name__ == "__main__":
    main()
