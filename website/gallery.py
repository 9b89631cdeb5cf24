"""The gallery of the documentation: successful and failed reconstructions.

    python website/gallery.py [DIR]        default: docs/gallery

Simulates the recordings, reconstructs them, draws the results, and writes the page with the
verdicts and errors of these runs. Only the captions are written by hand.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drawing import ESTIMATE, TRUTH, Picture
from tofuse.apps.jobs.run_options import Options
from tofuse.apps.jobs.running import run
from tofuse.apps.results.run_json import frames_in_main_model, read_run_json
from tofuse.engine.geometry import se3
from tofuse.engine.quality.trajectory_errors import evaluate_trajectory
from tofuse.engine.results.verdicts import REASONS
from tofuse.formats.geometry.ply import read_ply
from tofuse.formats.poses.trajectory import read_tum
from tofuse.lab.demo import simulate_to

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Made:
    """A recording to simulate, and the wrong values that are written into its camera.json."""

    scene: str
    texture: bool = True
    camera: str = "sr4000"
    camera_file: dict[str, object] = field(default_factory=dict)

    @property
    def simulated(self) -> tuple[str, bool, str]:
        return self.scene, self.texture, self.camera

    @property
    def truth(self) -> str:
        """Where the folder of the recording has the true poses."""
        return "truth/groundtruth.txt" if self.camera == "phone" else "groundtruth.txt"


@dataclass(frozen=True)
class Exhibit:
    """A picture of the gallery: a recording, the options of its run, and a caption."""

    name: str
    title: str
    made: Made
    options: dict[str, object]
    caption: str


_ROOM = Made("room")
PHONES = (
    Exhibit(
        "phone-flat", "A walk through a flat with a phone", Made("flat", camera="phone"), {},
        "22 m through four rooms and back to the start. Depth is smooth and late, and the phone's"
        " own poses drift; every third frame has colour.",
    ),
    Exhibit(
        "phone-room", "A room by a phone", Made("room", camera="phone"), {},
        "One turn in the middle of the room, which takes 13 s.",
    ),
)  # fmt: skip
RESULTS = (
    Exhibit(
        "room", "A room with chairs", _ROOM, {},
        "An SR4000 turns once in the middle of a room with seven chairs. Walls, doors and chairs"
        " meet again after the turn, so the loop can be closed.",
    ),
    Exhibit(
        "box", "A box on a turntable", Made("box"), {"object": True, "max_depth": 1.8},
        "The box turns, the camera stands still: with `--object` the model is of what moves, and"
        " the camera seems to travel around it.",
    ),
    Exhibit(
        "torso", "A mannequin's torso", Made("torso"), {"object": True, "max_depth": 2.2},
        "Smooth and nearly rotationally symmetric: geometry alone does not constrain the rotation"
        " about its axis, the albedo of its surface does.",
    ),
)  # fmt: skip
FAILURES = (
    Exhibit(
        "uniform", "An empty room without any texture", Made("empty-room", texture=False), {},
        "Plain walls of one albedo do not constrain the motion along them. It is extrapolated in"
        " these directions, and the verdict names the frames. Put objects into the scene, or hang a"
        " poster on the wall.",
    ),
    Exhibit(
        "thesis", "The same furnished room by the method of 2010", _ROOM, {"method": "thesis"},
        "Point-to-point registration of random points slides along flat walls, and closing the loop"
        " spreads that error over good transformations. This is why it is not the default.",
    ),
    Exhibit(
        "steps", "Too few frames", _ROOM, {"every": 16},
        "Every 16th frame of the turn: consecutive frames hardly overlap. Frames that can't be"
        " registered get no pose instead of a wrong one. Move more slowly, or keep more frames.",
    ),
    Exhibit(
        "range", "Depth taken for radial range", Made("room", camera_file={"depth_kind": "range"}),
        {},
        "`depth_kind` in `camera.json` says *range*, but the images contain z: walls are"
        " concave. `tofuse inspect` measures that.",
    ),
    Exhibit(
        "unit", "A depth unit ten times too large",
        Made("room", camera_file={"depth_unit_m": 0.001}), {},
        "The model has the right shape and the wrong size, and is consistent. Only the typical"
        " size of rooms and the ambiguity range of the camera reveal the error.",
    ),
)  # fmt: skip


def draw(result: Path, truth: Path) -> bytes:
    """Picture of a result folder: its surface or points, its path, and the true path."""
    stamps, poses = read_tum(result / "trajectory.txt")
    true_stamps, true_poses = read_tum(truth)
    cloud = read_ply(result / "cloud.ply")
    run_json = read_run_json(result / "run.json")
    up = np.array(run_json["T_up_world"])[1, :3]
    phone = run_json["input"]["format"] == "3dscannerapp"
    shown = np.concatenate([cloud.points.astype(float), poses[:, :3, 3]])
    picture = Picture(shown, up, paint=1.0 if phone else 0.5)
    mesh = result / "mesh.ply"
    surface = read_ply(mesh) if mesh.exists() else None
    if surface is not None and surface.faces is not None and len(surface.faces):
        picture.surface(surface)
    else:
        picture.points(cloud)
    start = int(np.argmin(abs(true_stamps - stamps[0])))
    picture.path(poses[0] @ se3.inverse(true_poses[start]) @ true_poses, TRUTH)
    picture.path(poses, ESTIMATE)
    return picture.png()


def lines(exhibit: Exhibit, result: Path, truth: Path) -> Iterator[str]:
    """Markdown of one exhibit."""
    run_json = read_run_json(result / "run.json")
    posed = len(frames_in_main_model(run_json))
    error = evaluate_trajectory(*read_tum(result / "trajectory.txt"), *read_tum(truth))
    yield f"### {exhibit.title}\n"
    yield f"![{exhibit.title}, seen from above]({exhibit.name}.png)\n"
    yield f"{exhibit.caption}\n"
    measured = (
        f"; error against the ground truth {1000 * error.ate_rms_m:.1f} mm and"
        f" {np.degrees(error.rotation_rms_rad):.2f} degrees"
    )
    yield (
        f"Verdict: **{run_json['verdict']}**; {posed} of {len(run_json['frames'])} frames have a"
        f" pose{measured if posed > 1 else ''}."
    )
    reasons = [r for r in run_json["reasons"] if REASONS[r["code"]][0] != "note"]
    if reasons:
        yield "\nReasons of the verdict:\n"
        yield from (f"- `{r['code']}`: {r['text']}" for r in reasons)
    yield ""


def exhibit_lines(exhibit: Exhibit, recordings: Path, out: Path) -> Iterator[str]:
    recording = recordings / "-".join(map(str, exhibit.made.simulated))
    if not recording.exists():
        made = exhibit.made
        simulate_to(made.scene, recording, texture=made.texture, camera=made.camera)
    result = recordings / f"result-{exhibit.name}"
    with mistaken(recording / "camera.json", exhibit.made.camera_file):
        run([recording], Options(out=result, **exhibit.options))  # type: ignore[arg-type]
    truth = recording / exhibit.made.truth
    (out / f"{exhibit.name}.png").write_bytes(draw(result, truth))
    print(f"drawn: {exhibit.name}", flush=True)
    return lines(exhibit, result, truth)


@contextmanager
def mistaken(camera: Path, values: dict[str, object]) -> Iterator[None]:
    """Replace values of a camera.json for a while."""
    if not values:
        yield
        return
    as_made = camera.read_text()
    stated = json.loads(as_made)
    if any(stated.get(key) == value for key, value in values.items()):
        raise ValueError(f"{camera}: no different from the correct one")
    try:
        camera.write_text(json.dumps({**stated, **values}))
        yield
    finally:
        camera.write_text(as_made)


def main() -> None:
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "gallery"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    page = [
        "# Gallery\n",
        "Drawn by `make gallery` from [simulated recordings](../simulator.md): of a phone with"
        " LiDAR, and of an SR4000 with all its errors (noise, mixed pixels, multipath, wiggling,"
        " scatter, motion). Rooms are seen from above, without the surfaces that show their back."
        " Orange: the estimated path; white: the ground truth.",
        "\n## Phones\n",
    ]
    with tempfile.TemporaryDirectory() as folder:
        for exhibit in PHONES:
            page += exhibit_lines(exhibit, Path(folder), out)
        page.append("## Time-of-flight cameras\n")
        for exhibit in RESULTS:
            page += exhibit_lines(exhibit, Path(folder), out)
        page.append("## Failures, and how they are reported\n")
        for exhibit in FAILURES:
            page += exhibit_lines(exhibit, Path(folder), out)
    (out / "index.md").write_text("\n".join(page), encoding="utf-8")


if __name__ == "__main__":
    main()
