"""Views of a furnished, textured room from any position, with exact poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ray_casting import rays_at, to_box, to_walls
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.views.prepared_view import PreparedView, prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions

Box = tuple[tuple[float, float, float], tuple[float, float, float], float]

CAMERA = Pinhole(128, 96, 92.0, 92.0, 63.5, 47.5)
# A room of 4 x 2.2 x 3.6 m, y down, with boxes (centre, half size, turned about y by rad).
HALF = (2.0, 1.1, 1.8)
BOXES: tuple[Box, ...] = (
    ((1.2, 0.7, 1.2), (0.3, 0.4, 0.25), 0.3),
    ((-1.4, 0.4, 1.3), (0.2, 0.7, 0.3), 0.9),
    ((-1.2, 0.7, -1.2), (0.4, 0.4, 0.2), 1.2),
    ((1.5, 0.5, -0.9), (0.2, 0.6, 0.4), 0.1),
    ((0.1, 0.8, 1.3), (0.25, 0.3, 0.2), 0.6),
    ((1.5, 0.8, 0.2), (0.25, 0.3, 0.2), 1.0),
    ((-1.5, 0.8, 0.1), (0.3, 0.25, 0.25), 0.4),
    ((0.2, 0.75, -1.4), (0.3, 0.35, 0.2), 0.8),
)
OTHER: tuple[Box, ...] = (
    ((1.5, 0.3, 0.8), (0.2, 0.8, 0.2), 1.1),
    ((-0.6, 0.7, 1.4), (0.5, 0.4, 0.15), 0.2),
    ((-1.6, 0.2, -0.8), (0.25, 0.9, 0.3), 0.5),
    ((0.4, 0.9, -1.4), (0.4, 0.2, 0.3), 0.9),
    ((0.6, 0.9, 1.2), (0.15, 0.2, 0.3), 0.4),
    ((0.1, 0.7, 0.9), (0.15, 0.4, 0.2), 0.7),
    ((1.2, 0.6, 1.5), (0.3, 0.5, 0.2), 0.3),
)


def at(x: float, z: float, yaw: float, pitch: float = 0.3, y: float = 0.0) -> Float64:
    """T_world_camera (4, 4) of a camera rotated by `yaw` that looks down by `pitch`."""
    return se3.pose(se3.so3_exp([0, yaw, 0]) @ se3.so3_exp([-pitch, 0, 0]), [x, y, z])


def seen(
    T_world_camera: Float64,
    index: int,
    *,
    half: tuple[float, float, float] = HALF,
    boxes: Sequence[Box] = BOXES,
    spots: int = 60,
    scene: int = 3,
    noise: float = 0.004,
    rate: float = 10.0,
    camera: Pinhole = CAMERA,
    shaded: bool = True,
) -> RangeFrame:
    """View of walls and boxes with spots of other albedo, whose places depend on `scene`."""
    rows, columns = camera.height, camera.width
    origin, d = rays_at(T_world_camera, camera)
    d = d.reshape(-1, 3)
    z, axis = to_walls(origin, d, -np.array(half), np.array(half))
    across = np.take_along_axis(d, axis[:, None], 1)[:, 0]
    for centre, size, turn in boxes:
        R = se3.so3_exp([0, turn, 0])
        e = d @ R
        near, axis = to_box((origin - np.array(centre)) @ R, e, -np.array(size), np.array(size))
        side = np.take_along_axis(e, axis[:, None], 1)[:, 0]
        z, across = np.minimum(z, near), np.where(near < z, side, across)
    p = origin + z[:, None] * d
    rng = np.random.default_rng(scene)
    albedo = np.ones(len(p))
    for spot, size, level in zip(
        rng.uniform(-1, 1, (spots, 3)) * half,
        rng.uniform(0.1, 0.35, spots),
        rng.uniform(0.4, 1.6, spots),
        strict=True,
    ):
        albedo[((p - spot) ** 2).sum(1) < size**2] = level
    rng = np.random.default_rng([4, index])
    z = z * (1 + noise * rng.standard_normal(len(z)))
    cosine = np.abs(across) / np.linalg.norm(d, axis=1) if shaded else 1.0
    light = 1000 * albedo * cosine * (1 + 0.02 * rng.standard_normal(len(z)))
    depth, light = (x.reshape(rows, columns).astype(np.float32) for x in (z, light))
    return RangeFrame(
        index,
        index / rate,
        camera,
        depth,
        "z",
        amplitude_image=light,
        amplitude_kind="range_compensated",
    )


def surface(frame: RangeFrame) -> PreparedView:
    """The view as the tests prepare it: small windows for small images."""
    return prepare_view(frame, SurfaceOptions(radii=(2,)))
