"""`--camera`: every reader either uses all of it, or rejects it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import made_arrays
import made_dumps
import made_exports
import made_ifm
import made_kinect
import made_phones
import made_sens
import made_tof
from damaged_files import make_native, make_pcd, make_ply, make_slam6d, make_xyz
from made_recordings import make_7scenes, make_redwood, make_sr4000, make_tum
from ros_bags import COUNTS, TOPIC, Bag, orbbec, real_sense
from tofuse.engine.cameras.cameras import BrownConrady, Pinhole, RayTable
from tofuse.engine.errors import InputError
from tofuse.formats.recordings.open import open_recording, readers


def inside(make: Callable[[Path], object], name: str = "a") -> Callable[[Path], Path]:
    def made(folder: Path) -> Path:
        make(folder / name)
        return folder / name

    return made


def ros_counts(folder: Path) -> Path:
    bag = Bag(folder, "ros2")
    bag.info("/camera/depth/camera_info")
    bag.image(TOPIC, 10, COUNTS[0], "16UC1")
    return bag.close()


def ros_metres(folder: Path) -> Path:
    bag = Bag(folder, "mcap")
    bag.info("/camera/depth/camera_info")
    bag.image(TOPIC, 10, (COUNTS[0] % 5000 / 1000).astype(np.float32), "32FC1")
    return bag.close()


def npz_metres(folder: Path) -> Path:
    depth = made_arrays.COUNTS % 5000 / 1000
    np.savez(folder / "a.npz", **made_arrays.arrays(depth=depth, depth_unit_m=None))
    return folder / "a.npz"


def own_lenses(folder: Path) -> Path:
    """A native folder in which each frame has its own lens or rays."""
    make_native(folder / "a")
    (folder / "a" / "frames.csv").write_text("fx,fy,cx,cy\n" + "35,35,19.5,14.5\n" * 3)
    (folder / "a" / "correction.npz").unlink()
    (folder / "a" / "rays").mkdir()
    for k in range(3):
        np.save(folder / "a" / "rays" / f"{k:06d}.npy", Pinhole(40, 30, 35, 35, 19.5, 14.5).rays())
    return folder / "a"


# How a recording is made, and whether its depth is counts (True) or metres.
TAKES: dict[str, tuple[str, Callable[[Path], Path], bool]] = {
    "native": ("native", own_lenses, True),
    "tum": ("tum", inside(make_tum, "freiburg1"), True),
    "7scenes": ("7scenes", inside(make_7scenes), True),
    "redwood": ("redwood", inside(make_redwood), True),
    "azure-kinect": ("azure-kinect", inside(made_kinect.make_small_mkv, "a.mkv"), True),
    "zense": ("zense", inside(made_arrays.make_zense), True),
    "sens": ("sens", inside(made_sens.make_sens, "a.sens"), True),
    "npz": ("npz", inside(made_arrays.make_npz, "a.npz"), True),
    "npz-metres": ("npz", npz_metres, False),
    "realsense-bag": (
        "realsense-bag",
        lambda folder: real_sense(folder, "ros1", "None", name="Intel RealSense L515"),
        True,
    ),
    "orbbec-bag": ("orbbec-bag", lambda folder: orbbec(folder, (0.0,) * 8), True),
    "kinect2": ("kinect2", inside(made_dumps.make_kinect2), True),
    "depth16": ("depth16", inside(made_dumps.make_depth16), True),
    "arducam": ("arducam", inside(made_tof.make_arducam), True),
    "aditof": ("aditof", inside(made_tof.make_aditof, "a.bin"), True),
    "ros": ("ros", ros_counts, True),
    "ros-metres": ("ros", ros_metres, False),
}


def empty(folder: Path) -> Path:
    (folder / "a").write_bytes(b"")
    return folder / "a"


REFUSES: dict[str, Callable[[Path], Path]] = {
    "sr4000": inside(make_sr4000),
    "3dscannerapp": inside(made_phones.make_scanner_app),
    "stray": inside(made_phones.make_stray),
    "record3d": inside(made_phones.make_record3d),
    "polycam": inside(made_dumps.make_polycam),
    "nerfstudio": inside(made_dumps.make_nerfstudio),
    "hololens2": inside(made_dumps.make_hololens),
    "ifm-h5": empty,
    "ifm-o3r": inside(made_ifm.make_o3r, "a.data"),
    "pcd": inside(make_pcd),
    "ply": inside(make_ply),
    "xyz": inside(make_xyz),
    "slam6d": inside(make_slam6d),
    "grid": inside(made_exports.make_helios),
    "las": empty,
    "e57": empty,
}


def camera_file(
    folder: Path, size: tuple[int, int], unit: float, kind: str
) -> tuple[Path, BrownConrady]:
    lens = BrownConrady(
        *size, 1.1 * size[0], 1.2 * size[0], size[0] / 2, size[1] / 2, k1=0.05, p2=0.001
    )
    fields = {"schema": 1, "model": "brown", "width": size[0], "height": size[1]}
    fields |= {name: getattr(lens, name) for name in ("fx", "fy", "cx", "cy")}
    fields |= {"distortion": [0.05, 0, 0, 0.001], "depth_unit_m": unit, "depth_kind": kind}
    folder.mkdir()
    (folder / "camera.json").write_text(json.dumps(fields))
    return folder / "camera.json", lens


def test_every_reader_is_covered() -> None:
    # TIFF images have no camera but the given one: see test_recordings_exports.py.
    # Nor does a single PNG: see test_cli_register.py.
    here = {name for name, _, _ in TAKES.values()} | set(REFUSES) | {"tiff", "depth-png"}
    assert here == set(readers())


@pytest.mark.parametrize("case", TAKES)
def test_lens_unit_and_kind_are_used(tmp_path: Path, case: str) -> None:
    name, make, counted = TAKES[case]
    path = make(tmp_path)
    own = open_recording(path, format=name)[0]
    size = (own.camera.width, own.camera.height)
    other = "z" if own.depth_kind == "range" else "range"
    file, lens = camera_file(tmp_path / "given", size, 0.003, other)
    recording = open_recording(path, format=name, camera=file)
    frame = recording[0]
    assert frame.camera == lens
    assert frame.depth_kind == recording.metadata["depth_kind"] == other
    scale = 1.0  # metres are not scaled
    if counted:
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


@pytest.mark.parametrize("case", ["sens", "npz", "azure-kinect", "realsense-bag", "tum"])
def test_ray_table_is_used_and_other_size_refused(tmp_path: Path, case: str) -> None:
    name, make, _ = TAKES[case]
    path = make(tmp_path)
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
    (tmp_path / "b").mkdir()
    with pytest.raises(InputError, match=r"--camera: does not apply to the format .*leave it out"):
        open_recording(REFUSES[name](tmp_path / "b"), format=name, camera=file)
