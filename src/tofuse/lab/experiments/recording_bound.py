"""Lower bound of the trajectory error for a simulated camera in a static scene.

The joint Cramer-Rao bound of all poses from the distances and the albedo of all pixels, with shot
noise. The scene is unknown: the surface is divided into cells of about a pixel's size, and the
height and the albedo of each are estimated as well, and so is the exposure of each view. The shape
within a cell is assumed known, and occlusion boundaries are not used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from tofuse.arrays import Bool, Float64, Int64
from tofuse.geometry import se3
from tofuse.lab.simulation import optics
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import CameraModel
from tofuse.lab.simulation.record import Plan

# Unknowns of a view: its pose, and the logarithm of its exposure.
_UNKNOWNS = 7
# Max deviation of neighbours from a plane, relative to the distance, on one surface.
_JUMP = 0.02
# Cells are sampled by a hash of their position.
_PRIMES = np.array([73_856_093, 19_349_663, 83_492_791, 2_654_435_761], np.int64)
_DRAWS = 2000


@dataclass(frozen=True, eq=False)
class Seen:
    """The view from one pose: the V pixels on a locally smooth surface.

    Attributes
    ----------
    points, normals
        (V, 3) in the camera's frame; normals have length 1.
    slopes
        (V, 2) gradient of the log albedo by x/z and y/z.
    phase
        (V,) standard deviation of the phase in rad, equal to that of the log amplitude.
    """

    points: Float64
    normals: Float64
    slopes: Float64
    phase: Float64


@dataclass(frozen=True)
class TrajectoryBound:
    """RMS errors of all positions after the best rigid alignment, m.

    Attributes
    ----------
    mean
        Lower bound for unbiased estimates, over many recordings.
    low, high
        Quantiles of 5 and 95 % of single recordings at the bound.
    """

    mean: float
    low: float
    high: float


def phase_noise(
    model: CameraModel, strength: Float64, diffuse: Float64, effects: Effects, ambient: float
) -> Float64:
    """Standard deviation (H, W) of the phase, rad, by the shot noise of four phase images.

    Parameters
    ----------
    strength, diffuse
        (H, W) direct light relative to a white wall at 1 m, and albedo.
    ambient
        Of the scene.
    """
    signal = model.signal_electrons * strength * model.transmission
    background = effects.ambient * model.ambient_electrons * ambient
    other = background * diffuse * np.sqrt(model.transmission)
    # Each part of the phasor is half the difference of two of the images.
    variance = (signal + other + 2 * model.read_noise_electrons**2) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(variance) / (model.modulation_contrast * signal)


def seen_by(plan: Plan, raw: int) -> Seen:
    """Return the camera's view of raw frame `raw`."""
    model, time_s = plan.model, raw / plan.sequence.frame_rate_hz
    T_room_camera = plan.sequence.T_room_camera(time_s)
    grid = optics.ray_grid(model, plan.effects.mixed_pixels)
    found = optics.trace(
        plan.scene,
        model,
        grid.directions.reshape(-1, 3),
        T_room_camera,
        plan.sequence.T_room_bodies(time_s),
        gloss=plan.effects.gloss,
    )
    fine = grid.directions.shape[:2]
    directions = grid.directions[grid.centre]
    rays = directions[..., :2] / directions[..., 2:]
    shape = rays.shape[:2]
    distance = found.distance.reshape(fine)[grid.centre]
    normals = (found.normals @ T_room_camera[:3, :3]).reshape(*fine, 3)[grid.centre]
    points = np.where(np.isfinite(distance), distance, 0.0)[..., None] * directions
    blur = model.blur_px if plan.effects.mixed_pixels else 0.0
    # Light of the whole pixel, with the lens blur.
    strength, diffuse = (
        optics.blurred(of(grid, found, model.modulation_hz)[..., 0], blur)
        for of in (optics.pixel_phasors, optics.bounce_weights)
    )
    phase = phase_noise(model, strength, diffuse, plan.effects, plan.scene.ambient)
    whole = np.isfinite(distance) & (distance < model.ambiguity_m) & (diffuse > 0)
    whole &= np.isfinite(phase) & (phase > 0)
    brightness = np.log(np.where(whole, diffuse, 1.0))
    inner = np.zeros(shape, bool)
    inner[1:-1, 1:-1] = whole[1:-1, 1:-1]
    slopes = np.zeros((*shape, 2))
    middle = (slice(1, -1), slice(1, -1))
    for axis in (0, 1):
        ahead = tuple(slice(2, None) if a == axis else slice(1, -1) for a in (0, 1))
        behind = tuple(slice(None, -2) if a == axis else slice(1, -1) for a in (0, 1))
        for side in (ahead, behind):
            apart = np.abs(((points[side] - points[middle]) * normals[middle]).sum(-1))
            inner[middle] &= whole[side] & (apart < _JUMP * distance[middle])
        column = 1 - axis
        across = rays[ahead][..., column] - rays[behind][..., column]
        slopes[(*middle, column)] = (brightness[ahead] - brightness[behind]) / across
    return Seen(points[inner], normals[inner], slopes[inner], phase[inner])


