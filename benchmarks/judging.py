"""Does `tofuse judge` separate good trajectories from corrupted ones, and rank several rightly?

`corrupted` judges the exact trajectory of simulated recordings (for real ones that of the default
method, or a reference accurate to a millimetre) with 1 mm and 0.02 degrees of noise, and corrupted
versions of it at two magnitudes: drift, a jump, a scale error, a time offset, and smoothing.
Printed, by kind of corruption and by error, are the error (rms displacement of the surfaces in
view), its estimate, the lower 95 % bound, how many were called inconsistent, how many have a larger
estimate than the good trajectory of the same recording, and the area under the ROC curve of the
estimate, good against corrupted over all recordings. Ranks and areas exclude trajectories with an
error below the noise of the good ones. The last column is the ROC area of the distance from the
best fit. Registrations are computed once per recording, around the good poses; with `--whole` every
trajectory is judged from scratch. `programs` judges the trajectories of several programs, and
compares their ranking with that by true error and by map consistency.

    python benchmarks/judging.py corrupted [--scenes room flat] [--seeds 10] [--real] [--whole]
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
from robustness import OURS, agreement, ours, peer, peer_methods
from scoring import roc_area
from tofuse.apps.jobs.judging import judge
from tofuse.apps.jobs.pose_scale import with_scale
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import TofuseError
from tofuse.engine.frames.recording import Recording
from tofuse.engine.geometry import se3
from tofuse.engine.quality.pose_deviation import Fit, deviation
from tofuse.engine.quality.trajectory_errors import align, displacement
from tofuse.formats.recordings.open import open_recording

NOISE_M, NOISE_RAD = 1e-3, np.radians(0.02)
# For size 1; other sizes are multiples.
DRIFT, SCALE, LATE_S = 0.01, 0.01, 0.03
JUMP_M, JUMP_RAD = 0.03, np.radians(1.5)
SMOOTHED = 2.0  # frames, standard deviation
SIZES = (1.0, 3.0)
# Bins of the error, m; good trajectories are below the first.
ERROR_BINS_M = ((0.002, 0.005), (0.005, 0.02), (0.02, 0.1), (0.1, np.inf), (0.005, np.inf))
# Lever arm, m, that converts rotation errors to displacements.
ARM_M = 1.0
REAL = ("sevenscenes_kitchen", "realsense_desk", "iphone_stray", "iphone_chair_3dscannerapp")
EXACT = ("azure_kinect_tags",)  # the reference is accurate to a millimetre
MAX_FRAMES = 100


def noisy(poses: Float64, times: Float64, rng: np.random.Generator, size: float) -> Float64:
    """Poses with independent noise per frame."""
    return poses @ se3.exp(rng.normal(0, [NOISE_M] * 3 + [NOISE_RAD] * 3, (len(poses), 6)))


def drifting(poses: Float64, times: Float64, rng: np.random.Generator, size: float) -> Float64:
    """Poses that drift with path length, in position and rotation."""
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    way = rng.standard_normal((2, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    far = np.linalg.norm(steps[:, :3, 3], axis=1) + ARM_M * se3.angle(steps)
    wrong = se3.exp(size * DRIFT * far[:, None] * np.concatenate([way[0], 0.3 * way[1] / ARM_M]))
    return chained(poses[0], steps @ wrong)


def jumping(poses: Float64, times: Float64, rng: np.random.Generator, size: float) -> Float64:
    """Poses with a jump halfway."""
    way = rng.standard_normal((2, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    jump = se3.exp(size * np.concatenate([JUMP_M * way[0], JUMP_RAD * way[1]]))
    out = poses.copy()
    half = len(out) // 2
    out[half:] = out[half] @ jump @ se3.inverse(out[half]) @ out[half:]
    return out


def scaled(poses: Float64, times: Float64, rng: np.random.Generator, size: float) -> Float64:
    """Poses with a scale error."""
    return with_scale(poses, 1 + size * SCALE)


def late(poses: Float64, times: Float64, rng: np.random.Generator, size: float) -> Float64:
    """Poses with a time offset."""
    then = times + size * LATE_S
    at = np.clip(np.searchsorted(times, then, side="right") - 1, 0, len(poses) - 2)
    fraction = np.clip((then - times[at]) / np.diff(times)[at], 0, 1)
    return se3.interpolate(poses[at], poses[at + 1], fraction)


def smoothed(poses: Float64, times: Float64, rng: np.random.Generator, size: float) -> Float64:
    """Poses after a low-pass filter."""
    out = poses.copy()
    out[:, :3, 3] = gaussian_filter1d(poses[:, :3, 3], size * SMOOTHED, axis=0, mode="nearest")
    R = poses[:, :3, :3].reshape(-1, 9)
    mean = gaussian_filter1d(R, size * SMOOTHED, axis=0, mode="nearest")
    out[:, :3, :3] = se3.nearest_rotation(mean.reshape(-1, 3, 3))
    return out


Corruption = Callable[[Float64, Float64, np.random.Generator, float], Float64]
CORRUPTIONS: dict[str, Corruption] = {
    "good": noisy,
    "drift": drifting,
    "jump": jumping,
    "scale": scaled,
    "late": late,
    "smoothed": smoothed,
}


def difference(poses: Float64, others: Float64) -> float:
    """Difference of two trajectories: rms of positions and of rotations at the lever arm, m."""
    both = np.isfinite(poses).all((1, 2)) & np.isfinite(others).all((1, 2))
    metres, rad = displacement(poses[both], others[both])
    return float(np.hypot(metres, ARM_M * rad))


def displaced(poses: Float64, others: Float64, depth_m: float) -> float:
    """Difference of two trajectories: rms displacement of surfaces at a depth, m."""
    aligned = align(others, poses, arm_m=depth_m) @ others
    x = se3.log(se3.inverse(poses) @ aligned)
    return float(np.sqrt(((x * [1.0, 1.0, 1.0, depth_m, depth_m, depth_m]) ** 2).sum(1).mean()))


def chained(first: Float64, steps: Float64) -> Float64:
    """Poses from the first one and relative motions."""
    out = [first]
    for step in steps:
        out.append(se3.orthonormalise(out[-1] @ step))
    return np.stack(out)


@dataclass(frozen=True)
class Case:
    """One judged trajectory: its true error and the estimates, m.

    Attributes
    ----------
    distance_m
        Distance from the best fit to the registrations.
    """

    recording: str
    name: str
    size: float
    error_m: float
    estimate_m: float
    at_least_m: float
    at_most_m: float
    distance_m: float

    @property
    def good(self) -> bool:
        """Whether it is uncorrupted."""
        return self.name == "good"

    @property
    def fit_m(self) -> float:
        """Error bound of the best fit to the registrations (95 %)."""
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
    """Judge corrupted versions of a correct trajectory."""
    fit: Fit | None = None
    for number, (title, corrupt) in enumerate(CORRUPTIONS.items()):
        for size in (1.0,) if title == "good" else sizes:
            rng = np.random.default_rng([seed, number])
            made = corrupt(poses, recording.timestamps, rng, size)
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
            error_m = displaced(poses[at], made[at], d.fit.depth_m)
            estimates = d.estimate_m, d.at_least_m, d.at_most_m, d.distance_m
            yield Case(name, title, size, error_m, *estimates)


def corrupted(
    scenes: Sequence[str],
    seeds: Sequence[int],
    data: Path | None,
    sizes: Sequence[float],
    *,
    multipath: bool,
    whole: bool,
) -> Iterator[Case]:
    """Yield the cases of simulated recordings, and of real ones if `data` is given."""
    for seed in seeds:
        for scene in scenes:
            for camera in verdict.CAMERAS:
                recording = verdict.recorded(scene, camera, seed, multipath=multipath)
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
        recording = recording.select(every=-(-len(recording) // MAX_FRAMES))
        if name in EXACT:
            assert recording.reference is not None
            yield from cases(name, recording, recording.reference, 1, sizes, whole=whole)
            continue
        parts, _, _, problem = ours(recording, 2)
        if problem or not np.isfinite(parts[0].poses).all():
            print(f"{name}: {problem or 'frames without a pose'}")
            continue
        yield from cases(name, recording, parts[0].poses, 1, sizes, whole=whole)


def print_corrupted(found: Sequence[Case]) -> None:
    """Print how well each kind of corruption, and each range of errors, is detected."""
    good = [c for c in found if c.good]
    print(
        "\n| corrupted by | trajectories | error mm (median) | estimate mm | at least mm"
        " | bound holds | inconsistent | more | ROC area | by distance |"
        "\n|---|---|---|---|---|---|---|---|---|---|"
    )
    print(row("nothing", good, good))
    bad = [c for c in found if not c.good]
    for name, size in dict.fromkeys((c.name, c.size) for c in bad):
        own = [c for c in bad if (c.name, c.size) == (name, size)]
        print(row(f"{name}, size {size:g}", own, good))
    for low, high in ERROR_BINS_M:
        own = [c for c in bad if low <= c.error_m < high]
        title = f"{1e3 * low:g} mm and more"
        if np.isfinite(high):
            title = f"{1e3 * low:g} to {1e3 * high:g} mm"
        if own:
            print(row(f"errors of {title}", own, good))
    own = [c for c in bad if c.error_m > c.fit_m]
    if own:
        print(row("errors above the bound of the best fit", own, good))


def row(name: str, own: Sequence[Case], good: Sequence[Case]) -> str:
    """A row of the table; ranks and areas exclude errors below the noise of the good ones."""
    error, estimate, lower = (
        1e3 * np.median([getattr(c, key) for c in own])
        for key in ("error_m", "estimate_m", "at_least_m")
    )
    holds = sum(c.at_least_m <= c.error_m for c in own)
    contradicted = sum(c.at_least_m > 0 for c in own)
    cells = [name, len(own), f"{error:.1f}", f"{estimate:.1f}", f"{lower:.1f}"]
    cells += [f"{holds} of {len(own)}", f"{contradicted} of {len(own)}"]
    far = [c for c in own if not c.good and c.error_m >= ERROR_BINS_M[0][0]]
    if far:
        of_good = {c.recording: c.estimate_m for c in good}
        more = sum(c.estimate_m > of_good.get(c.recording, np.inf) for c in far)
        cells += [f"{more} of {len(far)}"]
        cells += [f"{separation(far, good, key):.3f}" for key in ("estimate_m", "distance_m")]
    return f"| {' | '.join(map(str, cells))} |"


def separation(bad: Sequence[Case], good: Sequence[Case], key: str) -> float:
    """Area under the ROC curve of an estimate, over all recordings."""
    values = np.array([getattr(c, key) for c in (*bad, *good)])
    is_bad = np.array([True] * len(bad) + [False] * len(good))
    return roc_area(values, is_bad)


def programs(data: Path, only: str | None) -> None:
    """Rank the trajectories of several programs: by estimate, true error, map consistency."""
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
        estimates, true, maps = [], [], []
        for label, poses in made.items():
            found = judge(recording, poses)
            reference = recording.reference
            error = np.nan if reference is None else difference(reference, poses)
            rms, inliers = agreement(recording, poses)
            d = found.deviation
            estimates.append(0.0 if d is None else d.estimate_m)
            lower = 0.0 if d is None else 1e3 * d.at_least_m
            true.append(error)
            maps.append(1 - inliers)
            print(
                f"| {label} | {1e3 * estimates[-1]:.1f} | {lower:.1f} "
                f"| {1e3 * np.sqrt(np.nanmean(found.displacement_m**2)):.1f} "
                f"| {1e3 * found.accuracy.position_m:.1f} "
                f"| {1e3 * error:.1f} "
                f"| {1e3 * rms:.1f}, {inliers:.1%} |",
                flush=True,
            )
        for title, other in (("true error", true), ("map consistency", maps)):
            order = [np.argsort(values).tolist() for values in (estimates, other)]
            print(f"same ranking as by {title}: {'yes' if order[0] == order[1] else 'no'}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print every judged trajectory, and the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("what", choices=["corrupted", "programs"])
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
    multipath = not options.without_multipath
    for case in corrupted(
        options.scenes, options.seeds, data, options.sizes, multipath=multipath, whole=options.whole
    ):
        found.append(case)
        print(
            f"{case.recording:26} {case.name:8} {case.size:g}: error {1e3 * case.error_m:7.1f} mm,"
            f" estimate {1e3 * case.estimate_m:7.1f} ({1e3 * case.at_least_m:.1f} to"
            f" {1e3 * case.at_most_m:.1f}), distance {1e3 * case.distance_m:.1f}",
            flush=True,
        )
    print_corrupted(found)


if __name__ == "__main__":
    main()
