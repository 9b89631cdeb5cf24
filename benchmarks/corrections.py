"""Whether what a recording decides to correct helps: whole runs with corrections and without.

Rooms of both simulators (`verdict.py`), with and without indirect light, by cameras that are
calibrated and by cameras whose stated focal length, principal point or range is wrong. Each is
reconstructed as by default, and if that corrects multipath (`sensor.multipath_correction`) or the
calibration (`mapping.self_calibration`), once more without any correction. A row has what was wrong
and what was corrected, the rms errors of the poses without and with the corrections, and the stated
bounds. The table at the end counts, by what was wrong, the corrected runs, those in which the error
is more than 10 % larger with the corrections than without, and errors beyond their bounds.

    python benchmarks/corrections.py [--seeds 41] [--families phone room] [--cases calibrated]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np

import other_sensor
import stress
import verdict
from tofuse.apps.jobs.run_options import Options, resolve
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.mapping.adaptation import adapted
from tofuse.engine.mapping.config import Config
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.engine.mapping.self_calibration import in_words
from tofuse.engine.quality.trajectory_errors import displacement
from tofuse.engine.results import Reconstruction
from tofuse.engine.sensor import CameraErrors, Multipath

WORSE = 1.1
ROOMS = [name for name in verdict.SCENES if name != "flat"]  # flats take minutes each
CALIBRATED = "calibrated"
CASES: dict[str, Callable[[RangeFrame], RangeFrame]] = {
    CALIBRATED: lambda frame: frame,
    "focal 3 % long": partial(stress.lens_off, fx=1.03, fy=1.03),
    "focal 3 % short": partial(stress.lens_off, fx=0.97, fy=0.97),
    "principal point 2 % off": partial(stress.lens_off, cx=0.02),
    "range 3 cm long": partial(stress.farther, metres=0.03),
    "range 3 cm short": partial(stress.farther, metres=-0.03),
}


@dataclass(frozen=True)
class Row:
    """A recording with its errors and stated bounds, m, without and with what was corrected."""

    name: str
    case: str
    corrected: tuple[str, ...]
    errors_m: tuple[float, float]
    bounds_m: tuple[float, float]

    @property
    def worse(self) -> bool:
        """Whether the corrections make the poses worse by more than 10 %."""
        return self.errors_m[1] > WORSE * self.errors_m[0]

    @property
    def outside(self) -> bool:
        """Whether the error with the corrections exceeds its bound."""
        return self.errors_m[1] > self.bounds_m[1]

    def __str__(self) -> str:
        """Format as a row of the table."""
        errors, bounds = (
            " / ".join(f"{1e3 * value:.1f}" for value in pair)
            for pair in (self.errors_m, self.bounds_m)
        )
        mark = " ".join(["WORSE"] * self.worse + ["OUTSIDE"] * self.outside)
        return (
            f"| {self.name} | {self.case} | {', '.join(self.corrected) or '-'} | {errors} "
            f"| {bounds} | {mark} |"
        )


def rooms(seeds: Sequence[int], families: Sequence[str]) -> Iterator[tuple[str, Recording]]:
    """Yield names and recordings, with indirect light and without."""
    sensors = [name for name in families if name in other_sensor.SENSORS]
    scenes = [name for name in families if name in ROOMS]
    for _, name, recording in chain(
        verdict.other_recordings(seeds, sensors), verdict.simulated_recordings(seeds, scenes)
    ):
        yield name, recording


def without_corrections(config: Config) -> Config:
    """Return the configuration with nothing that the recording decides on."""
    kept = [
        replace(part, applied=False) if isinstance(part, Multipath) else part
        for part in config.corrections
    ]
    return replace(config, corrections=tuple(kept), self_calibration=False)


def corrections_of(config: Config, result: Reconstruction) -> Iterator[str]:
    """Yield what the recording decided to correct, in words."""
    for part in config.corrections:
        if isinstance(part, Multipath) and part.applied and part.strength is not None:
            yield f"multipath ({part.strength[0]:.2f} ± {part.strength[1]:.2f})"
    found = result.diagnostics.calibrated
    if found is not None:
        errors = (found.focal, found.offset_m, found.center_x, found.center_y, found.distortion)
        yield in_words(CameraErrors(*errors))


def judged(name: str, case: str, recording: Recording) -> Row:
    """Reconstruct with the corrections, and without them if there are any."""
    config = adapted(resolve(Options(out=Path("unused"))), recording)
    result = reconstruct(recording, config)
    corrected = tuple(corrections_of(config, result))
    plain = reconstruct(recording, without_corrections(config)) if corrected else result
    truth = recording.reference
    assert truth is not None
    errors, bounds = [], []
    both = plain.has_pose & result.has_pose
    for one in (plain, result):
        error = displacement(truth[both], one.trajectory[both])[0] if both.sum() > 2 else np.inf
        errors.append(error)
        bounds.append(one.diagnostics.accuracy.position_m)
    return Row(name, case, corrected, (errors[0], errors[1]), (bounds[0], bounds[1]))


def table(rows: Sequence[Row]) -> Iterator[str]:
    """Yield the table by what was wrong."""
    yield (
        "| camera | runs | corrected | better | more than 10 % worse | median error of the "
        "corrected, mm: without, with | outside the bound |"
    )
    yield "|---" * 7 + "|"
    for case in [*dict.fromkeys(row.case for row in rows), "all"]:
        own = [row for row in rows if case in (row.case, "all")]
        corrected = [row for row in own if row.corrected]
        better = sum(row.errors_m[1] < row.errors_m[0] for row in corrected)
        medians = np.median([row.errors_m for row in corrected] or [(np.nan, np.nan)], axis=0)
        yield (
            f"| {case} | {len(own)} | {len(corrected)} | {better} "
            f"| {sum(row.worse for row in corrected)} "
            f"| {', '.join(f'{1e3 * median:.1f}' for median in medians)} "
            f"| {sum(row.outside for row in own)} |"
        )


def main() -> None:
    """Run all, print a row for each and the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    families = [*other_sensor.SENSORS, *ROOMS]
    parser.add_argument("--seeds", nargs="*", type=int, default=[41, 42])
    parser.add_argument("--families", nargs="*", default=families, choices=families)
    parser.add_argument("--cases", nargs="*", default=[*CASES], choices=[*CASES])
    given = parser.parse_args()
    print("| recording | camera | corrected | error mm, without / with | bound mm | |")
    print("|---" * 6 + "|")
    rows = []
    for name, recording in rooms(given.seeds, given.families):
        frames = [frame for frame in recording if isinstance(frame, RangeFrame)]
        for case in given.cases:
            metadata = dict(recording.metadata)
            made = [CASES[case](frame) for frame in frames]
            source = ArraySource(made, recording.reference, metadata=metadata)
            rows.append(judged(name, case, Recording.of(source, recording.path, recording.format)))
            print(rows[-1], flush=True)
    print()
    print("\n".join(table(rows)))


if __name__ == "__main__":
    main()
