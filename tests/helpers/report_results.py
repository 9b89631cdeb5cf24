"""Small results for reports: a room and a single frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ray_casting import rays_at, to_room
from tofuse.apps.report.extras import ReportExtras
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.fusion.cloud import Cloud, CloudBuilder
from tofuse.engine.fusion.options import Fusion
from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import LoopRecord, PoseGraph
from tofuse.engine.quality.frame_samples import FrameSample
from tofuse.engine.results.types import Diagnostics, FrameRecord, Reason, Reconstruction

# A room of 6.0 x 2.5 x 3.2 m around the first camera, and two blocks in it.
ROOM = np.array([[-3.4, -1.4, -1.5], [2.6, 1.1, 1.7]])


BLOCKS = np.array([[[1.2, 0.3, 0.6], [1.9, 1.1, 1.2]], [[-2.6, -0.2, -1.0], [-2.0, 1.1, -0.4]]])


def circle(frames):
    """T_world_camera of a camera that turns once about an axis 0.15 m behind it."""
    angle = np.linspace(0, 2 * np.pi, frames, endpoint=False)
    poses = se3.exp(np.stack([0 * angle] * 4 + [angle, 0 * angle], axis=-1))
    arm = np.eye(4)
    arm[2, 3] = 0.15
    poses = poses @ arm
    return se3.inverse(poses[0]) @ poses


def view(k, T, camera, rng):
    origin, directions = rays_at(T, camera)
    z, _ = to_room(origin, directions, ROOM, BLOCKS)
    hit = origin + directions * z[..., None]
    texture = 0.6 + 0.3 * np.sign(np.sin(5 * hit).prod(-1))
    amplitude = (4000 * texture / (z**2 + 0.3)).astype(np.float32)
    depth = (z + rng.normal(0, 0.012, z.shape)).astype(np.float32)
    depth[rng.random(z.shape) < 0.01] *= 0.8
    return RangeFrame(k, k / 10, camera, depth, "z", amplitude)


def make_room(frames=24, width=64, height=48):
    rng = np.random.default_rng(5)
    camera = Pinhole(width, height, width * 1.4, width * 1.4, width / 2, height / 2)
    truth = circle(frames)
    share = np.linspace(0, 1, frames)
    drift = np.stack(
        [0.21 * share**2, 0.06 * share, -0.12 * share, 0 * share, 0.09 * share, 0 * share], -1
    )
    sequential = truth @ se3.exp(drift)
    estimate = truth @ se3.exp(0.06 * drift)
    views = [view(k, T, camera, rng) for k, T in enumerate(truth)]
    builder = CloudBuilder(Fusion(), 0.03)
    for frame, T in zip(views, estimate, strict=True):
        builder.add(frame, T)
    records = [
        FrameRecord(k, k / 10, "tracked", "", 0.97, 0.7 + 0.1 * np.sin(k / 3), 0.011)
        for k in range(frames)
    ]
    wall = "a flat wall holds only 3 of 6 directions"
    records[5] = FrameRecord(5, 0.5, "predicted", wall, 0.9, 0.4, 0.03)
    few = "too few correspondences: 31 of 1000"
    for k in (9, 10):
        records[k] = FrameRecord(k, k / 10, "lost", few, 0.8, 0.031, 0.09)
    records[15] = FrameRecord(15, 1.5, "skipped", "depth/000015.png: is truncated")
    estimate[[9, 10, 15]] = sequential[[9, 10, 15]] = np.nan
    loops = (
        LoopRecord(0, frames - 1, True, "", 0.62, 0.014, 0.01),
        LoopRecord(2, frames - 2, False, "overlap is below 25 %", 0.18, 0.05, None),
    )
    objective = tuple(3.1 * np.exp(-0.4 * np.arange(14)) + 0.01)
    samples = tuple(
        FrameSample.of(v, v, v.keep(np.asarray(v.amplitude_image > 700))) for v in views[:15:2]
    )
    reasons = (
        Reason("lost_frames", ((9, 10),), "2 readable frames have no pose"),
        Reason("unreadable_frames", ((15, 15),), "1 frame could not be read and was skipped"),
    )
    removed = {"confidence": 0.081, "neighbours": 0.5}
    seconds = {"read": 0.31, "filter": 0.92, "odometry": 2.4, "loops": 0.6, "fuse": 0.4}
    records = tuple(records)
    found = (reasons, records, loops, sequential, objective, removed, seconds)
    diagnostics = Diagnostics("degraded", *found, samples=samples)
    cloud = builder.finish()
    sigma = (0.002 + 0.004 * np.linalg.norm(cloud.points, axis=1)).astype(np.float32)
    cloud = replace(cloud, sigma=sigma)
    config = {"method": "thesis", "filters": [{"part": "confidence", "minimum": 4}]}
    about = {"path": "room", "format": "native", "frames": frames}
    about |= {"warnings": ["no timestamps.txt"]}
    made = (estimate, np.arange(frames) / 10, PoseGraph.empty(), cloud, diagnostics)
    result = Reconstruction(*made, config, about, 7, 2)
    raw = views[0]
    step1 = raw.keep(np.asarray(raw.amplitude_image > 700))
    step2 = step1.keep(rng.random(step1.valid.shape) < 0.5)
    surface = rng.uniform(*ROOM, (4000, 3))
    axis = rng.integers(0, 3, 4000)
    surface[np.arange(4000), axis] = ROOM[rng.integers(0, 2, 4000), axis]
    steps = (("raw", raw), ("confidence", step1), ("neighbours", step2))
    return result, ReportExtras("room <simulated>", steps, truth, surface.astype(np.float32))


def lonely(**changes):
    """A minimal result: one frame, and a cloud without attributes."""
    points = np.array([[0, 0, 1], [0.1, 0, 1], [0, 0.2, 1.1]], np.float32)
    cloud = Cloud(points, None, None, np.ones(3, np.int32))
    reasons, frames = (Reason("single_frame", ((0, 0),), ""),), (FrameRecord(0, 0.0, "tracked"),)
    pose = np.eye(4)[None]
    diagnostics = Diagnostics("good", reasons, frames, (), pose, (), {}, {})
    graph = PoseGraph.empty()
    whole = Reconstruction(pose, np.zeros(1), graph, cloud, diagnostics, {}, {}, 0, 1)
    inner = {k: v for k, v in changes.items() if k in Diagnostics.__dataclass_fields__}
    outer = {k: v for k, v in changes.items() if k not in inner}
    return replace(whole, **outer, diagnostics=replace(diagnostics, **inner))
