"""``tofuse plan``: what a camera would achieve in a place that a coarse scan knows.

The scan's mesh, with its brightness as albedo, is the scene of a simulation. Each camera is carried
along the path of the scan or another one, and what it records is reconstructed: the bound on its
poses and the part of the surface that it covers are expected of a real recording. Large images are
binned, and frames are as dense as views are stored, so that this takes a minute.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.errors import InputError
from tofuse.engine.frames import evenly_spaced
from tofuse.engine.fusion import Mesh as ScannedMesh
from tofuse.engine.geometry import KdTree, se3, triangles, unit_vectors
from tofuse.engine.mapping import reconstructing
from tofuse.engine.progress import Progress, Silent
from tofuse.engine.results import Reconstruction
from tofuse.lab.simulation import CAMERAS, CameraModel, Effects, RecordingPlan, camera_model
from tofuse.lab.world import Material, Mesh, Scene
from tofuse.lab.world import Sequence as Motion

# Levels of albedo of the scene: its mean, and the darkest and brightest.
_LEVELS, _MEAN_ALBEDO, _ALBEDO_RANGE = 8, 0.5, (0.05, 0.9)
_COLUMNS = 128  # of the simulated images
# Motion between frames: rad, and relative to the depth; twice that between stored views.
_ANGLE, _DISTANCE, _MAX_FRAMES = 0.06, 0.03, 100
# Points of the surface of which it is asked whether they are covered, and the distance, relative to
# the diagonal, within which they are.
_COVERAGE_POINTS, _COVERED = 5000, 0.005
# Rays of a pose that are to meet the scan, up to this tangent off its axis and of at most so many
# poses, and the fraction of them that must, relative to the path of the scan itself.
_RAYS, _TANGENT, _POSES, _MEETING = 7, 0.4, 50, 0.5
# Predicted and achieved bounds differ by less than this factor, see benchmarks/plan.py.
UNCERTAINTY = 1.7

# In the holes and rough spots of a coarse surface, multipath and smear are not those of the place.
_DEFAULT = Effects().without("multipath", "smear")

Decision = Literal["enough", "not enough", "undecided"]


@dataclass(frozen=True)
class Expected:
    """What is expected of a camera.

    Attributes
    ----------
    camera
        Its name.
    bound_m
        95 % bound on the rms error of the positions; inf if some motion is not constrained.
    coverage
        Fraction of the surface of the scan that its model has.
    posed
        Fraction of the frames with a pose.
    decision
        Whether the bound is within the tolerance; undecided within the error of the prediction.
    """

    camera: str
    bound_m: float
    coverage: float
    posed: float
    decision: Decision


def expect(
    scan: Reconstruction,
    cameras: Sequence[str] = (),
    *,
    poses: Float64 | None = None,
    times: Float64 | None = None,
    tolerance_m: float = 0.005,
    effects: Effects = _DEFAULT,
    threads: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[Expected]:
    """Simulate cameras in the scene of a coarse scan.

    Parameters
    ----------
    scan
        A result with a mesh.
    cameras
        Names of simulated cameras; all of them by default.
    poses, times
        (N, 4, 4) T_world_camera of a path in the world of the scan, and (N,) s; by default that of
        the scan.
    tolerance_m
        Required bound.
    effects
        Simulated errors of the cameras.

    Raises
    ------
    InputError
        If there is no such camera, no mesh, or no path.
    """
    progress = progress or Silent()
    models = [camera_model(name) for name in cameras or CAMERAS]
    if scan.mesh is None or not len(scan.mesh.faces):
        raise InputError("has no surface", where="the result", remedy="scan with a camera")
    if poses is None:
        poses, times = scan.trajectory, scan.timestamps
    known = np.isfinite(poses).all((1, 2))
    if known.sum() < 2:
        raise InputError("has fewer than two poses", where="the path", remedy="use a longer one")
    in_order = np.flatnonzero(known)
    if times is not None:  # files may have poses in any order
        in_order = in_order[np.argsort(times[in_order], kind="stable")]
        times = times[in_order]
    path = poses[in_order]
    diagonal = float(np.linalg.norm(np.ptp(scan.mesh.vertices, axis=0)))
    away = _distance_from(scan.mesh, path)
    if away > diagonal + _distance_from(scan.mesh, scan.trajectory[scan.has_pose]):
        raise InputError(
            f"leads {quantities.length(away)} away from the scan, whose diagonal is "
            f"{quantities.length(diagonal)}",
            where="the path",
            remedy="write it in metres, in the world of the scan",
        )
    scene = scene_of(scan.mesh)
    meets = _meeting(scene, scan.mesh, path)
    own = _meeting(scene, scan.mesh, scan.trajectory[scan.has_pose])
    if meets < _MEETING * own:
        raise InputError(
            f"looks elsewhere than the scan: {quantities.percent(meets)} of what its views show is "
            f"surface of the scan, and {quantities.percent(own)} from the path of the scan itself",
            where="the path",
            remedy="write T_world_camera in metres, in the world of the scan, with z forward",
        )
    depth_m = _typical_depth(scan.mesh, path)
    expected = []
    for model in models:
        plan = replace(_planned(scene, model, path, times, depth_m), effects=effects, seed=seed)
        progress.stage(f"simulating {model.name}", len(plan.raw))
        recording = plan.recording(progress=lambda *_: progress.advance())
        result = reconstructing.reconstruct(recording, threads=threads, progress=progress)
        bound_m = result.diagnostics.accuracy.position_m
        expected.append(
            Expected(
                model.name,
                bound_m,
                _coverage(scan.mesh, result, path[0] @ plan.poses),
                float(result.has_pose.mean()),
                _decision(bound_m, tolerance_m),
            )
        )
    return expected


def scene_of(mesh: ScannedMesh) -> Scene:
    """Return the mesh of a scan as a scene, its brightness as albedo in a few levels."""
    faces = mesh.faces.astype(np.int64)
    levels = np.zeros(len(faces), np.int64)
    materials = [Material("scan", _MEAN_ALBEDO)]
    if mesh.color is not None:
        grey = mesh.color.astype(float).mean(1)[faces].mean(1)
        albedo = np.clip(grey * (_MEAN_ALBEDO / max(float(grey.mean()), 1e-6)), *_ALBEDO_RANGE)
        edges = np.quantile(albedo, np.linspace(0, 1, _LEVELS + 1))
        levels = np.clip(np.searchsorted(edges, albedo, side="right") - 1, 0, _LEVELS - 1)
        materials = [
            Material(
                f"scan {k}", float(albedo[levels == k].mean()) if k in levels else _MEAN_ALBEDO
            )
            for k in range(_LEVELS)
        ]
    return Scene("scan", materials, Mesh(mesh.vertices.astype(float), faces, levels))


def _planned(
    scene: Scene, model: CameraModel, poses: Float64, times: Float64 | None, depth_m: float
) -> RecordingPlan:
    """Plan a recording along poses (N, 4, 4) with as many frames as its motion needs."""
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    motion = np.maximum(
        se3.angle(steps) / _ANGLE, np.linalg.norm(steps[:, :3, 3], axis=1) / (_DISTANCE * depth_m)
    )
    travelled = np.append(0.0, np.cumsum(np.maximum(motion, 1e-9)))
    count = int(np.clip(np.ceil(travelled[-1]) + 1, 3, _MAX_FRAMES))
    if times is None:  # by the usual speed of frames
        times = np.arange(len(poses)) / model.frame_rate_hz
    at = np.interp(np.linspace(0, travelled[-1], count), travelled, times)

    def path(t: float) -> Float64:
        # Frame k is at time k / rate, and the camera moves about it as it does there on the path.
        k = int(np.clip(round(t * rate_hz), 0, count - 1))
        s = float(at[k]) + t - k / rate_hz
        row = int(np.clip(np.searchsorted(times, s) - 1, 0, len(poses) - 2))
        fraction = (s - times[row]) / max(times[row + 1] - times[row], 1e-9)
        return se3.interpolate(poses[row], poses[row + 1], np.array(fraction))

    rate_hz = (count - 1) / max(float(times[-1] - times[0]), 1e-9)
    binned = replace(model.binned(_COLUMNS), frame_rate_hz=rate_hz)
    motion_of_camera = Motion(count, 1, rate_hz, path)
    return RecordingPlan(scene, motion_of_camera, binned, _DEFAULT, 0, np.arange(count))


def _distance_from(mesh: ScannedMesh, poses: Float64) -> float:
    """Largest distance of poses (N, 4, 4) from the box around the surface, m."""
    t = poses[:, :3, 3]
    nearest = t.clip(mesh.vertices.min(0), mesh.vertices.max(0))
    return float(np.linalg.norm(t - nearest, axis=1).max())


def _meeting(scene: Scene, mesh: ScannedMesh, poses: Float64) -> float:
    """Fraction of the rays from poses (N, 4, 4) that meet the front of the surface."""
    u, v = np.meshgrid(*[np.linspace(-_TANGENT, _TANGENT, _RAYS)] * 2)
    rays = unit_vectors(np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3))
    some = evenly_spaced(poses, _POSES)
    directions = (some[:, None, :3, :3] @ rays[:, :, None])[..., 0].reshape(-1, 3)
    origins = np.repeat(some[:, :3, 3], len(rays), axis=0)
    distance = scene.cast(origins, directions).distance.astype(float)
    met = np.isfinite(distance)
    points = origins[met] + distance[met, None] * directions[met]
    nearest, _ = KdTree(mesh.vertices.astype(float)).nearest(points, np.inf)
    facing = (mesh.normals[nearest] * directions[met]).sum(1) <= 0
    return float(facing.sum() / len(directions))


def _typical_depth(mesh: ScannedMesh, poses: Float64) -> float:
    """Median distance of the surface from the path, m."""
    some = mesh.vertices[:: max(1, len(mesh.vertices) // 500)].astype(float)
    p = poses[:: max(1, len(poses) // 20), :3, 3]
    return float(np.median(np.linalg.norm(some[:, None] - p, axis=2)))


def _coverage(mesh: ScannedMesh, result: Reconstruction, poses: Float64) -> float:
    """Fraction of the area of a mesh near a result's model, by true poses (N, 4, 4) of its frames.

    The world of the model is that of its first frame with a pose.
    """
    if result.mesh is None or not len(result.mesh.vertices):
        return 0.0
    corners = mesh.vertices.astype(float)[mesh.faces]
    area = triangles.areas(corners)
    which: Int64 = np.searchsorted(
        np.cumsum(area), (np.arange(_COVERAGE_POINTS) + 0.5) / _COVERAGE_POINTS * area.sum()
    )
    points = corners[which].mean(1)
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    first = int(result.has_pose.argmax())
    T_scan_model = poses[first] @ se3.inverse(result.trajectory[first])
    model = se3.transform(T_scan_model, result.mesh.vertices.astype(float))
    found, _ = KdTree(model).nearest(points, _COVERED * diagonal)
    return float((found >= 0).mean())


def _decision(bound_m: float, tolerance_m: float) -> Decision:
    if bound_m * UNCERTAINTY <= tolerance_m:
        return "enough"
    return "not enough" if bound_m > UNCERTAINTY * tolerance_m else "undecided"
