"""Reader of Microsoft's 7-Scenes (Shotton et al. 2013), and of data sets in its layout."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
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

# Files with the cameras: of 3DMatch, in the folder above; of BundleFusion, 12-Scenes and 3RScan.
_INTRINSICS, _INFO = "camera-intrinsics.txt", ("info.txt", "_info.txt")
_INFO_LENS = "m_calibrationDepthIntrinsic"

_DEPTH = re.compile(r"frame-([0-9]{1,9})\.depth\.(?:png|pgm)", re.IGNORECASE)


@part("reader", "7scenes", label="validated")
class SevenScenes(Reader):
    """7-Scenes, BundleFusion, 3DMatch: frame-NNNNNN.depth.png, .pose.txt, .color.png or .jpg."""

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
        # Other programs write this format too, with other cameras.
        given = _Camera(DEFAULT_CAMERA, SENSOR if first_size(files) == SIZE else "")
        warnings: list[str] = []
        if options.camera is None:
            given = _camera(path, files, given, warnings)
        source = DepthImageSource(
            files,
            numbers / FRAME_RATE_HZ,
            given.lens,
            depth_unit_m=given.unit,
            color=color if complete else None,
            color_registered=False,
            color_camera=given.color,
            sensor=given.sensor,
            options=options,
        )
        source.warnings += warnings
        if color and not complete:
            source.warnings.append(
                f"only {len(color)} of {len(files)} frames have colour: colour is ignored"
            )
        elif color and source.color_camera is None:
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


@dataclass(frozen=True)
class _Camera:
    lens: Pinhole
    sensor: str
    unit: float = 0.001
    color: camera_file.ColorCamera | None = None


def _camera(folder: Path, files: Sequence[Path], default: _Camera, warnings: list[str]) -> _Camera:
    """What the folder, or the one above, states about the cameras."""
    for place in (folder, folder.absolute().parent):
        path = place / _INTRINSICS
        if reading.is_file(path):
            K = tables.read_3x3(path, "write three rows of three")
            return replace(default, lens=camera_file.checked_pinhole(K, first_size(files), path))
        info = reading.first_file(*(place / name for name in _INFO))
        if info is not None and _INFO_LENS.encode() in reading.read_head(info, 4096):
            return _read_info(info, warnings)
    warnings.append(
        f"no {_INTRINSICS} or info.txt: the camera of 7-Scenes is used "
        f"({DEFAULT_CAMERA.fx:.0f} px); pass another by --camera"
    )
    return default


def _read_info(path: Path, warnings: list[str]) -> _Camera:
    """Read the lines "m_depthWidth = 640" and so on of BundleFusion."""
    lines = (line.partition("=") for line in reading.read_text(path).splitlines())
    cells = {name.strip(): value.split() for name, _, value in lines}

    def numbers(name: str, shape: tuple[int, ...]) -> Float64:
        try:
            return np.array(cells[name], float).reshape(shape)
        except (KeyError, ValueError) as error:
            raise InputError(
                "is missing, or not as many numbers", where=f"{path}: {name}", remedy="correct it"
            ) from error

    def lens(name: str) -> Pinhole:
        width, height = (numbers(f"m_{name.lower()}{side}", ()) for side in ("Width", "Height"))
        size = camera_file.image_size(float(width), float(height), f"{path}: m_{name}Width")
        K = numbers(f"m_calibration{name}Intrinsic", (-1, 4))
        return camera_file.checked_pinhole(K, size, path)

    unit = camera_file.depth_unit(float(numbers("m_depthShift", ())), f"{path}: m_depthShift")
    color = None
    if float(numbers("m_colorWidth", ())):
        T_device_color, T_device_depth = (
            numbers(f"m_calibration{name}Extrinsic", (4, 4)) for name in ("Color", "Depth")
        )
        T = inputs.color_from_depth(warnings, T_device_color, T_device_depth, path)
        color = camera_file.ColorCamera(lens("Color"), T)
    return _Camera(lens("Depth"), " ".join(cells.get("m_sensorName", [])), unit, color)
