"""Selection of tiles for a view: fine ones near the camera, coarse ones at a distance."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Float64
from tofuse.files.tileset import Tile

OVERVIEW_FACES = 250_000
# Smaller errors on the screen need no more triangles: a cluster of merged vertices is then hardly
# larger than a visible triangle.
_MAX_ERROR_PIXELS = 2.0
_MIN_DISTANCE_M = 0.01


@dataclass(frozen=True, eq=False)
class Eye:
    """The camera of a client, in the axes of the tiles.

    Attributes
    ----------
    position, forward
        (3,) m, and (3,) unit vector of the viewing direction.
    fov
        Vertical field of view, rad.
    aspect, height
        Width over height, and height in pixels.
    """

    position: Float64
    forward: Float64
    fov: float
    aspect: float
    height: int

    def pixels(self, tile: Tile) -> float:
        """Return the geometric error of a tile on the screen in pixels; 0 outside the view."""
        if not self._in_view(tile):
            return 0.0
        offset = np.maximum(np.maximum(tile.low - self.position, self.position - tile.high), 0)
        distance = max(float(np.linalg.norm(offset)), _MIN_DISTANCE_M)
        return float(tile.error_m * self.height / (2 * np.tan(self.fov / 2) * distance))

    def _in_view(self, tile: Tile) -> bool:
        """Whether the bounding sphere of a tile intersects the cone around the view frustum."""
        centre, radius = (tile.low + tile.high) / 2, float(np.linalg.norm(tile.high - tile.low)) / 2
        ray = centre - self.position
        distance = float(np.linalg.norm(ray))
        if distance <= radius:
            return True
        half_angle = np.arctan(np.tan(self.fov / 2) * np.hypot(1, self.aspect))
        angle = np.arccos(np.clip(ray @ self.forward / distance, -1, 1))
        return bool(angle <= half_angle + np.arcsin(radius / distance))


def select_tiles(root: Tile, eye: Eye | None, max_faces: int) -> list[Tile]:
    """Return the tiles to be shown: each part of the surface once, in tiles with content.

    The tile with the largest error on the screen is replaced by its children, until every error is
    small enough or the budget is used up.

    Parameters
    ----------
    root
        Root of the tree of tiles.
    eye
        The camera; None: geometric errors count instead of those on the screen.
    max_faces
        Maximum number of triangles.
    """
    selected: list[Tile] = []
    faces = root.faces
    queue = [(-_urgency(root, eye), 0, root)]
    order = 0  # breaks ties in the order of insertion
    while queue:
        urgency, _, tile = heapq.heappop(queue)
        added = sum(child.faces for child in tile.children) - tile.faces
        if tile.content is None or (urgency < 0 and faces + added <= max_faces):
            faces += added
            for child in tile.children:
                order += 1
                heapq.heappush(queue, (-_urgency(child, eye), order, child))
        else:
            selected.append(tile)
    return selected


def _urgency(tile: Tile, eye: Eye | None) -> float:
    """Priority of a tile for refinement; 0 if it needs no more detail."""
    if tile.content is None:
        return float(np.inf)
    if not tile.children:
        return 0.0
    if eye is None:
        return tile.error_m
    pixels = eye.pixels(tile)
    return pixels if pixels > _MAX_ERROR_PIXELS else 0.0
