"""Long recordings: accuracy, loop closure, time per frame and memory over the length of a run.

`building` walks through a simulated building: rooms on both sides of a corridor, each with a door,
furniture and distinct walls. The walk follows the corridor, enters every room and leaves it by the
same door; at the end it returns along the corridor and visits some rooms again. Images are small,
and the simulated camera has noise only: the subject is the length. For runs of the first N frames
it prints the error (ATE), the revisits, wall time per frame of the whole command (including
start-up and output), and peak memory.

A revisit is a segment of the walk in which the camera returns to within 0.5 m and 20 degrees of an
earlier pose after at least 20 s elsewhere. It is closed if the estimated relative pose of the
closest pair is accurate to 5 cm and 1 degree.

`there-and-back` plays a recording forwards and backwards until it has the required length, with
only every N-th row and column of its depth images with `--thin N`. Its error is the rms distance of
the positions at each image from that where the image was first played.

    python benchmarks/hours.py building [--rooms 20] [--frames 20000] [--counts 1000 20000]
    python benchmarks/hours.py there-and-back RECORDING [--thin 2] [--counts 1000 5000 20000]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import PchipInterpolator

from tofuse.apps.results.run_json import frames_in_main_model
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.geometry.rays import homogeneous
from tofuse.engine.quality.trajectory_errors import evaluate_trajectory
from tofuse.formats.export.conversion import convert
from tofuse.formats.poses.trajectory import read_tum
from tofuse.formats.recordings.native import RecordingWriter
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.scenes import furniture, household
from tofuse.lab.scenes.composition import Assembly, placed
from tofuse.lab.world import mesh as meshes
from tofuse.lab.world import paths
from tofuse.lab.world.scene import Scene
from tofuse.lab.world.texture import Material

OUT = Path(__file__).parent / "out"
COLUMNS, ROWS = 128, 96
FOCAL = 0.65 * COLUMNS  # 75 by 60 degrees
RATE_HZ = 30.0
# Dimensions, m: half width and depth of a room, half width of the corridor, walls, doors, ceiling.
HALF, CORRIDOR, WALL, HEIGHT = 2.2, 0.9, 0.12, 2.5
DOOR, DOOR_TOP, EYE = 0.45, 2.05, 1.3
PITCH = 2 * HALF + WALL  # between rooms along the corridor
# A revisit: distance in m and rad, and seconds elsewhere before; thresholds for closed.
NEAR_M, NEAR_RAD, AWAY_S = 0.5, np.radians(20), 20.0
CLOSED_M, CLOSED_RAD = 0.05, np.radians(1)

PATTERNS = ("noise", "print", "wood", "tiles", "speckle")


def place_of(room: int) -> tuple[float, float]:
    """Position of a room along the corridor, and its side (1 or -1)."""
    return PITCH * (room // 2), 1.0 if room % 2 == 0 else -1.0


def T_room(room: int) -> Float64:
    """(4, 4) pose of a room's frame: origin on the middle of its floor, its door in the -y wall."""
    along, side = place_of(room)
    T = paths.rotation([0, 0, 0 if side > 0 else np.pi])
    T[:3, 3] = along, side * (CORRIDOR + WALL + HALF), 0
    return T


def material(rng: np.random.Generator, name: str) -> Material:
    """Unique material of a wall or floor."""
    size = rng.uniform(0.25, 0.9)
    return Material(
        name,
        rng.uniform(0.3, 0.75),
        rng.uniform(0.1, 0.3),
        PATTERNS[rng.integers(len(PATTERNS))],
        (size, size, size),
    )


def building(rooms: int, seed: int) -> Scene:
    """Lay out the building."""
    assembly = Assembly([])
    for room in range(rooms):
        _room(assembly, room, np.random.default_rng([seed, room]))
    _corridor(assembly, rooms, np.random.default_rng([seed, rooms]))
    return Scene("building", assembly.materials, assembly.mesh(), seed=seed)


