"""The files of a recording, and what belongs to each frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.frames import Source
from tofuse.engine.geometry import se3
from tofuse.formats.files import reading, tables
from tofuse.formats.poses import associated_poses, interpolated_poses, read_tum
from tofuse.formats.sources.reader import ReaderOptions

PER_FRAME = "a camera per frame"


T = TypeVar("T")


def required(files: list[T], name: str, where: Path, remedy: str = "check the path") -> list[T]:
    """Return the files; raise InputError, that `where` has no `name`, if there are none."""
    if not files:
        if reading.is_folder(where) and (tiffs := reading.files_with(where, ".tif", ".tiff")):
            name += f", but {len(tiffs)} .tif files"
            remedy = "pass this folder itself, with --format tiff and --camera camera.json"
        raise InputError(f"has no {name}", where=where, remedy=remedy)
    return files


def depth_images(folder: Path) -> list[Path]:
    """Return the PNGs in a folder of depth images; InputError if there are none."""
    return required(reading.files_with(folder, ".png"), ".png files", folder)


def refuse_camera(options: ReaderOptions, name: str, stores: str = "points") -> None:
    """Raise InputError if a camera was passed for the format `name`, which stores `stores`."""
    if options.camera is not None:
        raise InputError(
            f"does not apply to the format {name!r}, which stores {stores}",
            where="--camera",
            remedy="leave it out",
        )


def file_of(path: Path, *suffixes: str) -> Path | None:
    """Return the file at `path`, or the only one with these suffixes in that folder; else None."""
    if reading.is_file(path):
        return path if path.suffix.lower() in suffixes else None
    if not reading.is_folder(path):
        return None
    try:
        files = reading.files_with(path, *suffixes)
    except InputError:
        return None
    return files[0] if len(files) == 1 else None


def begins_with(file: Path | None, head: bytes) -> bool:
    """Return whether there is a file that begins with these bytes; errors as `read_head`."""
    return file is not None and reading.read_head(file, len(head)) == head


def required_file(path: Path, *suffixes: str) -> Path:
    """Return the same as `file_of`, or any file given by its path; else raise InputError."""
    file = file_of(path, *suffixes)
    if file is not None:
        return file
    if reading.is_file(path):
        return path
    raise InputError(
        f"doesn't contain exactly one {' or '.join(suffixes)} file",
        where=path,
        remedy="pass the file",
    )


def files_at(path: Path, *suffixes: str) -> list[Path]:
    """Return the file itself or the files of a folder, if they have one of the suffixes."""
    if reading.is_file(path):
        return [path] if path.suffix.lower() in suffixes else []
    return reading.files_with(path, *suffixes) if reading.is_folder(path) else []


def tum_poses(source: Source, path: Path, *, interpolated: bool = False) -> Float64:
    """Return (N, 4, 4) poses of a TUM file at the source's timestamps, NaN without a match.

    Those nearest in time, or interpolated over their usual interval.
    """
    times, poses = read_tum(path)
    if interpolated:
        out = interpolated_poses(source.timestamps, times, poses, over_gaps=False)
    else:
        out = associated_poses(source.timestamps, times, poses)
    posed = int(np.isfinite(out[:, 0, 0]).sum())
    if posed < len(out):
        source.warnings.append(
            f"{path}: {posed} of {len(out)} frames have a pose at their timestamp"
        )
    return out


def poses_of(
    source: Source, items: Iterable[T], read: Callable[[T], Float64 | None]
) -> Float64 | None:
    """Return the poses (N, 4, 4) of all frames; None if none is known.

    Parameters
    ----------
    source
        Receives a warning if poses can't be read.
    items
        One for each frame: what its pose is read from.
    read
        Returns the pose (4, 4), NaN or None if unknown; raises InputError if it can't be read.
    """
    poses, errors = [], []
    for item in items:
        pose = None
        try:
            pose = read(item)
        except InputError as error:
            errors.append(error)
        poses.append(np.full((4, 4), np.nan) if pose is None else pose)
    if errors:
        source.warnings.append(
            f"{quantities.count(len(errors), 'pose')} can't be read, the first: {errors[0]}"
        )
    return np.stack(poses) if np.isfinite(poses).any() else None


def poses_from_files(
    source: Source, files: Iterable[Path], read: Callable[[Path], Float64]
) -> Float64 | None:
    """Return the poses of one file per frame, which may be missing; see `poses_of`."""
    found = (reading.if_file(path) for path in files)
    return poses_of(source, found, lambda file: None if file is None else read(file))


def read_matrix_pose(table: Float64, where: str) -> Float64:
    """Check a (4, 4) pose of a file, and orthonormalise its rotation.

    Non-finite entries, which trackers write where they are lost, give NaN.
    """
    if table.shape != (4, 4):
        raise InputError(
            f"has {quantities.count(table.shape[0], 'row')} of {table.shape[-1]} numbers",
            where=where,
            remedy="write the pose as four rows of four numbers",
        )
    if not np.isfinite(table).all():
        return np.full((4, 4), np.nan)
    return se3.orthonormalise(se3.check_pose(table, where=where))


def color_from_depth(
    warnings: list[str], T_device_color: Float64, T_device_depth: Float64, where: str | Path
) -> Float64:
    """Return T_color_depth (4, 4) of two poses of a file; identity if they are invalid."""
    try:
        poses = [
            read_matrix_pose(T, f"{where}: extrinsics") for T in (T_device_color, T_device_depth)
        ]
    except InputError as error:
        warnings.append(f"{error}; colour is assumed to have the pose of depth")
        return np.eye(4)
    return se3.inverse(poses[0]) @ poses[1] if np.isfinite(poses).all() else np.eye(4)


def read_timestamps(path: Path, count: int, warnings: list[str]) -> Float64:
    """Read a timestamps.txt: (N,) seconds for `count` frames."""
    table = tables.read_numbers(path)
    if table.shape != (count, 1):
        raise InputError(
            f"has {quantities.count(len(table), 'line')} of {table.shape[-1]} numbers for "
            f"{quantities.count(count, 'frame')}",
            where=path,
            remedy="use one time in seconds for each frame, or remove it",
        )
    times = table[:, 0]
    check_timestamps(times, path, warnings)
    return times


def cameras_of(items: Iterable[T], read: Callable[[T], Pinhole]) -> list[Pinhole | InputError]:
    """Return the camera of each frame, or the error that makes only this frame unusable."""
    cameras: list[Pinhole | InputError] = []
    for item in items:
        try:
            cameras.append(read(item))
        except InputError as error:
            cameras.append(error)
    return cameras


def check_timestamps(times: Float64, path: Path, warnings: list[str]) -> None:
    """Raise InputError if timestamps are not finite; warn if they repeat or decrease."""
    if not np.isfinite(times).all():
        k = int(np.argmin(np.isfinite(times)))
        raise InputError(
            f"line {k + 1} is {times[k]}", where=path, remedy="assign every frame a time in seconds"
        )
    steps = np.diff(times)
    if (steps < 0).any():
        k = int(np.argmax(steps < 0)) + 1
        warnings.append(f"{path}: time decreases at frame {k}; frames stay in the order of files")
    elif (steps == 0).any():
        k = int(np.argmax(steps == 0)) + 1
        warnings.append(f"{path}: frames {k - 1} and {k} have the same timestamp")


def interpolated(times: Float64) -> Float64:
    """Return timestamps (N,) of frames, some of them finite, with the others interpolated.

    Before the first and after the last known one they go on with the median step.
    """
    known = np.flatnonzero(np.isfinite(times))
    index, steps = np.arange(len(times)), np.diff(times[known]) / np.diff(known)
    beyond = index - np.clip(index, known[0], known[-1])
    step = np.median(steps) if len(steps) else 1.0
    return np.asarray(np.interp(index, known, times[known]) + beyond * step)
