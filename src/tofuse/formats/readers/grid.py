"""Reader of organised clouds (one point per pixel), as exported by ToF viewers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine import quantities
from tofuse.engine.arrays import Float32
from tofuse.engine.cameras import Camera
from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame
from tofuse.engine.fusion import GeometryRecord
from tofuse.engine.geometry import se3
from tofuse.engine.parts import part
from tofuse.formats.files import reading, tables
from tofuse.formats.geometry import read_pcd, read_ply
from tofuse.formats.sources import Reader, ReaderOptions, Sniff, cloud_files, inputs, organised

_SUFFIXES = (".ply", ".csv", ".pcd")
_AMPLITUDES = ("intensity", "amplitude", "i")
MAX_POINTS = 1 << 22
# Mean distances of ToF cameras are below 50 m and above 50 mm.
MM_FROM = 50.0
# Unorganised points: largest distance from the pixel's ray (px), and min fraction within it.
_MAX_RAY_DISTANCE_PX, _MIN_ON_RAYS = 0.3, 0.8


@part("reader", "grid")
class Grid(Reader):
    """Helios, blaze, pmd: a folder of .ply, .csv or .pcd, one point per pixel; m or mm."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        try:
            files = inputs.files_at(path, *_SUFFIXES)
            if not files or (reading.is_folder(path) and reading.is_file(path / "run.json")):
                return None
            status = files[0].stat()
            raster = _first_raster(files[0], status.st_mtime_ns, status.st_size)
        except (InputError, OSError):
            return None
        if raster is None:
            return None
        return Sniff(1.0, f"{len(files)} clouds of {raster.width} x {raster.height} pixels")

    def open(self, path: Path, options: ReaderOptions) -> cloud_files.CloudFileSource:
        """See `Reader.open`."""
        inputs.refuse_camera(options, "grid")
        files = cloud_files.required_files(path, *_SUFFIXES)
        images: list[Float32] = []
        raster: organised.Raster | None = None
        for cells in organised.samples(len(files), lambda k: read_cells(files[k])):
            raster = raster or cells.raster()
            if raster is not None and len(cells.points) == raster.width * raster.height:
                images.append(raster.image(cells.points))
        if raster is None or not images:
            raise _not_organised(path)
        scale = 1e-3 if _median_z(images[0]) > MM_FROM else 1.0
        images = [image * np.float32(scale) for image in images]
        offset, camera = 0.0, organised.common_camera(images)
        if camera is None:
            offset = organised.ray_origin_offset(images)
            camera = organised.common_camera([_shifted(image, offset) for image in images])
        if camera is None:
            raise _not_organised(path)
        frames = _Frames(raster, camera, scale, offset)
        source = cloud_files.CloudFileSource(path, files, frames.load)
        source.metadata |= {"depth_kind": "z"}
        if offset:
            source.warnings.append(
                f"the origin is {1000 * offset:.1f} mm in front of the camera's centre of "
                "projection; points are shifted to the centre"
            )
        if raster.reversed_axes:
            source.warnings.append(f"{raster.reversed_axes} against the pixels, and reversed")
        return source


@dataclass(frozen=True, eq=False)
class Cells:
    """A cloud in the file's unit, with NaN for invalid points, and its width, if stated."""

    cloud: GeometryRecord
    width: int | None = None

    @property
    def points(self) -> Float32:
        """(N, 3)."""
        return cloud_files.to_float32(self.cloud.points)

    def raster(self) -> organised.Raster | None:
        """See `find_raster`."""
        few = len(self.points) <= MAX_POINTS
        return organised.find_raster(self.points, self.width) if few else None


def read_cells(path: Path) -> Cells:
    """Read a file, with NaN for invalid points; raise InputError if it can't be read."""
    suffix, width = path.suffix.lower(), None
    if suffix == ".pcd":
        pcd = read_pcd(path)
        cloud, width = pcd.cloud, pcd.width if pcd.organised else None
    elif suffix == ".ply":
        cloud = read_ply(path)
        declared = dict(line.split(None, 1) for line in cloud.comments if len(line.split()) == 2)
        stated = declared.get("num_cols", "")
        width = int(stated) if stated.isdecimal() else None
    else:
        cloud = _read_csv(path)
    points = cloud_files.to_float32(cloud.points)
    plausible = (np.abs(points) < se3.MAX_COORDINATE_M).all(1, keepdims=True)
    points = np.where(plausible, points, np.float32(np.nan))
    return Cells(replace(cloud, points=points, normals=None), width)


