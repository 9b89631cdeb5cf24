"""A result in other formats, for `tofuse export`."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from tofuse.apps.export.colmap import write_colmap
from tofuse.apps.export.grids import Grid
from tofuse.apps.export.mcap_file import write_mcap
from tofuse.apps.export.nerfstudio import write_nerfstudio
from tofuse.apps.export.rerun_file import write_rerun
from tofuse.apps.export.scene import Scene
from tofuse.apps.results import (
    DISPLAY_FACES,
    TEXTURE_SIZE,
    folders,
    read_cloud,
    read_mesh,
    run_json,
    textured_record,
)
from tofuse.engine.arrays import Float64, UInt8
from tofuse.engine.errors import InputError, OutputError
from tofuse.engine.fusion import GeometryRecord, Mesh, texture
from tofuse.engine.times import nearest
from tofuse.formats.export import exchange
from tofuse.formats.files import atomic, reading, staging, stamps
from tofuse.formats.geometry import read_textured_glb
from tofuse.formats.images import jpeg_bytes
from tofuse.formats.poses import read_tum, write_kitti, write_log

# Maximum size of a .glb with a texture.
_MAX_BYTES = 8_000_000
_VERTEX_BYTES, _FACE_BYTES, _OTHER_BYTES = 32, 12, 4096
_QUALITIES = (92, 85, 75, 60, 40)
# Texture layout takes minutes for more faces.
_MAX_TEXTURED_FACES = 120_000


@dataclass(frozen=True)
class _Result:
    """The files of a result, read on demand."""

    folder: Path
    faces: int | None
    every: int
    pinhole: bool
    voxel_m: float | None

    @cached_property
    def scene(self) -> Scene:
        """Poses and model, and on demand images."""
        return Scene.read(self.folder, self.every)

    @cached_property
    def grid(self) -> Grid:
        """Free and occupied space."""
        return Grid(self.scene, self.voxel_m)

    @cached_property
    def cloud(self) -> GeometryRecord:
        """The cloud, with the number of views and sigma of each point."""
        cloud = read_cloud(self.folder)
        scalars = {k: v for k, v in cloud.scalars.items() if k in ("views", "sigma")}
        return replace(cloud, faces=None, scalars=scalars)

    @cached_property
    def trajectory(self) -> tuple[Float64, Float64]:
        return read_tum(self.folder / "trajectory.txt")

    @cached_property
    def mesh(self) -> Mesh:
        path = self.folder / "mesh.ply"
        mesh = read_mesh(path)
        if mesh is None:
            raise InputError(
                "doesn't exist",
                where=path,
                remedy="choose a format for clouds, which have no surface without a camera model, "
                "or run again if it was deleted",
            )
        if not len(mesh.faces):
            raise InputError("has no triangles", where=path, remedy="choose a format for clouds")
        return mesh

    @cached_property
    def R_up_world(self) -> Float64:
        """The rotation (3, 3) that makes the mesh upright."""
        path = self.folder / "run.json"
        return run_json.rotation_up_world(run_json.read_run_json(path), path)

    @cached_property
    def textured(self) -> GeometryRecord:
        """The surface with the texture of mesh.glb; else simplified, with its colours in a texture.

        Without a texture if that takes too long.
        """
        found = None if self.faces else read_textured_glb(self.folder / "mesh.glb")
        if found is not None:
            record, in_world = found
            if in_world:
                return record
            normals = None if record.normals is None else record.normals @ self.R_up_world
            return replace(record, points=record.points @ self.R_up_world, normals=normals)
        max_faces = self.faces or DISPLAY_FACES
        n_faces = min(max_faces, len(self.mesh.faces))
        if self.mesh.color is None or n_faces > _MAX_TEXTURED_FACES:
            return self.mesh.decimated(max_faces).record()
        baked = texture.baked(self.mesh, max_faces, TEXTURE_SIZE)
        rows, faces = baked.atlas.vertices, baked.atlas.faces
        other_bytes = _VERTEX_BYTES * len(rows) + _FACE_BYTES * len(faces) + _OTHER_BYTES
        return textured_record(baked, _jpeg(baked.image, other_bytes))


def _jpeg(image: UInt8, other_bytes: int) -> bytes:
    """The best JPEG that keeps a mesh of this size below `_MAX_BYTES`, or the smallest one."""
    data = b""
    for quality in _QUALITIES:
        data = jpeg_bytes(image, quality)
        if len(data) + other_bytes <= _MAX_BYTES:
            break
    return data


def _cloud(result: _Result, path: Path) -> None:
    exchange.save(result.cloud, path)


def _mesh(result: _Result, path: Path) -> None:
    exchange.save(result.textured, path, result.R_up_world)


def _stl(result: _Result, path: Path) -> None:
    mesh = result.mesh
    if result.faces is not None:
        mesh = mesh.decimated(result.faces)
    exchange.save(mesh.record(), path, result.R_up_world)


def _images(result: _Result, path: Path) -> None:
    """Write a folder with images, which then replaces an earlier export in its place."""

    def check(folder: Path) -> None:
        if unexpected := folders.RESULT.foreign(folder, f"{path.name}/"):
            raise OutputError(
                f"contains {unexpected}, which is not part of an export",
                where=path,
                remedy="move it away, or pass another --out",
            )

    write = write_colmap if path.name == "colmap" else write_nerfstudio
    with staging.replacing_folder(path, check) as folder:
        write(result.folder, folder, result.every, result.pinhole)


def _kitti(result: _Result, path: Path) -> None:
    write_kitti(path, result.trajectory[1])


def _log(result: _Result, path: Path) -> None:
    with run_json.opened(result.folder) as run:
        times, index = run_json.frame_clock(run)
    stamps_of_poses, poses = result.trajectory
    write_log(path, poses, index[nearest(times, stamps_of_poses, 1e-6)])


# The file of each format, and the function that writes it.
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
    "kitti": ("trajectory.kitti.txt", _kitti),
    "log": ("trajectory.log", _log),
    "nerfstudio": ("nerfstudio", _images),
    "colmap": ("colmap", _images),
    "rerun": ("result.rrd", lambda result, path: write_rerun(result.scene, path)),
    "mcap": ("result.mcap", lambda result, path: write_mcap(result.scene, path)),
    "occupancy": ("occupancy.npz", lambda result, path: result.grid.write_occupancy(path)),
    "esdf": ("esdf.npz", lambda result, path: result.grid.write_esdf(path)),
    "octomap": ("octomap.bt", lambda result, path: result.grid.write_octomap(path)),
}

# The formats that each option is for.
_GRIDS = ("occupancy", "esdf", "octomap")
_TAKE = {
    "--faces": ("glb", "gltf", "obj", "usdz", "stl"),
    "--every": ("nerfstudio", "colmap", "rerun", "mcap", *_GRIDS),
    "--pinhole": ("nerfstudio", "colmap"),
    "--voxel": _GRIDS,
}

# Packages that formats need, and the extras that install them.
_NEEDED = {
    "e57": ("pye57", "scan"),
    "stl": ("trimesh", None),
    "rerun": ("rerun", "rerun"),
    "mcap": ("mcap.writer", "mcap"),
}


def export(
    folder: str | Path,
    formats: Sequence[str],
    out: str | Path | None = None,
    *,
    faces: int | None = None,
    every: int = 1,
    pinhole: bool = False,
    voxel_m: float | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write a result in other formats, and return the paths of the files.

    A target folder that is a result is locked against other processes.

    Parameters
    ----------
    folder
        A result of `tofuse run`.
    formats
        Names in `FORMATS`.
    out
        Folder for the files; by default that of the result.
    faces
        Maximum number of triangles; by default those of `mesh.glb`, for STL all.
    every
        Every n-th of the images with a pose.
    pinhole
        Whether to rectify images, for programs without distortion models.
    voxel_m
        Voxel size of grids and octrees, m; by default see `occupancy_grid`.
    overwrite
        Whether existing files may be replaced.

    Raises
    ------
    InputError
        If the folder contains no result, a format is unknown or lacks its input, no format has a
        given option, or the result was replaced while it was read.
    OutputError
        If a file exists already, or can't be written, or another process writes into the folder.
    """
    folder = Path(folder)
    folders.check_result(folder)
    unknown = [name for name in formats if name not in FORMATS]
    if unknown:
        available = ", ".join(FORMATS)
        raise InputError(
            f"unknown format {unknown[0]}", where="FORMAT", remedy=f"use one of {available}"
        )
    given = (faces is not None, every != 1, pinhole, voxel_m is not None)
    for (option, taking), is_given in zip(_TAKE.items(), given, strict=True):
        if is_given and not set(taking) & set(formats):
            raise InputError(
                f"has no effect on {', '.join(formats)}",
                where=option,
                remedy=f"leave it out; it is for {', '.join(taking)}",
            )
    for name in formats:
        if name in _NEEDED:  # before minutes are spent on other formats
            reading.required_package(*_NEEDED[name], f"tofuse export {name}")
    target = folder if out is None else Path(out)
    files = {name: target / FORMATS[name][0] for name in dict.fromkeys(formats)}
    with (
        _all_or_nothing(target, list(files.values())),
        folders.claimed(target),
        _unchanged(folder),
        run_json.opened(folder) as run,
    ):
        own = run.get("sha256", {}) if target.resolve() == folder.resolve() else {}
        for path in files.values():
            if path.name in own:
                raise OutputError(
                    "is a file of the result itself, which would count as edited",
                    where=path,
                    remedy="pass another folder with --out",
                )
            if path.exists() and not overwrite:
                raise OutputError(
                    "already exists", where=path, remedy="pass --overwrite to replace it"
                )
        result = _Result(folder, faces, every, pinhole, voxel_m)
        # Images first: only they can be missing after a complete run.
        for name in sorted(files, key=lambda name: FORMATS[name][1] is not _images):
            FORMATS[name][1](result, files[name])
    return list(files.values())


@contextmanager
def _all_or_nothing(folder: Path, files: Sequence[Path]) -> Iterator[None]:
    """Make a folder; if the block fails, remove what it added of these files, and what it made."""
    existed = folder.exists()
    atomic.make_folder(folder)
    before = set(folder.iterdir())
    stems = {path.name.partition(".")[0] for path in files}
    try:
        yield
    except BaseException:
        for path in set(folder.iterdir()) - before:
            if path.name.partition(".")[0] in stems:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        if not existed:
            with suppress(OSError):
                folder.rmdir()
        raise


@contextmanager
def _unchanged(folder: Path) -> Iterator[None]:
    """Raise an error if a run replaced the result while the block read it.

    The result itself is not locked: it may be read-only.
    """
    before = stamps.stamp(folder / folders.RESULT.marker)
    yield
    if not folders.is_result(folder) or stamps.stamp(folder / folders.RESULT.marker) != before:
        raise InputError(
            "was replaced by another run while it was read",
            where=folder,
            remedy="export it again with --overwrite",
        )
