"""The fused cloud: points of all views in one frame, thinned to one per voxel.

Colours of a model for display; black marks points without a colour in any image.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine import quantities
from tofuse.engine.arrays import Bool, Float32, Float64, Int32, Int64, UInt8
from tofuse.engine.compute import thread_count
from tofuse.engine.frames import CloudFrame, Frame, RangeFrame
from tofuse.engine.fusion.geometry_record import Exportable, GeometryRecord
from tofuse.engine.fusion.options import Fusion
from tofuse.engine.geometry import se3

# Displayed colour of points without a colour.
NO_COLOR = (142, 142, 142)


def has_color(colors: UInt8) -> Bool:
    """Return which of the colours (N, 3) are known, (N,): neither black nor the neutral grey."""
    return np.asarray(colors.any(1) & (colors != np.array(NO_COLOR, np.uint8)).any(1), np.bool_)


_BUFFER_ROWS = 2_000_000
_NORMAL_NEIGHBOURS = 12  # points in the plane fit of a normal
_KEY_BITS = 21  # voxels per axis: 2^21, that is 21 km at 1 cm


@dataclass(frozen=True, eq=False)
class Cloud(Exportable):
    """Points in the world frame.

    Attributes
    ----------
    points
        (N, 3) float32 in m.
    normals
        (N, 3) float32 unit normals towards the cameras that observed them, or None.
    color
        (N, 3) uint8 RGB (amplitude as grey where there is no colour), or None.
    views
        (N,) int32, number of frames that observed each point.
    sigma
        (N,) float32 standard deviation of each point along its normal, m; or None.
    """

    points: Float32
    normals: Float32 | None
    color: UInt8 | None
    views: Int32
    sigma: Float32 | None = None

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        return f"Cloud: {quantities.count(len(self), 'point')} over {self.diagonal_m:.3g} m"

    def record(self) -> GeometryRecord:
        """Return points in the world frame, with the other columns of a file."""
        scalars = {"views": self.views} | ({} if self.sigma is None else {"sigma": self.sigma})
        return GeometryRecord(self.points, normals=self.normals, color=self.color, scalars=scalars)

    @cached_property
    def diagonal_m(self) -> float:
        """Diagonal of the box without stray points (`_EXTENT`), m; 0 without points."""
        return float(np.linalg.norm(_extent(self.points))) if len(self) else 0.0


# Percentiles that bound a cloud, whatever stray points it has.
_EXTENT = (0.5, 99.5)


def _extent(points: Float32) -> Float64:
    """Edges (3,) of the box, m."""
    # One axis at a time, which takes a third of the time.
    low, high = np.transpose([np.percentile(axis, _EXTENT) for axis in points.T.astype(float)])
    return np.asarray(high - low)


def choose_voxel(frame: CloudFrame) -> float:
    """Return a voxel edge in m for the point spacing of a cloud: 2 mm to 10 cm."""
    points = frame.points
    if len(points) == 0:
        return 0.01
    # The spacing of N points on a surface is about the root of the area over N.
    extent = np.sort(_extent(points))
    size = float(np.sqrt(max(extent[2] * extent[1], 1e-6) / len(points)))
    return float(f"{np.clip(size, 0.002, 0.1):.2g}")


@dataclass
class CloudBuilder:
    """Averages views in voxels; memory grows with the surface, not with the number of frames."""

    config: Fusion
    voxel_m: float
    _keys: list[Int64] = field(default_factory=list)
    _sums: list[Float64] = field(default_factory=list)
    _rows: int = 0

    def add(self, frame: Frame, T_world_camera: Float64) -> None:
        """Add a (filtered) view at its pose."""
        if len(frame) == 0:
            return
        world = se3.transform(T_world_camera, frame.points.astype(float))
        to_camera = (T_world_camera[:3, :3] @ frame.origin + T_world_camera[:3, 3]) - world
        distance = np.maximum(np.linalg.norm(to_camera, axis=1, keepdims=True), 1e-9)
        rows = np.zeros((len(world), 13))
        rows[:, 0:3] = world
        rows[:, 3:6] = to_camera / distance
        rows[:, 6] = 1
        if frame.color is not None:
            # Black: the colour camera didn't see the point.
            rows[:, 7:10] = frame.color
            rows[:, 10] = frame.color.any(1)
        elif frame.amplitude is not None:
            # Compensated for the falloff with the squared range: proportional to the albedo.
            rows[:, 11] = _raw_amplitude(frame) * distance[:, 0] ** 2
            rows[:, 12] = 1
        keys = _voxel_keys(world, self.voxel_m)
        keys, sums = _sum_by_key(keys, rows)
        # Equal weight for each frame, however many pixels it has in the voxel.
        sums /= sums[:, 6:7].copy()
        self._keys.append(keys)
        self._sums.append(sums)
        self._rows += len(keys)
        if self._rows > _BUFFER_ROWS:
            self._merge()

    def _merge(self) -> None:
        keys, sums = _sum_by_key(np.concatenate(self._keys), np.concatenate(self._sums))
        self._keys, self._sums = [keys], [sums]
        # The buffer grows with the model, or a large model would be merged at every frame.
        self._rows = 0 if len(keys) > _BUFFER_ROWS // 2 else len(keys)

    def finish(self, *, normals: bool = True) -> Cloud:
        """Return the cloud, with or without `normals`; its order depends on the voxels alone."""
        if not self._keys:
            return empty_cloud()
        self._merge()
        sums = self._sums[0]
        sums = sums[sums[:, 6] >= self.config.min_views]
        if len(sums) == 0:
            return empty_cloud()
        views = sums[:, 6]
        points = sums[:, 0:3] / views[:, None]
        return Cloud(
            points.astype(np.float32),
            _estimate_normals(points, sums[:, 3:6], _NORMAL_NEIGHBOURS) if normals else None,
            _colors(sums),
            np.round(views).astype(np.int32),
        )


def empty_cloud() -> Cloud:
    """Return a cloud without points."""
    return Cloud(np.zeros((0, 3), np.float32), None, None, np.zeros(0, np.int32))


def as_cloud(frame: Frame, max_points: int) -> CloudFrame:
    """Return the view as a cloud of at most `max_points` points, taken at an even stride.

    Its amplitude is not range-compensated, even if that of the view is.
    """
    stride = slice(None, None, max(1, -(-len(frame) // max_points)))
    amplitude = None if frame.amplitude is None else _raw_amplitude(frame)

    def subsampled(values: NDArray[Any] | None) -> Any:
        return None if values is None else values[stride].copy()

    return CloudFrame(
        frame.index,
        frame.timestamp,
        subsampled(frame.points),
        subsampled(frame.normals),
        subsampled(frame.sigma),
        subsampled(amplitude),
        subsampled(frame.color),
        frame.origin,
    )


def _raw_amplitude(frame: Frame) -> Float32:
    """Return the amplitude (N,) without range compensation."""
    amplitude = frame.amplitude
    assert amplitude is not None
    if isinstance(frame, RangeFrame) and frame.amplitude_kind == "range_compensated":
        squared_range = np.einsum("ni,ni->n", frame.points, frame.points)
        return (amplitude / np.maximum(squared_range, 1e-6)).astype(np.float32)
    return amplitude


def _voxel_keys(points: Float64, voxel: float) -> Int64:
    half = 1 << (_KEY_BITS - 1)
    ijk = np.clip(np.floor(points / voxel), -half, half - 1).astype(np.int64) + half
    return (ijk[:, 0] << 2 * _KEY_BITS) | (ijk[:, 1] << _KEY_BITS) | ijk[:, 2]


def _sum_by_key(keys: Int64, rows: Float64) -> tuple[Int64, Float64]:
    order = np.argsort(keys, kind="stable")
    keys, rows = keys[order], rows[order]
    starts = np.flatnonzero(np.r_[True, keys[1:] != keys[:-1]])
    return keys[starts], np.add.reduceat(rows, starts, axis=0)


def _colors(sums: Float64) -> UInt8 | None:
    rgb, grey = sums[:, 10] > 0, sums[:, 12] > 0
    if not (rgb.any() or grey.any()):
        return None
    colors = np.full((len(sums), 3), 128, np.uint8)
    colors[rgb] = np.round(sums[rgb, 7:10] / sums[rgb, 10:11]).clip(0, 255).astype(np.uint8)
    grey &= ~rgb
    if grey.any():
        colors[grey] = grey_of(sums[grey, 11] / sums[grey, 12])
    return colors


def grey_of(albedo: Float64) -> UInt8:
    """Return grey colours (N, 3) of albedos (N,) in any unit; none is black, which is no colour."""
    if len(albedo) == 0:
        return np.zeros((0, 3), np.uint8)
    low, high = np.percentile(albedo, [1, 99])
    # Gamma 1/2.2: albedo is linear, screens are not.
    grey = ((albedo - low) / max(high - low, 1e-12)).clip(0, 1) ** (1 / 2.2)
    return np.repeat(np.maximum(np.round(255 * grey), 1).astype(np.uint8)[:, None], 3, axis=1)


def _estimate_normals(points: Float64, to_camera: Float64, neighbours: int) -> Float32 | None:
    from scipy.spatial import cKDTree

    k = min(neighbours, len(points))
    if k < 3:
        return None
    _, rows = cKDTree(points).query(points, k=k, workers=thread_count())
    out = np.empty((len(points), 3), np.float32)
    for start in range(0, len(points), 50_000):  # bounds the memory of the gathered neighbours
        chunk = slice(start, start + 50_000)
        neighbourhood = points[rows[chunk]]
        neighbourhood = neighbourhood - neighbourhood.mean(1, keepdims=True)
        _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", neighbourhood, neighbourhood))
        normal = vectors[..., 0]
        sign = np.where((normal * to_camera[chunk]).sum(1) < 0, -1.0, 1.0)
        out[chunk] = normal * sign[:, None]
    return out
