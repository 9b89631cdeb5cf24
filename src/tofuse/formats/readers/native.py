"""The native recording: a folder of images (or PLY clouds), described by a camera.json."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine import quantities
from tofuse.engine.arrays import Float32, Float64, UInt8
from tofuse.engine.cameras import Camera, Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.frames import POSES_BY, Frame, RangeFrame, depth_counts
from tofuse.engine.parts import part
from tofuse.engine.sensor import DepthCorrection
from tofuse.formats.cameras import camera_file, corrected_depth, read_correction
from tofuse.formats.files import reading, tables
from tofuse.formats.images import (
    check_first_size,
    first_size,
    read_color,
    read_exr_depth,
    read_image,
)
from tofuse.formats.sources import (
    FileSource,
    Reader,
    ReaderOptions,
    Sniff,
    cloud_files,
    gravity_at,
    inputs,
    pixels,
)

_IMAGES = (".png", ".jpg", ".jpeg")
_MAX_MEDIAN_M = 200.0  # floats with a larger median are not in metres


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

    camera: Camera | None  # type: ignore[assignment]  # None for clouds

    def __init__(self, folder: Path, camera_path: Path | None = None) -> None:
        self.folder = folder
        self.is_clouds = not reading.is_folder(folder / "depth") and reading.is_folder(
            folder / "cloud"
        )
        name, suffixes = ("cloud", (".ply",)) if self.is_clouds else ("depth", (".png",))
        remedy = "check that the recording is complete"
        files = reading.files_with(folder / name, *suffixes)
        if not (files or self.is_clouds):
            files = reading.files_with(folder / name, ".npy", ".exr")
        self.files = inputs.required(files, f"{suffixes[0]} files", folder / name, remedy)
        self.description, self.camera = self._read_camera(camera_path)
        self.unit, self.kind = self.description.depth_unit_m, self.description.depth_kind
        self.amplitude_kind = self.description.amplitude_kind or "raw"
        self.ambiguity_m = self.description.ambiguity_m
        super().__init__(np.arange(len(self.files)) / (self.description.frame_rate_hz or 1.0))
        self.read_sidecars(folder)
        self.amplitude = self._channel_files("amplitude", ".png")
        self.confidence = self._channel_files("confidence", ".png")
        self.color = self._channel_files("color", *_IMAGES)
        self.sigma = self._channel_files("sigma", ".png")
        self.rays = self._channel_files("rays", ".npy")
        if camera_path is not None:
            self.rays = []  # the camera passed by the user applies to all frames
        self.color_registered = self._is_registered()
        self.correction = self._read_correction()
        self.imu = self._read_table("imu.csv")
        self.frame_columns = self._read_table("frames.csv", rows=len(self.files))
        self.cameras = self._frame_lenses() if camera_path is None else []
        if self.sigma and self.description.sigma_unit_m is None:
            raise InputError(
                "is missing, and there is sigma/",
                where=f"{self.folder / 'camera.json'}: sigma_unit_m",
                remedy="set the metres per count of sigma",
            )
        self._read_gravity()
        self._check_sizes()
        self._fill_metadata()

    def load(self, index: int) -> Frame:
        """See `FileSource.load`."""
        timestamp = float(self.timestamps[index])
        if self.camera is None:
            cloud = cloud_files.ply_frame(self.files[index], index, timestamp)
            down = None if self.gravity is None else self.gravity[index, :3]
            return cloud if down is None or np.isnan(down).any() else replace(cloud, up=-down)
        camera = self._camera_of(index, self.camera)
        depth = self._depth(index)
        if self.correction is not None:
            depth = corrected_depth(self.correction, camera, depth, self.kind)
        images: dict[str, Any] = {"camera": camera}
        if self.color:
            path, frame = self.color[index], self.image(index, depth, camera=camera)
            images["color_image"] = self.color_if_readable(
                index, lambda: self._read_color(path, frame)
            )
        if self.amplitude:
            counts = self._read(self.amplitude, index, "uint16")
            images["amplitude_image"] = counts.astype(np.float32)
        if self.confidence:
            images["confidence_image"] = self._read(self.confidence, index, "uint8")
        if self.sigma:
            counts = self._read(self.sigma, index, "uint16").astype(np.float32)
            images["sigma_image"] = counts * np.float32(self.description.sigma_unit_m or 0)
        return self.image(index, depth, color_registered=self.color_registered, **images)

    def _read_color(self, path: Path, frame: RangeFrame) -> UInt8:
        """The colour (H, W, 3) of a frame, from its image."""
        color = read_color(path)
        if self._color_is_for_display:
            return pixels.resized(color, self._size, path, same_view=False)
        return pixels.sampled_color(frame, color, self.description.color, path)

    @property
    def _color_is_for_display(self) -> bool:
        return not self.color_registered and self.description.color is None

    def _is_registered(self) -> bool:
        """Whether colour has the pixels of depth, which only a camera.json states."""
        description = self.description
        if description.program is None or not self.color or first_size(self.color) == self._size:
            return description.color_registered
        self.warnings.append(
            "colour is of another size than depth and has no camera: it is for display only; "
            "describe its camera in a camera.json (docs/formats.md) to use it"
        )
        return False

    def _depth(self, index: int) -> Float32:
        """Depth (H, W), m."""
        path = self.files[index]
        if path.suffix.lower() == ".png":
            counts = self._read(self.files, index, "uint16")
            return depth_counts.depth_from_counts(counts, self.unit)
        numbers = self._numbers(path, self._size)
        in_metres = numbers.dtype.kind == "f"
        depth = depth_counts.depth_from_numbers(numbers, 1.0 if in_metres else self.unit)
        if in_metres and (depth > _MAX_MEDIAN_M).sum() > (depth > 0).sum() / 2:
            raise InputError(
                f"has floats with a median of {np.median(depth[depth > 0]):.4g}, which can't be m",
                where=path,
                remedy="save metres, or integers in units of depth_unit_m",
            )
        return depth

    def _size_of_images(self) -> tuple[int, int]:
        nothing = InputError("has no images", where=self.files[0].parent)
        height, width = reading.first_readable(self.files, self._numbers, nothing).shape[:2]
        return width, height

    @staticmethod
    def _numbers(path: Path, size: tuple[int, int] | None = None) -> NDArray[Any]:
        """The numbers (H, W) of a depth image."""
        if path.suffix.lower() == ".exr":
            return read_exr_depth(path, size)
        return read_image(path, size=size)

    @property
    def _size(self) -> tuple[int, int]:
        assert self.camera is not None
        return self.camera.width, self.camera.height

    def _read(self, files: list[Path], index: int, dtype: str) -> NDArray[Any]:
        """The counts (H, W) in a file of a channel."""
        return read_image(files[index], size=self._size, dtype=dtype).astype(dtype, copy=False)

    def _camera_of(self, index: int, camera: Camera) -> Camera:
        """Return the camera of a frame: its own, if the recording has one per frame."""
        if self.cameras:
            lens = self.cameras[index]
            if isinstance(lens, InputError):
                raise lens
            return lens
        if not self.rays:
            return camera
        table = camera_file.read_rays(self.rays[index])
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
        if (
            columns is None
            or not isinstance(camera, Pinhole)
            or not set(camera_file.LENS_COLUMNS) <= set(columns)
        ):
            return []
        path, size = self.folder / "frames.csv", (camera.width, camera.height)
        common = {f.name: getattr(camera, f.name) for f in fields(camera)[2:]}
        rows = enumerate(
            zip(*(columns[name].tolist() for name in camera_file.LENS_COLUMNS), strict=True), 1
        )
        lenses: dict[tuple[float, ...], Pinhole] = {}

        def lens(numbered: tuple[int, tuple[float, ...]]) -> Pinhole:
            k, row = numbered
            if row not in lenses:  # frames with the same lens share it
                values = common | dict(zip(camera_file.LENS_COLUMNS, row, strict=True))
                lenses[row] = camera_file.checked_lens(
                    type(camera), size, values, f"{path}, row {k}"
                )
            return lenses[row]

        return inputs.cameras_of(rows, lens)

    def _read_camera(
        self, camera_path: Path | None
    ) -> tuple[camera_file.CameraFile, Camera | None]:
        path = self.folder / "camera.json"
        if not self.is_clouds:
            return camera_file.load_camera(camera_path or path, size_of_images=self._size_of_images)
        if camera_path is not None:
            raise InputError(
                "does not apply to a recording of clouds", where="--camera", remedy="leave it out"
            )
        if reading.is_file(path):
            return camera_file.read_camera_file(path, clouds=True), None
        return camera_file.CameraFile(None, None), None

    def _channel_files(self, name: str, *suffixes: str) -> list[Path]:
        folder = self.folder / name
        if self.is_clouds or not reading.is_folder(folder):
            return []
        files = reading.files_with(folder, *suffixes)
        if len(files) != len(self.files):
            raise self._count_error(folder, quantities.count(len(files), "image"))
        if [f.stem for f in files] == [f.stem for f in self.files]:
            return files
        # Numbers from another first one shift all names that both have, others are of other frames.
        places = {f.stem: k for k, f in enumerate(files)}
        shifts = {places[f.stem] - k for k, f in enumerate(self.files) if f.stem in places}
        if 0 in shifts or len(shifts) > 1:
            raise InputError(
                "has names of other frames than depth/",
                where=folder,
                remedy="give the images of a frame one name, and remove those without a partner",
            )
        self.warnings.append(f"{folder}: names differ from those in depth/; paired in order")
        return files

    def _read_correction(self) -> DepthCorrection | None:
        path = self.folder / "correction.npz"
        if self.camera is None or not reading.is_file(path):
            return None
        correction = read_correction(path)
        with reading.named(path):
            correction.correct(np.ones((self.camera.height, self.camera.width), np.float32))
        return correction

    def _read_table(self, name: str, rows: int | None = None) -> dict[str, Float64] | None:
        path = self.folder / name
        if not reading.is_file(path):
            return None
        columns = tables.read_columns(path)
        length = len(next(iter(columns.values())))
        if rows is not None and length != rows:
            raise self._count_error(path, quantities.count(length, "row"))
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
            self.warnings.append(
                f"{path}: has no samples other than zero near the time of any frame"
            )

    def _count_error(self, where: Path, count: str) -> InputError:
        return InputError(
            f"has {count}, {self.files[0].parent.name}/ has "
            f"{quantities.count(len(self.files), 'file')}",
            where=where,
            remedy="make the counts agree, or remove it",
        )

    def _check_sizes(self) -> None:
        """Compare the size in camera.json with the first readable header of each channel."""
        if self.camera is None:
            return
        size, where = self._size, "camera.json states"
        remedy = "use the camera.json of these images"
        for channel in (self.files, self.amplitude, self.confidence, self.sigma):
            check_first_size(channel, size, where, remedy)
        if self._color_is_for_display:  # its size doesn't matter
            return
        color = self.description.color
        if color is None:
            remedy += '; or describe its camera by "color" in camera.json, or state there that it '
            remedy += 'has none: "color_registered": false'
        else:
            size = (color.camera.width, color.camera.height)
        check_first_size(self.color, size, where, remedy)

    def _fill_metadata(self) -> None:
        description = self.description
        if description.unknown:
            self.warnings.append(
                f"{self.folder / 'camera.json'}: unknown fields ignored: "
                f"{', '.join(description.unknown)}"
            )
        self.metadata |= description.stated(
            "sensor",
            "serial",
            "frame_rate_hz",
            "ambiguity_m",
            "confidence_max",
            "amplitude_kind",
            POSES_BY,
        )
        if self.camera is not None:
            self.metadata["depth_unit_m"] = description.depth_unit_m
            self.metadata["depth_kind"] = description.depth_kind
            self.metadata["corrected"] = self.correction is not None
            if self.sigma:
                self.metadata["sigma_unit_m"] = description.sigma_unit_m
        if reading.is_folder(self.folder / "truth"):
            self.metadata["truth"] = str(self.folder / "truth")


@part("reader", "native", label="validated")
class Native(Reader):
    """Folders with a camera.json and depth/ (PNG, .npy or .exr) or cloud/ (PLY)."""

    joinable = True

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        if not reading.is_folder(path):
            return None
        images = next((n for n in ("depth", "cloud") if reading.is_folder(path / n)), None)
        if reading.is_file(path / "camera.json"):
            try:
                text = reading.read_text(path / "camera.json")
            except InputError:
                text = ""
            if "intrinsic_matrix" in text and '"schema"' not in text:
                return None
            if images is None:
                return Sniff(Sniff.CERTAIN, "a camera.json but neither depth/ nor cloud/")
            return Sniff(1.0, f"camera.json and {images}/")
        if images == "depth":
            return Sniff(
                Sniff.UNCERTAIN,
                "depth/ but no camera.json",
                "use --camera camera.json (docs/formats.md), or a file of OpenCV or ROS",
                needs_camera=True,
            )
        return Sniff(Sniff.CERTAIN, "cloud/") if images == "cloud" else None

    def open(self, path: Path, options: ReaderOptions) -> NativeSource:
        """See `Reader.open`."""
        if not reading.is_folder(path):
            raise InputError("is not a folder", where=path, remedy="pass the recording's folder")
        if not reading.is_folder(path / "depth") and not reading.is_folder(path / "cloud"):
            raise InputError(
                "has neither depth/ nor cloud/",
                where=path,
                remedy="check that the recording is complete",
            )
        return NativeSource(path, options.camera)
