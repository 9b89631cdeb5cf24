"""A simulated phone with LiDAR: colour images, smoothed depth, and poses of its own.

What the app of a phone records is no longer what a sensor measures: depth is dense, smooth, late
and rounded at edges, with errors that vary slowly over the image and over time, and the poses of
visual-inertial odometry drift. Recordings are written as 3d Scanner App exports them.

Not simulated: motion blur, refocusing, and shadows; surfaces shine the same from all sides.
"""

from __future__ import annotations

import colorsys
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Self

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

from tofuse.engine.arrays import Float64, UInt8, UInt16
from tofuse.engine.cameras import Pinhole, scaled
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import homogeneous, se3
from tofuse.formats.files import atomic, staging
from tofuse.formats.images import jpeg_bytes, write_png
from tofuse.formats.poses import write_tum
from tofuse.lab.simulation.effects import switched_off
from tofuse.lab.simulation.truth import write_surface
from tofuse.lab.world import Material, Scene
from tofuse.lab.world import Sequence as Motion
from tofuse.lab.world import scene as scenes

NAME = "phone"
COLOR = Pinhole(1440, 1080, 1086.0, 1086.0, 724.3, 518.4)
DEPTH = scaled(COLOR, 256, 192)
# Raw frames from one image to the next (5 a second), and frames from one with colour to the next.
STRIDE, COLOR_EVERY = 6, 3

# Errors of depth, as residuals of iPhones to their fused surfaces show them: shares of the variance
# that stays with the image, and that lasts some time; the rest is new in each image.
_STAYS, _LASTS, _DURATION_S, _SIZE = 0.3, 0.3, 2.0, 0.1  # size as a fraction of the width
_FAR_M = 5.0  # depth without confidence
_EDGE, _EDGE_PX = 0.05, 3  # relative step of depth, and width, of what is called an edge
# Drift: random walks per square root of a second, tilt that stays bounded, and scale.
_HEADING_RAD, _TILT_RAD, _POSITION_M, _SCALE = np.radians(0.1), np.radians(0.1), 0.003, 0.005
_JUMP_M, _JUMP_RAD = np.array([0.06, 0.08, 0.0]), np.radians(2.0)
# Light from all sides, from above, and from one side.
_AMBIENT, _ABOVE, _SIDE = 0.55, 0.25, 0.2
_LIGHT = np.array([0.48, 0.60, 0.64])
_MEAN_LEVEL, _GAMMA, _ADAPTATION, _WHITE = 0.32, 1 / 2.2, 0.4, 0.01
# Of materials by their pattern: hue (0 to 1, None for any), range of saturation, visible contrast.
_LOOKS: dict[str, tuple[float | None, float, float, float]] = {
    "plain": (0.6, 0.0, 0.05, 1.0),
    "noise": (None, 0.03, 0.15, 0.3),
    "wood": (0.08, 0.35, 0.55, 1.0),
    "tiles": (0.11, 0.05, 0.2, 1.0),
    "print": (None, 0.3, 0.6, 1.2),
    "speckle": (None, 0.15, 0.45, 1.0),
}

_ARKIT_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
_ARKIT_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # from z up


@dataclass(frozen=True)
class PhoneErrors:
    """Strengths of the errors of a phone; 0 switches one off.

    Attributes
    ----------
    depth
        Relative error of the depth, rms, smooth over the image, partly over time.
    blur
        Pixels by which depth is smoothed (sigma); edges of iPhones are 1.5 to 3 pixels wide.
    lag
        s by which depth is older than colour.
    shutter
        s from the first to the last row of a colour image, whose middle is at the frame's time.
    exposure
        How much exposure and white balance follow the image, 0 to 1.
    noise
        Of the colour, grey levels.
    drift
        Factor on a usual drift of the phone's own poses.
    jump
        Factor on a jump of 0.1 m and 2 degrees in the middle, as by a relocalization.
    """

    depth: float = 0.005
    blur: float = 0.7
    lag: float = 0.02
    shutter: float = 0.015
    exposure: float = 1.0
    noise: float = 2.0
    drift: float = 1.0
    jump: float = 0.0

    def without(self, *names: str) -> Self:
        """Return these errors with the named ones switched off; "all" means every one.

        Raises
        ------
        InputError
            If there is no such error.
        """
        known = [each.name for each in fields(self)]
        return replace(
            self, **dict.fromkeys(switched_off(names, known, "a phone has no error"), 0.0)
        )


