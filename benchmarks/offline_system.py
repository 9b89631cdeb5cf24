"""A whole `tofuse run` compared with Open3D's offline reconstruction system: time and ATE.

Both read the same frames of a recording and write a mesh. `peers/o3d_offline.py` describes Open3D's
system and its options; it uses as many processes as tofuse has threads. tofuse runs with its
defaults, after an untimed run to compile; its time is that of the process, including start-up and
report; Open3D's starts at its first frame.

    python benchmarks/offline_system.py [--input kitchen] [--end 1000] [--every 1] [--threads 2]
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from end_to_end import add_options, located, measured, started

TARGET = 25  # times faster


def ours(source: Path, chosen: Sequence[str], threads: int, out: Path) -> tuple[float, float]:
    """Run tofuse; return seconds and peak MB."""
    command = [sys.executable, "-m", "tofuse", "run", str(source), "--out", str(out), *chosen]
    wall, _, peak = measured([*command, "--overwrite", "--threads", str(threads)], (0, 3))
    return wall, peak


def ate(times: Sequence[float], poses: object, recording: object) -> str:
    """Errors of a trajectory as text."""
    import numpy as np

    from tofuse.engine.frames.recording import Recording
    from tofuse.engine.quality.trajectory_errors import evaluate_trajectory

    assert isinstance(recording, Recording)
    if recording.reference is None:
        return "no reference"
    known = np.isfinite(recording.reference[:, 0, 0])
    found = evaluate_trajectory(
        np.asarray(times), poses, recording.timestamps[known], recording.reference[known]
    )
    fraction = len(times) / max(1, len(recording))
    return (
        f"ATE {1e3 * found.ate_rms_m:.1f} mm, {np.degrees(found.rotation_rms_rad):.2f} deg, "
        f"{fraction:.0%} posed"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--input", default="kitchen", help="sequence, or path of a recording")
    add_options(parser)
    parser.add_argument("--fragment", type=int, default=100, help="frames per fragment of Open3D")
    options = parser.parse_args(arguments)
    source = located(options.input, options.data)
    if not source.exists():
        parser.error(f"{source} does not exist")
    chosen = started(options)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "result"
        if not options.no_first:
            ours(source, chosen, options.threads, out)
        seconds, peak = ours(source, chosen, options.threads, out)
        from tofuse.formats.poses.trajectory import read_tum
        from tofuse.formats.recordings.open import open_recording

        recording = open_recording(source).select(options.start, options.end, options.every)
        times, poses = read_tum(out / "trajectory.txt")
        print(f"tofuse run: {len(recording)} frames in {seconds:.1f} s, {peak:.0f} MB")
        print(f"  {ate(times, poses, recording)}", flush=True)
        if importlib.util.find_spec("open3d") is None:
            print("Open3D is not installed")
            return
        from peers.o3d_offline import Selected, System, reconstruct

        system = System(frames_per_fragment=options.fragment)
        selected = Selected(str(source), options.start, options.end, options.every)
        made = reconstruct(system, selected, Path(folder) / "mesh.ply", options.threads)
        total = sum(made.seconds.values())
        print(
            f"Open3D's offline system: {len(made.poses)} frames in {total:.1f} s; "
            f"{made.fragments} fragments, {made.loops} loops between them, "
            f"{made.triangles:,} triangles"
        )
        for name, elapsed in made.seconds.items():
            print(f"  {name:<14}{elapsed:>8.1f} s")
        print(f"  {ate(recording.timestamps[: len(made.poses)].tolist(), made.poses, recording)}")
        print(f"tofuse is {total / seconds:.1f} times faster (target: {TARGET})")


if __name__ == "__main__":
    main()
