"""A result in other formats, for `tofuse export`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import InputError, OutputError
from tofuse.files.atomic import make_folder
from tofuse.files.ply import read_ply
from tofuse.files.trajectory import associate, read_tum, write_kitti, write_log
from tofuse.fusion.exchange import Shape
from tofuse.fusion.mesh import Mesh
from tofuse.fusion.upright import upright
from tofuse.results.folder import is_result, settle
from tofuse.results.output import read_run_json

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class _Result:
    """The files of a result, read when they are asked for."""

    folder: Path

    @cached_property
    def cloud(self) -> Shape:
        """The cloud, with columns that say how far each point is to be trusted."""
        ply = read_ply(self.folder / "cloud.ply")
        scalars = {name: ply.vertex[name] for name in _SCALARS if name in ply.vertex}
        return Shape(ply.points, ply.normals, ply.color, scalars)

    @cached_property
    def trajectory(self) -> tuple[Float64, Float64]:
        return read_tum(self.folder / "trajectory.txt")

    @cached_property
    def mesh(self) -> tuple[Shape, Float64]:
        """The mesh, and the rotation (3, 3) that makes it upright."""
        path = self.folder / "mesh.ply"
        if not path.is_file():
            raise InputError(
                "is not there: clouds without a camera make no surface",
                where=path,
                remedy="choose a format for clouds",
            )
        ply = read_ply(path)
        faces = np.zeros((0, 3), np.int32) if ply.faces is None else ply.faces
        normals = np.zeros((len(ply), 3), np.float32) if ply.normals is None else ply.normals
        nothing = np.zeros(len(ply), np.int32)
        mesh = Mesh(
            ply.points, faces, normals, ply.color, nothing.astype(np.float32), nothing, np.zeros(3)
        )
        return mesh.shape(), upright(mesh, self.trajectory[1])

    @cached_property
    def frame_numbers(self) -> NDArray[np.intp]:
        """Number of the frame that each pose is of."""
        frames = read_run_json(self.folder / "run.json")["frames"]
        index = np.array([frame["index"] for frame in frames], np.intp)
        times = np.array([frame["timestamp"] for frame in frames], float)
        return index[associate(self.trajectory[0], times, limit=1e-6)]


_SCALARS = ("views", "sigma")


def _cloud(result: _Result, path: Path) -> None:
    result.cloud.save(path)


def _mesh(result: _Result, path: Path) -> None:
    shape, R_up_world = result.mesh
    shape.save(path, R_up_world)


def _kitti(result: _Result, path: Path) -> None:
    write_kitti(path, result.trajectory[1])


def _log(result: _Result, path: Path) -> None:
    write_log(path, result.trajectory[1], result.frame_numbers)


# The file that each format makes, and how.
FORMATS: dict[str, tuple[str, Callable[[_Result, Path], None]]] = {
    "pcd": ("cloud.pcd", _cloud),
    "las": ("cloud.las", _cloud),
    "e57": ("cloud.e57", _cloud),
    "obj": ("mesh.obj", _mesh),
    "gltf": ("mesh.gltf", _mesh),
    "kitti": ("trajectory.kitti.txt", _kitti),
    "log": ("trajectory.log", _log),
}


def export(
    folder: str | Path,
    formats: Sequence[str],
    out: str | Path | None = None,
    *,
    overwrite: bool = False,
) -> list[Path]:
    """Write a result in other formats; returns the files.

    Parameters
    ----------
    folder
        A result of `tofuse run`.
    formats
        Names in `FORMATS`.
    out
        Where to; beside the result unless given.
    overwrite
        Whether files may be replaced.

    Raises
    ------
    InputError
        If the folder holds no result, a format is unknown, or lacks what it needs.
    OutputError
        If a file is there already, or can't be written.
    """
    folder = Path(folder)
    settle(folder)
    if not is_result(folder):
        raise InputError("holds no result", where=folder, remedy="give the --out of `tofuse run`")
    unknown = [name for name in formats if name not in FORMATS]
    if unknown:
        raise InputError(f"is {unknown[0]!r}", where="FORMAT", remedy=f"use one of {list(FORMATS)}")
    target = folder if out is None else Path(out)
    files = {name: target / FORMATS[name][0] for name in dict.fromkeys(formats)}
    for path in files.values():
        if path.exists() and not overwrite:
            raise OutputError(
                "is there already", where=path, remedy="give --overwrite to replace it"
            )
    make_folder(target)
    result = _Result(folder)
    for name, path in files.items():
        FORMATS[name][1](result, path)
    return list(files.values())
