"""Accuracy of the extrinsic calibration of camera rigs, and detection of displaced cameras.

`still` simulates four cameras around a rotating person, and calibrates them from one instant and
from up to 60; `--all-effects` adds multipath and lens scattering. `systematic` simulates random
static rigs of five camera models in three scenes with all effects, one instant each, and prints the
coverage of the 95 % ellipsoids, of all errors and of random errors alone. `moving` simulates three
cameras back to back that are carried through a furnished room, and prints the calibration from the
trajectories alone, and from all views. Clocks run at 30.03 and 30.14 Hz. `coverage` prints the
coverage of the 95 % ellipsoids of hand-eye calibrations, from trajectories with errors correlated
over half a second. `check` displaces one camera of a rig by 5 mm or 0.3 degrees, or none. `real`
calibrates five Azure Kinects from one image each, and compares them with poses by COLMAP, whose
scale is aligned.

    python benchmarks/rigs.py still [--instants 1 60] [--seeds 1] [--all-effects]
    python benchmarks/rigs.py systematic [--seeds 3]
    python benchmarks/rigs.py moving [--frames 150] [--seeds 1]
    python benchmarks/rigs.py coverage [--seeds 100]
    python benchmarks/rigs.py check [--seeds 100]
    python benchmarks/rigs.py real
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from tofuse.apps.rigs.calibrating import calibrate, calibrate_cameras
from tofuse.apps.rigs.checking import compare
from tofuse.apps.rigs.hand_eye import Track, hand_eye
from tofuse.apps.rigs.inputs import Camera, open_cameras
from tofuse.apps.rigs.joint import RigView, disagreements, refine_together
from tofuse.engine.arrays import Float64
from tofuse.engine.frames.recording import Recording
from tofuse.engine.geometry import se3
from tofuse.engine.stored_views.view_store import SampledView
from tofuse.formats.rigs.rig_file import Rig, RigCamera
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import CameraModel, camera_model
from tofuse.lab.simulation.rig import Mount, camera_ring, relative, simulate_rig, wander
from tofuse.lab.world import scene as scenes
from tofuse.lab.world.paths import look_at, rotation

REAL = Path(__file__).resolve().parents[2] / "shared" / "data" / "azure_kinect_rig"
STILL = Effects(multipath=False, scatter=0.0, smear=False)
MOVING = Effects(multipath=False, smear=False)
RATES = (30.03, 30.14, 30.0, 30.08)
CLOCKS = (0.0, 0.0123, -0.021, 0.008)
# Cameras with a larger standard deviation are too weakly constrained to count, m.
LOOSE_M = 0.3
INSIDE = float(chi2.ppf(0.95, 6))
HEADER = f"{'':<28}{'camera':<8}{'mm':>7}{'deg':>8}{'clock ms':>10}{'chi2':>8}"


def smaller(model: CameraModel, width: int) -> CameraModel:
    """The same camera with fewer pixels."""
    c, s = model.camera, width / model.camera.width
    camera = replace(
        c,
        width=width,
        height=round(c.height * s),
        fx=c.fx * s,
        fy=c.fy * s,
        cx=(c.cx + 0.5) * s - 0.5,
        cy=(c.cy + 0.5) * s - 0.5,
    )
    return replace(model, camera=camera)


def cameras_of(recordings: list[Recording]) -> list[Camera]:
    return [Camera(f"cam{k}", recording) for k, recording in enumerate(recordings)]


def print_errors(label: str, rig: Rig, truth: list[Float64], clocks: tuple[float, ...]) -> None:
    for camera in rig.cameras[1:]:
        k = int(camera.name[3:])
        error = se3.inverse(camera.T_rig_camera) @ truth[k]
        e = se3.log(error)
        late = 1e3 * (camera.time_offset_s - (clocks[k] - clocks[0]))
        square = e @ np.linalg.solve(camera.covariance, e)
        print(
            f"{label:<28}{camera.name:<8}{1e3 * np.linalg.norm(error[:3, 3]):7.2f}"
            f"{np.degrees(se3.angle(error)):8.3f}{late:10.2f}{square:8.1f}"
        )
    for name, why in rig.unplaced.items():
        print(f"{label:<28}{name:<8}not placed: {why}")


def still(instants: list[int], seeds: int, *, all_effects: bool) -> None:
    scene, sequence = scenes.build("torso")
    stands = camera_ring((0, 0, 0.8), 1.6, 0.5, 4)
    truth = relative(stands)
    sequence = replace(sequence, camera_path=lambda t: stands[0])
    model = smaller(camera_model("kinect2"), 256)
    print(HEADER)
    for seed in range(seeds):
        for count in instants:
            clocks = CLOCKS if count > 1 else (0.0,) * 4
            mounts = [
                Mount(T, model, rate if count > 1 else 30.0, clock)
                for T, rate, clock in zip(truth, RATES, clocks, strict=True)
            ]
            effects = Effects() if all_effects else STILL
            recordings = simulate_rig(
                scene, sequence, mounts, first_s=0.5, frames=count, effects=effects, seed=seed
            )
            found = calibrate_cameras(cameras_of(recordings))
            print_errors(f"still, {found.how}, seed {seed}", found.rig, truth, clocks)


def stands_of(scene: str, rng: np.random.Generator) -> list[Float64]:
    """(4, 4) T_room_camera of a random rig: round a person, or side by side in a room."""
    if scene == "torso":
        centre, radius = (0, 0, 0.8 + rng.uniform(-0.1, 0.1)), rng.uniform(1.3, 2.0)
        count, first = int(rng.integers(3, 6)), rng.uniform(0, 2 * np.pi)
        stands = camera_ring(centre, radius, rng.uniform(0.2, 0.7), count, first)
    else:
        middle, step = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(30, 70))
        target = [-0.6 * np.cos(middle), -0.6 * np.sin(middle), 0.7]
        stands = []
        for angle in middle + step * np.arange(-1, 2):
            at = np.array([1.6 * np.cos(angle), 1.1 * np.sin(angle), rng.uniform(1.0, 1.8)])
            stands.append(look_at(at, np.array(target)))
    aside = np.array([0.05] * 3 + [0.06] * 3)
    return [T @ se3.exp(rng.normal(size=6) * aside) for T in stands]


def systematic(seeds: int) -> None:
    """Random rigs with all effects: how many errors lie in the stated ellipsoids.

    The refinement starts 1 cm and 0.5 degrees from the truth. Seeds below 10 were used for tuning.
    """
    print(f"{'':<24}{'cameras':>8}{'mm':>7}{'bound':>8}{'inside':>8}{'random only':>13}")
    start = np.array([0.01] * 3 + [np.radians(0.5)] * 3)
    total, ratios = np.zeros(3, int), []
    for kind in ("torso", "room", "empty-room"):
        scene, sequence = scenes.build(kind)
        for name in ("kinect2", "sr4000", "azure-nfov", "pico-flexx", "ifm-o3r"):
            model = smaller(camera_model(name), min(224, camera_model(name).camera.width))
            row, errors, bounds = np.zeros(3, int), [], []
            for seed in range(10, 10 + seeds):
                rng = np.random.default_rng([seed, *name.encode(), *kind.encode()])
                stands = stands_of(kind, rng)
                truth = np.stack(relative(stands))
                recordings = simulate_rig(
                    scene,
                    replace(sequence, camera_path=lambda t, T=stands[0]: T),
                    [Mount(T, model) for T in truth],
                    first_s=rng.uniform(0.2, 3),
                    seed=seed,
                )
                views = [
                    RigView(k, 0, SampledView.of(camera.surface(camera.images(1)[0]), 6000))
                    for k, camera in enumerate(cameras_of(recordings))
                ]
                away = rng.normal(size=(len(truth), 6)) * start
                away[0] = 0
                placed = refine_together(views, truth @ se3.exp(away))
                for k in range(1, len(truth)):
                    e = se3.log(se3.inverse(placed.poses[k]) @ truth[k])
                    C, R = placed.covariance[k][:6, :6], placed.random_covariance[k][:6, :6]
                    if not np.trace(C[:3, :3]) < LOOSE_M**2:
                        continue
                    errors.append(np.linalg.norm(e[:3]))
                    bounds.append(1.96 * np.sqrt(np.trace(C[:3, :3])))
                    row += [
                        1,
                        e @ np.linalg.solve(C, e) < INSIDE,
                        e @ np.linalg.solve(R, e) < INSIDE,
                    ]
            total += row
            ratios += [b / e for b, e in zip(bounds, errors, strict=True)]
            about = (
                f"{1e3 * np.median(errors):7.1f}{1e3 * np.median(bounds):8.1f}" if errors else " "
            )
            print(f"{kind + ', ' + name:<24}{row[0]:8}{about:>15}{row[1]:8}{row[2]:13}", flush=True)
    print(
        f"{total[1]} of {total[0]} inside, {total[2]} by random errors alone; median bound over "
        f"error {np.median(ratios):.1f}"
    )


def back_to_back() -> list[Float64]:
    truth = [np.eye(4)]
    for k in (1, 2):
        a = 2 * np.pi * k / 3
        T = rotation([0.05 * k, a, 0.03])
        T[:3, 3] = [0.09 * np.sin(a), 0.01 * k, -0.09 * (1 - np.cos(a))]
        truth.append(T)
    return truth


def moving(frames: int, seeds: int) -> None:
    scene, sequence = scenes.build("room")
    sequence = replace(sequence, camera_path=wander((0, 0, 1.2), (0.9, 0.5), 9.0))
    truth = back_to_back()
    model = camera_model("sr4000")
    clocks = (0.0, 0.0123, -0.045)
    mounts = [
        Mount(T, model, rate, clock) for T, rate, clock in zip(truth, RATES, clocks, strict=False)
    ]
    print(HEADER)
    for seed in range(seeds):
        recordings = simulate_rig(
            scene, sequence, mounts, first_s=0.2, frames=frames, effects=MOVING, seed=seed
        )
        found = calibrate_cameras(cameras_of(recordings), "moving")
        print_errors(f"moving, {frames} frames, seed {seed}", found.rig, truth, clocks)


def with_errors(path, T: Float64, rate: float, clock: float, rng: np.random.Generator) -> Track:
    """A trajectory of 8 s with errors of 2 mm and 0.07 degrees, correlated over 0.5 s."""
    times = np.arange(240) / rate + 0.4 - clock
    poses = np.stack([path(t + clock) @ T for t in times])
    errors, keep = rng.normal(size=(240, 6)), np.exp(-1 / 15)
    for k in range(1, 240):
        errors[k] = keep * errors[k - 1] + np.sqrt(1 - keep**2) * errors[k]
    poses = poses @ se3.exp(errors * ([0.002] * 3 + [np.radians(0.07)] * 3))
    return Track(times, se3.inverse(poses[0]) @ poses)


def coverage(seeds: int) -> None:
    T, path = back_to_back()[1], wander((0, 0, 1.2), (0.9, 0.5), 9.0)
    inside, errors, late = 0, [], []
    for seed in range(seeds):
        rng = np.random.default_rng([seed, 7])
        a = with_errors(path, np.eye(4), RATES[0], 0.0, rng)
        b = with_errors(path, T, RATES[1], CLOCKS[1], rng)
        found = hand_eye(a, b, 0.0)
        e = se3.log(se3.inverse(found.T_a_b) @ T)
        inside += bool(e @ np.linalg.solve(found.covariance, e) < INSIDE)
        errors.append(e)
        late.append(found.time_offset_s - CLOCKS[1])
    rms = np.sqrt((np.array(errors) ** 2).mean(0))
    print(f"hand-eye: {inside} of {seeds} errors in the 95 % ellipsoid")
    print(f"rms {1e3 * np.linalg.norm(rms[:3]):.2f} mm, {np.degrees(np.linalg.norm(rms[3:])):.3f}")
    print(f"deg, clock {1e3 * np.sqrt(np.mean(np.square(late))):.2f} ms")


def check(seeds: int) -> None:
    """Check rigs of four, calibrated to 0.6 mm and 0.03 degrees, for displaced cameras."""
    sigma = np.array([0.0006] * 3 + [np.radians(0.03)] * 3)
    truth = relative(camera_ring((0, 0, 0.8), 1.6, 0.5, 4))

    def measured(poses: list[Float64], rng: np.random.Generator) -> Rig:
        rows = [RigCamera("0", "", np.eye(4), np.zeros((6, 6)))]
        for k, T in enumerate(poses[1:], 1):
            T = se3.inverse(poses[0]) @ T @ se3.exp(rng.normal(size=6) * sigma)
            rows.append(RigCamera(str(k), "", T, np.diag(sigma**2)))
        return Rig(tuple(rows))

    for name, xi in (
        ("none", [0.0] * 6),
        ("5 mm", [0.005, 0, 0, 0, 0, 0]),
        ("0.3 deg", [0, 0, 0, 0, np.radians(0.3), 0]),
    ):
        right = 0
        for seed in range(seeds):
            rng = np.random.default_rng([seed, 11])
            which = seed % 4
            after = [T @ se3.exp(xi) if k == which else T for k, T in enumerate(truth)]
            found = compare(measured(truth, rng), measured(after, rng))
            named = [m.name for m in found if m.moved]
            right += named == ([] if name == "none" else [str(which)])
        print(f"displaced by {name:<8} detected rightly in {right} of {seeds}")


def real() -> None:
    """Compare the calibration of real cameras with reference poses, good to about 1 degree."""
    if not REAL.is_dir():
        print(f"{REAL} not found")
        return
    folders = sorted(path for path in REAL.iterdir() if path.is_dir())
    poses = json.loads((REAL / "reference_T_world_camera.json").read_text())
    rig = calibrate(folders).rig
    reference = np.stack([np.array(poses[camera.name], float) for camera in rig.cameras])
    reference = se3.inverse(reference[0]) @ reference
    views = [
        RigView(k, 0, SampledView.of(camera.surface(camera.images(1)[0]), 6000))
        for k, camera in enumerate(open_cameras([REAL / c.name for c in rig.cameras]))
    ]
    apart = np.median([pair.median_m for pair in rig.disagreement])
    stated = np.median([distance for distance, _ in disagreements(views, reference).values()])
    print(f"median distance of surfaces: {1e3 * apart:.1f} mm, at the reference {1e3 * stated:.1f}")
    print(f"{'camera':<16}{'mm':>7}{'deg':>7}{'±mm':>7}{'±deg':>7}{'chi2':>7}{'random only':>13}")
    for camera, T in zip(rig.cameras[1:], reference[1:], strict=True):
        e = se3.log(se3.inverse(camera.T_rig_camera) @ T)
        C, R = camera.covariance, camera.random_covariance
        metres, radians = se3.largest_sigmas(C)
        print(
            f"{camera.name:<16}{1e3 * np.linalg.norm(e[:3]):7.1f}"
            f"{np.degrees(np.linalg.norm(e[3:])):7.2f}{1e3 * metres:7.1f}{np.degrees(radians):7.2f}"
            f"{e @ np.linalg.solve(C, e):7.1f}{e @ np.linalg.solve(R, e):13.0f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "what", choices=("still", "systematic", "moving", "coverage", "check", "real")
    )
    parser.add_argument("--instants", type=int, nargs="+", default=[1, 60])
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--seeds", type=int)
    parser.add_argument("--all-effects", action="store_true")
    arguments = parser.parse_args()
    if arguments.what == "still":
        still(arguments.instants, arguments.seeds or 1, all_effects=arguments.all_effects)
    elif arguments.what == "systematic":
        systematic(arguments.seeds or 3)
    elif arguments.what == "moving":
        moving(arguments.frames, arguments.seeds or 1)
    elif arguments.what == "real":
        real()
    else:
        {"coverage": coverage, "check": check}[arguments.what](arguments.seeds or 100)


if __name__ == "__main__":
    main()
