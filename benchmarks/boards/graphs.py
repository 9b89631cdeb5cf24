"""Pose graphs: accuracy of optimisers with and without false loops, compared with GTSAM."""

from __future__ import annotations

import importlib.util
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np

import pose_graphs
from boards import Board, Score, default_made
from tofuse.engine.graph.graph import PoseGraph
from tofuse.formats.poses.g2o import read_g2o, write_g2o

SCENES = ("room", "walk")
_GTSAM = "GTSAM"


class Graphs(Board):
    """See `Board`."""

    name = "graphs"
    title = "Pose graphs"
    columns: ClassVar[dict[str, str]] = {
        "noise1": "noise as stated",
        "noise4": "noise x 4",
        "false0.1": "10 % false loops",
        "false0.4": "40 % false loops",
    }

    def methods(self) -> Sequence[str]:
        """See `Board`."""
        ours = [*default_made("optimiser")]
        return [*ours, _GTSAM] if importlib.util.find_spec("gtsam") else ours

    def cases(self, seeds: int) -> Sequence[str]:
        """See `Board`."""
        return [f"{g}/{s}/{k}" for g in self.columns for s in SCENES for k in range(seeds)]

    def run(self, method: str, case: str, data: Path) -> Score | None:
        """See `Board`."""
        group, scene, seed = case.split("/")
        fraction = float(group[5:]) if group.startswith("false") else 0.0
        noise = float(group[5:]) if group.startswith("noise") else 1.0
        graph, truth = pose_graphs.make_graph(scene, 1000 + int(seed), fraction, noise)
        began = time.process_time()
        if method == _GTSAM:
            done, seconds = _gtsam(graph)
        else:
            done = default_made("optimiser")[method].optimise(graph).graph
            seconds = time.process_time() - began
        before = pose_graphs.ate(graph, truth)
        return {"ate": pose_graphs.ate(done, truth), "before": before, "seconds": seconds}

    def cell(self, scores: Sequence[Score]) -> str:
        """See `Board`: median error in mm."""
        return f"{1000 * np.median([s['ate'] for s in scores]):.1f} mm"

    def merit(self, scores: Sequence[Score]) -> float:
        """See `Board`."""
        return -float(np.median([s["ate"] / s["before"] for s in scores]))


def _gtsam(graph: PoseGraph) -> tuple[PoseGraph, float]:
    gtsam = importlib.import_module("gtsam")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "graph.g2o"
        write_g2o(file, graph)
        factors, start = gtsam.readG2o(str(file), True)
        ids = read_g2o(file).ids
    first = int(ids[0])
    factors.add(
        gtsam.PriorFactorPose3(first, start.atPose3(first), gtsam.noiseModel.Constrained.All(6))
    )
    began = time.process_time()
    found = gtsam.LevenbergMarquardtOptimizer(factors, start).optimize()
    seconds = time.process_time() - began
    poses = np.array([found.atPose3(int(k)).matrix() for k in ids])
    return replace(graph, poses=poses), seconds
