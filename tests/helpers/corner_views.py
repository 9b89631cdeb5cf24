"""Two views of a corner."""

from __future__ import annotations

import numpy as np

from ray_casting import rays_at, to_plane
from tofuse.engine.cameras.cameras import BrownConrady, Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.stored_views import pair_equation_kernels as kernels
from tofuse.engine.views.view_planes import FineScale, SurfaceOptions

CAMERA = Pinhole(60, 48, 50.0, 50.0, 29.5, 23.5)
# Its distortion bends as much as that of a strong lens, and is monotonic in the image.
BARREL = BrownConrady(60, 48, 50.0, 50.0, 29.5, 23.5, k1=-0.3, k2=0.15)


# No plane fit bridges the edges of the corner, so that the fits are exact. In images as coarse as
# these, the half width is 2 pixels.
SHARP = SurfaceOptions(radii=(4,), flatness=1e-5, fine_scale=FineScale(noise=0))


def corner(
    T_world_camera: np.ndarray, *, offset: float = 0.0, waves: float = 1.0, camera: Pinhole = CAMERA
) -> RangeFrame:
    """A corner of three walls with a pattern, seen by a camera whose range is short by `offset`."""
    origin, directions = rays_at(T_world_camera, camera)
    depth = np.full((48, 60), np.inf)
    light = np.zeros((48, 60))
    for normal, d in (((0, 0, 1), 3.0), ((0.8, 0, 0.6), 2.6), ((0, 0.8, 0.6), 2.4)):
        z = to_plane(origin, directions, normal, d)
        hit = origin + np.where(z < 20, z, 0)[..., None] * directions
        phase = waves * hit
        pattern = 1.5 + 0.5 * np.sin(7 * phase[..., 0]) * np.cos(phase[..., 1:] @ (6, 5))
        light = np.where(z < depth, pattern, light)
        depth = np.minimum(depth, z)
    depth = depth - offset / np.linalg.norm(directions, axis=-1)
    return RangeFrame(
        index=0,
        timestamp=0.0,
        camera=camera,
        depth=depth.astype(np.float32),
        depth_kind="z",
        amplitude_image=(1000 * light).astype(np.float32),
        amplitude_kind="range_compensated",
    )


def unpack(out):
    H = np.zeros((kernels.UNKNOWNS, kernels.UNKNOWNS))
    upper = np.triu_indices(kernels.UNKNOWNS)
    H[upper] = out[kernels.PRODUCTS : kernels.GRADIENT]
    H.T[upper] = out[kernels.PRODUCTS : kernels.GRADIENT]
    return H, out[kernels.GRADIENT : kernels.GRADIENT + kernels.UNKNOWNS]
