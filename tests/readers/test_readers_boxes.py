"""Readers of data sets on views of a box: unit, lens, and direction and axes of the poses."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import made_datasets as made
from refused import refused
from tofuse.engine.errors import UnreadableFrameError
from tofuse.engine.frames.recording import Recording
from tofuse.formats.images.images import read_image, write_png
from tofuse.formats.recordings.open import open_recording


def check(recording: Recording) -> None:
    """All points are on the sides of the box, and colour is that of the frame."""
    poses = made.POSES if recording.reference is None else recording.reference
    for k, (frame, T) in enumerate(zip(recording, poses, strict=True)):
        assert frame.camera == made.CAMERA
        assert frame.valid.all()
        world = frame.points @ T[:3, :3].T + T[:3, 3]
        distance = np.abs(np.abs(world) - made.SIDES).min(1)
        assert distance.max() < 2e-3  # depth is rounded to 1 mm
        np.testing.assert_array_equal(frame.color_image, made.color(k))
        assert frame.color_registered


@pytest.mark.parametrize("make", [made.make_sun3d, made.make_bop, made.make_replica])
def test_points_are_on_the_box_by_the_poses(tmp_path: Path, make: Callable[[Path], None]) -> None:
    make(tmp_path / "scan1")
    recording = open_recording(tmp_path / "scan1")
    np.testing.assert_allclose(recording.reference, made.POSES, atol=1e-6)
    check(recording)
    assert recording.has_timestamps == (make is made.make_sun3d)


def test_bop_without_poses_and_with_another_unit(tmp_path: Path) -> None:
    """Poses are optional, and units differ from image to image."""
    made.make_bop(tmp_path)
    file = tmp_path / "scene_camera.json"
    cameras = json.loads(file.read_text())
    depth = open_recording(tmp_path)[1].depth
    for entry in cameras.values():
        del entry["cam_R_w2c"]
    cameras["3"]["depth_scale"] = 1.0
    cameras["6"]["depth_scale"] = 0
    del cameras["0"]
    file.write_text(json.dumps(cameras))
    recording = open_recording(tmp_path)
    assert recording.reference is None
    np.testing.assert_allclose(recording[1].depth, 10 * depth, rtol=1e-6)
    for k, problem in ((0, "image 0: is missing"), (2, "image 6: depth_scale: is 0")):
        with pytest.raises(UnreadableFrameError, match=problem):
            recording[k]


def test_sun3d_far_depth(tmp_path: Path) -> None:
    """Beyond 8.192 m the rotation moves bits to the other end."""
    made.make_sun3d(tmp_path / "scan1")
    file = sorted((tmp_path / "scan1" / "depth").iterdir())[0]
    stored = read_image(file)
    stored[3, :4] = [(mm << 3) % 65536 | mm >> 13 for mm in (8191, 8192, 12345, 60000)]
    write_png(file, stored)
    frame = open_recording(tmp_path / "scan1")[0]
    np.testing.assert_allclose(frame.depth[3, :4], [8.191, 8.192, 12.345, 60.0], rtol=1e-6)


def test_sun3d_with_plain_millimetres_is_refused(tmp_path: Path) -> None:
    made.make_sun3d(tmp_path / "scan1")
    for file in (tmp_path / "scan1" / "depth").iterdir():
        write_png(file, read_image(file) >> 3)
    refused(r"depth: has depth whose bits are not rotated as in SUN3", tmp_path / "scan1")


def test_sun3d_without_usable_poses(tmp_path: Path) -> None:
    made.make_sun3d(tmp_path / "scan1")
    sorted((tmp_path / "scan1" / "image").iterdir())[-1].unlink()
    recording = open_recording(tmp_path / "scan1")
    assert recording.reference is None
    assert "not 3 rows of 4 for each of 5 images: poses are left out" in recording.warnings[0]
    shutil.rmtree(tmp_path / "scan1" / "extrinsics")
    assert open_recording(tmp_path / "scan1").warnings == []


CHANGES = {
    "missing": (r"room0: has no cam_params\.json, nor has the folder above; .* camera", None),
    "size": (r"depth000000\.png: is 64 x 48 pixels, .* 1200 x 48", {"w": 1200}),
    "scale": (r"cam_params\.json: camera: scale: is missing; .* use camera", {"scale": None}),
    "metres": (r"cam_params\.json: scale: is 0\.001, which are no counts", {"scale": 0.001}),
}


@pytest.mark.parametrize("fault", CHANGES)
def test_replica_with_wrong_camera_is_refused(tmp_path: Path, fault: str) -> None:
    says, changes = CHANGES[fault]
    made.make_replica(tmp_path / "room0")
    file = tmp_path / "room0" / "cam_params.json"
    if changes is None:
        file.unlink()
    else:
        about = json.loads(file.read_text())["camera"] | changes
        about = {name: value for name, value in about.items() if value is not None}
        file.write_text(json.dumps({"camera": about}))
    refused(says, tmp_path / "room0")


def test_replica_with_camera_above(tmp_path: Path) -> None:
    made.make_replica(tmp_path / "room0", "../cam_params.json")
    check(open_recording(tmp_path / "room0"))
    lines = (tmp_path / "room0" / "traj.txt").read_text().splitlines()
    (tmp_path / "room0" / "traj.txt").write_text("\n".join(lines[:2]))
    refused(r"traj\.txt: has 2 lines of 16 numbers", tmp_path / "room0")


@pytest.mark.parametrize(
    "names", [("{:05d}-depth.png", "{:05d}-color.png"), ("depth{:06d}.png", "left{:06d}.png")]
)
def test_pairs(tmp_path: Path, names: tuple[str, str]) -> None:
    made.make_pairs(tmp_path / "scene_01", *names)
    check(open_recording(tmp_path / "scene_01"))
    camera = (tmp_path / "scene_01" / "camera.json").rename(tmp_path / "camera.json")
    refused(r"use format pairs with camera=camera\.json, which s", tmp_path / "scene_01")
    refused("neither lens nor unit", tmp_path / "scene_01", format="pairs")
    check(open_recording(tmp_path / "scene_01", format="pairs", camera=camera))
