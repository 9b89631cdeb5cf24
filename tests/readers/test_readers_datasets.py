"""Each reader on small generated recordings with known ground truth."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from made_dumps import pgm_bytes
from made_recordings import (
    BUNDLEFUSION_INFO,
    CAMERA,
    COUNTS,
    POSES,
    make_7scenes,
    make_redwood,
    make_sr4000,
    make_tum,
    pcd_bytes,
    pcd_points,
)
from refused import refused
from tofuse.engine.cameras.cameras import BrownConrady, Pinhole, RayTable
from tofuse.engine.errors import InputError, UnreadableFrameError
from tofuse.engine.frames.frames import CloudFrame, RangeFrame
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.engine.geometry.se3 import exp
from tofuse.engine.noise.model import family_of
from tofuse.formats.geometry.ply import write_ply
from tofuse.formats.images.images import read_image, write_png
from tofuse.formats.poses.trajectory import write_tum
from tofuse.formats.recordings.open import open_recording
from written import camera_json


def test_sr4000_points_equal_stored_vectors(tmp_path: Path) -> None:
    z, rays = make_sr4000(tmp_path / "Y1")
    for k, frame in enumerate(open_recording(tmp_path / "Y1")):
        assert isinstance(frame.camera, RayTable)
        truth = np.concatenate([rays * (z[k] + 0.01)[..., None], z[k][..., None]], -1)
        assert not frame.valid[3, 3]
        assert frame.valid.sum() == 12 * 16 - 1
        np.testing.assert_allclose(frame.points, truth[frame.valid], atol=6e-5)
        np.testing.assert_array_equal(frame.amplitude_image.ravel(), np.arange(192))
        assert (frame.confidence_image == 5).all()


def test_sr4000_stations_are_joined_in_name_order(tmp_path: Path) -> None:
    z2, _ = make_sr4000(tmp_path / "Y2", 2)
    make_sr4000(tmp_path / "Y1", 3)
    recording = open_recording(tmp_path)
    assert len(recording) == 5
    assert (np.diff(recording.timestamps) > 0).all()
    assert "Y2: timestamps start again" in recording.warnings[0]
    frame = recording[3]
    assert frame.index == 3
    assert frame.timestamp == recording.timestamps[3]
    np.testing.assert_allclose(frame.z[frame.valid], z2[0][frame.valid], atol=1e-6)


def test_tum(tmp_path: Path) -> None:
    folder = tmp_path / "rgbd_dataset_freiburg1_xyz"
    make_tum(folder)
    recording = open_recording(folder)
    frame = recording[1]
    # The colour camera's lens, not the infrared one's: depth is registered to colour.
    assert isinstance(frame.camera, BrownConrady)
    assert (frame.camera.fx, frame.camera.k1) == (517.306408, 0.262383)
    np.testing.assert_allclose(frame.depth[1:], COUNTS[1][1:] / 5000, rtol=1e-6)
    assert frame.depth[0, :2].tolist() == [0, 0]
    assert frame.color_registered
    assert (frame.color_image == 1).all()
    np.testing.assert_allclose(recording.reference, POSES, atol=1e-12)
    assert recording.odometry is None
    third = open_recording(folder.rename(tmp_path / "fr3_office"))[0]
    assert third.camera == BrownConrady(640, 480, 535.4, 539.2, 320.1, 247.6)


def test_tum_with_colour_of_half_the_rate(tmp_path: Path) -> None:
    """No image is the colour of two frames."""
    folder = tmp_path / "freiburg1"
    make_tum(folder)
    lines = (folder / "rgb.txt").read_text().splitlines()
    (folder / "rgb.txt").write_text("\n".join(lines[::2]) + "\n")
    recording = open_recording(folder)
    assert [frame.color_image is None for frame in recording] == [True, False, True]
    assert [recording.source.has_color(k) for k in range(3)] == [False, True, False]
    assert "only 1 of 3 frames have colour" in recording.warnings


def test_tum_with_unknown_name_requires_camera(tmp_path: Path) -> None:
    make_tum(tmp_path / "living_room")
    refused(r"with camera=camera\.json", tmp_path / "living_room")
    lens = Pinhole(640, 480, 481.2, 480.0, 319.5, 239.5)
    file = camera_json(tmp_path / "camera.json", lens, depth_kind="range", sensor="ifm O3R222")
    recording = open_recording(tmp_path / "living_room", camera=file)
    assert recording[0].camera == lens
    assert recording[0].depth_kind == "range"
    assert family_of(recording, recording[0]) == "ifm-o3r"


def test_tum_camera_of_other_data_sets(tmp_path: Path) -> None:
    """Bonn's by the name of the folder, ETH3D's from calibration.txt."""
    make_tum(tmp_path / "rgbd_bonn_balloon")
    bonn = open_recording(tmp_path / "rgbd_bonn_balloon")[0].camera
    assert isinstance(bonn, BrownConrady)
    assert (bonn.fx, bonn.k2) == (542.822841, -0.099343)
    make_tum(tmp_path / "cables_1")
    (tmp_path / "cables_1" / "calibration.txt").write_text("726.2 726.3 359.2 202.5\n")
    recording = open_recording(tmp_path / "cables_1")
    assert recording[0].camera == Pinhole(640, 480, 726.2, 726.3, 359.2, 202.5)
    assert "sensor" not in recording.metadata
    (tmp_path / "cables_1" / "calibration.txt").write_text("726.2 726.3\n")
    refused(r"calibration\.txt: is not one line", tmp_path / "cables_1")


@pytest.mark.parametrize("order", ["depth first", "colour first"])
def test_tum_with_list_of_pairs_alone(tmp_path: Path, order: str) -> None:
    """As ICL-NUIM's, in which depth is first; associate.py writes colour first."""
    lines = []
    for k, counts in enumerate(COUNTS):
        for name in ("depth", "rgb"):
            (tmp_path / name).mkdir(exist_ok=True)
        write_png(tmp_path / "depth" / f"{k + 9}.png", counts)
        write_png(tmp_path / "rgb" / f"{k + 9}.png", np.full((480, 640, 3), k, np.uint8))
        pair = [f"{k + 9} depth\\{k + 9}.png", f"{k + 9} rgb/{k + 9}.png"]
        lines.append(" ".join(pair if order == "depth first" else pair[::-1]))
    (tmp_path / "associations.txt").write_text("\r\n".join(lines))
    refused(r"camera=camera\.json.*depth_unit_m 0\.0002", tmp_path)
    (tmp_path / "calibration.txt").write_text("481.2 480 319.5 239.5")
    recording = open_recording(tmp_path)
    for k, frame in enumerate(recording):
        np.testing.assert_allclose(frame.depth[1:], COUNTS[k][1:] / 5000, rtol=1e-6)
        assert (frame.color_image == k).all()
    np.testing.assert_array_equal(recording.timestamps, [9, 10, 11])


