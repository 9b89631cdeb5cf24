"""Lengths between two points of a model: whether the stated intervals contain the true ones.

`simulated`: points of the surface in simulated recordings with exact truth, of ToF cameras and of a
phone with smooth depth, with the right focal length and with wrong ones. The true place of a point
is the mean of what the images that measured it saw at its pixels.

`recorded`: known lengths in real recordings.

    python benchmarks/lengths.py simulated [--names "room, turn"] [--focal 1 1.02] [--seeds 1]
    python benchmarks/lengths.py recorded [--data FOLDER]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import phone
import unusual
from tofuse.apps.api.result import Result, reconstruct
from tofuse.apps.coach import LengthErrors
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import POSES_BY, ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.formats.cameras.calibration_files import corrected_depth
from tofuse.lab.simulation import sensor
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.record import RecordingPlan
from tofuse.lab.world import paths
from tofuse.lab.world import scene as scenes

CAMERAS = {
    "o3r": unusual.pinhole("ifm-o3r", 80, 60, 60),
    "azure": unusual.pinhole("azure-nfov", 96, 80, 75),
    "sr4000": unusual.pinhole("sr4000", 88, 72, 44),
    "phone": unusual.pinhole("sr4000", 96, 72, 62),
}
# Points of a model, and pairs of them of each kind, which are at least so far apart.
VERTICES, PAIRS, MIN_LENGTH = 400, 400, 0.05
# Points count that at least so many images saw, without a larger jump of the range, as a fraction of
# it, within so many pixels: no one can tap on what is mixed with its background.
VIEWS, JUMP, EDGE = 3, 0.15, 2
# Pairs of points by the fraction of the images of one that saw the other as well, above the first.
KINDS = {"the same views": 0.8, "some of them": 0.0, "no common view": -1.0}


@dataclass(frozen=True)
class Case:
    """A scene and motion, and how many frames of it at which rate."""

    scene: unusual.Unusual
    frames: int
    rate_hz: float


def _unusual(name: str) -> unusual.Unusual:
    return unusual.UNUSUAL[name]


_room, _flat = _unusual("80 x 60 pixels"), _unusual("elsewhere in the flat")
CASES = {
    "room, turn": Case(_room, 64, 2.1),
    "room, short": Case(_room, 24, 6.0),
    "attic, turn": Case(_unusual("attic"), 64, 6.2),
    "flat, walk": Case(_flat, 48, 6.0),
    "books, pan": Case(_unusual("bookshelf"), 40, 4.0),
}


@dataclass(frozen=True, eq=False)
class Taken:
    """A recording with the stated camera, and the true points of its pixels.

    Attributes
    ----------
    points
        (H, W, 3) of each frame, in the world of the first camera; NaN without a surface.
    poses
        (N, 4, 4) true ones.
    """

    recording: Recording
    camera: Pinhole
    points: list[Float64]
    poses: Float64


def simulated(case: Case, camera: str, seed: int, focal: float) -> Taken:
    """Simulate a case; the stated focal length is `focal` times the true one.

    A phone has smooth depth without amplitude, and own poses that drift.
    """
    model = replace(CAMERAS[camera], frame_rate_hz=case.rate_hz)
    effects = Effects.none() if camera == "phone" else Effects()
    sequence = scenes.Sequence(case.frames, 1, case.rate_hz, case.scene.path(seed))
    scene = case.scene.scene(seed)
    made = RecordingPlan(scene, sequence, model, effects, seed, np.arange(case.frames))
    true = made.model.camera
    stated = replace(true, fx=focal * true.fx, fy=focal * true.fy)
    factory = sensor.factory_correction(model, effects)
    rng, error = np.random.default_rng([seed, 5]), np.zeros((true.height, true.width))
    frames: list[RangeFrame] = []
    points: list[Float64] = []
    for T, rendered in zip(made.poses, made.frames(None), strict=True):
        frame = rendered.frame
        if camera == "phone":
            error = phone._next_field(error, rng, first=not frames)
            frame = phone._as_phone(frame, error)
        else:
            depth = corrected_depth(factory, frame.camera, frame.depth, frame.depth_kind)
            frame = replace(frame, depth=depth)
        z = replace(rendered.frame, depth=rendered.depth).z.astype(float)[..., None]
        exact = np.where(z > 0, np.concatenate([z * true.rays(), z], -1), np.nan)
        points.append(exact @ T[:3, :3].T + T[:3, 3])
        frames.append(replace(frame, camera=stated))
    metadata = {"frame_rate_hz": case.rate_hz, "sensor": f"lengths {camera}"}
    poses = made.poses
    if camera == "phone":
        times = np.array([frame.timestamp for frame in frames])
        up = sequence.T_room_camera(times[0])[:3, :3].T @ [0.0, 0.0, 1.0]
        poses = phone.drifting(poses, times, up, phone.DRIFTS["usual"], rng)
        metadata |= {POSES_BY: "a simulated phone", "depth_kind": "z", "depth_unit_m": 0.001}
    source = ArraySource(frames, poses, metadata=metadata)
    return Taken(Recording.of(source, "simulated", "simulated"), stated, points, made.poses)


def _spread(range_m: Float64) -> Float64:
    """Difference of the largest and smallest range around each pixel; NaN at missing ones."""
    size = 2 * EDGE + 1
    padded = np.pad(range_m, EDGE, constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, (size, size))
    return np.ptp(around, axis=(2, 3))


def true_places(taken: Taken, poses: Float64, vertices: Float64) -> tuple[Float64, Float64]:
    """Return the true places (V, 3) of vertices, and which frames (V, F) measured them.

    Parameters
    ----------
    poses
        (F, 4, 4) as estimated, NaN where there is none.
    vertices
        (V, 3) of the model.
    """
    total = np.zeros_like(vertices)
    seen = np.zeros((len(vertices), len(poses)), np.bool_)
    for k in np.flatnonzero(np.isfinite(poses[:, 0, 0])):
        points, camera = taken.points[k], taken.camera
        place = se3.transform(se3.inverse(poses[k]), vertices)
        pixel = np.nan_to_num(camera.project(place), nan=-1)
        low = np.floor(pixel).astype(int)
        edge = np.array([camera.width, camera.height]) - EDGE - 1
        inside = ((low >= EDGE) & (low < edge)).all(1)
        u, v = np.where(inside[:, None], low, 0).T
        a, b = np.where(inside[:, None], pixel - low, 0).T[..., None]
        corners = [points[v, u], points[v, u + 1], points[v + 1, u], points[v + 1, u + 1]]
        q = (1 - b) * ((1 - a) * corners[0] + a * corners[1])
        q += b * ((1 - a) * corners[2] + a * corners[3])
        range_m = np.linalg.norm(points - taken.poses[k, :3, 3], axis=2)
        depth = np.linalg.norm(place, axis=1)
        near = np.abs(range_m[v, u] - depth) < 0.05 + 0.05 * depth
        ok = inside & near & (_spread(range_m)[v, u] < JUMP * depth)
        total[ok] += q[ok]
        seen[ok, k] = True
    return total / seen.sum(1)[:, None], seen


@dataclass(frozen=True, eq=False)
class Measured:
    """Lengths of one kind: errors and half widths of their 95 % intervals, m; inf if unbounded."""

    errors: Float64
    bounds: Float64

    def cells(self) -> str:
        """Return the cells of a row of the table."""
        bounded = np.isfinite(self.bounds)
        if not bounded.any():
            return f"{len(self.errors)} | 0 % | - | - | - | -"
        error, bound = np.abs(self.errors[bounded]), self.bounds[bounded]
        median = float(np.median(error))
        return (
            f"{len(self.errors)} | {bounded.mean():.0%} | {(error <= bound).mean():.0%} | "
            f"{1e3 * median:.1f} | {1e3 * np.median(bound):.1f} | {np.median(bound) / median:.1f}"
        )


def measured(taken: Taken, result: Result, frame: RangeFrame) -> dict[str, Measured]:
    """Measure random lengths in a model, by kind of pair."""
    errors = LengthErrors.of(result, frame)
    if errors is None or result.mesh is None:
        return {}
    rng = np.random.default_rng(0)
    rows = rng.permutation(len(result.mesh.vertices))[:VERTICES]
    vertices = result.mesh.vertices[rows].astype(float)
    true, seen = true_places(taken, result.trajectory, vertices)
    count = seen.sum(1)
    known = count >= VIEWS
    vertices, true, seen, count = vertices[known], true[known], seen[known], count[known]
    i, j = np.triu_indices(len(vertices), 1)
    length = np.linalg.norm(vertices[i] - vertices[j], axis=1)
    i, j = i[length > MIN_LENGTH], j[length > MIN_LENGTH]
    common = (seen[i] & seen[j]).sum(1) / np.minimum(count[i], count[j])
    out, above = {}, np.inf
    for kind, least in KINDS.items():
        chosen = np.flatnonzero((common > least) & (common <= above))
        above = least
        chosen = rng.permutation(chosen)[:PAIRS]
        lengths = [errors.between(vertices[i[k]], vertices[j[k]]) for k in chosen]
        truth = np.linalg.norm(true[i[chosen]] - true[j[chosen]], axis=1)
        out[kind] = Measured(
            np.array([one.length_m for one in lengths]) - truth,
            np.array([one.bound_m for one in lengths]),
        )
    return out
