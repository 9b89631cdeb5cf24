"""The layout of the volume: blocks near surfaces, and regions of them that fit into memory.

The blocks of all views are laid out first, so that their order depends on the surfaces alone. If
they exceed the memory, they are bisected recursively into boxes, which are fused one at a time. One
layer of blocks around a box is fused with it: cells of the surface extend into the adjacent block
and no farther, so the surface of the box's cells is the same as if all blocks were fused jointly.

View frusta: which views can affect a box of space.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64, Int32, Int64
from tofuse.engine.compute import run_chunks
from tofuse.engine.fusion.block_kernels import EDGE, EMPTY, HALF, VOXELS, insert_keys
from tofuse.engine.fusion.range_view import Views, summaries
from tofuse.engine.fusion.tsdf_kernels import max_informative_depth, near_cubes
from tofuse.engine.geometry import se3

_CHUNKS = 16
_ROUNDING = 1.001  # margin for single precision


@dataclass(frozen=True, eq=False)
class Frusta:
    """The pyramids of space that views affect, up to the truncation behind their surfaces.

    Attributes
    ----------
    T_camera_world
        (N, 4, 4).
    spans
        (N, 4) minimum x/z and y/z, and maximum.
    far
        (N,) maximum z that a view affects, m; 0 for empty views.
    """

    T_camera_world: Float64
    spans: Float64
    far: Float64

    @classmethod
    def of(cls, views: Views, poses: Float64, free_space_limits: Float32) -> Frusta:
        """Return frusta of views at poses (N, 4, 4); limits as for `max_informative_depth`."""
        spans, far = np.empty((len(views), 4)), np.empty(len(views))

        def measure(a: int, b: int) -> None:
            for k in range(a, b):
                view = views[k]
                projection = view.projection
                low, size = projection.frame[:2], np.array(projection.lookup.shape[1::-1]) - 1
                spans[k] = [*low, *(low + size / projection.frame[2:])]
                far[k] = max_informative_depth(view.stored, free_space_limits)

        run_chunks(measure, len(views), _CHUNKS)
        T = np.array([se3.inverse(pose) for pose in poses]).reshape(-1, 4, 4)
        return cls(T, spans, _ROUNDING * far)

    def touching(self, low: Float64, high: Float64) -> Bool:
        """Return which views (N,) may affect the box from `low` to `high` (3,), m.

        The test is conservative: no such view is missed.
        """
        R, t = self.T_camera_world[:, :3, :3], self.T_camera_world[:, :3, 3]
        centre, half_size = R @ (0.5 * (low + high)) + t, 0.5 * (high - low)
        min_z = centre[:, 2] - np.abs(R[:, 2]) @ half_size
        touching = (self.far > 0) & (min_z <= self.far)
        ones = np.ones(len(touching))
        for axis in range(2):
            for side, sign in ((0, -1.0), (2, 1.0)):
                # Points outside of a side plane have n . p > 0.
                n = np.zeros((len(touching), 3))
                n[:, axis], n[:, 2] = sign * ones, -sign * self.spans[:, side + axis]
                radius = np.abs(np.einsum("ni,nij->nj", n, R)) @ half_size
                touching &= np.einsum("ni,ni->n", n, centre) <= radius
        # Nothing behind the camera is visible.
        return touching & (centre[:, 2] + np.abs(R[:, 2]) @ half_size > 0)


# Far from surfaces, free space is integrated of at most every 4th view, with a weight of 4, as
# hundreds of views through the same free space are redundant. The stride grows by 1 per 32 views.
_MAX_STRIDE, _VIEWS_PER_STRIDE = 4, 32
# Spacing of samples along a normal: as a fraction of a block's edge, and of an octant's.
_BLOCK_SPACING, CUBE_SPACING = 0.34, 0.6
# A smaller truncation would cut off the noise on one side of a surface more than on the other.
REACH_SIGMAS = 3.0
# Truncation distance in voxels: trilinear interpolation needs the first, and the second limits the
# memory for a very noisy sensor.
_MIN_REACH, _MAX_REACH = 3.0, 8.0
# Bytes of a voxel besides its colour: distance, weight, views, and the number of its cell.
_VOXEL_BYTES = 4 + 4 + 2 + 4
_BLOCK_BYTES = 27 * 4 + 8 * 4 + 3 * 8  # of a block: its neighbours, its octants, its keys


@dataclass(frozen=True, eq=False)
class Region:
    """Blocks that are fused jointly.

    Attributes
    ----------
    rows
        (B,) rows of the layout's keys: those owned, ascending, then the layer around them.
    owned
        Number of blocks that the region owns.
    low, high
        (3,) corners of the bounding box of all of them, in blocks.
    """

    rows: Int64
    owned: int
    low: Int64
    high: Int64


@dataclass(frozen=True, eq=False)
class Layout:
    """All blocks near the surfaces of views.

    Attributes
    ----------
    voxel_m, reach_m
        Edge of a voxel, and the truncation distance.
    keys
        (B,) of the blocks, ascending.
    channels
        3 for colour, 1 for albedo, else 0.
    free_space_stride
        Far from surfaces, free space is integrated of every n-th view.
    """

    voxel_m: float
    reach_m: float
    keys: Int64
    channels: int
    free_space_stride: int

    @classmethod
    def of(cls, views: Views, poses: Float64, voxel_m: float) -> Layout:
        """Lay out the blocks near the surfaces of views at their poses (N, 4, 4)."""
        view_summaries = summaries(views)
        noise = [summary.sigma_m for summary in view_summaries if summary.sigma_m > 0]
        sigma = float(np.median(noise)) if noise else 0.0
        free_space_stride = int(np.clip(len(views) // _VIEWS_PER_STRIDE, 1, _MAX_STRIDE))
        reach = voxel_m * float(
            np.clip(
                REACH_SIGMAS * sigma / voxel_m,
                _MIN_REACH,
                _MAX_REACH,
            )
        )
        keys = _surface_blocks(views, poses, EDGE * voxel_m, reach, free_space_stride)
        return cls(
            voxel_m,
            reach,
            keys,
            max((summary.channels for summary in view_summaries), default=0),
            free_space_stride,
        )

    @property
    def block_bytes(self) -> int:
        """Memory of a block while it is fused."""
        return VOXELS * (_VOXEL_BYTES + 4 * self.channels) + _BLOCK_BYTES

    def single_region(self) -> Region:
        """All blocks as a single region."""
        return Region(
            np.arange(len(self.keys)), len(self.keys), np.full(3, -HALF), np.full(3, HALF)
        )

    def regions(self, max_blocks: int) -> list[Region]:
        """Bisect the blocks into boxes of at most `max_blocks`, the layer around included.

        A box with more is cut into halves of nearly equal numbers of blocks, across its longest
        side. A single block is not cut, however large the layer around it.
        """
        if len(self.keys) <= max_blocks:
            return [self.single_region()]
        coordinates = _coordinates(self.keys)
        boxes = []
        all_rows = np.arange(len(self.keys))
        pending = [(all_rows, all_rows)]
        while pending:
            owned, candidates = pending.pop()
            region = _with_layer(owned, candidates, coordinates)
            if len(region.rows) <= max_blocks or len(owned) == 1:
                boxes.append(region)
            else:
                pending += [(half, region.rows) for half in reversed(_halves(owned, coordinates))]
        return boxes


def _coordinates(keys: Int64) -> Int32:
    """Return the grid coordinates (B, 3) of blocks by their keys."""
    return np.stack([((keys >> s) & (2 * HALF - 1)) - HALF for s in (42, 21, 0)], 1).astype(
        np.int32
    )


def _halves(owned: Int64, coordinates: Int32) -> list[Int64]:
    """Return the rows of both halves of a box."""
    box = coordinates[owned]
    axis = int(np.ptp(box, axis=0).argmax())
    coordinate = box[:, axis]
    median = np.median(coordinate)
    lower = coordinate < median
    if not lower.any():  # at least half of the blocks are in the first layer
        lower = coordinate <= median
    return [owned[lower], owned[~lower]]


def _with_layer(owned: Int64, candidates: Int64, coordinates: Int32) -> Region:
    """Return a box with the layer of blocks around it, taken from the rows `candidates`."""
    low = coordinates[owned].min(0).astype(np.int64) - 1
    high = coordinates[owned].max(0).astype(np.int64) + 2
    in_box = candidates[
        ((coordinates[candidates] >= low) & (coordinates[candidates] < high)).all(1)
    ]
    return Region(np.concatenate([owned, np.setdiff1d(in_box, owned)]), len(owned), low, high)


def _surface_blocks(
    views: Views, poses: Float64, block_m: float, reach_m: float, free_space_stride: int
) -> Int64:
    """Return the keys of the blocks near surfaces, ascending."""

    stride = min(free_space_stride, 2)

    def touched(start: int, stop: int) -> Int64:
        table, count = np.full(1 << 12, EMPTY, np.int64), 0
        for k in range(start, stop):
            keys = near_cubes(
                views[k].stored,
                poses[k],
                block_m,
                reach_m,
                _BLOCK_SPACING,
                first_pixel(k, stride),
                stride,
            )
            table, count = insert_keys(table, count, keys)
        return table[table != EMPTY]

    if len(views) == 0:
        return np.zeros(0, np.int64)
    return np.unique(np.concatenate(run_chunks(touched, len(views), _CHUNKS)))


def first_pixel(number: int, stride: int) -> tuple[int, int]:
    """Return row and column of the first of every `stride`-th pixel, which depend on the view."""
    return number % stride, number // stride % stride