def test_7scenes(tmp_path: Path) -> None:
    make_7scenes(tmp_path / "seq-01")
    recording = open_recording(tmp_path / "seq-01")
    frame = recording[2]
    assert frame.camera == Pinhole(640, 480, 585.0, 585.0, 320.0, 240.0)
    np.testing.assert_allclose(frame.depth[1:], COUNTS[2][1:] / 1000, rtol=1e-6)
    assert not frame.color_registered
    np.testing.assert_allclose(recording.reference, POSES, atol=1e-12)
    # 3DMatch's sequences without the file above them look the same.
    assumed = "no camera-intrinsics.txt or info.txt: the camera of 7-Scenes is used (585 px)"
    assert assumed in recording.warnings[0]
    (tmp_path / "seq-01" / "camera-intrinsics.txt").write_text("500 0 320\n0 510 240\n0 0 1\n")
    np.savetxt(tmp_path / "seq-01" / "frame-000002.pose.txt", np.full((4, 4), np.inf))
    recording = open_recording(tmp_path / "seq-01")
    assert len(recording.warnings) == 1
    assert assumed not in recording.warnings[0]
    assert np.isnan(recording.reference[1]).all()
    assert recording[0].camera == Pinhole(640, 480, 500.0, 510.0, 320.0, 240.0)