def _wall_with_door(start: float, stop: float, y: float, door: float) -> list[meshes.Mesh]:
    """A wall along x at y with a door about x = door."""
    up = np.array([0, 0, HEIGHT])
    parts = []
    for a, b in ((start, door - DOOR), (door + DOOR, stop)):
        parts.append(meshes.quad((a, y, 0), (b - a, 0, 0), up))
    above = (0, 0, HEIGHT - DOOR_TOP)
    parts.append(meshes.quad((door - DOOR, y, DOOR_TOP), (2 * DOOR, 0, 0), above))
    return parts


def _room(assembly: Assembly, room: int, rng: np.random.Generator) -> None:
    T, a, h = T_room(room), HALF, HEIGHT
    quad = meshes.quad
    walls = [material(rng, f"wall {room} {k}") for k in range(4)]
    sides = [
        [quad((-a, -a, 0), (0, 2 * a, 0), (0, 0, h))],
        [quad((a, -a, 0), (0, 2 * a, 0), (0, 0, h))],
        [quad((-a, a, 0), (2 * a, 0, 0), (0, 0, h))],
        _wall_with_door(-a, a, -a, 0.0),
    ]
    lining = [quad((s * DOOR, -a - WALL, 0), (0, WALL, 0), (0, 0, DOOR_TOP)) for s in (-1, 1)]
    lining.append(quad((-DOOR, -a - WALL, DOOR_TOP), (2 * DOOR, 0, 0), (0, WALL, 0)))
    for wall, parts in zip(walls, sides, strict=True):
        assembly.at(T).add(wall, *parts)
    assembly.at(T).add(walls[3], *lining)
    floor = quad((-a, -a - WALL, 0), (2 * a, 0, 0), (0, 2 * a + WALL, 0))
    assembly.at(T).add(material(rng, f"floor {room}"), floor)
    assembly.at(T).add(material(rng, f"ceiling {room}"), floor.translated(0, 0, h))
    fabric = material(rng, f"fabric {room}")
    corners = [(-1.65, -1.6), (1.65, -1.6), (1.65, 1.6), (-1.65, 1.6)]
    order = rng.permutation(4)

    def near(k: int, yaw: float) -> Float64:
        x, y = np.array(corners[order[k]]) + rng.uniform(-0.1, 0.1, 2)
        return T @ placed((float(x), float(y)), yaw + rng.uniform(-0.2, 0.2))

    furniture.chair(assembly.at(near(0, rng.uniform(0, 6))), fabric)
    furniture.plant(assembly.at(near(1, 0.0)), rng)
    x = rng.uniform(-1.2, 1.2)
    if rng.random() < 0.5:
        household.sofa(assembly.at(T @ placed((float(x) / 2, a - 0.5), -np.pi / 2)), fabric)
    else:
        household.shelf(assembly.at(T @ placed((float(x), a - 0.01), -np.pi / 2)), rng)
    size = tuple(rng.uniform((0.4, 0.6, 0.7), (0.5, 1.2, 1.9)).tolist())
    side, turn = (-a, 0.0) if rng.random() < 0.5 else (a, np.pi)
    at = T @ placed((side, float(rng.uniform(-0.8, 0.8))), turn)
    household.cabinet(assembly.at(at), household.OAK, size)


