"""Reader of RGB-D folders in the layout of Open3D and Redwood (Choi et al. 2015)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.parts import part
from tofuse.engine.times import partners
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading
from tofuse.formats.images import first_size
from tofuse.formats.poses import read_poses
from tofuse.formats.sources import DepthImageSource, Reader, ReaderOptions, Sniff, inputs

# Open3D's PinholeCameraIntrinsicParameters.PrimeSenseDefault.
SENSOR, SIZE = "PrimeSense (structured light)", (640, 480)
PRIMESENSE = Pinhole(*SIZE, 525.0, 525.0, 319.5, 239.5)

_COLOR_FOLDERS = ("color", "image", "rgb")
COLOR_LIMIT_S = 0.05
_MICROSECONDS = re.compile(r"[0-9]+-([0-9]{12})")
_NUMBER = re.compile(r"[^0-9]*([0-9]{1,18})(?:-[0-9]+)?")


@part("reader", "redwood", label="validated")
class Redwood(Reader):
    """Open3D, Redwood: folders with depth/, color/ (image/, rgb/), camera .json, trajectory.log."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        if not reading.is_folder(path / "depth") or reading.is_file(path / "depth.txt"):
            return None
        color = next((n for n in _COLOR_FOLDERS if reading.is_folder(path / n)), None)
        camera = _camera_file(path)
        if color is None and (camera is None or reading.is_file(path / "camera.json")):
            return None
        if camera is not None:
            return Sniff(1.0, f"depth/{'' if color is None else f', {color}/'} and {camera.name}")
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
        files = inputs.depth_images(path / "depth")
        warnings: list[str] = []
        # Open3D's recorders write this format with other cameras.
        camera = _Camera(PRIMESENSE, sensor=SENSOR if first_size(files) == SIZE else "")
        if options.camera is None:
            file = _camera_file(path)
            if file is None:
                warnings.append(
                    "no camera .json: the PrimeSense default is used (525 px); "
                    "pass another by --camera"
                )
            else:
                camera = _read_camera(file, camera.sensor)
        times = timestamps(files)
        source = DepthImageSource(
            files,
            np.arange(len(files)) / camera.rate if times is None else times,
            camera.lens,
            depth_unit_m=camera.unit,
            color=color_files(path, files, times, warnings),
            sensor=camera.sensor,
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
    texts = {f: text for f in reading.files_with(path, ".json") if (text := _camera_text(f))}
    if len(set(texts.values())) > 1:
        raise InputError(
            f"has several cameras: {', '.join(f.name for f in texts)}",
            where=path,
            remedy="keep one of them",
        )
    return next(iter(texts), None)


def _camera_text(file: Path) -> str | None:
    """The text of a .json with an intrinsic_matrix of its own; None for views, or anything else."""
    try:
        text = reading.read_text(file)
    except InputError:
        return None
    named = '"intrinsic_matrix"' in text
    return text if named and "intrinsic_matrix" in reading.parse_json(text, file) else None


@dataclass(frozen=True)
class _Camera:
    """What the camera .json states, and Open3D's defaults."""

    lens: Pinhole
    sensor: str
    unit: float = 0.001
    rate: float = 1.0


def _read_camera(path: Path, sensor: str) -> _Camera:
    data = reading.read_json(path)
    remedy = "write it as Open3D does, column by column"
    K = reading.numbers_in(data, "intrinsic_matrix", path, (3, 3), remedy)
    if K[2, :2].any() or not K[:2, 2].any():  # else it is written row by row
        K = K.T
    width, height = (
        reading.number_in(data, name, path, remedy=remedy) for name in ("width", "height")
    )
    lens = camera_file.checked_pinhole(K, camera_file.image_size(width, height, path), path)
    # Open3D's readers of bags add these; other programs write the matrix alone.
    counts_per_metre = reading.number_in(data, "depth_scale", path, 1000.0)
    unit = camera_file.depth_unit(counts_per_metre, f"{path}: depth_scale")
    rate = reading.number_in(data, "fps", path, 1.0)
    sensor = str(data.get("device_name") or sensor)
    return _Camera(lens, sensor, unit, rate if 0.01 <= rate <= 1e4 else 1.0)


def timestamps(files: list[Path]) -> Float64 | None:
    """Return seconds from names like 000001-000000033369.png (microseconds), else None."""
    matches = [_MICROSECONDS.fullmatch(f.stem) for f in files]
    times = np.array([int(m.group(1)) / 1e6 for m in matches if m])
    return times if len(times) == len(files) and (np.diff(times) > 0).all() else None


def color_files(
    path: Path, files: list[Path], times: Float64 | None, warnings: list[str]
) -> list[Path | None] | None:
    """Return the colour image of each depth image, by time, place, name or number."""
    folder = next((path / n for n in _COLOR_FOLDERS if reading.is_folder(path / n)), None)
    if folder is None:
        return None
    color = color_images(folder)
    color_times = timestamps(color)
    if times is not None and color_times is not None:
        found = partners(times, color_times, COLOR_LIMIT_S)
        matches = [color[k] if k >= 0 else None for k in found]
    else:
        named = {file.stem: file for file in color}
        numbered = {_number(file): file for file in color if _number(file) is not None}
        matches = [named.get(f.stem) or numbered.get(_number(f)) for f in files]
        # Of as many images of another first number, or of names that tell nothing.
        alike = len(color) == len(files)
        if alike and (_numbered_alike(color, files) or matches.count(None) > len(files) // 2):
            return list(color)
    if any(matches):
        return matches
    warnings.append(
        f"{folder.name}/ has {quantities.count(len(color), 'image')}, depth/ {len(files)}, "
        "and their names don't show which belong together: colour is ignored"
    )
    return None


def color_images(folder: Path) -> list[Path]:
    """Return the colour images in a folder, in order."""
    return reading.files_with(folder, ".png", ".jpg", ".jpeg")


def _number(path: Path) -> int | None:
    """Number of an image: of names like 000012-000000400428 or color_000012."""
    match = _NUMBER.fullmatch(path.stem)
    return int(match.group(1)) if match else None


def _numbered_alike(color: list[Path], files: list[Path]) -> bool:
    """Whether the numbers of colour images are those of as many depth images, plus a constant."""
    pairs = [(_number(c), _number(f)) for c, f in zip(color, files, strict=True)]
    return len({c - f for c, f in pairs if c is not None and f is not None}) == 1


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
