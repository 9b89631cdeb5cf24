"""Mirrors in simulated rooms: found, with which area, and at which cost; and none where none hangs.

Usage: `python benchmarks/mirrors.py [--cases N] [RECORDING...]`. With recordings: what is found in
them. Prints a row per case as Markdown, then the totals.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

import tofuse
import unusual
from tofuse.apps.mirrors import find_mirrors
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
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
    "corridor": (known("corridor"), lambda seed: scenes.build("corridor", seed=seed)[1].camera_path, 60, 30.0),
    "aisle": (UNUSUAL["aisle of identical shelves"].scene, UNUSUAL["aisle of identical shelves"].path, 72, 8.0),
}
POSITIVE, NEGATIVE = ("room", "empty-room", "room", "flat"), ("flat-alike", "aisle", "flat", "corridor")


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


def simulated(
    name: str, camera: str, seed: int, *, mirror: bool
) -> tuple[tofuse.Recording, Mirror | None, np.ndarray]:
    """Simulate a recording of 112 x 84 pixels; with the mirror, and T_world_room."""
    build, path, frames, rate = SCENES[name]
    model = unusual.pinhole(camera, 112, 84, 60)
    one = Unusual(build, path, model, frames, rate)
    scene, hung = one.scene(seed), None
    sequence = scenes.Sequence(frames, 1, rate, one.path(seed))
    if mirror:
        width, height = size_of(seed)
        for smaller in (1.0, 0.8, 0.6, 0.45, 0.3):
            try:
                size = (smaller * width, smaller * height)
                times = np.arange(frames) / rate
                scene, hung = hang_mirror(scene, sequence, model, size, times=times, seed=seed)
                break
            except InputError:
                continue
    recording = unusual.record(replace(one, scene=lambda _: scene), seed)
    return recording, hung, sequence.T_world_truth()


def run(name: str, camera: str, seed: int, *, mirror: bool) -> dict[str, float]:
    """Reconstruct one recording, look for mirrors, and print the row."""
    recording, hung, T = simulated(name, camera, seed, mirror=mirror)
    result = tofuse.reconstruct(recording, threads=1)
    start = time.process_time()
    found = find_mirrors(recording, result)
    seconds = time.process_time() - start
    mirrors = found.mirrors
    ate = result.evaluate().error.ate_rms_m
    row = {"seconds": seconds, "false": len(mirrors), "ate": ate}
    area, best = 0.0, None
    if hung is not None:
        centre = se3.transform(T, hung.centre[None])[0]
        right = [m for m in mirrors if np.linalg.norm(m.corners.mean(0) - centre) < _reach(hung)]
        right = [m for m in right if m.normal @ T[:3, :3] @ hung.normal > 0.95]
        best = max(right, key=lambda m: m.area_m2) if right else None
        area = hung.area
        row |= {"area": area, "found": best is not None, "false": len(mirrors) - len(right)}
        if best is not None:
            world = se3.transform(se3.inverse(T), found.cloud.points.astype(float))
            row |= {"ratio": best.area_m2 / area, "left": _left_behind(world, hung)}
    print(
        f"| {name} | {camera} | {seed} | {area:.2f} | "
        f"{'–' if best is None else f'{best.area_m2:.2f}'} | {row['false']} | "
        f"{row.get('left', 0):.0f} | {1e3 * ate:.1f} | {seconds:.1f} |",
        flush=True,
    )
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
            if m.kind == "mirror":
                line = se3.transform(se3.inverse(T), m.corners)[:, :2]
                axis.plot(*line.T, color="#e66100", linewidth=2)
        axis.set(aspect="equal", title=f"{title} --mirrors", xlabel="x, m", ylabel="y, m")
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="*")
    parser.add_argument("--cases", type=int, default=None)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--picture", help="draw one room before and after, and stop")
    arguments = parser.parse_args()
    if arguments.recordings:
        for path in arguments.recordings:
            recording = tofuse.open(path)
            recording = recording[:: max(1, len(recording) // arguments.frames)]
            found = find_mirrors(recording, tofuse.reconstruct(recording, threads=1))
            areas = [f"{m.area_m2:.2f} m²" for m in found.mirrors]
            print(f"{path}: {len(recording)} frames: {', '.join(areas) or 'none'}", flush=True)
        return
    if arguments.picture:
        recording, _, T = simulated("empty-room", "ifm-o3r", 1, mirror=True)
        result = tofuse.reconstruct(recording, threads=1)
        draw(result, find_mirrors(recording, result), T, arguments.picture)
        return
    print("| scene | camera | seed | area, m² | found | false | left | ATE, mm | CPU s |")
    print("|---|---|---|---|---|---|---|---|---|")
    rows, others = [], []
    for k, case in enumerate(WITH_MIRROR[: arguments.cases]):
        rows.append(run(*case, mirror=True))
        if k % 2 == 0 and k // 2 < len(WITHOUT):
            others.append(run(*WITHOUT[k // 2], mirror=False))
    ratios = np.array([r["ratio"] for r in rows if "ratio" in r])
    print(
        f"\n{sum(r['found'] for r in rows)} of {len(rows)} mirrors found, area within 10 % in "
        f"{int((np.abs(ratios - 1) < 0.1).sum())}, ratio {ratios.min():.2f} to {ratios.max():.2f}; "
        f"{sum(r['false'] for r in rows)} false ones with a mirror, "
        f"{sum(r['false'] for r in others)} in {len(others)} recordings without; "
        f"median ATE {1e3 * np.median([r['ate'] for r in rows]):.1f} mm with a mirror, "
        f"{1e3 * np.median([r['ate'] for r in others]):.1f} mm without."
    )


if __name__ == "__main__":
    main()
