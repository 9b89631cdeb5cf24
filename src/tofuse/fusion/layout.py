"""Where there is anything to fuse: blocks near surfaces, and regions of them that fit into memory.

The blocks of all views are laid out first, so their order depends on the surfaces alone. Where they
take more memory than there may be, they are cut into boxes, halves of halves, and fused one box
after the other. Of the blocks around a box one layer is fused with it: cells of the surface reach
into the next block and no farther, so all that is made of a box's own cells is exactly what it
would be, were all blocks fused at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Float64, Int32, Int64
from tofuse.fusion.kept import Views, about
from tofuse.fusion.options import Fusion
from tofuse.fusion.views import RangeView
from tofuse.kernels.blocks import EDGE, EMPTY, HALF, VOXELS, enter
from tofuse.kernels.threads import run_chunks
from tofuse.kernels.tsdf import near_cubes

_CHUNKS = 16
# Where a view shows no surface near by, at most every 4th one counts, and four times: of hundreds
# that see through a place all say the same. One of every so many more views is left out.
_TURNS, _PER_TURN = 4, 32
# How far apart points along a normal may be that stand for all of it: as a share of a block's edge,
# and of an eighth's.
_OF_BLOCKS, OF_CUBES = 0.34, 0.6
# Nearer cuts would take off more of the noise on one side of a surface than on the other.
REACH_SIGMAS = 3.0
_LARGEST_REACH = 8.0  # voxels: the noise of a bad sensor is no reason to fill space
# Bytes of a voxel beside its colour: distance, weight, views, and the number of its cell.
_VOXEL_BYTES = 4 + 4 + 2 + 4
_AROUND_BYTES = 27 * 4 + 8 * 4 + 3 * 8  # of a block: its neighbours, its eighths, its keys


@dataclass(frozen=True, eq=False)
class Region:
    """Blocks that are fused together.

    Attributes
    ----------
    rows
        (B,) of the layout's keys: those of the region itself, ascending, then the layer around.
    own
        How many are the region's.
    low, high
        (3,) corners of the box around all of them, in blocks.
    """

    rows: Int64
    own: int
    low: Int64
    high: Int64


@dataclass(frozen=True, eq=False)
class Layout:
    """All blocks near the surfaces of views.

    Attributes
    ----------
    voxel_m, reach_m
        Edge of a voxel, and the largest distance that is told.
    keys
        (B,) of the blocks, ascending.
    channels
        Of the light: 3 for colour, 1 for albedo, else 0.
    turns
        Every how-many-th view says what it saw through.
    """

    voxel_m: float
    reach_m: float
    keys: Int64
    channels: int
    turns: int

    @classmethod
    def of(cls, views: Views, poses: Float64, voxel_m: float, options: Fusion) -> Layout:
        """Lay out the blocks near the surfaces of views at their poses (N, 4, 4)."""
        known = about(views)
        noise = [each.sigma_m for each in known if each.sigma_m > 0]
        sigma = float(np.median(noise)) if noise else 0.0
        turns = int(np.clip(len(views) // _PER_TURN, 1, _TURNS))
        reach = voxel_m * float(
            np.clip(
                REACH_SIGMAS * sigma / voxel_m,
                options.reach,
                max(_LARGEST_REACH, options.reach),
            )
        )
        keys = _touched(views, poses, EDGE * voxel_m, reach, turns)
        return cls(voxel_m, reach, keys, max((each.channels for each in known), default=0), turns)

    @property
    def block_bytes(self) -> int:
        """What a block takes while it is fused."""
        return VOXELS * (_VOXEL_BYTES + 4 * self.channels) + _AROUND_BYTES

    def whole(self) -> Region:
        """All blocks as one region."""
        return Region(
            np.arange(len(self.keys)), len(self.keys), np.full(3, -HALF), np.full(3, HALF)
        )

    def regions(self, most: int) -> list[Region]:
        """Cut the blocks into boxes that hold at most so many, the layer around included.

        A box with more is cut in two halves of nearly as many blocks, across its longest side. A
        single block is not cut, however many are around it.
        """
        if len(self.keys) <= most:
            return [self.whole()]
        places = _places(self.keys)
        out = []
        everything = np.arange(len(self.keys))
        waiting = [(everything, everything)]
        while waiting:
            own, around = waiting.pop()
            region = _with_layer(own, around, places)
            if len(region.rows) <= most or len(own) == 1:
                out.append(region)
            else:
                waiting += [(half, region.rows) for half in reversed(_halves(own, places))]
        return out


def _places(keys: Int64) -> Int32:
    """(B, 3) where blocks are, by their keys."""
    return np.stack([((keys >> s) & (2 * HALF - 1)) - HALF for s in (42, 21, 0)], 1).astype(
        np.int32
    )


def _halves(own: Int64, places: Int32) -> list[Int64]:
    """Rows of either half of a box."""
    inside = places[own]
    axis = int(np.ptp(inside, axis=0).argmax())
    along = inside[:, axis]
    middle = np.median(along)
    first = along < middle
    if not first.any():  # half of them and more lie in the first layer
        first = along <= middle
    return [own[first], own[~first]]


def _with_layer(own: Int64, around: Int64, places: Int32) -> Region:
    """A box with the layer of blocks around it, which are among those `around`."""
    low = places[own].min(0).astype(np.int64) - 1
    high = places[own].max(0).astype(np.int64) + 2
    within = around[((places[around] >= low) & (places[around] < high)).all(1)]
    return Region(np.concatenate([own, np.setdiff1d(within, own)]), len(own), low, high)


def _touched(views: Views, poses: Float64, block_m: float, reach: float, turns: int) -> Int64:
    """Keys of the blocks near surfaces, ascending."""

    def touched(start: int, stop: int) -> Int64:
        table, count = np.full(1 << 12, EMPTY, np.int64), 0
        for k in range(start, stop):
            keys = near(views[k], poses[k], block_m, reach, _OF_BLOCKS, k, min(turns, 2))
            table, count = enter(table, count, keys)
        return table[table != EMPTY]

    if len(views) == 0:
        return np.zeros(0, np.int64)
    return np.unique(np.concatenate(run_chunks(touched, len(views), _CHUNKS)))


def near(
    view: RangeView,
    T_world_camera: Float64,
    cube_m: float,
    reach: float,
    spacing: float,
    number: int,
    stride: int,
) -> Int64:
    """Keys of the cubes near to what a view shows, by every `stride`-th pixel.

    Views with other numbers begin with another one.
    """
    return near_cubes(
        view.z,
        view.unit,
        view.normals,
        view.strength,
        view.projection.rays,
        T_world_camera,
        cube_m,
        reach,
        spacing,
        (number % stride, number // stride % stride),
        stride,
    )
