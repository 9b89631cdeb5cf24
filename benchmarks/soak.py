"""Whether what runs for long, or often, ends up holding more: memory, file handles, threads.

    python benchmarks/soak.py frames [--columns 64] [--count 20000]
    python benchmarks/soak.py runs [--count 1000]
    python benchmarks/soak.py live [--hours 1] [--rate 10] [--no-mapper]

`frames` reads a recording of so many images, which goes forth and back through a made room, and
maps it in one go. `runs` makes whole runs in one process, of clouds and of images by turns, with
all of their files. `live` takes what a camera sends in an hour of its own time, of which some is
missing, some comes twice and some after its successor: once into a recording, once into a mapper.

Each prints the resident memory, open file handles and threads at ten places on the way, and how
much of the memory is in stores that may keep a share of `--memory`. A store that is not full yet
grows by right, and by as much as it says; it must stay within its share. All other memory must not
grow, from the middle on, by more than what is kept of a frame on purpose (its record and how it was
tracked) or by 1 MB for 100 runs; handles and threads must not grow at all. Ends with 1 if any does.
Linux only.
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
from tofuse.files.memory import give_back
from tofuse.files.spill import Spill
from tofuse.lab.simulation.record import simulate
from tofuse.live.device import DeviceError, Settings, Stream
from tofuse.live.recorder import record
from tofuse.pipeline.adaptation import with_recording_defaults
from tofuse.pipeline.config import Config, changed, from_method
from tofuse.pipeline.mapper import Mapper
from tofuse.pipeline.run import Options, run
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.native import RecordingWriter
from tofuse.recordings.open import open_recording

FRAME_BYTES = 6000  # of its record, how it was tracked, and the list that holds them
RUN_BYTES = 10_000  # 1 MB for 100 runs
NOISE_BYTES = 8 << 20  # by which the C library's memory comes and goes
MEMORY_MB = 500
SAMPLES = 10


@dataclass(frozen=True)
class Held:
    """What the process holds: bytes of memory, open file handles, threads.

    Of the memory, `stored` bytes are in stores of a mapper, which may keep `allowed`. `blocks` are
    those that Python has allocated: what is left of a run or a frame is among them, while memory is
    blurred by the gaps between them.
    """

    after: int
    memory: int
    handles: int
    threads: int
    stored: int = 0
    allowed: int = 0
    blocks: int = 0

    @property
    def other(self) -> int:
        """Bytes of memory that no store holds."""
        return self.memory - self.stored

    @staticmethod
    def now(after: int) -> Held:
        """Look, after so many frames or runs."""
        gc.collect()
        give_back()
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        handles, tasks = (len(os.listdir(f"/proc/self/{name}")) for name in ("fd", "task"))
        stores = [o for o in gc.get_objects() if isinstance(o, Spill) and len(o)]
        stored, allowed = (sum(getattr(s, n) for s in stores) for n in ("resident_bytes", "budget"))
        memory = pages * os.sysconf("SC_PAGE_SIZE")
        blocks = sys.getallocatedblocks()
        return Held(after, memory, handles, tasks, stored, allowed, blocks)


def growth(held: list[Held]) -> float:
    """Bytes by which memory outside of stores grows each time, from the middle on.

    That is the median of all slopes (Sen).
    """
    late = held[len(held) // 2 :]
    slopes = [
        (b.other - a.other) / (b.after - a.after) for k, a in enumerate(late) for b in late[k + 1 :]
    ]
    return float(np.median(slopes)) if slopes else 0.0


def judged(what: str, held: list[Held], each: float) -> bool:
    """Print what was held, and return whether it stayed within bounds."""
    head = f"{'after':>8}{'MB':>9}{'in stores':>11}{'handles':>9}{'threads':>9}{'blocks':>10}"
    print(f"\n{what}\n{head}")
    for one in held:
        row = f"{one.after:>8}{one.memory / 1e6:>9.1f}{one.stored / 1e6:>11.1f}"
        print(f"{row}{one.handles:>9}{one.threads:>9}{one.blocks:>10}")
    late = held[len(held) // 2 :]
    slope, count = growth(held), late[-1].after - late[0].after
    flat = slope * count <= each * count + NOISE_BYTES
    steady = all(max(v) <= v[0] for v in ([h.handles for h in late], [h.threads for h in late]))
    within = all(h.stored <= h.allowed for h in held)
    good = flat and steady and within
    told = f"{slope / 1e3:.2f} kB each from the middle on, but for stores"
    print(f"{told}: {'held' if good else 'DID NOT HOLD'}", flush=True)
    return good


def small(kind: str = "range") -> Config:
    """The default, within the least memory that can be asked for."""
    return changed(from_method("default", kind), {"memory_mb": MEMORY_MB}, where="soak")


def frames(columns: int, count: int, base: Path, samples: int = SAMPLES) -> bool:
    """Map a recording of so many images."""
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
    held: list[Held] = []
    for k, frame in enumerate(recording):
        mapper.push(frame)
        if (k + 1) % (count // samples) == 0:
            held.append(Held.now(k + 1))
    good = judged(f"{count} frames of {columns} x {columns * 3 // 4}", held, FRAME_BYTES)
    posed = len(mapper.finish().trajectory)
    print(f"{posed} of {count} frames have a pose")
    return good and posed == count


def runs(count: int, base: Path, samples: int = SAMPLES) -> bool:
    """Whole runs in this process."""
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
    held: list[Held] = []
    for k in range(count):
        recording, method = kinds[k % 2]
        run([recording], Options(base / "out", method=method, overwrite=True))
        if (k + 1) % (count // samples) == 0:
            held.append(Held.now(k + 1))
    return judged(f"{count} runs in one process", held, RUN_BYTES)


@dataclass
class Sent:
    """How many frames a camera sent, and how many of them were no news or came too late."""

    frames: int = 0
    missing: int = 0
    doubled: int = 0
    late: int = 0


class Camera(Stream):
    """A camera of made images that sends as fast as it is read, by a clock of its own.

    Of a hundred images two are missing, one comes twice, and one comes after its successor.
    """

    def __init__(self, columns: int, count: int, rate: float, ahead: int | None = None) -> None:
        self._images = made_frames(columns, LENGTH)
        self.settings = Settings("made", self._images[0].camera, 0.0005, "z", rate)
        self.sent = Sent()
        self._rate = rate
        self._feed = self._frames(count)
        # Whoever reads it on another thread says how many are done, so that none need be dropped.
        self._free = None if ahead is None else threading.Semaphore(ahead)

    def done(self, _count: int) -> None:
        """One more frame was taken."""
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
        return replace(frame, index=index)

    def close(self) -> None:
        """See `Stream.close`."""

    def _frames(self, count: int) -> Iterator[RangeFrame]:
        rng = np.random.default_rng(6)
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
    """Which image comes k-th, there and back."""
    period = 2 * LENGTH - 2
    return min(k % period, period - k % period)


def live(
    columns: int, seconds: float, rate: float, base: Path, mapped: bool, samples: int = SAMPLES
) -> bool:
    """Record from a camera, and map from it."""
    count = round(seconds * rate)
    held: list[Held] = []
    with Camera(columns, count, rate, ahead=32) as camera:

        def told(written: int) -> None:
            camera.done(written)
            if written % (count // samples) == 0:
                held.append(Held.now(written))

        done = record(camera, base / "recorded", progress=told)
        sent = camera.sent
    what = f"{seconds / 3600:.2g} h at {rate:g} frames a second, {columns} columns wide"
    good = judged(f"recording of {what}", held, 0)
    print(f"{sent}, {done.frames} recorded, {done.dropped} dropped; ended: {done.ended_by}")
    good &= (done.frames, done.dropped) == (sent.frames, 0)
    recording = open_recording(base / "recorded")
    warned = any("time decreases" in line for line in recording.warnings)
    good &= len(recording) == sent.frames and warned == (sent.late > 0)
    if not mapped:
        return good
    held.clear()
    mapper = Mapper(small())
    with Camera(columns, count, rate) as camera:
        try:
            for k, frame in enumerate(camera):
                mapper.push(frame)
                if (k + 1) % (count // samples) == 0:
                    held.append(Held.now(k + 1))
        except DeviceError:
            pass
        sent = camera.sent
    good &= judged(f"mapping of {what}", held, FRAME_BYTES)
    result = mapper.finish()
    repeated = len(mapper.log.repeated)
    print(f"{len(result.trajectory)} of {sent.frames} frames have a pose, {repeated} came twice")
    return good and len(result.trajectory) == sent.frames and repeated == sent.doubled


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
