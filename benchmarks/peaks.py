"""The peaks noise sweep beside an independent implementation of the 2010 method.

    python benchmarks/peaks.py [seeds]

Prints mean camera position and rotation errors for ten levels of noise (20 seeds unless told
otherwise) with their ratio to the reference, which is a mean over 3 seeds, and the lowest error
that any unbiased method could reach from the surface alone (Cramer-Rao).
"""

from __future__ import annotations

import sys
import time

import numpy as np

from tofuse.experiments.peaks import sweep_peaks

# sigma in m: sequential (m, deg), optimised (m, deg)
REFERENCE = {
    0.02: (0.018, 0.11, 0.010, 0.05),
    0.04: (0.254, 1.45, 0.110, 0.42),
    0.06: (0.973, 5.5, 0.410, 1.3),
    0.08: (1.76, 10.0, 0.72, 1.6),
    0.10: (2.86, 16.4, 1.15, 2.7),
}


def main() -> None:
    seeds = range(int(sys.argv[1]) if len(sys.argv) > 1 else 20)
    start = time.perf_counter()
    sweep = sweep_peaks(seeds)
    print(
        f"peaks, means over 20 cameras and {len(seeds)} seeds ({time.perf_counter() - start:.0f} s)"
    )
    print("ratios in brackets are to the reference; +- is the standard error over the seeds")
    print(f"{'sigma':>6} {'sequential':^42} {'optimised':^42}")
    for k, sigma in enumerate(sweep.sigmas):
        reference = REFERENCE.get(round(float(sigma), 2))
        runs = [run for run in sweep.runs if run.sigma == sigma]
        cells = []
        for which, name in enumerate(("sequential", "optimised")):
            means = [getattr(run, name).position.mean() for run in runs]
            spread = np.std(means) / np.sqrt(max(len(means) - 1, 1))
            values = (sweep.position[k, which], np.degrees(sweep.rotation[k, which]))
            ratios = (
                [f"({v / r:4.2f})" for v, r in zip(values, reference[2 * which :], strict=False)]
                if reference
                else ["      ", "      "]
            )
            cells.append(
                f"{values[0]:7.3f} +-{spread:6.3f} m {ratios[0]} {values[1]:7.2f} deg {ratios[1]}"
            )
        print(f"{sigma:6.2f} {cells[0]:^42} {cells[1]:^42}")


if __name__ == "__main__":
    main()
