"""The stages of `run.json`, in the groups that tables and pictures show."""

from __future__ import annotations

from collections.abc import Mapping

GROUPS = {
    "start": ("starting", "imports", "kernels", "opening", "inspection"),
    "trials": ("fitting", "trials"),
    "tracking": ("reading", "filters", "tracking"),
    "loops": ("loops", "joining", "optimisation"),
    "refinement": ("refinement",),
    "fusion": ("fusion", "meshing", "texture"),
    "checks": ("checking",),
    "output": ("writing", "report", "exit"),
}


def grouped(seconds: Mapping[str, float]) -> dict[str, float]:
    """Return the seconds of each group, and of the stages of none as "other"."""
    sums = {name: sum(seconds.get(s, 0.0) for s in stages) for name, stages in GROUPS.items()}
    return {**sums, "other": sum(seconds.values()) - sum(sums.values())}
