"""Surfaces that are too large for one file of a browser: an overview, and 3D Tiles."""

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
from tofuse.fusion.colors import seen_colors
from tofuse.fusion.levels import Level, Place, levels
from tofuse.fusion.mesh import Mesh
from tofuse.results.folder import RESULT, TILESET

# A surface of more triangles is tiled. So many are 110 MB of glTF, all of which has to be there
# before anything is shown.
MOST_FACES = 4_000_000
OVERVIEW_BYTES = 8_000_000
# Of a vertex: place, normal, colour; and of a triangle: its corners.
_VERTEX_BYTES, _FACE_BYTES, _HEAD_BYTES = 12 + 12 + 8, 12, 2000


@dataclass(frozen=True, eq=False)
class Tiled:
    """What has been written.

    Attributes
    ----------
    levels, tiles
        How many there are.
    faces
        Triangles of the whole surface.
    overview
        The surface with fewer triangles, no more than `OVERVIEW_BYTES` as one glTF file.
    """

    levels: int
    tiles: int
    faces: int
    overview: Mesh


def write_tiles(mesh: Mesh, R_up_world: Float64, folder: Path) -> Tiled:
    """Write a surface with faces as tiles with y up, a `tileset.json` and the files beside it.

    Parameters
    ----------
    R_up_world
        (3, 3) from the world into axes with y up; see `upright`.
    folder
        Made if it is not there.

    Raises
    ------
    OutputError
        If something can't be written.
    """
    make_folder(folder)
    below: dict[Place, Tile] = {}
    coarse = mesh
    number = tiles = 0
    for level in levels(mesh):
        number = level.number
        tiles += len(level.places)
        below = _tree(_written(level, R_up_world, folder), below, level.error_m)
        if not _fits(level.mesh):
            coarse = level.mesh
        error = level.error_m
    while len(below) > 1:  # what was put together to nothing has tiles below it all the same
        number, error = number + 1, 2 * error
        below = _tree({}, below, error)
    (root,) = below.values()
    T = np.eye(4)
    T[:3, :3] = R_up_world
    write_tileset(
        folder / TILESET,
        root,
        generator=f"tofuse {__version__}",
        extras={"T_up_world": T.tolist()},
    )
    return Tiled(number + 1, tiles, len(mesh.faces), overview(coarse))


def is_tiles(folder: Path) -> bool:
    """Say whether it is a folder `tiles` that holds nothing but what `write_tiles` writes."""
    return RESULT.names.is_whole(folder)


def overview(mesh: Mesh) -> Mesh:
    """Return the surface with as many triangles as fit into `OVERVIEW_BYTES` of glTF."""
    faces = float(OVERVIEW_BYTES / (_FACE_BYTES + _VERTEX_BYTES / 2))
    fitting = mesh
    while not _fits(fitting):
        fitting = mesh.decimated(int(faces))
        faces *= 0.9
    return fitting


def _fits(mesh: Mesh) -> bool:
    size = _HEAD_BYTES + _VERTEX_BYTES * len(mesh) + _FACE_BYTES * len(mesh.faces)
    return size <= OVERVIEW_BYTES


def _written(level: Level, R_up_world: Float64, folder: Path) -> dict[Place, Tile]:
    """Write the tiles of a level."""
    out = {}
    for place, mesh in level.tiles():
        name = f"{level.number}-{place[0]}-{place[1]}-{place[2]}.glb"
        points = (mesh.vertices @ R_up_world.T).astype(np.float32)
        write_glb(
            folder / name,
            GeometryRecord(
                points,
                mesh.faces,
                normals=mesh.normals @ R_up_world.T,
                color=None if mesh.color is None else seen_colors(mesh.color),
                scalars={"sigma": mesh.sigma, "views": mesh.views},
            ),
            generator=f"tofuse {__version__}",
        )
        low, high = points.min(0).astype(float), points.max(0).astype(float)
        out[place] = Tile(low, high, level.error_m, name, len(mesh.faces))
    return out


def _tree(tiles: dict[Place, Tile], below: dict[Place, Tile], error_m: float) -> dict[Place, Tile]:
    """Put the tiles of the next finer level below those of a level, each within its box."""
    for (i, j, k), child in below.items():
        place = (i // 2, j // 2, k // 2)
        if place not in tiles:
            tiles[place] = Tile(child.low, child.high, error_m, None, 0)
        parent = tiles[place]
        parent.children.append(child)
        parent.low = np.minimum(parent.low, child.low)
        parent.high = np.maximum(parent.high, child.high)
    for tile in tiles.values():
        if below and not tile.children:
            # What moved over a border is in a finer tile beside it: here it only has to go.
            tile.children.append(Tile(tile.low, tile.high, 0.0, None, 0))
    return tiles
