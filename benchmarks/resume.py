"""Runs that are killed at random moments: do they go on, with the same bytes?

Each time the same command is started, killed without warning at a random moment, and started once
more. Before that, the output folder must hold a whole result or none; after it, the same files, to
the byte, as those of a run that nobody killed. Also printed: how long the second start took, as a
fraction of a whole run, beside the moment of the kill.

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
# A state is kept often, so that short recordings show what long ones need.
_RUN = """
import sys
from tofuse.cli import main
from tofuse.pipeline import checkpoint
checkpoint._EVERY_S, checkpoint._TIME_FRACTION = float(sys.argv[1]), 1e9
sys.exit(main(sys.argv[2:]))
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--every-s", type=float, default=0.5, help="how often a state is kept")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "out" / "resume")
    arguments = parser.parse_args()
    out: Path = arguments.out
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)

    def start(name: str) -> subprocess.Popen[str]:
        words = ["run", str(arguments.recording), "--out", str(out / name)]
        command = [sys.executable, "-c", _RUN, str(arguments.every_s), *words]
        return subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def finish(name: str) -> tuple[float, str]:
        begun = perf_counter()
        job = start(name)
        _, said = job.communicate()
        if job.returncode not in (0, 3):
            raise SystemExit(f"{name}: status {job.returncode}: {said}")
        return perf_counter() - begun, said

    finish("whole")
    shutil.rmtree(out / "whole")
    seconds, _ = finish("whole")
    wanted = [(out / "whole" / name).read_bytes() for name in SAME]
    names = {p.name for p in (out / "whole").iterdir()}
    print(f"a whole run takes {seconds:.1f} s")
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
        again, said = finish(name)
        same = [(out / name / n).read_bytes() for n in SAME] == wanted
        clean = {p.name for p in (out / name).iterdir()} == names
        good += same and clean
        notes = [line for line in said.splitlines() if "stopped" in line]
        print(
            f"{fraction:5.0%}  {'the same' if same and clean else 'DIFFERS'}, "
            f"in {again / seconds:.0%} of the time{' (moves cut off)' if halves else ''}; "
            f"{'; '.join(notes)}",
            flush=True,
        )
        shutil.rmtree(out / name)
    print(f"{good} of {arguments.kills} the same")


if __name__ == "__main__":
    main()
