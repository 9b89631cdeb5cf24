"""Folders of other programs, in their published layouts, and faulty ones."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import made_dumps as made
import made_phones
from made_phones import DEPTH, HEIGHT, POSES, WIDTH
from phone_checks import check_frames, check_lens
from posed_results import BROWN, made_result
from posed_results import POSED as EXPORTED
from posed_results import POSES as EXPORTED_POSES
from refused import refused
from tofuse.apps.export.exporting import export
from tofuse.engine.cameras.cameras import BrownConrady, Fisheye, Pinhole
from tofuse.engine.errors import UnreadableFrameError
from tofuse.formats.images.images import parse_image
from tofuse.formats.recordings.open import open_recording


def test_folder_of_keyframes_is_a_polycam_export(tmp_path: Path) -> None:
    made.make_polycam(tmp_path / "scan")
    recording = open_recording(tmp_path / "scan" / "keyframes")
    assert recording.metadata["poses_by"] == "Polycam"
    check_frames(recording)


def test_polycam_with_corrected_cameras_and_images_alone(tmp_path: Path) -> None:
    folder = tmp_path / "scan"
    made.make_polycam(folder)
    shutil.rmtree(folder / "keyframes" / "cameras")
    (folder / "keyframes" / "images").rename(folder / "keyframes" / "corrected_images")
    recording = open_recording(folder)
    check_frames(recording)
    for k, frame in enumerate(recording):
        check_lens(frame, made_phones.FX + k, made_phones.CX, made_phones.CY)
        assert frame.color_image is None
    lens, color = recording.warnings
    assert "cameras/ is missing: the lenses are those of corrected_cameras/" in lens
    assert "images/ is missing: colour is left out" in color


def test_polycam_without_optimised_poses(tmp_path: Path) -> None:
    made.make_polycam(tmp_path / "scan", corrected=False)
    recording = open_recording(tmp_path / "scan")
    assert recording.metadata["poses_by"] == "ARKit"
    np.testing.assert_allclose(recording.reference[:, :3, 3], POSES[:, :3, 3] + 0.01)


def test_poses_of_a_phone_are_told_from_those_of_a_program(tmp_path: Path) -> None:
    made.make_nerfcapture(tmp_path / "phone")
    made.make_nerfstudio(tmp_path / "program")
    assert open_recording(tmp_path / "phone").metadata["poses_by"] == "NeRFCapture"
    recording = open_recording(tmp_path / "program")
    assert "poses_by" not in recording.metadata
    check_frames(recording)
    # Eight colour pixels are one depth pixel; both grids start at a corner.
    center = (130 / 8 - 0.5, 95 / 8 - 0.5)
    expected = BrownConrady(WIDTH, HEIGHT, 25.0, 201 / 8, *center, -0.05, 0.01, 0.001)
    np.testing.assert_allclose(recording[0].camera.rays(), expected.rays(), atol=1e-6)


def test_nerfstudio_with_views_for_training_alone(tmp_path: Path) -> None:
    made.make_nerfstudio(tmp_path / "scan")
    file = (tmp_path / "scan" / "transforms.json").rename(
        tmp_path / "scan" / "transforms_train.json"
    )
    for path in (tmp_path / "scan", file):
        check_frames(open_recording(path))
    test = file.with_name("transforms_test.json")
    test.write_bytes(file.read_bytes())
    (note,) = (w for w in open_recording(tmp_path / "scan").warnings if "the only frames" in w)
    assert "transforms_test.json" in note
    assert len(open_recording(file, test)) == 2 * len(open_recording(test))


def test_exported_nerfstudio_is_read_back(tmp_path: Path) -> None:
    """Depth, colour, lens, poses, times and sigma, as `tofuse export` writes them."""
    (folder,) = export(made_result(tmp_path, BROWN), ["nerfstudio"])
    recording = open_recording(folder)
    original = open_recording(tmp_path / "scan")
    np.testing.assert_allclose(recording.reference, EXPORTED_POSES[EXPORTED], atol=1e-9)
    np.testing.assert_allclose(recording.timestamps, original.timestamps[EXPORTED], atol=1e-9)
    for k, frame in zip(EXPORTED, recording, strict=True):
        same = original[k]
        np.testing.assert_allclose(frame.depth, same.depth, atol=1e-6)
        np.testing.assert_array_equal(frame.color_image, same.color_image)
        np.testing.assert_allclose(frame.camera.rays(), same.camera.rays(), atol=1e-9)
        assert frame.sigma_image is not None
        assert (frame.sigma_image > 0).mean() > 0.9


def changed(folder: Path, **changes: object) -> None:
    """Change fields of a transforms.json; None removes one."""
    path = folder / "transforms.json"
    about = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({k: v for k, v in about.items() if v is not None}))


def test_nerfstudio_with_angle_fisheye_and_float_depth(tmp_path: Path) -> None:
    folder = tmp_path / "scan"
    made.make_nerfstudio(folder)
    about = json.loads((folder / "transforms.json").read_text())
    for frame in about["frames"]:
        path = folder / frame["depth_file_path"]
        k = int(path.stem[-1])
        depth = DEPTH[k].astype(np.float32).copy()
        depth[1, 1] = np.inf
        np.save(path.with_suffix(".npy"), depth)
        frame["depth_file_path"] = f"depth/{path.stem}.npy"
    del about["frames"][0]["transform_matrix"]
    about["frames"][1]["transform_matrix"] = [[float("nan")] * 4] * 4
    (folder / "transforms.json").write_text(json.dumps(about))
    gone = dict.fromkeys(("k1", "k2", "p1", "p2", "fl_x", "fl_y"))
    changed(folder, depth_unit_scale_factor=1.0, camera_angle_x=1.0, **gone)
    recording = open_recording(folder)
    frame = recording[1]
    assert type(frame.camera) is Pinhole
    assert frame.camera.fx == pytest.approx(WIDTH / 2 / np.tan(0.5))
    assert not frame.valid[1, 1]
    np.testing.assert_array_equal(frame.depth[2:], DEPTH[1][2:])
    assert np.isfinite(recording.reference).all((1, 2)).tolist() == [False, True, False]
    assert any("1 pose can't be read" in line for line in recording.warnings)
    changed(folder, camera_model="OPENCV_FISHEYE", k1=0.01)
    frame = open_recording(folder)[0]
    assert isinstance(frame.camera, Fisheye)
    assert frame.camera.k1 == 0.01


@pytest.mark.parametrize("unpacked", [False, True])
@pytest.mark.parametrize("stream", ["Depth Long Throw", "Depth AHaT"])
def test_hololens(tmp_path: Path, stream: str, unpacked: bool) -> None:
    made.make_hololens(tmp_path / "scan", stream=stream, unpacked=unpacked)
    recording = open_recording(tmp_path / "scan")
    np.testing.assert_allclose(recording.reference, POSES, atol=1e-9)
    rays = made.hololens_rays()
    for k, frame in enumerate(recording):
        assert frame.depth_kind == "range"
        np.testing.assert_allclose(frame.camera.rays(), rays, atol=1e-5)
        np.testing.assert_allclose(frame.depth, DEPTH[k], atol=6e-4)
        assert not frame.valid[:3, :3].any()
        assert frame.valid[3:].all()
        np.testing.assert_array_equal(frame.amplitude_image, made.AMPLITUDE[k])
        assert frame.ambiguity_m == (1.0 if stream == "Depth AHaT" else None)
    lengths = np.linalg.norm(frame.points, axis=1)
    np.testing.assert_allclose(lengths, frame.depth[frame.valid], rtol=1e-5)


def test_incomplete_hololens(tmp_path: Path) -> None:
    folder = tmp_path / "scan"
    made.make_hololens(folder, unpacked=True)
    stream = "Depth Long Throw"
    (folder / stream / f"{made.TICKS[1]}_ab.pgm").unlink()
    path = folder / stream / f"{made.TICKS[2]}.pgm"
    path.write_bytes(path.read_bytes()[:-1])
    rows = (folder / f"{stream}_rig2world.txt").read_text().splitlines()
    cells = rows[1].split(",")
    cells[5] = "nan"
    (folder / f"{stream}_rig2world.txt").write_text("\n".join([rows[0], ",".join(cells)]))
    recording = open_recording(folder)
    items = list(recording.read_all())
    assert items[1].amplitude_image is None
    assert isinstance(items[2], UnreadableFrameError)
    assert "is cut off" in str(items[2])
    assert recording.reference is not None
    assert np.isfinite(recording.reference).all((1, 2)).tolist() == [True, False, False]
    (folder / f"{stream}_extrinsics.txt").unlink()
    recording = open_recording(folder)
    assert recording.reference is None
    assert any("extrinsics.txt is missing" in line for line in recording.warnings)
    table = folder / f"{stream}_lut.bin"
    table.write_bytes(table.read_bytes()[:-12])
    refused("not 12 for each of", folder)


def test_pgm() -> None:
    image = np.arange(6, dtype=np.uint16).reshape(2, 3) * 1000
    np.testing.assert_array_equal(parse_image(made.pgm_bytes(image), "a.pgm"), image)
    small = b"P5 # made by hand\n3 2\n# twice\n255\n" + bytes(range(6))
    np.testing.assert_array_equal(parse_image(small, "a.pgm"), np.arange(6).reshape(2, 3))
    for bad in (b"", b"P2\n1 1\n1\n1", b"P5\n0 2\n255\n", b"P5\n99999 99999\n255\n", small[:-1]):
        refused(r"a\.pgm", bad, "a.pgm", by=parse_image)


@pytest.mark.parametrize(
    ("size", "serial", "scale"),
    [((512, 424), "", 1.0), ((960, 540), "501467543042", 1.5), ((1920, 1080), "", 3.0)],
)
def test_kinect2(tmp_path: Path, size: tuple[int, int], serial: str, scale: float) -> None:
    made.make_kinect2(tmp_path / "scan", size=size, serial=serial)
    for k, frame in enumerate(open_recording(tmp_path / "scan")):
        assert frame.camera == Pinhole(*size, *(scale * value for value in made.K2))
        assert frame.depth[100, 100] == pytest.approx(1 + 0.1 * k)
        assert not frame.valid[0, 0]
        assert (frame.color_image is None) == (k == 1)


def test_depth16_level_of_confidence(tmp_path: Path) -> None:
    """Level 0 is undefined and counts as certain; level n is (n - 1) sevenths."""
    made.make_depth16(tmp_path / "scan")
    recording = open_recording(tmp_path / "scan")
    assert recording.metadata["confidence_max"] == 7
    for k, frame in enumerate(recording):
        np.testing.assert_allclose(frame.depth, DEPTH[k], atol=6e-4)
        expected = np.array([7, 4, 5], np.uint8)[made_phones.CONFIDENCE[k]]
        np.testing.assert_array_equal(frame.confidence_image, expected)
