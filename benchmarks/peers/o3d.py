"""Open3D: frame-to-frame tensor odometry, and frame-to-model dense SLAM."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from peers import MAX_DEPTH_M, Method, PinholeImages, Session, grid
from tofuse.engine.arrays import Float64, Int64, UInt8
from tofuse.engine.frames.frames import SATURATED_AMPLITUDE, RangeFrame

# Counts per metre: 0.2 mm, so that rounding is far below the noise of any camera.
_SCALE = 5000.0


@dataclass(frozen=True)
class Odometry:
    """Multi-scale RGB-D odometry against the previous frame."""

    hybrid: str = ""  # "color", "amplitude", or nothing: depth only
    iterations: tuple[int, ...] = (10, 5, 3)

    @property
    def label(self) -> str:
        return f"Open3D odometry, {f'depth and {self.hybrid}' if self.hybrid else 'depth'}"

    @property
    def tuning(self) -> str:
        method = "hybrid" if self.hybrid else "point to plane"
        return f"{method}, iterations {self.iterations}, start: identity"

    def resolution(self, frame: RangeFrame) -> str:
        return f"{grid(frame)} and {len(self.iterations) - 1} halvings"

    def start(self, frame: RangeFrame, threads: int) -> Session:
        return _OdometrySession(self, frame)


@dataclass(frozen=True)
class DenseSlam:
    """Frame-to-model tracking: TSDF volume, ray casting, point-to-plane ICP."""

    voxel_m: float = 0.01
    iterations: tuple[int, ...] = (6, 3, 1)

    @property
    def label(self) -> str:
        return "Open3D dense SLAM"

    @property
    def tuning(self) -> str:
        return (
            f"voxels {100 * self.voxel_m:g} cm, iterations {self.iterations}, truncation 8 voxels"
        )

    def resolution(self, frame: RangeFrame) -> str:
        return f"{grid(frame)}, {100 * self.voxel_m:g} cm"

    def start(self, frame: RangeFrame, threads: int) -> _DenseSession:
        return _DenseSession(self, frame)


class _Images:
    def __init__(self, frame: RangeFrame) -> None:
        self.o3d = importlib.import_module("open3d")
        self.o3d.utility.set_verbosity_level(self.o3d.utility.VerbosityLevel.Error)
        self.images = PinholeImages(frame.camera)
        p = self.images.pinhole
        K = np.array([[p.fx, 0, p.cx], [0, p.fy, p.cy], [0, 0, 1.0]])
        self.K = self.o3d.core.Tensor(K)

    def depth(self, frame: RangeFrame) -> Any:
        z = self.images.take(frame.z)
        z = np.where(z < MAX_DEPTH_M, z, 0)
        return self.o3d.t.geometry.Image(np.round(z * _SCALE).astype(np.uint16))

    def color(self, frame: RangeFrame, kind: str) -> Any:
        shape = (*frame.depth.shape, 3)
        rgb: UInt8 = np.zeros(shape, np.uint8)
        if kind == "color" and frame.color_image is not None:
            rgb = self.images.take(frame.color_image)
        elif kind == "amplitude":
            rgb = np.repeat(self.images.take(_grey(frame))[..., None], 3, -1)
        return self.o3d.t.geometry.Image(np.ascontiguousarray(rgb))


class _OdometrySession:
    def __init__(self, options: Odometry, frame: RangeFrame) -> None:
        self._images = _Images(frame)
        self._options = options
        self._before: Any = None
        self._T = np.eye(4)
        o = self._images.o3d.t.pipelines.odometry
        self._method = o.Method.Hybrid if options.hybrid else o.Method.PointToPlane
        self._criteria = [o.OdometryConvergenceCriteria(n) for n in options.iterations]
        self._start = self._images.o3d.core.Tensor(np.eye(4))
        self._run = o.rgbd_odometry_multi_scale

    def prepare(self, frame: RangeFrame) -> Any:
        images = self._images
        color = images.color(frame, self._options.hybrid)
        return images.o3d.t.geometry.RGBDImage(color, images.depth(frame))

    def push(self, prepared: Any) -> Float64 | None:
        before, self._before = self._before, prepared
        if before is not None:
            try:
                found = self._run(
                    prepared,
                    before,
                    self._images.K,
                    self._start,
                    _SCALE,
                    MAX_DEPTH_M,
                    self._criteria,
                    self._method,
                )
            except RuntimeError:  # too little overlap
                return None
            self._T = self._T @ found.transformation.numpy()
        return self._T


class _DenseSession:
    def __init__(self, options: DenseSlam, frame: RangeFrame) -> None:
        self._images = _Images(frame)
        self._options = options
        o3d = self._images.o3d
        device = o3d.core.Device("CPU:0")
        camera = self._images.images.pinhole
        self._T = np.eye(4)
        self._model = o3d.t.pipelines.slam.Model(
            options.voxel_m, 16, 10000, o3d.core.Tensor(self._T), device
        )
        size = (camera.height, camera.width)
        self._input = o3d.t.pipelines.slam.Frame(*size, self._images.K, device)
        self._cast = o3d.t.pipelines.slam.Frame(*size, self._images.K, device)
        o = o3d.t.pipelines.odometry
        self._method = o.Method.PointToPlane
        self._criteria = [o.OdometryConvergenceCriteria(n) for n in options.iterations]
        self._index = 0

    def prepare(self, frame: RangeFrame) -> Any:
        return self._images.depth(frame), self._images.color(frame, "")

    def push(self, prepared: Any) -> Float64 | None:
        depth, color = prepared
        self._input.set_data_from_image("depth", depth)
        self._input.set_data_from_image("color", color)
        if self._index:
            try:
                found = self._model.track_frame_to_model(
                    self._input, self._cast, _SCALE, MAX_DEPTH_M, 0.07, self._method, self._criteria
                )
            except RuntimeError:  # too little overlap
                return None
            self._T = self._T @ found.transformation.numpy()
        self._model.update_frame_pose(self._index, self._images.o3d.core.Tensor(self._T))
        self._model.integrate(self._input, _SCALE, MAX_DEPTH_M, 8.0)
        self._model.synthesize_model_frame(self._cast, _SCALE, 0.1, MAX_DEPTH_M, 8.0, False)
        self._index += 1
        return self._T

    def write_mesh(self, path: Path) -> None:
        """Write the surface fused so far as PLY."""
        mesh = self._model.voxel_grid.extract_triangle_mesh()
        self._images.o3d.io.write_triangle_mesh(str(path), mesh.to_legacy())


def fused(
    frames: Sequence[RangeFrame], poses: Float64, voxel_m: float, min_weight: float
) -> tuple[Float64, Int64]:
    """Vertices and faces of Open3D's TSDF fusion at given poses (N, 4, 4).

    Truncation is 8 voxels, its default; `min_weight` is the weight, one per view, from which
    surfaces are extracted.
    """
    images = _Images(frames[0])
    o3d = images.o3d
    kinds = (o3d.core.float32, o3d.core.float32)
    # With smaller blocks, or fewer initial ones, its allocator fails.
    volume = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), kinds, ((1), (1)), voxel_m, 16, 50000, o3d.core.Device("CPU:0")
    )
    for frame, T_world_camera in zip(frames, poses, strict=True):
        depth = images.depth(frame)
        seen_from = (images.K, o3d.core.Tensor(np.linalg.inv(T_world_camera)), _SCALE, MAX_DEPTH_M)
        blocks = volume.compute_unique_block_coordinates(depth, *seen_from, 8.0)
        volume.integrate(blocks, depth, *seen_from, 8.0)
    mesh = volume.extract_triangle_mesh(min_weight).to_legacy()
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles, np.int64)


def _grey(frame: RangeFrame) -> UInt8:
    """Range-compensated amplitude, 0 to 255, with the median at 100."""
    amplitude = frame.amplitude_image
    assert amplitude is not None
    amplitude = np.where((amplitude < SATURATED_AMPLITUDE) & frame.valid, amplitude, 0).astype(
        np.float32
    )
    if frame.amplitude_kind == "raw":
        amplitude = amplitude * frame.radial_range**2
    positive = amplitude[amplitude > 0]
    scale = 100 / np.median(positive) if len(positive) else 1.0
    return np.clip(amplitude * scale, 0, 255).astype(np.uint8)


def methods(frame: RangeFrame) -> list[list[Method]]:
    """See `peers.all_methods`."""
    found: list[list[Method]] = [[Odometry()]]
    if frame.color_image is not None:
        found.append([Odometry("color")])
    if frame.amplitude_image is not None:
        found.append([Odometry("amplitude")])
    return [*found, [DenseSlam()]]
