"""Readers of clouds: PLY, PCD (organised ones become images), plain text, and slam6D scans."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.cameras import Camera
from tofuse.engine.errors import InputError
from tofuse.engine.frames import CloudFrame, Frame
from tofuse.engine.fusion import GeometryRecord
from tofuse.engine.geometry import se3
from tofuse.engine.parts import part
from tofuse.formats.files import reading, tables
from tofuse.formats.geometry import read_pcd
from tofuse.formats.sources import cloud_files, inputs, organised


@part("reader", "ply", label="validated")
class PlyClouds(cloud_files.CloudReader):
    """A .ply file, or a folder of them; metres."""

    suffixes = (".ply",)

    def source(self, path: Path, files: list[Path]) -> cloud_files.CloudFileSource:
        """See `CloudReader.source`."""
        return cloud_files.CloudFileSource(path, files, cloud_files.ply_frame, deproject=True)


@part("reader", "pcd", label="validated")
class PcdClouds(cloud_files.CloudReader):
    """A .pcd file, or a folder of them; images if organised; metres."""

    suffixes = (".pcd",)

    def source(self, path: Path, files: list[Path]) -> cloud_files.CloudFileSource:
        """See `CloudReader.source`."""
        camera = _camera(files)
        if camera is None:
            return cloud_files.CloudFileSource(path, files, pcd_cloud, deproject=True)
        source = cloud_files.CloudFileSource(
            path, files, lambda file, index, time: pcd_image(file, index, time, camera)
        )
        source.metadata["depth_kind"] = "z"
        return source


def pcd_cloud(path: Path, index: int, timestamp: float) -> CloudFrame:
    """Read a file as a cloud; its viewpoint is the sensor's position."""
    pcd = read_pcd(path)
    return cloud_files.cloud_frame(index, timestamp, pcd.cloud, origin=pcd.viewpoint[:3])


def pcd_image(path: Path, index: int, timestamp: float, camera: Camera) -> Frame:
    """Read an organised file as an image of `camera`; see `organised_frame`."""
    pcd = read_pcd(path)
    return organised.organised_frame(
        cloud_files.to_float32(pcd.image), pcd.cloud, camera, index, timestamp
    )


def _camera(files: list[Path]) -> Camera | None:
    """Return the camera of organised files, from up to `SAMPLES` readable ones; or None."""
    images: list[Float32] = []
    for file, pcd in organised.samples(len(files), lambda k: (files[k], read_pcd(files[k]))):
        if not pcd.organised or pcd.viewpoint[:3].any():
            return None
        images.append(cloud_files.to_float32(pcd.image))
        points, size = images[-1].reshape(-1, 3), f"WIDTH {pcd.width} and HEIGHT {pcd.height}"
        fits, fits_turned = (organised.find_raster(points, n) for n in (pcd.width, pcd.height))
        if fits is None and fits_turned is not None:
            raise InputError(
                f"has {size}, but rows of {pcd.height} points",
                where=file,
                remedy="swap WIDTH and HEIGHT",
            )
    return organised.common_camera(images)


_TRIPLES = ("nx", "ny", "nz"), ("r", "g", "b"), ("red", "green", "blue")
_AMPLITUDES = "intensity", "amplitude", "reflectance", "i"
_HEAD_LINES = 8
_SUFFIXES = (".xyz", ".xyzn", ".xyzrgb", ".asc", ".pts")


@part("reader", "xyz")
class XyzClouds(cloud_files.CloudReader):
    """A .xyz, .xyzn, .xyzrgb, .asc or .pts file, or a folder of them; metres.

    A line before the numbers that names x, y and z tells the columns. Without one the fourth of
    four is an amplitude, and columns four to six (of seven in .pts, after the intensity, five to
    seven) normals or colours. Three columns are normals in .xyzn, and where all have length 1;
    colours in .xyzrgb (0 to 1), and where all are integers up to 255. Others are ignored.
    """

    suffixes = _SUFFIXES

    def source(self, path: Path, files: list[Path]) -> cloud_files.CloudFileSource:
        """See `CloudReader.source`."""
        return cloud_files.CloudFileSource(path, files, xyz_frame, deproject=True)


def xyz_frame(path: Path, index: int, timestamp: float) -> CloudFrame:
    """Read one file: lines of numbers, maybe after their count, names of columns and comments."""
    text = reading.read_text(path)
    skip, names = _head(text, path)
    table = tables.parse_numbers(text, path, skip=skip)
    if table.shape[1] < 3:
        raise InputError(
            f"has {quantities.count(table.shape[1], 'number')} per line",
            where=path,
            remedy="write x y z",
        )
    points, triples, scalars = table[:, :3], [], _fourth(table)
    named: dict[str, Float64] = {}
    for name, column in zip(names, table.T, strict=False):
        named.setdefault(name, column)
    if len(names) >= table.shape[1] and set("xyz") <= named.keys():
        # In the order of the file: surveyors' y and x, east and north, are right-handed so.
        points = np.stack([column for name, column in named.items() if name in "xyz"], 1)
        triples = [
            np.stack([named[name] for name in triple], 1)
            for triple in _TRIPLES
            if set(triple) <= named.keys()
        ]
        amplitude = next((named[name] for name in _AMPLITUDES if name in named), None)
        scalars = {} if amplitude is None else {"amplitude": cloud_files.to_float32(amplitude)}
    elif table.shape[1] >= 6:
        first = 4 if path.suffix.lower() == ".pts" and table.shape[1] == 7 else 3
        triples = [table[:, first : first + 3]]
    normals = color = None
    for columns in triples:
        if path.suffix.lower() == ".xyzrgb":
            color = np.clip(np.rint(np.nan_to_num(columns) * 255), 0, 255).astype(np.uint8)
        elif path.suffix.lower() == ".xyzn" or _are_unit(columns):
            normals = cloud_files.to_float32(columns)
        elif ((columns >= 0) & (columns <= 255) & (columns == np.rint(columns))).all():
            color = columns.astype(np.uint8)
    cloud = GeometryRecord(points, None, normals, color, scalars=scalars)
    return cloud_files.cloud_frame(index, timestamp, cloud)


