"""Mirrors in simulated rooms: found, with which area, and at which cost; and none where none hangs.

Usage: `python benchmarks/mirrors.py [--cases N] [--first SEED] [RECORDING...]`. With recordings:
what is found in them. Else each of N recordings with a mirror is paired with the same one where
there is the wall alone, and N other scenes have none. Prints a row per case as Markdown, then the
totals.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.stats import wilcoxon

import tofuse
import unusual
from tofuse.apps.mirrors import find_mirrors
from tofuse.apps.mirrors.openings import Plane
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
from tofuse.engine.geometry.rays import homogeneous, unit_rays
from tofuse.engine.results import Reconstruction
from tofuse.lab.simulation.mirrors import Mirror, hang_mirror
from tofuse.lab.world import scene as scenes
from unusual import UNUSUAL, Unusual, known

CAMERAS = ("ifm-o3r", "kinect2", "azure-nfov", "sr4000")
# Builder and motion as functions of the seed, frames, and their rate.
SCENES = {
    "room": (known("room"), unusual._in_room(unusual.calm), 72, 6.0),
    "empty-room": (known("empty-room"), unusual._in_room(unusual.calm), 72, 6.0),
    "flat": (known("flat"), unusual._elsewhere_in_flat, 60, 10.0),
    "flat-alike": (known("flat-alike"), unusual._elsewhere_in_flat, 60, 10.0),
    "corridor": (
        known("corridor"),
        lambda seed: scenes.build("corridor", seed=seed)[1].camera_path,
        60,
        30.0,
    ),
    "aisle": (
        UNUSUAL["aisle of identical shelves"].scene,
        UNUSUAL["aisle of identical shelves"].path,
        72,
        8.0,
    ),
}
# Fewest patches, see `shown`, with which a mirror can be told from a room: 0.6 m^2.
DECIDABLE = 15
POSITIVE, NEGATIVE = (
    ("room", "empty-room", "room", "flat"),
    ("flat-alike", "aisle", "flat", "corridor"),
)


def cases(first: int, count: int, names: tuple[str, ...]) -> list[tuple[str, str, int]]:
    """Return scene, camera and seed of `count` recordings."""
    return [
        (names[k % len(names)], CAMERAS[k // len(names) % len(CAMERAS)], first + k)
        for k in range(count)
    ]


def size_of(seed: int) -> tuple[float, float]:
    """Draw width and height: 0.3 to 2 m."""
    rng = np.random.default_rng([seed, 31])
    return float(np.exp(rng.uniform(np.log(0.3), np.log(2)))), float(rng.uniform(0.4, 1.6))


@dataclass(frozen=True, eq=False)
class Case:
    """A simulated recording of 112 x 84 pixels, with its mirror, if there is one."""

    one: Unusual
    sequence: scenes.Sequence
    wall: scenes.Scene
    mirror: Mirror | None
    seed: int

    @property
    def T_world_room(self) -> np.ndarray:
        """(4, 4) the room's frame in that of the first camera."""
        return self.sequence.T_world_truth()

    def recording(self) -> tofuse.Recording:
        """Simulate it."""
        return unusual.record(self.one, self.seed)


def planned(name: str, camera: str, seed: int, *, mirror: bool) -> Case:
    """Plan a recording; without the mirror it is the same one with the bare wall."""
    build, path, frames, rate = SCENES[name]
    model = unusual.pinhole(camera, 112, 84, 60)
    one = Unusual(build, path, model, frames, rate)
    wall, hung = one.scene(seed), None
    scene = wall
    sequence = scenes.Sequence(frames, 1, rate, one.path(seed))
    if mirror:
        width, height = size_of(seed)
        for smaller in (1.0, 0.8, 0.6, 0.45, 0.3):
            try:
                size = (smaller * width, smaller * height)
                times = np.arange(frames) / rate
                scene, hung = hang_mirror(wall, sequence, model, size, times=times, seed=seed)
                break
            except InputError:
                continue
    return Case(replace(one, scene=lambda _: scene), sequence, wall, hung, seed)


