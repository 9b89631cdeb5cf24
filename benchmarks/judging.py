"""Does `tofuse judge` tell good trajectories from spoilt ones, and which of several is best?

`spoilt` judges the exact trajectory of simulated recordings (of real ones: that of the default
method, or a reference that is good to a millimetre) with 1 mm and 0.02 degrees of noise, and others
that are made of it, each at two sizes: with drift, a jump, a scale error, poses that are late, and
smoothed. Printed are what each is off by (rms displacement of the surfaces in view), what is
estimated, its 95 % bound from below, how many were called inconsistent, how many have a larger
estimate than the good one of the same recording, and the area under the ROC curve of the estimate,
good against spoilt over all recordings: by how the trajectories were spoilt, and by how much they
are off. A trajectory is not spoilt by less than the noise of the good ones: ranks and areas are of
those that are off by more. The last column has the area of the mere distance from the poses that
fit best. Registrations are made once for each recording, around the good poses; with `--whole`
every trajectory is judged from scratch. `programs` judges the trajectories of several programs, and
compares their order with that by truth, or by map consistency.

    python benchmarks/judging.py spoilt [--scenes room flat] [--seeds 10] [--real] [--whole]
    python benchmarks/judging.py programs [--only room]
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
from tofuse.evaluation.deviation import Fit, deviation
from tofuse.evaluation.trajectory import align, displacement
from tofuse.geometry import se3
from tofuse.pipeline.judging import judge
from tofuse.recordings.open import open_recording
from tofuse.recordings.recording import Recording

NOISE_M, NOISE_RAD = 1e-3, np.radians(0.02)
# Of size 1; others are multiples.
DRIFT, SCALE, LATE_S = 0.01, 0.01, 0.03
JUMP_M, JUMP_RAD = 0.03, np.radians(1.5)
SMOOTHED = 2.0  # frames, standard deviation
SIZES = (1.0, 3.0)
# What good trajectories are off by, and groups of the others, m.
OFF_M = ((0.002, 0.005), (0.005, 0.02), (0.02, 0.1), (0.1, np.inf), (0.005, np.inf))
# What a turn moves is so far away, m: errors of rotations count as much as those of positions.
ARM_M = 1.0
REAL = ("sevenscenes_kitchen", "realsense_desk", "iphone_stray", "iphone_chair_3dscannerapp")
EXACT = ("azure_kinect_tags",)  # the reference is good to a millimetre
MOST_FRAMES = 100


def noisy(poses: Float64, times: Float64, rng: np.random.Generator, size: float) -> Float64:
    """Poses with noise from frame to frame."""
    return poses @ se3.exp(rng.normal(0, [NOISE_M] * 3 + [NOISE_RAD] * 3, (len(poses), 6)))


def drifting(poses: Float64, times: Float64, rng: np.random.Generator, size: float) -> Float64:
    """Poses whose error grows with the path: a wrong direction and a slow turn."""
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    way = rng.standard_normal((2, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    far = np.linalg.norm(steps[:, :3, 3], axis=1) + ARM_M * se3.angle(steps)
    wrong = se3.exp(size * DRIFT * far[:, None] * np.concatenate([way[0], 0.3 * way[1] / ARM_M]))
    return chained(poses[0], steps @ wrong)


def jumping(poses: Float64, times: Float64, rng: np.random.Generator, size: float) -> Float64:
    """Poses that are elsewhere from the middle on."""
    way = rng.standard_normal((2, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    jump = se3.exp(size * np.concatenate([JUMP_M * way[0], JUMP_RAD * way[1]]))
    out = poses.copy()
    half = len(out) // 2
    out[half:] = out[half] @ jump @ se3.inverse(out[half]) @ out[half:]
    return out


def scaled(poses: Float64, times: Float64, rng: np.random.Generator, size: float) -> Float64:
    """Poses of a program whose lengths are too long."""
    out = poses.copy()
    out[:, :3, 3] *= 1 + size * SCALE
    return out


def late(poses: Float64, times: Float64, rng: np.random.Generator, size: float) -> Float64:
    """Poses of somewhat later."""
    then = times + size * LATE_S
    at = np.clip(np.searchsorted(times, then, side="right") - 1, 0, len(poses) - 2)
    fraction = np.clip((then - times[at]) / np.diff(times)[at], 0, 1)
    return se3.interpolate(poses[at], poses[at + 1], fraction)


def smoothed(poses: Float64, times: Float64, rng: np.random.Generator, size: float) -> Float64:
    """Poses after a low pass."""
    out = poses.copy()
    out[:, :3, 3] = gaussian_filter1d(poses[:, :3, 3], size * SMOOTHED, axis=0, mode="nearest")
    R = poses[:, :3, :3].reshape(-1, 9)
    mean = gaussian_filter1d(R, size * SMOOTHED, axis=0, mode="nearest")
    U, _, V = np.linalg.svd(mean.reshape(-1, 3, 3))
    out[:, :3, :3] = U @ V
    return out


Spoiling = Callable[[Float64, Float64, np.random.Generator, float], Float64]
SPOILT: dict[str, Spoiling] = {
    "good": noisy,
    "drift": drifting,
    "jump": jumping,
    "scale": scaled,
    "late": late,
    "smoothed": smoothed,
}


def apart(poses: Float64, others: Float64) -> float:
    """By how much two trajectories differ: rms of positions and of what rotations move, m."""
    both = np.isfinite(poses).all((1, 2)) & np.isfinite(others).all((1, 2))
    metres, rad = displacement(poses[both], others[both])
    return float(np.hypot(metres, ARM_M * rad))


def displaced(poses: Float64, others: Float64, depth_m: float) -> float:
    """By how much two trajectories differ: rms displacement of what is at a distance, m."""
    aligned = align(others, poses, arm_m=depth_m) @ others
    x = se3.log(se3.inverse(poses) @ aligned)
    return float(np.sqrt(((x * [1.0, 1.0, 1.0, depth_m, depth_m, depth_m]) ** 2).sum(1).mean()))


def chained(first: Float64, steps: Float64) -> Float64:
    """Poses from a first one and motions."""
    out = [first]
    for step in steps:
        out.append(se3.orthonormalise(out[-1] @ step))
    return np.stack(out)


@dataclass(frozen=True)
class Case:
    """One judged trajectory: what it is off by, and what was said of it, m.

    Attributes
    ----------
    distance_m
        From the poses that fit the registrations best.
    """

    recording: str
    name: str
    size: float
    off_m: float
    estimate_m: float
    at_least_m: float
    at_most_m: float
    distance_m: float

    @property
    def good(self) -> bool:
        """Whether it is not spoilt."""
        return self.name == "good"

    @property
    def fit_m(self) -> float:
        """What the poses that fit the registrations best may be off by (95 %)."""
        return self.at_most_m - self.distance_m


def cases(
    name: str,
    recording: Recording,
    poses: Float64,
    seed: int,
    sizes: Sequence[float],
    *,
    whole: bool,
) -> Iterator[Case]:
    """Judge what is made of a trajectory that is right."""
    fit: Fit | None = None
    for number, (title, spoil) in enumerate(SPOILT.items()):
        for size in (1.0,) if title == "good" else sizes:
            rng = np.random.default_rng([seed, number])
            made = spoil(poses, recording.timestamps, rng, size)
            if fit is None or whole:
                try:
                    found = judge(recording, made)
                except TofuseError as error:
                    print(f"{name}, {title}: {error}")
                    continue
                d = found.deviation
                if d is None:
                    print(f"{name}, {title}: nothing to compare with")
                    continue
            else:
                at = np.searchsorted(recording.indices, fit.graph.ids)
                d = deviation(fit, made[at])
            if title == "good":
                fit = d.fit
            at = np.searchsorted(recording.indices, d.ids)
            off = displaced(poses[at], made[at], d.fit.depth_m)
            said = d.estimate_m, d.at_least_m, d.at_most_m, d.distance_m
            yield Case(name, title, size, off, *said)


def spoilt(
    scenes: Sequence[str],
    seeds: Sequence[int],
    data: Path | None,
    sizes: Sequence[float],
    *,
    light: bool,
    whole: bool,
) -> Iterator[Case]:
    """Give the cases of simulated recordings, and of real ones if there is a folder of them.

    `light` is whether the simulated ones have multipath.
    """
    for seed in seeds:
        for scene in scenes:
            for camera in verdict.CAMERAS:
                recording = verdict.recorded(scene, camera, seed, multipath=light)
                if recording.reference is not None:
                    title = f"{scene}, {camera}, {seed}"
                    yield from cases(
                        title, recording, recording.reference, seed, sizes, whole=whole
                    )
    for name in (*REAL, *EXACT) if data is not None else ():
        assert data is not None
        if not (data / name).exists():
            continue
        recording = open_recording(data / name)
        recording = recording.select(every=-(-len(recording) // MOST_FRAMES))
        if name in EXACT:
            assert recording.reference is not None
            yield from cases(name, recording, recording.reference, 1, sizes, whole=whole)
            continue
        parts, _, _, problem = ours(recording, 2)
        if problem or not np.isfinite(parts[0].poses).all():
            print(f"{name}: {problem or 'frames without a pose'}")
            continue
        yield from cases(name, recording, parts[0].poses, 1, sizes, whole=whole)


def print_spoilt(found: Sequence[Case]) -> None:
    """How well each way to spoil a trajectory is told, and each size of error."""
    good = [c for c in found if c.good]
    print(
        "\n| spoilt by | trajectories | off mm (median) | estimate mm | at least mm | bound holds"
        " | inconsistent | more than the good one | ROC area | by distance |"
        "\n|---|---|---|---|---|---|---|---|---|---|"
    )
    print(row("not at all", good, good))
    bad = [c for c in found if not c.good]
    for name, size in dict.fromkeys((c.name, c.size) for c in bad):
        own = [c for c in bad if (c.name, c.size) == (name, size)]
        print(row(f"{name}, size {size:g}", own, good))
    for low, high in OFF_M:
        own = [c for c in bad if low <= c.off_m < high]
        title = f"{1e3 * low:g} mm and more"
        if np.isfinite(high):
            title = f"{1e3 * low:g} to {1e3 * high:g} mm"
        if own:
            print(row(f"off by {title}", own, good))
    own = [c for c in bad if c.off_m > c.fit_m]
    if own:
        print(row("off by more than the best fit may be", own, good))


def row(name: str, own: Sequence[Case], good: Sequence[Case]) -> str:
    """A row of the table; areas and ranks are of those that are off by more than the good ones."""
    off, estimate, least = (
        1e3 * np.median([getattr(c, key) for c in own])
        for key in ("off_m", "estimate_m", "at_least_m")
    )
    holds = sum(c.at_least_m <= c.off_m for c in own)
    contradicted = sum(c.at_least_m > 0 for c in own)
    cells = [name, len(own), f"{off:.1f}", f"{estimate:.1f}", f"{least:.1f}"]
    cells += [f"{holds} of {len(own)}", f"{contradicted} of {len(own)}"]
    far = [c for c in own if not c.good and c.off_m >= OFF_M[0][0]]
    if far:
        of_good = {c.recording: c.estimate_m for c in good}
        more = sum(c.estimate_m > of_good.get(c.recording, np.inf) for c in far)
        cells += [f"{more} of {len(far)}"]
        cells += [f"{separation(far, good, key):.3f}" for key in ("estimate_m", "distance_m")]
    return f"| {' | '.join(map(str, cells))} |"


def separation(bad: Sequence[Case], good: Sequence[Case], key: str) -> float:
    """Area under the ROC curve of what was said, trajectories of all recordings together."""
    said = np.array([getattr(c, key) for c in (*bad, *good)])
    is_bad = np.array([True] * len(bad) + [False] * len(good))
    return roc_area(said, is_bad)


def programs(data: Path, only: str | None) -> None:
    """Order of the trajectories of several programs: as stated, by truth, by map consistency."""
    kitchen = data / "sevenscenes_kitchen"
    recordings = {}
    if only != "kitchen":
        recordings["room"] = verdict.recorded("room", "sr4000", 10, multipath=True)
    if only != "room" and kitchen.exists():
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
            f"\n{name}\n\n| program | estimate mm | at least mm | moved mm | stated mm | true mm"
            " | map rms mm, inliers |\n|---|---|---|---|---|---|---|"
        )
        said, true, maps = [], [], []
        for label, poses in made.items():
            found = judge(recording, poses)
            reference = recording.reference
            off = np.nan if reference is None else apart(reference, poses)
            rms, inliers = agreement(recording, poses)
            d = found.deviation
            said.append(0.0 if d is None else d.estimate_m)
            least = 0.0 if d is None else 1e3 * d.at_least_m
            true.append(off)
            maps.append(1 - inliers)
            print(
                f"| {label} | {1e3 * said[-1]:.1f} | {least:.1f} "
                f"| {1e3 * apart(found.refined.trajectory, poses):.1f} "
                f"| {1e3 * found.accuracy.position_m:.1f} "
                f"| {1e3 * off:.1f} "
                f"| {1e3 * rms:.1f}, {inliers:.1%} |",
                flush=True,
            )
        for title, other in (("truth", true), ("map consistency", maps)):
            order = [np.argsort(values).tolist() for values in (said, other)]
            print(f"the same order as by {title}: {'yes' if order[0] == order[1] else 'no'}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print what was judged, and the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("what", choices=["spoilt", "programs"])
    parser.add_argument("--scenes", nargs="+", default=["room", "rail", "flat"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[10])
    parser.add_argument("--sizes", nargs="+", type=float, default=SIZES)
    parser.add_argument("--real", action="store_true")
    parser.add_argument("--whole", action="store_true")
    parser.add_argument("--only", choices=["room", "kitchen"])
    parser.add_argument("--without-multipath", action="store_true")
    parser.add_argument("--data", type=Path, default=sequences.DATA)
    options = parser.parse_args(arguments)
    if options.what == "programs":
        programs(options.data, options.only)
        return
    found = []
    data = options.data if options.real else None
    light = not options.without_multipath
    for case in spoilt(
        options.scenes, options.seeds, data, options.sizes, light=light, whole=options.whole
    ):
        found.append(case)
        print(
            f"{case.recording:26} {case.name:8} {case.size:g}: off {1e3 * case.off_m:7.1f} mm,"
            f" estimate {1e3 * case.estimate_m:7.1f} ({1e3 * case.at_least_m:.1f} to"
            f" {1e3 * case.at_most_m:.1f}), distance {1e3 * case.distance_m:.1f}",
            flush=True,
        )
    print_spoilt(found)


if __name__ == "__main__":
    main()
