"""Sources for readers: files, depth images, colour, pose files, joined recordings, depth limits."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Any

from tofuse.engine.arrays import Float32, Float64, UInt8, UInt16
from tofuse.engine.cameras import Camera
from tofuse.engine.errors import InputError, UnreadableFrameError
from tofuse.engine.frames import AmplitudeKind, DepthKind, Frame, RangeFrame, depth_counts
from tofuse.engine.quantities import count
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading
from tofuse.formats.images import check_first_size, first_size, read_color, read_image
from tofuse.formats.sources.inputs import read_timestamps, tum_poses
from tofuse.formats.sources.pixels import resized, sampled_color
from tofuse.formats.sources.reader import ReaderOptions


class FileSource(ABC):
    """A source whose frames are files; an error in one of them affects only its frame.

    Attributes
    ----------
    concurrent
        Whether several threads can read frames concurrently: `load` has no side effects.
    path, remedy
        The file, and the remedy, for errors of frames that state none.
    camera, unit, kind, amplitude_kind, ambiguity_m
        Of depth images: the common camera, metres per count, and those of `RangeFrame`.
    color_camera
        None if colour is registered to depth, or there is none.
    """

    concurrent = False
    path: Path  # of a single file
    remedy: str | None = None
    camera: Camera
    unit: float = 0.001
    kind: DepthKind = "z"
    amplitude_kind: AmplitudeKind = "raw"
    ambiguity_m: float | None = None
    color_camera: camera_file.ColorCamera | None = None

    def __init__(self, timestamps: Float64) -> None:
        self.timestamps = timestamps
        self.reference: Float64 | None = None
        self.odometry: Float64 | None = None
        self.gravity: Float64 | None = None
        self.warnings: list[str] = []
        self.metadata: dict[str, Any] = {}
        self._unread_colors: dict[int, str] = {}  # errors by frame
        self._unread_note, self._unread_lock = "", Lock()

    def where(self, index: int) -> str:
        """Return the name of a frame for errors."""
        path = getattr(self, "path", None)
        return f"frame {index}" if path is None else f"{path}: frame {index}"

    @abstractmethod
    def load(self, index: int) -> Frame:
        """Read frame `index`; raise InputError if it can't be read."""

    def use_camera(
        self,
        path: Path,
        size: tuple[int, int] | None = None,
        size_of_images: camera_file.SizeOf | None = None,
    ) -> camera_file.CameraFile:
        """Take camera, unit and kind of depth from a camera.json; see `load_camera`."""
        description, self.camera = camera_file.load_camera(path, size, size_of_images)
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

    def color_if_readable(self, index: int, read: Callable[[], UInt8 | None]) -> UInt8 | None:
        """Return the colour of a frame by calling `read`; None if that raises InputError.

        Depth is of use without it. One of the `warnings` counts such frames.
        """
        try:
            with reading.about(self.where(index)):
                return read()
        except InputError as error:
            with self._unread_lock:
                self._unread_colors[index] = str(error)
                first = self._unread_colors[min(self._unread_colors)]
                others = [line for line in self.warnings if line is not self._unread_note]
                number = len(self._unread_colors)
                self._unread_note = (
                    f"colour can't be read in {count(number, 'frame')}, which "
                    f"{'is' if number == 1 else 'are'} used without, the first: {first}"
                )
                self.warnings[:] = [*others, self._unread_note]
            return None

    def color_from_file(self, index: int, path: Path | None, size: tuple[int, int]) -> UInt8 | None:
        """Return the colour of a frame, of an image that has the view of depth.

        Downscaled to the `size` (width, height) of depth; None without a readable file.
        """
        if path is None:
            return None
        return self.color_if_readable(index, lambda: resized(read_color(path), size, path))

    def full_resolution_color(self, index: int) -> UInt8 | None:
        """Return the colour of a frame at its recorded resolution, if it has the view of depth.

        (H, W, 3) RGB, or None if there is none. Raise InputError if it can't be read.
        """
        return None

    def has_color(self, index: int) -> bool:
        """Whether a frame may have colour, as far as is known without reading it."""
        return True

    def read_sidecars(self, folder: Path) -> None:
        """Read timestamps.txt, groundtruth.txt and odometry.txt, as far as the folder has them."""
        path = folder / "timestamps.txt"
        if reading.is_file(path):
            self.timestamps = read_timestamps(path, len(self.timestamps), self.warnings)
        if reading.is_file(folder / "groundtruth.txt"):
            self.reference = tum_poses(self, folder / "groundtruth.txt")
        if reading.is_file(folder / "odometry.txt"):
            self.odometry = tum_poses(self, folder / "odometry.txt", interpolated=True)

    def note_missing_color(self, color: Sequence[object]) -> None:
        """Warn if some of the frames have no colour: None in `color`."""
        colored = sum(item is not None for item in color)
        if 0 < colored < len(color):
            self.warnings.append(f"only {colored} of {len(color)} frames have colour")

    def read(self, index: int) -> Frame:
        """See `Source.read`."""
        try:
            with reading.about(self.where(index), self.remedy):
                return self.load(index)
        except InputError as error:
            raise UnreadableFrameError(
                error.problem, where=error.where, remedy=error.remedy
            ) from error
        except MemoryError as error:
            raise UnreadableFrameError("needs more memory than is available") from error


class DepthImageSource(FileSource):
    """Depth images, with colour images where given, registered to them or of another camera.

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
        Whether colour is registered to depth, if it has no camera of its own.
    color_camera
        Of colour that isn't registered, unless `options` has a camera.json with one.
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
        *,
        depth_unit_m: float = 0.001,
        color: Sequence[Path | None] | None = None,
        color_registered: bool = True,
        color_camera: camera_file.ColorCamera | None = None,
        sensor: str = "",
        options: ReaderOptions | None = None,
    ) -> None:
        super().__init__(timestamps)
        self.files = list(files)
        self.color = [None] * len(files) if color is None else list(color)
        self.color_registered, self.color_camera = color_registered, color_camera
        where = "the camera of this format"
        if options is not None and options.camera is not None:
            description = self.use_camera(
                options.camera, size_of_images=lambda: first_size(self.files)
            )
            sensor = description.sensor or sensor
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
        self.note_missing_color(self.color)
        check_first_size(self.files, size, where, "pass the camera of these images with --camera")

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        counts = self.read_counts(index, (self.camera.width, self.camera.height))
        frame = self.image(index, depth_counts.depth_from_counts(counts, self.unit))
        path = self.color[index]
        if path is None:
            return frame
        return replace(
            frame,
            color_image=self.color_if_readable(index, lambda: self._read_color(path, frame)),
            color_registered=self.color_registered or self.color_camera is not None,
        )

    def has_color(self, index: int) -> bool:
        """See `FileSource.has_color`."""
        return self.color[index] is not None

    def read_counts(self, index: int, size: tuple[int, int]) -> UInt16:
        """Return the image (H, W) of a frame, in counts of depth."""
        return read_image(self.files[index], size=size, dtype="uint16")

    def _read_color(self, path: Path, frame: RangeFrame) -> UInt8:
        """The colour (H, W, 3) of a frame, from its image."""
        color = read_color(path)
        if self.color_camera is not None:
            return sampled_color(frame, color, self.color_camera, path)
        height, width = frame.depth.shape
        if color.shape[:2] != (height, width):
            raise InputError(
                f"is {color.shape[1]} x {color.shape[0]} pixels, depth {width} x {height}",
                where=path,
                remedy="register colour to depth, pass its camera in camera.json, or leave it out",
            )
        return color
