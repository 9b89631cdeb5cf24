"""Small results, and contents of a folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tofuse.engine.fusion.cloud import empty_cloud
from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import PoseGraph
from tofuse.engine.results.types import Component, Diagnostics, FrameRecord, Reason, Reconstruction


def result(seed=0) -> Reconstruction:
    trajectory = np.stack([np.eye(4), np.full((4, 4), np.nan)])
    graph = replace(PoseGraph.empty(), ids=np.array([0]), poses=np.eye(4)[None])
    frames = (
        FrameRecord(0, 0.0, "tracked", "", 0.5, None, np.float32(0.25), np.eye(6), np.ones((2, 6))),
        FrameRecord(1, 0.1, "lost", "no points", 0.0, float("nan"), float("inf")),
    )
    reasons = (Reason("lost_frames", ((1, 1),), "Frame 1 has no pose."),)
    found = (reasons, frames, (), trajectory, (), {"median": 0.25}, {"tracking": 0.123456})
    diagnostics = Diagnostics("degraded", *found)
    recording = {"path": "/somewhere", "format": "native", "frames": 2, "warnings": ["w"]}
    made = (trajectory, np.array([0.0, 0.1]), graph, empty_cloud(), diagnostics)
    return Reconstruction(*made, {"method": "default"}, recording, seed, 2)


def torn(seed=0, parts=2) -> Reconstruction:
    """Four frames: one in the main model, one linked to it, one apart and one lost.

    Of the components apart the first has a model of its own, if there are `parts` that do.
    """
    whole = result(seed)
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[2:] = np.nan
    states = (("tracked", 0), ("tracked", 1), ("tracked", 2), ("lost", None))
    frames = tuple(FrameRecord(k, 0.1 * k, s, component=c) for k, (s, c) in enumerate(states))
    T = se3.translation([0.5, 0, 0])
    components = (
        Component(((0, 0),), np.eye(4), None),
        Component(((1, 1),), T, "links"),
        Component(((2, 2),), None, None, result(seed) if parts > 1 else None),
    )
    diagnostics = replace(whole.diagnostics, frames=frames, sequential=poses)
    posed = {"trajectory": poses, "timestamps": 0.1 * np.arange(4), "diagnostics": diagnostics}
    return replace(whole, **posed, components=components)


def contents(folder: Path) -> dict[str, bytes]:
    files = (p for p in folder.rglob("*") if p.is_file())
    shown = (p for p in files if not p.name.startswith(".tofuse-lock"))
    return {str(p.relative_to(folder)): p.read_bytes() for p in shown}
