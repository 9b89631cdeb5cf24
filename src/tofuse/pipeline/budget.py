"""What the memory of a run is divided into: this is the only place that says so."""

from __future__ import annotations

# Shares of the whole. The rest is the program itself (some 400 MB), the frames at work, what stages
# make of the views that they ask for, and the result.
_VOXELS, _VIEWS = 0.3, 0.15


def voxels_mb(memory_mb: int) -> int:
    """What fusion may take for voxels, MB, see `Fusion.memory_mb`: half as much goes to images."""
    return max(1, int(_VOXELS * memory_mb))


def views_bytes(memory_mb: int) -> int:
    """Of the prepared views that loops and refinement work on, as far as they are in memory."""
    return int(_VIEWS * memory_mb * 1_000_000)
