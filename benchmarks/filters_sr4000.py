"""Temporal noise of a real SR4000 before and after each filter.

    python benchmarks/filters_sr4000.py [folder of sr4000_corridor]

The camera is static at each position, so the standard deviation of z over the frames there is
noise. It is computed for pixels that a filter keeps in every frame of the position. The temporal
filter is evaluated on the frames that it filters.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tofuse.engine.filters.base import Filter, apply_filters
from tofuse.engine.filters.outliers import NeighbourFraction, NeighbourhoodAngle
from tofuse.engine.filters.thresholds import Confidence, Distance
from tofuse.engine.frames.frames import RangeFrame
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.methods.filters_amplitude import Amplitude
from tofuse.lab.methods.filters_median import Median
from tofuse.lab.methods.filters_neighbour_distance import NeighbourDistance
from tofuse.lab.methods.filters_temporal import TemporalDeviation, z_deviation

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "sr4000_corridor"

CASES: dict[str, list[Filter]] = {
    "no filter": [],
    **{f"confidence {level}": [Confidence(level)] for level in range(1, 8)},
    "amplitude over 500": [Amplitude(500.0)],
    "distance 0.5 to 4 m": [Distance(0.5, 4.0)],
    "neighbourhood angle 170 deg": [NeighbourhoodAngle()],
    "median 5 x 5, 0.1 m": [Median()],
    "neighbour distance 0.05 m": [NeighbourDistance()],
    "neighbour fraction 0.5": [NeighbourFraction()],
    "temporal 25 mm": [TemporalDeviation()],
    "chapter 4: confidence 7, fraction 0.5": [Confidence(), NeighbourFraction()],
    "figure 3.2 d: temporal, fraction 0.5": [TemporalDeviation(), NeighbourFraction()],
}


@dataclass(frozen=True)
class Noise:
    """Noise of the pixels kept in all frames: median and rms deviation in m, and their fraction."""

    median_m: float
    rms_m: float
    kept: float


def temporal_noise(positions: Sequence[Sequence[RangeFrame]], filters: Sequence[Filter]) -> Noise:
    """Pool the temporal standard deviation of z over static frames at several positions."""
    deviations, seen = [], 0
    for frames in positions:
        kept = np.all([f.valid for f in frames], axis=0)
        seen += int(kept.sum())
        for k, frame in enumerate(frames):
            # The other frames serve as history, as the first frames have none.
            others = [*frames[k + 1 :], *frames[:k]]
            kept &= apply_filters(filters, frame, others)[0].valid
        deviations.append(z_deviation([f.z for f in frames])[kept])
    pooled = np.concatenate(deviations)
    if len(pooled) == 0:
        return Noise(np.nan, np.nan, 0.0)
    return Noise(
        float(np.median(pooled)), float(np.sqrt((pooled**2).mean())), len(pooled) / max(seen, 1)
    )


def still_frames(folder: Path) -> list[list[RangeFrame]]:
    """Frames of each position of the corridor."""
    return [
        [frame for frame in open_recording(folder / name) if isinstance(frame, RangeFrame)]
        for name in ("Y1", "Y2")
    ]


def main() -> None:
    positions = still_frames(Path(sys.argv[1]) if len(sys.argv) > 1 else DATA)
    before = temporal_noise(positions, [])
    print(f"{'':36}{'median':>9}{'rms':>9}{'kept':>8}{'median reduced':>16}")
    for name, filters in CASES.items():
        noise = temporal_noise(positions, filters)
        lowered = before.median_m / noise.median_m
        print(
            f"{name:36}{noise.median_m * 1e3:6.1f} mm{noise.rms_m * 1e3:6.0f} mm"
            f"{noise.kept:8.1%}{lowered:14.2f} x"
        )


if __name__ == "__main__":
    main()
