"""Sources for readers: files, depth images, colour, pose files, joined recordings, depth limits."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Bool, Float32, Float64, Intp, UInt8
from tofuse.engine.cameras import Camera, Pinhole
from tofuse.engine.errors import InputError, UnreadableFrameError
from tofuse.engine.frames import (
    AmplitudeKind,
    CloudFrame,
    DepthKind,
    Frame,
    RangeFrame,
    Source,
    depth_counts,
)
from tofuse.engine.geometry import se3
from tofuse.formats.files import input_error, is_file, read_numbers
from tofuse.formats.geometry import read_ply
from tofuse.formats.images import check_first_size, read_color, read_image
from tofuse.formats.poses import associated_poses, read_tum
from tofuse.formats.recordings.camera_file import CameraFile, ColorCamera, check_size, load_camera
from tofuse.formats.recordings.reader import ReaderOptions

T = TypeVar("T")


class FileSource(ABC):
    """A source whose frames are files; an error in one of them affects only its frame.

    Attributes
    ----------
    concurrent
        Whether several threads can read frames concurrently: `load` has no side effects.
    camera, unit, kind, amplitude_kind, ambiguity_m
        Of depth images: the common camera, metres per count, and those of `RangeFrame`.
    color_camera
        None if colour is registered to depth, or there is none.
    """

    concurrent = False
    camera: Camera
    unit: float = 0.001
    kind: DepthKind = "z"
    amplitude_kind: AmplitudeKind = "raw"
    ambiguity_m: float | None = None
    color_camera: ColorCamera | None = None

    def __init__(self, timestamps: Float64) -> None:
        self.timestamps = timestamps
        self.reference: Float64 | None = None
        self.odometry: Float64 | None = None
        self.gravity: Float64 | None = None
        self.warnings: list[str] = []
        self.metadata: dict[str, Any] = {}

    @abstractmethod
    def load(self, index: int) -> Frame:
        """Read frame `index`; raise InputError if it can't be read."""

    def use_camera(self, path: Path, size: tuple[int, int] | None = None) -> CameraFile:
        """Take camera, unit and kind of depth from a camera.json; see `load_camera`."""
        description, self.camera = load_camera(path, size)
        self.unit, self.kind = description.depth_unit_m, description.depth_kind
        self.color_camera = description.color or self.color_camera
        return description

    def image(self, index: int, depth: Float32, **others: Any) -> RangeFrame:
        """Return frame `index` with this depth and other attributes of `RangeFrame` by name."""
        common = {
            "camera": self.camera if "camera" not in others else None,
            "depth_kind": self.kind,
            "amplitude_kind": self.amplitude_kind,
            "ambiguity_m": self.ambiguity_m,
        }
        time = float(self.timestamps[index])
        return RangeFrame(index=index, timestamp=time, depth=depth, **(common | others))

    def full_resolution_color(self, index: int) -> UInt8 | None:
        """Return the colour of a frame at its recorded resolution, if it has the view of depth.

        (H, W, 3) RGB, or None if there is none. Raise InputError if it can't be read.
        """
        return None

    def read_sidecars(self, folder: Path) -> None:
        """Read timestamps.txt, groundtruth.txt and odometry.txt, as far as the folder has them."""
        path = folder / "timestamps.txt"
        if is_file(path):
            self.timestamps = _read_timestamps(path, len(self.timestamps), self.warnings)
        if is_file(folder / "groundtruth.txt"):
            self.reference = tum_poses(self, folder / "groundtruth.txt")
        if is_file(folder / "odometry.txt"):
            self.odometry = tum_poses(self, folder / "odometry.txt")

    def note_missing_color(self, color: Sequence[object]) -> None:
        """Warn if some of the frames have no colour: None in `color`."""
        colored = sum(item is not None for item in color)
        if 0 < colored < len(color):
            self.warnings.append(f"only {colored} of {len(color)} frames have colour")

    def read(self, index: int) -> Frame:
        """See `Source.read`."""
        try:
            return self.load(index)
        except UnreadableFrameError:
            raise
        except InputError as error:
            raise UnreadableFrameError(
                error.problem, where=error.where, remedy=error.remedy
            ) from error
        except MemoryError as error:
            raise UnreadableFrameError("needs more memory than is available") from error


def tum_poses(source: FileSource, path: Path) -> Float64:
    """Return (N, 4, 4) poses of a TUM file at the source's timestamps, NaN without a match."""
    times, poses = read_tum(path)
    out = associated_poses(source.timestamps, times, poses)
    posed = int(np.isfinite(out[:, 0, 0]).sum())
    if posed < len(out):
        source.warnings.append(
            f"{path}: {posed} of {len(out)} frames have a pose within 0.02 s of their timestamp"
        )
    return out


