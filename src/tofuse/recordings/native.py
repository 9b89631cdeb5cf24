"""The native recording: a folder of PNG images (or PLY clouds), described by a camera.json."""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofuse.arrays import Float32, Float64, UInt16
from tofuse.errors import InputError, OutputError
from tofuse.files.atomic import make_folder, replacing, write_text
from tofuse.files.geometry_record import GeometryRecord
from tofuse.files.images import check_first_size, read_color, read_image, write_png
from tofuse.files.ply import write_ply
from tofuse.files.reading import files_with, is_file, is_folder, list_folder
from tofuse.files.tables import exact, read_columns, read_numbers, write_columns
from tofuse.files.trajectory import write_tum
from tofuse.geometry.cameras import Camera, Pinhole, RayTable, range_from_z, z_from_range
from tofuse.recordings.camera_file import (
    SCHEMA,
    CameraFile,
    camera_fields,
    checked_lens,
    load_camera,
    read_camera_file,
    read_rays,
)
from tofuse.recordings.color import sampled_color
from tofuse.recordings.frames import (
    SATURATED_AMPLITUDE,
    CloudFrame,
    DepthKind,
    Frame,
    RangeFrame,
)
from tofuse.recordings.imu import gravity_at
from tofuse.recordings.sources import FileSource, check_timestamps, ply_frame, tum_poses
from tofuse.sensor.depth_correction import DepthCorrection
from tofuse.sensor.frequencies import DISAGREEMENT, combined
from tofuse.sensor.models import SPEED_OF_LIGHT

INVALID_DEPTH = 65535
MAX_CORRECTION_BYTES = 1 << 30
MAX_COUNTS = 65535
_IMAGES = (".png", ".jpg", ".jpeg")
_LENS = ("fx", "fy", "cx", "cy")


