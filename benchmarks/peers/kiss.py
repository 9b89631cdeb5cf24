"""KISS-ICP with voxel sizes for indoor scenes."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from peers import MAX_DEPTH_M, Method, Session
from tofuse.engine.arrays import Float64
from tofuse.engine.frames.frames import RangeFrame

_VOXELS_M = (0.05, 0.1)
_THRESHOLDS_M = (0.1, 0.5)


@dataclass(frozen=True)
class KissIcp:
    """Point-to-point ICP against a voxel map, with an adaptive threshold."""

    voxel_m: float
    threshold_m: float

    @property
    def label(self) -> str:
        return "KISS-ICP"

    @property
    def tuning(self) -> str:
        return (
            f"initial threshold {100 * self.threshold_m:g} cm, minimum motion 1 cm, no deskewing, "
            "start: last motion"
        )

    def resolution(self, frame: RangeFrame) -> str:
        return f"voxels {100 * self.voxel_m:g} cm"

    def start(self, frame: RangeFrame, threads: int) -> Session:
        return _KissSession(self, threads)


class _KissSession:
    def __init__(self, options: KissIcp, threads: int) -> None:
        module = importlib.import_module("kiss_icp.kiss_icp")
        config = importlib.import_module("kiss_icp.config").KISSConfig()
        config.data.deskew = False
        config.data.max_range = 2 * MAX_DEPTH_M
        config.mapping.voxel_size = options.voxel_m
        config.registration.max_num_threads = threads
        config.adaptive_threshold.initial_threshold = options.threshold_m
        config.adaptive_threshold.min_motion_th = 0.01
        self._peer = module.KissICP(config)

    def prepare(self, frame: RangeFrame) -> Float64:
        points = frame.points
        return points[points[:, 2] < MAX_DEPTH_M].astype(np.float64)

    def push(self, prepared: Any) -> Float64 | None:
        self._peer.register_frame(prepared, np.zeros(len(prepared)))
        return np.array(self._peer.last_pose)


def methods(frame: RangeFrame) -> list[list[Method]]:
    """See `peers.all_methods`."""
    return [[KissIcp(v, t) for v in _VOXELS_M for t in _THRESHOLDS_M]]
