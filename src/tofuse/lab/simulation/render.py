"""One frame of a simulated recording, with its ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Bool, Complex128, Float32, Float64, UInt16
from tofuse.engine.cameras import ray_lengths
from tofuse.engine.frames import RangeFrame, depth_counts
from tofuse.lab.simulation import optics, sensor
from tofuse.lab.simulation.effects import Effects, Flag
from tofuse.lab.simulation.models import CameraModel
from tofuse.lab.world import Scene, Sequence

_DEFAULT = Effects()
_FLAG_THRESHOLD_M = 0.003
_MIXED_M, _MIXED_FRACTION = 0.02, 0.01
_MIRROR_FRACTION = 0.1


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """A frame as the camera reports it, and its ground truth.

    Attributes
    ----------
    frame
        Its depth is not corrected.
    depth
        (H, W) float32, true depth in m at the pixel centres at the frame's timestamp, in the
        frame's depth kind; 0 without a surface.
    flags
        (H, W) uint16 of `Flag` bits.
    """

    frame: RangeFrame
    depth: Float32
    flags: UInt16


@dataclass(frozen=True, eq=False)
class _Light:
    """Light of one pose: (F, H, W, 7) direct and single-bounce, and the ray hits."""

    direct: Float64
    weights: Float64
    returns: optics.Returns


def tap_times(model: CameraModel, time_s: float) -> Float64:
    """Mid-exposure times (4,) in s of a frame's phase images, centred on its timestamp."""
    return time_s + (np.arange(sensor.TAPS) - 1.5) / sensor.TAPS * model.integration_s


def render(
    scene: Scene,
    sequence: Sequence,
    model: CameraModel,
    index: int,
    *,
    effects: Effects = _DEFAULT,
    seed: int = 0,
) -> RenderedFrame:
    """Render raw frame `index` of a sequence, at the time index / frame rate.

    The result depends neither on the other frames rendered nor on the number of threads.
    """
    time_s = index / sequence.frame_rate_hz
    grid = optics.ray_grid(model, effects.mixed_pixels)
    poses = [
        (sequence.T_room_camera(t), sequence.T_room_bodies(t))
        for t in (*tap_times(model, time_s), time_s)
    ]
    static = not effects.smear or all(_same_poses(pose, poses[-1]) for pose in poses)

    def light(pose: tuple[Float64, Float64 | None], rays: optics.RayGrid) -> _Light:
        returns = optics.trace(
            scene, model, rays.directions.reshape(-1, 3), *pose, gloss=effects.gloss
        )
        direct = [optics.pixel_phasors(rays, returns, f) for f in model.frequencies]
        weights = [
            optics.bounce_weights(rays, returns, f)
            for f in (model.frequencies if effects.multipath else model.frequencies[:1])
        ]
        return _Light(np.stack(direct), np.stack(weights), returns)

    taps = [light(poses[-1], grid)] if static else [light(pose, grid) for pose in poses[:-1]]
    centre_returns = taps[0].returns if static else None
    centre_grid = grid
    if centre_returns is None:
        centre_grid = optics.ray_grid(model, False)
        centre_returns = optics.trace(
            scene, model, centre_grid.directions.reshape(-1, 3), *poses[-1], gloss=effects.gloss
        )
    shape = centre_grid.directions.shape
    distance = centre_returns.distance.reshape(shape[:2])[centre_grid.centre]
    bounced = None
    if effects.multipath:
        points = centre_returns.points.reshape(shape)[centre_grid.centre]
        normals = centre_returns.normals.reshape(shape)[centre_grid.centre]
        bounced = optics.single_bounce_light(
            scene, model, points, normals, *poses[-1], gloss=effects.gloss
        )

    phase_images = _phase_images(model, effects, taps, bounced)
    exposure = phase_images.exposure(model, effects, scene.ambient)
    measured = sensor.expose(model, effects, exposure, np.random.default_rng([seed, index]))
    expected = sensor.expose(model, effects, exposure, None)
    ranges = _add_offsets(model, effects, measured.range_m, time_s)
    if not effects.wrap:
        travelled = optics.travelled(centre_returns).reshape(shape[:2])[centre_grid.centre]
        periods = np.round(
            (np.where(np.isfinite(travelled), travelled, ranges) - ranges) / model.period_m
        )
        ranges = np.maximum(ranges + periods * model.period_m, 0)

    measured = sensor.Measurement(ranges, measured.amplitude, measured.saturated)
    flags = phase_images.flags(model, effects)
    flags |= _pixel_flags(model, grid, taps, distance, ranges, expected)
    surface = centre_returns.surface.reshape(shape[:2])[centre_grid.centre]
    flags |= _bit(np.isin(surface, list(scene.passing_surfaces)), Flag.PASSING)
    return RenderedFrame(
        _frame(model, effects, measured, index, time_s),
        _in_depth_kind(model, np.where(np.isfinite(distance), distance, 0)),
        flags,
    )