class NativeSource(FileSource):
    """A native folder.

    Attributes
    ----------
    camera
        The camera of all frames; None for clouds.
    description
        Content of camera.json.
    imu
        Columns of imu.csv by name, or None.
    frame_columns
        Columns of frames.csv by name, each (N,), or None.

    Raises
    ------
    InputError
        Naming file and field, if the folder isn't complete and consistent.
    """

    concurrent = True

    def __init__(self, folder: Path, camera_file: Path | None = None) -> None:
        self.folder = folder
        self.is_clouds = not is_folder(folder / "depth") and is_folder(folder / "cloud")
        name, suffixes = ("cloud", (".ply",)) if self.is_clouds else ("depth", (".png",))
        self.files = files_with(folder / name, *suffixes)
        if not self.files:
            raise InputError(
                f"has no {suffixes[0]} files",
                where=folder / name,
                remedy="check that the recording is complete",
            )
        self.description, self.camera = self._read_camera(camera_file)
        rate = self.description.frame_rate_hz
        super().__init__(np.arange(len(self.files)) / (rate or 1.0))
        self._read_timestamps()
        self.amplitude = self._channel("amplitude", ".png")
        self.confidence = self._channel("confidence", ".png")
        self.color = self._channel("color", *_IMAGES)
        self.sigma = self._channel("sigma", ".png")
        self.rays = self._channel("rays", ".npy")
        self.by_frequency = self._frequencies()
        if camera_file is not None:
            self.rays = []  # a given camera applies to all frames
        self.correction = self._read_correction()
        self.imu = self._read_table("imu.csv")
        self.frame_columns = self._read_table("frames.csv", rows=len(self.files))
        self.cameras = self._frame_lenses() if camera_file is None else []
        if self.sigma and self.description.sigma_unit_m is None:
            raise InputError(
                "is missing, and there is sigma/",
                where=f"{self.folder / 'camera.json'}: sigma_unit_m",
                remedy="set the metres per count of sigma",
            )
        if is_file(folder / "groundtruth.txt"):
            self.reference = tum_poses(self, folder / "groundtruth.txt")
        if is_file(folder / "odometry.txt"):
            self.odometry = tum_poses(self, folder / "odometry.txt")
        self._read_gravity()
        self._check_sizes()
        self._fill_metadata()

    def load(self, index: int) -> Frame:
        """See `FileSource.load`."""
        timestamp = float(self.timestamps[index])
        if self.camera is None:
            return ply_frame(self.files[index], index, timestamp)
        size = (self.camera.width, self.camera.height)
        camera = self._camera_of(index, self.camera)
        kind = self.description.depth_kind
        if self.by_frequency:
            depth = self._combined(index, camera, size, kind)
        else:
            counts = read_image(self.files[index], size=size, dtype="uint16")
            depth = depth_from_counts(counts, self.description.depth_unit_m)
        if self.correction is not None:
            depth = corrected_depth(self.correction, camera, depth, kind)
        frame = RangeFrame(index, timestamp, camera, depth, kind)
        amplitude = confidence = color = sigma = None
        if self.amplitude:
            amplitude = read_image(self.amplitude[index], size=size, dtype="uint16")
            amplitude = amplitude.astype(np.float32)
        if self.confidence:
            confidence = read_image(self.confidence[index], size=size, dtype="uint8")
            confidence = confidence.astype(np.uint8, copy=False)
        if self.color:
            path = self.color[index]
            color = sampled_color(frame, read_color(path), self.description.color, path)
        if self.sigma:
            counts = read_image(self.sigma[index], size=size, dtype="uint16")
            sigma = counts.astype(np.float32) * np.float32(self.description.sigma_unit_m or 0)
        return RangeFrame(
            index,
            timestamp,
            camera,
            frame.depth,
            kind,
            amplitude,
            confidence,
            color,
            sigma,
            color_registered=self.description.color_registered,
            amplitude_kind=self.description.amplitude_kind or "raw",
            ambiguity_m=self.description.ambiguity_m,
        )

    def _camera_of(self, index: int, camera: Camera) -> Camera:
        """Return the camera of one frame, where each has its own."""
        if self.cameras:
            own = self.cameras[index]
            if isinstance(own, InputError):
                raise own
            return own
        if not self.rays:
            return camera
        table = read_rays(self.rays[index])
        if (table.width, table.height) != (camera.width, camera.height):
            raise InputError(
                f"is {table.width} x {table.height}, the images {camera.width} x {camera.height}",
                where=self.rays[index],
                remedy="use the table of this frame",
            )
        return table

    def _frame_lenses(self) -> list[Pinhole | InputError]:
        """The lens of each frame, if frames.csv contains fx, fy, cx and cy."""
        columns, camera = self.frame_columns, self.camera
        if columns is None or not isinstance(camera, Pinhole) or not set(_LENS) <= set(columns):
            return []
        cameras: list[Pinhole | InputError] = []
        known: dict[tuple[float, ...], Pinhole] = {}
        for k, row in enumerate(zip(*(columns[name] for name in _LENS), strict=True)):
            try:
                values = {f.name: getattr(camera, f.name) for f in fields(camera)[2:]}
                values |= {name: float(v) for name, v in zip(_LENS, row, strict=True)}
                where = f"{self.folder / 'frames.csv'}, row {k + 1}"
                size = (camera.width, camera.height)
                if row not in known:
                    known[row] = checked_lens(type(camera), size, values, where)
                cameras.append(known[row])
            except InputError as error:
                cameras.append(error)
        return cameras

    def _read_camera(self, given: Path | None) -> tuple[CameraFile, Camera | None]:
        path = self.folder / "camera.json"
        if not self.is_clouds:
            return load_camera(given or path)
        if given is not None:
            raise InputError(
                "does not apply to a recording of clouds", where="--camera", remedy="leave it out"
            )
        if is_file(path):
            return read_camera_file(path, clouds=True), None
        return CameraFile(None, None), None

    def _read_timestamps(self) -> None:
        path = self.folder / "timestamps.txt"
        if not is_file(path):
            return
        table = read_numbers(path)
        if len(table) != len(self.files):
            raise self._count_error(path, f"{len(table)} lines")
        if table.shape[1] != 1:
            raise InputError(
                f"has {table.shape[1]} numbers per line", where=path, remedy="use one, in seconds"
            )
        self.timestamps = table[:, 0]
        check_timestamps(self.timestamps, path, self.warnings)

    def _channel(self, name: str, *suffixes: str) -> list[Path]:
        folder = self.folder / name
        if self.is_clouds or not is_folder(folder):
            return []
        files = files_with(folder, *suffixes)
        if len(files) != len(self.files):
            raise self._count_error(folder, f"{len(files)} images")
        if [f.stem for f in files] != [f.stem for f in self.files]:
            self.warnings.append(f"{folder}: names differ from those in depth/; paired in order")
        return files

    def _frequencies(self) -> dict[float, list[Path]]:
        """The depth images by modulation frequency in Hz, if several were recorded separately."""
        folder = self.folder / "frequencies"
        if self.is_clouds or not is_folder(folder):
            return {}
        images: dict[float, list[Path]] = {}
        for part in list_folder(folder):
            try:
                hertz = float(part.name)
            except ValueError:
                hertz = math.nan
            if not 1e5 <= hertz <= 1e10 or not is_folder(part):
                raise InputError(
                    "isn't a frequency", where=part, remedy="name the folder in Hz, as 30000000"
                )
            images[hertz] = files_with(part, ".png")
            if len(images[hertz]) != len(self.files):
                raise self._count_error(part, f"{len(images[hertz])} images")
        if len(images) == 1:
            raise InputError(
                "has only one frequency", where=folder, remedy="use two or more, or remove it"
            )
        return images

    def _combined(
        self, index: int, camera: Camera, size: tuple[int, int], kind: DepthKind
    ) -> Float32:
        """The depth that is consistent with all frequencies; 0 where there is none."""
        unit = self.description.depth_unit_m
        periods = [SPEED_OF_LIGHT / (2 * hertz) for hertz in self.by_frequency]
        ranges = []
        for files in self.by_frequency.values():
            counts = read_image(files[index], size=size, dtype="uint16")
            depth = depth_from_counts(counts, unit)
            ranges.append(depth if kind == "range" else range_from_z(camera, depth))
        radial, apart = combined(ranges, periods)
        agreed = np.where(apart < DISAGREEMENT * min(periods), radial, np.float32(0))
        return agreed if kind == "range" else z_from_range(camera, agreed)

    def _read_correction(self) -> DepthCorrection | None:
        path = self.folder / "correction.npz"
        if self.camera is None or not is_file(path):
            return None
        correction = read_correction(path)
        try:
            correction.correct(np.ones((self.camera.height, self.camera.width), np.float32))
        except InputError as error:
            raise InputError(error.problem, where=path, remedy=error.remedy) from error
        return correction

    def _read_table(self, name: str, rows: int | None = None) -> dict[str, Float64] | None:
        path = self.folder / name
        if not is_file(path):
            return None
        columns = read_columns(path)
        length = len(next(iter(columns.values())))
        if rows is not None and length != rows:
            raise self._count_error(path, f"{length} rows")
        return columns

    def _read_gravity(self) -> None:
        if self.imu is None:
            return
        self.gravity = gravity_at(self.timestamps, self.imu)
        path = self.folder / "imu.csv"
        if self.gravity is None:
            self.warnings.append(
                f"{path}: has no columns timestamp, ax, ay, az, so gravity is unknown"
            )
        elif not np.isfinite(self.gravity).any():
            self.warnings.append(f"{path}: has no samples near the time of any frame")

    def _count_error(self, where: Path, count: str) -> InputError:
        return InputError(
            f"has {count}, {self.files[0].parent.name}/ has {len(self.files)} files",
            where=where,
            remedy="make the counts agree, or remove it",
        )

    def _check_sizes(self) -> None:
        """Compare the size in camera.json with the first readable header of each channel."""
        if self.camera is None:
            return
        size, where = (self.camera.width, self.camera.height), "camera.json states"
        remedy = "use the camera.json of these images"
        for channel in (self.files, self.amplitude, self.confidence, self.sigma):
            check_first_size(channel, size, where, remedy)
        color = self.description.color
        if color is None:
            remedy += '; or describe its camera by "color" in camera.json'
        else:
            size = (color.camera.width, color.camera.height)
        check_first_size(self.color, size, where, remedy)

    def _fill_metadata(self) -> None:
        about = self.description
        if about.unknown:
            self.warnings.append(
                f"{self.folder / 'camera.json'}: unknown fields ignored: {', '.join(about.unknown)}"
            )
        for name in ("sensor", "frame_rate_hz", "ambiguity_m", "confidence_max", "amplitude_kind"):
            if getattr(about, name) is not None:
                self.metadata[name] = getattr(about, name)
        if self.camera is not None:
            self.metadata["depth_unit_m"] = about.depth_unit_m
            self.metadata["depth_kind"] = about.depth_kind
            self.metadata["corrected"] = self.correction is not None
            if self.sigma:
                self.metadata["sigma_unit_m"] = about.sigma_unit_m
        if is_folder(self.folder / "truth"):
            self.metadata["truth"] = str(self.folder / "truth")


