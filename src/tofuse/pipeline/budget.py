"""How the memory of a run is divided."""

from __future__ import annotations

# Fractions of the total. The rest is the program itself (some 400 MB), frames being processed, what
# stages compute from stored views, and the result.
_VOXELS, _VIEWS = 0.3, 0.05


def voxels_mb(memory_mb: int) -> int:
    """Return the memory of fusion for voxels, MB; see `Fusion.memory_mb`."""
    return max(1, int(_VOXELS * memory_mb))


def views_bytes(memory_mb: int) -> int:
    """Return the memory for the prepared views of loops and refinement, bytes."""
    return int(_VIEWS * memory_mb * 1_000_000)
