"""Sessions in one map: are those joined that share a place, how exactly, and no others?

Tours of a simulated flat with four rooms, each reconstructed alone and then merged with the first
one, which goes from room 0 into room 1. The truth is exact. `join error` is how far the second
session is off from the first in the merged map: each session's own frames are brought onto the
truth, and what is left between the two is measured in the middle of the room that they share.

`--row N` merges sessions one after the other into a growing map, each a walk of its own through a
part of two rooms, and prints after each merge how far the map is off, and its worst session.

    python benchmarks/sessions.py [--cases shares-a-room,...] [--threads 2]
    python benchmarks/sessions.py --row 10 [--frames 61]
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from unittest import mock

import numpy as np

from tofuse.arrays import Float64
from tofuse.evaluation.trajectory import align, displacement
from tofuse.geometry import se3
from tofuse.lab.simulation import paths
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.record import Plan, plan, write
from tofuse.lab.simulation.scenes import flat, furniture
from tofuse.lab.simulation.scenes.assembly import Assembly, placed
from tofuse.pipeline.merging import MergeOptions, merge_files
from tofuse.pipeline.run import Options, run
from tofuse.results.sessions import probability_text
from tofuse.results.types import Reconstruction

OUT = Path(__file__).resolve().parent / "out" / "recordings" / "sessions"
RUNS = Path(__file__).resolve().parent / "out" / "sessions"
EVERY = 4
# The second tour goes beside the first one, and looks aside.
BESIDE = paths.rotation([0, 0.2, 0])
BESIDE[:3, 3] = 0.12, 0.03, 0.0


@dataclass(frozen=True)
class Tour:
    """A walk through a part of the flat.

    Attributes
    ----------
    first, frames
        Raw frame to begin with, and how many are taken.
    beside
        Whether it goes beside the usual path.
    chair
        By how much the chair in room 1 has moved, m; None where there is none.
    refurnished
        Whether each room has the furniture of the next one: another flat of the same plan.
    """

    name: str
    first: int
    frames: int
    scene: str = "flat"
    camera: str = "ifm-o3r"
    beside: bool = True
    chair: float | None = 0.0
    refurnished: bool = False

    def plan(self) -> Plan:
        """What is recorded."""
        with ExitStack() as stack:
            if self.scene == "flat":
                rooms = list(flat._FURNISHED)
                rooms = rooms[1:] + rooms[:1] if self.refurnished else rooms
                if self.chair is not None:
                    rooms[1] = with_chair(rooms[1], self.chair)
                stack.enter_context(mock.patch.object(flat, "_FURNISHED", rooms))
            made = plan(
                self.scene,
                camera=self.camera,
                effects=Effects().without("multipath", "smear"),
                every=EVERY,
                first=self.first,
                frames=self.frames,
            )
        if not self.beside:
            return made
        path = made.sequence.camera_path
        return replace(
            made, sequence=replace(made.sequence, camera_path=lambda t: path(t) @ BESIDE)
        )

    def recording(self) -> tuple[Path, Float64]:
        """Its folder, and (N, 4, 4) true T_flat_camera."""
        made, folder = self.plan(), OUT / self.name
        if not folder.is_dir():
            unfinished = folder.with_name(f"{folder.name}.part")
            shutil.rmtree(unfinished, ignore_errors=True)
            write(made, unfinished)
            unfinished.rename(folder)
        start = made.raw[0] / made.sequence.frame_rate_hz
        return folder, made.sequence.T_room_camera(start) @ made.poses

    def result(self, threads: int) -> Path:
        """The folder of its result."""
        folder, _ = self.recording()
        out = RUNS / self.name
        if not (out / "run.json").is_file():
            run([folder], Options(out=out, threads=threads))
        return out


Furnish = Callable[[Assembly, Float64, np.random.Generator, int], None]


def with_chair(furnish: Furnish, moved: float) -> Furnish:
    """A room with one more chair."""

    def furnished(assembly: Assembly, T: Float64, rng: np.random.Generator, room: int) -> None:
        furnish(assembly, T, rng, room)
        furniture.chair(assembly, flat.FABRICS[3], T @ placed((0.9 + moved, -1.3), 2.2), arms=False)

    return furnished


FIRST = Tour("a", 120, 81, beside=False)
SECOND = Tour("b", 180, 81)
ALIKE = Tour("alike", 0, 81, scene="flat-alike", beside=False, chair=None)


@dataclass(frozen=True)
class Case:
    """Two tours, and whether they are of one place."""

    name: str
    first: Tour
    second: Tour
    one_place: bool


CASES = (
    Case("shares a room", FIRST, SECOND, True),
    Case("chair moved by 10 cm", FIRST, replace(SECOND, name="b-moved", chair=0.1), True),
    Case("another camera", FIRST, replace(SECOND, name="b-sr4000", camera="sr4000"), True),
    Case("shares a doorway", FIRST, Tour("doorway", 400, 60), True),
    Case("other rooms", FIRST, Tour("c", 570, 60), False),
    Case(
        "flat of the same plan",
        FIRST,
        replace(SECOND, name="b-refurnished", refurnished=True, chair=None),
        False,
    ),
    Case(
        "furniture of another room",
        Tour("c", 570, 60),
        replace(SECOND, name="b-refurnished", refurnished=True, chair=None),
        False,
    ),
    Case(
        "study of another flat",
        FIRST,
        replace(ALIKE, name="alike-2", first=570, beside=True),
        False,
    ),
    Case(
        "room that looks alike",
        ALIKE,
        replace(ALIKE, name="alike-2", first=570, beside=True),
        False,
    ),
)


def join_error(result: Reconstruction, truth: Sequence[Float64]) -> tuple[float, float]:
    """m and rad by which the second session is off from the first; NaN where it is apart."""
    if result.sessions[1].T_main_session is None:
        return np.nan, np.nan
    index = np.array([f.index for f in result.diagnostics.frames])
    T_flat_map, common = [], None
    for session, true in zip(result.sessions, truth, strict=True):
        mine = np.array([session.has(int(k)) for k in index]) & result.has_pose
        known = true[index[mine] - session.first]
        T_flat_map.append(align(result.trajectory[mine], known))
        common = known if common is None else common
    # Where the second tour is, as the first one's map has it and as its own has it.
    _, theirs = truth
    nearest = np.linalg.norm(theirs[:, None, :3, 3] - truth[0][None, :, :3, 3], axis=2).min(1)
    here = theirs[nearest < 0.5]
    off = se3.inverse(T_flat_map[0]) @ T_flat_map[1]
    # Of points in the map: in the frame of the flat they lie where the shared cameras are.
    at = se3.inverse(T_flat_map[1]) @ here
    moved = (off @ at)[:, :3, 3] - at[:, :3, 3]
    return float(np.sqrt((moved**2).sum(1).mean())), float(se3.angle(off))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", default="", help="names, separated by commas")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--row", type=int, help="so many sessions in a row, and nothing else")
    parser.add_argument("--frames", type=int, default=61, help="of each session in a row")
    arguments = parser.parse_args()
    if arguments.row:
        in_a_row(arguments.row, arguments.frames, arguments.threads)
        return
    wanted = {name.strip().replace("-", " ") for name in arguments.cases.split(",") if name}
    head = ("case", "joined", "join error", "ATE a", "ATE b", "ATE map", "stated", "how sure")
    head = (*head, "changed")
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    for case in CASES:
        if wanted and case.name not in wanted:
            continue
        tours = (case.first, case.second)
        truth = [tour.recording()[1] for tour in tours]
        folders = [tour.result(arguments.threads) for tour in tours]
        out = RUNS / "merged" / case.name.replace(" ", "-")
        options = MergeOptions(out, overwrite=True, threads=arguments.threads)
        result = merge_files(folders, options)
        print(row(case, result, truth), flush=True)


def in_a_row(count: int, frames: int, threads: int) -> None:
    """Merge sessions one after the other, and print the error of the map after each."""
    head = ("sessions", "in the map", "ATE map", "ATE worst session", "stated", "changed")
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    # Each begins elsewhere in the first two rooms, and every other one goes beside the path.
    starts = [120 + 25 * (k % 5) + 8 * (k // 5) for k in range(count)]
    tours = [
        Tour(f"row-{start}-{frames}", start, frames, beside=k % 2 == 1)
        for k, start in enumerate(starts)
    ]
    truth = [tour.recording()[1] for tour in tours]
    whole = tours[0].result(threads)
    for k in range(1, count):
        out = RUNS / "merged" / f"row-{frames}-{k + 1}"
        options = MergeOptions(out, overwrite=True, threads=threads)
        result = merge_files([whole, tours[k].result(threads)], options)
        whole = out
        true, ates = against(result, truth)
        posed = result.has_pose
        joined = sum(session.T_main_session is not None for session in result.sessions)
        cells = (
            f"{k + 1}",
            f"{joined}",
            f"{1e3 * displacement(result.trajectory[posed], true[posed])[0]:.1f} mm",
            f"{1e3 * np.nanmax(ates):.1f} mm",
            f"{1e3 * result.diagnostics.accuracy.position_m:.0f} mm",
            ", ".join(c.change.kind for c in result.changes) or "-",
        )
        print("| " + " | ".join(cells) + " |", flush=True)


def against(result: Reconstruction, truth: Sequence[Float64]) -> tuple[Float64, list[float]]:
    """(N, 4, 4) true poses of the frames, and the ATE of each session in m, NaN where apart."""
    index = np.array([f.index for f in result.diagnostics.frames])
    true = np.full((len(index), 4, 4), np.nan)
    ates = []
    for session, known in zip(result.sessions, truth, strict=False):
        mine = np.array([session.has(int(k)) for k in index])
        true[mine] = known[index[mine] - session.first]
        both = mine & result.has_pose
        ates.append(displacement(result.trajectory[both], true[both])[0] if both.any() else np.nan)
    return true, ates


def row(case: Case, result: Reconstruction, truth: Sequence[Float64]) -> str:
    """One line of the table."""
    true, ates = against(result, truth)
    posed = result.has_pose
    ate = displacement(result.trajectory[posed], true[posed])[0]
    metres, angle = join_error(result, truth)
    joined = result.sessions[1].T_main_session is not None
    pair = result.session_pairs[0]
    right = "" if joined == case.one_place else " (wrong)"
    cells = [
        case.name,
        ("yes" if joined else "no") + right,
        f"{1e3 * metres:.1f} mm, {np.degrees(angle):.2f}°" if joined else "-",
        *(f"{1e3 * a:.1f} mm" if np.isfinite(a) else "-" for a in (*ates, ate)),
        f"{1e3 * result.diagnostics.accuracy.position_m:.0f} mm",
        "-"
        if pair.probability is None
        else f"{probability_text(pair.probability)}, {pair.links} links",
        ", ".join(c.change.kind for c in result.changes) or "-",
    ]
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
