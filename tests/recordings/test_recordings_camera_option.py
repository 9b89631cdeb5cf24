"""`--camera`: every reader either uses all of it, or rejects it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import made_arrays
from camera_files import EVERY, made
from refused import refused
from ros_bags import COUNTS, TOPIC, Bag
from tofuse.engine.cameras.cameras import BrownConrady, Pinhole, RayTable
from tofuse.engine.errors import InputError
from tofuse.formats.recordings.open import open_recording
from written import camera_json


def npz_metres(path: Path) -> Path:
    depth = made_arrays.COUNTS % 5000 / 1000
    np.savez(path, **made_arrays.arrays(depth=depth, depth_unit_m=None))
    return path


def ros_metres(path: Path) -> Path:
    bag = Bag(path.parent, "mcap")
    bag.info("/camera/depth/camera_info")
    bag.image(TOPIC, 10, (COUNTS[0] % 5000 / 1000).astype(np.float32), "32FC1")
    return bag.close()


# Recordings whose depth is in metres, not counts.
METRES: dict[str, tuple[str, str, Callable[[Path], Path]]] = {
    "npz-metres": ("a.npz", "npz", npz_metres),
    "ros-metres": ("a", "ros", ros_metres),
}
TAKES = ["native", "tum", "7scenes", "redwood", "mkv", "zense", "sens", "npz", "realsense"]
TAKES += ["orbbec", "kinect2", "depth16", "arducam", "aditof", "mcap", "scannet"]
TAKES += ["sun3d", "replica", "pairs"]
REFUSES = [name for name in EVERY if name not in TAKES]


def recorded(case: str, folder: Path) -> tuple[Path, str]:
    """The path of a recording, and its format."""
    if case in METRES:
        name, format_, make = METRES[case]
        return make(folder / name), format_
    path, format_ = made(case, folder)
    if case == "native":  # each frame has its own lens or rays
        (folder / path / "frames.csv").write_text("fx,fy,cx,cy\n" + "35,35,19.5,14.5\n" * 3)
        (folder / path / "correction.npz").unlink()
        (folder / path / "rays").mkdir()
        for k in range(3):
            rays = Pinhole(40, 30, 35, 35, 19.5, 14.5).rays()
            np.save(folder / path / "rays" / f"{k:06d}.npy", rays)
    return folder / path, format_


def camera_file(
    folder: Path, size: tuple[int, int], unit: float, kind: str
) -> tuple[Path, BrownConrady]:
    center = (size[0] / 2, size[1] / 2)
    lens = BrownConrady(*size, 1.1 * size[0], 1.2 * size[0], *center, k1=0.05, p2=0.001)
    bent = {"model": "brown", "distortion": [0.05, 0, 0, 0.001]}
    folder.mkdir()
    path = folder / "camera.json"
    return camera_json(path, lens, **bent, depth_unit_m=unit, depth_kind=kind), lens


@pytest.mark.parametrize("case", [*TAKES, *METRES])
def test_lens_unit_and_kind_are_used(tmp_path: Path, case: str) -> None:
    path, name = recorded(case, tmp_path)
    own = open_recording(path, format=name)[0]
    size = (own.camera.width, own.camera.height)
    other = "z" if own.depth_kind == "range" else "range"
    file, lens = camera_file(tmp_path / "given", size, 0.003, other)
    recording = open_recording(path, format=name, camera=file)
    frame = recording[0]
    assert frame.camera == lens
    assert frame.depth_kind == recording.metadata["depth_kind"] == other
    scale = 1.0  # metres are not scaled
    if case not in METRES:
        unit = open_recording(path, format=name).metadata.get("depth_unit_m")
        # Depth in mm that is not integer has no unit.
        assert recording.metadata.get("depth_unit_m") == (None if unit is None else 0.003)
        scale = 0.003 / (0.001 if unit is None else unit)
        assert scale > 1.5
    np.testing.assert_allclose(frame.depth, own.depth * scale, rtol=1e-5)
    # Points are along the given rays, at distances of the given kind.
    lengths = np.linalg.norm(frame.points, axis=1) if other == "range" else frame.points[:, 2]
    np.testing.assert_allclose(lengths, frame.depth[frame.valid], rtol=1e-4)
    assert (frame.color_image is None) == (own.color_image is None)
    assert (frame.amplitude_image is None) == (own.amplitude_image is None)


@pytest.mark.parametrize("case", ["sens", "npz", "mkv", "realsense", "tum"])
def test_ray_table_is_used_and_other_size_refused(tmp_path: Path, case: str) -> None:
    path, name = recorded(case, tmp_path)
    own = open_recording(path, format=name)[0]
    size = (own.camera.width, own.camera.height)
    file, _ = camera_file(tmp_path / "given", size, 0.001, "z")
    np.save(file.with_name("rays.npy"), own.camera.rays() * 1.5)
    frame = open_recording(path, format=name, camera=file)[0]
    assert isinstance(frame.camera, RayTable)
    np.testing.assert_allclose(frame.camera.rays(), own.camera.rays() * 1.5, rtol=1e-5)
    small, _ = camera_file(tmp_path / "small", (8, 6), 0.001, "z")
    with pytest.raises(InputError, match=r"8 x 6") as found:
        open_recording(path, format=name, camera=small)
    assert len(str(found.value).splitlines()) == 1


@pytest.mark.parametrize("name", REFUSES)
def test_camera_is_refused_where_not_applicable(tmp_path: Path, name: str) -> None:
    file, _ = camera_file(tmp_path / "given", (16, 12), 0.001, "z")
    path, format_ = made(name, tmp_path)
    refused(
        r"camera: does not apply to the format .*leave it out",
        tmp_path / path,
        format=format_,
        camera=file,
    )
