"""Children of `fork`, after calls in their parent that started threads.

Each scenario runs in a process of its own: some call, then the same or another one in two children
of a pool, which must end.
"""

from __future__ import annotations

import os
import subprocess
import sys

LIMIT_S = 300

_PROGRAM = """
import multiprocessing
import sys
import numpy as np
import tofuse
from made_rooms import at, seen
from tofuse.engine.frames import ArraySource, Recording

def register():
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 1, (3000, 3)) * [3, 2, 0.01]
    points[::2] = points[::2][:, [2, 0, 1]]
    points[::3] = points[::3][:, [0, 2, 1]]
    return tofuse.register(points, points + 0.01).T_target_source.tobytes()

def run():
    frames = [seen(at(0.02 * k, 0.0, 0.03 * k), k) for k in range(3)]
    recording = Recording.of(ArraySource(frames), "frames", "arrays")
    return tofuse.reconstruct(recording, threads=2).trajectory.tobytes()

def from_thread():
    import threading
    found = []
    thread = threading.Thread(target=lambda: found.append(run()))
    thread.start()
    thread.join()
    return found[0]

if __name__ == "__main__":
    parent, child = (globals()[name] for name in sys.argv[1:])
    parent()
    expected = child()
    with multiprocessing.get_context("fork").Pool(2) as pool:
        tasks = [pool.apply_async(child) for _ in range(2)]
        same = [task.get(120) == expected for task in tasks]
    print(same)
"""

# What the parent does first, and then it and its children.
SCENARIOS = (
    ("register", "register"),
    ("register", "run"),
    ("run", "register"),
    ("run", "run"),
    ("from_thread", "run"),
)


def attack(parent: str, child: str) -> str:
    """Run a scenario; return the fault, or nothing."""
    command = [sys.executable, "-W", "ignore", "-c", _PROGRAM, parent, child]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=LIMIT_S, check=False,
            env=_environment(),
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"took more than {LIMIT_S} s"
    if done.stdout != "[True, True]\n":
        lines = done.stderr.splitlines() or [""]
        return f"status {done.returncode}: {done.stdout.strip()} {lines[-1]}"
    return ""


def _environment() -> dict[str, str]:
    """This environment, with the import path of this process."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