_DEFAULT = PhoneErrors()


@dataclass(frozen=True, eq=False)
class PhoneFrame:
    """What the app writes of a frame.

    Attributes
    ----------
    depth
        (H, W) in mm, 0 without a surface.
    confidence
        (H, W), 0 to 2.
    color
        (H, W, 3) RGB, or None.
    """

    depth: UInt16
    confidence: UInt8
    color: UInt8 | None


@dataclass(frozen=True, eq=False)
class PhonePlan:
    """A planned recording of a phone.

    Attributes
    ----------
    scene, motion, errors, seed
        What is recorded.
    times
        (N,) of the frames, s.
    depth, color
        Cameras of depth and colour, with the same view.
    color_every
        Frames from one with colour to the next; 0: no colour.
    """

    scene: Scene
    motion: Motion
    times: Float64
    errors: PhoneErrors = _DEFAULT
    seed: int = 0
    depth: Pinhole = DEPTH
    color: Pinhole = COLOR
    color_every: int = COLOR_EVERY

    @property
    def poses(self) -> Float64:
        """(N, 4, 4) true T_world_camera; the world is the first camera's frame."""
        return np.stack([self.motion.T_world_camera(t, self.times[0]) for t in self.times])

    def device_poses(self) -> Float64:
        """(N, 4, 4) T_world_camera as the phone estimates them, in a world with y up."""
        rng = np.random.default_rng([self.seed, 6])
        first = self.motion.T_room_camera(self.times[0])
        poses = drifting(first @ self.poses, self.times, self.errors, rng)
        poses[:, :3, 3] -= first[:3, 3]
        return np.asarray(_ARKIT_UP @ poses)

    def frames(self) -> Iterator[PhoneFrame]:
        """Render the frames."""
        rng = np.random.default_rng([self.seed, 5])
        palette = _palette(self.scene.materials, self.seed)
        shape = self.depth.height, self.depth.width
        stays, lasts = _smooth(rng, shape), _smooth(rng, shape)
        gain, white, steps = 0.0, np.ones(3), np.diff(self.times, prepend=-np.inf)
        for k, (t, step) in enumerate(zip(self.times, steps, strict=True)):
            kept = np.exp(-step / _DURATION_S)
            lasts = kept * lasts + np.sqrt(1 - kept**2) * _smooth(rng, shape)
            new = np.sqrt(1 - _STAYS - _LASTS) * _smooth(rng, shape)
            error = np.sqrt(_STAYS) * stays + np.sqrt(_LASTS) * lasts + new
            depth, confidence = self._depth(t, 1 + self.errors.depth * error)
            color = None
            if self.color_every and k % self.color_every == 0:
                light = self._light(t, palette)
                best = _MEAN_LEVEL / max(float(light.mean()), 1e-3)
                followed = self.errors.exposure * (_ADAPTATION if gain else 1.0)
                gain = (1 - followed) * (gain or 1.0) + followed * best
                white = white * (1 + self.errors.exposure * _WHITE * rng.standard_normal(3))
                level = 255 * np.clip(gain * white * light, 0, 1) ** _GAMMA
                level += self.errors.noise * rng.standard_normal(level.shape)
                color = np.round(level).clip(0, 255).astype(np.uint8)
            yield PhoneFrame(depth, confidence, color)

    def _cast(self, camera: Pinhole, t: float, readout: float) -> scenes.Hits:
        """Return what the rays of an image hit, row by row in `readout` s."""
        rays = homogeneous(camera.rays())
        rows = t + readout * ((np.arange(camera.height) + 0.5) / camera.height - 0.5)
        poses = np.stack([self.motion.T_room_camera(r) for r in (rows if readout else rows[:1])])
        directions = rays @ np.swapaxes(poses[:, :3, :3], 1, 2)
        directions = (directions / np.linalg.norm(rays, axis=2, keepdims=True)).reshape(-1, 3)
        origins = poses[:, :3, 3]
        if len(origins) > 1:
            origins = np.repeat(origins, camera.width, 0)
        return self.scene.cast(origins, directions, self.motion.T_room_bodies(t))

    def _depth(self, t: float, factor: Float64) -> tuple[UInt16, UInt8]:
        hits = self._cast(self.depth, t - self.errors.lag, 0.0)
        shape = self.depth.height, self.depth.width
        rays = self.depth.rays().astype(float)
        z = hits.distance.reshape(shape) / np.sqrt(1 + (rays**2).sum(2))
        valid = np.isfinite(z)
        z = np.where(valid, z, 0.0)
        smooth = gaussian_filter(z, self.errors.blur)
        smooth /= np.maximum(gaussian_filter(valid.astype(float), self.errors.blur), 1e-6)
        step = maximum_filter(z, _EDGE_PX) - minimum_filter(z, _EDGE_PX)
        confidence = np.where(step > _EDGE * z, 1, 2) * (z < _FAR_M) * valid
        millimetres = np.where(valid, 1000 * smooth * factor, 0.0)
        return np.round(millimetres).astype(np.uint16), confidence.astype(np.uint8)

    def _light(self, t: float, palette: _Palette) -> Float64:
        """Return the light (H, W, 3) of the colour image, 1 for white in full light."""
        hits = self._cast(self.color, t, self.errors.shutter)
        normal = hits.normal.astype(float)
        shade = _AMBIENT + _ABOVE * normal[:, 2] + _SIDE * (normal @ _LIGHT)
        light = palette.reflectance(hits) * shade[:, None]
        light[hits.surface < 0] = 0.0
        return light.reshape(self.color.height, self.color.width, 3)


