"""Reader of transforms.json with depth: nerfstudio, instant-ngp, NeRFCapture, `tofuse export`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.arrays import Float32, Float64, UInt8
from tofuse.engine.cameras import DISTORTION_ORDER, MODELS, Pinhole, ray_lengths
from tofuse.engine.errors import InputError
from tofuse.engine.frames import POSES_BY, RangeFrame, depth_counts
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import npz, reading
from tofuse.formats.images import read_color, read_image
from tofuse.formats.poses import OPENGL
from tofuse.formats.sources import FileSource, Reader, ReaderOptions, Sniff, inputs

# The first one that a folder has is read; the others are parts of the same scene.
NAMES = ("transforms.json", *(f"transforms_{part}.json" for part in ("train", "val", "test")))
_DEPTH = ("depth_file_path", "depth_path")
_IMAGES = ("", ".png", ".jpg", ".jpeg")  # NeRFCapture omits suffixes
_MODELS = {
    "PERSPECTIVE": "pinhole",
    "PINHOLE": "pinhole",
    "SIMPLE_PINHOLE": "pinhole",
    "OPENCV": "brown",
    "OPENCV_FISHEYE": "fisheye",
}
_HEAD_BYTES = 1 << 16
_REMEDY = "correct it there"


@part("reader", "nerfstudio", label="experimental")
class Nerfstudio(Reader):
    """nerfstudio, instant-ngp, NeRFCapture, `tofuse export`: a transforms.json with depth."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        file = _file(path)
        head = reading.read_head(file, _HEAD_BYTES) if reading.is_file(file) else b""
        if file.name in NAMES and any(f'"{key}"'.encode() in head for key in _DEPTH):
            return Sniff(1.0, f"{file.name} with depth")
        return None

    def open(self, path: Path, options: ReaderOptions) -> NerfstudioSource:
        """See `Reader.open`."""
        inputs.refuse_camera(options, "nerfstudio", inputs.PER_FRAME)
        file = _file(path)
        source = NerfstudioSource(file)
        others = [name for name in NAMES[1:] if name != file.name and path.is_dir()]
        unread = [name for name in others if reading.is_file(path / name)]
        if file.name in NAMES[1:] and unread:
            source.warnings.append(
                f"{file}: the only frames read; join those of {' and '.join(unread)} by naming "
                "each file as an input"
            )
        return source


class NerfstudioSource(FileSource):
    """Depth images with individual intrinsics, and the file's poses as reference."""

    concurrent = True

    def __init__(self, file: Path) -> None:
        self.file = file
        document = reading.read_json(file)
        entries = document.get("frames")
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise InputError("has no list of frames", where=file, remedy=_REMEDY)
        self.frames = [_Frame(document, entry, k, file) for k, entry in enumerate(entries)]
        with_depth = [frame for frame in self.frames if frame.path(*_DEPTH) is not None]
        if not with_depth:
            raise InputError(
                "has no frames with depth_file_path",
                where=file,
                remedy="record depth too: colour alone is not sufficient",
            )
        without_depth = len(self.frames) - len(with_depth)
        self.frames = _sorted(with_depth)
        times = np.array([frame.time for frame in self.frames])
        timed = bool(np.isfinite(times).all())
        super().__init__(times if timed else np.arange(len(self.frames), dtype=float))
        self.unit_m = _unit(document, file, any("depth_file_path" in f.entry for f in self.frames))
        self.sigma_unit_m = reading.number_in(
            document, "sigma_unit_scale_factor", file, 1e-4, _REMEDY
        )
        self.metadata |= {"depth_kind": "z", "depth_unit_m": self.unit_m}
        # The key of NeRFCapture, whose poses are those of ARKit.
        if all("depth_path" in frame.entry for frame in self.frames):
            self.metadata[POSES_BY] = "NeRFCapture"
        if without_depth:
            self.warnings.append(
                f"{file}: {quantities.count(without_depth, 'frame')} without depth: skipped"
            )
        if not timed:
            self.warnings.append(f"{file}: no timestamps: frame numbers serve as seconds")
        self.reference = inputs.poses_of(self, self.frames, _Frame.pose)

    def full_resolution_color(self, index: int) -> UInt8 | None:
        """See `FileSource.full_resolution_color`."""
        path = self.frames[index].image()
        return None if path is None else read_color(path)

    def has_color(self, index: int) -> bool:
        """See `FileSource.has_color`."""
        return self.frames[index].image() is not None

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        frame = self.frames[index]
        path = frame.path(*_DEPTH)
        assert path is not None
        depth = self._depth(path)
        size = (depth.shape[1], depth.shape[0])
        camera = frame.lens(size)
        sigma = frame.path("sigma_file_path")
        sigma_image = None
        if sigma is not None:
            counts = read_image(sigma, size=size, dtype="uint16")
            sigma_z = counts.astype(np.float32) * np.float32(self.sigma_unit_m)
            sigma_image = np.nan_to_num(sigma_z * ray_lengths(camera))
        return self.image(
            index,
            depth,
            camera=camera,
            color_image=self.color_from_file(index, frame.image(), size),
            sigma_image=sigma_image,
        )

    def _depth(self, path: Path) -> Float32:
        if path.suffix.lower() == ".npy":
            return depth_counts.depth_from_numbers(_array(path), self.unit_m)
        return depth_counts.depth_from_counts(read_image(path, dtype="uint16"), self.unit_m)


