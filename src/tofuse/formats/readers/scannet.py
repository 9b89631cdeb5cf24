"""Reader of ScanNet's folders (Dai et al. 2017), as its tools export .sens files."""

from __future__ import annotations

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
SENSOR = "StructureSensor"  # as .sens files name it
_SUFFIXES = (".jpg", ".jpeg", ".png")


@part("reader", "scannet", label="experimental")
class ScanNet(Reader):
    """ScanNet, exported: folders with depth/, pose/, intrinsic/ (or intrinsics_*.txt), color/."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        lens = _lens_file(path, "depth")
        if lens is None or not all(reading.is_folder(path / name) for name in ("depth", "pose")):
            return None
        return Sniff(1.0, f"depth/, pose/ and {lens.name}")

    def open(self, path: Path, options: ReaderOptions) -> DepthImageSource:
        """See `Reader.open`."""
        files = inputs.depth_images(path / "depth")
        numbered = all(file.stem.isdecimal() and len(file.stem) <= 9 for file in files)
        numbers = np.array([int(f.stem) for f in files] if numbered else range(len(files)))
        warnings: list[str] = []
        color_camera = _color_camera(path, warnings)
        color = {}
        if color_camera is not None:
            color = {file.stem: file for file in reading.files_with(path / "color", *_SUFFIXES)}
        source = DepthImageSource(
            files,
            numbers / FRAME_RATE_HZ,
            _lens(path, "depth", first_size(files)),
            color=[color.get(file.stem) for file in files] if color else None,
            color_camera=color_camera,
            sensor=SENSOR,
            options=options,
        )
        source.warnings += warnings
        # -inf where tracking was lost.
        source.reference = inputs.poses_from_files(
            source,
            [path / "pose" / f"{file.stem}.txt" for file in files],
            lambda file: inputs.read_matrix_pose(tables.read_numbers(file), str(file)),
        )
        source.metadata["frame_rate_hz"] = FRAME_RATE_HZ
        return source


def _lens_file(path: Path, camera: str) -> Path | None:
    return reading.first_file(
        path / "intrinsic" / f"intrinsic_{camera}.txt", path / f"intrinsics_{camera}.txt"
    )


def _lens(path: Path, camera: str, size: tuple[int, int]) -> Pinhole | None:
    """The lens of the images of a camera, "depth" or "color"; None if there is no file of it."""
    file = _lens_file(path, camera)
    if file is None:
        return None
    return camera_file.checked_pinhole(_matrix(file), size, file)


def _matrix(file: Path) -> Float64:
    matrix = tables.read_numbers(file)
    if matrix.shape not in ((4, 4), (3, 3)):
        raise InputError("is not a 4x4 matrix", where=file, remedy="export it again")
    return matrix


def _color_camera(path: Path, warnings: list[str]) -> camera_file.ColorCamera | None:
    """The camera of the colour images; None, with a warning, if it isn't that of these images."""
    files = inputs.files_at(path / "color", *_SUFFIXES)
    if not files:
        return None
    width, height = first_size(files)
    lens = _lens(path, "color", (width, height))
    if lens is None or not (0.25 < lens.cx / width < 0.75 and 0.25 < lens.cy / height < 0.75):
        problem = "is missing" if lens is None else "is of images of another size"
        warnings.append(f"the lens of color/ {problem}: colour is ignored")
        return None
    poses = [path / "intrinsic" / f"extrinsic_{name}.txt" for name in ("color", "depth")]
    if not all(reading.is_file(file) for file in poses):
        return camera_file.ColorCamera(lens, np.eye(4))
    T_device_color, T_device_depth = (tables.read_numbers(file) for file in poses)
    T = inputs.color_from_depth(warnings, T_device_color, T_device_depth, path / "intrinsic")
    return camera_file.ColorCamera(lens, T)
