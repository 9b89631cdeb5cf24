"""The ground truth that simulated recordings come with."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tofuse.engine.fusion import GeometryRecord
from tofuse.engine.geometry import se3
from tofuse.formats.geometry import write_ply
from tofuse.lab.world import Scene, Sequence


def write_surface(folder: Path, scene: Scene, sequence: Sequence, first: float) -> None:
    """Write surface.ply into a folder, in the world of a recording that begins at `first` s."""
    vertices, faces = scene.truth_mesh()
    vertices = se3.transform(sequence.T_world_truth(first), vertices)
    write_ply(folder / "surface.ply", GeometryRecord(vertices, faces=faces.astype(np.int32)))
