"""Clouds deprojected from images: the camera is recovered from the points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tofuse.apps.pairs.views import named_view
from tofuse.engine.arrays import Float32, Intp
from tofuse.engine.cameras.cameras import BrownConrady, Camera, Pinhole, Rational
from tofuse.engine.errors import UnreadableFrameError
from tofuse.engine.frames.frames import CloudFrame, RangeFrame
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.formats.geometry.ply import read_ply, write_ply
from tofuse.formats.recordings.open import open_recording
from tofuse.formats.sources.organised import find_deprojection

PINHOLE = Pinhole(160, 120, 140.0, 141.0, 82.3, 57.9)
LENSES: dict[str, Camera] = {
    "pinhole": PINHOLE,
    "brown": BrownConrady(160, 120, 140.0, 141.0, 82.3, 57.9, k1=-0.25, k2=0.1, p1=1e-3),
    "rational": Rational(160, 120, 140.0, 140.0, 79.0, 61.0, k1=0.1, k2=-0.01, k4=0.3, k5=0.02),
}


def seen(camera: Camera, seed: int) -> RangeFrame:
    """A wavy wall with holes, one of them over whole columns."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: camera.height, : camera.width]
    depth = 1.5 + 0.5 * np.sin(u / 30 + seed) + 0.3 * np.cos(v / 20) + 0.01 * rng.random(u.shape)
    depth[rng.random(u.shape) < 0.2] = 0
    depth[:, 40:43] = 0
    amplitude = rng.uniform(10, 1000, u.shape).astype(np.float32)
    return RangeFrame(seed, 0.0, camera, depth.astype(np.float32), amplitude_image=amplitude)


def cloud_of(frame: RangeFrame, order: Intp | None = None) -> CloudFrame:
    order = np.arange(len(frame)) if order is None else order
    amplitude = frame.amplitude
    return CloudFrame(frame.index, 0.0, frame.points[order], amplitude=amplitude[order])


@pytest.mark.nightly_part
@pytest.mark.parametrize("lens", LENSES)
def test_image_is_recovered_from_shuffled_points(lens: str) -> None:
    frames = [seen(LENSES[lens], k) for k in range(3)]
    rng = np.random.default_rng(7)
    clouds = [cloud_of(f, rng.permutation(len(f))) for f in frames]
    found = find_deprojection(clouds[:2])
    assert (found.camera.width, found.camera.height) == (160, 120)
    assert isinstance(found.camera, Pinhole) == (lens == "pinhole")
    # Rays of invalid pixels match the lens, too.
    off = np.abs(found.camera.rays() - LENSES[lens].rays()) * 140
    assert off.max() < 0.01
    for frame, cloud in zip(frames, clouds, strict=True):
        image = found.image(cloud)
        np.testing.assert_array_equal(image.depth, frame.depth)
        there = frame.valid
        np.testing.assert_array_equal(image.amplitude_image[there], frame.amplitude_image[there])
        np.testing.assert_allclose(image.points, frame.points, atol=2e-5)


def test_coordinates_rounded_to_millimetres_suffice() -> None:
    cloud = cloud_of(seen(PINHOLE, 0))
    rounded = CloudFrame.of(np.round(cloud.points, 3))
    assert len(find_deprojection([rounded]).image(rounded)) == len(rounded)


def moved(points: Float32) -> Float32:
    turn = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    return (points @ turn.T + (0.1, 0.2, 3.0)).astype(np.float32)


@pytest.mark.parametrize("change", ["moved", "merged", "averaged", "scattered", "behind", "few"])
def test_other_clouds_stay_clouds(change: str) -> None:
    rng = np.random.default_rng(1)
    points = cloud_of(seen(PINHOLE, 0)).points
    off = rng.normal(0, 0.004, points.shape).astype(np.float32)
    scattered = rng.uniform((-1, -1, 1), (1, 1, 3), (20_000, 3)).astype(np.float32)
    other = {
        "moved": moved(points),
        "merged": np.concatenate([points, moved(points)]),
        "averaged": points + off,
        "scattered": scattered,
        "behind": points * np.where(rng.random((len(points), 1)) < 0.5, -1, 1),
        "few": points[:300],
    }[change]
    assert find_deprojection([CloudFrame.of(other)]) is None


def test_files_of_the_realsense_viewer_are_turned(tmp_path: Path) -> None:
    frame, turn = seen(PINHOLE, 0), (1, -1, -1)
    normals = np.tile(np.float32([0.6, 0, -0.8]), (len(frame), 1))
    write_ply(tmp_path / "a.ply", GeometryRecord(frame.points * turn, normals=normals * turn))
    recording = open_recording(tmp_path / "a.ply")
    assert any("RealSense Viewer" in text for text in recording.warnings)
    image = recording[0]
    np.testing.assert_array_equal(image.depth, frame.depth)
    np.testing.assert_allclose(image.camera.rays(), PINHOLE.rays(), atol=1e-5)
    np.testing.assert_array_equal(image.normals, normals)
    # A pair is registered in the coordinates of its files.
    view = named_view(str(tmp_path / "a.ply")).frame
    assert isinstance(view, CloudFrame)
    np.testing.assert_allclose(view.points, frame.points * turn, atol=2e-5)
    np.testing.assert_array_equal(view.normals, normals * turn)


def test_real_file_of_the_realsense_viewer(shared_data: Path) -> None:
    frame = open_recording(shared_data / "cases" / "realsense_viewer")[0]
    assert (frame.camera.width, frame.camera.height, len(frame)) == (612, 465, 129601)
    stored = read_ply(shared_data / "cases" / "realsense_viewer" / "45.ply").points
    assert frame.z.max() == np.float32(-stored[:, 2].min())


@pytest.mark.nightly
def test_folder_of_exported_clouds_is_read_as_images(tmp_path: Path) -> None:
    frames = [seen(LENSES["brown"], k) for k in range(4)]
    for k, frame in enumerate(frames[:3]):
        write_ply(
            tmp_path / f"{k}.ply",
            GeometryRecord(frame.points, scalars={"amplitude": frame.amplitude}),
        )
    write_ply(tmp_path / "3.ply", GeometryRecord(np.zeros((0, 3))))
    recording = open_recording(tmp_path)
    assert recording.format == "ply"
    for k, frame in enumerate(frames[:3]):
        image = recording[k]
        np.testing.assert_array_equal(image.depth, frame.depth)
        assert image.amplitude_image is not None
    assert len(recording[3]) == 0


def test_cloud_off_the_rays_is_unreadable(tmp_path: Path) -> None:
    for k, frame in enumerate([seen(PINHOLE, k % 5) for k in range(24)]):
        points = moved(frame.points) if k == 4 else frame.points
        write_ply(tmp_path / f"{k:02d}.ply", GeometryRecord(points))
    recording = open_recording(tmp_path)
    assert isinstance(recording[5], RangeFrame)
    with pytest.raises(UnreadableFrameError, match="off the rays of the previous clouds"):
        recording[4]