@pytest.mark.parametrize("place", ["apt0", "office2/data"], ids=["BundleFusion", "12-Scenes"])
def test_cameras_in_info_file(tmp_path: Path, place: str) -> None:
    """Beside the frames, or above; colour has its own camera there."""
    make_7scenes(tmp_path / place)
    for path in (tmp_path / place).glob("*.color.png"):
        write_png(path, np.full((240, 320, 3), 77, np.uint8))
    info = tmp_path / place.split("/")[0] / "info.txt"
    info.write_text(BUNDLEFUSION_INFO)
    recording = open_recording(tmp_path / place)
    frame = recording[1]
    assert frame.camera == Pinhole(640, 480, 583.0, 584.0, 320.0, 240.0)
    np.testing.assert_allclose(frame.depth[1:], COUNTS[1][1:] / 5000, rtol=1e-6)
    assert frame.color_registered
    assert set(np.unique(frame.color_image)) == {0, 77}  # occluded, or seen
    assert recording.metadata["sensor"] == "StructureSensor"
    assert recording.warnings == []
    # 3RScan's depth is PGM.
    for path in (tmp_path / place).glob("*.depth.png"):
        path.with_suffix(".pgm").write_bytes(pgm_bytes(read_image(path)))
        path.unlink()
    np.testing.assert_array_equal(open_recording(tmp_path / place)[1].depth, frame.depth)
    info.write_text(BUNDLEFUSION_INFO.replace("583 0", "wide 0"))
    refused(r"info\.txt: m_calibrationDepthIntrinsic: is missing, or", tmp_path / place)


def test_camera_of_3dmatch_is_above_its_sequences(tmp_path: Path) -> None:
    make_7scenes(tmp_path / "seq-01")
    (tmp_path / "camera-intrinsics.txt").write_text("572 0 320\n0 573 240\n0 0 1\n")
    for path in (tmp_path / "seq-01", tmp_path):
        assert open_recording(path)[0].camera == Pinhole(640, 480, 572.0, 573.0, 320.0, 240.0)


def intrinsic(path: Path, matrix: object = (500.0, 0, 0, 0, 510.0, 0, 321.0, 241.0, 1), **facts):
    """Write the camera as Open3D does, which stores the matrix column by column."""
    about = {"width": 640, "height": 480, "intrinsic_matrix": matrix}
    path.write_text(json.dumps(about | facts))


OF_FILE = Pinhole(640, 480, 500.0, 510.0, 321.0, 241.0)


@pytest.mark.parametrize("color", ["color", "image", "rgb"])
def test_redwood(tmp_path: Path, color: str) -> None:
    make_redwood(tmp_path, color)
    recording = open_recording(tmp_path)
    assert any("PrimeSense default" in w for w in recording.warnings)
    frame = recording[1]
    assert frame.camera == Pinhole(640, 480, 525.0, 525.0, 319.5, 239.5)
    np.testing.assert_allclose(frame.depth[1:], COUNTS[1][1:] / 1000, rtol=1e-6)
    np.testing.assert_allclose(recording.reference, POSES, atol=1e-12)
    intrinsic(tmp_path / "camera_primesense.json")
    recording = open_recording(tmp_path)
    assert recording.warnings == []
    assert recording[0].camera == OF_FILE


def test_redwood_uses_what_recorders_of_open3d_state(tmp_path: Path) -> None:
    """As its readers of RealSense bags: unit and rate beside the lens."""
    for name in ("depth", "color"):
        (tmp_path / name).mkdir()
        for k, counts in enumerate(COUNTS):
            write_png(tmp_path / name / f"{k:05d}.png", counts)
    facts = {"fps": 30.0, "depth_scale": 4000.0, "device_name": "Intel RealSense L515"}
    intrinsic(tmp_path / "intrinsic.json", **facts)
    recording = open_recording(tmp_path)
    frame = recording[1]
    np.testing.assert_allclose(frame.depth[1:], COUNTS[1][1:] / 4000, rtol=1e-6)
    np.testing.assert_allclose(recording.timestamps, np.arange(3) / 30)
    assert recording.metadata["sensor"] == "Intel RealSense L515"
    # Row by row, as people write it.
    rows = [[500.0, 0, 321.0], [0, 510.0, 241.0], [0, 0, 1]]
    intrinsic(tmp_path / "intrinsic.json", rows, **facts)
    assert open_recording(tmp_path)[0].camera == frame.camera == OF_FILE
    shutil.rmtree(tmp_path / "color")
    assert open_recording(tmp_path).format == "redwood"
    intrinsic(tmp_path / "intrinsic.json", depth_scale=0.001)
    refused(r"intrinsic\.json: depth_scale: is 0\.001", tmp_path)


