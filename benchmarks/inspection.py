"""Faults of recordings, and whether `tofuse inspect` reports them.

    python benchmarks/inspection.py [--cache DIR] [--seeds 10] [--clean 100] [--only FAULT,...]

Four simulated cameras record rooms, a corridor and an office, with noise and flying pixels (but
without multipath and smear, which are slow to simulate). Each of 20 faults is injected into 10
recordings of each camera, most of them into the finished recording, as by a wrong file or setting;
100 recordings of each camera are left clean. Prints, for each fault, how often it was reported and
which other findings there were; and the findings for the clean recordings (false alarms). Rendering
takes most of the time; --cache keeps its results. Faults that show at depth edges only (mirrored or
smoothed depth, unregistered colour) are injected into views of furniture: a mirrored bare corridor
is a valid corridor. A recording counts as saturated only if a tenth of its pixels are.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from made_once import computed_once
from tofuse.apps.inspection.inspect import inspect_recording
from tofuse.engine.cameras.cameras import BrownConrady, Pinhole, ray_lengths, scaled
from tofuse.engine.frames.frames import SATURATED_AMPLITUDE, RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import CameraModel, camera_model
from tofuse.lab.simulation.record import RecordingPlan
from tofuse.lab.world import paths
from tofuse.lab.world.scene import SCENES, build

Frames = list[RangeFrame]

EFFECTS = Effects().without("multipath", "smear")
# Horizontal field of view in degrees, and full-well capacity in electrons with which much of a room
# saturates.
CAMERAS = {"sr4000": (42, 5000.0), "kinect2": (70, 9000.0), "pico-flexx": (56, 700.0),
           "ifm-o3r": (62, 3000.0)}  # fmt: skip
STEP_DEG = 360 / SCENES["room"].frames


def model_of(camera: str) -> CameraModel:
    model = camera_model(camera)
    # At 3/8 of the resolution, which is what the checks use, rendering takes a seventh of the time.
    small = scaled(model.camera, 192, 159)
    return replace(model, camera=small) if camera == "kinect2" else model


def film(scene: str, camera: str, seed: int, raw, *, still=False, well=None, walk=None) -> Frames:
    """Simulate raw frames of a scene, with factory correction."""
    model = model_of(camera)
    if well is not None:
        model = replace(model, full_well_electrons=well)
    built, sequence = build(scene, seed=seed)
    if still:
        T = sequence.T_room_camera(raw[0] / sequence.frame_rate_hz)
        sequence = replace(sequence, camera_path=paths.still(T))
    effects = EFFECTS
    if walk is not None:
        sequence = walk(sequence)
    if scene == "corridor" or walk is not None:
        effects = effects.without("wrap")  # longer than the ambiguity range of some cameras
    plan = RecordingPlan(built, sequence, model, effects, seed, np.asarray(raw))
    return [*plan.corrected_frames()]


def clean(camera: str, k: int) -> Frames:
    """One of the clean recordings: a room, an office, a corridor or an empty room."""
    scene = ("room", "rail", "room", "corridor", "empty-room")[k % 5]
    rng = np.random.default_rng([k, 5])
    stride = {"rail": 8}.get(scene, 4)
    count = 6 if k < 10 else 4
    start = int(rng.integers(0, SCENES[scene].frames - count * stride))
    if scene == "rail":  # the part with motion
        start = int(rng.choice([rng.integers(25, 50), rng.integers(150, 230)]))
    if scene == "empty-room":  # facing a corner, as a bare wall is a finding
        corner = np.degrees(np.arctan2(1.6, 3.0)) * np.array([1, -1])
        at = rng.choice(np.concatenate([corner, 180 + corner])) + rng.uniform(-8, 8)
        at -= np.degrees(np.arctan2(0.2, 1))
        start = round(((-at) % 360) / 360 * 405 - count * stride / 2) % 405
    return film(scene, camera, k, start + stride * np.arange(count))


def turn(camera: str, k: int) -> Frames:
    """Four segments of five frames each of a camera rotation."""
    raw = (11 * k + np.concatenate([96 * q + 6 * np.arange(5) for q in range(4)])) % 384
    return film("room", camera, k, raw)


def rendered_fault(fault: str) -> Callable[[str, int], Frames]:
    def make(camera: str, k: int) -> Frames:
        rng, n = np.random.default_rng([k, 6]), np.arange(4)
        wide, well = CAMERAS[camera]
        if fault == "wall_only":
            return film("wall", camera, k, 3 * n + k)
        start = int(rng.integers(0, 384))
        if fault == "saturation":
            for _ in range(6):
                frames = film("room", camera, k, start + 4 * n, well=well)
                if np.mean([f.amplitude_image >= SATURATED_AMPLITUDE for f in frames]) > 0.1:
                    break
                well /= 1.5
            return frames
        if fault == "static":
            return film("room", camera, k, start + n, still=True)
        fraction = {"fast": 0.3, "overlap": 0.75}[fault]
        return film("room", camera, k, start + round(fraction * wide / STEP_DEG) * n)

    return make


def with_camera(frames: Frames, camera: Pinhole) -> Frames:
    return [replace(f, camera=camera) for f in frames]


def unit(frames: Frames, k: int) -> Frames:
    factor = np.float32((1000, 0.001, 10, 0.01)[k % 4])
    return [replace(f, depth=f.depth * factor) for f in frames]


def range_as_z(frames: Frames, k: int) -> Frames:
    return [replace(f, depth=f.radial_range, depth_kind="z") for f in frames]


def z_as_range(frames: Frames, k: int) -> Frames:
    return [replace(f, depth=f.z, depth_kind="range") for f in frames]


def wrong_focal(frames: Frames, k: int) -> Frames:
    """Of radial range: with z depth planes stay planes."""
    c = frames[0].camera
    factor = 1.25 if k % 2 else 0.8
    ranges = [replace(f, depth=f.radial_range, depth_kind="range") for f in frames]
    return with_camera(ranges, replace(c, fx=c.fx * factor, fy=c.fy * factor))


def color_intrinsics(frames: Frames, k: int) -> Frames:
    c = frames[0].camera
    return with_camera(frames, Pinhole(c.width, c.height, 1060.0, 1060.0, 959.5, 539.5))


def undistorted(frames: Frames, k: int) -> Frames:
    c = frames[0].camera
    if c.width == 176:  # this lens distorts by only 3 %: use the opposite sign convention
        flipped = BrownConrady(c.width, c.height, c.fx, c.fy, c.cx, c.cy, k1=-c.k1, k2=-c.k2)
        return with_camera(frames, flipped)
    return with_camera(frames, Pinhole(c.width, c.height, c.fx, c.fy, c.cx, c.cy))


def mirrored(frames: Frames, k: int) -> Frames:
    turned = (np.s_[:, ::-1], np.s_[::-1], np.s_[::-1, ::-1])[k % 3]
    return [replace(f, amplitude_image=f.amplitude_image[turned].copy()) for f in frames]


def colored(frames: Frames, k: int, shift: float = 0.0) -> Frames:
    """Colour from the amplitude, shifted by a fraction of the image width."""
    out = []
    for f in frames:
        amplitude = np.log1p(np.minimum(f.amplitude_image, 60000))
        low, high = np.percentile(amplitude, [1, 99])
        grey = (np.clip((amplitude - low) / (high - low), 0, 1) * 255).astype(np.uint8)
        moved = np.float32([[1, 0, shift * f.camera.width], [0, 1, -shift * f.camera.width / 3]])
        grey = cv2.warpAffine(grey, moved, grey.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
        out.append(replace(f, color_image=np.repeat(grey[..., None], 3, -1)))
    return out


def times(change: Callable[[np.ndarray], None]) -> Callable[[Frames, int], Frames]:
    def apply(frames: Frames, k: int) -> Frames:
        t = np.arange(len(frames)) / 10.0
        change(t)
        return [replace(f, timestamp=float(s)) for f, s in zip(frames, t, strict=True)]

    return apply


def unsorted(t: np.ndarray) -> None:
    t[[2, 3]] = t[[3, 2]]


def repeated(t: np.ndarray) -> None:
    t[3:] = t[2:-1].copy()


def gap(t: np.ndarray) -> None:
    t[3:] += 0.3


def frozen(frames: Frames, k: int) -> Frames:
    return [replace(frames[k - (k == 2)], timestamp=f.timestamp) for k, f in enumerate(frames)]


def wrapped(frames: Frames, percent: float) -> Frames:
    """Depth of a camera with an ambiguity range that a percentage of the pixels exceeds."""
    ranges = np.concatenate([f.radial_range[f.valid] for f in frames])
    period = float(np.percentile(ranges, 100 - percent))
    out = []
    for f in frames:
        r = f.radial_range
        short = np.where(f.valid, np.mod(r, period), 0).astype(np.float32)
        amplitude = f.amplitude_image
        if f.amplitude_kind == "range_compensated":
            amplitude = np.where(f.valid, amplitude * (short / np.maximum(r, 1e-6)) ** 2, amplitude)
        depth = short if f.depth_kind == "range" else short / ray_lengths(f.camera)
        depth = np.where(f.valid, depth, 0).astype(np.float32)
        out.append(
            replace(
                f, depth=depth, amplitude_image=amplitude.astype(np.float32), ambiguity_m=period
            )
        )
    return out


def smoothed(frames: Frames, k: int) -> Frames:
    """Depth as from a driver that resamples or smooths across edges."""
    out = []
    for f in frames:
        known = f.valid.astype(np.float32)
        soft = cv2.GaussianBlur(f.depth * known, (0, 0), 2)
        weight = cv2.GaussianBlur(known, (0, 0), 2)
        depth = np.where(f.valid, soft / np.maximum(weight, 1e-3), 0)
        out.append(replace(f, depth=depth.astype(np.float32)))
    return out


def as_it_is(frames: Frames, k: int) -> Frames:
    return frames


# Fault: what to record, how to corrupt it, and the code that reports it.
FAULTS: dict[str, tuple[str, Callable[[Frames, int], Frames], str]] = {
    "depth in another unit": ("clean", unit, "depth_unit"),
    "range taken for z": ("turn", range_as_z, "range_taken_for_z"),
    "z taken for range": ("turn", z_as_range, "z_taken_for_range"),
    "focal length x 1.25 or 0.8": ("turn", wrong_focal, "focal_length"),
    "intrinsics of a colour camera": ("clean", color_intrinsics, "other_intrinsics"),
    "distortion not applied": ("turn", undistorted, "lens_distortion"),
    "depth mirrored to amplitude": ("furnished", mirrored, "mirrored"),
    "colour not registered": ("furnished", lambda f, k: colored(f, k, 0.06), "color_unregistered"),
    "timestamps unsorted": ("clean", times(unsorted), "time_unsorted"),
    "timestamps repeated": ("clean", times(repeated), "time_repeated"),
    "frames missing": ("clean", times(gap), "frames_missing"),
    "images repeated": ("clean", frozen, "frames_repeated"),
    "phase wrap of a quarter": ("clean", lambda f, k: wrapped(f, 25), "some_phase_wrap"),
    "phase wrap of three quarters": ("clean", lambda f, k: wrapped(f, 75), "phase_wrap"),
    "saturation": ("saturation", as_it_is, "saturated"),
    "depth smoothed across edges": ("furnished", smoothed, "flying_pixels"),
    "shift of 0.3 of the view per frame": ("fast", as_it_is, "fast_motion"),
    "shift of 0.75 of the view per frame": ("overlap", as_it_is, "little_overlap"),
    "static camera": ("static", as_it_is, "static"),
    "one bare wall": ("wall_only", as_it_is, "wall_only"),
}


def recording_of(frames: Frames, name: str) -> Recording:
    parts = {}
    if len(frames) == 20:  # segments of a rotation that may end where it began
        parts = {"parts": [{"frames": 5}] * 4}
        frames = [replace(f, timestamp=k / 10) for k, f in enumerate(frames)]
    return Recording.of(ArraySource(frames, metadata=parts), name, "simulated")


def taken(kind: str, camera: str, k: int, cache: Path | None) -> Frames:
    if kind == "furnished":
        kind, k = "clean", 5 * (k // 3) + k % 3
    file = None if cache is None else cache / f"{kind}-{camera}-{k:03d}.pkl"
    make = {"clean": clean, "turn": turn}.get(kind) or rendered_fault(kind)
    return computed_once(file, lambda: make(camera, k))


def finding_codes(frames: Frames, name: str) -> set[str]:
    return {f.code for f in inspect_recording(recording_of(frames, name)).findings}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--clean", type=int, default=100)
    parser.add_argument("--only", default="")
    chosen = parser.parse_args()
    begin = time.process_time()
    print("| fault | " + " | ".join(CAMERAS) + " | other findings |")
    print("|---|" + "---|" * (len(CAMERAS) + 1))
    total = hit = 0
    for fault, (kind, put, code) in FAULTS.items():
        if chosen.only and code not in chosen.only.split(","):
            continue
        cells, others = [], Counter()
        for camera in CAMERAS:
            found = 0
            for k in range(chosen.seeds):
                # Geometric faults: in views of walls in all directions.
                frames = put(taken(kind, camera, k, chosen.cache), k)
                codes = finding_codes(frames, fault)
                found += code in codes
                others.update(codes - {code})
            cells.append(f"{found} of {chosen.seeds}")
            total, hit = total + chosen.seeds, hit + found
        also = ", ".join(f"{name} {count}" for name, count in others.most_common())
        print(f"| {fault} | " + " | ".join(cells) + f" | {also or '-'} |", flush=True)
    if total:
        print(f"\nreported: {hit} of {total}, {hit / total:.1%}")
    if not chosen.only or "clean" in chosen.only:
        clean_ones(chosen.clean, chosen.cache)
    print(f"{time.process_time() - begin:.0f} s of CPU time")


def clean_ones(count: int, cache: Path | None) -> None:
    alarms, wrong, total = Counter(), 0, 0
    for camera in CAMERAS:
        for k in range(count):
            if cache is not None and not (cache / f"clean-{camera}-{k:03d}.pkl").exists():
                continue
            frames = taken("clean", camera, k, cache)
            codes = finding_codes(colored(frames, k) if k % 2 else frames, "clean")
            wrong += bool(codes)
            total += 1
            alarms.update(codes)
            if codes:
                print(camera, k, codes)
    print(f"clean recordings: {wrong} of {total} with an alarm ({wrong / max(total, 1):.1%}): "
          + (", ".join(f"{name} {n}" for name, n in alarms.most_common()) or "none"))  # fmt: skip


if __name__ == "__main__":
    main()
