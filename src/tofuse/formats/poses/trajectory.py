"""Trajectories in the TUM format: timestamp tx ty tz qx qy qz qw, one pose a line."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import quaternion, se3
from tofuse.engine.times import MAX_GAP_S, partners
from tofuse.formats.files import atomic, reading, tables

_MAX_INTERVAL_S = 0.5  # of poses to interpolate between


def read_tum(path: str | Path) -> tuple[Float64, Float64]:
    """Read a trajectory.

    Returns
    -------
    (N,) timestamps in s and (N, 4, 4) T_world_camera, in file order. Comments after '#' and empty
    lines are skipped, and so are poses of NaN only; quaternions are normalised.

    Raises
    ------
    InputError
        Naming file and line, if a line isn't 8 numbers, or its pose can't be used.
    """
    rows = rows_of(path, reading.read_text(path))
    with reading.about(path, "write 'timestamp tx ty tz qx qy qz qw'"):
        table, lines = numbers_of_rows(rows, path, 8, exactly=True)
        check_times(table[:, 0], path, lines)
    poses = poses_of_rows(table[:, 4:], table[:, 1:4], path, lines)
    known = np.isfinite(poses[:, 0, 0])
    return table[known, 0], poses[known]


def rows_of(path: str | Path, text: str) -> list[tuple[int, list[str]]]:
    """Return number and cells of each line that is neither empty nor a comment ('#').

    Raises
    ------
    InputError
        If the first one has the names of columns, as tables of other programs do.
    """
    lines = enumerate(text.splitlines(), 1)
    rows = [(n, line.split("#", 1)[0].replace(",", " ").split()) for n, line in lines]
    rows = [(number, cells) for number, cells in rows if cells]
    if rows and re.fullmatch("[A-Za-z_]{2,}", rows[0][1][0]) and rows[0][1][0].lower() != "nan":
        raise InputError(
            "has names instead of numbers",
            where=f"{path}, line {rows[0][0]}",
            remedy="begin it with '#'; the columns must be those of TUM's or EuRoC's format",
        )
    return rows


def numbers_of_rows(
    rows: Sequence[tuple[int, list[str]]], path: str | Path, count: int, *, exactly: bool = False
) -> tuple[Float64, list[int]]:
    """Return the first numbers of rows, (N, count), and their lines."""
    table = []
    for number, cells in rows:
        where = f"{path}, line {number}"
        try:
            table.append([float(cell) for cell in cells[:count]])
        except ValueError as error:
            raise InputError(str(error), where=where) from error
        if len(cells) < count or (exactly and len(cells) > count):
            needed = f"{count}" if exactly else f"{count} or more"
            raise InputError(
                f"has {quantities.count(len(cells), 'number')}, not {needed}", where=where
            )
    return np.array(table, float).reshape(-1, count), [number for number, _ in rows]


def check_times(times: Float64, path: str | Path, lines: Sequence[int]) -> None:
    """Raise InputError for the first of the times (N,) of lines of a file that is not finite."""
    if not np.isfinite(times).all():
        line = lines[int(np.argmin(np.isfinite(times)))]
        raise InputError("has a timestamp that is not finite", where=f"{path}, line {line}")


def poses_of_rows(q_xyzw: Float64, t: Float64, path: str | Path, numbers: Sequence[int]) -> Float64:
    """Return poses (N, 4, 4) of rows of a file; NaN for rows without any finite number.

    Parameters
    ----------
    q_xyzw, t
        (N, 4) quaternions and (N, 3) translations in m.
    path, numbers
        The file and the line of each row, for errors.

    Raises
    ------
    InputError
        If only some numbers of a row are finite, a quaternion is not of unit length, or a
        coordinate is implausibly large.
    """
    finite = np.isfinite(np.column_stack([q_xyzw, t]))
    unknown = ~finite.any(1)  # programs write NaN where tracking failed
    for bad, problem, remedy in (
        (
            ~finite.all(1) & ~unknown,
            "contains a number that is not finite",
            "write NaN for the whole pose, or remove it",
        ),
        (
            ~unknown & (np.abs(quaternion.length(q_xyzw) - 1) > 0.1),
            "contains a quaternion that is not of unit length",
            "normalise it",
        ),
        (
            ~unknown & (np.abs(t) > se3.MAX_COORDINATE_M).any(1),
            f"contains a coordinate beyond {se3.MAX_COORDINATE_M:.0e} m",
            "use metres, or remove the pose",
        ),
    ):
        if bad.any():
            line = numbers[int(np.argmax(bad))]
            raise InputError(problem, where=f"{path}, line {line}", remedy=remedy)
    poses = np.full((len(t), 4, 4), np.nan)
    poses[~unknown] = quaternion.to_pose(q_xyzw[~unknown], t[~unknown])
    return poses


def write_tum(path: str | Path, timestamps: ArrayLike, poses: ArrayLike) -> None:
    """Write (N,) timestamps in s and (N, 4, 4) T_world_camera; poses that are NaN are skipped.

    Every number is the shortest text that reads back as the same float64.
    """
    atomic.write_text(path, tum_text(timestamps, poses))


def tum_text(timestamps: ArrayLike, poses: ArrayLike) -> str:
    """Return the text that `write_tum` writes."""
    times = np.asarray(timestamps, float)
    T = np.asarray(poses, float)
    if T.shape != (len(times), 4, 4):
        raise InputError(
            f"{times.shape} timestamps and poses of shape {T.shape}",
            where="trajectory",
            remedy="pass (N,) and (N, 4, 4)",
        )
    finite = np.isfinite(T).all((1, 2))
    times, T = times[finite], T[finite]
    if not len(times):
        return ""
    table = np.column_stack([times, T[:, :3, 3], quaternion.from_matrix(T[:, :3, :3])])
    return "".join(" ".join(tables.exact(v) for v in row) + "\n" for row in table)


def write_kitti(path: str | Path, poses: ArrayLike) -> None:
    """Write (N, 4, 4) T_world_camera in KITTI's odometry format: the upper 3 x 4, row by row.

    The format has no timestamps and no gaps: poses that are NaN are skipped.
    """
    rows = _finite_poses(poses)[:, :3].reshape(-1, 12).tolist()
    atomic.write_text(path, "".join(" ".join(tables.exact(v) for v in row) + "\n" for row in rows))


def write_log(path: str | Path, poses: ArrayLike, numbers: ArrayLike) -> None:
    """Write (N, 4, 4) T_world_camera as an Open3D trajectory; poses that are NaN are skipped.

    Parameters
    ----------
    numbers
        (N,) frame numbers: each pose has a line `n n n+1` before its matrix.
    """
    finite = np.isfinite(np.asarray(poses, float)).all((1, 2))
    lines = []
    for n, T in zip(
        np.asarray(numbers)[finite].tolist(), _finite_poses(poses).tolist(), strict=True
    ):
        lines += [f"{n} {n} {n + 1}", *(" ".join(tables.exact(v) for v in row) for row in T)]
    atomic.write_text(path, "".join(f"{line}\n" for line in lines))


def _finite_poses(poses: ArrayLike) -> Float64:
    T = np.asarray(poses, float)
    return np.asarray(T[np.isfinite(T).all((1, 2))], np.float64)


def associated_poses(timestamps: ArrayLike, others: ArrayLike, poses: ArrayLike) -> Float64:
    """Return poses (N, 4, 4) at timestamps (N,), matched to (M,) others with (M, 4, 4) poses.

    Timestamps without a match have NaN; see `times.partners`.
    """
    index = partners(timestamps, others)
    out = np.full((len(index), 4, 4), np.nan)
    out[index >= 0] = np.asarray(poses, float)[index[index >= 0]]
    return out


def interpolated_poses(
    timestamps: ArrayLike, others: ArrayLike, poses: ArrayLike, *, over_gaps: bool = True
) -> Float64:
    """Return poses (N, 4, 4) at timestamps (N,), between those (M, 4, 4) at others (M,).

    NaN more than 0.02 s before the first or after the last, and between poses more than half a
    second apart. Unless `over_gaps`, only over the usual interval of the poses, as over a longer
    one a pose is missing; there the nearest one counts, see `associated_poses`.
    """
    at, others, poses = (np.asarray(x, float) for x in (timestamps, others, poses))
    out = np.full((len(at), 4, 4), np.nan)
    order = np.argsort(others, kind="stable")
    order = order[np.isfinite(others[order])]
    if not len(order):
        return out
    times, T = others[order], poses[order]
    limit = _MAX_INTERVAL_S
    if not over_gaps:
        out = associated_poses(at, others, poses)
        usual = float(np.median(np.diff(times))) if len(times) > 2 else 0.0
        limit = min(limit, 1.5 * usual)
    after = np.searchsorted(times, at)
    a, b = (after - 1).clip(0), after.clip(0, len(times) - 1)
    span = times[b] - times[a]
    fraction = np.where(span > 0, (at - times[a]) / np.where(span > 0, span, 1), 0.0)
    inside = (span <= limit) & (fraction >= 0) & (fraction <= 1)
    nearest = np.minimum(np.abs(at - times[a]), np.abs(at - times[b]))
    valid = np.where(a == b, nearest <= MAX_GAP_S, inside)
    out[valid] = se3.interpolate(T[a[valid]], T[b[valid]], fraction[valid])
    return out
