"""Draws docs/images/speed.png: milliseconds per frame of whole runs by stage, beside peers.

Each argument is a recording, which is run twice, the second time with all kernels compiled; or a
finished result, whose times are taken as they are. The peers' times, of 7-Scenes kitchen, are read
from the tables of docs/evidence.md, so `tracking.py` and `end_to_end.py` should have been run on
the same machine. The line is the time in which its memory moves what fusing a VGA frame reads and
writes.

    python benchmarks/speed_picture.py RECORDING_OR_RESULT ... [--threads 2] [--end 500]
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

from stages import grouped

ROOT = Path(__file__).resolve().parents[1]
PICTURE = ROOT / "docs" / "images" / "speed.png"
EVIDENCE = ROOT / "docs" / "evidence.md"
LIMIT_MS = 5.0
# Rows of the tables: tracking alone, then whole runs.
PEERS = {
    "small_gicp map": "small_gicp, tracking only",
    "Open3D odometry, depth": "Open3D odometry only",
    "KISS-ICP": "KISS-ICP, tracking only",
    "kitchen: Open3D dense SLAM": "Open3D dense SLAM and mesh",
}
COLORS = ("#8a8f98", "#b8a13c", "#3b6fb6", "#5aa0a0", "#2f8f4e", "#c8553d", "#7d5ba6", "#5c4a3d")
OTHER = "#d9d9d9"


def times_of(path: Path, threads: int, end: int | None) -> dict[str, Any]:
    """`run.json` of a result, or of the second run of a recording."""
    if (path / "run.json").is_file():
        return dict(json.loads((path / "run.json").read_text()))
    with tempfile.TemporaryDirectory() as folder:
        words = ["run", path, "--out", f"{folder}/out", "--overwrite", "--threads", threads]
        words += [] if end is None else ["--end", end]
        for _ in range(2):
            command = [sys.executable, "-m", "tofuse", *map(str, words)]
            if subprocess.run(command, capture_output=True).returncode not in (0, 3):
                raise SystemExit(f"{path}: failed")
        return dict(json.loads(Path(folder, "out", "run.json").read_text()))


def peers(text: str) -> Iterator[tuple[str, float]]:
    """Names and ms/frame of the peers in the page of evidence."""
    for row, name in PEERS.items():
        # The first number is that of the frames in the table of whole runs.
        found = re.search(rf"^\| {re.escape(row)}[^|]*\|(?: \d+ \|)? ([\d.]+)", text, re.MULTILINE)
        if found:
            yield name, float(found[1])


def draw(runs: Sequence[tuple[str, dict[str, float]]], others: Sequence[tuple[str, float]]) -> None:
    figure, axes = plt.subplots(figsize=(9, 0.45 * (len(runs) + len(others)) + 1.6))
    rows = range(len(runs))
    left = [0.0] * len(runs)
    for stage, color in zip(runs[0][1], (*COLORS, OTHER), strict=True):
        widths = [run[stage] for _, run in runs]
        axes.barh(rows, widths, left=left, color=color, label=stage, height=0.7)
        left = [a + b for a, b in zip(left, widths, strict=True)]
    places = range(len(runs), len(runs) + len(others))
    axes.barh(places, [ms for _, ms in others], color="#eeeeee", edgecolor="#8a8f98", height=0.7)
    totals = [*left, *(ms for _, ms in others)]
    for k, total in enumerate(totals):
        axes.text(total, k, f" {total:.1f}", va="center", fontsize=9)
    axes.axvline(LIMIT_MS, color="black", linewidth=1, linestyle=":")
    axes.text(LIMIT_MS, -0.75, " limit of memory, VGA", fontsize=8, va="center")
    axes.set_yticks(
        range(len(totals)), [*(name for name, _ in runs), *(name for name, _ in others)]
    )
    axes.set_ylim(len(totals) - 0.5, -1.1)
    axes.set_xlim(0, 1.08 * max(totals))
    axes.set_xlabel("ms per frame, two threads; peers: kitchen, VGA")
    axes.legend(ncols=9, fontsize=8, loc="lower center", bbox_to_anchor=(0.4, 1), frameon=False,
                columnspacing=1.0, handlelength=1.0)  # fmt: skip
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.savefig(PICTURE, dpi=110, bbox_inches="tight")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("inputs", nargs="+", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--end", type=int, help="use only the frames before this one")
    options = parser.parse_args(arguments)
    runs = []
    for path in options.inputs:
        run = times_of(path, options.threads, options.end)
        count = len(run["frames"])
        stages = {name: 1e3 * s / count for name, s in grouped(run["seconds"]).items()}
        runs.append((f"{path.name}, {count} frames", stages))
        print(f"{runs[-1][0]}: " + ", ".join(f"{name} {ms:.1f}" for name, ms in stages.items()))
    draw(runs, list(peers(EVIDENCE.read_text())))


if __name__ == "__main__":
    main()