def trajectory_bounds(plan: Plan, *, every: int = 8) -> tuple[TrajectoryBound, TrajectoryBound]:
    """Bounds of a recording: from distances only, and from distances and albedo.

    Parameters
    ----------
    every
        One of `every` cells is evaluated and represents the others.
    """
    poses, period = plan.poses, plan.model.period_m
    n = len(poses)
    height, photometric = _Cells(n), _Cells(n)
    pitch = float(np.nanmedian(np.abs(np.diff(plan.model.camera.rays()[..., 0], axis=1))))
    size = 0.0
    for k, raw in enumerate(plan.raw.tolist()):
        view = seen_by(plan, int(raw))
        p, m = view.points, view.normals
        size = size or pitch * float(np.median(p[:, 2]))
        cells = _cells(se3.transform(poses[k], p), m @ poses[k][:3, :3].T, size)
        some = np.abs(cells * _PRIMES[0]) % every == 0
        p, m, cells = p[some], m[some], cells[some]
        phase, slopes, z = view.phase[some], view.slopes[some], view.points[some, 2:]
        # Error normal to the surface = error along the ray times the cosine.
        cosine = np.maximum(np.abs((p * m).sum(1)) / np.linalg.norm(p, axis=1), 1e-3)
        sigma = phase / (2 * np.pi) * period * cosine
        height.add(k, cells, _rows(m, p, 0.0), every / sigma**2)
        d = np.hstack([slopes, -(slopes * p[:, :2] / z).sum(1, keepdims=True)]) / z
        photometric.add(k, cells, _rows(d, p, -1.0), every / phase**2)
    of_distances = height.information()
    of_both = of_distances + photometric.information()
    unknowns = np.arange(n * _UNKNOWNS)
    # The first view's pose and exposure are given. Exposures affect albedo only.
    moving = unknowns >= _UNKNOWNS
    return (
        _after_alignment(of_distances, poses, moving & (unknowns % _UNKNOWNS != 6)),
        _after_alignment(of_both, poses, moving),
    )


def _rows(direction: Float64, p: Float64, exposure: float) -> Float64:
    """Jacobian (M, UNKNOWNS) of the residuals by pose and exposure."""
    return np.hstack([direction, np.cross(p, direction), np.full((len(p), 1), exposure)])


class _Cells:
    """Unknowns of the surface, one per cell, and their observations by each view."""

    def __init__(self, views: int) -> None:
        self._views = views
        self._cells: list[Int64] = []
        self._view: list[Int64] = []
        self._mixed: list[Float64] = []
        self._own: list[Float64] = []
        self._known = np.zeros((views, _UNKNOWNS, views, _UNKNOWNS))

    def add(self, k: int, cells: Int64, J: Float64, weight: Float64) -> None:
        """Add view k: the cell (M,), Jacobian (M, UNKNOWNS) and weight (M,) of each pixel."""
        self._known[k, :, k] += (J * weight[:, None]).T @ J
        found, at = np.unique(cells, return_inverse=True)
        at = at.ravel()
        mixed = [np.bincount(at, weight * J[:, q], len(found)) for q in range(_UNKNOWNS)]
        self._cells.append(found)
        self._view.append(np.full(len(found), k, np.int64))
        self._mixed.append(np.stack(mixed, 1).astype(np.float64))
        self._own.append(np.bincount(at, weight, len(found)).astype(np.float64))

    def information(self) -> Float64:
        """(N UNKNOWNS, N UNKNOWNS) information of the views, with the surface eliminated."""
        _, cell = np.unique(np.concatenate(self._cells), return_inverse=True)
        cell = cell.ravel()
        own = np.bincount(cell, np.concatenate(self._own))
        view, mixed = np.concatenate(self._view), np.concatenate(self._mixed)
        mixed /= np.sqrt(own[cell])[:, None]
        columns = view[:, None] * _UNKNOWNS + np.arange(_UNKNOWNS)
        rows = np.repeat(cell, _UNKNOWNS)
        shape = len(own), self._views * _UNKNOWNS
        A = sparse.csr_array((mixed.ravel(), (rows, columns.ravel())), shape=shape)
        known = self._known.reshape(self._views * _UNKNOWNS, -1)
        return np.asarray(known - (A.T @ A).toarray(), np.float64)


def _cells(points: Float64, normals: Float64, size: float) -> Int64:
    """(M,) cell index of each point in the world, by position and normal direction."""
    axis = np.argmax(np.abs(normals), axis=1)
    side = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] > 0)
    place = np.floor(points / size).astype(np.int64)
    key: Int64 = (np.column_stack([place, side]) * _PRIMES).sum(1)
    return key


def _after_alignment(information: Float64, poses: Float64, free: Bool) -> TrajectoryBound:
    """RMS of random errors of the free unknowns after the best rigid alignment."""
    n, at = len(poses), poses[:, :3, 3]
    L = np.linalg.cholesky(information[np.ix_(free, free)])
    drawn = np.random.default_rng([0]).normal(size=(len(L), _DRAWS))
    steps = np.zeros((n * _UNKNOWNS, _DRAWS))
    steps[free] = np.linalg.solve(L.T, drawn)
    errors = poses[:, :3, :3] @ steps.reshape(n, _UNKNOWNS, -1)[:, :3]
    flat = errors.reshape(3 * n, -1)
    G = np.hstack([np.tile(np.eye(3), (n, 1)), -se3.hat(at - at.mean(0)).reshape(3 * n, 3)])
    flat = flat - G @ (np.linalg.pinv(G) @ flat)
    rms = np.sqrt((flat**2).sum(0) / n)
    low, high = np.quantile(rms, [0.05, 0.95])
    return TrajectoryBound(float(rms.mean()), float(low), float(high))
