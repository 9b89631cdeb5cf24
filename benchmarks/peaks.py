"""The peaks noise sweep, compared with an independent implementation of the 2010 method.

    python benchmarks/peaks.py [seeds]
    python benchmarks/peaks.py default [seeds]

Prints mean camera position and rotation errors for ten noise levels (20 seeds by default) with
their ratio to the reference, a mean over 3 seeds. Then those of coarse-to-fine registration and of
joint refinement of all views, neither of which is given the loop closure, with the Cramer-Rao bound
for unbiased estimates from the surface alone. Plots all of them: docs/images/peaks.png.

`default` prints, at 0.10 m, the errors of `tofuse run` relative to the true pose of the first
camera, for five seeds (from 101 on) on which no option was tuned; and the 5 to 95 % range of errors
of single recordings for a method that attains the bound.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from tofuse.lab.experiments.peaks import (
    peaks_bound,
    peaks_bound_quantiles,
    reconstruct_peaks,
    refine_peaks,
    sweep_peaks,
)

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "images" / "peaks.png"

# sigma in m: sequential (m, deg), optimised (m, deg)
REFERENCE = {
    0.02: (0.018, 0.11, 0.010, 0.05),
    0.04: (0.254, 1.45, 0.110, 0.42),
    0.06: (0.973, 5.5, 0.410, 1.3),
    0.08: (1.76, 10.0, 0.72, 1.6),
    0.10: (2.86, 16.4, 1.15, 2.7),
}


def whole_runs(seeds: range) -> None:
    """Print the errors of whole runs, and the bound for single recordings."""
    low, median, high = peaks_bound_quantiles(0.10, (0.05, 0.5, 0.95))
    print(f"bound of one recording: median {median:.3f} m, 5 to 95 %: {low:.3f} to {high:.3f} m")
    for seed in seeds:
        errors, posed = reconstruct_peaks(0.10, seed)
        turned = np.degrees(errors.rotation.mean())
        print(f"seed {seed}: {errors.position.mean():.4f} m {turned:.2f} deg, {posed} of 20 views")


def main() -> None:
    if sys.argv[1:2] == ["default"]:
        whole_runs(range(101, 101 + int(sys.argv[2] if len(sys.argv) > 2 else 5)))
        return
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
    print(f"\n{'sigma':>6} {'coarse to fine':>20} {'all views':>20} {'bound':>9} {'ratio':>6}")
    rows = []
    for sigma in sweep.sigmas:
        errors = [refine_peaks(float(sigma), seed) for seed in seeds]
        start, refined = (np.array([e[k].position.mean() for e in errors]) for k in (0, 1))
        turned = np.degrees([e[1].rotation.mean() for e in errors]).mean()
        rows.append((start.mean(), refined.mean(), peaks_bound(float(sigma))))
        print(
            f"{sigma:6.2f} {rows[-1][0]:18.3f} m {rows[-1][1]:9.4f} m {turned:5.2f} deg "
            f"{rows[-1][2]:7.4f} m {rows[-1][1] / rows[-1][2]:5.2f} worst {refined.max():.4f}",
            flush=True,
        )
    draw(sweep.sigmas, sweep.position, np.array(rows))


def draw(sigmas: np.ndarray, thesis: np.ndarray, rows: np.ndarray) -> None:
    """Plot errors (S, 2) of the 2010 method, and (S, 3) of clouds: initial, refined, bound."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    fig, ax = plt.subplots(figsize=(6.4, 3.8), dpi=110, layout="constrained")
    ax.semilogy(sigmas, thesis[:, 0], "o:", color="0.6", label="2010, sequential")
    ax.semilogy(sigmas, thesis[:, 1], "o-", color="0.4", label="2010, optimised, loop given")
    ax.semilogy(sigmas, rows[:, 0], "s:", color="#7aa6d8", label="coarse to fine, sequential")
    ax.semilogy(sigmas, rows[:, 1], "s-", color="#1f5fa8", label="refined over all views")
    ax.semilogy(sigmas, rows[:, 2], "k--", label="Cramér-Rao bound, surface alone")
    ax.set_xlabel("noise per coordinate (m)")
    ax.set_ylabel("mean error of the 20 positions (m)")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
    fig.savefig(PICTURE)


if __name__ == "__main__":
    main()
