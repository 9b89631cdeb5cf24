"""Views of simulated cameras and scenes that are not in the tables of `pairs.py`.

Other seeds and motions, and cameras with other resolution, field of view, noise and kind of
amplitude. Part of `pairs.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

import unusual
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.lab.simulation.models import CameraModel, camera_model
from tofuse.lab.world import scene as scenes
from tofuse.lab.world.paths import Path
from unusual import Unusual

VIEWS = 14
# A phone's depth is smoothed and has no amplitude.
_PHONE = "phone"
_CAMERAS: dict[str, CameraModel] = {
    "sr4000": camera_model("sr4000"),
    "pico-flexx": camera_model("pico-flexx"),
    "ifm-o3r": camera_model("ifm-o3r"),
    "kinect2": unusual.pinhole("kinect2", 256, 212, 70.0),
    "azure-nfov": unusual.pinhole("azure-nfov", 320, 288, 65.0),
    _PHONE: unusual.pinhole("ifm-o3r", 256, 192, 60.0),
}


@dataclass(frozen=True)
class Taken:
    """A set of views of a scene by a camera.

    Attributes
    ----------
    scene
        Name in the simulator, or in `unusual`.
    hz
        Views per second of the scene's own motion.
    """

    camera: str
    scene: str
    seed: int
    hz: float
    texture: bool = True

    @property
    def place(self) -> str:
        """Place shown: scenes of one kind may look alike, whatever their seed."""
        return "room" if "room" in self.scene else self.scene.removesuffix("-alike")

    def __str__(self) -> str:
        return f"{self.camera}, {self.scene} {self.seed}"


TAKEN = (
    Taken("sr4000", "room", 21, 3.0),
    Taken("sr4000", "empty-room", 22, 3.0),
    Taken("sr4000", "flat", 23, 1.5),
    Taken("sr4000", "flat-alike", 24, 1.5),
    Taken("pico-flexx", "room", 25, 3.0),
    Taken("pico-flexx", "flat", 26, 1.5),
    Taken("pico-flexx", "empty-room", 42, 3.0, texture=False),
    Taken("pico-flexx", "rail", 27, 1.0),
    Taken("pico-flexx", "things on a table", 28, 2.0),
    Taken("ifm-o3r", "hall", 29, 1.0),
    Taken("ifm-o3r", "flat-alike", 30, 1.5),
    Taken("ifm-o3r", "empty-room", 31, 3.0),
    Taken("ifm-o3r", "yard", 32, 1.5),
    Taken("kinect2", "room", 33, 3.0),
    Taken("kinect2", "flat", 34, 1.5),
    Taken("kinect2", "empty-room", 35, 3.0, texture=False),
    Taken("azure-nfov", "hall", 36, 1.0),
    Taken("azure-nfov", "empty-room", 43, 3.0),
    Taken("azure-nfov", "flat-alike", 37, 1.5),
    Taken("azure-nfov", "floor and chairs from above", 38, 1.5),
    Taken(_PHONE, "room", 39, 3.0),
    Taken(_PHONE, "flat", 40, 1.5),
    Taken(_PHONE, "things on a table", 41, 2.0),
)


def recorded(taken: Taken) -> Recording:
    """Simulate the views; the true poses are the reference."""
    # Views far apart in time have no smear, whatever the motion between them.
    made = unusual.record(_plan(taken), taken.seed, "smear")
    if taken.camera != _PHONE:
        return made
    frames = [_smoothed(frame) for frame in made if isinstance(frame, RangeFrame)]
    return Recording.of(ArraySource(frames, made.reference), "simulated", "simulated")


def _plan(taken: Taken) -> Unusual:
    if taken.scene in unusual.UNUSUAL:
        known = unusual.UNUSUAL[taken.scene]
        scene: Callable[[int], scenes.Scene] = known.scene
        path = known.path(taken.seed)
    else:
        built = scenes.build(taken.scene, seed=taken.seed, texture=taken.texture)
        scene, path = (lambda _seed: built[0]), built[1].camera_path
    rng = np.random.default_rng([taken.seed, 15])
    start = rng.uniform(0, 3)

    def later(t: float) -> np.ndarray:
        return path(start + t)

    # Hand-held, so that the motion has six dimensions.
    moved: Path = unusual.together(later, unusual.handheld(rng, 0.08, 6.0))
    return Unusual(scene, lambda _seed: moved, _CAMERAS[taken.camera], VIEWS, taken.hz)


def _smoothed(frame: RangeFrame) -> RangeFrame:
    smooth = cv2.bilateralFilter(frame.depth.astype(np.float32), 7, 0.1, 2.0)
    depth = np.where(frame.depth > 0, smooth, np.float32(0)).astype(np.float32)
    return replace(frame, depth=depth, amplitude_image=None, sigma_image=None)
