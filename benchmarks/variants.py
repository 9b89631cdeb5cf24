"""Variants of recordings whose trajectories follow from that of the original.

`real`: a recording is reconstructed unchanged and then with changes of known effect on the
trajectory: reversed, subsampled, rotated about the optical axis, cropped, at lower resolution,
noisier... The trajectory of each variant is compared with that of the original, which is not exact
but states its own error. `simulated`: cameras, scenes and motions that no other benchmark has
(`unusual.py`), compared with ground truth.

A row has the frames with a pose, ATE and largest error (aligned as in `scoring.py`), wrong and
unmarked poses (as defined there), the stated 95 % bound, the verdict with its reasons, and one of
these marks:

- `LOST`: fewer than 90 % of the frames posed in the original have a pose;
- `WRONG`: the ATE exceeds the combined stated bounds of both runs, and the verdict is "good";
- `off`: it exceeds them, but the verdict is not "good".

    python benchmarks/variants.py [real] [--names tags] [--variants "every 3rd"] [--frames 60]
    python benchmarks/variants.py simulated [--names stairs] [--seeds 1 2]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import scoring
import sequences
import stress
import unusual
from recorded import RECORDED
from tofuse.apps.inspection.inspect import inspect_recording
from tofuse.apps.jobs.run_options import Options, resolve
from tofuse.apps.jobs.running import with_findings
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.cameras.cameras import Camera, Pinhole, RayTable
from tofuse.engine.errors import InputError
from tofuse.engine.frames.frames import IMAGES, RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.mapping.reconstructing import reconstruct

SEED = 7
MAX_FRAMES = 100
PLACED_FRACTION = 0.9


@dataclass(frozen=True, eq=False)
class Take(stress.Take):
    """Frames of a recording in memory, with poses (NaN where unknown), path and format."""

    path: str
    format: str

    def at(self, order: Sequence[int] | Intp) -> Take:
        """Return frames in another order, keeping their times if these ascend."""
        taken = super().at(np.asarray(order, int))
        times = np.array([frame.timestamp for frame in taken.frames])
        if (np.diff(times) <= 0).any():
            steps = np.abs(np.diff(times))
            steps[steps == 0] = self.step_s
            times = np.concatenate([[0.0], np.cumsum(steps)])
        timed = zip(taken.frames, times, strict=True)
        return replace(
            self, frames=tuple(replace(f, timestamp=float(t)) for f, t in timed), poses=taken.poses
        )

    def each(self, change: Callable[[RangeFrame], RangeFrame]) -> Take:
        """Return the take with each frame changed."""
        return replace(self, frames=tuple(change(frame) for frame in self.frames))

    def as_recording(self) -> Recording:
        """Return the take as a recording with the original's metadata."""
        frames = [replace(frame, index=k) for k, frame in enumerate(self.frames)]
        return Recording.of(ArraySource(frames, metadata=self.metadata), self.path, self.format)


def take_of(recording: Recording, poses: Float64 | None = None) -> Take:
    """Read a recording into memory; its poses (N, 4, 4) are unknown unless given."""
    frames = tuple(frame for frame in recording if isinstance(frame, RangeFrame))
    unknown = np.full((len(frames), 4, 4), np.nan)
    metadata = dict(recording.metadata)
    return Take(
        frames, unknown if poses is None else poses, metadata, recording.path, recording.format
    )


# ---- Changes of images ---------------------------------------------------------------------------


def arranged(
    frame: RangeFrame, camera: Camera, pick: Callable[[np.ndarray], np.ndarray]
) -> RangeFrame:
    """Return the frame with resampled images and the matching camera."""
    images = {name: getattr(frame, name) for name in IMAGES}
    picked = {
        name: None if image is None else np.ascontiguousarray(pick(image))
        for name, image in images.items()
    }
    return replace(frame, camera=camera, **picked)