def poses_of(
    source: FileSource, items: Iterable[T], read: Callable[[T], Float64 | None]
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
        source.warnings.append(f"{len(errors)} poses can't be read, the first: {errors[0]}")
    return np.stack(poses) if np.isfinite(poses).any() else None


def poses_from_files(
    source: FileSource, files: Iterable[Path], read: Callable[[Path], Float64]
) -> Float64 | None:
    """Return the poses of one file per frame, which may be missing; see `poses_of`."""
    return poses_of(source, files, lambda path: read(path) if is_file(path) else None)


def read_matrix_pose(table: Float64, where: str) -> Float64:
    """Check a (4, 4) pose of a file, and orthonormalise its rotation.

    Non-finite entries, which trackers write where they are lost, give NaN.
    """
    if table.shape != (4, 4):
        raise InputError(
            f"has {table.shape[0]} rows of {table.shape[-1]} numbers",
            where=where,
            remedy="write the pose as four rows of four numbers",
        )
    if not np.isfinite(table).all():
        return np.full((4, 4), np.nan)
    return se3.orthonormalise(se3.check_pose(table, where=where))


def _read_timestamps(path: Path, count: int, warnings: list[str]) -> Float64:
    """Read a timestamps.txt: (N,) seconds for `count` frames."""
    table = read_numbers(path)
    if table.shape != (count, 1):
        raise InputError(
            f"has {len(table)} lines of {table.shape[-1]} numbers for {count} frames",
            where=path,
            remedy="use one time in seconds for each frame, or remove it",
        )
    times = table[:, 0]
    check_timestamps(times, path, warnings)
    return times


def read_part(path: Path, offset: int, size: int) -> bytes:
    """Return up to `size` bytes of a file from an offset; InputError if it can't be read."""
    try:
        with path.open("rb") as file:
            file.seek(offset)
            return file.read(size)
    except OSError as error:
        raise input_error(error, path) from error


@contextmanager
def library_errors(where: str | Path, remedy: str = "copy the file again") -> Iterator[None]:
    """Turn any exception of a library that reads a damaged file into an InputError."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        line = " ".join(str(error).split())[:200]
        raise InputError(
            f"can't be read ({type(error).__name__}: {line})", where=where, remedy=remedy
        ) from error


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
    """Return timestamps (N,) of frames, some of them finite, with the others interpolated."""
    known, index = np.isfinite(times), np.arange(len(times))
    return np.where(known, times, np.interp(index, index[known], times[known]))


def ply_frame(path: Path, index: int, timestamp: float, shift: Float64 | None = None) -> CloudFrame:
    """Read a PLY cloud; non-finite points are dropped, and `shift` (3,) in m is subtracted."""
    ply = read_ply(path)
    with np.errstate(invalid="ignore"):  # signalling NaN
        points = to_float32(ply.points) if shift is None else ply.points.astype(np.float64)
    return cloud_frame(
        index,
        timestamp,
        points,
        ply.normals,
        amplitude=ply.amplitude,
        color=ply.color,
        shift=shift,
    )


def finite_float32(values: NDArray[Any]) -> Float32:
    """Return numbers of a file as float32, 0 where they are not finite."""
    with np.errstate(all="ignore"):
        return np.nan_to_num(values.astype(np.float32), posinf=0, neginf=0)


def to_float32(values: NDArray[Any]) -> Float32:
    """Return numbers of a file as float32: infinite beyond its range, NaN for signalling NaN."""
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(np.float32, copy=False)


def cloud_frame(
    index: int,
    timestamp: float,
    points: NDArray[np.floating],
    normals: Float32 | None = None,
    *,
    amplitude: Float32 | None = None,
    color: UInt8 | None = None,
    origin: Float64 | None = None,
    shift: Float64 | None = None,
) -> CloudFrame:
    """Return a cloud of (N, 3) points in m with columns (N, ...), without invalid points.

    `shift` (3,) is subtracted from the points, in their own precision, and from the `origin` (3,).
    """
    # False for NaN; the squares of the remaining coordinates fit into float32.
    measured = np.asarray((np.abs(points) < se3.MAX_COORDINATE_M).all(1))
    if shift is not None:
        with np.errstate(over="ignore", invalid="ignore"):
            points = points - shift
        measured &= (np.abs(points) < se3.MAX_COORDINATE_M).all(1)
        origin = None if origin is None else origin - shift
    if not measured.all():
        points = np.where(measured[:, None], points, 0)
    frame = CloudFrame(
        index,
        timestamp,
        to_float32(points),
        normals,
        amplitude=amplitude,
        color=color,
        origin=np.zeros(3) if origin is None else origin,
    )
    return frame if measured.all() else frame.keep(measured)


class JoinedSource:
    """Several sources in sequence."""

    def __init__(self, parts: Sequence[Source], names: Sequence[str]) -> None:
        self.parts = list(parts)
        self.concurrent = all(getattr(p, "concurrent", False) for p in self.parts)
        counts = [len(p.timestamps) for p in self.parts]
        self.starts = np.concatenate([[0], np.cumsum(counts)]).astype(int)
        self.warnings = _joined_warnings(self.parts, names)
        self.timestamps = self._joined_times(names)
        self.reference = _joined([p.reference for p in self.parts], counts, (4, 4))
        self.odometry = _joined([p.odometry for p in self.parts], counts, (4, 4))
        self.gravity = _joined([p.gravity for p in self.parts], counts, (4,))
        self.metadata: dict[str, Any] = dict(self.parts[0].metadata)
        for part in self.parts[1:]:
            # Only values common to all parts.
            self.metadata = {
                key: value
                for key, value in self.metadata.items()
                if key in part.metadata and part.metadata[key] == value
            }
        self.metadata["parts"] = [
            {"name": name, "frames": count} for name, count in zip(names, counts, strict=True)
        ]

    def _joined_times(self, names: Sequence[str]) -> Float64:
        times: list[Float64] = []
        for part, name in zip(self.parts, names, strict=True):
            part_times = part.timestamps
            last = max((float(t.max()) for t in times), default=-np.inf)
            if part_times.min() <= last:
                steps = np.diff(part_times)
                step = float(np.median(steps)) if len(steps) else 1.0
                shift = last + max(step, 1e-3) - float(part_times.min())
                part_times = part_times + shift
                self.warnings.append(f"{name}: timestamps start again, shifted by {shift:.6g} s")
            times.append(part_times)
        return np.concatenate(times)

    def read(self, index: int) -> Frame:
        """See `Source.read`."""
        part = int(np.searchsorted(self.starts, index, side="right")) - 1
        frame = self.parts[part].read(index - int(self.starts[part]))
        return replace(frame, index=index, timestamp=float(self.timestamps[index]))


def _joined_warnings(parts: Sequence[Source], names: Sequence[str]) -> list[str]:
    """The parts' warnings, each once, naming the part where they differ."""
    lines: dict[str, list[str]] = {}
    for part, name in zip(parts, names, strict=True):
        for line in part.warnings:
            lines.setdefault(line, []).append(name)
    return [
        line if len(where) == len(parts) or where[0] in line else f"{', '.join(where)}: {line}"
        for line, where in lines.items()
    ]


def _joined(
    arrays: Sequence[Float64 | None], counts: Sequence[int], shape: tuple[int, ...]
) -> Float64 | None:
    if all(array is None for array in arrays):
        return None
    parts = zip(arrays, counts, strict=True)
    return np.concatenate(
        [np.full((n, *shape), np.nan) if array is None else array for array, n in parts]
    )


class LimitedSource:
    """A source restricted to points between two depths in m: z of images, distance in clouds."""

    def __init__(self, source: Source, min_depth: float, max_depth: float) -> None:
        self.source, self.min_depth, self.max_depth = source, min_depth, max_depth
        self.concurrent = getattr(source, "concurrent", False)
        self.timestamps = source.timestamps
        self.reference = source.reference
        self.odometry = source.odometry
        self.gravity = source.gravity
        self.warnings = source.warnings
        self.metadata = source.metadata

    def read(self, index: int) -> Frame:
        """See `Source.read`."""
        frame = self.source.read(index)
        if isinstance(frame, RangeFrame):
            return frame.keep((frame.z >= self.min_depth) & (frame.z <= self.max_depth))
        distance = np.linalg.norm(frame.points - frame.origin, axis=1)
        return frame.keep((distance >= self.min_depth) & (distance <= self.max_depth))


# A point is occluded if another one in its cell is nearer by more than this fraction.
OCCLUSION_FRACTION = 0.05


def sampled_color(
    frame: RangeFrame, image: UInt8, color: ColorCamera | None, where: str | Path
) -> UInt8:
    """Return the colour (H, W, 3) of the depth pixels, by projecting their points into an image.

    Black where the point is outside of the colour image, or occluded there by a nearer surface that
    the depth camera observes too. Without a colour camera (None) the image has the pixels of depth.

    Raises
    ------
    InputError
        Naming `where`, if the image does not have the size of its camera.
    """
    check_size(image, frame.camera if color is None else color.camera, where)
    if color is None:
        return image
    T = color.T_color_depth
    points = frame.points @ T[:3, :3].T + T[:3, 3]
    uv = color.camera.project(points)
    with np.errstate(invalid="ignore"):
        pixel = np.nan_to_num(np.rint(uv), nan=-1.0, posinf=-1.0, neginf=-1.0)
    u, v = np.clip(pixel, -1, 1 << 20).astype(np.intp).T
    inside = (u >= 0) & (v >= 0) & (u < image.shape[1]) & (v < image.shape[0])
    cell = _cell(frame, color)
    occluded = _occluded(u[inside] // cell, v[inside] // cell, points[inside, 2])
    inside[inside] = ~occluded
    sampled = np.zeros((len(u), 3), np.uint8)
    sampled[inside] = image[v[inside], u[inside]]
    out = np.zeros((*frame.depth.shape, 3), np.uint8)
    out[frame.valid] = sampled
    return out


def _cell(frame: RangeFrame, color: ColorCamera) -> int:
    """Size in colour pixels of cells that each contain points of a continuous surface."""
    rays = frame.camera.rays()
    pitch = float(np.nanmedian(np.abs(np.diff(rays[..., 0], axis=1))))
    return max(1, int(np.ceil(2 * pitch * color.camera.fx)))


def _occluded(u: Intp, v: Intp, z: Float64) -> Bool:
    """Whether each point is behind the nearest one of its cell."""
    if len(z) == 0:
        return np.zeros(0, bool)
    nearest = np.full((int(v.max()) + 1, int(u.max()) + 1), np.inf)
    np.minimum.at(nearest, (v, u), z)
    return np.asarray(z > nearest[v, u] * (1 + OCCLUSION_FRACTION))


class DepthImageSource(FileSource):
    """Depth images, with colour images registered to them where given.

    Parameters
    ----------
    files
        16-bit PNGs, one for each frame.
    timestamps
        (N,) seconds.
    camera, depth_unit_m
        Of all frames, unless `options` has a camera.json, which replaces both.
    color
        None, or one image per frame, None where there is none.
    color_registered
        Whether colour is registered to depth.
    sensor
        Name of the camera, unless `options` has a camera.json that names it; empty if unknown.
    options
        Of the reader.

    Raises
    ------
    InputError
        If the camera does not have the size of the images.
    """

    concurrent = True

    def __init__(
        self,
        files: Sequence[Path],
        timestamps: Float64,
        camera: Camera | None,
        depth_unit_m: float,
        *,
        color: Sequence[Path | None] | None = None,
        color_registered: bool = True,
        sensor: str = "",
        options: ReaderOptions | None = None,
    ) -> None:
        super().__init__(timestamps)
        self.files, self.color = list(files), None if color is None else list(color)
        self.color_registered = color_registered
        where = "the camera of this format"
        if options is not None and options.camera is not None:
            sensor = self.use_camera(options.camera).sensor or sensor
            where = str(options.camera)
        elif camera is None:
            raise InputError(
                "has no camera", where=self.files[0].parent, remedy="pass one with --camera"
            )
        else:
            self.camera, self.unit = camera, depth_unit_m
        size = (self.camera.width, self.camera.height)
        self.metadata |= {"depth_unit_m": self.unit, "depth_kind": self.kind}
        if sensor:
            self.metadata["sensor"] = sensor
        self.note_missing_color(self.color or ())
        remedy = "pass the camera of these images with --camera"
        check_first_size(self.files, size, where, remedy)

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        size = (self.camera.width, self.camera.height)
        counts = read_image(self.files[index], size=size, dtype="uint16")
        color = None
        path = None if self.color is None else self.color[index]
        if path is not None:
            color = read_color(path)
            if color.shape[:2] != counts.shape:
                raise InputError(
                    f"is {color.shape[1]} x {color.shape[0]} pixels, depth {size[0]} x {size[1]}",
                    where=path,
                    remedy="register colour to depth, or leave it out",
                )
        depth = depth_counts.depth_from_counts(counts, self.unit)
        return self.image(index, depth, color_image=color, color_registered=self.color_registered)
