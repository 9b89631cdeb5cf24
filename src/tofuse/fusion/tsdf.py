"""The surface of many range images: signed distances in sparse blocks, and their zero."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tofuse.fusion.cloud import grey_of
from tofuse.fusion.mesh import Mesh
from tofuse.fusion.options import Fusion
from tofuse.fusion.views import DECODED, RangeView
from tofuse.geometry import se3
from tofuse.kernels.blocks import (
    EDGE,
    EMPTY,
    VOXELS,
    enter,
    index_of,
    mark_eighths,
    neighbours_of,
)
from tofuse.kernels.surface_nets import make_faces, make_vertices, mark_cells
from tofuse.kernels.threads import run_chunks
from tofuse.kernels.tsdf import integrate, near_cubes, open_view, settle_free

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

_CHUNKS = 16
_AT_ONCE = 16  # views
# Where a view shows no surface near by, at most every 4th one counts, and four times: of hundreds
# that see through a place all say the same. One of every so many more views is left out.
_TURNS, _PER_TURN = 4, 32
# How far apart points along a normal may be that stand for all of it: as a share of a block's edge,
# and of an eighth's.
_OF_BLOCKS, _OF_CUBES = 0.34, 0.6
_MOST_SEEN = 65535  # views that a voxel can count
# Pixels by which a camera that keeps lines straight may bend them, from one node to the next.
_STRAIGHT = 1e-3
# And within how many nodes any other one bends them little.
_LINEAR_NODES = 2.0
# Nearer cuts would take off more of the noise on one side of a surface than on the other.
_REACH_SIGMAS = 3.0
_LARGEST_REACH = 8.0  # voxels: the noise of a bad sensor is no reason to fill space
_KNOWN = 2.0  # voxels: the largest standard deviation of a surface
# How much larger voxels get when there are too many.
_COARSER = 1.25


def fitting_voxel(views: Sequence[RangeView]) -> float:
    """Return a voxel edge in m that fits the sensor and the scene: 2 mm to 10 cm."""
    seen = [view for view in views if view.depth > 0]
    if not seen:
        return 0.01
    depth = float(np.median([view.depth for view in seen]))
    # Depth noise grows with depth: finer voxels than this would hold little but noise.
    size = max(float(np.median([view.pitch for view in seen])), 0.004) * depth
    return float(f"{np.clip(size, 0.002, 0.1):.2g}")


@dataclass(eq=False)
class Volume:
    """Signed distances to the surfaces that views saw, in blocks near these surfaces.

    All blocks are laid out first, so their order and memory depend on the surfaces alone; then each
    view is added to the blocks it sees. Blocks are shared out among threads, and each is changed by
    one of them.

    Attributes
    ----------
    voxel_m, reach_m
        Edge of a voxel, and the largest distance that is told.
    keys
        (B,) the blocks, ascending.
    distance, weight, seen, color, free
        See `tofuse.kernels.tsdf.integrate`.
    turns, added
        Every how-many-th view says what it saw through, and how many have been added.
    """

    voxel_m: float
    reach_m: float
    keys: Int64
    distance: Float32
    weight: Float32
    seen: NDArray[np.uint16]
    color: Float32
    free: Float32
    turns: int = 1
    added: int = 0

    @cached_property
    def index(self) -> tuple[Int64, NDArray[np.int32]]:
        """Where the row of a block is found by its key."""
        return index_of(self.keys)

    @classmethod
    def around(
        cls, views: Sequence[RangeView], poses: Float64, voxel_m: float, options: Fusion
    ) -> Volume:
        """Lay out the blocks near the surfaces of views at their poses (N, 4, 4), all empty.

        Where that would take more memory than allowed, voxels are made larger.
        """
        channels = max((view.channels for view in views), default=0)
        block_bytes = VOXELS * (4 + 4 + 2 + 4 * channels)
        most = max(1, options.memory_mb * 1_000_000 // block_bytes)
        noise = [view.sigma_m for view in views if view.sigma_m > 0]
        sigma = float(np.median(noise)) if noise else 0.0
        turns = int(np.clip(len(views) // _PER_TURN, 1, _TURNS))
        while True:
            reach = voxel_m * float(
                np.clip(
                    _REACH_SIGMAS * sigma / voxel_m,
                    options.reach,
                    max(_LARGEST_REACH, options.reach),
                )
            )
            keys = _touched(views, poses, EDGE * voxel_m, reach, most, turns)
            if keys is not None:
                break
            voxel_m = float(f"{_COARSER * voxel_m:.3g}")
        blocks = len(keys)
        return cls(
            voxel_m,
            reach,
            keys,
            np.zeros((blocks, VOXELS), np.float32),
            np.zeros((blocks, VOXELS), np.float32),
            np.zeros((blocks, VOXELS), np.uint16),
            np.zeros((blocks, VOXELS, channels), np.float32),
            np.zeros((blocks, 8), np.float32),
            turns,
        )

    def add(
        self,
        views: Sequence[RangeView],
        poses: Float64,
        advance: Callable[[], None] | None = None,
    ) -> None:
        """Add views at their poses (N, 4, 4), in order; `advance` is called after each."""
        start = 0
        while start < len(views):
            stop = start + 1
            while (
                stop < min(len(views), start + _AT_ONCE)
                and views[stop].projection is views[start].projection
            ):
                stop += 1
            self._add(views[start:stop], poses[start:stop])
            for _ in range(start, stop):
                if advance is not None:
                    advance()
            start = stop

    def _add(self, views: Sequence[RangeView], poses: Float64) -> None:
        """Add a few views of one camera at once: a block is then fetched once for all of them."""
        if len(self.keys) == 0:
            return
        count, (rows, columns) = len(views), views[0].z.shape
        projection = views[0].projection
        heights = np.empty((count, rows * columns + 1), np.float32)
        codes = np.empty((count, rows * columns + 1), np.int32)
        grid = np.array(projection.lookup.shape[:2]) - 1
        cells = np.empty((count, *grid, 3), np.float32)
        coarse = np.empty((count, *-(-grid // 4), 3), np.float32)
        channels = self.color.shape[2]
        backs = _backs(self.reach_m)
        light = np.zeros((count, rows * columns, channels), np.float32)

        def open_views(a: int, b: int) -> None:
            for s in range(a, b):
                view = views[s]
                open_view(
                    view.z,
                    view.unit,
                    view.normals,
                    view.strength,
                    DECODED,
                    projection.rays,
                    projection.frame,
                    self.reach_m,
                    backs,
                    heights[s],
                    codes[s],
                    cells[s],
                    coarse[s],
                )
                if self.turns > 1:
                    cubes = _near(view, poses[s], edge, self.reach_m, _OF_CUBES, self.added + s, 2)
                    mark_eighths(cubes, *self.index, near[s])
                # Albedo says nothing where the others have colour.
                if view.light is not None and channels == view.channels:
                    light[s] = view.light.reshape(-1, channels)

        near = np.zeros((count, len(self.keys)), np.uint8)
        edge = 0.5 * EDGE * self.voxel_m
        run_chunks(open_views, count, count)
        if self.added + count > _MOST_SEEN:
            np.minimum(self.seen, _MOST_SEEN - count, out=self.seen)
        T = np.array([se3.inverse(T_world_camera) for T_world_camera in poses])
        nodes = _straight_nodes(projection.lookup)
        run_chunks(
            lambda a, b: integrate(
                self.keys,
                self.voxel_m,
                T,
                heights,
                codes,
                DECODED,
                backs,
                near,
                self.added,
                self.turns,
                light,
                (rows, columns),
                projection.lookup,
                projection.frame,
                nodes,
                cells,
                coarse,
                self.reach_m,
                self.distance,
                self.weight,
                self.seen,
                self.color,
                self.free,
                a,
                b,
            ),
            len(self.keys),
            _CHUNKS,
        )
        self.added += count

    def surface(self, min_views: int = 1) -> Mesh:
        """Return where the distances change sign, between voxels that views saw.

        What is not known to within a few voxels is left out: there noise makes the surface.
        """
        blocks = len(self.keys)
        run_chunks(
            lambda a, b: settle_free(self.distance, self.weight, self.free, self.reach_m, a, b),
            blocks,
            _CHUNKS,
        )
        neighbours = np.empty((blocks, 27), np.int32)
        neighbours_of(self.keys, neighbours)
        cells = np.empty((blocks, VOXELS), np.int32)
        counts = np.zeros(blocks, np.int64)
        run_chunks(
            lambda a, b: mark_cells(
                neighbours,
                self.distance,
                self.weight,
                self.seen,
                1 / (_KNOWN * self.voxel_m) ** 2,
                min_views,
                cells,
                counts,
                a,
                b,
            ),
            blocks,
            _CHUNKS,
        )
        starts = np.cumsum(counts) - counts
        total = int(counts.sum())
        channels = self.color.shape[2]
        points = np.empty((total, 3))
        normals = np.empty((total, 3), np.float32)
        tints = np.empty((total, channels), np.float32)
        sigma = np.empty(total, np.float32)
        views = np.empty(total, np.int32)
        run_chunks(
            lambda a, b: make_vertices(
                self.keys,
                self.voxel_m,
                neighbours,
                self.distance,
                self.weight,
                self.seen,
                self.color,
                cells,
                starts,
                points,
                normals,
                tints,
                sigma,
                views,
                a,
                b,
            ),
            blocks,
            _CHUNKS,
        )
        faces = self._faces(neighbours, cells, starts, points)
        color = None
        if channels == 3:
            color = np.round(tints).clip(0, 255).astype(np.uint8)
        elif channels:
            color = grey_of(tints[:, 0].astype(float) ** 2)
        return Mesh(points.astype(np.float32), faces, normals, color, sigma, views, np.zeros(3))

    def _faces(
        self,
        neighbours: NDArray[np.int32],
        cells: NDArray[np.int32],
        starts: Int64,
        points: Float64,
    ) -> NDArray[np.int32]:
        blocks = len(self.keys)
        counts = np.zeros(blocks, np.int64)

        def run(firsts: Int64, faces: NDArray[np.int32], fill: bool) -> NDArray[np.int32]:
            run_chunks(
                lambda a, b: make_faces(
                    neighbours,
                    self.distance,
                    cells,
                    starts,
                    points,
                    firsts,
                    faces,
                    counts,
                    fill,
                    a,
                    b,
                ),
                blocks,
                _CHUNKS,
            )
            return faces

        run(counts, np.empty((0, 3), np.int32), fill=False)
        found = np.empty((int(counts.sum()), 3), np.int32)
        return run(np.cumsum(counts) - counts, found, fill=True)


def _backs(reach: float) -> Float32:
    """(256,) how far behind its surface a pixel matters, m, by the code of its weight.

    It has to be surely behind. If a noisy pixel were not heard there, any other one that errs to
    the back would make a surface of its own.
    """
    sigma = 1 / np.sqrt(np.maximum(DECODED, np.float32(1e-12)))
    return np.where(DECODED > 0, np.maximum(_REACH_SIGMAS * sigma, reach), reach).astype(np.float32)


def _straight_nodes(lookup: Float32) -> float:
    """Within how many nodes of a lookup a linear function will do."""
    bends = [np.abs(np.diff(lookup, 2, axis)) for axis in (0, 1)]
    if max(bend.max() for bend in bends) < _STRAIGHT:
        return float(np.inf)
    return _LINEAR_NODES


def _touched(
    views: Sequence[RangeView],
    poses: Float64,
    block_m: float,
    reach: float,
    most: int,
    turns: int,
) -> Int64 | None:
    """Keys of the blocks near surfaces, ascending; None if there are more than `most`."""

    def touched(start: int, stop: int) -> Int64:
        table, count = np.full(1 << 12, EMPTY, np.int64), 0
        for k in range(start, stop):
            keys = _near(views[k], poses[k], block_m, reach, _OF_BLOCKS, k, min(turns, 2))
            table, count = enter(table, count, keys)
            if count > most:
                break
        return table[table != EMPTY]

    if not views:
        return np.zeros(0, np.int64)
    keys = np.unique(np.concatenate(run_chunks(touched, len(views), _CHUNKS)))
    return keys if len(keys) <= most else None


def _near(
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


def fuse_surface(
    views: Sequence[RangeView],
    poses: Float64,
    options: Fusion | None = None,
    advance: Callable[[], None] | None = None,
) -> Mesh:
    """Fuse range images at their final poses into one surface.

    Parameters
    ----------
    views
        All of one camera or several.
    poses
        (N, 4, 4) T_world_camera.
    advance
        Called after each view.

    Returns
    -------
    The surface without its islands; no faces where the views show none.
    """
    options = options or Fusion()
    volume = Volume.around(views, poses, options.voxel_m or fitting_voxel(views), options)
    volume.add(views, poses, advance)
    return volume.surface(options.min_views).without_islands(options.island)
