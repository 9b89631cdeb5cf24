"""Readers: robustness to damaged files, and decoding speed of depth images.

    python benchmarks/readers.py [--mutations 10000] [--first 0] [--frames 400]

Creates a small recording of each format as the tests do, damages it (truncation, flipped bits,
swapped files, changed numbers, files missing or replaced by folders), and reads all of it. Any
outcome other than frames or one-line errors of the package, or a time above 20 s, is printed and
makes the exit status 1. --first continues a previous run. Then decodes 640 x 480 depth images with
read-ahead, and prints frames per second. Finally prints the peak memory of the process.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "helpers"))

from camera_files import MAKERS, OTHERS  # noqa: E402
from damaged_files import damage  # noqa: E402
from tofuse.engine.cameras.cameras import Pinhole  # noqa: E402
from tofuse.engine.errors import TofuseError  # noqa: E402
from tofuse.engine.frames.frames import RangeFrame  # noqa: E402
from tofuse.formats.recordings.native import RecordingWriter  # noqa: E402
from tofuse.formats.recordings.open import open_recording  # noqa: E402

LIMIT_S = 20


def makers() -> dict[str, tuple[Callable[[Path], object], str | None]]:
    return {name: (make, file) for name, (make, file, _) in (MAKERS | OTHERS).items()}


class TooSlowError(Exception):
    pass


def alarm(number: int, frame: object) -> None:
    raise TooSlowError


def read_through(path: Path) -> tuple[int, int]:
    """Numbers of frames and of the package's own errors; any other error is raised."""
    whole = own_errors = 0
    try:
        for item in open_recording(path).read_all():
            if isinstance(item, TofuseError):
                own_errors += 1
                assert len(str(item).splitlines()) == 1
            else:
                assert np.isfinite(item.points).all()
                whole += 1
    except TofuseError as error:
        own_errors += 1
        if len(str(error).splitlines()) != 1:
            raise ValueError("more than one line") from error
    return whole, own_errors


def fuzz(total: int, first: int, work: Path) -> int:
    signal.signal(signal.SIGALRM, alarm)
    known = makers()
    bad = 0
    print(f"{'format':14s} {'mutations':>9s} {'frames':>8s} {'errors':>8s} {'failures':>8s}")
    for number, (name, (make, file)) in enumerate(known.items()):
        original = work / name / "freiburg1"
        original.parent.mkdir(parents=True)
        make(original / (file or "."))
        count = total // len(known) + (number < total % len(known))
        frames = errors = failures = 0
        for k in range(first, first + count):
            rng = np.random.default_rng([200, number, k])
            copy = work / "copy" / "freiburg1"
            shutil.copytree(original, copy)
            for _ in range(1 + int(rng.integers(3))):
                if files := sorted(p for p in copy.rglob("*") if p.is_file()):
                    damage(files, rng)
            signal.alarm(LIMIT_S)
            try:
                whole, own_errors = read_through(copy / (file or "."))
                frames, errors = frames + whole, errors + own_errors
            except BaseException:
                failures += 1
                print(f"{name}, mutation {k}:", file=sys.stderr)
                traceback.print_exc()
            finally:
                signal.alarm(0)
            shutil.rmtree(work / "copy")
        bad += failures
        print(f"{name:14s} {count:9d} {frames:8d} {errors:8d} {failures:8d}", flush=True)
    return bad


def decode(frames: int, work: Path) -> None:
    """Print the decoding rate of 640 x 480 depth images, warm, with read-ahead."""
    camera = Pinhole(640, 480, 525.0, 525.0, 319.5, 239.5)
    folder = work / "vga"
    writer = RecordingWriter(folder, camera)
    rng = np.random.default_rng(1)
    slope = np.linspace(0.8, 3.0, 640, dtype=np.float32) * np.ones((480, 1), np.float32)
    for k in range(20):
        noise = rng.normal(0, 0.003, slope.shape).astype(np.float32)
        writer.add(RangeFrame(k, k / 30, camera, slope + noise))
    writer.finish()
    for path in sorted((folder / "depth").iterdir()):
        for k in range(1, frames // 20):
            shutil.copyfile(path, folder / "depth" / f"{int(path.stem) + 20 * k:06d}.png")
    (folder / "timestamps.txt").unlink()
    rates = []
    for _ in range(3):
        start = time.perf_counter()
        count = sum(1 for _ in open_recording(folder))
        rates.append(count / (time.perf_counter() - start))
    print(f"640 x 480 depth images: {np.median(rates):.0f} per second (median of 3 runs)")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mutations", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--frames", type=int, default=400)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        bad = fuzz(given.mutations, given.first, work) if given.mutations else 0
        decode(given.frames, work)
    print(f"peak memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