def _same_poses(a: tuple[Float64, Float64 | None], b: tuple[Float64, Float64 | None]) -> bool:
    return all(
        (x is None and y is None)
        or (x is not None and y is not None and np.abs(x - y).max() < 1e-12)
        for x, y in zip(a, b, strict=True)
    )


@dataclass(frozen=True, eq=False)
class _PhaseImages:
    """Light of the phase images before scattering in the lens.

    Attributes
    ----------
    sharp, direct, combined
        (F, 4, H, W) correlations of direct light, before and after the lens blur, and including
        single-bounce light.
    total
        (F, 4, H, W) all modulated light.
    albedo
        (H, W) diffuse reflectance.
    unsmeared
        (H, W) phasor of direct light without motion during the exposures; None for a static scene.
    """

    sharp: Float64
    direct: Float64
    combined: Float64
    total: Float64
    albedo: Float64
    unsmeared: Complex128 | None

    def scattered(self, model: CameraModel, effects: Effects, images: Float64) -> Float64:
        camera = model.camera
        scatter = optics.LensScatter(camera.width, camera.height, effects.scatter)
        images = images * model.transmission
        if effects.scatter == 0:
            return images
        return np.stack([[scatter(image) for image in taps] for taps in images])

    def exposure(self, model: CameraModel, effects: Effects, ambient: float) -> sensor.Exposure:
        background = ambient * self.albedo * np.sqrt(model.transmission)
        return sensor.Exposure(
            self.scattered(model, effects, self.combined),
            self.scattered(model, effects, self.total),
            background,
        )

    def flags(self, model: CameraModel, effects: Effects) -> UInt16:
        """Bits of the effects that are determined by the light alone."""
        out = np.zeros(self.direct.shape[2:], np.uint16)
        combined = sensor.phasor_of(self.combined[0])
        direct = sensor.phasor_of(self.direct[0])
        if effects.mixed_pixels:
            sharp = sensor.phasor_of(self.sharp[0])
            out |= _bit(_ranges_differ(model, direct, sharp, _MIXED_M), Flag.MIXED)
        if effects.multipath:
            out |= _bit(_ranges_differ(model, combined, direct), Flag.MULTIPATH)
        if self.unsmeared is not None:
            out |= _bit(_ranges_differ(model, direct, self.unsmeared), Flag.SMEAR)
        if effects.scatter > 0:
            scattered = sensor.phasor_of(self.scattered(model, effects, self.combined[:1])[0])
            out |= _bit(_ranges_differ(model, scattered, combined), Flag.SCATTER)
        return out


def _bit(mask: Bool, flag: Flag) -> UInt16:
    return np.where(mask, np.uint16(flag), np.uint16(0))


def _ranges_differ(
    model: CameraModel, a: Complex128, b: Complex128, limit_m: float = _FLAG_THRESHOLD_M
) -> Bool:
    """Mask of phasors whose ranges differ by more than `limit_m`; False where one is zero."""
    difference = np.abs(np.angle(a * np.conj(b))) / (2 * np.pi) * model.period_m
    return (difference > limit_m) & (np.abs(a) > 0) & (np.abs(b) > 0)