def test_redwood_beside_other_json_files(tmp_path: Path) -> None:
    """Open3D's viewer saves views, with the intrinsic matrix of its window."""
    make_redwood(tmp_path)
    (tmp_path / "trajectory.log").unlink()
    intrinsic(tmp_path / "intrinsic.json")
    camera = json.loads((tmp_path / "intrinsic.json").read_text()) | {"width": 1920}
    window = {"class_name": "PinholeCameraParameters", "intrinsic": camera}
    (tmp_path / "ScreenCamera_2026-11-28.json").write_text(json.dumps(window))
    (tmp_path / "._intrinsic.json").write_bytes(b"\0\5\26\7")
    (tmp_path / "other.json").write_bytes(b"\xff\xff")
    assert open_recording(tmp_path)[0].camera == OF_FILE
    refused(r"not a recording .*; pass the recording's folder, ", tmp_path / "color")


def test_redwood_colour_of_another_rate_and_numbering(tmp_path: Path) -> None:
    """By time if both are named by it, as in Redwood's data sets, or by equal names."""
    make_redwood(tmp_path)
    for path in (tmp_path / "color").iterdir():
        path.unlink()
    for k in range(5):
        name = f"{k + 1:07d}-{k * 20000:012d}.png"
        write_png(tmp_path / "color" / name, np.full((480, 640, 3), 40 * k, np.uint8))
    colors = [frame.color_image[0, 0, 0] for frame in open_recording(tmp_path)]
    assert colors == [0, 80, 120]  # of 0, 40 and 60 ms for 0, 33 and 67 ms
    for k, path in enumerate(sorted((tmp_path / "depth").iterdir())):
        path.rename(path.with_name(f"frame_{k + 9}.png"))
    for k, path in enumerate(sorted((tmp_path / "color").iterdir())):
        path.rename(path.with_name(f"frame_{k + 8}.png"))
    colors = [frame.color_image[0, 0, 0] for frame in open_recording(tmp_path)]
    assert colors == [40, 80, 120]


