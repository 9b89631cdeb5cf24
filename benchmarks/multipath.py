"""Range errors before and after multipath compensation, and the trial that decides on it.

    python benchmarks/multipath.py errors [--corridor folder of sr4000_corridor]
    python benchmarks/multipath.py trial [--scenes room rail] [--first-seed 5] [--frames 40]
        [--no-runs] [--recordings folder ...] [--effect with|without|other|both]

`errors`. Simulated scenes: median and 90th percentile of the absolute range error, and median of
the signed error, over pixels without other gross errors (mixed, wrapped, saturated, smeared). With
"all effects", the first two include pixel noise. The gain is estimated from the frames; that of the
simulated camera is 3482. For the corner also the angles between the fitted planes, which should be
90 degrees.

The real recording has no ground truth. Its corridor has flat walls at right angles: printed are the
distances of the pixels from the planes of the large surfaces, and the angles between these.

`trial`. Simulated recordings with all effects, and with all except multipath: the strength of
multipath that the trial estimates, with its standard error, and the decision; the decision in five
parts of the recording (halves, the middle half, and both sets of alternate frames), and the ATE of
whole runs with and without the compensation. `--effect other`: without multipath, but with errors
that the simulated camera does not have: distortion, wiggling, and smoothing that grows with the
range. For `--recordings`, real ones, only strength and
decision are printed.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from tofuse.apps.jobs.run_options import Options, resolve
from tofuse.engine.arrays import Bool, Float32, Float64
from tofuse.engine.cameras.cameras import ray_lengths
from tofuse.engine.compute.thread_pool import threads
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry.rays import homogeneous
from tofuse.engine.mapping.adaptation import adapted
from tofuse.engine.mapping.config import Config
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.engine.quality.trajectory_errors import evaluate_trajectory
from tofuse.engine.sensor.multipath_correction import Multipath, MultipathCorrector
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.simulation import record
from tofuse.lab.simulation.effects import Effects, Flag
from tofuse.lab.simulation.render import render

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "sr4000_corridor"
SCENES = ("corner", "room", "empty-room", "corridor", "box", "torso")
TRIED = ("room", "empty-room", "one-albedo", "corridor", "rail", "box", "torso")
PLAIN: dict[str, tuple[str, dict[str, bool]]] = {"one-albedo": ("empty-room", {"texture": False})}
OBJECTS = ("box", "torso")
ALBEDOS = (0.2, 0.35, 0.6, 0.9)
FRAMES = 8
GROSS = Flag.NO_RETURN | Flag.UNDER_EXPOSED | Flag.SATURATED | Flag.MIXED | Flag.WRAPPED
GROSS |= Flag.SMEAR | Flag.MIRROR
ONLY = Effects.none(multipath=True)


@dataclass
class Case:
    before: list[Float64] = field(default_factory=list)
    after: list[Float64] = field(default_factory=list)
    angles: list[tuple[Float64, Float64]] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    gain: float = 0.0


def simulated(scene: str, effects: Effects, albedo: float | None = None) -> Case:
    plan = record.plan(scene, effects=effects, texture=albedo is None)
    if albedo is not None:
        # All surfaces have uniform albedo; the rows are the parameters of the renderer.
        plan.scene._rows[:, 0] = albedo
    correction = plan.correction
    corrector = Multipath().start()
    case = Case()
    for raw in np.linspace(plan.raw[0], plan.raw[-1], FRAMES).astype(int):
        rendered = render(plan.scene, plan.sequence, plan.model, int(raw), effects=effects)
        frame = record.corrected(rendered.frame, correction)
        fixed = apply(corrector, frame, case)
        length = ray_lengths(frame.camera).astype(float)
        good = frame.valid & (rendered.depth > 0) & (rendered.flags & np.uint16(GROSS) == 0)
        case.before.append(((frame.z - rendered.depth) * length)[good])
        case.after.append(((fixed.z - rendered.depth) * length)[good])
        if scene == "corner":
            surfaces = planes_of(rendered.depth, frame)
            case.angles.append((angles(frame, surfaces), angles(fixed, surfaces)))
    case.gain = corrector.gain or 0.0
    return case


def apply(corrector: MultipathCorrector, frame: RangeFrame, case: Case) -> RangeFrame:
    """Correct a frame; timed once the gain is known."""
    corrector.apply(frame)
    known = Multipath(gain=corrector.gain).start()
    known.apply(frame)
    times = []
    for _ in range(5):
        fresh = replace(frame)
        start = time.process_time()
        fixed = known.apply(fresh)
        times.append(time.process_time() - start)
    case.seconds.append(min(times))
    assert isinstance(fixed, RangeFrame)
    return fixed


def planes_of(depth: Float32, frame: RangeFrame) -> list[Bool]:
    """Masks of the flat surfaces in a noise-free image with at least 300 pixels.

    Pixels on one plane have the same normal.
    """
    points = homogeneous(frame.camera.rays()) * depth[..., None]
    down, right = np.gradient(points, axis=(0, 1))
    normals = np.cross(right, down)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    return grouped(normals, points, depth > 0, 0.999, 0.005)


def grouped(
    normals: Float64, points: Float64, free: Bool, alike: float, max_distance_m: float
) -> list[Bool]:
    """Extract the largest planes one by one, seeded by a fixed grid of pixels."""
    found: list[Bool] = []
    free = free.copy()
    seeds = [(i, j) for i in range(6, free.shape[0], 12) for j in range(6, free.shape[1], 12)]
    while len(found) < 4:
        best = np.zeros_like(free)
        for i, j in seeds:
            if not free[i, j]:
                continue
            distance = np.abs((points - points[i, j]) @ normals[i, j])
            mask = free & (normals @ normals[i, j] > alike) & (distance < max_distance_m)
            best = mask if mask.sum() > best.sum() else best
        if best.sum() < 300:
            break
        found.append(best)
        free &= ~best
    return found


def plane(points: Float64) -> tuple[Float64, Float64]:
    """Robustly fitted plane: unit normal, and distances of the points."""
    weight = np.ones(len(points))
    for _ in range(5):
        centre = (weight[:, None] * points).sum(0) / weight.sum()
        moment = ((points - centre) * weight[:, None]).T @ (points - centre)
        normal = np.linalg.eigh(moment)[1][:, 0]
        distance = (points - centre) @ normal
        weight = 1 / (1 + (distance / max(1.5 * float(np.median(np.abs(distance))), 1e-6)) ** 2)
    return normal, distance


def angles(frame: RangeFrame, surfaces: list[Bool]) -> Float64:
    """Angles in degrees between all pairs of surfaces."""
    normals = [plane(frame.point_image[m & frame.valid].astype(float))[0] for m in surfaces]
    pairs = [abs(a @ b) for k, a in enumerate(normals) for b in normals[:k]]
    return np.degrees(np.arccos(np.clip(pairs, 0, 1)))


def millimetres(errors: list[Float64]) -> str:
    e = np.concatenate(errors) * 1e3
    size = np.abs(e)
    return f"{np.median(size):7.1f}{np.percentile(size, 90):7.1f}{np.median(e):8.1f}"


def line(name: str, effects: str, case: Case) -> str:
    return (
        f"{name:25s}{effects:11s}{millimetres(case.before)}  |{millimetres(case.after)}"
        f"  |{case.gain:7.0f}{np.median(case.seconds) * 1e3:8.1f}"
    )


def real(folder: Path) -> None:
    print("\nSR4000 in a corridor: distance of pixels from the planes of the largest surfaces")
    recording = open_recording(folder)
    corrector = Multipath().start()
    before, after, bent, square = [], [], [], []
    for k in range(len(recording)):
        frame = recording[k]
        assert isinstance(frame, RangeFrame)
        confidence = frame.confidence_image
        trusted = frame.valid if confidence is None else confidence >= 3
        fixed = corrector.apply(frame)
        assert isinstance(fixed, RangeFrame)
        if k % max(1, len(recording) // 24):
            continue
        surfaces = surfaces_of(frame, trusted)
        for mask in surfaces:
            before.append(np.median(np.abs(plane(frame.point_image[mask].astype(float))[1])))
            after.append(np.median(np.abs(plane(fixed.point_image[mask].astype(float))[1])))
        bent.append(angles(frame, surfaces))
        square.append(angles(fixed, surfaces))
    old, new = np.concatenate(bent), np.concatenate(square)
    right = (np.abs(old - 90) < 12) & (np.abs(new - 90) < 12)
    print(f"{len(before)} surfaces, gain {corrector.gain:.0f}")
    print(
        f"distance from the plane, median: {np.median(before) * 1e3:.2f} mm before, "
        f"{np.median(after) * 1e3:.2f} after"
    )
    print(
        f"{right.sum()} right angles, median |angle - 90|: "
        f"{np.median(np.abs(old[right] - 90)):.2f} deg before, "
        f"{np.median(np.abs(new[right] - 90)):.2f} after; "
        f"mean {old[right].mean():.2f} and {new[right].mean():.2f}"
    )


def surfaces_of(frame: RangeFrame, trusted: Bool) -> list[Bool]:
    """Masks of the large flat surfaces of a measured image."""
    points = frame.point_image.astype(float)
    span = 5
    right = np.roll(points, -span, 1) - np.roll(points, span, 1)
    down = np.roll(points, -span, 0) - np.roll(points, span, 0)
    normals = np.cross(right, down)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    free = frame.valid & trusted
    free[:span] = free[-span:] = False
    free[:, :span] = free[:, -span:] = False
    return [mask for mask in grouped(normals, points, free, 0.94, 0.06) if mask.sum() > 700]


def after_trial(config: Config, recording: Recording) -> Multipath | None:
    """The compensation after its trial; None if the configuration has none."""
    config = adapted(config, recording, 1)
    return next((item for item in config.corrections if isinstance(item, Multipath)), None)


def in_words(part: Multipath | None) -> tuple[str, str]:
    """Strength and decision."""
    if part is None or (part.applied and part.strength is None):
        return "", "not applicable"
    seen = (
        "too little data"
        if part.strength is None
        else f"{part.strength[0]:.2f} ± {part.strength[1]:.2f}"
    )
    return seen, "applied" if part.applied else "not applied"


def parts(recording: Recording) -> list[Recording]:
    """Halves, the middle half, and both sets of alternate frames."""
    n = len(recording)
    cuts = [(0, n // 2, 1), (n // 2, n, 1), (n // 4, n - n // 4, 1), (0, n, 2), (1, n, 2)]
    return [recording.select(*cut) for cut in cuts]


def final_error(config: Config, recording: Recording, keep: bool) -> str:
    """ATE rms in mm of a whole run with or without the compensation."""
    chosen = [
        replace(item, trial=False, applied=keep) if isinstance(item, Multipath) else item
        for item in config.corrections
    ]
    result = reconstruct(recording, replace(config, corrections=tuple(chosen)))
    truth, has = recording.reference, result.has_pose
    assert truth is not None
    times = np.arange(len(has), dtype=float)[has]
    if len(times) < 3:
        return "no poses"
    ate = evaluate_trajectory(times, result.trajectory[has], times, truth[has]).ate_rms_m
    lost = f", {len(has) - len(times)} lost" * (len(times) < len(has))
    return f"{ate * 1e3:.1f}{lost}"


def of_other_sensor(frame: RangeFrame) -> RangeFrame:
    """A frame with errors that are no multipath: distortion, wiggling, and smoothing with range."""
    rows, columns = np.indices(frame.depth.shape, np.float32)
    middle = (np.array(frame.depth.shape, np.float32) - 1) / 2
    down, right = rows - middle[0], columns - middle[1]
    factor = 1 - 0.02 * (down**2 + right**2) / (middle @ middle)
    at = (middle[1] + factor * right, middle[0] + factor * down)

    def distorted(image: Float32) -> Float32:
        return cv2.remap(image.astype(np.float32), *at, cv2.INTER_NEAREST)

    depth = distorted(frame.depth)
    seen = (depth > 0).astype(np.float32)
    means = [
        cv2.boxFilter(depth, -1, (k, k)) / np.maximum(cv2.boxFilter(seen, -1, (k, k)), 1e-6)
        for k in (1, 3, 5)
    ]
    smoothed = np.select([depth < 1.5, depth < 3], means[:2], means[2])
    wiggled = smoothed + 0.01 * np.sin(2 * np.pi * smoothed / 1.25)
    amplitude = None if frame.amplitude_image is None else distorted(frame.amplitude_image)
    wiggled = np.where(depth > 0, wiggled, 0).astype(np.float32)
    return replace(frame, depth=wiggled, amplitude_image=amplitude)


def tried(scene: str, seed: int, effect: str, runs: bool, frames: int | None) -> str:
    """One row of the trial's table."""
    multipath = effect == "with"
    effects = Effects() if multipath else Effects().without("multipath")
    name, options = PLAIN.get(scene, (scene, {}))
    every = None
    if frames is not None:
        made = record.plan(name, seed=seed, **options)
        every = made.sequence.stride * max(1, round(len(made.raw) / frames))
    recording = record.simulate_recording(name, seed=seed, every=every, effects=effects, **options)
    if effect == "other":
        changed = [of_other_sensor(frame) for frame in recording]
        source = ArraySource(changed, metadata=recording.metadata, reference=recording.reference)
        recording = Recording.of(source, recording.path, recording.format)
    config = resolve(Options(Path("unused"), object=scene in OBJECTS))
    strength, outcome = in_words(after_trial(config, recording))
    cells = [f"{scene}, seed {seed}", effect, strength, outcome]
    if runs:
        pieces = parts(recording)
        found = [after_trial(config, piece) for piece in pieces]
        applied = sum(part is not None and part.applied for part in found)
        errors = [final_error(config, recording, keep) for keep in (True, False)]
        cells += [f"{applied} of {len(pieces)}", *errors]
    return f"| {' | '.join(cells)} |"


