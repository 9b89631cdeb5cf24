"""Coverage and sharpness of the stated accuracy, and correctness of the verdict.

Many runs are assessed without ground truth and then compared with it. For each, the true rms error
of the poses after alignment and the stated 95 % bound are printed; at the end, by family, the
coverage of the bound, the median ratio of bound to error, and how often right and wrong runs were
called good; and for each fault of the recordings, how often a reason or finding names it. A run is
right if its error is within the tolerance (0.5 % of the model's diagonal, at least 1 cm) and at
least 95 % of its frames have a pose; for real recordings, the uncertainty of the reference is
added. Another table has the causes of the bounds, by their size relative to the true error.

Simulated scenes are recorded by several cameras, with and without multipath. Variants of each
recording have every second or fourth frame, a wrong focal length or principal point, a depth
offset, or a gap. A second simulator (`other_sensor.py`) has a family for each of its cameras, of
smaller recordings without variants. The family `incidents` has cases of `stress.py`: a person
passes through the view, the lens is covered, the camera approaches a bare wall, or continues in
another place. Real recordings are used complete and with every fourth frame.

    python benchmarks/verdict.py [--seeds 10 11] [--families room] [--real] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

import other_sensor
import sequences
import stress
from made_once import made_once
from recorded import RECORDED
from tofuse.apps.inspection.inspect import inspect_recording
from tofuse.apps.jobs.run_options import Options, resolve
from tofuse.apps.jobs.running import with_findings
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import TofuseError
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.engine.quality.trajectory_errors import displacement
from tofuse.engine.results.checks import tolerance_of
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.record import simulate

OUT = sequences.OUT / "recordings" / "verdict"
# Stride over the raw frames of each scene.
SCENES = {"room": 12, "rail": 10, "empty-room": 12, "corridor": 12, "flat": 3}
FRAMES = 60
CAMERAS = ("sr4000", "ifm-o3r", "pico-flexx")
POSED = 0.95
FOCAL, CENTER, OFFSET_M = 1.05, 0.02, 0.03
INCIDENTS = "incidents"
UNCHANGED = "as it is"
# Fault of a recording, by the end of a run's name, and the reasons that name it.
CALIBRATION = frozenset({"calibration_alarm", "self_calibrated", "unchecked_calibration"})
INCIDENT_CAUSES = {
    "passes over 25%": frozenset({"moving_objects"}),
    "passes over 40%": frozenset({"moving_objects"}),
    "by a lid, 1 s": frozenset({"lost_frames"}),
    "by a hand, 1 s": frozenset({"lost_frames", "disconnected"}),
    "close-up of a bare wall": frozenset({"unobserved_motion"}),
    "two places": frozenset({"disconnected"}),
}
CAUSES = {
    "focal 5 % off": CALIBRATION,
    "principal point 2 % off": CALIBRATION,
    "depth 3 cm off": CALIBRATION,
    "gap": frozenset({"bridged_gap", "disconnected", "frames_missing"}),
    **INCIDENT_CAUSES,
}


@dataclass(frozen=True)
class Run:
    """One run, with its true error.

    Attributes
    ----------
    error_m, error_rad
        Rms after alignment; inf if fewer than half of the frames have a pose.
    bound_m, bound_rad
        Stated bounds; inf if not bounded.
    allowed_m
        Largest error of a right run.
    posed
        Fraction of the frames with a pose.
    reference_m
        Uncertainty of the reference itself.
    causes_m
        See `Accuracy.causes_m`.
    """

    family: str
    name: str
    verdict: str
    codes: tuple[str, ...]
    error_m: float
    error_rad: float
    bound_m: float
    bound_rad: float
    allowed_m: float
    posed: float
    reference_m: float = 0.0
    causes_m: dict[str, float] = field(default_factory=dict)

    @property
    def right(self) -> bool:
        """Whether the result is right."""
        return self.error_m <= self.allowed_m and self.posed >= POSED

    @property
    def within(self) -> bool:
        """Whether the error is within the stated bound plus that of the reference."""
        return self.error_m <= self.bound_m + self.reference_m


def recorded(scene: str, camera: str, seed: int, *, multipath: bool) -> Recording:
    """A simulated recording, created once and kept."""
    make = partial(
        simulate,
        scene,
        camera=camera,
        seed=seed,
        every=SCENES[scene],
        frames=FRAMES,
        effects=Effects(multipath=multipath),
    )
    name = f"{scene}_{camera}_{seed}_{int(multipath)}"
    return open_recording(made_once(OUT / name, make))


def variants(recording: Recording) -> Iterator[tuple[str, Recording]]:
    """Yield variants of a recording."""
    yield UNCHANGED, recording
    yield "every 2nd", recording.select(every=2)
    n = len(recording)
    kept = np.r_[: n // 2 - n // 10, n // 2 + n // 10 : n]
    yield "gap", replace(recording, indices=recording.indices[kept])
    frames = [f for f in recording if isinstance(f, RangeFrame)]
    changed = {
        "focal 5 % off": [stress.lens_off(f, fx=FOCAL, fy=FOCAL) for f in frames],
        "principal point 2 % off": [stress.lens_off(f, cx=CENTER) for f in frames],
        "depth 3 cm off": [stress.farther(f, OFFSET_M) for f in frames],
    }
    for name, made in changed.items():
        source = ArraySource(made, recording.reference, metadata=dict(recording.metadata))
        yield name, Recording.of(source, recording.path, recording.format)


def judged(
    family: str,
    name: str,
    recording: Recording,
    references: Sequence[Float64],
    reference_m: float = 0.0,
    *,
    turning: bool = False,
) -> Run:
    """Inspect and reconstruct as `tofuse run` does; compare with the best-fitting reference."""
    config = resolve(Options(out=Path("unused"), object=turning))
    try:
        findings = inspect_recording(recording, turning=turning, quick=True).findings
        result = with_findings(reconstruct(recording, config), findings, turning=turning)
    except TofuseError as error:
        code = (type(error).__name__,)
        return Run(family, name, "failed", code, np.inf, np.inf, np.inf, np.inf, 0.0, 0.0)
    d = result.diagnostics
    errors = [(np.inf, np.inf)]
    for reference in references:
        both = result.has_pose & np.isfinite(reference).all((1, 2))
        if 2 * both.sum() >= len(both) and both.sum() > 1:
            errors.append(displacement(reference[both], result.trajectory[both]))
    error = min(errors)
    allowed = tolerance_of(None, result.cloud.diagonal_m) + reference_m
    return Run(
        family,
        name,
        d.verdict,
        (*(r.code for r in d.reasons), *(f.code for f in findings)),
        *error,
        d.accuracy.position_m,
        d.accuracy.rotation_rad,
        allowed,
        float(result.has_pose.mean()),
        reference_m,
        d.accuracy.causes_m,
    )


def simulated_recordings(
    seeds: Sequence[int], scenes: Sequence[str]
) -> Iterator[tuple[str, str, Recording]]:
    """Yield scene, name and recording of all cameras, with multipath and without."""
    for seed in seeds:
        for scene in scenes:
            for camera in CAMERAS:
                for multipath in (True, False):
                    label = "" if multipath else ", no multipath"
                    name = f"{scene}, {camera}{label}, seed {seed}"
                    yield scene, name, recorded(scene, camera, seed, multipath=multipath)


def simulated(seeds: Sequence[int], families: Sequence[str]) -> Iterator[Run]:
    """Yield the runs of simulated recordings."""
    for scene, name, recording in simulated_recordings(seeds, families):
        for what, made in variants(recording):
            assert made.reference is not None
            yield judged(scene, f"{name}, {what}", made, [made.reference])


def other_recordings(
    seeds: Sequence[int], sensors: Sequence[str]
) -> Iterator[tuple[str, str, Recording]]:
    """Yield sensor, name and recording of the second simulator, with indirect light and without."""
    for seed in seeds:
        for sensor in sensors:
            for scene in other_sensor.SCENES:
                for indirect in (True, False)[: 1 + other_sensor.SENSORS[sensor].has_indirect]:
                    name = f"{scene}, {sensor}{'' if indirect else ', direct'}, seed {seed}"
                    yield sensor, name, other_sensor.record(scene, sensor, seed, indirect=indirect)


def by_other_sensors(seeds: Sequence[int], sensors: Sequence[str]) -> Iterator[Run]:
    """Yield the runs of recordings by the second simulator."""
    for sensor, name, recording in other_recordings(seeds, sensors):
        assert recording.reference is not None
        yield judged(f"other: {sensor}", name, recording, [recording.reference])


def real(data: Path) -> Iterator[Run]:
    """Yield the runs of real recordings with a reference."""
    for one in RECORDED.values():
        try:
            recording = one.open(data)
        except FileNotFoundError:
            continue
        for every in (1, 4):
            part = recording.select(every=every)
            references = [poses[::every] for poses in one.references(data, recording)]
            if len(part) > 1 and references:
                name = f"{one.title}{f', every {every}th' if every > 1 else ''}"
                yield judged("real", name, part, references, one.reference_m, turning=one.object)


def incidents(seeds: Sequence[int]) -> Iterator[Run]:
    """Yield the runs of recordings with incidents."""
    for seed in seeds:
        for scene in stress.SCENES.values():
            for name in INCIDENT_CAUSES:
                for case in stress.cases(scene, seed, containing=name):
                    assert case.recording.reference is not None
                    title = f"{scene.name}, seed {seed}, {case.name}"
                    yield judged(INCIDENTS, title, case.recording, [case.recording.reference])


def line(run: Run) -> str:
    """Format one run as a line."""
    bound = f"{1e3 * run.bound_m:8.1f}" if np.isfinite(run.bound_m) else "    none"
    return (
        f"{run.name:58} {'right' if run.right else 'wrong'} {1e3 * run.error_m:8.1f}"
        f" {np.degrees(run.error_rad):6.2f} {bound} {np.degrees(run.bound_rad):6.2f}"
        f" {1e3 * run.allowed_m:6.1f}  {run.verdict:8} {' '.join(run.codes)}"
    )


def table(runs: Sequence[Run]) -> Iterator[str]:
    """Yield the table by family."""
    yield (
        "| family | runs | error within bound | bounded | median bound / error "
        "| good, of the right runs | good, of the wrong runs |"
    )
    yield "|---|---|---|---|---|---|---|"
    families = [*dict.fromkeys(run.family for run in runs)]
    for name in [*families, "all"]:
        own = [run for run in runs if name in ("all", run.family)]
        assessed = [run for run in own if np.isfinite(run.error_m)]
        bounded = [run for run in assessed if np.isfinite(run.bound_m)]
        within = sum(run.within for run in assessed)
        ratio = np.median([run.bound_m / max(run.error_m, 1e-9) for run in bounded or own])
        right = [run for run in own if run.right]
        wrong = [run for run in own if not run.right]
        good = [sum(run.verdict == "good" for run in group) for group in (right, wrong)]
        yield (
            f"| {name} | {len(own)} | {within} of {len(assessed)} | {len(bounded)} | {ratio:.1f} |"
            f" {good[0]} of {len(right)} | {good[1]} of {len(wrong)} |"
        )


def causes(runs: Sequence[Run]) -> Iterator[str]:
    """Yield the table of the causes of the bounds, as medians relative to the true error."""
    bounded = [run for run in runs if run.causes_m]
    names = [*dict.fromkeys(name for run in bounded for name in run.causes_m)]
    yield f"| family | runs | bound | {' | '.join(names)} |"
    yield "|---" * (3 + len(names)) + "|"
    for family in [*dict.fromkeys(run.family for run in bounded), "all"]:
        own = [run for run in bounded if family in ("all", run.family)]
        ratios = np.median(
            [np.array([run.bound_m, *run.causes_m.values()]) / run.error_m for run in own], axis=0
        )
        yield f"| {family} | {len(own)} | {' | '.join(f'{ratio:.2f}' for ratio in ratios)} |"


def named(runs: Sequence[Run]) -> Iterator[str]:
    """Yield the table of faults, and whether they are named where they have an effect.

    Only runs count whose recording is right and good without the fault, if that was run.
    """
    yield "| fault | runs | right and good | fault reported, of the other runs |"
    yield "|---|---|---|---|"
    fine = {run.name: run.right and run.verdict == "good" for run in runs}
    for cause, codes in CAUSES.items():
        own = [
            run
            for run in runs
            if run.name.endswith(cause) and fine.get(run.name.replace(cause, UNCHANGED), True)
        ]
        affected = [run for run in own if not fine[run.name]]
        count = sum(bool(codes.intersection(run.codes)) for run in affected)
        if own:
            yield (
                f"| {cause} | {len(own)} | {len(own) - len(affected)} |"
                f" {count} of {len(affected)} |"
            )


def main() -> None:
    """Run all, print a line for each, and the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "--seeds", nargs="*", type=int, default=[10, 11], help="seeds of the simulation"
    )
    families = [*SCENES, *other_sensor.SENSORS, INCIDENTS]
    parser.add_argument("--families", nargs="*", default=families, choices=families)
    parser.add_argument("--real", action="store_true", help="also the real recordings")
    parser.add_argument("--data", type=Path, default=sequences.DATA, help="real recordings")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all runs to this file")
    options = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    print(f"{'run':58} is     error mm    deg    bound    deg allowed  verdict", flush=True)
    runs = []
    for run in [
        *([real(options.data)] if options.real else []),
        simulated(options.seeds, [name for name in options.families if name in SCENES]),
        by_other_sensors(
            options.seeds, [name for name in options.families if name in other_sensor.SENSORS]
        ),
        incidents(options.seeds if INCIDENTS in options.families else ()),
    ]:
        for one in run:
            runs.append(one)
            print(line(one), flush=True)
    for text in [*table(runs), "", *causes(runs), "", *named(runs)]:
        print(text)
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(run) for run in runs], indent=1))


if __name__ == "__main__":
    main()
