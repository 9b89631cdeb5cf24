"""The main model of a result, as programs that show scenes over time need it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np

from tofuse.apps.export.posed_frames import PosedFrame, posed_frames
from tofuse.apps.results import read_cloud, read_mesh, run_json
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.cameras import Pinhole
from tofuse.engine.fusion import GeometryRecord
from tofuse.engine.geometry import se3

# From axes with y up (glTF) to axes with z up (ROS, REP 103).
_R_ZUP_YUP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass(frozen=True, eq=False)
class Scene:
    """The main model of a result, relative to its `shift_of`.

    Attributes
    ----------
    result
        The folder.
    every
        Every n-th of the frames with a pose is read.
    times, indices, poses
        (N,) s, (N,) frame indices and (N, 4, 4) T_world_camera of all frames with a pose.
    T_zup_world
        (4, 4) rotation of the world to axes with z up.
    shift
        (3,) m.
    """

    result: Path
    every: int
    times: Float64
    indices: Intp
    poses: Float64
    T_zup_world: Float64
    shift: Float64

    @classmethod
    def read(cls, result: Path, every: int) -> Self:
        """Read the poses of a result.

        Raises
        ------
        InputError
            If its files are damaged.
        """
        path = result / "run.json"
        with run_json.opened(result) as run:
            indices, poses = run_json.main_poses(result, run)
            times = [float(frame["timestamp"]) for frame in run_json.frames_in_main_model(run)]
            T_zup_world = se3.pose(_R_ZUP_YUP @ run_json.rotation_up_world(run, path))
            shift = run_json.shift_of(run, path)
        rows = np.array(indices, np.intp)
        return cls(result, every, np.array(times), rows, poses, T_zup_world, shift)

    @cached_property
    def cloud(self) -> GeometryRecord:
        """The points."""
        return read_cloud(self.result).shifted(-self.shift)

    @cached_property
    def mesh(self) -> GeometryRecord | None:
        """The surface; None for clouds without a camera."""
        mesh = read_mesh(self.result / "mesh.ply")
        return None if mesh is None else mesh.record().shifted(-self.shift)

    def images(self) -> Iterator[PosedFrame]:
        """Yield the frames as images of a pinhole camera; none of clouds."""
        return posed_frames(
            self.result, self.every, lambda camera: type(camera) is Pinhole, clouds=True
        )
