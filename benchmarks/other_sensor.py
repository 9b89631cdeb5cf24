"""Small recordings by a second simulated sensor, which shares no camera error with `tofuse.lab`.

Only the ray caster is the same. The lens, noise, mixed pixels, smoothing, steps of the depth,
periodic errors, warm-up, stray light and one diffuse reflection are modelled here in another way,
for four kinds of cameras: two time-of-flight cameras, a phone whose depth is smoothed, and
structured light. `verdict.py` reconstructs them: what was tuned on one simulator is tested on
another.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

import unusual
from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.geometry.rays import homogeneous
from tofuse.lab.scenes.composition import Assembly, placed, shell
from tofuse.lab.scenes.furniture import chair, desk
from tofuse.lab.world import mesh as meshes
from tofuse.lab.world import paths
from tofuse.lab.world import scene as scenes
from tofuse.lab.world.paths import Path

FRAMES, RATE_HZ = 36, 7.0
LOW = 0.01  # least albedo times cosine that is measured
_BOUNCE_GRID = (15, 20)  # patches of the image that light the others


@dataclass(frozen=True)
class Sensor:
    """A camera and its errors.

    Attributes
    ----------
    degrees
        Horizontal field of view.
    noise_m, noise_power
        Standard deviation of the depth at 1 m on a white surface, and how it grows with depth.
    by_light, grain
        Whether noise decreases with the light; pixels over which it is correlated.
    calibration
        Standard deviation of the errors of focal length and principal point, relative.
    warp, fixed_m
        Relative depth error towards the corners; standard deviation of that of each pixel.
    wiggle_m, period_m
        Amplitude and period of a periodic error of the range.
    warm_up_m
        Change of the depth from the first frame to the last.
    step_m, smoothing
        Step of the depth at 1 m; size of the window that the maker smooths with, pixels.
    modulation_m, stray
        Period of the range of the fastest modulation, if any; light that the lens spreads.
    """

    width: int
    height: int
    degrees: float
    noise_m: float
    noise_power: float = 2.0
    by_light: bool = True
    grain: float = 0.0
    calibration: float = 0.001
    warp: float = 0.0
    wiggle_m: float = 0.0
    period_m: float = 1.5
    warm_up_m: float = 0.0
    fixed_m: float = 0.0
    step_m: float = 0.001
    smoothing: int = 0
    modulation_m: float | None = None
    stray: float = 0.0
    amplitude: bool = True

    @property
    def has_indirect(self) -> bool:
        """Whether indirect light changes its depth."""
        return self.modulation_m is not None


SENSORS = {
    "azure": Sensor(
        96, 86, 75, 0.0015, wiggle_m=0.001, warm_up_m=0.001, fixed_m=0.0005, modulation_m=0.75,
        stray=0.01,
    ),
    "old tof": Sensor(
        88, 72, 43, 0.0025, wiggle_m=0.003, warm_up_m=0.002, fixed_m=0.002, modulation_m=5.0,
        stray=0.04, calibration=0.002,
    ),
    "phone": Sensor(
        96, 72, 60, 0.004, 1.0, by_light=False, grain=1.0, warp=0.001, step_m=0.002, smoothing=7,
        amplitude=False,
    ),
    "structured light": Sensor(
        96, 72, 58, 0.0015, 2.0, by_light=False, grain=1.5, warp=0.002, step_m=0.002,
        amplitude=False, calibration=0.002,
    ),
}  # fmt: skip


# ---- Scenes and motions --------------------------------------------------------------------------


def _office(assembly: Assembly, rng: np.random.Generator) -> None:
    walls = [unusual.WALL, unusual.PLASTER, unusual.WALL, unusual.PLASTER]
    shell(assembly, (-2.4, -2.0, 0), (2.4, 2.0, 2.6), walls, unusual.GROUND, unusual.WHITE)
    desk(assembly.at(placed((1.6, 0.9), rng.uniform(-0.3, 0.3))))
    for k, at in enumerate([(1.2, -1.0), (-1.2, 1.1), (-1.5, -0.9)]):
        chair(assembly.at(placed(at, rng.uniform(0, 6))), unusual.THINGS[k])
    _boxes(assembly, rng, 18, (-2.2, -1.8), (2.2, 1.8), clear=0.8)


def _store(assembly: Assembly, rng: np.random.Generator) -> None:
    """Add a store room with boxes on the floor and on boards along the walls."""
    shell(assembly, (-3.2, -1.6, 0), (3.2, 1.6, 2.4), [unusual.PLASTER] * 4, unusual.GROUND,
          unusual.PLASTER)  # fmt: skip
    for height in (0.5, 1.0, 1.5):
        assembly.add(unusual.WOOD, meshes.box_between((-3, 1.2, height), (3, 1.6, height + 0.03)))
        for x in np.arange(-2.8, 2.8, 0.35):
            size = rng.uniform((0.1, 0.1, 0.08), (0.3, 0.3, 0.4))
            body = meshes.box(size, (x, 1.4, height + 0.03 + size[2] / 2))
            assembly.add(unusual.THINGS[int(rng.integers(5))], body)
    _boxes(assembly, rng, 18, (-3, -1.5), (3, 0.9), clear=0.7)


def _aisle(assembly: Assembly, rng: np.random.Generator) -> None:
    """Add an aisle between two rows of shelves, with a wall at its end."""
    shell(assembly, (-1, -1.5, 0), (8, 1.5, 2.8), [unusual.PLASTER] * 4, unusual.GROUND,
          unusual.WHITE)  # fmt: skip
    for side in (-1, 1):
        for height in (0.3, 0.9, 1.5, 2.1):
            corners = (-1, side * 0.9, height), (7, side * 1.5, height + 0.03)
            assembly.add(unusual.WOOD, meshes.box_between(*np.sort(corners, axis=0)))
            for x in np.arange(-0.8, 6.9, 0.4):
                size = rng.uniform((0.1, 0.1, 0.08), (0.35, 0.4, 0.5))
                body = meshes.box(size, (x, side * 1.2, height + 0.03 + size[2] / 2))
                assembly.add(unusual.THINGS[int(rng.integers(5))], body)


def _bare(assembly: Assembly, rng: np.random.Generator) -> None:
    """Add a room with plain walls, a column and few boxes."""
    shell(assembly, (-2.6, -2.2, 0), (2.0, 2.6, 2.5), [unusual.PLASTER] * 4, unusual.GROUND,
          unusual.PLASTER)  # fmt: skip
    assembly.add(unusual.WALL, meshes.rod((1.2, 1.0, 0), (1.2, 1.0, 2.5), 0.15))
    _boxes(assembly, rng, 9, (-2.4, -2.0), (1.8, 2.4), clear=0.8)


def _objects(assembly: Assembly, rng: np.random.Generator) -> None:
    """Add a table with things, in a room."""
    shell(assembly, (-2, -2, -0.7), (2, 2, 1.8), [unusual.WALL] * 4, unusual.GROUND, unusual.WHITE)
    assembly.add(unusual.WOOD, meshes.box_between((-0.7, -0.7, -0.04), (0.7, 0.7, 0)))
    _boxes(assembly, rng, 9, (-0.5, -0.5), (0.5, 0.5), size=0.5)


def _boxes(
    assembly: Assembly,
    rng: np.random.Generator,
    count: int,
    low: tuple[float, float],
    high: tuple[float, float],
    clear: float = 0.0,
    size: float = 1.0,
) -> None:
    """Add boxes and balls on the ground, none closer to the origin than `clear`."""
    while count:
        at = rng.uniform(low, high)
        if np.hypot(*at) < clear + 0.4:
            continue
        count -= 1
        a, b, c = size * rng.uniform((0.15, 0.15, 0.2), (0.6, 0.6, 1.3))
        body = meshes.box((a, b, c), (0, 0, c / 2))
        if count % 3 == 0:
            body = meshes.superellipsoid((a, b, c)).transformed(
                se3.exp(np.array([0, 0, c / 2, 0, 0, 0]))
            )
        T = placed((float(at[0]), float(at[1])), rng.uniform(0, 6))
        assembly.add(unusual.THINGS[count % 5], body.transformed(T))


def _turn(rng: np.random.Generator) -> Path:
    """Turn once around, with an unsteady hand."""
    camera = paths.look_at((0.1, -0.1, 1.2), (1, 0, rng.uniform(0.75, 1.0)))
    turn = paths.camera_turn(camera, (FRAMES - 1) / RATE_HZ, 0.2)
    return unusual.together(turn, unusual.handheld(rng, 0.02, 1.5))


def _pan(rng: np.random.Generator) -> Path:
    """Turn by a third and move aside."""
    seconds, angle = (FRAMES - 1) / RATE_HZ, rng.uniform(0, 6)

    def path(t: float) -> Float64:
        u = t / seconds
        a = angle + 2.1 * u
        p = np.array([0.3 * np.cos(a + 2), 0.3 * np.sin(a + 2), 1.1 + 0.2 * u])
        return paths.look_at(p, p + np.array([np.cos(a), np.sin(a), -0.3]))

    return unusual.together(path, unusual.handheld(rng, 0.02, 1.5))


def _aside(rng: np.random.Generator) -> Path:
    """Move to the side and back, without a turn."""
    angle = rng.uniform(0, 6)
    camera = paths.look_at((0, 0, 1.1), (np.cos(angle), np.sin(angle), 0.8))
    out = paths.out_and_back(camera, 0.6, (FRAMES - 1) / RATE_HZ)
    return unusual.together(out, unusual.handheld(rng, 0.01, 1.0))


def _ahead(rng: np.random.Generator) -> Path:
    """Walk straight ahead."""
    seconds, far = (FRAMES - 1) / RATE_HZ, rng.uniform(3.5, 4.5)

    def path(t: float) -> Float64:
        at = np.array([far * t / seconds, 0, 1.3])
        return paths.look_at(at, at + np.array([1, 0, -0.1]))

    return unusual.together(path, unusual.handheld(rng, 0.02, 1.5))


def _orbit(rng: np.random.Generator) -> Path:
    walk = unusual.around(1.1, 0.6, (0, 0, 0.05), (FRAMES - 1) / RATE_HZ)
    return unusual.together(walk, unusual.handheld(rng, 0.02, 1.5))


Fill, Motion = (
    Callable[[Assembly, np.random.Generator], None],
    Callable[[np.random.Generator], Path],
)
SCENES: dict[str, tuple[Fill, Motion]] = {
    "office, turn": (_office, _turn),
    "store, pan": (_store, _pan),
    "bare room, turn": (_bare, _turn),
    "office, aside": (_office, _aside),
    "aisle, ahead": (_aisle, _ahead),
    "table, orbit": (_objects, _orbit),
}


# ---- Images --------------------------------------------------------------------------------------


def record(scene: str, sensor: str, seed: int, *, indirect: bool = True) -> Recording:
    """Simulate a recording in memory; the true poses are its reference."""
    fill, motion = SCENES[scene]
    s = SENSORS[sensor]
    rng = np.random.default_rng([seed, *scene.encode(), *sensor.encode()])
    world = unusual.built(scene, fill)(seed)
    path = motion(rng)
    f = s.width / 2 / np.tan(np.radians(s.degrees) / 2)
    centre = (s.width - 1) / 2, (s.height - 1) / 2
    stated = Pinhole(s.width, s.height, f, f, *centre)
    fx, fy = f * (1 + s.calibration * rng.standard_normal(2))
    cx, cy = np.array(centre) + s.calibration * f * rng.standard_normal(2)
    made = _Images(s, world, Pinhole(s.width, s.height, fx, fy, cx, cy), indirect, rng)
    poses = np.array([path(k / RATE_HZ) for k in range(FRAMES)])
    frames = []
    for k, T in enumerate(poses):
        depth, amplitude = made.images(T, k / (FRAMES - 1))
        frames.append(
            RangeFrame(
                k, k / RATE_HZ, stated, depth, amplitude_image=amplitude if s.amplitude else None
            )
        )
    metadata = {"frame_rate_hz": RATE_HZ, "sensor": f"other {sensor}"}
    reference = se3.inverse(poses[0]) @ poses
    return Recording.of(ArraySource(frames, reference, metadata=metadata), "simulated", "simulated")


@dataclass
class _Images:
    """Makes the images of one camera in one scene."""

    sensor: Sensor
    scene: scenes.Scene
    camera: Pinhole
    indirect: bool
    rng: np.random.Generator

    def __post_init__(self) -> None:
        s = self.sensor
        self.fixed = s.fixed_m * self.rng.standard_normal((s.height, s.width))
        # Four rays for each pixel: those at an edge see two surfaces.
        c = self.camera
        fine = Pinhole(
            2 * s.width, 2 * s.height, 2 * c.fx, 2 * c.fy, 2 * c.cx + 0.5, 2 * c.cy + 0.5
        )
        rays = homogeneous(fine.rays())
        self.z_of_range = 1 / np.linalg.norm(rays, axis=2)
        self.rays = rays * self.z_of_range[..., None]

    def images(self, T: Float64, progress: float) -> tuple[Float32, Float32]:
        """Return depth and amplitude of one frame; `progress` is 0 at the first, 1 at the last."""
        s, rng = self.sensor, self.rng
        directions = self.rays.reshape(-1, 3) @ T[:3, :3].T
        hits = self.scene.cast(T[:3, 3], directions)
        shape = self.z_of_range.shape
        fine = hits.distance.reshape(shape).astype(float)
        cosine = -(hits.normal * directions).sum(1).reshape(shape)
        reflected = np.maximum(hits.albedo.reshape(shape) * cosine, LOW)
        light = reflected / fine**2
        if s.modulation_m is None:  # the maker chooses one of the surfaces
            distance = np.median(_four(fine), axis=0)
        else:
            phase = 4 * np.pi / (2 * s.modulation_m)
            direct = _four(fine).mean(0)
            signal = _four(light * np.exp(1j * phase * fine)).mean(0)
            if self.indirect:
                signal = signal + self._scattered(signal) + self._bounced(hits, T, shape, phase)
            # Slower modulations tell in which period the distance is.
            distance = direct + np.angle(signal * np.exp(-1j * phase * direct)) / phase
        light, distance = _four(light).mean(0), np.asarray(distance, float)
        z = distance * _four(self.z_of_range).mean(0)
        r2 = ((_four(self.rays[..., :2] / self.rays[..., 2:]).mean(0)) ** 2).sum(2)
        z = z * (1 + s.warp * r2) + s.warm_up_m * progress + self.fixed
        z += s.wiggle_m * np.sin(2 * np.pi * distance / s.period_m)
        noise = rng.standard_normal(z.shape)
        if s.grain:
            noise = cv2.GaussianBlur(noise, (0, 0), s.grain)
            noise /= noise.std()
        sigma = s.noise_m * z**s.noise_power
        if s.by_light:
            sigma = s.noise_m * np.sqrt(1 / np.maximum(light, 1e-3)) * z ** (s.noise_power - 1)
        z += sigma * noise * np.where(rng.random(z.shape) < 0.01, 5, 1)
        if s.smoothing:
            z = cv2.bilateralFilter(z.astype(np.float32), s.smoothing, 0.1, s.smoothing / 3)
        step = s.step_m * (z**2 if s.noise_power == 2 and not s.by_light else 1)
        z = np.round(z / step) * step
        counts = 2e4 * light * rng.normal(1, 0.01, light.shape)
        valid = (z > 0.2) & (sigma < 0.05 * z) & (light > 2e-3)
        return np.where(valid, z, 0).astype(np.float32), counts.astype(np.float32)

    def _scattered(self, signal: np.ndarray) -> np.ndarray:
        """Light that the lens spreads over the image."""
        width = 0.25 * self.sensor.width
        spread = [cv2.GaussianBlur(part, (0, 0), width) for part in (signal.real, signal.imag)]
        return self.sensor.stray * (spread[0] + 1j * spread[1])

    def _bounced(
        self, hits: scenes.Hits, T: Float64, shape: tuple[int, int], phase: float
    ) -> np.ndarray:
        """Light that reaches a point by way of another surface in view."""
        rows, columns = (
            (np.arange(n) * size / n + size / n / 2).astype(int)
            for n, size in zip(_BOUNCE_GRID, shape, strict=True)
        )
        chosen = (rows[:, None] * shape[1] + columns).ravel()
        directions = self.rays.reshape(-1, 3)[chosen]
        normal = hits.normal[chosen].astype(float) @ T[:3, :3]
        r, albedo = hits.distance[chosen].astype(float), hits.albedo[chosen].astype(float)
        p = directions * r[:, None]
        d = p[:, None] - p
        length = np.maximum(np.linalg.norm(d, axis=2), 0.25)
        facing = np.maximum(-(normal[:, None] * d).sum(2), 0) * np.maximum((normal * d).sum(2), 0)
        solid_angle = 4 * np.tan(np.radians(self.sensor.degrees) / 2) ** 2 * shape[0] / shape[1]
        weight = albedo * solid_angle / len(r) * facing / (np.pi * length**4)
        path = (r + length + r[:, None]) / 2
        bounced = (albedo[:, None] * weight * np.exp(1j * phase * path)).sum(1)
        bounced = bounced.reshape(_BOUNCE_GRID)
        size = (self.sensor.width, self.sensor.height)
        real, imaginary = (cv2.resize(part, size) for part in (bounced.real, bounced.imag))
        return np.asarray(real + 1j * imaginary)


def _four(image: np.ndarray) -> np.ndarray:
    """Return the (4, H, W, ...) rays of each pixel of an image (2H, 2W, ...)."""
    return np.stack([image[a::2, b::2] for a in (0, 1) for b in (0, 1)])