def same_distortion(a: Pinhole, b: Pinhole) -> bool:
    """Whether two lenses differ only in focal lengths and principal point."""
    return type(a) is type(b) and all(
        getattr(a, f.name) == getattr(b, f.name) for f in fields(a) if f.name not in _LENS
    )


def depth_from_counts(counts: NDArray[np.generic], unit_m: float) -> Float32:
    """Return depth in m (float32) of stored counts (H, W); 0 and 65535 give 0."""
    depth = counts.astype(np.float32) * np.float32(unit_m)
    depth[counts == INVALID_DEPTH] = 0
    return depth


def read_correction(path: Path) -> DepthCorrection:
    """Read a correction.npz; InputError if it is invalid, or decompresses to an absurd size."""
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(item.file_size for item in archive.infolist())
    except (OSError, ValueError, zipfile.BadZipFile):
        size = 0  # reported by the loader
    try:
        if size <= MAX_CORRECTION_BYTES:
            return DepthCorrection.load(path)
    except MemoryError:
        pass
    raise InputError(
        "decompresses to more than a correction can be", where=path, remedy="write it again"
    )


def corrected_depth(
    correction: DepthCorrection, camera: Camera, depth: Float32, kind: DepthKind
) -> Float32:
    """Return depth (H, W) in m of the given kind, after correction of its radial range."""
    if kind == "range":
        return correction.correct(depth)
    return z_from_range(camera, correction.correct(range_from_z(camera, depth)))


