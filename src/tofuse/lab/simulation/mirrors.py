"""Mirrors on the walls of a simulated scene.

A mirror is a surface with specular reflection only, so that `optics.trace` continues its rays: the
range of a pixel is that of the whole path. Where the camera illuminates the reflected surface
directly as well, that light takes a shorter path and mixes in, as in a real camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.lab.simulation.models import CameraModel
from tofuse.lab.world import Material, Scene, Sequence
from tofuse.lab.world import mesh as meshes

# The silver behind the glass reflects so much of the infrared, at normal incidence.
_REFLECTANCE = 0.9
_SILVER = Material("mirror", 0.0, gloss=float(np.sqrt(_REFLECTANCE)))
_THICKNESS = 0.01
# A wall is flat to this, and free up to that distance, m.
_FLAT_M, _FREE_M = 0.03, 0.4
_ATTEMPTS, _NEAREST_M = 400, 0.6


@dataclass(frozen=True, eq=False)
class Mirror:
    """A rectangle in the room's frame: its centre (3,), and half of its edges (2, 3), m."""

    centre: Float64
    half_edges: Float64

    @property
    def normal(self) -> Float64:
        """(3,) unit vector towards the room."""
        n = np.cross(*self.half_edges)
        return n / np.linalg.norm(n)

    @property
    def area(self) -> float:
        """In m^2."""
        return float(4 * np.linalg.norm(np.cross(*self.half_edges)))


def hang_mirror(
    scene: Scene,
    sequence: Sequence,
    model: CameraModel,
    size: tuple[float, float],
    *,
    times: Float64,
    seed: int,
) -> tuple[Scene, Mirror]:
    """Hang a mirror on a wall that the camera sees.

    Parameters
    ----------
    size
        Its width and height, m.
    times
        (N,) s, of the frames: it is near the middle of one of their images.
    seed
        Chooses the place.

    Raises
    ------
    InputError
        If no visible part of a wall has room for it.
    """
    rng = np.random.default_rng([seed, 5])
    fx, fy, width, height = (
        model.camera.fx,
        model.camera.fy,
        model.camera.width,
        model.camera.height,
    )
    for _ in range(_ATTEMPTS):
        T = sequence.T_room_camera(float(rng.choice(times)))
        ray = np.array([*rng.uniform(-0.2, 0.2, 2) * (width / fx, height / fy), 1.0])
        ray = T[:3, :3] @ (ray / np.linalg.norm(ray))
        hit = scene.cast(T[:3, 3], ray[None])
        n = hit.normal[0].astype(float)
        if not hit.distance[0] > _NEAREST_M or np.isinf(hit.distance[0]) or abs(n[2]) > 0.01:
            continue
        across = np.cross([0.0, 0.0, 1.0], n)
        half_edges = 0.5 * np.array([size[0] * across, size[1] * np.array([0.0, 0.0, 1.0])])
        mirror = Mirror(T[:3, 3] + hit.distance[0] * ray + _THICKNESS * n, half_edges)
        if _has_room(scene, mirror):
            u, v = 2 * mirror.half_edges
            face = meshes.quad(mirror.centre - (u + v) / 2, u, v)
            return scene.with_surface(_SILVER, face), mirror
    raise InputError(
        f"no wall in view has room for {size[0]:g} x {size[1]:g} m",
        where="--mirror",
        remedy="make it smaller, or simulate more of the sequence",
    )


def _has_room(scene: Scene, mirror: Mirror) -> bool:
    """Whether the wall behind the mirror and a margin around it is flat and free."""
    steps = np.linspace(-1.05, 1.05, 9)
    places = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2) @ mirror.half_edges
    start = mirror.centre + places + _FREE_M * mirror.normal
    distance = scene.cast(start, np.tile(-mirror.normal, (len(start), 1))).distance
    return bool((np.abs(distance - _FREE_M - _THICKNESS) < _FLAT_M).all())
