"""Trajectories in the formats of other programs, detected from the content of the file.

TUM, EuRoC (CSV), KITTI, Open3D and Redwood (.log), COLMAP (images.txt), nerfstudio and
NeRFCapture (transforms.json), NumPy (.npy), and the result of a run. Some have a timestamp for each
pose, others the number of its frame.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.errors import InputError, InputWarning
from tofuse.engine.geometry import se3
from tofuse.formats.files import npz, reading
from tofuse.formats.poses.trajectory import (
    associated_poses,
    check_times,
    numbers_of_rows,
    poses_of_rows,
    read_tum,
    rows_of,
)

# Files with the poses in a folder; the first that exists is used.
NAMES = ("trajectory.txt", "groundtruth.txt", "images.txt", "transforms.json", "trajectory.log")
_SUPPORTED = "TUM, EuRoC, KITTI, .log, COLMAP's images.txt, transforms.json or .npy"
# Times in nanoseconds are larger than any in seconds, which end in the year 2286, after 10 s.
_NANOSECONDS = 1e10
# Digits that always fit into an int64.
_DIGITS = 18
# Cameras of OpenGL look along -z, with y up.
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class TimedPoses:
    """Poses of a camera, with the timestamps or numbers of their frames.

    Attributes
    ----------
    poses
        (N, 4, 4) T_world_camera, x right, y down, z forward.
    timestamps
        (N,) s; None where the format has none.
    frames
        (N,) frame numbers where it has no timestamps: from 0, or as in the names of the images.
    in_order
        The file and its number of poses, if it states neither times nor frame numbers.
    """

    poses: Float64
    timestamps: Float64 | None = None
    frames: Intp | None = None
    in_order: tuple[Path, int] | None = None

    def of_frames(self, timestamps: Float64, frames: Intp) -> Float64:
        """Return (M, 4, 4) poses of frames with timestamps (M,) and numbers (M,), NaN if unknown.

        As many poses as frames, numbered from 0, are those of the frames in their order.

        Warns
        -----
        InputWarning
            If poses without numbers are too few for the frames, so that any may be missing.
        """
        if self.timestamps is not None:
            return associated_poses(timestamps, self.timestamps, self.poses)
        assert self.frames is not None
        if np.array_equal(self.frames, np.arange(len(frames))):
            return self.poses
        if self.in_order is not None and len(frames) != self.in_order[1] <= frames.max(initial=0):
            path, rows = self.in_order
            warnings.warn(
                f"{path}: has {quantities.count(rows, 'pose')} without times or frame numbers, and "
                f"the recording {quantities.count(len(frames), 'frame')}: they are taken for the "
                "first ones; if others have no pose, use a format with times, such as TUM",
                InputWarning,
                stacklevel=3,
            )
        out = np.full((len(frames), 4, 4), np.nan)
        row = {int(number): k for k, number in enumerate(self.frames)}
        for k, number in enumerate(frames.tolist()):
            if number in row:
                out[k] = self.poses[row[number]]
        return out

    def timed(self, clock: Clock | None, where: str | Path) -> tuple[Float64, Float64]:
        """Return (M,) timestamps and (M, 4, 4) poses, of the frames that the clock contains.

        Without timestamps and without a clock the frame numbers serve as timestamps.

        Raises
        ------
        InputError
            Naming `where`, if the clock contains none of the frames.
        """
        if self.timestamps is not None:
            return self.timestamps, self.poses
        assert self.frames is not None
        if clock is None:
            return self.frames.astype(np.float64), self.poses
        poses = self.of_frames(*clock)
        posed = np.isfinite(poses).all((1, 2))
        if not posed.any():
            raise InputError("has poses of other frames than the recording", where=where)
        return clock[0][posed], poses[posed]


# (N,) timestamps and (N,) numbers of the frames of a recording.
Clock = tuple[Float64, Intp]


def read_poses(path: str | Path) -> TimedPoses:
    """Read a trajectory in any of the formats, from a file or a folder.

    Raises
    ------
    InputError
        If there is none, it can't be read, or its format is unknown.
    """
    path = Path(path)
    if reading.is_folder(path):
        file = next((path / name for name in NAMES if reading.is_file(path / name)), None)
        if file is None:
            raise InputError(
                f"contains none of {', '.join(NAMES)}",
                where=path,
                remedy=f"pass a result, or a file of poses: {_SUPPORTED}",
            )
        path = file
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return _numpy(path)
    text = reading.read_text(path)
    with reading.about(path, f"use {_SUPPORTED}"):
        if suffix == ".json":
            return _transforms(text, path)
        rows = rows_of(path, text)
        if not rows:
            raise InputError("contains no poses")
        first_line = text.splitlines()[rows[0][0] - 1]
        return _reader(rows, with_commas="," in first_line)(rows, path)


_Rows = Sequence[tuple[int, list[str]]]
_Reader = Callable[[_Rows, Path], TimedPoses]


def _reader(rows: _Rows, *, with_commas: bool) -> _Reader:
    """The reader of a text format, detected from the number of cells per line."""
    first = rows[0][1]
    count = len(first)
    if count == 3 and len(rows) > 1 and len(rows[1][1]) == 4:
        return _log
    if count == 12:
        return _kitti
    if count >= 10 and not _is_number(first[9]):
        return _colmap
    last = rows[-1][1][0]
    in_ns = count >= 8 and _is_number(last) and float(last) > _NANOSECONDS
    if in_ns and (with_commas or count > 8):
        return _euroc
    if count == 8:
        return _tum
    raise InputError(
        "is not a trajectory of a known format: its first line has "
        f"{quantities.count(count, 'column')}"
    )


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _tum(_rows: _Rows, path: Path) -> TimedPoses:
    """TUM's lines. ORB-SLAM3 writes such for EuRoC's recordings, with times in ns."""
    times, poses = read_tum(path)
    if times.max(initial=0) > _NANOSECONDS:
        times = 1e-9 * times
    return TimedPoses(poses, timestamps=times)


def _known(
    poses: Sequence[Float64] | Float64,
    timestamps: Float64 | None = None,
    frames: Any = None,
    in_order: Path | None = None,
) -> TimedPoses:
    """Leave out poses that are NaN, which programs write where tracking failed."""
    stacked = np.reshape(poses, (-1, 4, 4))
    known = np.isfinite(stacked[:, 0, 0])
    return TimedPoses(
        stacked[known],
        None if timestamps is None else timestamps[known],
        None if frames is None else np.array(frames, np.intp)[known],
        None if in_order is None else (in_order, len(stacked)),
    )


def _rigid(T: Float64, where: str) -> Float64:
    """Check a pose, and orthonormalise its rotation; NaN if no number is finite."""
    if T.shape == (4, 4) and se3.is_unknown(T):
        return np.full((4, 4), np.nan)
    return se3.orthonormalise(se3.check_pose(T, where=where))


def _euroc(rows: _Rows, path: Path) -> TimedPoses:
    """Lines of ns, x y z, qw qx qy qz, and possibly more, as in EuRoC's ground truth."""
    table, lines = numbers_of_rows(rows, path, 8)
    poses = poses_of_rows(table[:, [5, 6, 7, 4]], table[:, 1:4], path, lines)
    check_times(table[:, 0], path, lines)
    return _known(poses, timestamps=1e-9 * table[:, 0])


