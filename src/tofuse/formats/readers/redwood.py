"""Reader of RGB-D folders in the layout of Open3D and Redwood (Choi et al. 2015)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading
from tofuse.formats.images import first_size
from tofuse.formats.poses import read_poses
from tofuse.formats.sources import DepthImageSource, Reader, ReaderOptions, Sniff, inputs

# Open3D's PinholeCameraIntrinsicParameters.PrimeSenseDefault.
SENSOR, SIZE = "PrimeSense (structured light)", (640, 480)
PRIMESENSE = Pinhole(*SIZE, 525.0, 525.0, 319.5, 239.5)

_COLOR_FOLDERS = ("color", "image", "rgb")
_MICROSECONDS = re.compile(r"[0-9]+-([0-9]{12})")


@part("reader", "redwood", label="validated")
class Redwood(Reader):
    """Open3D, Redwood: folders with depth/, color/ (image/, rgb/), camera .json, trajectory.log."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        if not reading.is_folder(path / "depth") or reading.is_file(path / "depth.txt"):
            return None
        color = next((n for n in _COLOR_FOLDERS if reading.is_folder(path / n)), None)
        if color is None:
            return None
        camera = _camera_file(path)
        if camera is not None:
            return Sniff(1.0, f"depth/, {color}/ and {camera.name}")
        if reading.is_file(path / "trajectory.log"):
            return Sniff(1.0, f"depth/, {color}/ and trajectory.log")
        if reading.is_file(path / "camera.json"):
            return None
        return Sniff(
            Sniff.UNCERTAIN,
            f"depth/ and {color}/ but no camera",
            "use --format redwood (a PrimeSense camera, millimetres), with --camera for another",
        )

    def open(self, path: Path, options: ReaderOptions) -> DepthImageSource:
        """See `Reader.open`."""
        files = inputs.required(
            reading.files_with(path / "depth", ".png"), ".png files", path / "depth"
        )
        warnings: list[str] = []
        camera: Pinhole | None = None
        if options.camera is None:
            file = _camera_file(path)
            camera = PRIMESENSE if file is None else _read_intrinsics(file)
            if file is None:
                warnings.append(
                    "no camera .json: the PrimeSense default is used (525 px); --camera to change"
                )
        source = DepthImageSource(
            files,
            _timestamps(files),
            camera,
            color=_color_files(path, files, warnings),
            # Open3D's recorders write this format with other cameras.
            sensor=SENSOR if first_size(files) == SIZE else "",
            options=options,
        )
        source.warnings += warnings
        if reading.is_file(path / "trajectory.log"):
            source.reference = _poses(path / "trajectory.log", len(files))
        if reading.is_file(path / "odometry.log"):
            source.odometry = _poses(path / "odometry.log", len(files))
        return source


def _camera_file(path: Path) -> Path | None:
    """The .json with an intrinsic_matrix, if there is one; InputError if several differ."""
    files = [f for f in reading.files_with(path, ".json") if reading.is_file(f)]
    cameras = [f for f in files if "intrinsic_matrix" in reading.read_text(f)]
    if len({reading.read_text(f) for f in cameras}) > 1:
        raise InputError(
            f"has several cameras: {', '.join(f.name for f in cameras)}",
            where=path,
            remedy="keep one of them",
        )
    return cameras[0] if cameras else None


def _read_intrinsics(path: Path) -> Pinhole:
    data = reading.read_json(path)
    remedy = "write it as Open3D does, column by column"
    K = reading.numbers_in(data, "intrinsic_matrix", path, (3, 3), remedy).T
    width, height = (
        reading.number_in(data, name, path, remedy=remedy) for name in ("width", "height")
    )
    return camera_file.checked_pinhole(K, camera_file.image_size(width, height, path), path)


def _timestamps(files: list[Path]) -> Float64:
    """Seconds from names like 000001-000000033369.png (microseconds), else the index."""
    matches = [_MICROSECONDS.fullmatch(f.stem) for f in files]
    times = np.array([int(m.group(1)) / 1e6 for m in matches if m])
    if len(times) == len(files) and (np.diff(times) > 0).all():
        return times
    return np.arange(len(files), dtype=float)


def _color_files(path: Path, files: list[Path], warnings: list[str]) -> list[Path | None] | None:
    folder = next((path / n for n in _COLOR_FOLDERS if reading.is_folder(path / n)), None)
    if folder is None:
        return None
    color = reading.files_with(folder, ".png", ".jpg", ".jpeg")
    if len(color) == len(files):
        return list(color)
    numbered = {number: file for file in color if (number := _number(file)) is not None}
    matches = [numbered.get(number) if (number := _number(f)) is not None else None for f in files]
    if any(matches):
        return matches
    warnings.append(
        f"{folder.name}/ has {len(color)} images, depth/ {len(files)}, and their names don't show "
        "which belong together: colour is ignored"
    )
    return None


def _number(path: Path) -> int | None:
    """Number of an image: the prefix of its name."""
    first = path.stem.split("-")[0]
    return int(first) if first.isdecimal() and len(first) <= 18 else None


def _poses(path: Path, count: int) -> Float64:
    """Read a trajectory.log: (count, 4, 4), NaN for frames that it omits."""
    trajectory = read_poses(path)
    if trajectory.frames is None:
        raise InputError(
            "has timestamps instead of frame numbers", where=path, remedy="pass a .log"
        )
    if (trajectory.frames >= count).any():
        raise InputError(
            f"has a pose of frame {trajectory.frames.max()} of {count}",
            where=path,
            remedy="check the counts",
        )
    out = np.full((count, 4, 4), np.nan)
    out[trajectory.frames] = trajectory.poses
    return out
