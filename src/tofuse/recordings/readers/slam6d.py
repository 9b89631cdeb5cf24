"""Reader of 3DTK / slam6D scans (Nuechter et al. 2007)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.files.reading import read_text
from tofuse.files.tables import parse_numbers, read_numbers
from tofuse.parts import part
from tofuse.recordings.cloud_files import CloudFileSource, required_files, sniff_clouds
from tofuse.recordings.frames import CloudFrame
from tofuse.recordings.reader import Reader, ReaderOptions, Sniff, refuse_camera
from tofuse.recordings.sources import cloud_frame, poses_from_files

# x right, y up, z forward, left-handed, cm; negating y gives the camera's convention.
FLIP = np.diag([1.0, -1.0, 1.0])
CENTIMETRE = 0.01


@part("reader", "slam6d", label="validated")
@dataclass(frozen=True)
class Slam6d(Reader):
    """3DTK, slam6D: a folder of scanNNN.3d with scanNNN.pose."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        return sniff_clouds(path, ".3d")

    def open(self, path: Path, options: ReaderOptions) -> CloudFileSource:
        """See `Reader.open`."""
        refuse_camera(options, "slam6d")
        files = required_files(path, ".3d")
        source = CloudFileSource(path, files, scan_frame)
        poses = poses_from_files(source, [file.with_suffix(".pose") for file in files], read_pose)
        if poses is not None:
            source.odometry = poses
            if source.reference is None:
                source.reference = poses
                source.warnings.append(
                    "the .pose files are the robot's odometry: a reference, but not ground truth"
                )
        return source


def scan_frame(path: Path, index: int, timestamp: float) -> CloudFrame:
    """Read one scan: lines of x y z [reflectance ...], optionally after a line with their count."""
    text = read_text(path)
    first = text.split("\n", 1)[0].split()
    table = parse_numbers(text, path, skip=int(len(first) == 1))
    if table.shape[1] < 3:
        raise InputError(f"has {table.shape[1]} numbers per line", where=path)
    with np.errstate(over="ignore"):
        points = (table[:, :3] * np.diag(FLIP) * CENTIMETRE).astype(np.float32)
    # The scanner writes (0, 0, 0) for missing measurements.
    points[(points == 0).all(1)] = np.nan
    amplitude = table[:, 3].astype(np.float32) if table.shape[1] == 4 else None
    return cloud_frame(index, timestamp, points, amplitude=amplitude)


def read_pose(path: Path) -> Float64:
    """Return T_world_scan (4, 4) of a .pose: cm and Euler angles in degrees, left-handed."""
    numbers = read_numbers(path).ravel()
    if len(numbers) != 6 or not np.isfinite(numbers).all():
        raise InputError(
            f"has {len(numbers)} numbers", where=path, remedy="write x y z and three angles"
        )
    (sx, sy, sz), (cx, cy, cz) = np.sin(np.radians(numbers[3:])), np.cos(np.radians(numbers[3:]))
    # Rx Ry Rz, as EulerToMatrix4 of 3DTK.
    R = np.array(
        [
            [cy * cz, -cy * sz, sy],
            [sx * sy * cz + cx * sz, -sx * sy * sz + cx * cz, -sx * cy],
            [-cx * sy * cz + sx * sz, cx * sy * sz + sx * cz, cx * cy],
        ]
    )
    T = np.eye(4)
    T[:3, :3] = FLIP @ R @ FLIP
    T[:3, 3] = FLIP @ numbers[:3] * CENTIMETRE
    return T