def picked_camera(
    camera: Camera, pick: Callable[[np.ndarray], np.ndarray], R: Float64 | None = None
) -> Camera:
    """Return the camera of resampled pixels; rays (2,) are rotated by R (2, 2)."""
    rays = pick(camera.rays())
    if R is not None:
        rays = rays @ R.T.astype(np.float32)
    if type(camera) is not Pinhole:
        return RayTable(rays)
    height, width = rays.shape[:2]
    slope_x = float(rays[0, -1, 0] - rays[0, 0, 0]) / (width - 1)
    slope_y = float(rays[-1, 0, 1] - rays[0, 0, 1]) / (height - 1)
    return Pinhole(
        width, height, 1 / slope_x, 1 / slope_y,
        -float(rays[0, 0, 0]) / slope_x, -float(rays[0, 0, 1]) / slope_y,
    )  # fmt: skip


def picked(take: Take, pick: Callable[[np.ndarray], np.ndarray], degrees: float = 0.0) -> Take:
    """Resample all images; the camera is rotated about its optical axis by an angle."""
    T = se3.exp(np.array([0, 0, 0, 0, 0, np.radians(degrees)]))
    cameras: dict[int, Camera] = {}

    def change(frame: RangeFrame) -> RangeFrame:
        key = id(frame.camera)
        if key not in cameras:
            cameras[key] = picked_camera(frame.camera, pick, T[:2, :2].T)
        return arranged(frame, cameras[key], pick)

    return replace(take.each(change), poses=take.poses @ T)


def turned(take: Take, quarters: int) -> Take:
    """Rotate the images by quarter turns, counter-clockwise."""
    return picked(take, lambda image: np.rot90(image, quarters), 90.0 * quarters)


