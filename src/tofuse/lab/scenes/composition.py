"""Assembly of meshes and materials, and parts common to several scenes."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Self

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.lab.world import Material, Mesh, paths
from tofuse.lab.world import mesh as meshes


class Assembly:
    """Collects parts, each of one material."""

    def __init__(self, materials: list[Material]) -> None:
        self.materials = materials
        self._parts: list[Mesh] = []
        self._T: Float64 | None = None

    def at(self, T: Float64) -> Self:
        """Return the same assembly, to which parts are added at a pose T (4, 4)."""
        placed = copy.copy(self)
        placed._T = T
        return placed

    def add(self, material: Material, *parts: Mesh) -> None:
        """Add parts made of a material."""
        surface = self._id(material)
        for part in parts:
            placed = part if self._T is None else part.transformed(self._T)
            self._parts.append(placed.of_surface(surface))

    def add_mixed(self, materials: Sequence[Material], part: Mesh) -> None:
        """Add one part whose surface ids index `materials`."""
        ids = np.array([self._id(material) for material in materials])
        self._parts.append(replace(part, surface=ids[part.surface]))

    def _id(self, material: Material) -> int:
        if material not in self.materials:
            self.materials.append(material)
        return self.materials.index(material)

    def mesh(self) -> Mesh:
        """Return the mesh of all parts added so far."""
        return meshes.joined(self._parts)


def placed(position: tuple[float, float], yaw: float) -> Float64:
    """Pose (4, 4) of furniture on the floor, rotated by `yaw` rad about z."""
    T = paths.rotation([0, 0, yaw])
    T[:2, 3] = position
    return T


def shell(
    assembly: Assembly,
    low: tuple[float, float, float],
    high: tuple[float, float, float],
    walls: list[Material],
    floor: Material,
    ceiling: Material,
) -> None:
    """Add a closed room between two corners; walls in the order -x, +x, -y, +y."""
    hull = meshes.inside_out(meshes.box_between(low, high))
    # The order of the faces of `box`: -z, +z, -y, +y, -x, +x, two triangles each.
    for k, material in enumerate([floor, ceiling, walls[2], walls[3], walls[0], walls[1]]):
        assembly.add(material, Mesh(hull.vertices, hull.faces[2 * k : 2 * k + 2], hull.surface[:2]))


BACKDROP = Material("backdrop", 0.5, 0.15, "noise", (0.6, 0.6, 0.6))
LINOLEUM = Material("linoleum", 0.4, 0.12, "speckle", (0.1, 0.1, 0.1))
WHITE = Material("ceiling", 0.78)


def studio(assembly: Assembly) -> None:
    """Add a room around an object at the origin and a camera at -x: the background is 3 m away."""
    shell(assembly, (-2.2, -2.6, 0), (3.0, 2.6, 2.6), [BACKDROP] * 4, LINOLEUM, WHITE)
