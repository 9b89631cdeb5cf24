"""Overview and 3D Tiles of surfaces that are too large for a single file in a browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tofuse._version import __version__
from tofuse.arrays import Float64
from tofuse.files.atomic import make_folder
from tofuse.files.geometry_record import GeometryRecord
from tofuse.files.glb import write_glb
from tofuse.files.tileset import Tile, write_tileset
from tofuse.fusion.colors import display_colors
from tofuse.fusion.levels import Level, TileIndex, levels
from tofuse.fusion.mesh import Mesh
from tofuse.results.folder import RESULT, TILES, TILESET

# A surface with more triangles is tiled. These take 110 MB of glTF, all of which must be loaded
# before anything is shown.
MAX_UNTILED_FACES = 4_000_000
OVERVIEW_BYTES = 8_000_000
# A vertex has a position, normal and colour; a triangle has its corners.
_VERTEX_BYTES, _FACE_BYTES, _HEAD_BYTES = 12 + 12 + 8, 12, 2000


@dataclass(frozen=True, eq=False)
class TilingSummary:
    """A summary of the tiles that were written.

    Attributes
    ----------
    levels, tiles
        Number of levels of detail, and of tiles.
    faces
        Number of triangles of the full surface.
    overview
        The simplified surface, of at most `OVERVIEW_BYTES` as one glTF file.
    """

    levels: int
    tiles: int
    faces: int
    overview: Mesh


def write_tiles(mesh: Mesh, R_up_world: Float64, folder: Path) -> TilingSummary:
    """Write a surface as tiles with y up: a `tileset.json` and its .glb files.

    Parameters
    ----------
    mesh
        A surface with at least one face.
    R_up_world
        (3, 3) from the world into axes with y up; see `upright`.
    folder
        Created if necessary.

    Raises
    ------
    OutputError
        If something can't be written.
    """
    make_folder(folder)
    finer: dict[TileIndex, Tile] = {}
    overview_source = mesh
    number = tiles = 0
    for level in levels(mesh):
        number = level.number
        tiles += len(level.tile_indices)
        finer = _parents(_write_level(level, R_up_world, folder), finer, level.error_m)
        if not _fits(level.mesh):
            overview_source = level.mesh
        error = level.error_m
    while len(finer) > 1:  # further levels without content, up to a single root
        number, error = number + 1, 2 * error
        finer = _parents({}, finer, error)
    (root,) = finer.values()
    T = np.eye(4)
    T[:3, :3] = R_up_world
    write_tileset(
        folder / TILESET,
        root,
        generator=f"tofuse {__version__}",
        extras={"T_up_world": T.tolist()},
    )
    return TilingSummary(number + 1, tiles, len(mesh.faces), overview(overview_source))


def is_tiles(folder: Path) -> bool:
    """Whether it is a folder `tiles` that contains only files of `write_tiles`."""
    return folder.is_dir() and not RESULT.foreign(folder, f"{TILES}/")


def overview(mesh: Mesh) -> Mesh:
    """Return the surface, simplified until it fits into `OVERVIEW_BYTES` of glTF."""
    faces = float(OVERVIEW_BYTES / (_FACE_BYTES + _VERTEX_BYTES / 2))
    simplified = mesh
    while not _fits(simplified):
        simplified = mesh.clustered(int(faces))
        faces *= 0.9
    return simplified


def _fits(mesh: Mesh) -> bool:
    size = _HEAD_BYTES + _VERTEX_BYTES * len(mesh) + _FACE_BYTES * len(mesh.faces)
    return size <= OVERVIEW_BYTES


def _write_level(level: Level, R_up_world: Float64, folder: Path) -> dict[TileIndex, Tile]:
    """Write the tiles of a level; returns them by tile index."""
    out = {}
    for index, mesh in level.tiles():
        name = f"{level.number}-{index[0]}-{index[1]}-{index[2]}.glb"
        points = (mesh.vertices @ R_up_world.T).astype(np.float32)
        write_glb(
            folder / name,
            GeometryRecord(
                points,
                mesh.faces,
                normals=mesh.normals @ R_up_world.T,
                color=None if mesh.color is None else display_colors(mesh.color),
                scalars={"sigma": mesh.sigma, "views": mesh.views},
            ),
            generator=f"tofuse {__version__}",
        )
        low, high = points.min(0).astype(float), points.max(0).astype(float)
        out[index] = Tile(low, high, level.error_m, name, len(mesh.faces))
    return out


def _parents(
    tiles: dict[TileIndex, Tile], finer: dict[TileIndex, Tile], error_m: float
) -> dict[TileIndex, Tile]:
    """Make tiles the parents of those of the next finer level, each within its box."""
    for (i, j, k), child in finer.items():
        index = (i // 2, j // 2, k // 2)
        if index not in tiles:
            tiles[index] = Tile(child.low, child.high, error_m, None, 0)
        parent = tiles[index]
        parent.children.append(child)
        parent.low = np.minimum(parent.low, child.low)
        parent.high = np.maximum(parent.high, child.high)
    for tile in tiles.values():
        if finer and not tile.children:
            # Simplification moved its content into a neighbour: finer detail here is empty.
            tile.children.append(Tile(tile.low, tile.high, 0.0, None, 0))
    return tiles
