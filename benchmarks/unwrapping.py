"""Phase unwrapping: shares of pixels restored and harmed in a room larger than the camera's period.

    python benchmarks/unwrapping.py [--seeds 5] [--every 15]

A simulated SR4000 (period 5 m) turns around in the scene `hall`, 8 x 8 m, with all its errors, and
in the scene `room`, most of which lies within the period; both also without indirect light. The
correction `unwrap` learns the camera's light from the frames and moves pixels by whole periods.
Printed for each seed: which share of the wrapped pixels is moved back to where it belongs (target
99 %), and which share of the others is moved by mistake (at most 0.1 %). Pixels count whose
measurement is that of one surface: within half a metre of the truth but for whole periods, and with
a confidence of 1 or more.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np

from tofuse.filters.unwrap import Unwrap
from tofuse.geometry.cameras import range_from_z
from tofuse.recordings.frames import RangeFrame
from tofuse.simulation.effects import Effects
from tofuse.simulation.record import plan

PERIOD_M = 5.0
OFF_M = 0.5


@dataclass
class Counts:
    wrapped: int = 0
    restored: int = 0
    good: int = 0
    harmed: int = 0

    def __str__(self) -> str:
        restored = 100 * self.restored / max(self.wrapped, 1)
        harmed = 100 * self.harmed / max(self.good, 1)
        wrapped = 100 * self.wrapped / max(self.wrapped + self.good, 1)
        return f"{wrapped:8.1f} {restored:9.2f} {harmed:8.3f}"


def count(scene: str, effects: Effects, seed: int, every: int) -> Counts:
    made = plan(scene, every=every, seed=seed, effects=effects)
    frames: list[RangeFrame] = []
    truth: list[np.ndarray] = []
    for rendered in made.frames(None):
        frames.append(rendered.frame)
        z = made.model.depth_kind == "z"
        truth.append(range_from_z(rendered.frame.camera, rendered.depth) if z else rendered.depth)
    corrector = Unwrap().learnt(frames).start()
    out = Counts()
    for frame, radial in zip(frames, truth, strict=True):
        lacks = np.rint((radial - frame.radial_range) / PERIOD_M)
        off = np.abs(radial - frame.radial_range - lacks * PERIOD_M)
        sure = frame.valid & (radial > 0) & (off < OFF_M)
        if frame.confidence_image is not None:
            sure &= frame.confidence_image >= 1
        found = corrector.apply(frame)
        assert isinstance(found, RangeFrame)
        moved = np.rint((found.radial_range - frame.radial_range) / PERIOD_M)
        out.wrapped += int((sure & (lacks == 1)).sum())
        out.restored += int((sure & (lacks == 1) & (moved == 1)).sum())
        out.good += int((sure & (lacks == 0)).sum())
        out.harmed += int((sure & (lacks == 0) & (moved != 0)).sum())
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--every", type=int, default=15)
    given = parser.parse_args()
    print(
        f"{'scene':6s} {'indirect':8s} {'seed':>4s} {'wrapped':>8s} {'restored':>9s} {'harmed':>8s}"
    )
    for scene in ("hall", "room"):
        for name, effects in (("yes", Effects()), ("no", Effects().without("multipath"))):
            every = given.every if scene == "hall" else 4 * given.every
            for seed in range(given.seeds):
                counts = count(scene, effects, seed, every)
                print(f"{scene:6s} {name:8s} {seed:4d} {counts}", flush=True)


if __name__ == "__main__":
    main()
