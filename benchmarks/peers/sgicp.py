"""small_gicp: each frame against the previous one, and against an incremental voxel map."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from peers import MAX_DEPTH_M, Method, Session
from tofuse.engine.arrays import Float64
from tofuse.engine.frames.frames import RangeFrame

# Each peer is tried with every pair of these; the best on the first frames is used.
_VOXELS_M = (0.02, 0.04, 0.08)
_DISTANCES_M = (0.05, 0.1, 0.3)
_MAP_VOXELS_M = (0.05, 0.1, 0.2)


@dataclass(frozen=True)
class Pairwise:
    """GICP against the previous frame."""

    voxel_m: float
    distance_m: float

    @property
    def label(self) -> str:
        return "small_gicp pairwise"

    @property
    def tuning(self) -> str:
        return f"GICP, correspondences within {100 * self.distance_m:g} cm, start: last motion"

    def resolution(self, frame: RangeFrame) -> str:
        return f"voxels {100 * self.voxel_m:g} cm"

    def start(self, frame: RangeFrame, threads: int) -> Session:
        return _PairSession(self, threads)


@dataclass(frozen=True)
class Map:
    """VGICP against a map of Gaussian voxels."""

    voxel_m: float
    map_voxel_m: float
    distance_m: float = 0.3

    @property
    def label(self) -> str:
        return "small_gicp map"

    @property
    def tuning(self) -> str:
        return (
            f"VGICP, map voxels {100 * self.map_voxel_m:g} cm, correspondences within "
            f"{100 * self.distance_m:g} cm, start: last motion"
        )

    def resolution(self, frame: RangeFrame) -> str:
        return f"voxels {100 * self.voxel_m:g} cm"

    def start(self, frame: RangeFrame, threads: int) -> Session:
        return _MapSession(self, threads)


class _Session:
    def __init__(self, voxel_m: float, threads: int) -> None:
        self._peer = importlib.import_module("small_gicp")
        self._voxel_m = voxel_m
        self._threads = threads
        self._T, self._motion = np.eye(4), np.eye(4)

    def prepare(self, frame: RangeFrame) -> Float64:
        points = frame.points
        return points[points[:, 2] < MAX_DEPTH_M].astype(np.float64)

    def _cloud(self, points: Float64) -> tuple[Any, Any]:
        return self._peer.preprocess_points(
            points, self._voxel_m, num_neighbors=10, num_threads=self._threads
        )


class _PairSession(_Session):
    def __init__(self, options: Pairwise, threads: int) -> None:
        super().__init__(options.voxel_m, threads)
        self._distance_m = options.distance_m
        self._before: tuple[Any, Any] | None = None

    def push(self, prepared: Float64) -> Float64 | None:
        before, self._before = self._before, self._cloud(prepared)
        if before is not None:
            found = self._peer.align(
                before[0],
                self._before[0],
                before[1],
                self._motion,
                registration_type="GICP",
                max_correspondence_distance=self._distance_m,
                num_threads=self._threads,
            )
            self._motion = np.array(found.T_target_source)
            self._T = self._T @ self._motion
        return self._T


class _MapSession(_Session):
    def __init__(self, options: Map, threads: int) -> None:
        super().__init__(options.voxel_m, threads)
        self._distance_m = options.distance_m
        self._map = self._peer.GaussianVoxelMap(options.map_voxel_m)
        self._empty = True

    def push(self, prepared: Float64) -> Float64 | None:
        cloud, _tree = self._cloud(prepared)
        if not self._empty:
            found = self._peer.align(
                self._map,
                cloud,
                self._T @ self._motion,
                max_correspondence_distance=self._distance_m,
                num_threads=self._threads,
            )
            T = np.array(found.T_target_source)
            self._motion = np.linalg.inv(self._T) @ T
            self._T = T
        self._map.insert(cloud, self._T)
        self._empty = False
        return self._T


def methods(frame: RangeFrame) -> list[list[Method]]:
    """See `peers.all_methods`."""
    return [
        [Pairwise(v, d) for v in _VOXELS_M for d in _DISTANCES_M],
        [Map(v, m) for v in _VOXELS_M for m in _MAP_VOXELS_M],
    ]