def shown(case: Case, recording: tofuse.Recording) -> tuple[int, float]:
    """Return what a mirror shows that could tell it from a room, and the area seen, m^2.

    The first is the number of patches of 0.2 m that the camera sees in the mirror, with a return
    and within its ambiguity range, in three frames or more, and directly as well, at any time; not
    counted are surfaces at right angles to the mirror (floor, ceiling, side walls): each is in the
    plane of its own reflection. It is found from the true scene, not from the reconstruction.
    """
    mirror, camera = case.mirror, case.one.camera.camera
    assert mirror is not None
    n = mirror.normal
    poses = [case.sequence.T_room_camera(k / case.one.rate_hz) for k in range(case.one.frames)]
    rays = unit_rays(camera.rays().reshape(-1, 2))
    hits, points, frames = [], [], []
    for k, T in enumerate(poses):
        d = rays @ T[:3, :3].T
        toward = np.where(d @ n < -1e-3, d @ n, np.nan)
        at = ((mirror.centre - T[:3, 3]) @ n) / toward
        p = T[:3, 3] + at[:, None] * d
        inside = np.abs((p - mirror.centre) @ mirror.half_edges.T) < (mirror.half_edges**2).sum(1)
        rows = np.flatnonzero(inside.all(1) & (at > 0) & recording[k].valid.reshape(-1))
        rows = rows[case.wall.cast(T[:3, 3], d[rows]).distance > at[rows] - 0.05]
        onward = d[rows] - 2 * (d[rows] @ n)[:, None] * n
        second = case.wall.cast(p[rows] + 1e-3 * n, onward)
        far = second.distance.astype(float)
        tells = np.abs(second.normal @ n) > 0.3
        tells &= at[rows] + far < case.one.camera.ambiguity_m
        hits.append((p[rows] - mirror.centre) @ mirror.half_edges.T)
        points.append((p[rows] + far[:, None] * onward)[tells])
        frames.append(np.full(int(tells.sum()), k))
    flat = np.concatenate(hits) / np.linalg.norm(mirror.half_edges, axis=1)
    area = cv2.contourArea(cv2.convexHull(flat.astype(np.float32))) if len(flat) else 0.0
    cells = np.floor(np.concatenate(points) / 0.2).astype(int)
    in_frame = np.unique(np.c_[cells, np.concatenate(frames)], axis=0)
    patches, times = np.unique(in_frame[:, :3], axis=0, return_counts=True)
    patches = patches[times >= 3]
    return sum(_seen_directly(case, poses, np.concatenate(points), cells, patches)), area


def _seen_directly(
    case: Case, poses: list[np.ndarray], points: np.ndarray, cells: np.ndarray, patches: np.ndarray
) -> list[bool]:
    """Whether each patch has a point in view of one of the poses."""
    out = []
    camera = case.one.camera.camera
    for patch in patches:
        p = points[(cells == patch).all(1)][:1]
        seen = False
        for T in poses:
            toward = p - T[:3, 3]
            length = float(np.linalg.norm(toward))
            in_camera = toward @ T[:3, :3]
            pixel = camera.project(in_camera)[0]
            if (
                in_camera[0, 2] > 0.05
                and length < case.one.camera.ambiguity_m
                and (pixel >= 0).all()
                and (pixel < (camera.width, camera.height)).all()
                and case.wall.cast(T[:3, 3], toward / length).distance[0] > length - 0.05
            ):
                seen = True
                break
        out.append(seen)
    return out


def weigh(case: Case, recording: tofuse.Recording, result: Reconstruction) -> dict[str, float]:
    """Look for mirrors in one reconstruction, and compare with the truth."""
    found = find_mirrors(recording, result)
    mirrors = found.mirrors
    ate = result.evaluate().error.ate_rms_m
    row = {"false": len(mirrors), "ate": ate}
    if case.mirror is None:
        return row
    T, hung = case.T_world_room, case.mirror
    centre = se3.transform(T, hung.centre[None])[0]
    right = [m for m in mirrors if np.linalg.norm(m.corners.mean(0) - centre) < _reach(hung)]
    right = [m for m in right if m.normal @ T[:3, :3] @ hung.normal > 0.95]
    patches, area = shown(case, recording)
    row |= {"area": area, "patches": patches, "found": len(right) > 0}
    row["false"] = len(mirrors) - len(right)
    if right:
        best = max(right, key=lambda m: m.area_m2)
        world = se3.transform(se3.inverse(T), found.cloud.points.astype(float))
        row |= {"measured": best.area_m2, "left": _left_behind(world, hung)}
    return row