class RecordingWriter:
    """Writes a native folder, frame by frame.

    Every file is written atomically; camera.json comes last, in `finish`, so that an interrupted
    recording is never mistaken for a complete one.

    Parameters
    ----------
    folder
        Created if missing; must be empty.
    camera
        The camera of all frames; a RayTable is written to rays.npy. None for clouds.
    depth_unit_m
        Metres per count.
    depth_kind
        Kind of the stored depth, "z" or "range"; frames are converted.
    frame_rate_hz, ambiguity_m, confidence_max, amplitude_kind, sensor
        See `CameraFile`; None: not written.
    sigma_unit_m
        Metres per count of sigma; None: frames' sigma is not written.
    color_registered
        Whether colour is registered to depth.
    own_cameras
        Whether to write a camera per frame: its lens if it has the model and distortion of
        `camera`, else its rays.

    Attributes
    ----------
    out_of_range
        Number of pixels so far whose depth or amplitude didn't fit into 16 bits (depth became
        invalid, amplitude the largest unsaturated value).

    Raises
    ------
    OutputError
        If something can't be written, or the folder isn't empty.
    """

    def __init__(
        self,
        folder: str | Path,
        camera: Camera | None,
        *,
        depth_unit_m: float = 0.001,
        depth_kind: DepthKind = "z",
        frame_rate_hz: float | None = None,
        ambiguity_m: float | None = None,
        confidence_max: float | None = None,
        amplitude_kind: str | None = None,
        sensor: str | None = None,
        sigma_unit_m: float | None = None,
        color_registered: bool = True,
        own_cameras: bool = False,
    ) -> None:
        self.folder = make_folder(folder)
        if any(self.folder.iterdir()):
            raise OutputError("isn't empty", where=self.folder, remedy="choose a new folder")
        self.camera = camera
        self.depth_unit_m, self.depth_kind = depth_unit_m, depth_kind
        self.sigma_unit_m, self.own_cameras = sigma_unit_m, own_cameras
        self.out_of_range = 0
        self._lenses: list[tuple[float, ...]] = []
        self._channels: frozenset[str] | None = None
        self._times: list[float] = []
        self._about: dict[str, Any] = {"schema": SCHEMA}
        if camera is not None:
            self._about |= camera_fields(camera)
            self._about |= {"depth_unit_m": float(depth_unit_m), "depth_kind": depth_kind}
        optional: dict[str, Any] = {
            "frame_rate_hz": frame_rate_hz,
            "ambiguity_m": ambiguity_m,
            "confidence_max": confidence_max,
            "amplitude_kind": amplitude_kind,
            "sensor": sensor,
            "sigma_unit_m": sigma_unit_m,
            "color_registered": None if color_registered else False,
        }
        self._about |= {key: value for key, value in optional.items() if value is not None}

    def __len__(self) -> int:
        return len(self._times)

    def add(self, frame: Frame) -> None:
        """Write the next frame.

        Raises
        ------
        InputError
            If the frame has another size, kind or set of channels than the first.
        """
        if isinstance(frame, CloudFrame):
            self._write_cloud(frame)
        else:
            self._write_images(frame)
        self._times.append(float(frame.timestamp))

    def _name(self, channel: str, suffix: str) -> Path:
        return make_folder(self.folder / channel) / f"{len(self):06d}{suffix}"

    def _write_cloud(self, frame: CloudFrame) -> None:
        if self.camera is not None:
            raise InputError("is a cloud", where=f"frame {frame.index}", remedy="add only images")
        self._check_channels(frame, "cloud")
        write_ply(
            self._name("cloud", ".ply"),
            GeometryRecord(
                frame.points,
                normals=frame.normals,
                color=frame.color,
                scalars={} if frame.amplitude is None else {"amplitude": frame.amplitude},
            ),
        )

    def _write_images(self, frame: RangeFrame) -> None:
        camera = self.camera
        if camera is None:
            raise InputError("is an image", where=f"frame {frame.index}", remedy="pass a camera")
        if frame.depth.shape != (camera.height, camera.width):
            raise InputError(
                f"is {frame.depth.shape[1]} x {frame.depth.shape[0]}, the recording's camera "
                f"{camera.width} x {camera.height}",
                where=f"frame {frame.index}",
            )
        images = {
            "amplitude": frame.amplitude_image,
            "confidence": frame.confidence_image,
            "color": frame.color_image,
            "sigma": None if self.sigma_unit_m is None else frame.sigma_image,
        }
        self._check_channels(frame, *(name for name, image in images.items() if image is not None))
        depth = frame.z if self.depth_kind == "z" else frame.radial_range
        write_png(self._name("depth", ".png"), self._counts(depth))
        if frame.amplitude_image is not None:
            write_png(self._name("amplitude", ".png"), self._amplitude(frame.amplitude_image))
        if frame.confidence_image is not None:
            confidence = frame.confidence_image.astype(np.uint8, copy=False)
            write_png(self._name("confidence", ".png"), confidence)
        if frame.color_image is not None:
            write_png(self._name("color", ".png"), frame.color_image)
        if self.sigma_unit_m is not None and frame.sigma_image is not None:
            counts = np.rint(frame.sigma_image.astype(float) / self.sigma_unit_m)
            write_png(self._name("sigma", ".png"), np.clip(counts, 0, MAX_COUNTS).astype(np.uint16))
        if self.own_cameras:
            self._write_camera(frame.camera, camera)

    def _write_camera(self, own: Camera, common: Camera) -> None:
        if isinstance(common, Pinhole):
            if not isinstance(own, Pinhole) or not same_distortion(own, common):
                raise InputError(
                    "has another lens model than the first",
                    where=f"frame {len(self)}",
                    remedy="use a RayTable as the common camera",
                )
            self._lenses.append((own.fx, own.fy, own.cx, own.cy))
            return
        with replacing(self._name("rays", ".npy")) as temporary, temporary.open("wb") as file:
            np.save(file, np.asarray(own.rays(), np.float32))

    def _check_channels(self, frame: Frame, *names: str) -> None:
        if self._channels is None:
            self._channels = frozenset(names)
        elif self._channels != set(names):
            raise InputError(
                f"has {sorted(names)} where the first frame has {sorted(self._channels)}",
                where=f"frame {frame.index}",
                remedy="use the same channels in all frames",
            )

    def _counts(self, depth: Float32) -> UInt16:
        counts = np.rint(depth.astype(float) / self.depth_unit_m)
        beyond = counts >= INVALID_DEPTH
        self.out_of_range += int(beyond.sum())
        return np.where(beyond, 0, counts).astype(np.uint16)

    def _amplitude(self, amplitude: Float32) -> UInt16:
        counts = np.rint(np.nan_to_num(amplitude.astype(float)))
        beyond = (counts >= SATURATED_AMPLITUDE) & (amplitude != SATURATED_AMPLITUDE)
        self.out_of_range += int(beyond.sum())
        counts[beyond] = SATURATED_AMPLITUDE - 1
        return np.clip(counts, 0, SATURATED_AMPLITUDE).astype(np.uint16)

    def finish(
        self,
        *,
        groundtruth: ArrayLike | None = None,
        odometry: ArrayLike | None = None,
        correction: DepthCorrection | None = None,
        imu: Mapping[str, NDArray[np.generic]] | None = None,
        frames: Mapping[str, NDArray[np.generic]] | None = None,
    ) -> Path:
        """Write the files of the whole recording, camera.json last, and return the folder.

        Parameters
        ----------
        groundtruth, odometry
            (N, 4, 4) T_world_camera of the frames added, NaN where unknown.
        correction
            Depth correction for readers to apply to the frames, which were added uncorrected.
        imu
            Columns of imu.csv by name.
        frames
            Columns (N,) of frames.csv by name.

        Raises
        ------
        InputError
            If there are no frames, or the counts disagree.
        """
        if not len(self):
            raise InputError("has no frames", where=self.folder, remedy="add at least one")
        for name, poses in (("groundtruth", groundtruth), ("odometry", odometry)):
            if poses is not None:
                write_tum(self.folder / f"{name}.txt", self._times, poses)
        if correction is not None:
            with replacing(self.folder / "correction.npz") as temporary:
                correction.save(temporary)
        if imu is not None:
            write_columns(self.folder / "imu.csv", imu)
        if self._lenses:
            columns = dict(zip(_LENS, np.array(self._lenses).T, strict=True))
            frames = {**(frames or {}), **columns}
        if frames is not None:
            if any(len(column) != len(self) for column in frames.values()):
                raise InputError(
                    f"columns don't have {len(self)} values", where=self.folder / "frames.csv"
                )
            write_columns(self.folder / "frames.csv", frames)
        if isinstance(self.camera, RayTable):
            with replacing(self.folder / "rays.npy") as temporary:
                np.save(temporary, np.asarray(self.camera.table, np.float32))
        write_text(self.folder / "timestamps.txt", "".join(exact(t) + "\n" for t in self._times))
        write_text(self.folder / "camera.json", json.dumps(self._about, indent=1) + "\n")
        return self.folder