def _head(text: str, path: Path) -> tuple[int, list[str]]:
    """The number of lines before those of numbers, and the names in the last one that is text.

    The names are in small letters and without units. Columns with names that are not x, y and z,
    such as an identifier, northing and easting, could be in any order.
    """
    names: list[str] = []
    is_comment = False
    lines = tables.plain_nan("\n".join(text.split("\n", _HEAD_LINES)[:_HEAD_LINES])).split("\n")
    for k, line in enumerate(lines):
        cells = re.split(r"[\s,;]+", line.strip("#/,; \t\r"))
        if _is_number(cells[0]) and len(cells) > 1:
            if len(names) == len(cells) and not is_comment and not set("xyz") <= set(names):
                raise InputError(
                    f"names its columns {', '.join(names)}",
                    where=path,
                    remedy="call those of the coordinates x, y and z in that line",
                )
            return k, names
        if cells[0] and not _is_number(cells[0]):
            is_comment = line.lstrip()[0] in "#/;"
            names = [re.sub(r"\W.*|_m$", "", cell.strip('"').lower()) for cell in cells]
    return 1, names


def _is_number(cell: str) -> bool:
    with suppress(ValueError):
        float(cell)
        return True
    return False


def _fourth(table: Float64) -> dict[str, Float32]:
    """The last column of four, which is an amplitude."""
    four = table.shape[1] == 4
    return {"amplitude": cloud_files.to_float32(table[:, 3])} if four else {}


def _are_unit(vectors: Float64) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):
        return bool((np.abs(np.sqrt((vectors**2).sum(1)) - 1) < 1e-3).all())


# x right, y up, z forward, left-handed, cm; negating y gives the camera's convention.
FLIP = np.diag([1.0, -1.0, 1.0])
CENTIMETRE = 0.01


@part("reader", "slam6d", label="validated")
class Slam6d(cloud_files.CloudReader):
    """3DTK, slam6D: a folder of scanNNN.3d with scanNNN.pose."""

    suffixes = (".3d",)

    def source(self, path: Path, files: list[Path]) -> cloud_files.CloudFileSource:
        """See `CloudReader.source`."""
        source = cloud_files.CloudFileSource(path, files, scan_frame)
        poses = inputs.poses_from_files(
            source, [file.with_suffix(".pose") for file in files], read_pose
        )
        if poses is not None:
            source.odometry = poses
            if source.reference is None:
                source.reference = poses
                source.warnings.append(
                    "the .pose files are the robot's odometry: a reference, but not ground truth"
                )
        return source


def scan_frame(path: Path, index: int, timestamp: float) -> CloudFrame:
    """Read one scan: lines of x y z [reflectance ...], optionally after a line with their count."""
    text = reading.read_text(path)
    first = text.split("\n", 1)[0].split()
    table = tables.parse_numbers(text, path, skip=int(len(first) == 1))
    if table.shape[1] < 3:
        raise InputError(f"has {quantities.count(table.shape[1], 'number')} per line", where=path)
    with np.errstate(over="ignore"):
        points = table[:, :3] * np.diag(FLIP) * CENTIMETRE
    # The scanner writes (0, 0, 0) for missing measurements.
    points[(points == 0).all(1)] = np.nan
    cloud = GeometryRecord(points, scalars=_fourth(table))
    return cloud_files.cloud_frame(index, timestamp, cloud)


def read_pose(path: Path) -> Float64:
    """Return T_world_scan (4, 4) of a .pose: cm and Euler angles in degrees, left-handed."""
    numbers = tables.read_numbers(path).ravel()
    if len(numbers) != 6 or not np.isfinite(numbers).all():
        raise InputError(
            f"has {quantities.count(len(numbers), 'number')}",
            where=path,
            remedy="write x y z and three angles",
        )
    (sx, sy, sz), (cx, cy, cz) = np.sin(np.radians(numbers[3:])), np.cos(np.radians(numbers[3:]))
    # Rx Ry Rz, as EulerToMatrix4 of 3DTK.
    R = np.array(
        [
            [cy * cz, -cy * sz, sy],
            [sx * sy * cz + cx * sz, -sx * sy * sz + cx * cz, -sx * cy],
            [-cx * sy * cz + sx * sz, cx * sy * sz + sx * cz, cx * cy],
        ]
    )
    return se3.pose(FLIP @ R @ FLIP, FLIP @ numbers[:3] * CENTIMETRE)