def drifting(
    poses: Float64, times: Float64, errors: PhoneErrors, rng: np.random.Generator
) -> Float64:
    """Poses (N, 4, 4), z up, with drift in heading, tilt and position, and a jump halfway."""
    up = np.array([0.0, 0.0, 1.0])
    root = np.sqrt(np.diff(times, prepend=times[0]))[:, None]
    heading = _HEADING_RAD * (root * rng.standard_normal((len(times), 1))).cumsum(0)
    smooth = gaussian_filter(rng.standard_normal((len(times), 3)), (5, 0))
    tilt = _TILT_RAD * smooth / max(float(smooth.std()), 1e-9)
    rotation = errors.drift * (heading * up + tilt)
    position = errors.drift * _POSITION_M * (root * rng.standard_normal((len(times), 3))).cumsum(0)
    half = len(times) // 2
    rotation[half:] += errors.jump * _JUMP_RAD * up
    position[half:] += errors.jump * _JUMP_M
    # Errors of motion add up in the frame of the camera's heading at the time.
    turn = se3.so3_exp(rotation)
    step = np.diff(poses[:, :3, 3], axis=0, prepend=poses[:1, :3, 3])
    step = step * (1 + errors.drift * _SCALE)
    positions = (turn @ step[..., None])[..., 0].cumsum(0) + poses[0, :3, 3] + position
    return se3.pose(turn @ poses[:, :3, :3], positions)


def _smooth(rng: np.random.Generator, shape: tuple[int, int]) -> Float64:
    """Return a smooth random field of unit variance."""
    field = gaussian_filter(rng.standard_normal(shape), _SIZE * shape[1], mode="reflect")
    return np.asarray(field / field.std())


