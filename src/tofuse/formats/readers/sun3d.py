"""Reader of SUN3D (Xiao et al. 2013)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64, UInt16
from tofuse.engine.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading, tables
from tofuse.formats.images import first_size, read_image
from tofuse.formats.readers import redwood
from tofuse.formats.sources import DepthImageSource, Reader, ReaderOptions, Sniff, inputs

_LENS = "intrinsics.txt"
_BITS = 3


@part("reader", "sun3d", label="experimental")
class Sun3D(Reader):
    """SUN3D: folders with depth/, image/, intrinsics.txt and maybe extrinsics/."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        folders = all(reading.is_folder(path / name) for name in ("depth", "image"))
        if folders and reading.is_file(path / _LENS):
            return Sniff(1.0, f"depth/, image/ and {_LENS}")
        return None

    def open(self, path: Path, options: ReaderOptions) -> DepthImageSource:
        """See `Reader.open`."""
        files = inputs.depth_images(path / "depth")
        nothing = InputError("has no images", where=path / "depth")
        _check_rotated(reading.first_readable(files, _read, nothing), path / "depth")
        warnings: list[str] = []
        times = redwood.timestamps(files)
        color = redwood.color_files(path, files, times, warnings)
        source = Sun3DSource(
            files,
            np.arange(len(files), dtype=float) if times is None else times,
            None if options.camera is not None else _lens(path / _LENS, first_size(files)),
            color=color,
            sensor=redwood.SENSOR if first_size(files) == redwood.SIZE else "",
            options=options,
        )
        source.warnings += warnings
        source.reference = _reference(path, color or [], source.warnings)
        return source


class Sun3DSource(DepthImageSource):
    """Depth whose bits are rotated."""

    def read_counts(self, index: int, size: tuple[int, int]) -> UInt16:
        """See `DepthImageSource.read_counts`."""
        stored = super().read_counts(index, size)
        return ((stored >> _BITS) | (stored << (16 - _BITS))).astype(np.uint16)


def _read(path: Path) -> UInt16:
    return read_image(path, dtype="uint16")


def _lens(path: Path, size: tuple[int, int]) -> Pinhole:
    return camera_file.checked_pinhole(tables.read_3x3(path, "download it again"), size, path)


def _check_rotated(stored: UInt16, folder: Path) -> None:
    """Refuse depth that isn't rotated to the left: of less than 8 m, its lowest bits are 0."""
    valid = stored[stored > 0]
    if np.count_nonzero(valid & ((1 << _BITS) - 1)) > len(valid) / 2:
        raise InputError(
            "has depth whose bits are not rotated as in SUN3D",
            where=folder,
            remedy="use --format redwood and --camera camera.json, with its depth_unit_m",
        )


def _reference(path: Path, color: list[Path | None], warnings: list[str]) -> Float64 | None:
    """The poses (N, 4, 4) of the colour images in the latest file, three rows for each."""
    files = inputs.files_at(path / "extrinsics", ".txt")
    if not files or not color:
        return None
    images = redwood.color_images(path / "image")
    try:
        table = tables.read_numbers(files[-1])
        if table.shape != (3 * len(images), 4):
            raise InputError(
                f"has {len(table)} rows of {table.shape[-1]} numbers, not 3 rows of 4 for each of "
                f"{quantities.count(len(images), 'image')}",
                where=files[-1],
            )
    except InputError as error:
        warnings.append(f"{error}: poses are left out")
        return None
    row: dict[Path | None, int] = {image: 3 * k for k, image in enumerate(images)}
    poses = np.full((len(color), 4, 4), np.nan)
    for k, image in enumerate(color):
        if image in row:
            pose = np.vstack([table[row[image] : row[image] + 3], [0, 0, 0, 1]])
            poses[k] = inputs.read_matrix_pose(pose, f"{files[-1]}, row {row[image] + 1}")
    return poses
