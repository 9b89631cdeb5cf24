"""The recordings of real cameras, with their reference poses."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from scoring import Tolerance
from sequences import kinect_loop
from sequences import recorded as _folder
from tofuse.engine.arrays import Float64
from tofuse.engine.frames.recording import Recording
from tofuse.engine.geometry import se3

# Reads the candidate references of a recording; empty if there is none.
References = Callable[[Path, Recording], list[Float64]]


@dataclass(frozen=True)
class Recorded:
    """One recording.

    Attributes
    ----------
    name
        Folder in the data.
    reference_m, reference_rad
        Uncertainty of the reference itself.
    references
        (N, 4, 4) T_world_camera. Of several, the best-fitting one is used: the sign of a
        direction may be unknown.
    object
        Whether the world frame is that of a moving object.
    """

    name: str
    title: str
    open: Callable[[Path], Recording] = field(repr=False)
    references: References = field(repr=False)
    reference_m: float = 0.0
    reference_deg: float = 0.0
    object: bool = False

    @property
    def tolerance(self) -> Tolerance:
        """Tolerance of a right pose, including the uncertainty of the reference."""
        return Tolerance().widened(self.reference_m, np.radians(self.reference_deg))


def _own(_data: Path, recording: Recording) -> list[Float64]:
    """The reference stored with the frames."""
    return [] if recording.reference is None else [recording.reference]


def _none(_data: Path, _recording: Recording) -> list[Float64]:
    return []


def _still(_data: Path, recording: Recording) -> list[Float64]:
    """A static camera."""
    return [np.tile(np.eye(4), (len(recording), 1, 1))]


def _corridor(_data: Path, recording: Recording) -> list[Float64]:
    """Two positions, the second 305 mm further along the optical axis."""
    poses = np.tile(np.eye(4), (len(recording), 1, 1))
    poses[len(poses) // 2 :, 2, 3] = 0.305
    return [poses]


def _rig(*parts: str, either: bool = False) -> References:
    def read(data: Path, recording: Recording) -> list[Float64]:
        found = json.loads(data.joinpath(*parts).read_text())
        poses = np.array([found[key] for key in sorted(found)], float)
        if len(poses) != len(recording):
            return []
        return [poses, se3.inverse(poses)] if either else [poses]

    return read


RECORDED = {
    one.name + ("-object" if one.object else ""): one
    for one in (
        Recorded(
            "azure_kinect_tags",
            "Azure Kinect over tags, 1280 x 720",
            _folder("azure_kinect_tags"),
            _own,
            0.002,
            0.1,
        ),
        Recorded(
            "iphone_chair_3dscannerapp",
            "iPhone round a chair, 256 x 192",
            _folder("iphone_chair_3dscannerapp"),
            _own,
            0.03,
            1.5,
        ),
        Recorded(
            "iphone_stray", "iPhone, Stray, 256 x 192", _folder("iphone_stray"), _own, 0.03, 1.5
        ),
        Recorded(
            "iphone_record3d",
            "iPhone, Record3D, 192 x 256",
            _folder("iphone_record3d"),
            _own,
            0.03,
            1.5,
        ),
        Recorded("kinectv2_loop", "Kinect v2 round boxes, 512 x 424", kinect_loop, _own, 0.07, 1.3),
        Recorded(
            "sevenscenes_kitchen",
            "Kinect v1, kitchen, 640 x 480",
            _folder("sevenscenes_kitchen"),
            _own,
            0.05,
            2.0,
        ),
        Recorded(
            "realsense_desk",
            "RealSense along a desk, 640 x 480",
            _folder("realsense_desk"),
            _own,
            0.08,
            2.0,
        ),
        Recorded("iphone_room", "iPhone in a room, 720 x 960", _folder("iphone_room"), _none),
        Recorded(
            "person_turning", "a person turns, whole image", _folder("person_turning"), _still
        ),
        Recorded(
            "person_turning",
            "a person turns, the person",
            _folder("person_turning"),
            _none,
            object=True,
        ),
        Recorded(
            "cases/person_fills_view",
            "somebody near fills the view",
            _folder("cases/person_fills_view"),
            _still,
        ),
        Recorded(
            "sr4000_corridor", "SR4000, corridor, 176 x 144", _folder("sr4000_corridor"), _corridor
        ),
        Recorded(
            "pico_zense_static",
            "Pico Zense, still, 640 x 480",
            _folder("pico_zense_static"),
            _still,
        ),
        Recorded(
            "xtion_ring",
            "eight Xtions in a ring, 320 x 240",
            _folder("xtion_ring"),
            _rig("xtion_ring", "rig_T_rig_camera.json", either=True),
            0.05,
            3.0,
        ),
        Recorded(
            "azure_kinect_rig",
            "five Azure Kinects, 1920 x 1080",
            _folder("azure_kinect_rig"),
            _rig("azure_kinect_rig", "reference_T_world_camera.json"),
            0.02,
            1.0,
        ),
        Recorded("open3d_rgbd5", "PrimeSense, 5 frames", _folder("open3d_rgbd5"), _own, 0.02, 1.0),
    )
}
