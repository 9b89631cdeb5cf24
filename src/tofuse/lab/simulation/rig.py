"""Multi-camera rigs: moving on one path, or static around an object; each with its own clock."""

from __future__ import annotations

from collections.abc import Sequence as SequenceOf
from dataclasses import dataclass, field, replace

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import ray_lengths
from tofuse.engine.frames import ArraySource, RangeFrame, Recording
from tofuse.engine.geometry import se3
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import CameraModel, camera_model
from tofuse.lab.simulation.record import RecordingPlan
from tofuse.lab.world import Path, look_at, rotation
from tofuse.lab.world import scene as scenes

_DEFAULT = Effects()


@dataclass(frozen=True, eq=False)
class Mount:
    """A camera of a rig.

    Attributes
    ----------
    T_rig_camera
        (4, 4) pose in the rig.
    model
        Camera model.
    frame_rate_hz
        Frame rate by its own clock.
    time_offset_s
        The rig's time is the camera's timestamp plus this.
    depth_offset_m
        Constant bias of its ranges.
    """

    T_rig_camera: Float64 = field(default_factory=lambda: np.eye(4))
    model: CameraModel = field(default_factory=lambda: camera_model("pico-flexx"))
    frame_rate_hz: float = 30.0
    time_offset_s: float = 0.0
    depth_offset_m: float = 0.0

    def sequence(self, rig: scenes.Sequence) -> scenes.Sequence:
        """Return the rig's sequence as seen by this camera."""

        def delayed(path: Path) -> Path:
            return lambda t: path(t + self.time_offset_s)

        return replace(
            rig,
            frame_rate_hz=self.frame_rate_hz,
            camera_path=lambda t: rig.camera_path(t + self.time_offset_s) @ self.T_rig_camera,
            object_path=None if rig.object_path is None else delayed(rig.object_path),
            passing_paths=tuple(map(delayed, rig.passing_paths)),
        )


def camera_ring(
    centre: SequenceOf[float], radius: float, height: float, count: int, first_rad: float = np.pi
) -> list[Float64]:
    """(4, 4) T_room_camera of `count` cameras evenly spaced around a point, facing it."""
    angles = first_rad + 2 * np.pi * np.arange(count) / count
    target = np.asarray(centre, float)
    offsets = [np.array([radius * np.cos(a), radius * np.sin(a), height]) for a in angles]
    return [look_at(target + offset, target) for offset in offsets]


def relative(T_room_camera: SequenceOf[Float64]) -> list[Float64]:
    """T_rig_camera of static cameras given by T_room_camera: the first is the identity."""
    first = se3.inverse(np.asarray(T_room_camera[0]))
    return [np.eye(4), *(np.asarray(first @ T, np.float64) for T in T_room_camera[1:])]


def simulate_rig(
    scene: scenes.Scene,
    sequence: scenes.Sequence,
    mounts: SequenceOf[Mount],
    *,
    first_s: float = 0.0,
    frames: int = 1,
    effects: Effects = _DEFAULT,
    seed: int = 0,
) -> list[Recording]:
    """Simulate a recording of each camera of a rig, in memory; their noise is independent.

    Parameters
    ----------
    scene, sequence
        The scene, and the motion of the rig (the sequence's camera) and of all bodies.
    first_s
        Start in s, by the rig's clock; timestamps are those of the cameras' own clocks.
    frames
        Images per camera.
    """
    recordings = []
    for k, mount in enumerate(mounts):
        camera_sequence = mount.sequence(sequence)
        first_own_s = max(first_s - mount.time_offset_s, 0.0)  # a recording has no earlier frame
        first = int(np.ceil(first_own_s * mount.frame_rate_hz - 1e-9))
        raw = first + np.arange(frames)
        planned = RecordingPlan(scene, camera_sequence, mount.model, effects, 1000 * seed + k, raw)
        images = [_biased(frame, mount.depth_offset_m) for frame in planned.corrected_frames()]
        names = ("frame_rate_hz", "ambiguity_m", "amplitude_kind", "depth_kind")
        metadata = {name: planned.facts[name] for name in names}
        source = ArraySource(images, planned.poses, metadata=metadata)
        recordings.append(Recording.of(source, f"simulated camera {k}", "simulated"))
    return recordings


def _biased(frame: RangeFrame, offset_m: float) -> RangeFrame:
    """Return an image with a bias of its ranges."""
    if not offset_m:
        return frame
    scale = 1.0 if frame.depth_kind == "range" else 1.0 / ray_lengths(frame.camera)
    biased = np.where(frame.depth > 0, frame.depth + offset_m * scale, 0)
    return replace(frame, depth=biased.astype(np.float32))


def wander(centre: SequenceOf[float], radii: SequenceOf[float], seconds: float) -> Path:
    """Path of a rig carried around a room: an ellipse, with varying heading, tilt and height.

    Parameters
    ----------
    centre, radii
        (3,) and (2,) of the ellipse in m.
    seconds
        Duration of one round.
    """
    mean_position = np.asarray(centre, float)

    def path(t: float) -> Float64:
        u = 2 * np.pi * t / seconds
        offset = [radii[0] * np.cos(u), radii[1] * np.sin(u), 0.12 * np.sin(2.3 * u)]
        position = np.add(mean_position, offset)
        heading = u + 0.5 * np.sin(1.7 * u)
        T = look_at(position, np.add(position, [np.cos(heading), np.sin(heading), 0.0]))
        tilts = 0.25 * np.array([np.sin(3.1 * u + 0.4), 0.0, np.sin(2.3 * u)])
        return np.asarray(T @ rotation([tilts[0], 0, 0]) @ rotation([0, 0, tilts[2]]), np.float64)

    return path
