"""Reader of Polycam's raw data (iPhone and iPad with LiDAR)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tofuse.engine.arrays import Float64, UInt8
from tofuse.engine.cameras import Pinhole
from tofuse.engine.frames import POSES_BY
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading
from tofuse.formats.images import first_size
from tofuse.formats.sources import Reader, ReaderOptions, Sniff, inputs, phones

_POSE = [f"t_{row}{column}" for row in range(3) for column in range(4)]
_CORRECTED = "corrected_cameras"
_LEVELS = 255.0  # the confidences low, medium and high are stored as 0, 127 and 255


@part("reader", "polycam", label="experimental")
class Polycam(Reader):
    """Polycam, "raw data": folders with keyframes/, in it depth/, images/ and cameras/."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        folder = _keyframes(path)
        cameras = _lens_folder(folder)
        if reading.is_folder(folder / "depth") and reading.is_folder(cameras):
            return Sniff(1.0, f"{folder.name}/ with depth/ and {cameras.name}/")
        return None

    def open(self, path: Path, options: ReaderOptions) -> phones.PhoneSource:
        """See `Reader.open`."""
        inputs.refuse_camera(options, "polycam", inputs.PER_FRAME)
        return PolycamSource(_keyframes(path))


class PolycamSource(phones.PhoneSource):
    """Frames with ARKit's intrinsics, and the poses optimised by Polycam, or else ARKit's."""

    def __init__(self, folder: Path) -> None:
        files = inputs.files_at(folder / "depth", ".png")
        inputs.required(files, ".png files", folder / "depth", "export 'raw data' again")
        size = first_size(files)
        super().__init__(
            files,
            _times(files),
            confidence=[
                reading.if_file(folder / "confidence" / f"{file.stem}.png") for file in files
            ],
            color=[reading.if_file(folder / "images" / f"{file.stem}.jpg") for file in files],
        )
        self._read_lenses(folder, size)
        self._read_poses(folder)

    def _read_lenses(self, folder: Path, size: tuple[int, int]) -> None:
        """Read ARKit's lenses, or those of the corrected images: warn that these are others."""
        lenses = _lens_folder(folder)
        if lenses.name == _CORRECTED:
            self.warnings.append(
                f"cameras/ is missing: the lenses are those of {_CORRECTED}/, which differ "
                "slightly from those of depth: export 'raw data' again"
            )
        if not any(self.color) and reading.is_folder(folder / "corrected_images"):
            self.warnings.append(
                "images/ is missing: colour is left out, as corrected_images/ show another view"
            )
        paths = [lenses / f"{file.stem}.json" for file in self.files]
        self.cameras = inputs.cameras_of(
            [reading.if_file(path) or path for path in paths],
            lambda path: _lens(reading.read_json(path), size, path),
        )

    def _read_poses(self, folder: Path) -> None:
        """Read Polycam's optimised poses, else ARKit's; never a mix, as they differ too much."""
        paths = [folder / _CORRECTED / f"{file.stem}.json" for file in self.files]
        if any(reading.if_file(path) for path in paths):
            self.metadata[POSES_BY] = "Polycam"
        else:
            paths = [folder / "cameras" / path.name for path in paths]
        self.reference = inputs.poses_from_files(
            self, paths, lambda path: _pose(reading.read_json(path), path)
        )

    def read_confidence(self, path: Path, size: tuple[int, int]) -> UInt8:
        """See `PhoneSource.read_confidence`."""
        stored = super().read_confidence(path, size)
        return np.round(stored * (phones.CONFIDENCE_MAX / _LEVELS)).astype(np.uint8)


def _keyframes(path: Path) -> Path:
    return path / "keyframes" if reading.is_folder(path / "keyframes") else path


def _lens_folder(folder: Path) -> Path:
    """The folder of ARKit's cameras, or else of those that Polycam optimised."""
    own, corrected = folder / "cameras", folder / _CORRECTED
    return corrected if reading.is_folder(corrected) and not reading.is_folder(own) else own


def _times(files: list[Path]) -> Float64:
    """Timestamps (N,) in s of files named by microseconds; else the indices."""
    if all(file.stem.isdecimal() and len(file.stem) <= 18 for file in files):
        return np.array([int(file.stem) for file in files], float) * 1e-6
    return np.arange(len(files), dtype=float)


def _lens(metadata: dict[str, Any], size: tuple[int, int], path: Path) -> Pinhole:
    fx, fy, cx, cy, width, height = _numbers(
        metadata, ("fx", "fy", "cx", "cy", "width", "height"), path
    )
    K = camera_file.intrinsic_matrix(fx, fy, cx, cy)
    return phones.phone_lens(K, camera_file.image_size(width, height, f"{path}: width"), size, path)


def _pose(metadata: dict[str, Any], path: Path) -> Float64:
    table = np.eye(4)
    table[:3] = np.reshape(_numbers(metadata, _POSE, path), (3, 4))
    return phones.arkit_pose(table, str(path))


def _numbers(metadata: dict[str, Any], names: tuple[str, ...] | list[str], path: Path) -> Float64:
    return np.array(
        [reading.number_in(metadata, n, path, remedy="export 'raw data' again") for n in names]
    )
