"""Static segments of a recording, and their averages."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.errors import UnreadableFrameError
from tofuse.engine.frames.frames import SATURATED_AMPLITUDE, CloudFrame, RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.noise.model import NoiseModel, RangeLaw, noise_model_for
from tofuse.formats.recordings.open import open_recording
from tofuse.formats.recordings.still import (
    average_of,
    average_still,
    change_between,
    stationary_intervals,
)

CAMERA = Pinhole(120, 96, 100.0, 100.0, 59.5, 47.5)
SIGMA = 0.02
MODEL = NoiseModel("test", RangeLaw(SIGMA, 0.0))
V, U = np.mgrid[0:96, 0:120]


def scene(shift_m: float = 0.0, box_at: int | None = None) -> np.ndarray:
    """Ranges of a wavy wall, from a camera shifted backwards, perhaps with a box before it."""
    depth = 2.0 + 0.3 * np.sin(U / 15) * np.cos(V / 20) + shift_m
    if box_at is not None:
        depth[30:70, box_at : box_at + 30] = 1.4
    return depth


def shot(k: int, depth: np.ndarray, sigma: float = SIGMA, **channels: object) -> RangeFrame:
    noise = np.random.default_rng([7, k]).normal(0, sigma, depth.shape)
    image = (depth + noise).astype(np.float32)
    return RangeFrame(k, k / 10, CAMERA, image, "range", **channels)


def recording_of(frames: list) -> Recording:
    poses = np.repeat(np.eye(4)[None], len(frames), 0)
    poses[:, 0, 3] = np.arange(len(frames))
    return Recording.of(ArraySource(frames, poses), "made", "made")


def test_noise_is_not_motion() -> None:
    for sigma in (0.0005, 0.02, 0.3):
        a, b = shot(0, scene(), sigma), shot(1, scene(), sigma)
        motion = change_between(a, b, MODEL)
        assert motion.still
        assert not motion.identical


def test_motion_below_pixel_noise_is_detected() -> None:
    assert not change_between(shot(0, scene()), shot(1, scene(0.4 * SIGMA)), MODEL).still
    # With a better camera, even smaller motion.
    better = 0.1 * SIGMA
    a, b = shot(0, scene(), better), shot(1, scene(0.4 * better), better)
    assert not change_between(a, b, MODEL).still


def test_correlated_noise_is_not_motion() -> None:
    def smooth(frame: RangeFrame) -> RangeFrame:
        padded = np.pad(frame.depth, 1, "edge")
        mean = sum(padded[i : i + 96, j : j + 120] for i in range(3) for j in range(3)) / 9
        return replace(frame, depth=mean.astype(np.float32))

    assert change_between(smooth(shot(0, scene())), smooth(shot(1, scene())), MODEL).still


def test_object_moving_before_static_wall_is_motion() -> None:
    assert change_between(shot(0, scene(box_at=20)), shot(1, scene(box_at=20)), MODEL).still
    assert not change_between(shot(0, scene(box_at=20)), shot(1, scene(box_at=50)), MODEL).still


def test_amplitude_reveals_motion_along_flat_wall() -> None:
    wall = np.full((96, 120), 2.0)

    def seen(k: int, slide_px: float, exposure: float = 1.0) -> RangeFrame:
        albedo = 1 + 0.5 * np.sin((U + slide_px) / 8) * np.sin(V / 9)
        noise = np.random.default_rng([9, k]).normal(0, 0.02, wall.shape)
        image = (exposure * 400 * albedo * (1 + noise)).astype(np.float32)
        return shot(k, wall, amplitude_image=image)

    assert change_between(seen(0, 0), seen(1, 0), MODEL).still
    assert change_between(seen(0, 0), seen(1, 0, exposure=1.7), MODEL).still
    assert not change_between(seen(0, 0), seen(1, 1), MODEL).still


def test_identical_and_empty_frames() -> None:
    a = shot(0, scene())
    assert change_between(a, a, MODEL).identical
    assert not change_between(a, replace(a, depth=np.zeros_like(a.depth)), MODEL).still
    other = RangeFrame(1, 0.0, Pinhole(20, 20, 9, 9, 9, 9), np.ones((20, 20), np.float32))
    assert not change_between(a, other, MODEL).still


def test_intervals_are_contiguous_and_slow_motion_is_detected() -> None:
    shifts = [0, 0, 0, 0, 0.1, 0.2, 0.3, 0.3, 0.3]
    frames = [shot(k, scene(s)) for k, s in enumerate(shifts)]
    assert stationary_intervals(recording_of(frames), MODEL) == [(0, 4), (4, 5), (5, 6), (6, 9)]
    creeping = [shot(k, scene(0.001 * k)) for k in range(40)]
    found = stationary_intervals(recording_of(creeping), MODEL)
    assert max(b - a for a, b in found) < 12
    assert [a for a, _ in found[1:]] == [b for _, b in found[:-1]]
    assert found[-1][1] == 40


def test_clouds_and_unreadable_frames_are_separate() -> None:
    class Broken(ArraySource):
        def read(self, index: int) -> RangeFrame | CloudFrame:
            if index == 2:
                raise UnreadableFrameError("is broken")
            return super().read(index)

    frames = [shot(k, scene()) for k in range(5)]
    broken = Recording.of(Broken(frames), "made", "made")
    assert stationary_intervals(broken, MODEL) == [(0, 2), (2, 3), (3, 5)]
    averaged = average_still(broken, MODEL)
    assert len(averaged) == 3
    with pytest.raises(UnreadableFrameError):
        averaged[1]
    clouds = recording_of([CloudFrame.of(np.eye(3))] * 3)
    assert stationary_intervals(clouds) == [(0, 1), (1, 2), (2, 3)]
    assert len(average_still(clouds)[2]) == 3


def test_averaging_reduces_noise_and_sigma() -> None:
    averaged = average_still(recording_of([shot(k, scene()) for k in range(16)]), MODEL)
    assert len(averaged) == 1
    frame = averaged[0]
    assert (frame.radial_range - scene()).std() == pytest.approx(SIGMA / 4, rel=0.1)
    assert np.median(frame.sigma_image) == pytest.approx(SIGMA / 4, rel=0.02)
    assert np.median(MODEL.sigma(frame)) == pytest.approx(SIGMA / 4, rel=0.02)


def test_averaging_keeps_times_poses_and_moving_frames() -> None:
    shifts = [0, 0, 0, 0.1, 0.3, 0.3, 0.3]
    frames = [shot(k, scene(s)) for k, s in enumerate(shifts)]
    averaged = average_still(recording_of(frames), MODEL)
    np.testing.assert_array_equal(averaged.timestamps, [0.1, 0.3, 0.5])
    np.testing.assert_array_equal(averaged.reference[:, 0, 3], [1, 3, 5])
    assert [f.index for f in averaged] == [0, 1, 2]
    assert [f.timestamp for f in averaged] == [0.1, 0.3, 0.5]
    np.testing.assert_array_equal(averaged[1].depth, frames[3].depth)
    assert averaged.warnings == ["7 frames averaged to 3 in stationary intervals"]
    assert averaged.metadata["averaged"] == [3, 1, 3]
    selected = recording_of(frames).select(4)
    np.testing.assert_array_equal(average_still(selected, MODEL).timestamps, [0.5])


def test_outliers_and_rarely_valid_pixels() -> None:
    frames = [shot(k, scene()) for k in range(6)]
    for k, frame in enumerate(frames):
        depth = frame.depth.copy()
        if k == 2:
            depth[0, 0] += 1.5  # a flying pixel
        if k > 1:
            depth[0, 1] = 0  # valid in two of six
        if k > 2:
            depth[0, 2] = 0  # in three of six
        depth[0, 3] = 0
        frames[k] = replace(frame, depth=depth)
    frame = average_of(frames, MODEL)
    assert abs(frame.depth[0, 0] - scene()[0, 0]) < 3 * SIGMA
    assert frame.depth[0, 1] == frame.depth[0, 3] == 0
    assert frame.depth[0, 2] > 0
    assert frame.sigma_image[0, 2] == pytest.approx(SIGMA / np.sqrt(3))
    assert frame.sigma_image[0, 0] == pytest.approx(SIGMA / np.sqrt(5))
    assert (frame.sigma_image[0, [1, 3]] == 0).all()


def test_identical_frames_do_not_reduce_sigma() -> None:
    first, second = shot(0, scene()), shot(1, scene())
    frame = average_of([first, first, second, second, second], MODEL)
    assert np.median(frame.sigma_image) == pytest.approx(SIGMA / np.sqrt(2))
    assert average_of([first, first], MODEL).sigma_image is None


def test_channels() -> None:
    frames = []
    for k in range(4):
        amplitude = np.full((96, 120), 100.0 + k, np.float32)
        amplitude[5, 5] = SATURATED_AMPLITUDE
        amplitude[5, 6] = SATURATED_AMPLITUDE if k == 0 else 200.0
        images = {"amplitude_image": amplitude, "amplitude_kind": "range_compensated"}
        images |= {"confidence_image": np.full((96, 120), k, np.uint8)}
        images |= {"color_image": np.full((96, 120, 3), 10 * k, np.uint8)}
        frames.append(shot(k, scene(), **images))
    frame = average_of(frames, MODEL)
    assert np.median(frame.amplitude_image) == pytest.approx(101.5)
    assert frame.amplitude_image[5, 5] == SATURATED_AMPLITUDE
    assert frame.amplitude_image[5, 6] == 200
    assert frame.amplitude_kind == "range_compensated"
    assert np.median(frame.confidence_image) == 3
    assert frame.color_image is not None
    assert (frame.color_image == 15).all()


def test_memory_of_long_intervals_is_bounded() -> None:
    frames = [shot(k, scene()) for k in range(60)]
    frame = average_still(recording_of(frames), MODEL)[0]
    assert np.median(frame.sigma_image) == pytest.approx(SIGMA / np.sqrt(48), rel=0.02)


@pytest.mark.nightly
def test_sr4000_corridor(shared_data: Path) -> None:
    recording = open_recording(shared_data / "sr4000_corridor")
    assert stationary_intervals(recording) == [(0, 4), (4, 8)]
    averaged = average_still(recording)
    assert len(averaged) == 2
    # Each frame has its own rays; the mean has the mean of them.
    first, frame = recording[1], averaged[0]
    both = first.valid & frame.valid
    assert both.mean() > 0.95
    assert np.median(np.abs(frame.camera.rays() - first.camera.rays())[both]) < 2e-4
    # Neighbouring pixels differ less than in any of the four frames.
    rough = [np.median(np.abs(np.diff(f.z, n=2, axis=1))[both[:, 2:]]) for f in (first, frame)]
    assert rough[1] < 0.65 * rough[0]
    model = noise_model_for(recording)
    ratio = frame.sigma_image[both] / model.sigma(first)[both]
    assert np.median(ratio) == pytest.approx(0.5, abs=0.03)
