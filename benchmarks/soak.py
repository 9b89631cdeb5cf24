"""Leaks of memory, file descriptors and threads in long recordings and repeated runs.

    python benchmarks/soak.py frames [--columns 64] [--count 20000]
    python benchmarks/soak.py runs [--count 1000]
    python benchmarks/soak.py live [--hours 1] [--rate 10] [--no-mapper]

`frames` maps one recording of `--count` images, in which the camera moves back and forth through a
simulated room. `runs` executes whole runs in one process, alternately of clouds and of images, with
all output files. `live` processes the stream of a camera for `--hours` of the camera's own time,
with missing, duplicate and late frames: it is recorded first, then fed into a mapper.

Each prints, at ten points, the resident memory, open file descriptors and threads, and how much of
the memory is in stores with a budget out of `--memory`. A store may grow until it reaches its
budget, and then spills to a temporary file. Over the second half, all other memory may not grow by
more than what is retained of a frame by design (its record and its tracking), or by 1 MB per 100
runs; descriptors and threads may not grow at all. Exits with 1 if any does. Linux only.
"""

from __future__ import annotations

import argparse
import gc
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hours import there_and_back
from scaling import LENGTH, made_frames
from tofuse.apps.jobs.run_options import Options
from tofuse.apps.jobs.running import run
from tofuse.apps.live.device import DeviceError, Settings, Stream
from tofuse.apps.live.recorder import record
from tofuse.engine.compute.spill import Spill, SpillFile, trim_memory
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.mapping.adaptation import with_recording_defaults
from tofuse.engine.mapping.config import Config, changed
from tofuse.engine.mapping.mapper import Mapper
from tofuse.engine.mapping.methods import from_method
from tofuse.formats.recordings.native import RecordingWriter
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.simulation.record import simulate

FRAME_BYTES = 6000  # its record, its tracking, and their entries in lists
RUN_BYTES = 10_000  # 1 MB per 100 runs
NOISE_BYTES = 8 << 20  # fluctuation of the C library's heap
MEMORY_MB = 500
SAMPLES = 10


@dataclass(frozen=True)
class Usage:
    """Resources of this process: resident memory in bytes, file descriptors, threads.

    `stored` bytes of the memory are in a mapper's stores, whose budgets sum to `budget` bytes. The
    temporary file of a store that has exceeded its budget is not counted.
    `blocks` counts the blocks allocated by Python, which shows a leak of objects more clearly than
    the memory does, as that depends on fragmentation.
    """

    after: int
    memory: int
    descriptors: int
    threads: int
    stored: int = 0
    budget: int = 0
    blocks: int = 0

    @property
    def other(self) -> int:
        """Bytes of memory outside the stores."""
        return self.memory - self.stored

    @staticmethod
    def measured(after: int) -> Usage:
        """Measure, after that many frames or runs."""
        gc.collect()
        trim_memory()
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        descriptors, threads = (len(os.listdir(f"/proc/self/{name}")) for name in ("fd", "task"))
        objects = gc.get_objects()  # compared by type: a weak proxy passes for what it refers to
        descriptors -= sum(type(o) is SpillFile and o.size > 0 for o in objects)
        stores = [o for o in objects if type(o) is Spill and len(o)]
        del objects
        stored, budget = (sum(getattr(s, n) for s in stores) for n in ("resident_bytes", "budget"))
        memory = pages * os.sysconf("SC_PAGE_SIZE")
        blocks = sys.getallocatedblocks()
        return Usage(after, memory, descriptors, threads, stored, budget, blocks)