def _read_csv(path: Path) -> GeometryRecord:
    text = reading.read_text(path)
    head = text[: text.find("\n")].lower().replace(";", ",").replace("\t", ",")
    names = [cell.strip(' "#').split("[")[0].split("(")[0].strip() for cell in head.split(",")]
    has_header = {"x", "y", "z"} <= set(names)
    table = tables.parse_numbers(text, path, skip=int(has_header))
    if table.ndim != 2 or table.shape[1] < 3:
        raise InputError("has no x, y and z per line", where=path, remedy="export x, y, z")
    columns = {n: k for k, n in enumerate(names) if k < table.shape[1]} if has_header else {}
    indices = [columns.get(name, k) for k, name in enumerate("xyz")]
    column = next((columns[name] for name in _AMPLITUDES if name in columns), None)
    if not has_header and table.shape[1] == 4:
        column = 3
    scalars = {} if column is None else {"amplitude": cloud_files.to_float32(table[:, column])}
    return GeometryRecord(table[:, indices], scalars=scalars)


@dataclass(frozen=True, eq=False)
class _Frames:
    """Converts the points of each file to an image."""

    raster: organised.Raster
    camera: Camera
    scale: float
    offset: float

    def load(self, path: Path, index: int, timestamp: float) -> RangeFrame:
        cells = read_cells(path)
        cloud = cells.cloud
        complete = len(cells.points) == self.raster.width * self.raster.height
        points = self.raster.image(cells.points) if complete else cells.points
        points = _shifted(points * np.float32(self.scale), self.offset)
        if not complete:
            points, cloud = self._to_pixels(points, cloud)
        return organised.organised_frame(points, cloud, self.camera, index, timestamp)

    def _to_pixels(self, points: Float32, cloud: GeometryRecord) -> tuple[Float32, GeometryRecord]:
        """Assign points (n, 3), of a file without invalid ones, to pixels by their rays."""
        from scipy.spatial import cKDTree

        rays = self.camera.rays().reshape(-1, 2)
        has_ray = np.flatnonzero(np.isfinite(rays).all(-1))
        measured = np.flatnonzero(np.isfinite(points).all(-1) & (points[:, 2] > 0))
        distance, nearest = cKDTree(rays[has_ray]).query(
            points[measured, :2] / points[measured, 2:]
        )
        count = self.raster.width * self.raster.height
        step = float(np.ptp(rays[has_ray], axis=0).max()) / max(
            self.raster.width, self.raster.height
        )
        # Pixels without a measurement in the sampled files have no ray.
        on_ray = distance < _MAX_RAY_DISTANCE_PX * step
        pixel, measured = has_ray[nearest[on_ray]], measured[on_ray]
        if (
            len(points) > count
            or len(np.unique(pixel)) < len(pixel)
            or np.count_nonzero(on_ray) < _MIN_ON_RAYS * len(on_ray)
        ):
            raise InputError(
                f"has {quantities.count(len(points), 'point')}, "
                f"not {self.raster.width} x {self.raster.height}, "
                "and they are not on the rays of the previous files",
                remedy="export all points, including invalid ones",
            )
        image = np.full((count, 3), np.nan, np.float32)
        image[pixel] = points[measured]

        def arranged(values: NDArray[Any] | None) -> Any:
            if values is None:
                return None
            out = np.zeros((count, *values.shape[1:]), values.dtype)
            out[pixel] = values[measured]
            return out

        amplitude = arranged(cloud.amplitude)
        scalars = {} if amplitude is None else {"amplitude": amplitude}
        out = GeometryRecord(image, color=arranged(cloud.color), scalars=scalars)
        return image.reshape(self.raster.height, self.raster.width, 3), out


def _shifted(points: Float32, offset: float) -> Float32:
    """Points (..., 3) relative to an origin `offset` metres farther back; keeps invalid ones."""
    z = np.where(points[..., 2] > 0, points[..., 2] + np.float32(offset), points[..., 2])
    return np.concatenate([points[..., :2], z[..., None]], axis=-1)


def _median_z(image: Float32) -> float:
    z = image[..., 2]
    z = z[np.isfinite(z) & (z > 0)]
    return float(np.median(z)) if len(z) else 0.0


def _not_organised(path: Path) -> InputError:
    return InputError(
        "doesn't contain one point per pixel of a camera",
        where=path,
        remedy="export all points, including invalid ones, or use --format ply, pcd or xyz",
    )


@lru_cache(maxsize=4)
def _first_raster(file: Path, changed_ns: int, size: int) -> organised.Raster | None:
    """The raster of a file's points; None if there is none, or if the reader pcd applies."""
    cells = read_cells(file)
    raster = cells.raster()
    if raster is None:
        return None
    applies = file.suffix.lower() != ".pcd" or _median_z(raster.image(cells.points)) > MM_FROM
    return raster if applies else None
