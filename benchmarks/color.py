"""What colour at full resolution gives: simulated phones with and without it, and recordings.

    python benchmarks/color.py simulated [--scenes floor plain room] [--seeds 2]
    python benchmarks/color.py shutter [--scenes floor room] [--seeds 2]
    python benchmarks/color.py recorded [--names ...]

`simulated`: poses against truth, with colour images of 960x720 pixels beside smooth, lagging depth
of 256x192, and without them, and how often the error is within the stated bound. A bare floor has
one plane: depth leaves the yaw and two translations open. `plain` is the same without texture.
`shutter`: the same floor by a rolling shutter that is read in 20 ms, turning at up to 30 degrees a
second. `recorded`: distances of matched features (SIFT) from their epipolar lines, in pixels, as
the poses with and without colour predict them. The run uses other points: corners, of frames
selected by motion. In the same table, the errors against the reference where there is one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import combinations, product
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from phone import features_of, matched_rays, opened, parsed, present
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import scaled
from tofuse.engine.frames.recording import POSES_BY, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.geometry.rays import homogeneous
from tofuse.engine.mapping.adaptation import Prior, with_prior
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.engine.quality.trajectory_errors import displacement
from tofuse.engine.refinement import Joint
from tofuse.engine.results import Reconstruction
from tofuse.lab import scenes
from tofuse.lab.simulation.phone import COLOR, PhoneErrors, PhonePlan
from tofuse.lab.world import Material, mesh, paths
from tofuse.lab.world.scene import Scene, Sequence

NAMES = (
    "iphone_chair_3dscannerapp",
    "iphone_room",
    "azure_kinect_tags",
    "realsense_desk",
    "open3d_rgbd5",
)
SIZE = scaled(COLOR, 960, 720)
FRAMES, RATE_HZ = 50, 10.0
READOUT_S = 0.02
MATCH_PIXELS, MIN_MATCHES = 2.0, 60

Path_ = Callable[[float], Float64]


def floor_path(speed: float) -> Path_:
    """Walk along a floor, looking down and around; at `speed` 1 turning by up to 15 degrees/s."""

    def path(t: float) -> Float64:
        yaw = 0.5 * np.sin(0.52 * speed * t)
        position = np.array([0.25 * t, 0.1 * np.sin(1.3 * t), 1.4 + 0.05 * np.sin(1.7 * t)])
        return paths.look_at(position, position + np.array([np.sin(yaw), np.cos(yaw), -1.3]))

    return path


def scene_and_path(name: str, seed: int, speed: float) -> tuple[Scene, Path_]:
    """Return a scene and the path of the phone."""
    if name in ("floor", "plain"):
        material = Material("floor", 0.4, 0.25, "print", (0.2, 0.2, 0.2))
        material = material.uniform() if name == "plain" else material
        ground = mesh.quad((-10, -10, 0), (20, 0, 0), (0, 20, 0))
        return Scene(name, [material], ground, seed=seed), floor_path(speed)
    scene, sequence = scenes.build(name, seed=seed)
    return scene, lambda t: sequence.T_room_camera(speed * t)


def simulated(
    name: str, seed: int, *, every: int = 1, readout_s: float = 0.0, speed: float = 1.0
) -> PhonePlan:
    """Plan a recording of a phone.

    Parameters
    ----------
    name, seed
        Of the scene.
    every
        Every how many-th frame has colour.
    readout_s
        Time from the first to the last row of the colour image; its middle is at that of depth.
    speed
        Factor on that of the path.
    """
    scene, path = scene_and_path(name, seed, speed)
    times = np.arange(FRAMES) / RATE_HZ
    errors = PhoneErrors(shutter=readout_s)
    motion = Sequence(FRAMES, 1, RATE_HZ, path)
    return PhonePlan(scene, motion, times, errors, seed, color=SIZE, color_every=every)


def both(recording: Recording, prior: Prior) -> Iterator[tuple[str, Reconstruction]]:
    """Yield the reconstructions without and with colour at full resolution."""
    recording, config = with_prior(recording, from_method("default", "range"), prior)
    for name, color in (("depth", False), ("colour", True)):
        yield name, reconstruct(recording, replace(config, refinement=Joint(color=color)))


def print_simulated(names: list[str], seeds: int, **options: Any) -> None:
    """Print the table of simulated phones."""
    print("| scene | colour in | poses | posed | position rms, mm | rotation rms, deg | "
          "stated, mm | stated, deg | unbounded |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|")
    for name, every, seed in product(names, (1, 3), range(seeds)):
        planned = simulated(name, seed, every=every, **options)
        with opened(planned) as recording:
            for method, result in both(recording, "none"):
                posed = result.has_pose
                metres, rad = displacement(result.trajectory[posed], planned.poses[posed])
                stated = result.diagnostics.accuracy
                print(
                    f"| {name} {seed} | 1 of {every} | {method} | {posed.sum()} | "
                    f"{1000 * metres:.1f} | {np.degrees(rad):.2f} | "
                    f"{1000 * stated.position_m:.1f} | {np.degrees(stated.rotation_rad):.2f} | "
                    f"{len(stated.unbounded)} |",
                    flush=True,
                )


# ---- Recordings ----------------------------------------------------------------------------------


def epipolar_matches(recording: Recording) -> list[tuple[int, int, Float64, Float64, float]]:
    """Return positions i, j, rays (N, 2) in both images and the focal length of matched pairs."""
    out = []
    for a, b in combinations(list(features_of(recording)), 2):
        x_a, x_b = matched_rays(a, b)
        if len(x_a) < MIN_MATCHES:
            continue
        _, mask = cv2.findEssentialMat(
            x_a, x_b, np.eye(3), method=cv2.USAC_MAGSAC, prob=0.9999,
            threshold=MATCH_PIXELS / a.focal,
        )  # fmt: skip
        if mask is not None and (mask > 0).sum() >= MIN_MATCHES:
            used = mask.ravel() > 0
            out.append((a.k, b.k, x_a[used], x_b[used], a.focal))
    return out


def epipolar_distance(T_b_a: Float64, x_a: Float64, x_b: Float64, focal: float) -> float:
    """Median Sampson distance of matches, pixels."""
    E = se3.hat(T_b_a[:3, 3] / max(float(np.linalg.norm(T_b_a[:3, 3])), 1e-9)) @ T_b_a[:3, :3]
    h_a, h_b = homogeneous(x_a), homogeneous(x_b)
    in_b, in_a = h_a @ E.T, h_b @ E
    scale = np.sqrt((in_b[:, :2] ** 2).sum(1) + (in_a[:, :2] ** 2).sum(1))
    return focal * float(np.median(np.abs((h_b * in_b).sum(1)) / scale))


def print_recorded(data: Path, names: list[str]) -> None:
    """Print the table of recordings."""
    print("| recording | poses | epipolar distance, median (90 %), px | pairs | "
          "to reference, mm | deg | stated, mm | CPU of colour |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|")
    for name, recording in present(data, names, columns=8):
        matches = epipolar_matches(recording)
        prior: Prior = "auto" if POSES_BY in recording.metadata else "none"
        for method, result in both(recording, prior):
            P = result.trajectory
            distances = [
                epipolar_distance(se3.inverse(P[j]) @ P[i], x_i, x_j, focal)
                for i, j, x_i, x_j, focal in matches
                if np.isfinite(P[[i, j]]).all()
            ]
            reference = "- | -"
            if recording.reference is not None:
                known = result.has_pose & np.isfinite(recording.reference).all((1, 2))
                metres, rad = displacement(P[known], recording.reference[known])
                reference = f"{1000 * metres:.1f} | {np.degrees(rad):.2f}"
            seconds = result.diagnostics.cpu_seconds
            share = seconds.get("colour", 0.0) / sum(seconds.values())
            print(
                f"| {name} | {method} | {np.median(distances):.2f} "
                f"({np.quantile(distances, 0.9):.2f}) | {len(distances)} | {reference} | "
                f"{1000 * result.diagnostics.accuracy.position_m:.1f} | {share:.0%} |",
                flush=True,
            )


def main() -> None:
    """Run the chosen part."""
    shown = {"simulated": ["floor", "plain", "room"], "shutter": ["floor", "room"]}
    options = parsed(__doc__, NAMES, shown)
    if options.command == "simulated":
        print_simulated(options.scenes, options.seeds)
    elif options.command == "shutter":
        for readout_s in (READOUT_S, 0.0):
            print(f"\nRead in {1000 * readout_s:.0f} ms\n")
            print_simulated(options.scenes, options.seeds, readout_s=readout_s, speed=2.0)
    else:
        print_recorded(options.data, options.names)


if __name__ == "__main__":
    main()
