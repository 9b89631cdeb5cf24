"""Free, occupied and unknown space of a result for planners, and distances from obstacles."""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.apps.export.occupancy import FREE, OCCUPIED, OccupancyGrid
from tofuse.apps.export.scene import Scene
from tofuse.apps.results import reopening, run_json
from tofuse.engine.arrays import Float64
from tofuse.engine.frames import CloudFrame
from tofuse.engine.geometry import se3
from tofuse.engine.mapping import adaptation, clips
from tofuse.formats.export import write_octomap
from tofuse.formats.files import atomic

# Default voxels: at most this number along the diagonal of the model, and of a round size.
_DIAGONAL = 400
_ROUND = (1.0, 2.0, 5.0, 10.0)


def occupancy_grid(scene: Scene, voxel_m: float | None = None) -> OccupancyGrid:
    """Cast rays to all points of the frames of a result, filtered as for the model.

    Parameters
    ----------
    scene
        The result.
    voxel_m
        Voxel size in m; None: a 400th of the model's diagonal, rounded up to 1, 2 or 5 times a
        power of ten.

    Raises
    ------
    InputError
        If the recording is missing or has changed, or the grid would be too large.
    """
    corners = np.concatenate([scene.cloud.points, scene.poses[:, :3, 3]]).astype(float)
    grid = OccupancyGrid.around(corners, voxel_m or _default_voxel(corners))
    rows = slice(None, None, scene.every)
    selected = dict(zip(scene.indices[rows].tolist(), scene.poses[rows], strict=True))
    with run_json.opened(scene.result) as run:
        parts = list(reopening.stored_recordings(scene.result, run))
    numbers = count(1)
    for part in parts:
        recording = reopening.reopen(part, scene.result)
        config = adaptation.adapted(reopening.stored_config(part, scene.result), recording)
        own = [k for k in part.frames if k + part.first in selected]
        for frame in clips.filtered_frames(recording, config, own):
            local = frame.relative_to(scene.shift) if isinstance(frame, CloudFrame) else frame
            T = selected[frame.index + part.first]
            grid.add(
                se3.transform(T, local.points),
                se3.transform(T, local.origin[None])[0],
                next(numbers),
            )
    return grid


def _default_voxel(points: Float64) -> float:
    size = float(np.linalg.norm(np.ptp(points, axis=0))) / _DIAGONAL
    unit = 10.0 ** np.floor(np.log10(size)) if size > 0 else 0.01
    return float(f"{unit * next(r for r in _ROUND if r * unit >= size or r == _ROUND[-1]):.3g}")


@dataclass(frozen=True, eq=False)
class Grid:
    """Writes the grid of a result, which is computed once.

    Attributes
    ----------
    scene
        The result.
    voxel_m
        Voxel size in m; None: see `occupancy_grid`.
    """

    scene: Scene
    voxel_m: float | None

    @cached_property
    def _grid(self) -> OccupancyGrid:
        return occupancy_grid(self.scene, self.voxel_m)

    def write_occupancy(self, path: Path) -> None:
        """Write the states of all voxels."""
        self._write(path, log_odds=self._grid.log_odds)

    def write_esdf(self, path: Path) -> None:
        """Write the signed distances of all voxels from obstacles, besides their states."""
        self._write(path, distance_m=self._grid.distances)

    def write_octomap(self, path: Path) -> None:
        """Write an octree of OctoMap, relative to the `shift_of` the result."""
        states = self._grid.states
        free, occupied = states == FREE, states == OCCUPIED
        write_octomap(path, free, occupied, self._grid.first, self._grid.voxel_m)

    def _write(self, path: Path, **arrays: Any) -> None:
        file = io.BytesIO()
        np.savez_compressed(
            file,
            schema=1,
            origin=self._grid.origin + self.scene.shift,
            voxel_m=self._grid.voxel_m,
            states=self._grid.states,
            T_zup_world=self.scene.T_zup_world,
            **arrays,
        )
        atomic.write_bytes(path, file.getvalue())