def tried_real(path: Path) -> str:
    """The same for a real recording, without ground truth."""
    config = resolve(Options(Path("unused")))
    return (
        f"| {path.name} | ? | {' | '.join(in_words(after_trial(config, open_recording(path))))} |"
    )


def print_trial(given: argparse.Namespace) -> None:
    runs = not given.no_runs
    more = "| applied in parts | ATE with | ATE without |" if runs else "|"
    print(f"| recording | multipath | strength | compensation {more}")
    print("|---" * (7 if runs else 4) + "|")
    for there in {"both": ["without", "with"]}.get(given.effect, [given.effect]):
        for scene in given.scenes:
            for seed in range(given.first_seed, given.first_seed + given.seeds):
                print(tried(scene, seed, there, runs, given.frames), flush=True)
    for path in given.recordings:
        print(tried_real(path), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["errors", "trial"])
    parser.add_argument("--corridor", type=Path, default=DATA, help="a real recording, in 'errors'")
    parser.add_argument("--scenes", nargs="*", default=TRIED, help="in 'trial'")
    parser.add_argument("--seeds", type=int, default=1, help="in 'trial'")
    parser.add_argument("--first-seed", type=int, default=0, help="in 'trial'")
    parser.add_argument("--frames", type=int, help="in 'trial': approximate number, evenly spread")
    parser.add_argument("--recordings", nargs="*", type=Path, default=[], help="in 'trial'")
    parser.add_argument("--effect", choices=["with", "without", "other", "both"], default="both")
    parser.add_argument("--no-runs", action="store_true", help="'trial' without the final errors")
    given = parser.parse_args()
    if given.what == "errors":
        print_errors(given.corridor)
        return
    print_trial(given)


def print_errors(folder: Path) -> None:
    print(f"{'':36s}{'mm before':>22s}  |{'mm after':>22s}  |")
    print(f"{'scene':25s}{'effects':11s}" + 2 * "    med    90%  signed  |" + "   gain      ms")
    with threads(1):
        corner = None
        for scene in SCENES:
            for name, effects in (("multipath", ONLY), ("all", Effects())):
                case = simulated(scene, effects)
                print(line(scene, name, case), flush=True)
                corner = case if scene == "corner" else corner
        for albedo in ALBEDOS:
            for scene in ("corner", "empty-room"):
                case = simulated(scene, Effects(), albedo)
                print(line(f"{scene}, albedo {albedo}", "all", case), flush=True)
        assert corner is not None
        old, new = (np.concatenate(x) for x in zip(*corner.angles, strict=True))
        print(
            "corner, all effects: angles between its planes "
            f"{old.min():.1f} to {old.max():.1f} deg before (median |angle - 90| "
            f"{np.median(np.abs(old - 90)):.2f}), {new.min():.1f} to {new.max():.1f} after "
            f"({np.median(np.abs(new - 90)):.2f})"
        )
        if folder.is_dir():
            real(folder)


if __name__ == "__main__":
    main()