def _reach(mirror: Mirror) -> float:
    return 0.6 * float(np.linalg.norm(mirror.half_edges, axis=1).max()) + 0.1


def _left_behind(points: np.ndarray, mirror: Mirror) -> int:
    """Count points more than 0.2 m behind the mirror itself."""
    p = points - mirror.centre
    inside = np.abs(p @ mirror.half_edges.T) < (mirror.half_edges**2).sum(1)
    return int((inside.all(1) & (p @ mirror.normal < -0.2)).sum())


def draw(before: Reconstruction, after: Reconstruction, T: np.ndarray, path: str) -> None:
    """Draw both models from above, between floor and ceiling, with the mirrors found."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharex=True, sharey=True)
    for axis, result, title in zip(axes, (before, after), ("without", "with"), strict=True):
        p = se3.transform(se3.inverse(T), result.cloud.points.astype(float))
        p = p[(p[:, 2] > 0.3) & (p[:, 2] < 2.2)]
        axis.plot(p[:, 0], p[:, 1], ",", color="#456", alpha=0.6)
        for m in after.mirrors:
            line = se3.transform(se3.inverse(T), m.corners)[:, :2]
            axis.plot(*line.T, color="#e66100", linewidth=2)
        axis.set(aspect="equal", title=f"{title} --mirrors", xlabel="x, m", ylabel="y, m")
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def reconstructed(case: Case) -> tuple[tofuse.Recording, Reconstruction]:
    """Simulate a recording and reconstruct it."""
    recording = case.recording()
    return recording, tofuse.reconstruct(recording, threads=1)


def run(pairs: list[tuple[str, str, int]], without: list[tuple[str, str, int]]) -> None:
    """Print a row per case: with a mirror and with the wall alone; then scenes without one."""
    print(
        "| scene | camera | seed | area seen, m² | patches | found, m² | left | false | "
        "false, wall alone | ATE, mm | wall alone |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    rows, walls, others = [], [], []
    for name, camera, seed in pairs:
        case = planned(name, camera, seed, mirror=True)
        if case.mirror is None:
            continue
        row = weigh(case, *reconstructed(case))
        case = planned(name, camera, seed, mirror=False)
        wall = weigh(case, *reconstructed(case))
        rows.append(row)
        walls.append(wall)
        print(
            f"| {name} | {camera} | {seed} | {row['area']:.2f} | {row['patches']} | "
            f"{row.get('measured', 0):.2f} | {row.get('left', 0)} | {row['false']} | "
            f"{wall['false']} | {1e3 * row['ate']:.1f} | {1e3 * wall['ate']:.1f} |",
            flush=True,
        )
    for name, camera, seed in without:
        case = planned(name, camera, seed, mirror=False)
        others.append(weigh(case, *reconstructed(case)))
        print(
            f"| {name} | {camera} | {seed} | – | – | – | – | {others[-1]['false']} | – | "
            f"{1e3 * others[-1]['ate']:.1f} | – |",
            flush=True,
        )
    decidable = [r for r in rows if r["patches"] >= DECIDABLE]
    ratios = np.array([r["measured"] / r["area"] for r in rows if r["found"]])
    ate, plain = (np.array([r["ate"] for r in which]) for which in (rows, walls))
    print(
        f"\nFound: {sum(r['found'] for r in decidable)} of {len(decidable)} that can be decided, "
        f"{sum(r['found'] for r in rows) - sum(r['found'] for r in decidable)} of "
        f"{len(rows) - len(decidable)} others. "
        f"Area: within 10 % in {int((np.abs(ratios - 1) < 0.1).sum())} of {len(ratios)}, "
        f"ratio {ratios.min():.2f} to {ratios.max():.2f}. "
        f"False: {sum(r['false'] for r in rows)} beside {len(rows)} mirrors, "
        f"{sum(r['false'] for r in walls)} in {len(walls)} of their walls alone, "
        f"{sum(r['false'] for r in others)} in {len(others)} scenes without. "
        f"ATE: {1e3 * np.median(ate):.1f} mm with the mirror, {1e3 * np.median(plain):.1f} mm "
        f"with the wall alone (medians), larger in {int((ate > plain).sum())} of {len(ate)} pairs, "
        f"ratio {np.median(ate / plain):.2f} (median), "
        f"p = {wilcoxon(ate, plain, alternative='greater').pvalue:.2f} (signed ranks, one-sided)."
    )


def floor(paths: list[str]) -> None:
    """Print whether a shiny floor's image is in the first frames of stills that look along it.

    The floor is the plane through most points below the camera. Of the pixels that meet it beyond
    2.5 m where it would show a point above it: how far beyond the floor they measure, as a share of
    the way to the reflected point, and how both correlate.
    """
    for path in paths:
        recording = tofuse.open(path)
        frame = recording[0]
        depth = np.median([recording[k].z for k in range(len(recording))], axis=0)
        rays = homogeneous(frame.camera.rays())
        points = depth[..., None] * rays
        valid = frame.valid & (depth > 0.3)
        lengths = np.linalg.norm(rays, axis=-1)
        rng = np.random.default_rng(0)
        flat = points[valid]
        best, normal, offset = 0, np.zeros(3), 0.0
        for _ in range(500):
            a, b, c = flat[rng.integers(len(flat), size=3)]
            n = np.cross(b - a, c - a)
            n *= -np.sign(n[1]) / max(np.linalg.norm(n), 1e-12)
            votes = int((np.abs(flat @ n - n @ a) < 0.03).sum())
            if n[1] < -0.9 and n @ a < 0 and votes > best:
                best, normal, offset = votes, n, float(n @ a)
        below = points @ normal - offset < -0.1
        print(f"{path}: {int((below & valid).sum())} of {int(valid.sum())} points > 0.1 m below")
        plane = Plane(normal, offset)
        above = valid & (points @ normal - offset > 0.05)
        images = plane.reflected(points[above])
        pixels = frame.camera.project(images)[:, ::-1].round()
        inside = ((pixels >= 0) & (pixels < depth.shape)).all(1) & (images[:, 2] > 0.3)
        image = np.full(depth.shape, np.inf)
        at = tuple(pixels[inside].astype(int).T)
        np.minimum.at(image, at, np.linalg.norm(images[inside], axis=1))
        reached = plane.crossings(np.zeros(3), (rays / lengths[..., None]).reshape(-1, 3))
        reached = reached.reshape(depth.shape)
        used = valid & np.isfinite(image) & np.isfinite(reached) & (reached > 2.5)
        way = image[used] - reached[used]
        beyond = (depth * lengths)[used] - reached[used]
        rows = (way > 0.05) & (way < 2.5) & (beyond > -0.15)
        way, beyond = way[rows], beyond[rows]
        print(
            f"  {len(way)} pixels with an image: share of the way {np.median(beyond / way):.2f} "
            f"(median), at the image (0.1 m) {(np.abs(beyond - way) < 0.1).mean():.2f}, "
            f"correlation {np.corrcoef(beyond, way)[0, 1]:.2f}"
        )


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="*")
    parser.add_argument("--cases", type=int, default=16)
    parser.add_argument("--first", type=int, default=1000, help="seed of the first one")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--floor", action="store_true", help="of the recordings, see `floor`")
    parser.add_argument("--picture", help="draw one room before and after, and stop")
    arguments = parser.parse_args()
    if arguments.floor:
        floor(arguments.recordings)
        return
    if arguments.recordings:
        for path in arguments.recordings:
            recording = tofuse.open(path)
            recording = recording[:: max(1, len(recording) // arguments.frames)]
            found = find_mirrors(recording, tofuse.reconstruct(recording, threads=1))
            areas = [f"{m.area_m2:.2f} m²" for m in found.mirrors]
            print(f"{path}: {len(recording)} frames: {', '.join(areas) or 'none'}", flush=True)
        return
    if arguments.picture:
        case = planned("empty-room", "ifm-o3r", 1, mirror=True)
        recording, result = reconstructed(case)
        draw(result, find_mirrors(recording, result), case.T_world_room, arguments.picture)
        return
    run(
        cases(arguments.first, arguments.cases, POSITIVE),
        cases(arguments.first + 1000, arguments.cases, NEGATIVE),
    )


if __name__ == "__main__":
    main()