@dataclass(frozen=True, eq=False)
class _Palette:
    """Visible colours of M materials: (M, 3) of their dark and bright parts; mean and contrast."""

    dark: Float64
    bright: Float64
    albedo: Float64
    contrast: Float64

    def reflectance(self, hits: scenes.Hits) -> Float64:
        """Return the reflectance (N, 3) of what rays hit."""
        k = hits.surface
        deviation = hits.albedo / self.albedo[k] - 1
        mix = np.clip(deviation + 0.5, 0, 1)[:, None]
        tint = (1 - mix) * self.dark[k] + mix * self.bright[k]
        grey = self.albedo[k] * (1 + self.contrast[k] * deviation)
        return np.asarray(np.clip(grey, 0.02, 1.0)[:, None] * tint)


def _palette(materials: Sequence[Material], seed: int) -> _Palette:
    dark, bright, contrast = [], [], []
    for k, material in enumerate(materials):
        rng = np.random.default_rng([seed, 8, k])
        hue, low, high, visible = _LOOKS[material.pattern]
        hue = rng.uniform() if hue is None else hue
        if material.hue is not None:
            hue, low, high = material.hue, 0.3, 0.5
        saturation = rng.uniform(low, high)
        other = hue + 0.35 if material.pattern == "print" else hue
        bright.append(_tint(hue, saturation))
        dark.append(_tint(other, saturation))
        contrast.append(visible)
    albedo = np.array([material.albedo for material in materials])
    return _Palette(np.array(dark), np.array(bright), albedo, np.array(contrast))


def _tint(hue: float, saturation: float) -> Float64:
    """Return a colour (3,) of luminance 1."""
    rgb = np.array(colorsys.hsv_to_rgb(hue % 1, saturation, 1.0))
    return np.asarray(rgb / (rgb @ [0.3, 0.59, 0.11]))


def plan_phone(
    scene: str,
    *,
    seed: int = 0,
    errors: PhoneErrors = _DEFAULT,
    every: int | None = None,
    frames: int | None = None,
    first: int = 0,
    texture: bool = True,
) -> PhonePlan:
    """Plan a recording of a phone; see `simulate` for the parameters.

    Raises
    ------
    InputError
        For an unknown scene, or one in which the object moves.
    """
    built, motion = scenes.build(scene, seed=seed, texture=texture)
    if motion.object_path is not None:
        raise InputError(
            f"in {scene!r} the camera stands", where="scene", remedy="use room or flat, for example"
        )
    raw = motion.selected(STRIDE if every is None else every, frames, first)
    return PhonePlan(built, motion, raw / motion.frame_rate_hz, errors, seed)


def write_phone(
    planned: PhonePlan, out: str | Path, progress: Callable[[int, int], None] | None = None
) -> Path:
    """Write a recording as 3d Scanner App does, and the true poses and surface in truth/.

    Raises
    ------
    OutputError
        If the folder can't be written, or isn't empty.
    """
    lens = planned.color
    K = [lens.fx, 0, lens.cx, 0, lens.fy, lens.cy, 0, 0, 1]
    projection = np.diag([2 * lens.fx / lens.width, 2 * lens.fy / lens.height, -1.0, 0.0])
    frames = zip(planned.frames(), planned.device_poses() @ _ARKIT_AXES, planned.times, strict=True)
    with staging.new_folder(out) as folder:
        truth = atomic.make_folder(folder / "truth")
        write_tum(truth / "groundtruth.txt", planned.times, planned.poses)
        write_surface(truth, planned.scene, planned.motion, planned.times[0])
        for k, (frame, pose, time) in enumerate(frames):
            write_png(folder / f"depth_{k:05d}.png", frame.depth)
            write_png(folder / f"conf_{k:05d}.png", frame.confidence)
            if frame.color is not None:
                atomic.write_bytes(folder / f"frame_{k:05d}.jpg", jpeg_bytes(frame.color))
            entry = {
                "time": float(time),
                "intrinsics": K,
                "projectionMatrix": projection.ravel().tolist(),
                "cameraPoseARFrame": pose.ravel().tolist(),
            }
            atomic.write_text(folder / f"frame_{k:05d}.json", json.dumps(entry))
            if progress is not None:
                progress(k + 1, len(planned.times))
    return Path(out)
