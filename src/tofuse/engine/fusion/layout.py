"""The layout of the volume: blocks near surfaces, and regions of them that fit into memory.

The blocks of all views are laid out first, so that their order depends on the surfaces alone. If
they exceed the memory, they are bisected recursively into boxes, which are fused one at a time. One
layer of blocks around a box is fused with it: cells of the surface extend into the adjacent block
and no farther, so the surface of the box's cells is the same as if all blocks were fused jointly.

Where near and far surfaces differ in what a pixel resolves, there is a layout of each resolution.
Their voxels double from one to the next, so that blocks are the nodes of an octree; its leaves are
the blocks whose surface belongs to the model.

View frusta: which views can affect a box of space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64, Int32, Int64
from tofuse.engine.compute import run_chunks
from tofuse.engine.fusion.block_kernels import EDGE, EMPTY, HALF, VOXELS, insert_keys, neighbours_of
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
# Maximum standard deviation of a surface in voxels of level 0: beyond, it is noise.
_MAX_SIGMA_VOXELS = 2.0
_SHIFTS = np.array([[42], [21], [0]])  # of the coordinates in a key
_VOXEL_ORDER = (2, 2, 2, 4, 4, 4)  # of the voxels in a block: by octant
# Of a key, shifted right by one: the bits that remain in their coordinate, and what centres it.
_KEPT_BITS = (HALF - 1) * (1 << 42 | 1 << 21 | 1)
_CENTRE = (HALF >> 1) * (1 << 42 | 1 << 21 | 1)
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
    """Blocks near the surfaces of views, of one size.

    Attributes
    ----------
    voxel_m, reach_m
        Edge of a voxel, and the truncation distance.
    max_sigma_m
        Maximum standard deviation of the surface.
    keys
        (B,) of the blocks, ascending.
    leaf
        (B,) whether the surface of a block belongs to the model. Others surround such blocks.
    first
        Number of the first block among those of all layouts.
    channels
        3 for colour, 1 for albedo, else 0.
    free_space_stride
        Far from surfaces, free space is integrated of every n-th view.
    """

    voxel_m: float
    reach_m: float
    max_sigma_m: float
    keys: Int64
    leaf: Bool
    first: int
    channels: int
    free_space_stride: int

    @classmethod
    def of(cls, views: Views, poses: Float64, voxel_m: float) -> Layout:
        """Lay out blocks of one size near the surfaces of views at their poses (N, 4, 4)."""
        (layout,) = cls.levels(views, poses, voxel_m, range(1))
        return layout

    @classmethod
    def levels(cls, views: Views, poses: Float64, voxel_m: float, levels: range) -> list[Layout]:
        """Lay out the leaves of an octree, and what surrounds them, the coarsest first.

        Voxels of level l have an edge of 2^l `voxel_m`. A block is divided if a pixel of a surface
        in it resolves more than its voxels: the best view of a place decides.
        """
        view_summaries = summaries(views)
        noise = [summary.sigma_m for summary in view_summaries if summary.sigma_m > 0]
        sigma = float(np.median(noise)) if noise else 0.0
        channels = max((summary.channels for summary in view_summaries), default=0)
        stride = int(np.clip(len(views) // _VIEWS_PER_STRIDE, 1, _MAX_STRIDE))
        voxels = [voxel_m * 2.0**level for level in levels]
        reaches = [
            v * float(np.clip(REACH_SIGMAS * sigma / v, _MIN_REACH, _MAX_REACH)) for v in voxels
        ]
        surfaces = _surface_blocks(views, poses, voxel_m, levels, reaches, stride)
        divided = np.unique(_parents(surfaces[-1].keys))
        layouts: list[Layout] = []
        first, max_sigma = 0, _MAX_SIGMA_VOXELS * voxel_m
        for k in reversed(range(len(levels))):
            keys, finer = surfaces[k]
            finer = finer[is_among(_parents(finer), divided)]
            leaf = is_among(_parents(keys), divided) & ~is_among(keys, finer)
            divided = finer
            if not leaf.all():
                near = leaf | _beside(keys, leaf)
                keys, leaf = keys[near], leaf[near]
            if len(keys) or (k == 0 and not layouts):
                layout = cls(voxels[k], reaches[k], max_sigma, keys, leaf, first, channels, stride)
                layouts.append(layout)
                first += len(keys)
        return layouts

    def cells_around(self, finer: Layout, ids: Int64) -> Int64:
        """Return the ids of the cells that contain those of a finer layout; -1 where none does.

        An id is the number of the block times `VOXELS`, plus that of the voxel in it.
        """
        keys = finer.keys[ids // VOXELS - finer.first]
        within = np.array(np.unravel_index(ids % VOXELS, _VOXEL_ORDER))
        voxel = 4 * within[:3] + within[3:]
        for _ in range(round(np.log2(self.voxel_m / finer.voxel_m))):
            voxel = (EDGE * ((keys >> _SHIFTS) & 1) + voxel) >> 1
            keys = _parents(keys)
        rows = np.searchsorted(self.keys, keys).clip(max=len(self.keys) - 1)
        number = np.ravel_multi_index((*(voxel >> 2), *(voxel & 3)), _VOXEL_ORDER)
        return np.where(self.keys[rows] == keys, (self.first + rows) * VOXELS + number, -1)

    @property
    def block_bytes(self) -> int:
        """Memory of a block while it is fused."""
        of_color = 4 * self.channels + 2 * (self.channels > 0)
        return VOXELS * (_VOXEL_BYTES + of_color) + _BLOCK_BYTES

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


class _SurfaceBlocks(NamedTuple):
    """Keys, ascending, of the blocks of a level near surfaces, and of those with finer pixels."""

    keys: Int64
    finer: Int64


def _surface_blocks(
    views: Views,
    poses: Float64,
    voxel_m: float,
    levels: range,
    reaches: Sequence[float],
    free_space_stride: int,
) -> list[_SurfaceBlocks]:
    """Return the blocks of each level near the surfaces of views."""
    stride = min(free_space_stride, 2)
    # Pixels below these limits need a finer level. Up to a factor of 2 voxels remain as they are.
    limits = [voxel_m * 2.0 ** (level if level > 0 else level - 1) for level in levels]
    limits[0] = 0.0

    def touched(start: int, stop: int) -> list[Int64]:
        tables = [(np.full(1 << 12, EMPTY, np.int64), 0) for _ in range(2 * len(levels))]
        for k in range(start, stop):
            view, first = views[k], first_pixel(k, stride)
            resolution = view.resolution if len(levels) > 1 else np.float32(np.inf)
            for n, level in enumerate(levels):
                finer = resolution < limits[n]
                for table, selected in ((2 * n, ~finer), (2 * n + 1, finer)):
                    if not selected.any():
                        continue
                    keys = near_cubes(
                        view.stored._replace(strength=view.strength * selected),
                        poses[k],
                        EDGE * voxel_m * 2.0**level,
                        reaches[n],
                        _BLOCK_SPACING,
                        first,
                        stride,
                    )
                    tables[table] = insert_keys(*tables[table], keys)
        return [table[table != EMPTY] for table, _ in tables]

    chunks = run_chunks(touched, len(views), _CHUNKS) if len(views) else []
    none = np.zeros(0, np.int64)
    coarse, fine = (
        [
            np.unique(np.concatenate([none, *(c[k] for c in chunks)]))
            for k in range(part, 2 * len(levels), 2)
        ]
        for part in range(2)
    )
    return [_SurfaceBlocks(np.union1d(a, b), b) for a, b in zip(coarse, fine, strict=True)]


def is_among(values: Int64, ascending: Int64) -> Bool:
    """Return which values (N,) are among ascending ones (M,)."""
    if len(ascending) == 0:
        return np.zeros(len(values), bool)
    rows = np.searchsorted(ascending, values).clip(max=len(ascending) - 1)
    return np.asarray(ascending[rows] == values)


def _parents(keys: Int64) -> Int64:
    """Return the keys of the blocks of twice the size that contain blocks."""
    return ((keys >> 1) & _KEPT_BITS) + _CENTRE


def _beside(keys: Int64, chosen: Bool) -> Bool:
    """Return which blocks (B,) are among the 26 around the chosen ones (B,)."""
    neighbours = np.empty((len(keys), 27), np.int32)
    neighbours_of(keys, neighbours)
    rows = np.unique(neighbours[chosen])
    beside = np.zeros(len(keys), bool)
    beside[rows[rows >= 0]] = True
    return beside


def first_pixel(number: int, stride: int) -> tuple[int, int]:
    """Return row and column of the first of every `stride`-th pixel, which depend on the view."""
    return number % stride, number // stride % stride
