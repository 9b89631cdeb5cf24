"""What colour at full resolution gives: simulated phones with and without it, and recordings.

    python benchmarks/color.py simulated [--scenes floor plain room] [--seeds 2]
    python benchmarks/color.py shutter
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

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

import sequences
from phone import POSES_BY, features_of
from tofuse.engine.arrays import Float64, UInt8
from tofuse.engine.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.mapping.adaptation import with_prior
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.engine.quality.trajectory_errors import displacement
from tofuse.engine.refinement import Joint
from tofuse.engine.results import Reconstruction
from tofuse.formats.recordings.open import open_recording
from tofuse.lab import scenes
from tofuse.lab.world import Material, mesh, paths
from tofuse.lab.world.scene import Scene

NAMES = (
    "iphone_chair_3dscannerapp",
    "iphone_room",
    "azure_kinect_tags",
    "realsense_desk",
    "open3d_rgbd5",
)
COLOR, DEPTH = (
    Pinhole(960, 720, 725.0, 725.0, 479.5, 359.5),
    Pinhole(256, 192, 193.3, 193.3, 127.5, 95.5),
)
FRAMES, RATE_HZ = 50, 10.0
# Of the depth: blur (pixels), relative error, its width (pixels) and duration (frames).
BLUR, DEPTH_ERROR, WIDTH, DURATION = 1.5, 0.007, 12.0, 10.0
NOISE = 2.0  # levels of the colour
READOUT_S = 0.02
MATCH_PIXELS, MIN_MATCHES = 2.0, 60

Path_ = Callable[[float], Float64]


class PhoneSource(ArraySource):
    """Frames with colour at a higher resolution than depth."""

    images: list[UInt8 | None]

    def full_resolution_color(self, index: int) -> UInt8 | None:
        """Return the colour (H, W, 3) of a frame as recorded."""
        return self.images[index]


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
) -> tuple[Recording, Float64]:
    """Simulate a phone; return the recording and the true poses.

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
    rng = np.random.default_rng([seed, 7])
    frames, images, error = [], [], np.zeros((DEPTH.height, DEPTH.width))
    for k in range(FRAMES):
        field = gaussian_filter(rng.standard_normal(error.shape), WIDTH, mode="reflect")
        kept = float(np.exp(-1 / DURATION)) if k else 0.0
        error = kept * error + np.sqrt(1 - kept**2) * DEPTH_ERROR / field.std() * field
        distance, _ = cast(scene, DEPTH, path, k / RATE_HZ, 0.0)
        z = distance / np.linalg.norm(homogeneous(DEPTH), axis=2)
        z = np.where(np.isfinite(z), z, 0.0)
        z = gaussian_filter(z, BLUR) * (1 + error)
        color = None
        if k % every == 0:
            _, albedo = cast(scene, COLOR, path, k / RATE_HZ, readout_s)
            level = 30 + 200 * gaussian_filter(albedo, 0.6) + rng.normal(0, NOISE, albedo.shape)
            color = np.repeat(level.clip(0, 255).astype(np.uint8)[..., None], 3, 2)
        small = None
        if color is not None:
            small = cv2.resize(color, (DEPTH.width, DEPTH.height), interpolation=cv2.INTER_AREA)
        depth = np.round(z, 3).astype(np.float32)
        frames.append(RangeFrame(k, k / RATE_HZ, DEPTH, depth, color_image=small))
        images.append(color)
    poses = np.stack([path(k / RATE_HZ) for k in range(FRAMES)])
    truth = se3.inverse(poses[0]) @ poses
    source = PhoneSource(frames)
    source.images = images
    return Recording.of(source, f"simulated {name}", "simulated"), truth


def homogeneous(camera: Pinhole) -> Float64:
    """(H, W, 3) rays at z = 1."""
    rays = camera.rays().astype(float)
    return np.concatenate([rays, np.ones((*rays.shape[:2], 1))], 2)


