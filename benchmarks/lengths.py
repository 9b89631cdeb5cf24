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
    "phone": unusual.pinhole("ifm-o3r", 96, 72, 62),
}
VERTICES, PAIRS = 400, 4000


@dataclass(frozen=True)
class Case:
    """A scene and motion, and how many frames of it at which rate."""

    scene: unusual.Unusual
    frames: int
    rate_hz: float


def _around_table(seed: int) -> paths.Path:
    orbit = unusual.around(1.3, 0.9, (0.0, 0.0, 0.0), 20.0)
    return unusual.fixed(orbit)(seed)


_room = unusual.UNUSUAL["80 x 60 pixels"]
_flat = unusual.UNUSUAL["elsewhere in the flat"]
_table = unusual.Unusual(unusual.built("table", unusual._table), _around_table, CAMERAS["o3r"])
_bathroom = unusual.Unusual(
    unusual.built("bathroom", unusual._bathroom),
    unusual.fixed(unusual._in_the_bathroom),
    CAMERAS["o3r"],
)
CASES = {
    "room, turn": Case(_room, 60, 2.0),
    "room, short": Case(_room, 16, 5.0),
    "bathroom, turn": Case(_bathroom, 44, 4.2),
    "table, orbit": Case(_table, 48, 2.4),
    "flat, walk": Case(_flat, 36, 6.0),
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
        exact = replace(rendered.frame, depth=rendered.depth)
        points.append(se3.transform(T, exact.points).reshape(*exact.depth.shape, 3))
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
        inside = ((low >= 0) & (low < (camera.width - 1, camera.height - 1))).all(1)
        u, v = np.where(inside[:, None], low, 0).T
        a, b = np.where(inside[:, None], pixel - low, 0).T[..., None]
        corners = [points[v, u], points[v, u + 1], points[v + 1, u], points[v + 1, u + 1]]
        q = (1 - b) * ((1 - a) * corners[0] + a * corners[1])
        q += b * ((1 - a) * corners[2] + a * corners[3])
        centre = taken.poses[k, :3, 3]
        ranges = np.linalg.norm(np.array(corners) - centre, axis=2)
        depth = np.linalg.norm(place, axis=1)
        near = np.abs(ranges.mean(0) - depth) < 0.05 + 0.05 * depth
        ok = inside & near & (np.ptp(ranges, axis=0) < 0.1 * depth)
        total[ok] += q[ok]
        seen[ok, k] = True
    return total / seen.sum(1)[:, None], seen