def cropped(take: Take) -> Take:
    """Keep the central half of the width and of the height."""
    height, width = take.frames[0].depth.shape
    centre = np.s_[height // 4 : height - height // 4, width // 4 : width - width // 4]
    return picked(take, lambda image: image[centre])


def thinned(take: Take, step: int) -> Take:
    """Keep every `step`-th pixel."""
    return picked(take, lambda image: image[::step, ::step])


def quantised(frame: RangeFrame, metres: float) -> RangeFrame:
    """Round depth to multiples of a length."""
    return replace(frame, depth=(np.round(frame.depth / metres) * metres).astype(np.float32))


def noisier(frame: RangeFrame, fraction: float) -> RangeFrame:
    """Add independent noise to each pixel, as a fraction of its depth."""
    rng = np.random.default_rng([SEED, frame.index])
    factor = 1 + fraction * rng.standard_normal(frame.depth.shape)
    return replace(frame, depth=(frame.depth * factor).astype(np.float32))


def holed(frame: RangeFrame, fraction: float, size: int = 1) -> RangeFrame:
    """Drop a fraction of the pixels, in square blocks."""
    rng = np.random.default_rng([SEED, frame.index])
    height, width = frame.depth.shape
    kept = rng.random((-(-height // size), -(-width // size))) >= fraction
    return frame.keep(np.kron(kept, np.ones((size, size), bool))[:height, :width])


def scaled(take: Take, factor: float) -> Take:
    """Scale depth, and the positions with it."""
    poses = take.poses.copy()
    poses[:, :3, 3] *= factor
    changed = take.each(lambda f: replace(f, depth=f.depth * np.float32(factor)))
    return replace(changed, poses=poses)


def untimed(take: Take) -> Take:
    """Replace the timestamps by 30 Hz."""
    frames = [replace(f, timestamp=k / 30) for k, f in enumerate(take.frames)]
    return replace(take, frames=tuple(frames))


def depth_only(frame: RangeFrame) -> RangeFrame:
    """Keep depth only."""
    return replace(frame, **{name: None for name in IMAGES if name != "depth"})


# ---- Variants ------------------------------------------------------------------------------------


def dropped(take: Take, fraction: float) -> Take:
    """Drop a random fraction of the frames."""
    kept = np.random.default_rng(SEED).random(len(take.frames)) >= fraction
    return take.at(np.flatnonzero(kept))


def paused(take: Take, count: int = 60) -> Take:
    """Pause in the middle: one image repeated, each time with independent noise (1 mm)."""
    half = len(take.frames) // 2
    longer = take.at([*range(half), *[half] * count, *range(half, len(take.frames))])

    def change(k: int, frame: RangeFrame) -> RangeFrame:
        rng = np.random.default_rng([SEED, k])
        noise = rng.normal(0, 0.001, frame.depth.shape).astype(np.float32)
        return replace(frame, depth=np.where(frame.depth > 0, frame.depth + noise, 0))

    frames = [change(k, f) if half < k < half + count else f for k, f in enumerate(longer.frames)]
    return replace(longer, frames=tuple(frames))


def every(step: int, first: int = 0) -> Callable[[Take], Take]:
    """Take every `step`-th frame."""
    return lambda take: take.at(range(first, len(take.frames), step))


def middle(count: int) -> Callable[[Take], Take]:
    """Take a few frames from the middle."""

    def made(take: Take) -> Take:
        first = max(0, len(take.frames) // 2 - count // 2)
        return take.at(range(first, min(first + count, len(take.frames))))

    return made


VARIANTS: dict[str, Callable[[Take], Take]] = {
    "reversed": lambda take: take.at(range(len(take.frames))[::-1]),
    "every 2nd frame": every(2),
    "every 3rd frame": every(3, 1),
    "every 5th frame": every(5),
    "every 10th frame": every(10),
    "from a third on": lambda take: take.at(range(len(take.frames) // 3, len(take.frames))),
    "20 % of the frames dropped": lambda take: dropped(take, 0.2),
    "turned by 90 degrees": lambda take: turned(take, 1),
    "turned by 180 degrees": lambda take: turned(take, 2),
    "central half": cropped,
    "half the resolution": lambda take: thinned(take, 2),
    "quarter of the resolution": lambda take: thinned(take, 4),
    "depth in cm": lambda take: take.each(lambda f: quantised(f, 0.01)),
    "noise of 0.5 % of the depth": lambda take: take.each(lambda f: noisier(f, 0.005)),
    "noise of 2 % of the depth": lambda take: take.each(lambda f: noisier(f, 0.02)),
    "30 % of the pixels missing": lambda take: take.each(lambda f: holed(f, 0.3)),
    "30 % missing in blocks": lambda take: take.each(lambda f: holed(f, 0.3, 16)),
    "80 % of the pixels missing": lambda take: take.each(lambda f: holed(f, 0.8)),
    "depth x 1.02": lambda take: scaled(take, 1.02),
    "depth alone": lambda take: take.each(depth_only),
    "times at 30 Hz": untimed,
    "there and back": lambda take: take.at(
        [*range(len(take.frames)), *range(len(take.frames) - 1)[::-1]]
    ),
    "twice": lambda take: take.at([*range(len(take.frames))] * 2),
    "paused": paused,
    "2 frames": middle(2),
    "3 frames": middle(3),
    "5 frames": middle(5),
}


# ---- Runs ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Outcome:
    """Poses of a run, and what it states about them."""

    parts: tuple[scoring.Part, ...]
    bound_m: float
    verdict: str
    reasons: tuple[str, ...]
    components: int
    seconds: float


def run(recording: Recording, threads: int) -> Outcome:
    """Run the default method as `tofuse run` does."""
    began = time.perf_counter()
    try:
        findings = inspect_recording(recording, quick=True).findings
        result = reconstruct(recording, resolve(Options(out=Path("unused"))), threads=threads)
        result = with_findings(result, findings)
    except InputError as error:
        return Outcome((), np.nan, "refused", (str(error),), 0, time.perf_counter() - began)
    except Exception as error:
        # Crashes are counted as outcomes.
        message = f"{type(error).__name__}: {error}"
        return Outcome((), np.nan, "CRASHED", (message,), 0, time.perf_counter() - began)
    found = result.diagnostics
    return Outcome(
        tuple(scoring.parts_of(result, recording.indices)),
        found.accuracy.position_m,
        found.verdict,
        tuple(reason.code for reason in found.reasons),
        sum(1 for c in result.components if not c.connected) + 1,
        time.perf_counter() - began,
    )


def load(name: str, data: Path, max_frames: int) -> Take:
    """Read up to `max_frames` frames of a recording into memory."""
    recording = RECORDED[name].open(data)
    recording = replace(recording, indices=recording.indices[:max_frames])
    return take_of(recording)


def line(name: str, take: Take, outcome: Outcome, bound_m: float) -> str:
    """Return the row of a run, with the bound that the reference states."""
    count = len(take.frames)
    poses = outcome.parts[0].poses if outcome.parts else np.full((count, 4, 4), np.nan)
    known, placed = np.isfinite(take.poses).all((1, 2)), np.isfinite(poses).all((1, 2))
    both = known & placed
    ate, largest, degrees, wrong, unmarked = np.nan, np.nan, np.nan, 0, 0
    if both.sum() > 1:
        errors = scoring.errors(poses[both], take.poses[both], scoring.Tolerance())
        distance = np.linalg.norm(errors[:, :3], axis=1)
        ate, largest = float(np.sqrt((distance**2).mean())), float(distance.max())
        degrees = float(np.degrees(np.linalg.norm(errors[:, 3:], axis=1).max()))
        truth = scoring.Truth(take.poses, np.zeros(count, np.intp))
        found = scoring.score(list(outcome.parts), truth)
        wrong, unmarked = found.wrong, found.unmarked
    mark = ""
    if outcome.verdict == "CRASHED":
        mark = "CRASHED"
    elif placed[known].sum() < PLACED_FRACTION * known.sum():
        mark = "LOST"
    elif ate > np.hypot(outcome.bound_m, bound_m):
        mark = "WRONG" if outcome.verdict == "good" else "off"
    return (
        f"  {name:28} {placed.sum():4} of {count:4} {outcome.components:5}"
        f" {1e3 * ate:8.1f} {1e3 * largest:8.1f} {degrees:6.2f} {wrong:6} {unmarked:8}"
        f" {1e3 * outcome.bound_m:8.1f}  {outcome.verdict:9}{outcome.seconds:6.1f} {mark:7}"
        f" {', '.join(outcome.reasons)}"
    ).rstrip()


HEAD = (
    f"  {'variant':28} {'placed':>12} parts   ATE mm   max mm    deg  wrong unmarked bound mm"
    "  verdict       s mark    reasons"
)


def rows(name: str, options: argparse.Namespace) -> Iterator[str]:
    """Yield the rows of a recording and its variants."""
    take = load(name, options.data, options.frames)
    original = run(take.as_recording(), options.threads)
    take = replace(take, poses=original.parts[0].poses)
    yield f"{RECORDED[name].title}, {len(take.frames)} frames"
    yield line("as it is", take, original, 0.0)
    for variant, make in VARIANTS.items():
        if not any(part in variant for part in options.variants):
            continue
        changed = make(take)
        outcome = run(changed.as_recording(), options.threads)
        yield line(variant, changed, outcome, original.bound_m)


def simulated(name: str, seed: int, threads: int) -> str:
    """Return the row of a simulated recording, compared with the truth."""
    recording = unusual.record(unusual.UNUSUAL[name], seed)
    take = take_of(recording, recording.reference)
    return line(f"{name}, {seed}", take, run(take.as_recording(), threads), 0.0)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table for each recording."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("parts", nargs="*", choices=["real", "simulated", []], default=[])
    parser.add_argument(
        "--names",
        nargs="+",
        default=[""],
        help="recordings whose names contain these",
    )
    parser.add_argument(
        "--variants", nargs="+", default=[""], help="variants whose names contain these"
    )
    parser.add_argument("--frames", type=int, default=MAX_FRAMES, help="maximum per recording")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--data", type=Path, default=sequences.DATA)
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[1], help="seeds of simulated recordings"
    )
    options = parser.parse_args(arguments)
    wanted = options.parts or ["real", "simulated"]
    print(HEAD)
    for name, one in RECORDED.items() if "real" in wanted else ():
        if one.object or not any(part in name for part in options.names):
            continue
        try:
            for row in rows(name, options):
                print(row, flush=True)
        except FileNotFoundError as error:
            print(f"{one.title}: skipped, no {error}", flush=True)
    for name in unusual.UNUSUAL if "simulated" in wanted else ():
        if any(part in name for part in options.names):
            for seed in options.seeds:
                print(simulated(name, seed, options.threads), flush=True)


if __name__ == "__main__":
    main()
