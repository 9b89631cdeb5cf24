"""Which tiles of a surface are to be seen from somewhere: fine ones near by, coarse ones far."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Float64
from tofuse.files.tileset import Tile

# 60 million triangles a second at 30 pictures a second: by their data sheets a tenth or less of
# what the graphics inside of processors draw.
MOST_FACES = 2_000_000
OVERVIEW_FACES = 250_000
# Errors that are smaller on the screen are not worth more triangles. A cube of vertices that were
# put together is then hardly larger than what a triangle needs to be seen.
_PIXELS = 2.0
_NEAREST_M = 0.01


@dataclass(frozen=True, eq=False)
class Eye:
    """Who looks, in the axes of the tiles.

    Attributes
    ----------
    position, forward
        (3,) m, and a unit vector.
    fov
        Height of the picture, rad.
    aspect, height
        Width over height, and pixels.
    """

    position: Float64
    forward: Float64
    fov: float
    aspect: float
    height: int

    def pixels(self, tile: Tile) -> float:
        """How large the error of a tile is on the screen; 0 outside of it."""
        if not self._sees(tile):
            return 0.0
        off = np.maximum(np.maximum(tile.low - self.position, self.position - tile.high), 0)
        distance = max(float(np.linalg.norm(off)), _NEAREST_M)
        return float(tile.error_m * self.height / (2 * np.tan(self.fov / 2) * distance))

    def _sees(self, tile: Tile) -> bool:
        """Whether the ball around a tile is in the cone around the picture."""
        middle, radius = (tile.low + tile.high) / 2, float(np.linalg.norm(tile.high - tile.low)) / 2
        to = middle - self.position
        distance = float(np.linalg.norm(to))
        if distance <= radius:
            return True
        half = np.arctan(np.tan(self.fov / 2) * np.hypot(1, self.aspect))
        angle = np.arccos(np.clip(to @ self.forward / distance, -1, 1))
        return bool(angle <= half + np.arcsin(radius / distance))


def chosen(root: Tile, eye: Eye | None, most_faces: int) -> list[Tile]:
    """Return the tiles to be shown: each part of the surface once, in tiles that have a file.

    The tile whose error is largest on the screen is replaced by its children, as long as there are
    no more triangles than `most_faces`, and until no error is worth it. Without an `eye` the errors
    themselves count.
    """
    shown: list[Tile] = []
    faces = root.faces
    waiting = [(-_urgency(root, eye), 0, root)]
    number = 0  # equal ones in the order in which they came
    while waiting:
        urgency, _, tile = heapq.heappop(waiting)
        more = sum(child.faces for child in tile.children) - tile.faces
        if tile.content is None or (urgency < 0 and faces + more <= most_faces):
            faces += more
            for child in tile.children:
                number += 1
                heapq.heappush(waiting, (-_urgency(child, eye), number, child))
        else:
            shown.append(tile)
    return shown


def _urgency(tile: Tile, eye: Eye | None) -> float:
    """0 for what needs no more detail."""
    if tile.content is None:
        return float(np.inf)
    if not tile.children:
        return 0.0
    if eye is None:
        return tile.error_m
    pixels = eye.pixels(tile)
    return pixels if pixels > _PIXELS else 0.0
