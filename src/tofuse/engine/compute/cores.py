"""Number of cores that this process may use, by CPU affinity and control-group quota."""

from __future__ import annotations

import math
import os
from functools import cache
from pathlib import Path


@cache
def usable_cores() -> int:
    """Return the number of threads that can run at once, by affinity and quota."""
    allowed = quota()
    return max(1, _affinity() if allowed is None else min(_affinity(), math.ceil(allowed)))


def _affinity() -> int:
    """Return the number of cores that this process may be scheduled on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def quota(root: Path = Path("/")) -> float | None:
    """Return the CPU quota of this process's control groups, in cores; None without a limit.

    Parameters
    ----------
    root
        Root of the file system.
    """
    limits = [limit for folder in _groups(root) if (limit := _limit(folder)) is not None]
    return min(limits, default=None)


def _groups(root: Path) -> list[Path]:
    """Return the folders of this process's control groups (v1 and v2) and of their parents."""
    mount = root / "sys/fs/cgroup"
    found: list[Path] = []
    for line in _read(root / "proc/self/cgroup").splitlines():
        hierarchy, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if hierarchy == "0" and not controllers:
            top = mount
        elif "cpu" in controllers.split(","):
            top = mount / "cpu"
        else:
            continue
        parts = [part for part in path.split("/") if part not in ("", ".", "..")]
        # In a container the path may be the host's, while the mount is the container's.
        found += [top.joinpath(*parts[:k]) for k in range(len(parts) + 1)]
    return found


def _limit(folder: Path) -> float | None:
    words = _read(folder / "cpu.max").split() or [
        *_read(folder / "cpu.cfs_quota_us").split(),
        *_read(folder / "cpu.cfs_period_us").split(),
    ]
    try:
        time, period = (float(word) for word in words)
    except ValueError:  # "max", or nothing
        return None
    return time / period if time > 0 and period > 0 else None


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii")
    except (OSError, ValueError):
        return ""
