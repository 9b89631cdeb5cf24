"""Recordings in the layouts of TUM RGB-D and Open3D, and rectified images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tofuse
from refused import refused
from tofuse.apps.cli.program import main
from tofuse.engine.cameras.cameras import BrownConrady, Fisheye, Pinhole, RayTable
from tofuse.engine.cameras.depth_conversion import points_from_z
from tofuse.engine.errors import OutputError
from tofuse.engine.frames.frames import CloudFrame, RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.formats.cameras.rectify import Rectifier, pinhole_of
from tofuse.formats.export.conversion import convert_to

BARREL = BrownConrady(96, 72, 70.0, 71.0, 46.0, 37.0, k1=-0.25, k2=0.06, p1=0.002)
WIDE = Fisheye(96, 72, 36.0, 36.0, 47.5, 35.5, k1=0.02)
NORMAL, DISTANCE = np.array([0.2, -0.1, 0.97]), 1.8


def plane_depth(camera: object) -> np.ndarray:
    """z of a tilted plane at each pixel."""
    rays = camera.rays().astype(float)
    z = DISTANCE / (rays @ NORMAL[:2] + NORMAL[2])
    return np.where(np.isfinite(z) & (z > 0) & (z < 20), z, 0).astype(np.float32)


@pytest.mark.parametrize("camera", [BARREL, WIDE, RayTable(np.array(BARREL.rays()))])
def test_rectified_plane_stays_planar(camera: object) -> None:
    frame = RangeFrame(0, 0.0, camera, plane_depth(camera))
    pinhole = pinhole_of(camera)
    out = Rectifier(pinhole)(frame)
    points = points_from_z(pinhole, out.z)[out.valid].astype(float)
    assert len(points) > 0.8 * out.depth.size
    # Taken from the nearest pixel regardless of its slope, the error would be centimetres.
    assert np.abs(points @ NORMAL - DISTANCE).max() < 1e-3


def test_pinhole_images_are_unchanged() -> None:
    pinhole = Pinhole(64, 48, 50.0, 50.0, 31.5, 23.5)
    assert pinhole_of(pinhole) is pinhole
    depth = np.random.default_rng(5).uniform(1, 3, (48, 64)).astype(np.float32)
    frame = RangeFrame(0, 0.0, pinhole, depth, "range")
    out = Rectifier(pinhole)(frame)
    assert out.depth_kind == "z"
    np.testing.assert_array_equal(out.z, frame.z)


def test_depth_edges_are_not_interpolated() -> None:
    depth = np.full((72, 96), 1.0, np.float32)
    depth[:, 50:] = 3.0
    depth[10:20, 10:20] = 0
    out = Rectifier(pinhole_of(BARREL))(RangeFrame(0, 0.0, BARREL, depth))
    z = out.z[out.valid]
    assert (np.minimum(np.abs(z - 1), np.abs(z - 3)) < 0.02).all()
    assert (~out.valid).sum() >= 80


def test_wide_lens_is_cropped_at_sixty_degrees() -> None:
    pinhole = pinhole_of(WIDE)
    assert np.abs(pinhole.rays()).max() < 2.0
    assert np.abs(pinhole.rays()[..., 0]).max() > 1.0


def turned(frames: int = 4) -> Recording:
    rng = np.random.default_rng(6)
    made, reference = [], np.tile(np.eye(4), (frames, 1, 1))
    for k in range(frames):
        amplitude = rng.uniform(10, 900, (72, 96)).astype(np.float32)
        made.append(RangeFrame(k, 100.0 + k / 10, BARREL, plane_depth(BARREL), "z", amplitude))
        reference[k, 0, 3] = 0.1 * k
    reference[2] = np.nan
    return Recording.of(ArraySource(made, reference), "made", "made")


def test_tum_is_read_back(tmp_path: Path) -> None:
    recording = turned()
    out = tmp_path / "freiburg1_again"  # of which the camera is another one
    done = convert_to(recording, out, "tum")
    assert done.frames == 4
    assert any("rectified" in w for w in done.warnings)
    back = tofuse.open(out)
    assert "Kinect" not in back.metadata.get("sensor", "")
    assert (back.format, len(back)) == ("tum", 4)
    assert back.timestamps == pytest.approx(recording.timestamps)
    expected = Rectifier(pinhole_of(BARREL))(recording[1])
    frame = back[1]
    assert np.abs(frame.z - expected.z).max() < 1.1e-4
    assert frame.camera == pinhole_of(BARREL)
    assert frame.color_image.max() == 255
    assert np.allclose(back.reference[[0, 1, 3]], recording.reference[[0, 1, 3]])
    assert np.isnan(back.reference[2]).all()


def test_open3d_is_read_back(tmp_path: Path) -> None:
    recording = turned()
    convert_to(recording, tmp_path / "out", "open3d")
    back = tofuse.open(tmp_path / "out")
    assert back.format == "redwood"
    frame = back[3]
    assert np.abs(frame.z - Rectifier(pinhole_of(BARREL))(recording[3]).z).max() < 6e-4
    assert frame.camera == pinhole_of(BARREL)
    assert np.diff(back.timestamps) == pytest.approx(0.1, abs=1e-5)
    assert np.allclose(back.reference[3][:3, 3], [0.3, 0, 0])


@pytest.mark.parametrize("dark", [None, np.zeros((72, 96), np.float32)])
def test_first_image_may_be_dark(tmp_path: Path, dark: np.ndarray | None) -> None:
    """Grey levels are those of the first amplitude that there is."""
    frames = [turned()[k] for k in range(4)]
    frames[0] = replace(frames[0], amplitude_image=dark)
    recording = Recording.of(ArraySource(frames), "made", "made")
    done = convert_to(recording, tmp_path / "out", "tum")
    assert not any("black" in w for w in done.warnings)
    back = tofuse.open(tmp_path / "out")
    assert [back[k].color_image.max() for k in range(2)] == [0, 255]
    without = [replace(frame, amplitude_image=None) for frame in frames]
    recording = Recording.of(ArraySource(without), "made", "made")
    done = convert_to(recording, tmp_path / "black", "tum")
    assert any("black" in w for w in done.warnings)


def test_colour_of_another_view_is_not_passed_off_as_that_of_depth(tmp_path: Path) -> None:
    color = np.full((72, 96, 3), 90, np.uint8)
    for registered in (True, False):
        frame = replace(turned()[0], color_image=color, color_registered=registered)
        recording = Recording.of(ArraySource([frame]), "made", "made")
        done = convert_to(recording, tmp_path / str(registered), "open3d")
        assert any("not registered" in line for line in done.warnings) != registered


def test_unsupported_conversions_are_refused(tmp_path: Path) -> None:
    cloud = Recording.of(ArraySource([CloudFrame.of(np.ones((5, 3)))]), "made", "made")
    refused("contains clouds", cloud, tmp_path / "a", "tum", by=convert_to)
    assert not list(tmp_path.iterdir())
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "mine").write_text("x")
    refused("isn't empty", turned(), tmp_path / "a", "tum", by=convert_to, error=OutputError)


def test_far_pixels_are_left_out_and_counted(tmp_path: Path) -> None:
    camera = Pinhole(32, 24, 20.0, 20.0, 15.5, 11.5)
    depth = np.full((24, 32), 2.0, np.float32)
    depth[:3] = 14.0  # beyond the 13.1 m of 16 bits of 0.2 mm
    recording = Recording.of(ArraySource([RangeFrame(0, 0.0, camera, depth)]), "made", "made")
    done = convert_to(recording, tmp_path / "a", "tum")
    assert any("96 pixels beyond 13.1 m" in w for w in done.warnings)
    frame = tofuse.open(tmp_path / "a", camera=tmp_path / "a" / "lens.json")[0]
    assert isinstance(frame, RangeFrame)
    assert not frame.valid[:3].any()


def test_convert_command(room_recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "o3d"
    assert main(["convert", str(room_recording), "--out", str(out), "--to", "open3d"]) == 0
    assert (out / "camera_intrinsic.json").is_file()
    assert len(list((out / "depth").iterdir())) == len(tofuse.open(room_recording))
