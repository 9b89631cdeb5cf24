"""A result in other formats, for `tofuse export`."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from tofuse.arrays import Float64, Intp, UInt8
from tofuse.errors import InputError, OutputError
from tofuse.files.atomic import make_folder, new_folder, output_error
from tofuse.files.geometry_record import GeometryRecord
from tofuse.files.images import jpeg_bytes
from tofuse.files.ply import read_ply
from tofuse.files.stamps import stamp
from tofuse.files.trajectory import associate, read_tum, write_kitti, write_log
from tofuse.fusion import exchange
from tofuse.fusion.mesh import Mesh
from tofuse.fusion.texture import baked
from tofuse.fusion.upright import upright
from tofuse.results.colmap import write_colmap
from tofuse.results.folder import RESULT, TILES, TILESET, claimed, home, is_result, settle
from tofuse.results.nerfstudio import write_nerfstudio
from tofuse.results.output import read_run_json
from tofuse.results.tiles import is_tiles, write_tiles

# Triangles unless more are asked for, and what they take with their texture as .glb at most.
FACES = 60_000
_MOST_BYTES = 8_000_000
_VERTEX_BYTES, _FACE_BYTES, _OTHER_BYTES = 32, 12, 4096
_QUALITIES = (92, 85, 75, 60, 40)
# To lay out a texture for more would take minutes.
_MOST_PAINTED = 120_000
_TEXTURE_SIZE = 2048


@dataclass(frozen=True)
class _Result:
    """The files of a result, read when they are asked for."""

    folder: Path
    faces: int | None
    every: int
    pinhole: bool

    @cached_property
    def cloud(self) -> GeometryRecord:
        """The cloud, with columns that say how far each point is to be trusted."""
        ply = read_ply(self.folder / "cloud.ply")
        scalars = {name: ply.scalars[name] for name in _SCALARS if name in ply.scalars}
        return replace(ply, faces=None, scalars=scalars)

    @cached_property
    def trajectory(self) -> tuple[Float64, Float64]:
        return read_tum(self.folder / "trajectory.txt")

    @cached_property
    def mesh(self) -> Mesh:
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
        unknown = np.zeros(len(ply))
        return Mesh(
            ply.points.astype(np.float32),
            faces,
            normals,
            ply.color,
            ply.scalars.get("sigma", unknown).astype(np.float32),
            ply.scalars.get("views", unknown).astype(np.int32),
            np.zeros(3),
        )

    @cached_property
    def R_up_world(self) -> Float64:
        """The rotation (3, 3) that makes the mesh upright."""
        T = read_run_json(self.folder / "run.json").get("T_up_world")
        if T is None:  # of an earlier version
            return upright(self.mesh, self.trajectory[1])
        R: Float64 = np.array(T, float)[:3, :3]
        return R

    @cached_property
    def painted(self) -> GeometryRecord:
        """The mesh as it is looked at: simplified, its colours in a texture where that is quick."""
        most = self.faces or FACES
        if self.mesh.color is None or not len(self.mesh.faces):
            return self.mesh.decimated(most).record()
        if min(most, len(self.mesh.faces)) > _MOST_PAINTED:
            return self.mesh.decimated(most).record()
        found = baked(self.mesh, most, _TEXTURE_SIZE)
        rows = found.atlas.vertices
        return GeometryRecord(
            found.mesh.vertices[rows],
            found.atlas.faces,
            found.mesh.normals[rows],
            uv=found.atlas.uv,
            texture=_jpeg(found.image, len(rows), len(found.atlas.faces)),
        )

    @cached_property
    def frame_numbers(self) -> Intp:
        """Number of the frame that each pose is of."""
        frames = read_run_json(self.folder / "run.json")["frames"]
        index = np.array([frame["index"] for frame in frames], np.intp)
        times = np.array([frame["timestamp"] for frame in frames], float)
        return index[associate(self.trajectory[0], times, limit=1e-6)]


_SCALARS = ("views", "sigma")


def _jpeg(image: UInt8, vertices: int, faces: int) -> bytes:
    """The best picture that is small enough beside so many vertices and triangles."""
    room = _MOST_BYTES - _VERTEX_BYTES * vertices - _FACE_BYTES * faces - _OTHER_BYTES
    picture = b""
    for quality in _QUALITIES:
        picture = jpeg_bytes(image, quality)
        if len(picture) <= room:
            break
    return picture


def _cloud(result: _Result, path: Path) -> None:
    exchange.save(result.cloud, path)


def _mesh(result: _Result, path: Path) -> None:
    exchange.save(result.painted, path, result.R_up_world)


def _stl(result: _Result, path: Path) -> None:
    mesh = result.mesh if result.faces is None else result.mesh.decimated(result.faces)
    exchange.save(mesh.record(), path, result.R_up_world)


def _nerfstudio(result: _Result, path: Path) -> None:
    with _folder(path) as folder:
        write_nerfstudio(result.folder, folder, result.every, result.pinhole)


def _colmap(result: _Result, path: Path) -> None:
    with _folder(path) as folder:
        write_colmap(result.folder, folder, result.every, result.pinhole)


# Folders that hold images with poses, and what is in them.
_KINDS = frozenset({"images", "depth", "sigma", "masks"})
FOLDERS = {
    "nerfstudio": _KINDS | {"transforms.json", "points.ply"},
    "colmap": _KINDS | {"sparse"},
}


def foreign(folder: Path) -> tuple[str, ...]:
    """Return what is in the folder of an export that does not belong there, its own name if all."""
    if folder.is_symlink() or not folder.is_dir():
        return (folder.name,)
    return tuple(sorted({p.name for p in folder.iterdir()} - FOLDERS[folder.name]))


@contextmanager
def _folder(path: Path) -> Iterator[Path]:
    """Give a new folder that takes the place of an earlier one, of which everything is ours."""
    if os.path.lexists(path) and (others := foreign(path)):
        raise OutputError(
            f"is in the way: it holds {others[0]}, which no export wrote",
            where=path,
            remedy="move it away, or give another --out",
        )
    made = path.with_name(f".{path.name}-{os.getpid()}")
    with new_folder(made) as folder:
        yield folder
    try:
        shutil.rmtree(path, ignore_errors=True)
        os.replace(made, path)
    except OSError as error:
        raise output_error(error, path) from error


def _tiles(result: _Result, path: Path) -> None:
    if len(result.mesh.faces) == 0:
        raise InputError("holds no triangles to be tiled", where=result.folder / "mesh.ply")
    folder = path.parent
    if os.path.lexists(folder):
        if not is_tiles(folder):
            raise OutputError(
                "holds something other than tiles",
                where=folder,
                remedy="move it away, or give another --out",
            )
        shutil.rmtree(folder, ignore_errors=True)
    with new_folder(folder) as beside:
        write_tiles(result.mesh, result.R_up_world, beside)


def _kitti(result: _Result, path: Path) -> None:
    write_kitti(path, result.trajectory[1])


def _log(result: _Result, path: Path) -> None:
    write_log(path, result.trajectory[1], result.frame_numbers)


# The file that each format makes, and how.
FORMATS: dict[str, tuple[str, Callable[[_Result, Path], None]]] = {
    "pcd": ("cloud.pcd", _cloud),
    "las": ("cloud.las", _cloud),
    "laz": ("cloud.laz", _cloud),
    "e57": ("cloud.e57", _cloud),
    "glb": ("mesh.glb", _mesh),
    "gltf": ("mesh.gltf", _mesh),
    "obj": ("mesh.obj", _mesh),
    "usdz": ("mesh.usdz", _mesh),
    "stl": ("mesh.stl", _stl),
    "3dtiles": (f"{TILES}/{TILESET}", _tiles),
    "kitti": ("trajectory.kitti.txt", _kitti),
    "log": ("trajectory.log", _log),
    "nerfstudio": ("nerfstudio", _nerfstudio),
    "colmap": ("colmap", _colmap),
}


def export(
    folder: str | Path,
    formats: Sequence[str],
    out: str | Path | None = None,
    *,
    faces: int | None = None,
    every: int = 1,
    pinhole: bool = False,
    overwrite: bool = False,
) -> list[Path]:
    """Write a result in other formats; returns the files.

    Where the files go, no other process may write meanwhile.

    Parameters
    ----------
    folder
        A result of `tofuse run`.
    formats
        Names in `FORMATS`.
    out
        Where to; beside the result unless given.
    faces
        Triangles of a surface at most; `FACES` unless given, and all for STL.
    every
        Of the images that have a pose, each so-many-th.
    pinhole
        Whether images are rectified, as some programs know no distortion.
    overwrite
        Whether files may be replaced.

    Raises
    ------
    InputError
        If the folder holds no result, a format is unknown, or lacks what it needs; or the result
        was replaced while it was read.
    OutputError
        If a file is there already, or can't be written, or another process writes into the folder.
    """
    folder = Path(folder)
    settle(home(folder))
    if not is_result(folder):
        raise InputError("holds no result", where=folder, remedy="give the --out of `tofuse run`")
    unknown = [name for name in formats if name not in FORMATS]
    if unknown:
        raise InputError(f"is {unknown[0]!r}", where="FORMAT", remedy=f"use one of {list(FORMATS)}")
    target = folder if out is None else Path(out)
    files = {name: target / FORMATS[name][0] for name in dict.fromkeys(formats)}
    make_folder(target)
    with claimed(target), _unchanged(folder):
        for path in files.values():
            if path.exists() and not overwrite:
                raise OutputError(
                    "is there already", where=path, remedy="give --overwrite to replace it"
                )
        result = _Result(folder, faces, every, pinhole)
        for name, path in files.items():
            FORMATS[name][1](result, path)
    return list(files.values())


@contextmanager
def _unchanged(folder: Path) -> Iterator[None]:
    """Refuse what was read of a result in the block if a run replaced it meanwhile.

    Whoever writes elsewhere holds no lock of the result, which may be read-only.
    """
    before = stamp(folder / RESULT.marker)
    yield
    if not is_result(folder) or stamp(folder / RESULT.marker) != before:
        raise InputError(
            "was replaced by another run while it was read",
            where=folder,
            remedy="export it again with --overwrite",
        )