@dataclass(frozen=True, eq=False)
class _Frame:
    """The entry of one frame; values common to all frames are its defaults."""

    common: dict[str, Any]
    entry: dict[str, Any]
    number: int
    file: Path

    @property
    def where(self) -> str:
        return f"{self.file}: frame {self.number}"

    @property
    def time(self) -> float:
        """Timestamp in s; NaN if not given."""
        value = self.entry.get("timestamp")
        if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e18:
            return math.nan
        return float(value)

    @property
    def key(self) -> list[tuple[int, int, str]]:
        return reading.name_order(Path(str(self.entry.get("file_path", self.number))))

    def path(self, *names: str) -> Path | None:
        """Return the path under the first of these keys that the entry has."""
        value = next((self.entry[key] for key in names if key in self.entry), None)
        if not isinstance(value, str) or not value or "\0" in value:
            return None
        return self.file.parent / value.replace("\\", "/")

    def image(self) -> Path | None:
        base = self.path("file_path")
        if base is None:
            return None
        return reading.first_file(*(base.with_name(base.name + suffix) for suffix in _IMAGES))

    def pose(self) -> Float64:
        where = f"{self.where}: transform_matrix"
        rows = self.entry.get("transform_matrix")
        if isinstance(rows, list) and len(rows) == 3:
            rows = [*rows, [0, 0, 0, 1]]
        return inputs.read_matrix_pose(reading.matrix_of(rows, where, _REMEDY), where) @ OPENGL

    def number_of(self, name: str, default: float | None = None) -> float:
        if name in self.entry:
            return reading.number_in(self.entry, name, self.where, default, _REMEDY)
        return reading.number_in(self.common, name, self.file, default, _REMEDY)

    def lens(self, size: tuple[int, int]) -> Pinhole:
        """Return the camera scaled from the file's image size to the depth's (width, height)."""
        model_name = self.entry.get("camera_model", self.common.get("camera_model", "OPENCV"))
        model = _MODELS.get(model_name) if isinstance(model_name, str) else None
        if model is None:
            raise InputError(
                f"is {model_name!r:.60}",
                where=f"{self.where}: camera_model",
                remedy=f"use one of {', '.join(_MODELS)}",
            )
        width, height = self.number_of("w", size[0]), self.number_of("h", size[1])
        pixels = camera_file.image_size(width, height, f"{self.where}: w")
        fx = self.number_of("fl_x", self._focal_length("camera_angle_x", width))
        # Pixel coordinates here start at the corner of the first pixel, in `Pinhole` at its centre.
        values = {
            "fx": fx,
            "fy": self.number_of("fl_y", self._focal_length("camera_angle_y", height) or fx),
            "cx": self.number_of("cx", width / 2) - 0.5,
            "cy": self.number_of("cy", height / 2) - 0.5,
        } | {name: self.number_of(name, 0.0) for name in DISTORTION_ORDER[model]}
        if model == "brown":
            if self.number_of("k4", 0.0):
                raise InputError("is not 0", where=f"{self.where}: k4", remedy="undistort first")
            if not any(values[name] for name in DISTORTION_ORDER[model]):
                model = "pinhole"
                values = {name: values[name] for name in ("fx", "fy", "cx", "cy")}
        camera = camera_file.checked_lens(MODELS[model], pixels, values, self.where)
        return camera_file.scaled_lens(camera, size, self.where, _REMEDY)

    def _focal_length(self, name: str, pixels: float) -> float | None:
        """Focal length in pixels from the field of view; None if not given."""
        angle = self.entry.get(name, self.common.get(name))
        if isinstance(angle, bool) or not isinstance(angle, int | float) or not 0 < angle < 3.1:
            return None
        return pixels / 2 / math.tan(angle / 2)


def _file(path: Path) -> Path:
    if path.name in NAMES and not path.is_dir():
        return path
    return reading.first_file(*(path / name for name in NAMES)) or path / NAMES[0]


def _sorted(frames: list[_Frame]) -> list[_Frame]:
    """The frames sorted by time, or by image names if some have no time."""
    if all(math.isfinite(frame.time) for frame in frames):
        return sorted(frames, key=lambda frame: frame.time)
    return sorted(frames, key=lambda frame: frame.key)


def _unit(document: dict[str, Any], file: Path, nerfstudio: bool) -> float:
    """Metres per count: as stated in the file, or nerfstudio's millimetre."""
    for name in ("depth_unit_scale_factor", "integer_depth_scale"):
        if name in document:
            unit = reading.number_in(document, name, file, remedy=_REMEDY)
            if not 1e-9 <= unit <= 1:
                raise InputError(f"is {unit:g}", where=f"{file}: {name}", remedy="use metres")
            return unit
    if not nerfstudio:
        raise InputError(
            "is missing",
            where=f"{file}: integer_depth_scale",
            remedy="write the metres per count of depth",
        )
    return 0.001


def _array(path: Path) -> Float32:
    """Depth (H, W) of a .npy file."""
    table = npz.read_npy(path)
    if table.ndim == 3 and table.shape[2] == 1:
        table = table[..., 0]
    if table.ndim != 2 or table.dtype.kind not in "fiu" or min(table.shape) < 2:
        raise InputError(f"is of shape {table.shape}", where=path, remedy="write (H, W) numbers")
    return np.asarray(table, np.float32)