def test_colour_of_camera_in_given_camera_json(tmp_path: Path) -> None:
    """Colour of another size is sampled where each point projects."""
    make_redwood(tmp_path)
    for path in (tmp_path / "color").iterdir():
        write_png(path, np.dstack([np.tile(np.arange(320) // 2, (240, 1))] * 3).astype(np.uint8))
    recording = open_recording(tmp_path)
    assert [frame.color_image for frame in recording] == [None] * 3
    assert "colour can't be read in 3 frames" in recording.warnings[-1]
    assert "pass its camera in camera.json" in recording.warnings[-1]
    lens = {"width": 320, "height": 240, "fx": 300.0, "fy": 300.0, "cx": 159.5, "cy": 119.5}
    color = {"intrinsics": lens, "T_color_depth": np.eye(4).tolist()}
    whole = Pinhole(640, 480, 600.0, 600.0, 319.5, 239.5)
    given = camera_json(tmp_path / "given.json", whole, color=color)
    frame = open_recording(tmp_path, camera=given)[0]
    expected = np.tile(np.arange(640) // 4, (480, 1))
    seen = frame.color_image[..., 0] > 0
    assert seen.mean() > 0.2  # random depth occludes
    assert (np.abs(frame.color_image[..., 0].astype(int) - expected)[seen] <= 1).all()
    assert frame.color_registered


def test_redwood_with_fewer_colour_images_of_other_names(tmp_path: Path) -> None:
    make_redwood(tmp_path)
    (tmp_path / "color" / "000001.png").unlink()
    for path, name in zip((tmp_path / "color").iterdir(), "ab", strict=True):
        path.rename(path.with_name(f"photo {name}.png"))
    recording = open_recording(tmp_path, format="redwood")
    assert any("their names don't show which belong together" in w for w in recording.warnings)


@pytest.mark.parametrize("names", ["{1:06d}.png", "{0}_{1:04d}.png"])
def test_redwood_with_other_images_missing_of_each_kind(tmp_path: Path, names: str) -> None:
    """As many images of each kind, but not of the same frames."""
    image = np.zeros((480, 640, 3), np.uint8)
    for name, frames in (("depth", (0, 1, 3, 4)), ("color", (0, 1, 2, 4))):
        (tmp_path / name).mkdir()
        for k in frames:
            file = tmp_path / name / names.format(name, k)
            write_png(file, COUNTS[0] if name == "depth" else image + 40 * k)
    recording = open_recording(tmp_path, format="redwood")
    assert any("only 3 of 4 frames have colour" in w for w in recording.warnings)
    colors = [None if f.color_image is None else f.color_image[0, 0, 0] for f in recording]
    assert colors == [0, 40, None, 160]
    # Counted from another number.
    for k, path in enumerate(sorted((tmp_path / "depth").iterdir())):
        path.rename(path.with_name(f"{k:06d}.png"))
    for k, path in enumerate(sorted((tmp_path / "color").iterdir())):
        path.rename(path.with_name(f"{k + 10:06d}.png"))
    colors = [f.color_image[0, 0, 0] for f in open_recording(tmp_path, format="redwood")]
    assert colors == [0, 40, 80, 160]


def test_redwood_with_tiff_depth_names_what_reads_it(tmp_path: Path) -> None:
    make_redwood(tmp_path)
    for file in (tmp_path / "depth").glob("*.png"):
        file.rename(file.with_suffix(".tiff"))
    refused(r"has no .png files, but \d+ .tif files.*format tiff", tmp_path)


def test_redwood_without_camera_is_ambiguous(tmp_path: Path) -> None:
    make_redwood(tmp_path)
    (tmp_path / "trajectory.log").unlink()
    refused("format redwood", tmp_path)
    assert len(open_recording(tmp_path, format="redwood")) == 3


def test_organised_pcd_becomes_image(tmp_path: Path) -> None:
    truth = [pcd_points(CAMERA, k) for k in range(3)]
    for k, points in enumerate(truth):
        intensity = np.arange(1200.0)
        (tmp_path / f"cloud_{k}.pcd").write_bytes(pcd_bytes(points, intensity=intensity))
    half = np.sqrt(0.5)
    (tmp_path / "poses.txt").write_text(f"2 1 2 3 {half} {half} 0 0\n0 0 0 0 1 0 0 0\n")
    recording = open_recording(tmp_path)
    for k, frame in enumerate(recording):
        assert frame.camera.fx == pytest.approx(35, abs=1e-3)
        measured = np.isfinite(truth[k]).all(-1)
        np.testing.assert_array_equal(frame.valid, measured)
        np.testing.assert_allclose(frame.points, truth[k][measured], atol=1e-4)
        np.testing.assert_array_equal(frame.amplitude, np.flatnonzero(measured))
    np.testing.assert_array_equal(recording.reference[0], np.eye(4))
    assert np.isnan(recording.reference[1]).all()
    np.testing.assert_allclose(recording.reference[2][:3, 1], [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(recording.reference[2][:3, 3], [1, 2, 3])


def test_organised_pcd_with_distortion_has_ray_table(tmp_path: Path) -> None:
    lens = BrownConrady(40, 30, 35.0, 36.0, 19.5, 14.5, -0.1, 0.02)
    truth = pcd_points(lens, 1)
    (tmp_path / "a.pcd").write_bytes(pcd_bytes(truth))
    # A second file has pixels that the first lacks.
    (tmp_path / "b.pcd").write_bytes(pcd_bytes(pcd_points(lens, 2)))
    frame = open_recording(tmp_path)[0]
    assert isinstance(frame.camera, RayTable)
    np.testing.assert_allclose(frame.points, truth[np.isfinite(truth).all(-1)], atol=1e-5)
    assert np.isfinite(frame.camera.rays()).all(-1).mean() > 0.85


def test_unorganised_pcd_stays_cloud(tmp_path: Path) -> None:
    points = np.random.default_rng(3).normal(size=(30, 40, 3))
    (tmp_path / "a.pcd").write_bytes(pcd_bytes(points))
    frame = open_recording(tmp_path / "a.pcd")[0]
    assert isinstance(frame, CloudFrame)
    np.testing.assert_allclose(frame.points, points.reshape(-1, 3), rtol=1e-6)
    row = pcd_bytes(points.reshape(1, -1, 3)).replace(b"VIEWPOINT 0 0 0", b"VIEWPOINT 1 2 3")
    (tmp_path / "a.pcd").write_bytes(row)
    frame = open_recording(tmp_path / "a.pcd")[0]
    assert frame.origin.tolist() == [1, 2, 3]


def test_pcd_with_width_and_height_exchanged_is_refused(tmp_path: Path) -> None:
    right = pcd_bytes(pcd_points(CAMERA, 1))
    wrong = right.replace(b"WIDTH 40", b"WIDTH 30").replace(b"HEIGHT 30", b"HEIGHT 40")
    (tmp_path / "a.pcd").write_bytes(wrong)
    with pytest.raises(InputError, match="has WIDTH 30 and HEIGHT 40, but rows of 40 points") as e:
        open_recording(tmp_path)
    assert e.value.remedy == "swap WIDTH and HEIGHT"


def test_pcd_of_another_camera_is_unreadable(tmp_path: Path) -> None:
    for k in range(12):
        (tmp_path / f"{k}.pcd").write_bytes(pcd_bytes(pcd_points(CAMERA, k)))
    # Not among the files that are inspected first.
    other = Pinhole(40, 30, 60.0, 60.0, 19.5, 14.5)
    (tmp_path / "11.pcd").write_bytes(pcd_bytes(pcd_points(other, 11)))
    recording = open_recording(tmp_path)
    assert isinstance(recording[10], RangeFrame)
    with pytest.raises(UnreadableFrameError, match="off the rays"):
        recording[11]


@pytest.mark.parametrize("value", [3e38, -3e38, 1e20, 1e-40, 0.0, np.inf])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_absurd_numbers_in_organised_pcd(tmp_path: Path, value: float, axis: int) -> None:
    for count in (1, 1200):
        points = pcd_points(CAMERA, 1)
        points.reshape(-1, 3)[:count, axis] = value
        (tmp_path / "a.pcd").write_bytes(pcd_bytes(points))
        assert (np.abs(open_recording(tmp_path / "a.pcd")[0].points) < 1e9).all()


def test_ply_folder_is_in_the_order_of_numbers(tmp_path: Path) -> None:
    points = {
        k: np.random.default_rng(k).normal(size=(20, 3)).astype(np.float32) for k in (10, 9, 1)
    }
    for k in points:
        intensity = {"intensity": np.full(20, k, np.float32)}
        write_ply(tmp_path / f"scan{k}.ply", GeometryRecord(points[k], scalars=intensity))
    (tmp_path / "timestamps.txt").write_text("0.5\n1.5\n2.5\n")
    recording = open_recording(tmp_path)
    assert recording.timestamps.tolist() == [0.5, 1.5, 2.5]
    for frame, k in zip(recording, (1, 9, 10), strict=True):
        np.testing.assert_array_equal(frame.points, points[k])
        assert frame.amplitude[0] == k


def test_xyz(tmp_path: Path) -> None:
    points = np.random.default_rng(4).normal(size=(20, 3))
    unit = points / np.linalg.norm(points, axis=1, keepdims=True)
    files = {
        "a.xyz": points,
        "b.xyz": np.c_[points, np.arange(20)],
        "c.xyz": np.c_[points, unit],
        "d.xyz": np.c_[points, np.tile([10, 20, 30], (20, 1))],
        "e.xyzrgb": np.c_[points, np.full((20, 3), 0.2)],
        "f.asc": points,
        "g.pts": np.c_[points, np.arange(20) - 40, np.tile([10, 20, 30], (20, 1))],
    }
    for name, table in files.items():
        np.savetxt(tmp_path / name, table)
    frames = list(open_recording(tmp_path))
    for frame in frames:
        np.testing.assert_allclose(frame.points, points, rtol=1e-6)
    assert frames[0].amplitude is None
    np.testing.assert_array_equal(frames[1].amplitude, np.arange(20))
    np.testing.assert_allclose(frames[2].normals, unit, rtol=1e-6)
    for k, color in ((3, [10, 20, 30]), (4, [51, 51, 51]), (6, [10, 20, 30])):
        assert frames[k].color[0].tolist() == color


_PLY = """ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y
property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"""
_PCD = """VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 3\nHEIGHT 1
POINTS 3\nDATA ascii\n"""


@pytest.mark.parametrize(
    ("name", "head", "end"),
    [("a.ply", _PLY, "3 0 1 2\n"), ("a.pcd", _PCD, ""), ("a.xyz", "", ""), ("a.3d", "3\n", "")],
)
def test_points_that_windows_programs_write_as_missing(tmp_path, name, head, end) -> None:
    rows = "1.#QNAN 1.#QNAN 1.#QNAN\n4 5 6\n-nan(ind) nan(snan) -1.#IND\n"
    (tmp_path / name).write_text(head + rows + end)
    assert len(open_recording(tmp_path)[0]) == 1


@pytest.mark.parametrize(
    "head", ["X Y Z Nx Ny Nz\n", "x;y;z;nx;ny;nz\n", "20\n", "//X Y Z\n", "\n", ""]
)
def test_head_of_xyz_is_skipped(tmp_path: Path, head: str) -> None:
    table = np.random.default_rng(6).normal(size=(20, 6)).round(6)
    rows = "".join(" ".join(map(str, row)) + "\n" for row in table.tolist())
    (tmp_path / "a.xyz").write_text(head + rows)
    np.testing.assert_allclose(open_recording(tmp_path)[0].points, table[:, :3], rtol=1e-6)


@pytest.mark.parametrize("head", ["Point,Northing,Easting,Height\n", "a;b;c;d\n"])
def test_xyz_whose_names_leave_the_axes_open_is_refused(tmp_path: Path, head: str) -> None:
    """An identifier in front was taken for x; northing before easting mirrors the cloud."""
    (tmp_path / "a.xyz").write_text(head + "1,2,3,4\n")
    with pytest.raises(InputError, match=r"a\.xyz: names its columns .*; call those of the coord"):
        open_recording(tmp_path)[0]
    for named in ("id,X_m,Y_m,Z_m\n", "id,x,y,z\n", "# of a scanner\n"):
        (tmp_path / "a.xyz").write_text(named + "1,2,3,4\n")
        first = 1 if "," in named else 0
        assert open_recording(tmp_path)[0].points.tolist() == [[1.0, 2, 3, 4][first : first + 3]]
    (tmp_path / "a.xyz").write_text("id x y z s s\n1 2 3 4 5 6\n")
    assert open_recording(tmp_path)[0].points.tolist() == [[2, 3, 4]]


@pytest.mark.parametrize(
    "head",
    ["# of a scanner\n//ID,X,Y,Z,Intensity,R,G,B\n20\n", "id;x[m];y[m];z[m];i;red;green;blue\n"],
)
def test_columns_of_xyz_that_are_named(tmp_path: Path, head: str) -> None:
    points = np.random.default_rng(6).normal(size=(20, 3)).round(6)
    table = np.c_[np.arange(20), points, np.arange(20) + 300, np.tile([10, 20, 30], (20, 1))]
    rows = "".join(",".join(map(str, row)) + "\n" for row in table.tolist())
    (tmp_path / "a.xyz").write_text(head + rows)
    frame = open_recording(tmp_path)[0]
    np.testing.assert_allclose(frame.points, points, rtol=1e-6)
    np.testing.assert_array_equal(frame.amplitude, np.arange(20) + 300)
    assert frame.color[0].tolist() == [10, 20, 30]
    # A class is no amplitude, and the order is that of the file.
    (tmp_path / "a.xyz").write_text("Y X Z Class\n1 2 3 4\n")
    frame = open_recording(tmp_path)[0]
    assert frame.amplitude is None
    assert frame.points.tolist() == [[1, 2, 3]]


def test_map_coordinates_that_floats_round_are_refused(tmp_path: Path) -> None:
    """In a room they would be steps of half a metre; over a town the same steps don't matter."""
    scan = np.random.default_rng(5).uniform(-3, 3, (40, 3))
    for factor, place in ((1, [5e5, 5e6, 3]), (1, [5e4, 9e3, 3]), (1000, [5e5, 5e6, 3])):
        points = factor * scan + np.array(place)
        write_ply(tmp_path / "a.ply", GeometryRecord(points.astype(np.float32)))
        if place[1] == 5e6 and factor == 1:
            refused(r"a.ply: .* 32-bit floats round to 0.5 m", tmp_path)
            refused("double precision", points.astype(np.float32), by=CloudFrame.of)
        else:
            assert len(open_recording(tmp_path)[0]) == 40


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".xyz"])
def test_map_coordinates_keep_millimetre_precision(tmp_path: Path, suffix: str) -> None:
    """Each cloud has its shift; poses stay those of the files."""
    rng = np.random.default_rng(5)
    clouds = np.array([500_000.123, 4_000_000.456, 3]) + rng.uniform(-3, 3, (2, 40, 3))
    for k, points in enumerate(clouds):
        path = tmp_path / f"{k}{suffix}"
        rows = "\n".join(" ".join(f"{v:.6f}" for v in row) for row in points) + "\n"
        head = ""
        if suffix == ".ply":
            head = "ply\nformat ascii 1.0\nelement vertex 40\n"
            head += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
        elif suffix == ".pcd":
            head = "VERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 40\n"
            head += "HEIGHT 1\nVIEWPOINT 500001 4000002 7 1 0 0 0\nPOINTS 40\nDATA ascii\n"
        path.write_text(head + rows)
    T = exp([1, 2, 3, 0.1, 0.2, 0.3])
    write_tum(tmp_path / "groundtruth.txt", [0, 1], np.stack([np.eye(4), T]))
    recording = open_recording(tmp_path)
    for k, frame in enumerate(recording):
        assert isinstance(frame, CloudFrame)
        assert np.abs(frame.shift - [500_000, 4_000_000, 3]).max() <= 3  # near the points
        np.testing.assert_array_equal(frame.shift, np.round(frame.shift))
        local = frame.points.astype(float) + frame.shift
        np.testing.assert_allclose(local, clouds[k], rtol=0, atol=1e-5)
        if suffix == ".pcd":
            np.testing.assert_allclose(frame.origin + frame.shift, [500_001, 4_000_002, 7])
    np.testing.assert_allclose(recording.reference[1], T)


def test_slam6d_axes_units_and_poses(tmp_path: Path) -> None:
    """A left-handed world in cm: x right, y up, z forward."""
    (tmp_path / "scan000.3d").write_text("3\n100 200 300\n0 0 0\n-50 0 10\n")
    (tmp_path / "scan000.pose").write_text("0 0 0\n0 0 0\n")
    (tmp_path / "scan001.3d").write_text("100 200 300 7\n-50 0 10 8\n")
    (tmp_path / "scan001.pose").write_text("100 50 -200\n0 90 0\n")
    recording = open_recording(tmp_path)
    np.testing.assert_allclose(recording[0].points, [[1, -2, 3], [-0.5, 0, 0.1]], rtol=1e-6)
    np.testing.assert_array_equal(recording[1].amplitude, [7, 8])
    np.testing.assert_array_equal(recording.odometry[0], np.eye(4))
    T = recording.odometry[1]
    np.testing.assert_allclose(T[:3, 3], [1, -0.5, -2])
    # 3DTK rotates z forward to x right at +90 degrees about y.
    np.testing.assert_allclose(T[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-15)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    assert "not ground truth" in recording.warnings[0]
