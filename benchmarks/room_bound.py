"""Whole reconstructions of a simulated room, compared with the Cramer-Rao bound.

    python benchmarks/room_bound.py [--scene room] [--seeds 1] [--effects noise]

`noise` has shot noise, mixed pixels and phase wraps; `direct` has all errors except multipath.
Printed are the ATE (rms, after rigid alignment) of the tracker and of the final poses, and its
Cramer-Rao bound with an unknown surface, from distances alone and with albedo
(`lab/experiments/recording_bound.py`), with the 5 to 95 % range for single recordings; and the
ratio of the final error to both.
"""

from __future__ import annotations

import argparse

import numpy as np

from tofuse.engine.mapping.methods import default
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.engine.quality.trajectory_errors import evaluate_trajectory
from tofuse.lab.experiments.recording_bound import trajectory_bounds
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.record import plan, simulate_recording

EFFECTS = {
    "noise": Effects.none(shot_noise=True, ambient=1.0, mixed_pixels=True, wrap=True),
    "direct": Effects().without("multipath"),
}


def main() -> None:
    """Print a line for each recording."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="room")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--effects", nargs="+", choices=list(EFFECTS), default=list(EFFECTS))
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    for name in args.effects:
        for seed in range(args.seeds):
            _case(args.scene, name, seed, args.threads)


def _case(scene: str, name: str, seed: int, threads: int) -> None:
    effects = EFFECTS[name]
    bounds = trajectory_bounds(plan(scene, seed=seed, effects=effects))
    recording = simulate_recording(scene, seed=seed, effects=effects)
    result = reconstruct(recording, default("range"), threads=threads)
    truth = recording.reference
    assert truth is not None
    times = np.arange(len(truth), dtype=float)
    tracker, final = (
        evaluate_trajectory(times, poses, times, truth).ate_rms_m * 1e3
        for poses in (result.diagnostics.sequential, result.trajectory)
    )
    texts = [f"{1e3 * b.mean:.2f} ({1e3 * b.low:.2f} to {1e3 * b.high:.2f})" for b in bounds]
    ratios = [f"{final / (1e3 * b.mean):.2f}" for b in bounds]
    print(
        f"{scene} {name} seed {seed}: tracker {tracker:.2f} mm, final {final:.2f} mm; bound, "
        f"distances {texts[0]} mm, with albedo {texts[1]} mm; ratio {ratios[0]}, {ratios[1]}",
        flush=True,
    )


if __name__ == "__main__":
    main()
