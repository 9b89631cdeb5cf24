"""Division of the memory of a run."""

from __future__ import annotations

# Fractions of the total. The remainder is for the program itself (about 400 MB), frames being
# processed, data computed from stored views, and the result.
_VOXELS, _VIEWS, _CHECKED = 0.3, 0.03, 0.005


def voxels_mb(memory_mb: int) -> int:
    """Return the memory of fusion for voxels, MB; see `Fusion.memory_mb`."""
    return max(1, int(_VOXELS * memory_mb))


def checked_bytes(memory_mb: int) -> int:
    """Return the memory for the images of the final comparison, bytes."""
    return int(_CHECKED * memory_mb * 1_000_000)


def views_bytes(memory_mb: int) -> int:
    """Return the memory for the prepared views of loops and refinement, bytes."""
    return int(_VIEWS * memory_mb * 1_000_000)
