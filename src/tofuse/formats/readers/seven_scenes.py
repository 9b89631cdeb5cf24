"""Reader of Microsoft's 7-Scenes (Shotton et al. 2013)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading, tables
from tofuse.formats.images import first_size
from tofuse.formats.sources import DepthImageSource, Reader, ReaderOptions, Sniff, inputs

FRAME_RATE_HZ = 30.0
SENSOR, SIZE = "Kinect v1 (structured light)", (640, 480)
DEFAULT_CAMERA = Pinhole(*SIZE, 585.0, 585.0, 320.0, 240.0)

_DEPTH = re.compile(r"frame-([0-9]{1,9})\.depth\.png", re.IGNORECASE)


@part("reader", "7scenes", label="validated")
class SevenScenes(Reader):
    """7-Scenes: folders of frame-NNNNNN.depth.png, .pose.txt and .color.png or .jpg."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        files = _depth_files(path)
        return Sniff(1.0, f"{len(files)} frame-*.depth.png") if files else None

    def open(self, path: Path, options: ReaderOptions) -> DepthImageSource:
        """See `Reader.open`."""
        numbered = inputs.required(_depth_files(path), "frame-*.depth.png", path)
        numbers = np.array([number for number, _ in numbered])
        files = [file for _, file in numbered]
        color = [image for file in files if (image := _color(file)) is not None]
        complete = len(color) == len(files)
        source = DepthImageSource(
            files,
            numbers / FRAME_RATE_HZ,
            None if options.camera else _camera(path, files),
            color=color if complete else None,
            color_registered=False,
            # Other programs write this format too, with other cameras.
            sensor=SENSOR if first_size(files) == SIZE else "",
            options=options,
        )
        if color and not complete:
            source.warnings.append(
                f"only {len(color)} of {len(files)} frames have colour: colour is ignored"
            )
        elif color:
            source.warnings.append("colour is not registered to depth in 7-Scenes: used unchanged")
        stems = [file.name[: -len(".depth.png")] for file in files]
        source.reference = inputs.poses_from_files(
            source, [path / f"{stem}.pose.txt" for stem in stems], read_pose
        )
        source.metadata["frame_rate_hz"] = FRAME_RATE_HZ
        return source


def read_pose(path: Path) -> Float64:
    """Return T_world_camera (4, 4) of a .pose.txt; NaN if tracking was lost."""
    return inputs.read_matrix_pose(tables.read_numbers(path), str(path))


def _depth_files(path: Path) -> list[tuple[int, Path]]:
    return sorted(
        (int(p.name[6:].split(".")[0]), p) for p in reading.files_named(path, _DEPTH.fullmatch)
    )


def _color(file: Path) -> Path | None:
    stem = file.name[: -len(".depth.png")]
    return reading.first_file(*(file.with_name(f"{stem}.color.{s}") for s in ("png", "jpg")))


def _camera(folder: Path, files: Sequence[Path]) -> Pinhole:
    path = folder / "camera-intrinsics.txt"
    if not reading.is_file(path):
        return DEFAULT_CAMERA
    K = tables.read_numbers(path)
    if K.shape != (3, 3):
        raise InputError("is not a 3x3 matrix", where=path, remedy="write three rows of three")
    return camera_file.checked_pinhole(K, first_size(files), path)
