"""Segmentation of an object from its background, and lens scattering estimated from both.

All camera errors are simulated, in some tests without the slow ones. The ground truth is what the
central ray of each pixel hits.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import pytest

from tofuse.engine.errors import InputError
from tofuse.engine.filters.background import Background
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry.rays import unit_rays
from tofuse.engine.sensor.scattering import LensScattering
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.record import plan

OF_OBJECT = {"torso": ("skin", "hair", "shirt", "trousers", "seat"), "box": ("box",)}


# The slowest effects to simulate.
SLOW = ("multipath", "gloss")


@dataclass(frozen=True)
class Shown:
    frames: tuple[RangeFrame, ...]
    masks: tuple[np.ndarray, ...]  # which pixels show the object
    stands: tuple[np.ndarray, ...]  # and which its rotating stand, whose depth does not change


@cache
def shown(scene: str, camera: str = "sr4000", count: int = 7, off: tuple[str, ...] = ()) -> Shown:
    every = {"torso": 222, "box": 570}[scene] // count
    effects = Effects().without(*off)
    made = plan(scene, camera=camera, every=every, frames=count, effects=effects)
    rays = unit_rays(made.model.camera.rays())
    shape = rays.shape[:2]
    ahead = rays.reshape(-1, 3)
    masks, stands = [], []
    names = np.array([m.name for m in made.scene.materials] + [""])
    for k in range(count):
        t = k * every / made.sequence.frame_rate_hz
        T = made.sequence.T_room_camera(t)
        hits = made.scene.cast(T[:3, 3], ahead @ T[:3, :3].T, made.sequence.T_room_object(t))
        seen = names[hits.surface].reshape(shape)
        masks.append(np.isin(seen, OF_OBJECT[scene]))
        stands.append(seen == "stand")
    return Shown(tuple(made.corrected_frames()), tuple(masks), tuple(stands))


def check(case: Shown, least: float) -> None:
    """Intersection over union of the kept pixels; the lens blurs the outline by a pixel."""
    found = Background().fit(case.frames)
    for frame, mask, stand in zip(case.frames, case.masks, case.stands, strict=True):
        counted = frame.valid & ~(cv2.dilate(stand.astype(np.uint8), np.ones((5, 5))) > 0)
        keep, true = found.mask(frame, ()) & counted, mask & counted
        assert (keep & true).sum() / (keep | true).sum() > least
        inner = cv2.erode(true.astype(np.uint8), np.ones((5, 5))) > 0
        outer = cv2.dilate(true.astype(np.uint8), np.ones((5, 5))) > 0
        assert (keep & inner).sum() > 0.98 * inner.sum()
        assert (keep & ~outer).sum() < 0.03 * true.sum()


@pytest.mark.nightly
def test_person_is_segmented() -> None:
    check(shown("torso", off=SLOW), 0.93)


@pytest.mark.nightly
def test_box_is_segmented() -> None:
    check(shown("box"), 0.85)


def test_moving_camera_is_rejected() -> None:
    made = plan("rail", every=35, effects=Effects.none(shot_noise=True))
    frames = [rendered.frame for rendered in made.frames(None)]
    with pytest.raises(InputError, match="leave it out if the camera moves"):
        Background().fit(frames)


@pytest.mark.nightly
def test_lens_scattering_is_estimated_and_corrected() -> None:
    """The estimate matches the simulated scattering, although the shape of its blur differs."""
    case, clean = shown("box"), shown("box", off=("scatter",))
    learnt = LensScattering().fit(case.frames)
    assert learnt.fractions is not None
    assert not learnt.needs_fit
    assert 0.015 < sum(learnt.fractions) < 0.035
    none = LensScattering().fit(clean.frames)
    assert none.fractions == (0.0, 0.0, 0.0)
    assert none.start().apply(case.frames[0]) is case.frames[0]
    corrector = learnt.start()
    for k in (0, 4):
        before, after, truth = case.frames[k], corrector.apply(case.frames[k]), clean.frames[k]
        # Around the object, where its scattered light is strongest.
        mask = case.masks[k].astype(np.uint8)
        ring = cv2.dilate(mask, np.ones((9, 9))) != cv2.dilate(mask, np.ones((31, 31)))
        bias = abs(float((before.z - truth.z)[ring].mean()))
        left = abs(float((after.z - truth.z)[ring].mean()))
        assert bias > 0.004
        assert left < 0.4 * bias
        assert (after.valid == before.valid).all()
