"""Small recordings in manufacturers' formats, and a full read of one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import damaged_files
import made_arrays
import made_datasets
import made_dumps
import made_exports
import made_ifm
import made_kinect
import made_phones
import made_recordings
import made_sens
import made_tof
import ros_bags
from tofuse.engine.errors import TofuseError
from tofuse.engine.frames.frames import Frame
from tofuse.formats.recordings.open import open_recording

# Function that writes a recording, name of its file (None: a folder), and its format.
MAKERS: dict[str, tuple[Callable[[Path], object], str | None, str]] = {
    "3dscannerapp": (made_phones.make_scanner_app, None, "3dscannerapp"),
    "stray": (made_phones.make_stray, None, "stray"),
    "arkitscenes": (made_phones.make_arkitscenes, None, "arkitscenes"),
    "record3d": (made_phones.make_record3d, None, "record3d"),
    "mkv": (made_kinect.make_small_mkv, "a.mkv", "azure-kinect"),
    "o3r": (made_ifm.make_o3r, "a.data", "ifm-o3r"),
    "npz": (made_arrays.make_npz, "a.npz", "npz"),
    "sens": (made_sens.make_sens, "a.sens", "sens"),
    "scannet": (made_sens.make_scannet, None, "scannet"),
    "zense": (made_arrays.make_zense, None, "zense"),
    "helios": (made_exports.make_helios, None, "grid"),
    "csv": (made_exports.make_csv, None, "grid"),
    "r3d": (made_phones.make_r3d, "scan.r3d", "record3d"),
    "polycam": (made_dumps.make_polycam, None, "polycam"),
    "nerfstudio": (made_dumps.make_nerfstudio, None, "nerfstudio"),
    "nerfcapture": (made_dumps.make_nerfcapture, None, "nerfstudio"),
    "hololens2": (made_dumps.make_hololens, None, "hololens2"),
    "kinect2": (made_dumps.make_kinect2, None, "kinect2"),
    "depth16": (made_dumps.make_depth16, None, "depth16"),
    "arducam": (made_tof.make_arducam, None, "arducam"),
    "aditof": (made_tof.make_aditof, "a.bin", "aditof"),
}


def make_mcap(path: Path) -> None:
    bag = ros_bags.Bag(path.parent, "mcap")
    bag.info("/camera/depth/camera_info")
    for k in range(3):
        bag.image(ros_bags.TOPIC, 10 + k, ros_bags.COUNTS[k], "16UC1")
    bag.close()


def make_realsense(path: Path) -> None:
    ros_bags.real_sense(path.parent, "ros1", "None", name="Intel RealSense L515", color="yuyv")


def make_orbbec(path: Path) -> None:
    ros_bags.orbbec(path.parent, (0.0,) * 8, color="jpeg", R=ros_bags.T_COLOR[:3, :3])


# The same of formats with clouds, with a camera by name or in the recording, and of bags.
OTHERS: dict[str, tuple[Callable[[Path], object], str | None, str]] = {
    "native": (damaged_files.make_native, None, "native"),
    "sr4000": (made_recordings.make_sr4000, None, "sr4000"),
    "tum": (made_recordings.make_tum, None, "tum"),
    "7scenes": (made_recordings.make_7scenes, None, "7scenes"),
    "redwood": (made_recordings.make_redwood, None, "redwood"),
    "sun3d": (made_datasets.make_sun3d, None, "sun3d"),
    "replica": (made_datasets.make_replica, None, "replica"),
    "pairs": (made_datasets.make_pairs, None, "pairs"),
    "bop": (made_datasets.make_bop, None, "bop"),
    "pcd": (damaged_files.make_pcd, None, "pcd"),
    "ply": (damaged_files.make_ply, None, "ply"),
    "xyz": (damaged_files.make_xyz, None, "xyz"),
    "slam6d": (damaged_files.make_slam6d, None, "slam6d"),
    "ptx": (damaged_files.make_ptx, None, "ptx"),
    "h5": (made_ifm.make_h5, "a.h5", "ifm-h5"),
    "mcap": (make_mcap, "a", "ros"),
    "realsense": (make_realsense, "a.bag", "realsense-bag"),
    "orbbec": (make_orbbec, "a.bag", "orbbec-bag"),
}


@dataclass
class Read:
    """The readable frames of a recording, the number of others, and whether it was refused."""

    frames: list[Frame] = field(default_factory=list)
    unread: int = 0
    refused: bool = False
    warnings: list[str] = field(default_factory=list)


def read_frames(path: Path, format_: str | None, camera: Path | None = None) -> Read:
    """Read every frame; errors must have one line and a place."""
    read = Read()
    errors: list[TofuseError] = []
    try:
        recording = open_recording(path, format=format_, camera=camera)
        for item in recording.read_all():
            if isinstance(item, TofuseError):
                read.unread += 1
                errors.append(item)
            else:
                assert np.isfinite(item.points).all()
                read.frames.append(item)
        read.warnings = list(recording.warnings)
    except TofuseError as error:
        read.refused = True
        errors.append(error)
    assert all(len(str(error).splitlines()) == 1 and error.where for error in errors)
    return read


EVERY = MAKERS | OTHERS


def made(name: str, folder: Path) -> tuple[Path, str]:
    """Write the recording of a maker into `folder`; return its path there, and its format."""
    make, file, format_ = EVERY[name]
    path = folder / "freiburg1" / (file or ".")
    (folder if file is None else path.parent).mkdir(parents=True, exist_ok=True)
    make(path)
    return path.relative_to(folder), format_