def _corridor(assembly: Assembly, rooms: int, rng: np.random.Generator) -> None:
    """Walls between the doors, floor, ceiling, both ends, boxes and pictures."""
    last = PITCH * ((rooms + 1) // 2 - 1)
    low, high = -HALF - WALL, last + HALF + WALL
    quad, length = meshes.quad, high - low
    span = (length, 0, 0)
    floor = quad((low, -CORRIDOR, 0), span, (0, 2 * CORRIDOR, 0))
    assembly.add(material(rng, "corridor floor"), floor)
    assembly.add(material(rng, "corridor ceiling"), floor.translated(0, 0, HEIGHT))
    for x in (low, high):
        end = quad((x, -CORRIDOR, 0), (0, 2 * CORRIDOR, 0), (0, 0, HEIGHT))
        assembly.add(material(rng, f"end {x:.0f}"), end)
    for k in range((rooms + 1) // 2):
        for s, side in enumerate((1.0, -1.0)):
            start, stop = PITCH * k - PITCH / 2, PITCH * k + PITCH / 2
            start, stop = (low if k == 0 else start), (high if PITCH * k == last else stop)
            wall = material(rng, f"corridor {k} {side}")
            if 2 * k + s < rooms:
                parts = _wall_with_door(start, stop, side * CORRIDOR, PITCH * k)
            else:
                up = (0, 0, HEIGHT)
                parts = [quad((start, side * CORRIDOR, 0), (stop - start, 0, 0), up)]
            assembly.add(wall, *parts)
            # Pictures, and boxes along the walls.
            x = PITCH * k + side * rng.uniform(0.9, 1.6)
            w, top = rng.uniform(0.3, 0.7), rng.uniform(1.5, 2.0)
            y = side * CORRIDOR
            picture = (x, min(y, y - 0.03 * side), top - w), (x + w, max(y, y - 0.03 * side), top)
            assembly.add(material(rng, f"picture {k} {side}"), meshes.box_between(*picture))
            x = PITCH * k - side * rng.uniform(1.0, 1.7)
            d, top = rng.uniform(0.12, 0.3), rng.uniform(0.4, 1.1)
            box = (x, min(y, y - d * side), 0), (x + 0.4, max(y, y - d * side), top)
            assembly.add(material(rng, f"box {k} {side}"), meshes.box_between(*box))


def waypoints(rooms: int, seed: int) -> Float64:
    """(N, 3) x, y and yaw of the walk."""
    rng = np.random.default_rng([seed, 1000])
    out: list[tuple[float, float, float]] = []
    yaw = 0.0

    def go(x: float, y: float, towards: float) -> None:
        nonlocal yaw
        # The shorter way round.
        yaw += (towards - yaw + np.pi) % (2 * np.pi) - np.pi
        out.append((x + rng.normal(0, 0.03), y + rng.normal(0, 0.03), yaw + rng.normal(0, 0.05)))

    def visit(room: int, heading: float) -> None:
        """Enter from the corridor, walk a circle, and leave in the direction of `heading`."""
        along, side = place_of(room)
        inward = side * np.pi / 2
        centre = side * (CORRIDOR + WALL + HALF)
        go(along - 0.2 * np.cos(heading), 0.0, inward - side * np.cos(heading) * 0.9)
        go(along, side * (CORRIDOR - 0.25), inward)
        go(along, side * (CORRIDOR + WALL + 0.4), inward)
        turn = 1.0 if rng.random() < 0.5 else -1.0
        for k in range(1, 9):
            # A small circle, looking across the room, from the door round to it.
            angle = inward + np.pi + turn * 2 * np.pi * k / 8
            r = 0.55
            go(along + r * np.cos(angle), centre + r * np.sin(angle), angle + np.pi)
        go(along, side * (CORRIDOR + WALL + 0.4), inward + np.pi)
        go(along, side * (CORRIDOR - 0.25), inward + np.pi)
        go(along + 0.2 * np.cos(heading), 0.0, heading + side * np.cos(heading) * 0.5)

    last = PITCH * ((rooms + 1) // 2 - 1)
    go(-1.6, 0.0, 0.0)
    for room in range(rooms):
        visit(room, 0.0)
        if room % 2 == 1:
            go(PITCH * (room // 2) + PITCH / 2, 0.0, 0.0)
    go(last + 1.2, 0.0, np.pi / 2)
    for room in range(rooms - 1, -1, -1):
        along, _ = place_of(room)
        if room % 2 == 1:
            go(along + PITCH / 2, 0.0, np.pi)
        if room % 3 == 0:
            visit(room, np.pi)
    go(-1.4, 0.0, np.pi)
    go(-1.5, 0.0, 3 * np.pi / 2)
    go(-1.6, 0.0, 2 * np.pi)
    return np.array(out)


def walk(rooms: int, frames: int, seed: int) -> Float64:
    """(frames, 4, 4) poses of the camera in the building."""
    at = waypoints(rooms, seed)
    effort = np.linalg.norm(np.diff(at[:, :2], axis=0), axis=1) + 0.7 * np.abs(np.diff(at[:, 2]))
    way = np.concatenate([[0.0], np.cumsum(effort)])
    smooth = PchipInterpolator(way, at)(np.linspace(0, way[-1], frames))
    t = np.arange(frames) / RATE_HZ
    bob, sway = 0.01 * np.sin(2 * np.pi * 1.7 * t), 0.01 * np.sin(2 * np.pi * 0.85 * t + 1)
    tilt = -0.12 + 0.05 * np.sin(0.7 * t) + 0.005 * np.sin(2 * np.pi * 1.7 * t + 1)
    poses = []
    for (x, y, yaw), up, roll, pitch in zip(smooth, bob, sway, tilt, strict=True):
        p = np.array([x, y, EYE + up])
        ahead = np.array([np.cos(yaw), np.sin(yaw), np.tan(pitch)])
        poses.append(paths.look_at(p, p + ahead) @ paths.rotation([0, 0, roll]))
    return np.stack(poses)


def image_of(
    scene: Scene, camera: Pinhole, T: Float64, k: int, rng: np.random.Generator
) -> RangeFrame:
    """Image `k` of a camera with noise, at a pose (4, 4)."""
    rays = homogeneous(camera.rays().reshape(-1, 2))
    lengths = np.linalg.norm(rays, axis=1)
    directions = rays / lengths[:, None] @ T[:3, :3].T
    hits = scene.cast(T[:3, 3], directions)
    distance = hits.distance.astype(float)
    cosine = np.abs(np.einsum("ni,ni->n", hits.normal, directions))
    amplitude = 3e4 * hits.albedo * cosine / distance**2
    amplitude = amplitude + (0.5 + 0.01 * amplitude) * rng.standard_normal(len(amplitude))
    # Noise of a phase camera grows as the signal falls.
    sigma = 0.03 / np.sqrt(np.maximum(amplitude, 1.0))
    measured = distance + sigma * rng.standard_normal(len(amplitude))
    seen = np.isfinite(distance) & (distance < 9.0) & (amplitude > 20)
    z, amplitude = (
        np.where(seen, values, 0).reshape(camera.height, camera.width).astype(np.float32)
        for values in (measured / lengths, amplitude)
    )
    return RangeFrame(k, k / RATE_HZ, camera, z, amplitude_image=amplitude)


def record(rooms: int, frames: int, count: int, seed: int) -> Path:
    """Write the first images of the walk, unless they exist."""
    folder = OUT / f"building-{rooms}-{frames}-{count}-{seed}"
    if (folder / "camera.json").exists():
        return folder
    scene, poses = building(rooms, seed), walk(rooms, frames, seed)[:count]
    print(f"{scene.triangles} triangles; rendering {count} images", flush=True)
    camera = Pinhole(COLUMNS, ROWS, FOCAL, FOCAL, COLUMNS / 2 - 0.5, ROWS / 2 - 0.5)
    writer = RecordingWriter(folder, camera, frame_rate_hz=RATE_HZ, amplitude_kind="raw")
    for k, T in enumerate(poses):
        writer.add(image_of(scene, camera, T, k, np.random.default_rng([seed, 2000, k])))
    writer.finish(groundtruth=se3.inverse(poses[0]) @ poses)
    return folder


@dataclass(frozen=True)
class Visit:
    """A revisit: an earlier frame, and the closest later one."""

    i: int
    j: int


def revisits(poses: Float64) -> list[Visit]:
    """Revisits of the walk, one per segment."""
    away = round(AWAY_S * RATE_HZ)
    found: list[tuple[int, int, float]] = []
    some = np.arange(0, len(poses), 10)
    for j in some:
        earlier = some[some < j - away]
        if not len(earlier):
            continue
        between = se3.inverse(poses[j]) @ poses[earlier]
        far = np.linalg.norm(between[:, :3, 3], axis=1) / NEAR_M
        turned = np.asarray(se3.angle(between)) / NEAR_RAD
        gap = np.maximum(far, turned)
        # Only if the camera was elsewhere in between.
        k = int(np.argmin(gap))
        if gap[k] <= 1 and _was_away(poses, int(earlier[k]), int(j)):
            found.append((int(earlier[k]), int(j), float(gap[k])))
    visits: list[Visit] = []
    best = np.inf
    for n, (i, j, gap) in enumerate(found):
        same = n > 0 and j - found[n - 1][1] <= RATE_HZ and abs(i - found[n - 1][0]) <= 3 * RATE_HZ
        if not same:
            visits.append(Visit(i, j))
            best = gap
        elif gap < best:
            visits[-1], best = Visit(i, j), gap
    return visits


def _was_away(poses: Float64, i: int, j: int) -> bool:
    """Whether the camera was elsewhere for long enough between two frames."""
    between = se3.inverse(poses[i]) @ poses[i + 1 : j : 5]
    elsewhere = np.linalg.norm(between[:, :3, 3], axis=1) > 2 * NEAR_M
    elsewhere |= np.asarray(se3.angle(between)) > 3 * NEAR_RAD
    return bool(5 * elsewhere.sum() >= AWAY_S * RATE_HZ)


def closed(visit: Visit, truth: Float64, found: dict[int, Float64]) -> bool:
    """Whether the estimated relative pose of a revisit is accurate."""
    if visit.i not in found or visit.j not in found:
        return False
    true = se3.inverse(truth[visit.i]) @ truth[visit.j]
    error = se3.inverse(true) @ se3.inverse(found[visit.i]) @ found[visit.j]
    far, turned = float(np.linalg.norm(error[:3, 3])), float(se3.angle(error))
    return far <= CLOSED_M and turned <= CLOSED_RAD


@dataclass(frozen=True)
class Usage:
    """Wall and CPU time of a run, peak memory in bytes, and exit status."""

    seconds: float
    cpu_s: float
    peak: float
    status: int


def run(folder: Path, out: Path, frames: int, more: list[str]) -> Usage:
    """Run on the first frames, in a separate process."""
    command = [sys.executable, "-m", "tofuse", "run", str(folder), "--out", str(out)]
    command += ["--overwrite", "--end", str(frames), *more]
    start = time.perf_counter()
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    seconds, cpu = time.perf_counter() - start, usage.ru_utime + usage.ru_stime
    return Usage(seconds, cpu, 1024.0 * usage.ru_maxrss, child.returncode)


def rows(folder: Path, counts: list[int], more: list[str], *, truth: bool) -> Iterator[str]:
    """One line for each length."""
    yield (
        f"{'frames':>7}{'metres':>8}{'in main':>8}{'error, cm':>11}{'revisits':>10}{'closed':>8}"
        f"{'ms/frame':>12}{'CPU ms':>8}{'CPU ratio':>14}{'peak, MB':>10}  verdict"
    )
    first = np.nan
    for count in counts:
        out = OUT / f"hours-{folder.name}-{count}"
        used = run(folder, out, count, more)
        if used.status not in (0, 3):
            yield f"{count:>7}  failed with status {used.status}"
            continue
        each, cpu = 1e3 * used.seconds / count, 1e3 * used.cpu_s / count
        first = cpu if np.isnan(first) else first
        about = json.loads((out / "run.json").read_text())
        posed = len(frames_in_main_model(about))
        figures = [np.nan] * 4
        if truth:
            times, estimate = read_tum(out / "trajectory.txt")
            true_times, poses = (part[:count] for part in read_tum(folder / "groundtruth.txt"))
            score = evaluate_trajectory(times, estimate, true_times, poses)
            known = dict(zip(np.round(times * RATE_HZ).astype(int).tolist(), estimate, strict=True))
            visits = revisits(poses)
            metres = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
            figures = [metres, 100 * score.ate_rms_m, len(visits)]
            figures.append(sum(closed(visit, poses, known) for visit in visits))
        else:
            figures[1] = 100 * distance_of_repeats(folder, out)
        yield (
            f"{count:>7}{figures[0]:>8.0f}{posed:>8}{figures[1]:>11.2f}{figures[2]:>10.0f}{figures[3]:>8.0f}"
            f"{each:>12.1f}{cpu:>8.1f}{cpu / first:>14.2f}{used.peak / 1e6:>10.0f}"
            f"  {about['verdict']}"
        )
        stages = {name: 1e3 * s / count for name, s in about["seconds"].items()}
        yield "        ms: " + ", ".join(f"{name} {ms:.1f}" for name, ms in stages.items())


def distance_of_repeats(folder: Path, out: Path) -> float:
    """Rms distance in m of positions at repeated images from those at their first occurrence."""
    images = [path.resolve().name for path in sorted((folder / "depth").iterdir())]
    times, poses = read_tum(out / "trajectory.txt")
    first: dict[str, Float64] = {}
    far = []
    for k, T in zip(np.round(times * RATE_HZ).astype(int), poses, strict=True):
        here = T[:3, 3]
        if images[k] in first:
            far.append(np.linalg.norm(here - first[images[k]]))
        else:
            first[images[k]] = here
    return float(np.sqrt(np.mean(np.square(far)))) if far else np.nan


def there_and_back(recording: Path, count: int, folder: Path | None = None) -> Path:
    """A native folder of links to images: the recording forwards, backwards, and so on."""
    folder = folder or OUT / f"back-{recording.name}-{count}"
    if (folder / "camera.json").exists():
        return folder
    if not (recording / "camera.json").exists():
        native = OUT / f"native-{recording.name}"
        if not native.exists():
            convert(open_recording(recording), native)
        recording = native
    channels = [
        c for c in ("depth", "amplitude", "confidence", "color") if (recording / c).is_dir()
    ]
    files = {c: sorted((recording / c).iterdir()) for c in channels}
    n = len(files["depth"])
    period = [*range(n), *range(n - 2, 0, -1)]
    for channel in channels:
        (folder / channel).mkdir(parents=True, exist_ok=True)
        for k in range(count):
            source = files[channel][period[k % len(period)]]
            (folder / channel / f"{k:06d}{source.suffix}").symlink_to(source.resolve())
    for name in ("rays.npy", "correction.npz", "noise.json"):
        if (recording / name).exists():
            (folder / name).symlink_to((recording / name).resolve())
    about = json.loads((recording / "camera.json").read_text())
    (folder / "camera.json").write_text(json.dumps({**about, "frame_rate_hz": RATE_HZ}))
    return folder


def thinned(recording: Path, every: int) -> Path:
    """A native folder with every n-th row and column of the depth images of a recording."""
    folder = OUT / f"every-{every}-{recording.name}"
    if folder.exists():
        return folder
    source = open_recording(recording)
    camera = source[0].camera
    if not isinstance(camera, Pinhole):
        raise SystemExit(f"{recording}: --thin needs a pinhole camera")
    size = -(-camera.width // every), -(-camera.height // every)
    lens = (value / every for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    small = Pinhole(*size, *lens)
    frames = [
        RangeFrame(
            k, f.timestamp, small, np.ascontiguousarray(f.depth[::every, ::every]), f.depth_kind
        )
        for k, f in enumerate(source)
    ]
    convert(Recording.of(ArraySource(frames), recording, "thinned"), folder)
    return folder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    kinds = parser.add_subparsers(dest="kind", required=True)
    made = kinds.add_parser("building")
    made.add_argument("--rooms", type=int, default=20)
    made.add_argument("--frames", type=int, default=20_000, help="length of the whole walk")
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--counts", type=int, nargs="+", default=[1000, 20_000])
    made.add_argument("--only-record", action="store_true")
    played = kinds.add_parser("there-and-back")
    played.add_argument("recording", type=Path, help="a native folder")
    played.add_argument("--thin", type=int, default=1, help="use every n-th row and column")
    played.add_argument("--counts", type=int, nargs="+", default=[1000, 5000, 20_000])
    for kind in (made, played):
        kind.add_argument("--options", default="", help="more options of `tofuse run`")
    arguments = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    more = arguments.options.split()
    if arguments.kind == "building":
        folder = record(arguments.rooms, arguments.frames, max(arguments.counts), arguments.seed)
        if arguments.only_record:
            return
        lines = rows(folder, arguments.counts, more, truth=True)
    else:
        recording = arguments.recording
        if arguments.thin > 1:
            recording = thinned(recording, arguments.thin)
        folder = there_and_back(recording, max(arguments.counts))
        lines = rows(folder, arguments.counts, more, truth=False)
    for line in lines:
        print(line, flush=True)


if __name__ == "__main__":
    main()