class Trace:
    """Samples of the usage, printed as they are taken."""

    def __init__(self, title: str, count: int, samples: int = SAMPLES) -> None:
        self.samples: list[Usage] = []
        self._every = max(1, count // samples)
        columns = (f"{'descriptors':>13}", f"{'threads':>9}", f"{'blocks':>10}")
        print(f"\n{title}\n{'after':>8}{'MB':>9}{'in stores':>11}{''.join(columns)}", flush=True)

    def step(self, done: int) -> None:
        """Take a sample if one is due after that many frames or runs."""
        if done % self._every:
            return
        one = Usage.measured(done)
        self.samples.append(one)
        row = f"{one.after:>8}{one.memory / 1e6:>9.1f}{one.stored / 1e6:>11.1f}"
        print(f"{row}{one.descriptors:>13}{one.threads:>9}{one.blocks:>10}", flush=True)


def growth(samples: list[Usage]) -> float:
    """Bytes per frame or run by which memory outside the stores grows in the second half.

    That is the median of all slopes (Theil-Sen).
    """
    late = samples[len(samples) // 2 :]
    slopes = [
        (b.other - a.other) / (b.after - a.after) for k, a in enumerate(late) for b in late[k + 1 :]
    ]
    return float(np.median(slopes)) if slopes else 0.0


def bounded(samples: list[Usage], each: float) -> bool:
    """Whether usage stayed within its bounds: `each` bytes per frame or run."""
    late = samples[len(samples) // 2 :]
    slope, count = growth(samples), late[-1].after - late[0].after
    flat = slope * count <= each * count + NOISE_BYTES
    steady = all(max(v) <= v[0] for v in ([u.descriptors for u in late], [u.threads for u in late]))
    within = all(u.stored <= u.budget for u in samples)
    good = flat and steady and within
    rate = f"{slope / 1e3:.2f} kB each in the second half, outside the stores"
    print(f"{rate}: {'passed' if good else 'FAILED'}", flush=True)
    return good


def small(kind: str = "range") -> Config:
    """The default method with the smallest memory budget that is accepted."""
    return changed(from_method("default", kind), {"memory_mb": MEMORY_MB}, where="soak")


def frames(columns: int, count: int, base: Path, samples: int = SAMPLES) -> bool:
    """Map a recording of `count` images."""
    short = base / "short"
    some = made_frames(columns, LENGTH)
    writer = RecordingWriter(
        short, some[0].camera, depth_unit_m=0.0005, depth_kind="z", frame_rate_hz=30.0
    )
    for frame in some:
        writer.add(frame)
    writer.finish()
    recording = open_recording(there_and_back(short, count, base / "long"))
    mapper = Mapper(with_recording_defaults(small(), recording))
    trace = Trace(f"{count} frames of {columns} x {columns * 3 // 4}", count, samples)
    for k, frame in enumerate(recording):
        mapper.push(frame)
        trace.step(k + 1)
    good = bounded(trace.samples, FRAME_BYTES)
    posed = len(mapper.finish().trajectory)
    print(f"{posed} of {count} frames have a pose")
    return good and posed == count


def runs(count: int, base: Path, samples: int = SAMPLES) -> bool:
    """Execute `count` runs in this process."""
    clouds = simulate("peaks", base / "peaks", frames=2)
    images = base / "images"
    some = made_frames(64, 3)
    writer = RecordingWriter(
        images, some[0].camera, depth_unit_m=0.0005, depth_kind="z", frame_rate_hz=30.0
    )
    for frame in some:
        writer.add(frame)
    writer.finish()
    kinds = ((clouds, "thesis"), (images, "default"))
    trace = Trace(f"{count} runs in one process", count, samples)
    for k in range(count):
        recording, method = kinds[k % 2]
        run([recording], Options(base / "out", method=method, overwrite=True))
        trace.step(k + 1)
    return bounded(trace.samples, RUN_BYTES)


@dataclass
class Sent:
    """How many frames a camera sent, and how many were missing, duplicate or late.

    `repeated` counts images equal to the previous one: duplicates, and the images on both sides of
    a turning point that is missing.
    """

    frames: int = 0
    repeated: int = 0
    missing: int = 0
    doubled: int = 0
    late: int = 0


class Camera(Stream):
    """A camera of simulated images, with timestamps of its own, that sends as fast as it is read.

    Of a hundred images two are missing, one is sent twice, and one after its successor.
    """

    def __init__(self, columns: int, count: int, rate: float, ahead: int | None = None) -> None:
        self._images = made_frames(columns, LENGTH)
        self.settings = Settings("made", self._images[0].camera, 0.0005, "z", rate)
        self.sent = Sent()
        self._rate = rate
        self._feed = self._frames(count)
        self._depth: object = None
        # Limits how far ahead another thread reads, so that no frame is dropped.
        self._free = None if ahead is None else threading.Semaphore(ahead)

    def done(self, _count: int) -> None:
        """Let the reader proceed by one frame."""
        if self._free is not None:
            self._free.release()

    def read(self, index: int) -> RangeFrame:
        """See `Stream.read`."""
        if self._free is not None:
            self._free.acquire()
        frame = next(self._feed, None)
        if frame is None:
            raise DeviceError("was switched off", where="made")
        self.sent.frames += 1
        self.sent.repeated += frame.depth is self._depth
        self._depth = frame.depth
        return replace(frame, index=index)

    def close(self) -> None:
        """See `Stream.close`."""

    def _frames(self, count: int) -> Iterator[RangeFrame]:
        rng = np.random.default_rng(5)
        waiting: list[RangeFrame] = []
        for k in range(count):
            frame = replace(self._images[place(k)], timestamp=k / self._rate)
            kind = int(rng.integers(100))
            if kind < 2:
                self.sent.missing += 1
            elif kind == 2:
                self.sent.doubled += 1
                yield from (frame, frame)
            elif kind == 3:
                self.sent.late += 1
                waiting.append(frame)
                continue
            else:
                yield frame
            yield from waiting
            waiting.clear()


def place(k: int) -> int:
    """Index of the k-th image, back and forth."""
    period = 2 * LENGTH - 2
    return min(k % period, period - k % period)


def live(
    columns: int, seconds: float, rate: float, base: Path, mapped: bool, samples: int = SAMPLES
) -> bool:
    """Record a camera, and map it."""
    count = round(seconds * rate)
    what = f"{seconds / 3600:.2g} h at {rate:g} frames per second, {columns} columns wide"
    trace = Trace(f"recording of {what}", count, samples)
    with Camera(columns, count, rate, ahead=32) as camera:

        def progress(written: int) -> None:
            camera.done(written)
            trace.step(written)

        done = record(camera, base / "recorded", progress=progress)
        sent = camera.sent
    good = bounded(trace.samples, 0)
    print(f"{sent}, {done.frames} recorded, {done.dropped} dropped; ended: {done.ended_by}")
    good &= (done.frames, done.dropped) == (sent.frames, 0)
    recording = open_recording(base / "recorded")
    warned = any("time decreases" in line for line in recording.warnings)
    good &= len(recording) == sent.frames and warned == (sent.late > 0)
    if not mapped:
        return good
    trace = Trace(f"mapping of {what}", count, samples)
    mapper = Mapper(small())
    with Camera(columns, count, rate) as camera:
        try:
            for k, frame in enumerate(camera):
                mapper.push(frame)
                trace.step(k + 1)
        except DeviceError:
            pass
        sent = camera.sent
    good &= bounded(trace.samples, FRAME_BYTES)
    result = mapper.finish()
    repeated = len(mapper.log.repeated)
    print(f"{len(result.trajectory)} of {sent.frames} frames have a pose, {repeated} repeated")
    return good and len(result.trajectory) == sent.frames and repeated == sent.repeated


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    kinds = parser.add_subparsers(dest="kind", required=True)
    many = kinds.add_parser("frames")
    many.add_argument("--columns", type=int, default=64)
    many.add_argument("--count", type=int, default=20_000)
    often = kinds.add_parser("runs")
    often.add_argument("--count", type=int, default=1000)
    camera = kinds.add_parser("live")
    camera.add_argument("--columns", type=int, default=32)
    camera.add_argument("--hours", type=float, default=1.0)
    camera.add_argument("--rate", type=float, default=10.0)
    camera.add_argument("--no-mapper", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        base = Path(folder)
        if arguments.kind == "frames":
            good = frames(arguments.columns, arguments.count, base)
        elif arguments.kind == "runs":
            good = runs(arguments.count, base)
        else:
            seconds, mapped = 3600 * arguments.hours, not arguments.no_mapper
            good = live(arguments.columns, seconds, arguments.rate, base, mapped)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
