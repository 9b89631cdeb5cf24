"""Does `tofuse judge` tell good trajectories from spoilt ones, and which of several is best?

`spoilt` judges the exact trajectory of simulated recordings (of real ones: that of the default
method) with 1 mm and 0.02 degrees of noise, and others that are made of it: with drift, a jump, a
scale error of 1 %, poses 30 ms late, and smoothed. Printed are what each is off by (positions, and
what rotations move at 1 m), by how much the refinement moved it, what was stated (95 %), and the
area under the ROC curve of that motion, good against spoilt over all recordings: of all, and of
those that are off by 1 cm and more; and how many of the spoilt ones were moved more than the good
one of the same recording. `programs` judges the trajectories of
several programs, and compares their order with that by truth, or by map consistency.

    python benchmarks/judging.py spoilt [--scenes room flat] [--seeds 10] [--real]
    python benchmarks/judging.py programs
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

import sequences
import verdict
from pairs import roc_area
from robustness import OURS, agreement, ours, peer, peer_methods
from tofuse.arrays import Float64
from tofuse.errors import TofuseError
from tofuse.evaluation.trajectory import displacement
from tofuse.geometry import se3
from tofuse.pipeline.judging import judge
from tofuse.recordings.open import open_recording
from tofuse.recordings.recording import Recording

NOISE_M, NOISE_RAD = 1e-3, np.radians(0.02)
DRIFT, SCALE, LATE_S = 0.01, 1.01, 0.03
JUMP_M, JUMP_RAD = 0.03, np.radians(1.5)
SMOOTHED = 2.0  # frames, standard deviation
FAR_M = 0.01
# What a turn moves is so far away, m: errors of rotations count as much as those of positions.
ARM_M = 1.0
REAL = ("sevenscenes_kitchen", "realsense_desk", "iphone_stray", "iphone_chair_3dscannerapp")
MOST_FRAMES = 150


def noisy(poses: Float64, times: Float64, rng: np.random.Generator) -> Float64:
    """Poses with noise from frame to frame."""
    return poses @ se3.exp(rng.normal(0, [NOISE_M] * 3 + [NOISE_RAD] * 3, (len(poses), 6)))


def drifting(poses: Float64, times: Float64, rng: np.random.Generator) -> Float64:
    """Poses whose error grows with the path: a wrong direction and a slow turn."""
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    way = rng.standard_normal((2, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    far = np.linalg.norm(steps[:, :3, 3], axis=1) + ARM_M * se3.angle(steps)
    wrong = se3.exp(DRIFT * far[:, None] * np.concatenate([way[0], 0.3 * way[1] / ARM_M]))
    return chained(poses[0], steps @ wrong)


def jumping(poses: Float64, times: Float64, rng: np.random.Generator) -> Float64:
    """Poses that are elsewhere from the middle on."""
    way = rng.standard_normal((2, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    jump = se3.exp(np.concatenate([JUMP_M * way[0], JUMP_RAD * way[1]]))
    out = poses.copy()
    half = len(out) // 2
    out[half:] = out[half] @ jump @ se3.inverse(out[half]) @ out[half:]
    return out


def scaled(poses: Float64, times: Float64, rng: np.random.Generator) -> Float64:
    """Poses of a program whose lengths are 1 % too long."""
    out = poses.copy()
    out[:, :3, 3] *= SCALE
    return out


def late(poses: Float64, times: Float64, rng: np.random.Generator) -> Float64:
    """Poses of 30 ms later."""
    at = np.clip(np.searchsorted(times, times + LATE_S, side="right") - 1, 0, len(poses) - 2)
    share = np.clip((times + LATE_S - times[at]) / np.diff(times)[at], 0, 1)
    return se3.interpolate(poses[at], poses[at + 1], share)


def smoothed(poses: Float64, times: Float64, rng: np.random.Generator) -> Float64:
    """Poses after a low pass."""
    out = poses.copy()
    out[:, :3, 3] = gaussian_filter1d(poses[:, :3, 3], SMOOTHED, axis=0, mode="nearest")
    mean = gaussian_filter1d(poses[:, :3, :3].reshape(-1, 9), SMOOTHED, axis=0, mode="nearest")
    U, _, V = np.linalg.svd(mean.reshape(-1, 3, 3))
    out[:, :3, :3] = U @ V
    return out


Spoiling = Callable[[Float64, Float64, np.random.Generator], Float64]
SPOILT: dict[str, Spoiling] = {
    "good": noisy,
    "drift 1 %": drifting,
    "jump": jumping,
    "scale 1 %": scaled,
    "30 ms late": late,
    "smoothed": smoothed,
}


def apart(poses: Float64, others: Float64) -> float:
    """By how much two trajectories differ: rms of positions and of what rotations move, m."""
    both = np.isfinite(poses).all((1, 2)) & np.isfinite(others).all((1, 2))
    metres, rad = displacement(poses[both], others[both])
    return float(np.hypot(metres, ARM_M * rad))


def chained(first: Float64, steps: Float64) -> Float64:
    """Poses from a first one and motions."""
    out = [first]
    for step in steps:
        out.append(se3.orthonormalise(out[-1] @ step))
    return np.stack(out)


@dataclass(frozen=True)
class Case:
    """One judged trajectory: what it is off by, was moved by, and was stated to be off by, m."""

    recording: str
    name: str
    off_m: float
    moved_m: float
    stated_m: float
    verdict: str


def cases(name: str, recording: Recording, poses: Float64, seed: int) -> Iterator[Case]:
    """Judge what is made of a trajectory that is right."""
    for number, (title, spoil) in enumerate(SPOILT.items()):
        rng = np.random.default_rng([seed, number])
        made = spoil(poses, recording.timestamps, rng)
        try:
            found = judge(recording, made)
        except TofuseError as error:
            print(f"{name}, {title}: {error}")
            continue
        stated = found.accuracy.position_m
        yield Case(
            name,
            title,
            apart(poses, made),
            apart(found.refined.trajectory, made),
            stated,
            found.verdict,
        )


def spoilt(
    scenes: Sequence[str], seeds: Sequence[int], data: Path | None, *, light: bool
) -> Iterator[Case]:
    """Give the cases of simulated recordings, and of real ones if there is a folder of them.

    `light` is whether the simulated ones have multipath.
    """
    for seed in seeds:
        for scene in scenes:
            for camera in verdict.CAMERAS:
                recording = verdict.recorded(scene, camera, seed, multipath=light)
                if recording.reference is not None:
                    yield from cases(f"{scene}, {camera}", recording, recording.reference, seed)
    for name in REAL if data is not None else ():
        assert data is not None
        if not (data / name).exists():
            continue
        recording = open_recording(data / name)
        recording = recording.select(every=-(-len(recording) // MOST_FRAMES))
        parts, _, _, problem = ours(recording, 2)
        if problem or not np.isfinite(parts[0].poses).all():
            print(f"{name}: {problem or 'frames without a pose'}")
            continue
        yield from cases(name, recording, parts[0].poses, 1)


def print_spoilt(found: Sequence[Case]) -> None:
    """The area under the ROC curve for each way to spoil a trajectory."""
    good = [c for c in found if c.name == "good"]
    print(
        "\n| spoilt by | trajectories | off mm (median) | moved mm | stated mm | within stated"
        " | moved more than the good one | ROC area | of those 1 cm off and more |"
        "\n|---|---|---|---|---|---|---|---|---|"
    )
    everything: list[Case] = []
    for name in SPOILT:
        own = [c for c in found if c.name == name]
        if name != "good":
            everything += own
        if own:
            print(row(name, own, good))
    print(row("all", everything, good))


def row(name: str, own: Sequence[Case], good: Sequence[Case]) -> str:
    """A row of the table."""
    off, moved, stated = (
        1e3 * np.median([getattr(c, key) for c in own]) for key in ("off_m", "moved_m", "stated_m")
    )
    within = sum(c.off_m <= c.stated_m for c in own)
    areas = ["", "", ""]
    if name != "good":
        far = [c for c in own if c.off_m >= FAR_M]
        by_recording = {c.recording: c.moved_m for c in good}
        more = sum(
            c.moved_m > by_recording[c.recording] for c in own if c.recording in by_recording
        )
        areas = [f"{separation(some, good):.3f}" if some else "" for some in (own, far)]
        areas.insert(0, f"{more} of {len(own)}")
    cells = [name, len(own), f"{off:.1f}", f"{moved:.1f}", f"{stated:.1f}"]
    return f"| {' | '.join(map(str, [*cells, f'{within} of {len(own)}', *areas]))} |"


def separation(bad: Sequence[Case], good: Sequence[Case]) -> float:
    """Area under the ROC curve of the motion, trajectories of all recordings together."""
    moved = np.array([c.moved_m for c in (*bad, *good)])
    is_bad = np.array([True] * len(bad) + [False] * len(good))
    return roc_area(moved, is_bad)


def programs(data: Path) -> None:
    """Order of the trajectories of several programs: as stated, by truth, by map consistency."""
    kitchen = data / "sevenscenes_kitchen"
    recordings = {"room": verdict.recorded("room", "sr4000", 10, multipath=True)}
    if kitchen.exists():
        recordings["kitchen"] = open_recording(kitchen)
    for name, recording in recordings.items():
        _, cleaned, _ = sequences.prepared(recording)
        parts, _, _, _ = ours(recording, 2)
        made = {OURS: parts[0].poses}
        for label in peer_methods():
            there, _, problem = peer(label, recording, cleaned, 2)
            if there:
                made[label] = there[0].poses
            else:
                print(f"{name}, {label}: {problem}")
        print(
            f"\n{name}\n\n| program | moved mm | stated mm | true mm | map rms mm, inliers |"
            "\n|---|---|---|---|---|"
        )
        moved, true, maps = [], [], []
        for label, poses in made.items():
            found = judge(recording, poses)
            reference = recording.reference
            off = np.nan if reference is None else apart(reference, poses)
            rms, inliers = agreement(recording, poses)
            moved.append(apart(found.refined.trajectory, poses))
            true.append(off)
            maps.append(1 - inliers)
            print(
                f"| {label} | {1e3 * moved[-1]:.1f} | {1e3 * found.accuracy.position_m:.1f} "
                f"| {1e3 * off:.1f} "
                f"| {1e3 * rms:.1f}, {inliers:.1%} |",
                flush=True,
            )
        for title, other in (("truth", true), ("map consistency", maps)):
            order = [np.argsort(values).tolist() for values in (moved, other)]
            print(f"the same order as by {title}: {'yes' if order[0] == order[1] else 'no'}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print what was judged, and the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("what", choices=["spoilt", "programs"])
    parser.add_argument("--scenes", nargs="+", default=["room", "rail", "flat"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[10])
    parser.add_argument("--real", action="store_true")
    parser.add_argument("--without-multipath", action="store_true")
    parser.add_argument("--data", type=Path, default=sequences.DATA)
    options = parser.parse_args(arguments)
    if options.what == "programs":
        programs(options.data)
        return
    found = []
    data = options.data if options.real else None
    light = not options.without_multipath
    for case in spoilt(options.scenes, options.seeds, data, light=light):
        found.append(case)
        print(
            f"{case.recording:32} {case.name:12} off {1e3 * case.off_m:7.1f} mm,"
            f" moved {1e3 * case.moved_m:7.1f} mm, stated {1e3 * case.stated_m:7.1f} mm,"
            f" {case.verdict}",
            flush=True,
        )
    print_spoilt(found)


if __name__ == "__main__":
    main()