def _kitti(rows: _Rows, path: Path) -> TimedPoses:
    """Lines of 3 x 4 matrices, one for each frame."""
    table, lines = numbers_of_rows(rows, path, 12)
    out = np.tile(np.eye(4), (len(rows), 1, 1))
    out[:, :3] = table.reshape(-1, 3, 4)
    poses = [_rigid(T, f"{path}, line {line}") for T, line in zip(out, lines, strict=True)]
    return _known(poses, frames=range(len(out)), in_order=path)


def _log(rows: _Rows, path: Path) -> TimedPoses:
    """A line of three numbers, the first the frame, and four of a matrix, for each pose."""
    if len(rows) % 5:
        raise InputError(f"has {quantities.count(len(rows), 'line')}, not 5 for each pose")
    poses, frames = [], []
    for k in range(0, len(rows), 5):
        _, head = rows[k]
        where = f"{path}, pose {k // 5}"
        table, _ = numbers_of_rows(rows[k + 1 : k + 5], path, 4)
        if not (head[0].isdecimal() and len(head[0]) <= _DIGITS):
            raise InputError(f"names frame {head[0][:40]!r}", where=where)
        poses.append(_rigid(table, where))
        frames.append(int(head[0]))
    return _known(poses, frames=frames)


def _colmap(rows: _Rows, path: Path) -> TimedPoses:
    """COLMAP's images: id, qw qx qy qz, x y z of T_camera_world, camera, name; then its points."""
    # The second line of each image lists its points as triples, without a name in column 10.
    images = [(n, c) for n, c in rows if len(c) == 10 and not _is_number(c[9])]
    table, lines = numbers_of_rows(images, path, 8)
    T_camera_world = poses_of_rows(table[:, [2, 3, 4, 1]], table[:, 5:8], path, lines)
    names = [cells[9] for _, cells in images]
    return _known(se3.inverse(T_camera_world), frames=_frame_numbers(names))


def _transforms(text: str, path: Path) -> TimedPoses:
    """NeRF's JSON: for each frame a path and T_world_camera with the axes of OpenGL."""
    data = reading.parsed(json.loads, text, where=path, format_name="valid JSON")
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError("has no list 'frames'")
    poses, names = [], []
    for k, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise InputError(f"frame {k} is not an object")
        where = f"{path}, frame {k}: transform_matrix"
        T = reading.matrix_of(frame.get("transform_matrix"), where)
        poses.append(_rigid(T, where) @ OPENGL)
        names.append(str(frame.get("file_path", k)))
    return _known(poses, frames=_frame_numbers(names))


def _numpy(path: Path) -> TimedPoses:
    """(N, 4, 4) or (N, 3, 4), one for each frame, NaN where there is none."""
    table = npz.read_npy(path)
    if table.ndim != 3 or table.shape[1:] not in ((4, 4), (3, 4)) or table.dtype.kind not in "fiu":
        raise InputError(f"is of shape {table.shape}", where=path, remedy="write (N, 4, 4)")
    out = np.tile(np.eye(4), (len(table), 1, 1))
    out[:, : table.shape[1]] = table
    poses = [_rigid(T, f"{path}, pose {k}") for k, T in enumerate(out)]
    return _known(poses, frames=range(len(out)), in_order=path)


def _frame_numbers(names: Sequence[str]) -> Intp:
    """The last number in each file name: the frame number."""
    digits_in = [re.findall(r"[0-9]+", Path(name).stem) for name in names]
    if not all(digits_in):
        missing = names[[bool(digits) for digits in digits_in].index(False)]
        raise InputError(
            f"has an image without a number in its name, {missing!r}",
            remedy="name images by the number of their frame",
        )
    numbers = np.array([int(digits[-1][-_DIGITS:]) for digits in digits_in], np.intp)
    if len(np.unique(numbers)) != len(numbers):
        raise InputError("has two images with the same number")
    return numbers
