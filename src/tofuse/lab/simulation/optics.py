"""Per-pixel irradiance from ray hits: sub-rays, mirror reflection, one bounce, lens scattering."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy import ndimage
from scipy.constants import speed_of_light

from tofuse.engine.arrays import Bool, Float64, Int32
from tofuse.engine.cameras import Pinhole
from tofuse.engine.compute import run_chunks
from tofuse.engine.geometry import unit_rays, unit_vectors
from tofuse.lab.simulation import phasor_kernels as phasor
from tofuse.lab.simulation.models import CameraModel
from tofuse.lab.world import Scene

# Offset of secondary rays from their surface, against self-intersection.
_RAY_OFFSET_M = 1e-4
# Depth tolerance of the shadow test.
_SHADOW_BIAS_M = 0.005
# Highlight of a perfect mirror at normal incidence, relative to a white wall; and its width.
_HIGHLIGHT, _HIGHLIGHT_RAD = 40.0, 0.03
# Chosen for a sampling error of the range of about a millimetre.
_BOUNCE_RAYS = 128


@dataclass(frozen=True, eq=False)
class RayGrid:
    """Unit directions (H s + 1, W s + 1, 3) in the camera frame, s per pixel, or (H, W, 3).

    Attributes
    ----------
    directions
        Unit rays in the camera frame, NaN outside the lens model's domain.
    stride
        Samples per pixel pitch.
    weights
        Weights of the samples in a pixel's window along one axis (separable); they sum to 1.
    """

    directions: Float64
    stride: int
    weights: Float64

    @property
    def window(self) -> int:
        """Side length of a pixel's window in samples."""
        return len(self.weights)

    @property
    def centre(self) -> tuple[slice, slice]:
        """Slices of the samples at the pixel centres."""
        samples = slice(self.window // 2, None, self.stride)
        return samples, samples


@cache
def ray_grid(model: CameraModel, mixed: bool) -> RayGrid:
    """Return the rays of a camera: one per pixel centre, or a half-pixel grid.

    Samples on the border of two pixels contribute to both, which models the optical blur.
    """
    camera = model.camera
    if not mixed:
        return RayGrid(unit_rays(camera.rays()), 1, np.ones(1))
    fine: Pinhole = replace(
        camera,
        width=2 * camera.width + 1,
        height=2 * camera.height + 1,
        fx=2 * camera.fx,
        fy=2 * camera.fy,
        cx=2 * camera.cx + 1,
        cy=2 * camera.cy + 1,
    )
    return RayGrid(unit_rays(fine.rays()), 2, np.array([0.25, 0.5, 0.25]))


@dataclass(frozen=True, eq=False)
class Returns:
    """Returned signal of N rays: up to R returns each, and the surface hit.

    Attributes
    ----------
    strength
        (N, R) relative to a white wall at 1 m; the first is the direct return.
    path
        (N, R) round-trip path length in m.
    diffuse
        (N,) diffuse reflectance: albedo reduced by the specular fraction.
    distance
        (N,) in m, infinite without a hit.
    points, normals
        (N, 3) in the room's frame; points infinite without a hit.
    surface
        (N,) int32 id of the surface, -1 without a hit.
    """

    strength: Float64
    path: Float64
    diffuse: Float64
    distance: Float64
    points: Float64
    normals: Float64
    surface: Int32


def trace(
    scene: Scene,
    model: CameraModel,
    directions: Float64,
    T_room_camera: Float64,
    T_room_bodies: Float64 | None,
    *,
    gloss: bool,
) -> Returns:
    """Trace rays (N, 3) of the camera frame to the first hit, and on after specular reflection.

    The light source is at the camera's centre. A surface with specular reflectance g returns a
    highlight at normal incidence and the reflected scene: illuminated via the mirror (g^2, the
    mirror image) and directly (g, on a shorter path). g depends on the angle, see `_mirrored`.
    """
    origin = T_room_camera[:3, 3]
    rays = directions @ T_room_camera[:3, :3].T
    valid: Bool = np.isfinite(rays @ np.ones(3))
    rays[~valid] = (0.0, 0.0, 1.0)
    hits = scene.cast(origin, rays, T_room_bodies)
    distance: Float64 = np.where(valid, hits.distance.astype(float), np.inf)
    hit = np.isfinite(distance)
    safe = np.where(hit, np.maximum(distance, 1e-3), 1.0)
    normals = hits.normal.astype(float)
    cosine = np.clip(-np.einsum("nc,nc->n", normals, rays), 0, 1)
    mirror = np.where(hit, _mirrored(hits.gloss.astype(float), cosine), 0.0) * gloss
    diffuse = np.where(hit, hits.albedo * (1 - mirror), 0.0)
    direct = diffuse * cosine / safe**2
    points = origin + safe[:, None] * rays
    points[~hit] = np.inf
    specular = np.flatnonzero(mirror > 0.01)
    if len(specular) == 0:
        return Returns(
            direct[:, None], 2 * safe[:, None], diffuse, distance, points, normals, hits.surface
        )
    strength = np.zeros((len(rays), 3))
    path = np.zeros((len(rays), 3))
    strength[:, 0], path[:, 0] = direct, 2 * safe
    g, r, n, d = mirror[specular], safe[specular], normals[specular], rays[specular]
    incidence = np.arccos(cosine[specular])
    # The mirrored light source is at twice the distance.
    strength[specular, 0] += (
        g * _HIGHLIGHT / (4 * r**2) * np.exp(-((incidence / _HIGHLIGHT_RAD) ** 2))
    )
    reflected = d - 2 * (d * n).sum(1, keepdims=True) * n
    start = points[specular] + _RAY_OFFSET_M * n
    second = scene.cast(start, reflected, T_room_bodies)
    hit2 = np.isfinite(second.distance)
    s = np.where(hit2, second.distance, 1.0).astype(float)
    y = start + s[:, None] * reflected
    n2 = second.normal.astype(float)
    albedo = np.where(hit2, second.albedo * (1 - second.gloss), 0.0)
    cosine2 = np.clip(-(n2 * reflected).sum(1), 0, 1)
    strength[specular, 1] = g * g * albedo * cosine2 / (r + s) ** 2
    path[specular, 1] = 2 * (r + s)
    irradiance, length = direct_irradiance(scene, origin, y, n2, T_room_bodies)
    # Illuminated from the light source, not along the ray.
    irradiance *= _beam(model, (y - origin) @ T_room_camera[:3, :3]) / _beam(
        model, directions[specular]
    )
    strength[specular, 2] = g * albedo * irradiance
    path[specular, 2] = r + s + length
    return Returns(strength, path, diffuse, distance, points, normals, hits.surface)


def travelled(returns: Returns) -> Float64:
    """Half of the path of the light (N,), m: to the surface hit, or on from a perfect mirror."""
    if returns.path.shape[1] == 1:
        return returns.distance
    from_mirror = (returns.diffuse == 0) & (returns.path[:, 1] > 0)
    return np.where(from_mirror, returns.path[:, 1] / 2, returns.distance)


def _mirrored(gloss: Float64, cosine: Float64) -> Float64:
    """Specular reflectance (Schlick 1994): gloss^2 at normal incidence, rising to grazing.

    A perfect mirror reflects all light, varnish (gloss 0.2) 4 % at normal incidence, at most 20 %.
    """
    return gloss * (gloss + (1 - gloss) * (1 - cosine) ** 5)


def direct_irradiance(
    scene: Scene, lamp: Float64, points: Float64, normals: Float64, T_room_bodies: Float64 | None
) -> tuple[Float64, Float64]:
    """Irradiance of points (N, 3) by a lamp (3,): cos / r^2, 0 in shadow; and distances r in m."""
    toward = points - lamp
    length = np.maximum(np.linalg.norm(toward, axis=1), 1e-3)
    toward = toward / length[:, None]
    cosine = np.clip(-(normals * toward).sum(1), 0, 1)
    nearest = scene.cast(lamp, toward, T_room_bodies).distance
    visible = nearest > length - _SHADOW_BIAS_M - 0.002 * length
    return np.where(visible, cosine / length**2, 0.0), length


def pixel_phasors(grid: RayGrid, returns: Returns, frequency: float) -> Float64:
    """Direct light in each pixel, (H, W, 7) in the channels of `phasor_kernels`."""
    return _pool(grid, returns.strength, returns.path, frequency)


def bounce_weights(grid: RayGrid, returns: Returns, frequency: float) -> Float64:
    """Response (H, W, 7) of pixels to light arriving at their surface: half a path is added."""
    return _pool(grid, returns.diffuse[:, None], returns.path[:, :1] / 2, frequency)


def _pool(grid: RayGrid, strength: Float64, path: Float64, frequency: float) -> Float64:
    wave_number = 2 * np.pi * frequency / speed_of_light
    rows, columns = grid.directions.shape[:2]
    fine = np.empty((rows * columns, phasor.CHANNELS))
    strength, path = np.ascontiguousarray(strength), np.ascontiguousarray(path)
    run_chunks(lambda a, b: phasor.ray_phasors(strength, path, wave_number, a, b, fine), len(fine))
    fine = fine.reshape(rows, columns, -1)
    height = (rows - grid.window) // grid.stride + 1
    width = (columns - grid.window) // grid.stride + 1
    out = np.empty((height, width, phasor.CHANNELS))
    run_chunks(lambda a, b: phasor.pool(fine, grid.weights, grid.stride, a, b, out), height)
    return out


def plane_deviation(grid: RayGrid, returns: Returns) -> Float64:
    """Largest distance (H, W) in m of a pixel's sub-rays from the plane at its centre."""
    rows, columns = grid.directions.shape[:2]
    points = returns.points.reshape(rows, columns, 3)
    normals = returns.normals.reshape(rows, columns, 3)
    height = (rows - grid.window) // grid.stride + 1
    out = np.zeros((height, (columns - grid.window) // grid.stride + 1))
    run_chunks(
        lambda a, b: phasor.plane_deviation(points, normals, grid.window, grid.stride, a, b, out),
        height,
    )
    return out


def single_bounce_light(
    scene: Scene,
    model: CameraModel,
    points: Float64,
    normals: Float64,
    T_room_camera: Float64,
    T_room_bodies: Float64 | None,
    *,
    gloss: bool = True,
) -> list[Float64]:
    """Single-bounce indirect light on each pixel's surface, for each frequency.

    On a coarse pixel grid, rays are cast in fixed cosine-weighted directions about the normal (so
    that their mean radiance is what the surface scatters); the surfaces they hit are illuminated by
    the camera's lamp. Paths run from the lamp to the pixel's surface.

    Like direct light, it is relative to the lamp's emission towards the pixel: the image falloff is
    that of lens and lamp combined, but this light was emitted in another direction.

    Parameters
    ----------
    points, normals
        (H, W, 3) at the pixels' centres, in the room's frame; points infinite without a hit.
    gloss
        Whether glossy surfaces scatter less.

    Returns
    -------
    For each frequency (H, W, 7) in the channels of `phasor_kernels`.
    """
    step = max(4, points.shape[1] // 44)
    samples = (slice(step // 2, None, step), slice(step // 2, None, step))
    x, n = points[samples], normals[samples]
    shape = x.shape[:2]
    lamp = T_room_camera[:3, 3]
    hit = np.isfinite(x[..., 0])
    strengths = np.zeros((*shape, _BOUNCE_RAYS))
    paths = np.zeros((*shape, _BOUNCE_RAYS))
    if hit.any():
        n_hit = n[hit]
        start = x[hit] + _RAY_OFFSET_M * n_hit
        rays = np.einsum("kc,ncd->nkd", _hemisphere(_BOUNCE_RAYS), _frames(n_hit))
        starts = np.repeat(start, _BOUNCE_RAYS, axis=0)
        rays = rays.reshape(-1, 3)
        second = scene.cast(starts, rays, T_room_bodies)
        hit2 = np.isfinite(second.distance)
        s = np.where(hit2, second.distance, 1.0).astype(float)
        y = starts + s[:, None] * rays
        irradiance, length = direct_irradiance(
            scene, lamp, y, second.normal.astype(float), T_room_bodies
        )
        beam = _beam(model, (y - lamp) @ T_room_camera[:3, :3])
        mirror = (
            _mirrored(second.gloss.astype(float), np.clip(irradiance * length**2, 0, 1)) * gloss
        )
        albedo = np.where(hit2, second.albedo * (1 - mirror), 0.0)
        strengths[hit] = (albedo * irradiance * beam).reshape(-1, _BOUNCE_RAYS) / _BOUNCE_RAYS
        paths[hit] = (length + s).reshape(-1, _BOUNCE_RAYS)
    valid = np.isfinite(points[..., 0])
    beam = np.ones(valid.shape)
    beam[valid] = _beam(model, (points[valid] - lamp) @ T_room_camera[:3, :3])
    out = []
    for frequency in model.frequencies:
        wave_number = 2 * np.pi * frequency / speed_of_light
        coarse = np.empty((shape[0] * shape[1], phasor.CHANNELS))
        phasor.ray_phasors(
            strengths.reshape(-1, _BOUNCE_RAYS),
            paths.reshape(-1, _BOUNCE_RAYS),
            wave_number,
            0,
            len(coarse),
            coarse,
        )
        # Points relative to the lens: the plane tolerance grows with the range.
        light = _upsample(coarse.reshape(*shape, -1), x - lamp, n, points - lamp, normals, step)
        out.append(light / beam[..., None])
    return out


def _upsample(
    coarse: Float64, x: Float64, n: Float64, points: Float64, normals: Float64, step: int
) -> Float64:
    out = np.empty((*points.shape[:2], coarse.shape[2]))
    x, n = np.ascontiguousarray(x), np.ascontiguousarray(n)
    points, normals = np.ascontiguousarray(points), np.ascontiguousarray(normals)
    run_chunks(
        lambda a, b: phasor.upsample(coarse, x, n, points, normals, step, a, b, out), len(points)
    )
    return out


def _beam(model: CameraModel, directions: Float64) -> Float64:
    """Emission of the lamp in directions (N, 3) of the camera frame, relative to the axis.

    Half of the camera's falloff, and a ramp to zero from 1.1 to 1.3 times the angle of the image
    corner.
    """
    cosine = directions[:, 2] / np.maximum(np.linalg.norm(directions, axis=1), 1e-9)
    corner = float(np.nanmax(np.linalg.norm(model.camera.rays(), axis=-1)))
    limit = np.arctan(corner)
    angle = np.arccos(np.clip(cosine, -1, 1))
    edge = np.clip((1.3 - angle / limit) / 0.2, 0, 1)
    return np.maximum(cosine, 0) ** (model.falloff / 2) * edge


@cache
def _hemisphere(count: int) -> Float64:
    """Fixed cosine-weighted directions (count, 3) about z (a spiral)."""
    k = np.arange(count)
    radius = np.sqrt((k + 0.5) / count)
    phi = k * np.pi * (3 - np.sqrt(5))
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), np.sqrt(1 - radius**2)], -1)


def _frames(normals: Float64) -> Float64:
    """Orthonormal frames (N, 3, 3) of normals (N, 3): rows are two tangents and the normal."""
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = unit_vectors(np.cross(helper, normals))
    return np.stack([first, np.cross(normals, first), normals], 1)


def combine(weights: Float64, light: Float64) -> Float64:
    """Light of a pixel after a bounce, (H, W, 7): weights times arriving light, per harmonic."""
    out = weights * light
    for c in (1, 3, 5):
        a = weights[..., c] + 1j * weights[..., c + 1]
        b = light[..., c] + 1j * light[..., c + 1]
        out[..., c], out[..., c + 1] = (a * b).real, (a * b).imag
    return out


def gaussian_blur(images: Float64, sigma_px: float) -> Float64:
    """Images (..., H, W) after a Gaussian blur with standard deviation `sigma_px`."""
    if sigma_px == 0:
        return images
    radius = int(np.ceil(3 * sigma_px))
    weights = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma_px) ** 2)
    weights /= weights.sum()
    rows = ndimage.correlate1d(images, weights, -2, mode="nearest")
    return np.asarray(ndimage.correlate1d(rows, weights, -1, mode="nearest"))


class LensScatter:
    """Light scattered in the lens: a fraction of every image is spread widely over it.

    The point spread function is a mixture of Gaussians of 0.06 and 0.25 image widths, wide enough
    to be sampled at every fourth pixel (or coarser).
    """

    def __init__(self, width: int, height: int, fraction: float) -> None:
        self.fraction = fraction
        step = max(4, width // 44)
        self._parts = [
            (
                w,
                _blur_operators(height, step, sigma * width),
                _blur_operators(width, step, sigma * width),
            )
            for w, sigma in ((0.5, 0.06), (0.5, 0.25))
        ]

    def __call__(self, image: Float64) -> Float64:
        """Return the scattered light (H, W) of an image (H, W)."""
        if self.fraction == 0:
            return image
        out = (1 - self.fraction) * image
        for w, (up_rows, down_rows), (up_columns, down_columns) in self._parts:
            # einsum, not a matrix product: BLAS may sum differently with more threads.
            small = np.einsum("iv,vu->iu", down_rows, image)
            small = np.einsum("iu,ju->ij", small, down_columns)
            large = np.einsum("vi,ij->vj", up_rows, small)
            out += self.fraction * w * np.einsum("vj,uj->vu", large, up_columns)
        return out


def _blur_operators(size: int, step: int, sigma: float) -> tuple[Float64, Float64]:
    """Operators up (size, n) and down (n, size): blur at n nodes, and linear interpolation."""
    nodes = np.arange(-(-size // step))
    pixels = np.arange(size)
    sums = (pixels // step == nodes[:, None]).astype(float)
    distance = (nodes[:, None] - nodes) * step
    blur = np.exp(-0.5 * (distance / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
    position = np.clip((pixels - (step - 1) / 2) / step, 0, len(nodes) - 1)
    return np.maximum(0, 1 - np.abs(position[:, None] - nodes)), blur @ sums