def cast(
    scene: Scene, camera: Pinhole, path: Path_, time: float, readout_s: float
) -> tuple[Float64, Float64]:
    """Return distances and albedos (H, W), each row at its own time."""
    rays = homogeneous(camera)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    rows = np.arange(camera.height)
    times = time + readout_s * ((rows + 0.5) / camera.height - 0.5)
    T = np.stack([path(t) for t in times]) if readout_s else np.tile(path(time), (len(rows), 1, 1))
    directions = (rays @ np.swapaxes(T[:, :3, :3], 1, 2)).reshape(-1, 3)
    origins = np.repeat(T[:, :3, 3], camera.width, 0)
    hits = scene.cast(origins, directions)
    shape = camera.height, camera.width
    return hits.distance.reshape(shape).astype(float), hits.albedo.reshape(shape).astype(float)


def both(recording: Recording) -> Iterator[tuple[str, Reconstruction]]:
    """Yield the reconstructions without and with colour at full resolution."""
    prior = "auto" if POSES_BY in recording.metadata else "none"
    recording, config = with_prior(recording, from_method("default", "range"), prior)
    for name, color in (("depth", False), ("colour", True)):
        yield name, reconstruct(recording, replace(config, refinement=Joint(color=color)))


def print_simulated(names: list[str], seeds: int, **options: float) -> None:
    """Print the table of simulated phones."""
    print("| scene | colour in | poses | posed | position rms, mm | rotation rms, deg | "
          "stated, mm | stated, deg | unbounded |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|")
    for name in names:
        for every in (1, 3):
            for seed in range(seeds):
                recording, truth = simulated(name, seed, every=every, **options)  # type: ignore[arg-type]
                for method, result in both(recording):
                    posed = result.has_pose
                    metres, rad = displacement(result.trajectory[posed], truth[posed])
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
    matcher = cv2.BFMatcher()
    for a, b in combinations(list(features_of(recording)), 2):
        back = {
            m.queryIdx: m.trainIdx for (m,) in matcher.knnMatch(b.descriptors, a.descriptors, 1)
        }
        good = [
            m
            for m, second in matcher.knnMatch(a.descriptors, b.descriptors, 2)
            if m.distance < 0.8 * second.distance and back[m.trainIdx] == m.queryIdx
        ]
        if len(good) < MIN_MATCHES:
            continue
        x_a, x_b = a.rays[[m.queryIdx for m in good]], b.rays[[m.trainIdx for m in good]]
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
    h_a, h_b = (np.concatenate([x, np.ones((len(x), 1))], 1) for x in (x_a, x_b))
    in_b, in_a = h_a @ E.T, h_b @ E
    scale = np.sqrt((in_b[:, :2] ** 2).sum(1) + (in_a[:, :2] ** 2).sum(1))
    return focal * float(np.median(np.abs((h_b * in_b).sum(1)) / scale))


def print_recorded(data: Path, names: list[str]) -> None:
    """Print the table of recordings."""
    print("| recording | poses | epipolar distance, median (90 %), px | pairs | "
          "to reference, mm | deg | stated, mm | CPU of colour |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|")
    for name in names:
        if not (data / name).is_dir():
            print(f"| {name} | missing | | | | | | |")
            continue
        recording = open_recording(data / name)
        matches = epipolar_matches(recording)
        for method, result in both(recording):
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
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    made = commands.add_parser("simulated")
    made.add_argument("--scenes", nargs="+", default=["floor", "plain", "room"])
    made.add_argument("--seeds", type=int, default=2)
    rolling = commands.add_parser("shutter")
    rolling.add_argument("--seeds", type=int, default=2)
    real = commands.add_parser("recorded")
    real.add_argument("--data", type=Path, default=sequences.DATA)
    real.add_argument("--names", nargs="+", default=list(NAMES))
    options = parser.parse_args()
    if options.command == "simulated":
        print_simulated(options.scenes, options.seeds)
    elif options.command == "shutter":
        for readout_s in (READOUT_S, 0.0):
            print(f"\nRead in {1000 * readout_s:.0f} ms\n")
            print_simulated(["floor", "room"], options.seeds, readout_s=readout_s, speed=2.0)
    else:
        print_recorded(options.data, options.names)


if __name__ == "__main__":
    main()
