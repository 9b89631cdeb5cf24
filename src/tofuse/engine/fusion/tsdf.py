"""TSDF fusion: truncated signed distances in sparse blocks, and their zero surface.

Stitching of the pieces of a surface that were extracted from regions of its blocks.

A vertex is identified by its cell: the number of the block among all, and that of the voxel in it.
The region that owns the block creates it; faces of other regions refer to it by its id. So nothing
is matched by distance, and nothing is duplicated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64, Int32, Int64, UInt8, UInt16
from tofuse.engine.compute import Spill, run_chunks
from tofuse.engine.fusion.block_kernels import (
    EDGE,
    VOXELS,
    Blocks,
    index_of,
    mark_octants,
    neighbours_of,
)
from tofuse.engine.fusion.cloud import grey_of
from tofuse.engine.fusion.clustering_kernels import flatten_groups, union_faces
from tofuse.engine.fusion.layout import (
    CUBE_SPACING,
    REACH_SIGMAS,
    Frusta,
    Layout,
    Region,
    first_pixel,
    is_among,
)
from tofuse.engine.fusion.mesh import Mesh
from tofuse.engine.fusion.options import Fusion
from tofuse.engine.fusion.range_view import DECODED, RangeView, Views, summaries
from tofuse.engine.fusion.surface_net_kernels import Vertices, make_faces, make_vertices, mark_cells
from tofuse.engine.fusion.tsdf_kernels import (
    Batch,
    Camera,
    Decoding,
    apply_free_space,
    integrate,
    near_cubes,
    unpack_view,
)
from tofuse.engine.geometry import se3
from tofuse.engine.stopwatch import timing


@dataclass(frozen=True, eq=False)
class Piece:
    """The surface of the blocks that a region owns.

    Attributes
    ----------
    ids
        (K,) ids of vertices: the V owned, ascending, then others that its faces refer to.
    points, normals, intensity, sigma, views
        Of the owned vertices, V rows; see `Mesh`, and `to_rgb`.
    faces
        (M, 3) rows of `ids`.
    blocks, counts
        (B,) numbers of the owned blocks, ascending, and the number of faces of each.
    """

    ids: Int64
    points: Float32
    normals: Float32
    intensity: Float32
    sigma: Float32
    views: Int32
    faces: Int32
    blocks: Int64
    counts: Int64

    def __len__(self) -> int:
        return len(self.points)

    @property
    def owned_ids(self) -> Int64:
        """Ids of the owned vertices."""
        return self.ids[: len(self)]

    def joined(
        self, layout: Layout, coarser: Sequence[tuple[Layout, Int64]]
    ) -> tuple[Piece, Int64]:
        """Return the surface of the leaves of a layout, joined to that of coarser ones.

        A vertex is replaced by that of the coarser cell around it, if the surface of the coarser
        leaves has it. This concerns the cells along the border, on both sides, so there is neither
        a gap nor an overlap.

        Parameters
        ----------
        layout
            Of this surface.
        coarser
            The layouts before, the coarsest first, and the ids of the vertices of their leaves
            in ascending order.

        Returns
        -------
        The surface, and the ids (K,) of the vertices of the leaves' surface before it was joined.
        """
        block = np.repeat(self.blocks, self.counts)
        of_leaves = layout.leaf[block - layout.first]
        used = np.zeros(len(self.ids), bool)
        used[self.faces[of_leaves]] = True
        ids = self.ids.copy()
        own = np.arange(len(ids)) < len(self)
        for other, vertices in coarser:
            rows = np.flatnonzero(ids == self.ids)
            around = other.cells_around(layout, ids[rows])
            found = is_among(around, vertices)
            ids[rows[found]] = around[found]
            own[rows[found]] = False
        others = np.unique(ids[used & ~own])
        new_row = np.cumsum(own, dtype=np.int32) - np.int32(1)
        new_row[~own] = own.sum() + np.searchsorted(others, ids[~own])
        a, b, c = new_row[self.faces].T
        kept = of_leaves & (a != b) & (b != c) & (c != a)
        owned = own[: len(self)]
        piece = Piece(
            np.concatenate([self.ids[own], others]),
            self.points[owned],
            self.normals[owned],
            self.intensity[owned],
            self.sigma[owned],
            self.views[owned],
            new_row[self.faces[kept]],
            self.blocks,
            np.bincount(np.searchsorted(self.blocks, block[kept]), minlength=len(self.blocks)),
        )
        return piece, self.ids[used]


@timing("meshing")
def stitch(pieces: Spill[Piece], blocks: int, island: int) -> Mesh:
    """Stitch the pieces of all blocks, without islands.

    Vertices are in the order of their ids, faces in that of their blocks, as for a single region.
    Pieces are read one at a time, so that little memory is needed besides the result.

    Parameters
    ----------
    pieces
        A piece of each region.
    blocks
        Number of all blocks.
    island
        Connected surfaces of fewer vertices are left out.
    """
    indices = range(len(pieces))
    ids = np.sort(np.concatenate([pieces.get(k).owned_ids for k in indices]))
    intensity = np.empty((len(ids), pieces.get(0).intensity.shape[1]), np.float32)
    group = np.arange(len(ids), dtype=np.int32)
    used = np.zeros(len(ids), bool)
    for k in indices:
        piece = pieces.get(k)
        rows = _rows(piece, ids)
        intensity[rows[: len(piece)]] = piece.intensity
        faces = rows[piece.faces]
        used[faces] = True
        union_faces(faces, group)
    flatten_groups(group)
    color = to_rgb(intensity)  # with those of islands, for the range of brightness
    del intensity
    used &= np.bincount(group, minlength=len(ids))[group] >= island
    del group
    counts = np.zeros(blocks, np.int64)
    for k in indices:
        piece = pieces.get(k)
        block = np.repeat(piece.blocks, piece.counts)
        used_faces = used[_rows(piece, ids)[piece.faces[:, 0]]]
        counts += np.bincount(block[used_faces], minlength=blocks)
    new_row = np.cumsum(used, dtype=np.int32) - np.int32(1)
    starts = np.cumsum(counts) - counts
    total = int(used.sum())
    mesh = Mesh(
        np.empty((total, 3), np.float32),
        np.empty((int(counts.sum()), 3), np.int32),
        np.empty((total, 3), np.float32),
        None if color is None else color[used],
        np.empty(total, np.float32),
        np.empty(total, np.int32),
    )
    for k in indices:
        piece = pieces.get(k)
        rows = _rows(piece, ids)
        used_owned = used[rows[: len(piece)]]
        target = new_row[rows[: len(piece)][used_owned]]
        mesh.vertices[target] = piece.points[used_owned]
        mesh.normals[target] = piece.normals[used_owned]
        mesh.sigma[target], mesh.views[target] = piece.sigma[used_owned], piece.views[used_owned]
        used_faces = used[rows[piece.faces[:, 0]]]
        block = np.repeat(piece.blocks, piece.counts)[used_faces]
        earlier = np.searchsorted(block, block)  # faces of earlier blocks of this piece
        mesh.faces[starts[block] + np.arange(len(block)) - earlier] = new_row[
            rows[piece.faces[used_faces]]
        ]
    return mesh


def _rows(piece: Piece, ids: Int64) -> Int32:
    """Return the rows of the vertices of a piece among all, by their ids."""
    return np.searchsorted(ids, piece.ids).astype(np.int32)


def to_rgb(intensity: Float32) -> UInt8 | None:
    """Return RGB (N, 3) of intensity (N, C): three channels are RGB, one the root of the albedo.

    Black where it is 0, which is unknown.
    """
    channels = intensity.shape[1]
    if channels == 3:
        return np.round(intensity).clip(0, 255).astype(np.uint8)
    if not channels:
        return None
    known = intensity[:, 0] > 0
    color = np.zeros((len(intensity), 3), np.uint8)
    color[known] = grey_of(intensity[known, 0].astype(float) ** 2)
    return color


_CHUNKS = 16
_BATCH = 16  # views
# Maximum second difference of the lookup of a distortion-free camera, pixels.
_MAX_SECOND_DIFFERENCE = 1e-3
# Number of nodes within which the lookup of any other camera counts as linear.
_DISTORTED_LINEAR_NODES = 2.0
_MIN_VOXEL, _MAX_VOXEL = 0.002, 0.1  # m
_MAX_VOXELS_LEFT = 0.5  # of a grid, by levels: they cost less time in any case then
_EXTREMES = (1, 99)  # percentiles: there is no level for fewer pixels


def fitting_voxel(views: Views) -> float:
    """Return a voxel edge in m for the sensor and the scene: 2 mm to 10 cm."""
    nonempty = [summary for summary in summaries(views) if len(summary.depths)]
    if not nonempty:
        return 0.01
    depth = float(np.median([summary.depths[len(summary.depths) // 2] for summary in nonempty]))
    size = float(np.median([summary.detail for summary in nonempty])) * depth
    return float(f"{np.clip(size, _MIN_VOXEL, _MAX_VOXEL):.2g}")


def fitting_levels(views: Views, voxel_m: float) -> range:
    """Return the levels of `Layout.levels` that the near and the far surfaces of views need.

    Coarser ones save voxels, finer ones add some. There is one level, unless more of them halve the
    number of voxels: each is another pass over the views.
    """
    pixels = [summary.detail * summary.depths for summary in summaries(views)]
    if not any(map(len, pixels)):
        return range(1)
    size = np.concatenate(pixels) / voxel_m
    levels = np.trunc(np.log2(np.maximum(size, _MIN_VOXEL / voxel_m))).astype(int)
    low, high = (int(level) for level in np.percentile(levels, _EXTREMES, method="nearest"))

    def voxels(lowest: int) -> float:
        """Voxels of the surfaces of all pixels, each as large as a pixel is wide."""
        return float(np.square(size / 2.0 ** levels.clip(lowest, max(high, 0))).sum())

    most = _MAX_VOXELS_LEFT * np.square(size).sum()
    lowest = next((level for level in range(min(low, 0), 1) if voxels(level) <= most), None)
    return range(1) if lowest is None else range(lowest, max(high, 0) + 1)


@dataclass(eq=False)
class Volume:
    """Truncated signed distances to the surfaces of views, in blocks near these surfaces.

    Each view is integrated into the blocks in its frustum. Blocks are distributed among threads,
    and each is changed by one of them. The values of a block do not depend on which others are in
    the volume.

    Attributes
    ----------
    voxel_m, reach_m, max_sigma_m
        Edge of a voxel, the truncation distance, and the largest sigma of a surface.
    keys
        (B,) of the blocks: those the region owns, ascending, then the layer around them.
    numbers, owned
        (B,) their numbers among all blocks, and how many of them the region owns.
    distance, weight, seen, color, color_seen, free
        See `tofuse.engine.fusion.block_kernels.Blocks`.
    free_space_stride, added
        Stride of views for free space far from surfaces, and the number of views added.
    """

    voxel_m: float
    reach_m: float
    max_sigma_m: float
    keys: Int64
    numbers: Int64
    owned: int
    distance: Float32
    weight: Float32
    seen: UInt16
    color: Float32
    color_seen: UInt16
    free: Float32
    free_space_stride: int = 1
    added: int = 0

    @property
    def blocks(self) -> Blocks:
        """The blocks in the format of the kernels."""
        return Blocks(
            self.keys, self.numbers, self.distance, self.weight, self.seen, self.color,
            self.color_seen, self.free,
        )  # fmt: skip

    @cached_property
    def index(self) -> tuple[Int64, Int32]:
        """Hash table of the rows of blocks by their keys."""
        return index_of(self.keys)

    @classmethod
    def of(cls, layout: Layout, region: Region) -> Volume:
        """Return the empty volume of a region of a layout."""
        blocks = len(region.rows)
        return cls(
            layout.voxel_m,
            layout.reach_m,
            layout.max_sigma_m,
            layout.keys[region.rows],
            layout.first + region.rows,
            region.owned,
            np.zeros((blocks, VOXELS), np.float32),
            np.zeros((blocks, VOXELS), np.float32),
            np.zeros((blocks, VOXELS), np.uint16),
            np.zeros((blocks, VOXELS, layout.channels), np.float32),
            np.zeros((blocks, VOXELS if layout.channels else 0), np.uint16),
            np.zeros((blocks, 8), np.float32),
            layout.free_space_stride,
        )

    def add(
        self,
        views: Views,
        poses: Float64,
        advance: Callable[[], None] | None = None,
        touching: Bool | None = None,
    ) -> None:
        """Integrate views at their poses (N, 4, 4), in order; `advance` is called for each.

        Those that are not `touching` (N,) any block are skipped.
        """
        batch: list[RangeView] = []
        numbers: list[int] = []

        def flush() -> None:
            if batch:
                selected = np.array(numbers, np.int64)
                self._add(batch, poses[selected - self.added], selected)
            batch.clear()
            numbers.clear()

        for k in range(len(views)):
            if touching is None or touching[k]:
                view = views[k]
                if batch and (len(batch) == _BATCH or view.projection is not batch[0].projection):
                    flush()
                batch.append(view)
                numbers.append(self.added + k)
            if advance is not None:
                advance()
        flush()
        self.added += len(views)

    def _add(self, views: Views, poses: Float64, numbers: Int64) -> None:
        """Integrate a batch of views of one camera; each block is loaded once for all of them.

        `numbers` (N,) are their positions among all views.
        """
        if len(self.keys) == 0:
            return
        count, (rows, columns) = len(views), views[0].z.shape
        projection = views[0].projection
        grid = np.array(projection.lookup.shape[:2]) - 1
        channels = self.color.shape[2]
        batch = Batch(
            numbers,
            np.array([se3.inverse(T_world_camera) for T_world_camera in poses]),
            heights=np.empty((count, rows * columns + 1), np.float32),
            codes=np.empty((count, rows * columns + 1), np.int32),
            intensity=np.zeros((count, rows * columns, channels), np.float32),
            cells=np.empty((count, *grid, 3), np.float32),
            coarse=np.empty((count, *-(-grid // 4), 3), np.float32),
        )
        decoding = Decoding(DECODED, _free_space_limits(self.reach_m), self.reach_m)

        def unpack(a: int, b: int) -> None:
            for s in range(a, b):
                view = views[s]
                unpack_view(view.stored, projection.frame, decoding, batch, s)
                if self.free_space_stride > 1:
                    first = first_pixel(int(numbers[s]), 2)
                    cubes = near_cubes(
                        view.stored, poses[s], cube_m, self.reach_m, CUBE_SPACING, first, 2
                    )
                    mark_octants(cubes, *self.index, near_surface[s])
                # Albedo is ignored if other views have colour.
                if view.intensity is not None and channels == view.channels:
                    batch.intensity[s] = view.intensity.reshape(-1, channels)

        near_surface = np.zeros((count, len(self.keys)), np.uint8)
        cube_m = 0.5 * EDGE * self.voxel_m
        run_chunks(unpack, count, count)
        nodes = _linear_nodes(projection.lookup)
        camera = Camera((rows, columns), projection.lookup, projection.frame, nodes)
        blocks, stride = self.blocks, self.free_space_stride
        run_chunks(
            lambda a, b: integrate(
                blocks, self.voxel_m, batch, camera, decoding, near_surface, stride, a, b
            ),
            len(self.keys),
            _CHUNKS,
        )

    def surface(self, min_views: int = 1) -> Mesh:
        """Return the zero surface of the distances, between observed voxels.

        Vertices with a standard deviation above `max_sigma_m` are left out, as there the surface is
        noise. The surface of the blocks that a region owns is a `piece`.
        """
        net = self._extract(min_views)
        points, normals, intensity, sigma, views = net.vertices
        return Mesh(points.astype(np.float32), net.faces, normals, to_rgb(intensity), sigma, views)

    def piece(self, min_views: int = 1) -> Piece:
        """Return the surface of the owned blocks, to be stitched to those of other regions."""
        net = self._extract(min_views)
        points, normals, intensity, sigma, views = net.vertices
        block, voxel = np.nonzero(net.cells >= 0)
        ids = self.numbers[block] * VOXELS + voxel
        num_owned = int(np.searchsorted(block, self.owned))
        used = np.zeros(len(ids), bool)
        used[:num_owned] = True
        used[net.faces] = True
        row_of = np.cumsum(used, dtype=np.int32) - np.int32(1)
        return Piece(
            ids[used],
            points[:num_owned].astype(np.float32),
            normals[:num_owned].copy(),
            intensity[:num_owned].copy(),
            sigma[:num_owned].copy(),
            views[:num_owned].copy(),
            row_of[net.faces].reshape(-1, 3),
            self.numbers[: self.owned],
            net.per_block,
        )

    def _extract(self, min_views: int) -> _SurfaceNet:
        """Return the vertices of all cells, and the triangles of the owned blocks."""
        count, blocks = len(self.keys), self.blocks
        run_chunks(lambda a, b: apply_free_space(blocks, self.reach_m, a, b), count, _CHUNKS)
        neighbours = np.empty((count, 27), np.int32)
        neighbours_of(self.keys, neighbours)
        cells = np.empty((count, VOXELS), np.int32)
        counts = np.zeros(count, np.int64)
        min_weight = 1 / self.max_sigma_m**2
        run_chunks(
            lambda a, b: mark_cells(blocks, neighbours, min_weight, min_views, cells, counts, a, b),
            count,
            _CHUNKS,
        )
        starts = np.cumsum(counts) - counts
        total = int(counts.sum())
        vertices = Vertices(
            np.empty((total, 3)),
            np.empty((total, 3), np.float32),
            np.empty((total, self.color.shape[2]), np.float32),
            np.empty(total, np.float32),
            np.empty(total, np.int32),
        )
        run_chunks(
            lambda a, b: make_vertices(
                blocks, self.voxel_m, neighbours, cells, starts, vertices, a, b
            ),
            count,
            _CHUNKS,
        )
        faces, per_block = self._faces(neighbours, cells, starts, vertices.points)
        return _SurfaceNet(vertices, faces, per_block, cells)

    def _faces(
        self, neighbours: Int32, cells: Int32, starts: Int64, points: Float64
    ) -> tuple[Int32, Int64]:
        """Return the triangles of the owned blocks, and their number per block."""
        counts = np.zeros(self.owned, np.int64)

        def run(firsts: Int64, faces: Int32, fill: bool) -> Int32:
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
                self.owned,
                _CHUNKS,
            )
            return faces

        run(counts, np.empty((0, 3), np.int32), fill=False)
        triangles = np.empty((int(counts.sum()), 3), np.int32)
        return run(np.cumsum(counts) - counts, triangles, fill=True), counts


@dataclass(frozen=True, eq=False)
class _SurfaceNet:
    """The surface net of a volume: vertices (V,), and faces (M, 3)."""

    vertices: Vertices
    faces: Int32
    per_block: Int64  # (owned,) faces of each block
    cells: Int32  # (B, VOXELS) number of the vertex within its block, or -1


def _free_space_limits(reach_m: float) -> Float32:
    """Return the distance behind its surface up to which a pixel is integrated, m, by weight code.

    (256,) several sigmas: else any noisy pixel that errs to the back would create a separate
    surface.
    """
    sigma = 1 / np.sqrt(np.maximum(DECODED, np.float32(1e-12)))
    return np.where(DECODED > 0, np.maximum(REACH_SIGMAS * sigma, reach_m), reach_m).astype(
        np.float32
    )


def _linear_nodes(lookup: Float32) -> float:
    """Return the number of nodes within which a lookup is linear."""
    differences = [np.abs(np.diff(lookup, 2, axis)) for axis in (0, 1)]
    if max(difference.max() for difference in differences) < _MAX_SECOND_DIFFERENCE:
        return float(np.inf)
    return _DISTORTED_LINEAR_NODES


def fuse_surface(
    views: Views,
    poses: Float64,
    options: Fusion | None = None,
    advance: Callable[[], None] | None = None,
) -> Mesh:
    """Fuse range images at their final poses into one surface.

    Parameters
    ----------
    views
        Of one camera or several.
    poses
        (N, 4, 4) T_world_camera.
    options
        How they are fused.
    advance
        Called after each view.

    Returns
    -------
    The surface without islands; without faces if the views contain none. If its voxels exceed the
    memory of the options, it is fused region by region, with the same result.
    """
    options = options or Fusion()
    voxel = options.voxel_m or fitting_voxel(views)
    levels = range(1) if options.voxel_m else fitting_levels(views, voxel)
    layouts = Layout.levels(views, poses, voxel, levels)
    max_bytes = options.memory_mb * 1_000_000
    regions = [layout.regions(max_bytes // layout.block_bytes) for layout in layouts]
    if sum(map(len, regions)) == 1:
        volume = Volume.of(layouts[0], regions[0][0])
        volume.add(views, poses, advance)
        with timing("meshing"):
            mesh = volume.surface(options.min_views)
            del volume
            return mesh.without_islands(options.island)
    return _fuse_by_regions(layouts, regions, views, poses, options, advance)


def _fuse_by_regions(
    layouts: Sequence[Layout],
    regions: Sequence[Sequence[Region]],
    views: Views,
    poses: Float64,
    options: Fusion,
    advance: Callable[[], None] | None,
) -> Mesh:
    """Fuse the surface region by region, byte-identical to that of one region for each layout."""
    steps, done = sum(map(len, regions)), 0

    def step() -> None:
        nonlocal done
        done += 1
        if advance is not None and done % steps == 0:
            advance()

    store: Spill[Piece] = Spill(0)
    coarser: list[tuple[Layout, Int64]] = []
    with closing(store) as pieces:
        for layout, boxes in zip(layouts, regions, strict=True):
            limits = _free_space_limits(layout.reach_m)
            # A single region is touched by nearly all views.
            frusta = Frusta.of(views, poses, limits) if len(boxes) > 1 else None
            block_m = EDGE * layout.voxel_m
            cells = []
            for region in boxes:
                # With a margin of one block, as blocks are tested by their bounding spheres.
                low, high = np.asarray(region.low - 1, float), np.asarray(region.high + 1, float)
                touching = frusta.touching(block_m * low, block_m * high) if frusta else None
                volume = Volume.of(layout, region)
                volume.add(views, poses, step, touching)
                with timing("meshing"):
                    piece = volume.piece(options.min_views)
                    del volume
                    if len(layouts) > 1:
                        piece, vertices = piece.joined(layout, coarser)
                        cells.append(vertices)
                    pieces.put(piece)
            if cells:
                coarser.append((layout, np.sort(np.concatenate(cells))))
        return stitch(pieces, sum(len(layout.keys) for layout in layouts), options.island)
