"""Merging of sessions: are those of one place joined, how accurately, and no others?

Tours of a simulated flat with four rooms, each reconstructed alone and then merged with the first
one, which goes from room 0 into room 1. Ground truth is exact. `join error` is the relative error
between the two sessions in the merged map: each session is aligned to the ground truth, and the
difference of the two alignments is measured at the cameras in the shared room.

`--row N` merges sessions one by one into a growing map, each a different walk through parts of two
rooms, and prints after each merge the ATE of the map and of its worst session.

    python benchmarks/sessions.py [--cases shares-a-room,...] [--threads 2]
    python benchmarks/sessions.py --row 10 [--frames 61]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from unittest import mock

import numpy as np

from made_once import made_once
from tofuse.apps.jobs.merging import MergeOptions, merge_files
from tofuse.apps.jobs.run_options import Options
from tofuse.apps.jobs.running import run
from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.engine.quality.trajectory_errors import align, displacement
from tofuse.engine.quantities import probability
from tofuse.engine.results.types import Reconstruction
from tofuse.lab.scenes import flat, furniture
from tofuse.lab.scenes.composition import Assembly, placed
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.phone import NAME as PHONE
from tofuse.lab.simulation.phone import PhonePlan, plan_phone, write_phone
from tofuse.lab.simulation.record import RecordingPlan, plan, write
from tofuse.lab.world import paths
from tofuse.lab.world.scene import Sequence as Motion

OUT = Path(__file__).resolve().parent / "out" / "recordings" / "sessions"
RUNS = Path(__file__).resolve().parent / "out" / "sessions"
EVERY = 4
# The second tour follows a parallel path, and looks to the side.
BESIDE = paths.rotation([0, 0.2, 0])
BESIDE[:3, 3] = 0.12, 0.03, 0.0


@dataclass(frozen=True)
class Tour:
    """A walk through part of the flat.

    Attributes
    ----------
    first, frames
        First raw frame, and number of frames.
    parallel
        Whether it follows a path parallel to the usual one.
    chair
        Displacement of the chair in room 1, m; None without a chair.
    refurnished
        Whether each room has the furniture of the next one: another flat with the same plan.
    """

    name: str
    first: int
    frames: int
    scene: str = "flat"
    camera: str = "ifm-o3r"
    parallel: bool = True
    chair: float | None = 0.0
    refurnished: bool = False

    def plan(self) -> tuple[RecordingPlan | PhonePlan, Float64]:
        """The plan of the simulation, and (N, 4, 4) true T_flat_camera."""
        with ExitStack() as stack:
            if self.scene == "flat":
                rooms = list(flat._FURNISHED)
                rooms = rooms[1:] + rooms[:1] if self.refurnished else rooms
                if self.chair is not None:
                    rooms[1] = with_chair(rooms[1], self.chair)
                stack.enter_context(mock.patch.object(flat, "_FURNISHED", rooms))
            part = {"every": EVERY, "first": self.first, "frames": self.frames}
            if self.camera == PHONE:
                made = plan_phone(self.scene, **part)
                made = replace(made, motion=self._moved(made.motion))
                return made, made.motion.T_room_camera(made.times[0]) @ made.poses
            effects = Effects().without("multipath", "smear")
            made = plan(self.scene, camera=self.camera, effects=effects, **part)
        made = replace(made, sequence=self._moved(made.sequence))
        start = made.raw[0] / made.sequence.frame_rate_hz
        return made, made.sequence.T_room_camera(start) @ made.poses

    def _moved(self, motion: Motion) -> Motion:
        """The motion on the path of this tour."""
        if not self.parallel:
            return motion
        path = motion.camera_path
        return replace(motion, camera_path=lambda t: path(t) @ BESIDE)

    def recording(self) -> tuple[Path, Float64]:
        """Folder of the recording, and (N, 4, 4) true T_flat_camera."""
        (made, poses), folder = self.plan(), OUT / self.name
        made_once(folder, partial(write_phone if isinstance(made, PhonePlan) else write, made))
        return folder, poses

    def result(self, threads: int) -> Path:
        """Folder of the result."""
        folder, _ = self.recording()
        out = RUNS / self.name
        if not (out / "run.json").is_file():
            run([folder], Options(out=out, threads=threads))
        return out


Furnish = Callable[[Assembly, Float64, np.random.Generator, int], None]


def with_chair(furnish: Furnish, moved: float) -> Furnish:
    """Furnish a room with one more chair."""

    def furnished(assembly: Assembly, T: Float64, rng: np.random.Generator, room: int) -> None:
        furnish(assembly, T, rng, room)
        moved_chair = assembly.at(T @ placed((0.9 + moved, -1.3), 2.2))
        furniture.chair(moved_chair, flat.FABRICS[3], arms=False)

    return furnished


FIRST = Tour("a", 120, 81, parallel=False)
SECOND = Tour("b", 180, 81)
ALIKE = Tour("alike", 0, 81, scene="flat-alike", parallel=False, chair=None)


@dataclass(frozen=True)
class Case:
    """Two tours, and whether they share a place."""

    name: str
    first: Tour
    second: Tour
    one_place: bool


CASES = (
    Case("shares a room", FIRST, SECOND, True),
    Case("chair moved by 10 cm", FIRST, replace(SECOND, name="b-moved", chair=0.1), True),
    Case("another camera", FIRST, replace(SECOND, name="b-sr4000", camera="sr4000"), True),
    Case("a phone", FIRST, replace(SECOND, name="b-phone", camera=PHONE), True),
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
        replace(ALIKE, name="alike-2", first=570, parallel=True),
        False,
    ),
    Case(
        "room that looks alike",
        ALIKE,
        replace(ALIKE, name="alike-2", first=570, parallel=True),
        False,
    ),
)


def join_error(result: Reconstruction, truth: Sequence[Float64]) -> tuple[float, float]:
    """Relative error of the second session in m and rad; NaN if it is not joined."""
    if result.sessions[1].T_main_session is None:
        return np.nan, np.nan
    index = np.array([f.index for f in result.diagnostics.frames])
    T_flat_map, common = [], None
    for session, true in zip(result.sessions, truth, strict=True):
        mine = np.array([session.has(int(k)) for k in index]) & result.has_pose
        known = true[index[mine] - session.first]
        T_flat_map.append(align(result.trajectory[mine], known))
        common = known if common is None else common
    # Alignments of both sessions to the flat, and cameras of the second one.
    _, theirs = truth
    nearest = np.linalg.norm(theirs[:, None, :3, 3] - truth[0][None, :, :3, 3], axis=2).min(1)
    here = theirs[nearest < 0.5]
    error = se3.inverse(T_flat_map[0]) @ T_flat_map[1]
    # Displacement of points at these cameras.
    at = se3.inverse(T_flat_map[1]) @ here
    moved = (error @ at)[:, :3, 3] - at[:, :3, 3]
    return float(np.sqrt((moved**2).sum(1).mean())), float(se3.angle(error))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", default="", help="names, separated by commas")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument(
        "--row", type=int, help="merge this many sessions one by one, and nothing else"
    )
    parser.add_argument("--frames", type=int, default=61, help="frames per session, with --row")
    arguments = parser.parse_args()
    if arguments.row:
        in_a_row(arguments.row, arguments.frames, arguments.threads)
        return
    wanted = {name.strip().replace("-", " ") for name in arguments.cases.split(",") if name}
    head = ("case", "joined", "join error", "ATE a", "ATE b", "ATE map", "stated", "confidence")
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
    """Merge sessions one by one, and print the error of the map after each."""
    head = ("sessions", "in the map", "ATE map", "ATE worst session", "stated", "changed")
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    # Each starts elsewhere in the first two rooms; every other one follows the parallel path.
    starts = [120 + 25 * (k % 5) + 8 * (k // 5) for k in range(count)]
    tours = [
        Tour(f"row-{start}-{frames}", start, frames, parallel=k % 2 == 1)
        for k, start in enumerate(starts)
    ]
    truth = [tour.recording()[1] for tour in tours]
    whole = tours[0].result(threads)
    for k in range(1, count):
        out = RUNS / "merged" / f"row-{frames}-{k + 1}"
        options = MergeOptions(out, overwrite=True, threads=threads)
        result = merge_files([whole, tours[k].result(threads)], options)
        whole = out
        true, ates = compared(result, truth)
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


def compared(result: Reconstruction, truth: Sequence[Float64]) -> tuple[Float64, list[float]]:
    """True poses (N, 4, 4), and the ATE of each session in m, NaN if not joined."""
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
    true, ates = compared(result, truth)
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
        "-" if pair.probability is None else f"{probability(pair.probability)}, {pair.links} links",
        ", ".join(c.change.kind for c in result.changes) or "-",
    ]
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
