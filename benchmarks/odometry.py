"""Odometry of wheels, with the errors that wheels have: whole runs with it and without.

Recordings of the second simulator (`other_sensor.py`) with odometry of the camera: the true motion
with an error of each step of 1 % of its length and of its angle, and in addition a wrong radius of
the wheels, a slip, wrong angles, a clock that is late, or half of the poses. Each is reconstructed
with `--prior device`. A row has, without and with the odometry, the rms error of the poses and the
stated bound, mm; at the end, by the error of the odometry, their medians, how many bounds are
finite, and how many errors are within them.

    python benchmarks/odometry.py [--seeds 71 72] [--cameras "old tof"] [--scenes "aisle, ahead"]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

import other_sensor
from fixed_pattern import judged
from tofuse.engine.arrays import Float64
from tofuse.engine.frames.recording import Recording
from tofuse.engine.geometry import se3
from tofuse.engine.graph.external_sensors import OdometryEdges
from tofuse.engine.mapping.adaptation import with_odometry
from tofuse.engine.mapping.methods import from_method
from tofuse.formats.poses import interpolated_poses

NOISE = 0.01  # of lengths and of angles
SLIP_M, SLIP_STEPS = 0.15, 3
ERRORS: dict[str, Callable[[Float64], Float64]] = {
    "none": lambda steps: steps,
    "lengths 2 % long": lambda steps: _scaled(steps, 1.02, 1.0),
    "lengths 5 % short": lambda steps: _scaled(steps, 0.95, 1.0),
    "angles 3 % large": lambda steps: _scaled(steps, 1.0, 1.03),
    "slip of 15 cm": lambda steps: _slipping(steps),
}
LATE, SPARSE = "0.1 s late", "every 2nd pose"


def _scaled(steps: Float64, lengths: float, angles: float) -> Float64:
    """Return motions (K, 4, 4) with these factors on their lengths and angles."""
    out = np.array([se3.exp(np.append(np.zeros(3), angles * se3.log(T)[3:])) for T in steps])
    out[:, :3, 3] = lengths * steps[:, :3, 3]
    return out


def _slipping(steps: Float64) -> Float64:
    out, first = steps.copy(), 2 * len(steps) // 3
    out[first : first + SLIP_STEPS, 2, 3] += SLIP_M / SLIP_STEPS
    return out


def odometry(poses: Float64, error: str, seed: int) -> Float64:
    """Return poses (N, 4, 4) by wheels, one frame apart, given the true ones."""
    rng = np.random.default_rng([seed, 5])
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    length, angle = np.linalg.norm(steps[:, :3, 3], axis=1), se3.angle(steps)
    noise = NOISE * np.repeat(np.stack([length, angle], 1), 3, axis=1)
    steps = steps @ se3.exp(noise * rng.standard_normal((len(steps), 6)))
    out = [np.eye(4)]
    for step in ERRORS.get(error, ERRORS["none"])(steps):
        out.append(out[-1] @ step)
    return np.array(out)


def with_error(recording: Recording, error: str, seed: int) -> Recording:
    """Return a recording with odometry that has this error."""
    assert recording.reference is not None
    times = recording.timestamps
    poses = odometry(recording.reference, error, seed)
    if error == LATE:
        poses = interpolated_poses(times, times + 0.1, poses)
    if error == SPARSE:
        poses = interpolated_poses(times, times[::2], poses[::2])
    return with_odometry(recording, poses)


def main() -> None:
    """Run all, print a row for each and the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seeds", nargs="*", type=int, default=[71, 72])
    parser.add_argument("--cameras", nargs="*", default=["old tof", "azure"])
    parser.add_argument("--scenes", nargs="*", default=["aisle, ahead", "bare room, turn"])
    given = parser.parse_args()
    plain = from_method("default")
    config = replace(plain, priors=(*plain.priors, OdometryEdges()))
    print("| recording | odometry | error, mm: without, with | bound, mm |\n" + "|---" * 4 + "|")
    found: dict[str, list[tuple[tuple[float, float], tuple[float, float]]]] = {}
    for seed in given.seeds:
        for camera in given.cameras:
            for scene in given.scenes:
                recording = other_sensor.record(scene, camera, seed, indirect=False)
                without = judged(recording, plain)
                for error in (*ERRORS, LATE, SPARSE):
                    aided = judged(with_error(recording, error, seed), config)
                    found.setdefault(error, []).append((without, aided))
                    print(
                        f"| {scene}, {camera}, seed {seed} | {error} | {without[0]:.1f}, "
                        f"{aided[0]:.1f} | {without[1]:.1f}, {aided[1]:.1f} |",
                        flush=True,
                    )
    print("\n| odometry | runs | median error, mm: without, with | bounded | within the bound |")
    print("|---" * 5 + "|")
    for error, runs in found.items():
        print(f"| {error} | {len(runs)} | {_by_use(runs)} |")


def _by_use(runs: Sequence[tuple[tuple[float, float], tuple[float, float]]]) -> str:
    errors, bounds = np.array(runs).transpose(2, 1, 0)  # (without and with, runs)
    bounded = np.isfinite(bounds)
    cells = [
        [f"{x:.1f}" for x in np.median(errors, axis=1)],
        [str(x) for x in bounded.sum(1)],
        [str(x) for x in (bounded & (errors <= bounds)).sum(1)],
    ]
    return " | ".join(", ".join(pair) for pair in cells)


if __name__ == "__main__":
    main()