def _phase_images(
    model: CameraModel, effects: Effects, taps: list[_Light], bounced: list[Float64] | None
) -> _PhaseImages:
    harmonics = sensor.scaled_harmonics(model, effects)
    count, (height, width) = len(model.frequencies), taps[0].direct.shape[1:3]
    direct = np.empty((count, sensor.TAPS, height, width))
    combined, total = np.empty_like(direct), np.empty_like(direct)
    for f in range(count):
        for k in range(sensor.TAPS):
            light = taps[k if len(taps) > 1 else 0]
            direct[f, k] = sensor.correlate(light.direct[f], k, harmonics)
            combined[f, k], total[f, k] = direct[f, k], light.direct[f, ..., 0]
            if bounced is not None:
                indirect = optics.combine(light.weights[f], bounced[f])
                combined[f, k] += sensor.correlate(indirect, k, harmonics)
                total[f, k] += indirect[..., 0]
    sharp = direct
    if effects.mixed_pixels:
        direct, combined, total = (
            optics.gaussian_blur(x, model.blur_px) for x in (direct, combined, total)
        )
    unsmeared = None
    if len(taps) > 1:
        light = np.mean([tap.direct[0] for tap in taps], axis=0)
        static = np.stack([sensor.correlate(light, k, harmonics) for k in range(sensor.TAPS)])
        if effects.mixed_pixels:
            static = optics.gaussian_blur(static, model.blur_px)
        unsmeared = sensor.phasor_of(static)
    albedo = taps[len(taps) // 2].weights[0, ..., 0]
    return _PhaseImages(sharp, direct, combined, total, albedo, unsmeared)


def _add_offsets(model: CameraModel, effects: Effects, ranges: Float64, time_s: float) -> Float64:
    """Add the range offsets of pixels and thermal drift, which wrap with the phase."""
    ranges = ranges + effects.pixel_offsets * sensor.pixel_offsets(model)
    ranges += effects.thermal_drift * sensor.drift(model, time_s)
    return np.mod(ranges, model.ambiguity_m)


def _pixel_flags(
    model: CameraModel,
    grid: optics.RayGrid,
    taps: list[_Light],
    distance: Float64,
    ranges: Float64,
    expected: sensor.Measurement,
) -> UInt16:
    hit = np.isfinite(distance)
    out = _bit(~hit, Flag.NO_RETURN)
    min_amplitude = max(model.minimum_amplitude, *model.confidence_thresholds[:1], 0.0)
    out |= _bit(expected.amplitude < min_amplitude, Flag.UNDER_EXPOSED)
    out |= _bit(expected.saturated, Flag.SATURATED)
    if grid.window > 1:
        deviation = np.max([optics.plane_deviation(grid, tap.returns) for tap in taps], axis=0)
        limit = np.maximum(_MIXED_M, _MIXED_FRACTION * np.where(hit, distance, 0))
        out |= _bit(deviation > limit, Flag.MIXED)
    # Half of the shortest ambiguity period.
    out |= _bit(
        hit & (np.abs(ranges - np.where(hit, distance, 0)) > model.period_m / 2), Flag.WRAPPED
    )
    fraction = np.zeros(distance.shape)
    for tap in taps:
        strength = tap.returns.strength
        if strength.shape[1] > 1:
            total = strength.sum(1)
            specular = strength[:, 1:].sum(1) / np.where(total > 0, total, 1)
            fine_fraction = specular.reshape(grid.directions.shape[:2])
            fraction = np.maximum(fraction, fine_fraction[grid.centre])
    return out | _bit(fraction > _MIRROR_FRACTION, Flag.MIRROR)


def _in_depth_kind(model: CameraModel, radial: Float64) -> Float32:
    if model.depth_kind == "z":
        radial = radial / ray_lengths(model.camera)
    return np.where(np.isfinite(radial), radial, 0).astype(np.float32)


def _frame(
    model: CameraModel, effects: Effects, measured: sensor.Measurement, index: int, time_s: float
) -> RangeFrame:
    depth = np.where(measured.saturated, 0, _in_depth_kind(model, measured.range_m))
    if effects.under_exposure:
        depth = np.where(measured.amplitude < model.minimum_amplitude, 0, depth)
    counts = np.round(depth / model.depth_unit_m)
    counts = np.where(counts < depth_counts.INVALID_DEPTH, counts, 0).astype(np.uint16)
    return RangeFrame(
        index,
        time_s,
        model.camera,
        depth_counts.depth_from_counts(counts, model.depth_unit_m),
        model.depth_kind,
        sensor.reported_amplitude(model, measured),
        sensor.reported_confidence(model, measured),
        sigma_image=sensor.reported_sigma(model, measured),
        amplitude_kind=model.amplitude_kind,
        ambiguity_m=model.ambiguity_m,
    )
