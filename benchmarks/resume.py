"""Runs that are killed at random moments: do they resume, with identical results?

A command is started, killed by SIGKILL at a random moment, and started again. After the kill, the
output folder must contain a complete result or none; after the second start, files identical byte
by byte to those of an uninterrupted run. Also printed: the moment of the kill and the time of the
second run, as fractions of an uninterrupted one.

    python benchmarks/resume.py RECORDING --kills 20
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path
from time import perf_counter, sleep

import numpy as np

SAME = ("trajectory.txt", "pose_graph.g2o", "cloud.ply", "mesh.ply", "mesh.glb")
# Checkpoint often, so that short recordings have several checkpoints as long ones do.
_RUN = """
import sys
from tofuse.cli import main
from tofuse.pipeline import checkpoint
checkpoint._INTERVAL_S, checkpoint._TIME_FRACTION = float(sys.argv[1]), 1e9
sys.exit(main(sys.argv[2:]))
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--every-s", type=float, default=0.5, help="interval of checkpoints")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "out" / "resume")
    arguments = parser.parse_args()
    out: Path = arguments.out
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)

    def start(name: str) -> subprocess.Popen[str]:
        args = ["run", str(arguments.recording), "--out", str(out / name)]
        command = [sys.executable, "-c", _RUN, str(arguments.every_s), *args]
        return subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def finish(name: str) -> tuple[float, str]:
        begun = perf_counter()
        job = start(name)
        _, stderr = job.communicate()
        if job.returncode not in (0, 3):
            raise SystemExit(f"{name}: status {job.returncode}: {stderr}")
        return perf_counter() - begun, stderr

    finish("whole")
    shutil.rmtree(out / "whole")
    seconds, _ = finish("whole")
    wanted = [(out / "whole" / name).read_bytes() for name in SAME]
    names = {p.name for p in (out / "whole").iterdir()}
    print(f"an uninterrupted run takes {seconds:.1f} s")
    rng = np.random.default_rng(arguments.seed)
    good = 0
    for k, fraction in enumerate(np.sort(rng.random(arguments.kills))):
        name = f"{k:02d}"
        job = start(name)
        sleep(fraction * seconds)
        job.kill()
        job.communicate()
        left = {p.name for p in (out / name).glob("*") if not p.name.startswith(".tofuse-")}
        halves = bool(left) and left != names
        if left == names:
            print(f"{fraction:5.0%}  had finished")
            good += [(out / name / n).read_bytes() for n in SAME] == wanted
            continue
        again, stderr = finish(name)
        same = [(out / name / n).read_bytes() for n in SAME] == wanted
        clean = {p.name for p in (out / name).iterdir()} == names
        good += same and clean
        notes = [line for line in stderr.splitlines() if "stopped" in line]
        print(
            f"{fraction:5.0%}  {'identical' if same and clean else 'DIFFERS'}, "
            f"in {again / seconds:.0%} of the time"
            f"{' (killed while moving files)' if halves else ''}; "
            f"{'; '.join(notes)}",
            flush=True,
        )
        shutil.rmtree(out / name)
    print(f"{good} of {arguments.kills} identical")


if __name__ == "__main__":
    main()
