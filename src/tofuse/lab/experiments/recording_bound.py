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

from tofuse.engine.arrays import Bool, Float64, Int64
from tofuse.engine.geometry import se3
from tofuse.lab.simulation import CameraModel, Effects, RecordingPlan, optics

# Unknowns of a view: its pose, and the logarithm of its exposure.
_UNKNOWNS = 7
# Max deviation of neighbours from a plane, relative to the distance, on one surface.
_JUMP = 0.02
# Cells are sampled by a hash of their position.
_PRIMES = np.array([73_856_093, 19_349_663, 83_492_791, 2_654_435_761], np.int64)
_DRAWS = 2000


@dataclass(frozen=True, eq=False)
class VisiblePixels:
    """The V pixels of a view that lie on a locally smooth surface.

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
    ambient_electrons = background * diffuse * np.sqrt(model.transmission)
    # Each part of the phasor is half the difference of two of the images.
    variance = (signal + ambient_electrons + 2 * model.read_noise_electrons**2) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(variance) / (model.modulation_contrast * signal)


def visible_pixels(plan: RecordingPlan, raw: int) -> VisiblePixels:
    """Return the pixels of raw frame `raw` on smooth surfaces."""
    model, time_s = plan.model, raw / plan.sequence.frame_rate_hz
    T_room_camera = plan.sequence.T_room_camera(time_s)
    grid = optics.ray_grid(model, plan.effects.mixed_pixels)
    returns = optics.trace(
        plan.scene,
        model,
        grid.directions.reshape(-1, 3),
        T_room_camera,
        plan.sequence.T_room_bodies(time_s),
        gloss=plan.effects.gloss,
    )
    fine_shape = grid.directions.shape[:2]
    directions = grid.directions[grid.centre]
    rays = directions[..., :2] / directions[..., 2:]
    shape = rays.shape[:2]
    distance = returns.distance.reshape(fine_shape)[grid.centre]
    normals = (returns.normals @ T_room_camera[:3, :3]).reshape(*fine_shape, 3)[grid.centre]
    points = np.where(np.isfinite(distance), distance, 0.0)[..., None] * directions
    blur = model.blur_px if plan.effects.mixed_pixels else 0.0
    # Light of the whole pixel, with the lens blur.
    strength, diffuse = (
        optics.gaussian_blur(of(grid, returns, model.modulation_hz)[..., 0], blur)
        for of in (optics.pixel_phasors, optics.bounce_weights)
    )
    phase = phase_noise(model, strength, diffuse, plan.effects, plan.scene.ambient)
    valid = np.isfinite(distance) & (distance < model.ambiguity_m) & (diffuse > 0)
    valid &= np.isfinite(phase) & (phase > 0)
    log_albedo = np.log(np.where(valid, diffuse, 1.0))
    smooth = np.zeros(shape, bool)
    smooth[1:-1, 1:-1] = valid[1:-1, 1:-1]
    slopes = np.zeros((*shape, 2))
    interior = (slice(1, -1), slice(1, -1))
    for axis in (0, 1):
        forward = tuple(slice(2, None) if a == axis else slice(1, -1) for a in (0, 1))
        backward = tuple(slice(None, -2) if a == axis else slice(1, -1) for a in (0, 1))
        for side in (forward, backward):
            deviation = np.abs(((points[side] - points[interior]) * normals[interior]).sum(-1))
            smooth[interior] &= valid[side] & (deviation < _JUMP * distance[interior])
        column = 1 - axis
        spacing = rays[forward][..., column] - rays[backward][..., column]
        slopes[(*interior, column)] = (log_albedo[forward] - log_albedo[backward]) / spacing
    return VisiblePixels(points[smooth], normals[smooth], slopes[smooth], phase[smooth])


def trajectory_bounds(
    plan: RecordingPlan, *, every: int = 8
) -> tuple[TrajectoryBound, TrajectoryBound]:
    """Bounds of a recording: from distances only, and from distances and albedo.

    Parameters
    ----------
    every
        Every n-th cell is evaluated, and represents the others.
    """
    poses, period = plan.poses, plan.model.period_m
    n = len(poses)
    geometric, photometric = _Cells(n), _Cells(n)
    pitch = float(np.nanmedian(np.abs(np.diff(plan.model.camera.rays()[..., 0], axis=1))))
    size = 0.0
    for k, raw in enumerate(plan.raw.tolist()):
        view = visible_pixels(plan, int(raw))
        p, m = view.points, view.normals
        size = size or pitch * float(np.median(p[:, 2]))
        cells = _cells(se3.transform(poses[k], p), m @ poses[k][:3, :3].T, size)
        sampled = np.abs(cells * _PRIMES[0]) % every == 0
        p, m, cells = p[sampled], m[sampled], cells[sampled]
        phase, slopes, z = view.phase[sampled], view.slopes[sampled], view.points[sampled, 2:]
        # Error normal to the surface = error along the ray times the cosine.
        cosine = np.maximum(np.abs((p * m).sum(1)) / np.linalg.norm(p, axis=1), 1e-3)
        sigma = phase / (2 * np.pi) * period * cosine
        geometric.add(k, cells, _rows(m, p, 0.0), every / sigma**2)
        d = np.hstack([slopes, -(slopes * p[:, :2] / z).sum(1, keepdims=True)]) / z
        photometric.add(k, cells, _rows(d, p, -1.0), every / phase**2)
    range_information = geometric.information()
    total_information = range_information + photometric.information()
    unknowns = np.arange(n * _UNKNOWNS)
    # The first view's pose and exposure are given. Exposures affect albedo only.
    estimated = unknowns >= _UNKNOWNS
    return (
        _after_alignment(range_information, poses, estimated & (unknowns % _UNKNOWNS != 6)),
        _after_alignment(total_information, poses, estimated),
    )


def _rows(direction: Float64, p: Float64, exposure: float) -> Float64:
    """Jacobian (M, UNKNOWNS) of the residuals by pose and exposure."""
    return np.hstack([direction, np.cross(p, direction), np.full((len(p), 1), exposure)])


class _Cells:
    """Unknowns of the surface, one per cell, and their observations by each view.

    `add` accumulates the blocks of the information matrix, and `information` eliminates the cells.
    """

    def __init__(self, views: int) -> None:
        self._views = views
        self._cells: list[Int64] = []
        self._view: list[Int64] = []
        self._coupling: list[Float64] = []
        self._cell_information: list[Float64] = []
        self._view_information = np.zeros((views, _UNKNOWNS, views, _UNKNOWNS))

    def add(self, k: int, cells: Int64, J: Float64, weight: Float64) -> None:
        """Add view k: the cell (M,), Jacobian (M, UNKNOWNS) and weight (M,) of each pixel."""
        self._view_information[k, :, k] += (J * weight[:, None]).T @ J
        unique_cells, inverse = np.unique(cells, return_inverse=True)
        inverse = inverse.ravel()
        coupling = [
            np.bincount(inverse, weight * J[:, q], len(unique_cells)) for q in range(_UNKNOWNS)
        ]
        self._cells.append(unique_cells)
        self._view.append(np.full(len(unique_cells), k, np.int64))
        self._coupling.append(np.stack(coupling, 1).astype(np.float64))
        self._cell_information.append(
            np.bincount(inverse, weight, len(unique_cells)).astype(np.float64)
        )

    def information(self) -> Float64:
        """(N UNKNOWNS, N UNKNOWNS) information of the views, with the surface eliminated."""
        _, cell = np.unique(np.concatenate(self._cells), return_inverse=True)
        cell = cell.ravel()
        cell_information = np.bincount(cell, np.concatenate(self._cell_information))
        view, coupling = np.concatenate(self._view), np.concatenate(self._coupling)
        coupling /= np.sqrt(cell_information[cell])[:, None]
        columns = view[:, None] * _UNKNOWNS + np.arange(_UNKNOWNS)
        rows = np.repeat(cell, _UNKNOWNS)
        shape = len(cell_information), self._views * _UNKNOWNS
        A = sparse.csr_array((coupling.ravel(), (rows, columns.ravel())), shape=shape)
        view_information = self._view_information.reshape(self._views * _UNKNOWNS, -1)
        return np.asarray(view_information - (A.T @ A).toarray(), np.float64)


def _cells(points: Float64, normals: Float64, size: float) -> Int64:
    """(M,) cell index of each point in the world, by position and normal direction."""
    axis = np.argmax(np.abs(normals), axis=1)
    normal_bin = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] > 0)
    position_bin = np.floor(points / size).astype(np.int64)
    key: Int64 = (np.column_stack([position_bin, normal_bin]) * _PRIMES).sum(1)
    return key


def _after_alignment(information: Float64, poses: Float64, estimated: Bool) -> TrajectoryBound:
    """RMS of random errors of the estimated unknowns after the best rigid alignment."""
    n, positions = len(poses), poses[:, :3, 3]
    L = np.linalg.cholesky(information[np.ix_(estimated, estimated)])
    samples = np.random.default_rng([0]).normal(size=(len(L), _DRAWS))
    perturbations = np.zeros((n * _UNKNOWNS, _DRAWS))
    perturbations[estimated] = np.linalg.solve(L.T, samples)
    errors = poses[:, :3, :3] @ perturbations.reshape(n, _UNKNOWNS, -1)[:, :3]
    stacked = errors.reshape(3 * n, -1)
    G = np.hstack(
        [np.tile(np.eye(3), (n, 1)), -se3.hat(positions - positions.mean(0)).reshape(3 * n, 3)]
    )
    stacked = stacked - G @ (np.linalg.pinv(G) @ stacked)
    rms = np.sqrt((stacked**2).sum(0) / n)
    low, high = np.quantile(rms, [0.05, 0.95])
    return TrajectoryBound(float(rms.mean()), float(low), float(high))
