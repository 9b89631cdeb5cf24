"""Predicted against achieved bounds of cameras, planned from a coarse scan of a simulated room.

A small camera (80 x 60 pixels) scans a room. From its result `tofuse plan` predicts the bound and
the coverage of other cameras along the same path. They are then simulated in the true room, at full
resolution, along the true path, and reconstructed. With `--repeats`, both are done with several
seeds of the noise, all bounds are listed, and their medians are compared.

    python benchmarks/plan.py [--names room] [--cameras ifm-o3r pico-flexx] [--all-effects]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace

import numpy as np

import coach
import unusual
from tofuse.engine.arrays import Float64
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.lab import planning
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import camera_model
from tofuse.lab.simulation.record import RecordingPlan
from tofuse.lab.world import paths
from tofuse.lab.world import scene as scenes

RATE_HZ, SECONDS = 10.0, 7.0


def _across(t: float) -> Float64:
    """Walk along 250 degrees of a circle of 1.2 m within 7 s, looking to the other side."""
    a = np.radians(250) * t / 7
    at = np.array([1.2 * np.cos(a), 1.2 * np.sin(a), 1.3])
    return paths.look_at(at, [-np.cos(a + 0.6), -np.sin(a + 0.6), 0.8])


def _turning(t: float) -> Float64:
    """Turn by 290 degrees within 7 s, swaying."""
    sway = paths.sway(np.eye(4), [0.3, 0.1, 0.2, 0.1, 0, 0], 5.0)
    return unusual.EYE @ paths.rotation([0, np.radians(290) * t / 7, 0]) @ sway(t)


def _in_flat(t: float) -> Float64:
    """Walk along 240 degrees of a small circle in a room of the flat within 7 s."""
    centre = (float(coach.IN_FLAT[0]), float(coach.IN_FLAT[1]))
    return coach.circling(8 * t / 7, 0.3, centre, 0.7)


ROOMS: dict[str, tuple[str, Callable[[float], Float64]]] = {
    "room, walking": ("room", _across),
    "empty room, walking": ("empty-room", _across),
    "room, turning": ("room", _turning),
    "empty room, turning": ("empty-room", _turning),
    "flat, walking": ("flat", _in_flat),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--names", nargs="+", default=[""], help="rooms whose names contain these")
    parser.add_argument("--cameras", nargs="+", default=["ifm-o3r", "pico-flexx", "sr4000"])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=1, help="seeds of the noise")
    parser.add_argument(
        "--all-effects", action="store_true", help="with multipath and smear, which take longer"
    )
    options = parser.parse_args()
    effects = Effects() if options.all_effects else Effects().without("multipath", "smear")
    print(
        "| room | camera | predicted, mm | achieved, mm | ratio | coverage: predicted | achieved |"
    )
    print("|---|---|---|---|---|---|---|", flush=True)
    ratios = []
    for name, (scene_name, path) in ROOMS.items():
        if not any(part in name for part in options.names):
            continue
        scene = scenes.build(scene_name, seed=options.seed)[0]
        count = round(RATE_HZ * SECONDS)
        motion = scenes.Sequence(count, 1, RATE_HZ, path)
        small = replace(unusual.pinhole("ifm-o3r", 80, 60, 60), frame_rate_hz=RATE_HZ)
        raw = np.arange(count)
        scan_plan = RecordingPlan(scene, motion, small, effects, options.seed, raw)
        scan = reconstruct(scan_plan.recording(), threads=1)
        for camera in options.cameras:
            expected = [
                planning.expect(scan, [camera], effects=effects, threads=1, seed=k)[0]
                for k in range(options.repeats)
            ]
            model = replace(camera_model(camera), frame_rate_hz=RATE_HZ)
            results = []
            for k in range(options.repeats):
                plan = RecordingPlan(scene, motion, model, effects, options.seed + 10 + k, raw)
                results.append(reconstruct(plan.recording(), threads=1))
            bounds = [
                [each.bound_m for each in expected],
                [each.diagnostics.accuracy.position_m for each in results],
            ]
            assert scan.mesh is not None
            coverage = np.median([planning._coverage(scan.mesh, r, plan.poses) for r in results])
            predicted_m, achieved_m = np.median(bounds, axis=1)
            ratios.append(predicted_m / achieved_m)
            columns = [", ".join(f"{1e3 * each:.1f}" for each in bound) for bound in bounds]
            print(
                f"| {name} | {camera} | {columns[0]} | {columns[1]} | {ratios[-1]:.2f}"
                f" | {np.median([e.coverage for e in expected]):.0%} | {coverage:.0%} |",
                flush=True,
            )
    finite = np.array([r for r in ratios if np.isfinite(r) and r > 0])
    off = np.maximum(finite, 1 / finite)
    counts = " and ".join(
        f"{int((off <= f).sum())} below {f:g}" for f in (1.3, planning.UNCERTAINTY)
    )
    print(f"median factor {np.median(off):.2f}; of {len(off)} bounded {counts}")


if __name__ == "__main__":
    main()
