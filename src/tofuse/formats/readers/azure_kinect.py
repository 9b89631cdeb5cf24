"""Reader of .mkv recordings of Azure Kinect, and of Orbbec's Femto with the same recorder."""

from __future__ import annotations

import struct
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64, UInt8, UInt16
from tofuse.engine.cameras import Camera, Rational, RayTable
from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.parts import part
from tofuse.engine.times import partners
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading
from tofuse.formats.images import as_color, matroska, parse_image
from tofuse.formats.sources import FileSource, Reader, ReaderOptions, Sniff, inputs, pixels


@dataclass(frozen=True)
class Window:
    """The crop of the calibrated image that a mode uses; all (x, y) in pixels.

    Attributes
    ----------
    full_size
        Size of the calibrated image at the mode's resolution.
    corner
        Top left corner of the mode's image in it.
    size
        Size of the mode's image.
    """

    full_size: tuple[int, int]
    corner: tuple[int, int]
    size: tuple[int, int]


DEPTH_MODES = {
    "NFOV_2X2BINNED": Window((512, 512), (96, 90), (320, 288)),
    "NFOV_UNBINNED": Window((1024, 1024), (192, 180), (640, 576)),
    "WFOV_2X2BINNED": Window((512, 512), (0, 0), (512, 512)),
    "WFOV_UNBINNED": Window((1024, 1024), (0, 0), (1024, 1024)),
}
COLOR_MODES = {
    (1280, 720): Window((1280, 960), (0, 120), (1280, 720)),
    (1920, 1080): Window((1920, 1440), (0, 180), (1920, 1080)),
    (2560, 1440): Window((2560, 1920), (0, 240), (2560, 1440)),
    (2048, 1536): Window((2048, 1536), (0, 0), (2048, 1536)),
    (3840, 2160): Window((3840, 2880), (0, 360), (3840, 2160)),
    (4096, 3072): Window((4096, 3072), (0, 0), (4096, 3072)),
}
# Validity radius of the polynomials, if the calibration has none.
METRIC_RADIUS = 1.7
_LOCATIONS = {"depth": "CALIBRATION_CameraLocationD0", "color": "CALIBRATION_CameraLocationPV0"}
_MODELS = {
    "CALIBRATION_LensDistortionModelBrownConrady": 2.0,
    "CALIBRATION_LensDistortionModelRational6KT": 1.0,
}


@dataclass(frozen=True)
class KinectLens(Rational):
    """The calibration's lens: rational, undefined beyond a radius on the plane z = 1.

    In the older of its two forms, Rational6KT, the mixed tangential terms count once, not twice.
    """

    metric_radius: float = METRIC_RADIUS
    tangential_factor: float = 2.0

    def project(self, points: ArrayLike) -> Float64:
        """See `Camera.project`; also NaN beyond the radius."""
        points = np.asarray(points, float)
        uv = super().project(points)
        with np.errstate(all="ignore"):
            radius = np.hypot(points[..., 0], points[..., 1]) / points[..., 2]
        return np.where((radius <= self.metric_radius)[..., None], uv, np.nan)


@lru_cache(maxsize=8)
def depth_camera(lens: KinectLens) -> Camera:
    """Return the depth camera: the lens model if it is OpenCV's, else a ray table."""
    rays = lens.rays()
    valid = np.hypot(rays[..., 0], rays[..., 1]) <= lens.metric_radius
    if valid.all() and lens.tangential_factor == 2.0:
        return Rational(**{f.name: getattr(lens, f.name) for f in fields(Rational)})
    return RayTable(np.where(valid[..., None], rays, np.float32(np.nan)))


@part("reader", "azure-kinect", label="validated")
class AzureKinect(Reader):
    """A .mkv of k4arecorder (Azure Kinect, Femto): depth, infrared, and colour if it is MJPG."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        matches = inputs.begins_with(inputs.file_of(path, ".mkv"), matroska.MAGIC)
        return Sniff(1.0, "a Matroska file") if matches else None

    def open(self, path: Path, options: ReaderOptions) -> AzureKinectSource:
        """See `Reader.open`."""
        return AzureKinectSource(inputs.required_file(path, ".mkv"), options)


class AzureKinectSource(FileSource):
    """Depth frames, with the simultaneous infrared image and registered colour."""

    amplitude_kind = "ir"

    def __init__(self, path: Path, options: ReaderOptions) -> None:
        self.file = matroska.Matroska(path)
        tracks = {track.name.upper(): track for track in self.file.tracks}
        depth = tracks.get("DEPTH")
        if depth is None or not depth.blocks:
            kind = "only infrared (passive IR)" if "IR" in tracks else "no depth"
            raise InputError(
                f"contains {kind}", where=path, remedy="record it in one of the depth modes"
            )
        self.depth = depth.blocks
        self.size = _image_size(depth, path)
        self.mode = _mode(self.file.tags, self.size, path)
        offset = _integer(self.file.tags.get("K4A_START_OFFSET_NS"))
        super().__init__((np.array([b.time_ns for b in self.depth]) + offset) / 1e9)
        if not self.file.complete:
            self.warnings.append(
                f"{path} is cut off after {quantities.count(len(self.depth), 'frame')}"
            )
        limit = (depth.duration_ns or 33_333_333) / 2e9
        self.infrared = self._matched_blocks(tracks.get("IR"), limit, 0)
        color = tracks.get("COLOR")
        delay = _integer(self.file.tags.get("K4A_DEPTH_DELAY_NS"))
        self.color = self._matched_blocks(color, limit, delay)
        self._read_cameras(options, color)
        self.metadata |= {
            "sensor": self._sensor(),
            "depth_mode": self.mode,
            "depth_unit_m": self.unit,
            "depth_kind": self.kind,
            "amplitude_kind": "ir",
        }
        if depth.duration_ns:
            self.metadata["frame_rate_hz"] = round(1e9 / depth.duration_ns, 3)

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        depth = self._image(self.depth[index]).astype(np.float32) * np.float32(self.unit)
        block = self.infrared[index]
        infrared = None if block is None else self._image(block).astype(np.float32)
        frame = self.image(index, depth, amplitude_image=infrared)
        color = self.color_if_readable(index, lambda: self._color_image(index, frame))
        return frame if color is None else replace(frame, color_image=color)

    def _image(self, block: matroska.Block) -> UInt16:
        width, height = self.size
        data = self.file.read(block)
        if len(data) != 2 * width * height:
            raise InputError(
                f"contains an image of {len(data)} bytes at byte {block.offset}, "
                f"not of {width} x {height} pixels",
                where=self.file.path,
            )
        return np.frombuffer(data, ">u2").reshape(height, width).astype(np.uint16)

    def has_color(self, index: int) -> bool:
        """See `FileSource.has_color`."""
        return self.color[index] is not None

    def _color_image(self, index: int, frame: RangeFrame) -> UInt8 | None:
        block = self.color[index]
        if block is None or self.color_camera is None:
            return None
        camera = self.color_camera.camera
        where = f"{self.file.path}: colour at byte {block.offset}"
        image = as_color(
            parse_image(self.file.read(block), where, size=(camera.width, camera.height))
        )
        return pixels.sampled_color(frame, image, self.color_camera, where)

    def _matched_blocks(
        self, track: matroska.Track | None, limit: float, delay: int
    ) -> list[matroska.Block | None]:
        """The block of another track at the time of each depth frame, or None."""
        if track is None or not track.blocks:
            return [None] * len(self.depth)
        depth_times = np.array([b.time_ns - delay for b in self.depth]) / 1e9
        pairs = partners(depth_times, np.array([b.time_ns for b in track.blocks]) / 1e9, limit)
        if (pairs < 0).any():
            self.warnings.append(
                f"{int((pairs < 0).sum())} of {len(pairs)} frames have no {track.name} image"
            )
        return [track.blocks[k] if k >= 0 else None for k in pairs]

    def _read_cameras(self, options: ReaderOptions, color: matroska.Track | None) -> None:
        if options.camera is None:
            self._read_calibration(color)
        else:
            with suppress(InputError):  # possibly the reason for a camera passed by the user
                self._read_calibration(color)
            self.use_camera(options.camera, self.size)
        if self.color_camera is None:
            self.color = [None] * len(self.depth)

    def _read_calibration(self, color: matroska.Track | None) -> None:
        name = self.file.tags.get("K4A_CALIBRATION_FILE", "calibration.json")
        where = f"{self.file.path}: {name}"
        self.calibration = _calibration(self.file.attachments.get(name), where)
        lens, T_depth = _lens(self.calibration, "depth", DEPTH_MODES[self.mode], where)
        self.camera = depth_camera(lens)
        if color is not None and color.blocks:
            self.color_camera = self._color_camera(color, T_depth, where)

    def _color_camera(
        self, track: matroska.Track, T_depth: Float64, where: str
    ) -> camera_file.ColorCamera | None:
        fourcc = track.private[16:20]
        if fourcc != b"MJPG":
            self.warnings.append(f"colour is {fourcc!r}, not MJPG: ignored")
            return None
        try:
            size = _image_size(track, self.file.path)
            if size not in COLOR_MODES:
                raise InputError(f"is {size[0]} x {size[1]}, of no known mode", where=where)
            lens, T_color = _lens(self.calibration, "color", COLOR_MODES[size], where)
        except InputError as error:
            self.warnings.append(f"colour is ignored: {error}")
            return None
        return camera_file.ColorCamera(lens, T_color @ np.linalg.inv(T_depth))

    def _sensor(self) -> str:
        calibration = getattr(self, "calibration", {})
        name = str(_get(calibration, "CalibrationInformation", "Metadata", "DeviceName") or "")
        return f"{name[:40]} (ToF)" if "femto" in name.lower() else "Azure Kinect (ToF)"


def _image_size(track: matroska.Track, path: Path) -> tuple[int, int]:
    """(width, height) of a track's images, checked against the header of its bitmaps."""
    if len(track.private) < 20:
        raise InputError(f"describes no images in its track {track.name}", where=path)
    width, height = struct.unpack_from("<ii", track.private, 4)
    fourcc = track.private[16:20]
    if track.name.upper() in ("DEPTH", "IR") and fourcc != b"b16g":
        raise InputError(
            f"stores {track.name} as {fourcc!r}, not b16g",
            where=path,
            remedy="record it with k4arecorder",
        )
    if not (2 <= width <= 8192 and 2 <= height <= 8192):
        raise InputError(f"declares {width} x {height} pixels in {track.name}", where=path)
    return width, height


def _mode(tags: dict[str, str], size: tuple[int, int], path: Path) -> str:
    """The depth mode, identified by its unique image size."""
    tag = tags.get("K4A_DEPTH_MODE", "")
    if tag in DEPTH_MODES and DEPTH_MODES[tag].size == size:
        return tag
    for name, window in DEPTH_MODES.items():
        if window.size == size:
            return name
    raise InputError(
        f"has depth of {size[0]} x {size[1]} pixels, of no known mode",
        where=path,
        remedy="convert it to the native folder to set its camera",
    )


def _calibration(data: bytes | None, where: str) -> dict[str, Any]:
    if data is None:
        raise InputError(
            "is missing", where=where, remedy="pass the depth camera with --camera camera.json"
        )
    return reading.parse_json(data.rstrip(b"\0"), where, "pass the depth camera with --camera")


def _lens(
    calibration: dict[str, Any], camera: str, window: Window, where: str
) -> tuple[KinectLens, Float64]:
    """The lens in a mode, and the transform (4, 4) of points into this camera's frame."""
    where = f"{where}: {camera}"
    remedy = "pass the depth camera with --camera"
    cameras = _get(calibration, "CalibrationInformation", "Cameras")
    matches = [
        c
        for c in (cameras if isinstance(cameras, list) else [])
        if isinstance(c, dict) and c.get("Location") == _LOCATIONS[camera]
    ]
    if not matches:
        raise InputError("there is no such camera", where=where, remedy=remedy)
    data = matches[0]
    model = str(_get(data, "Intrinsics", "ModelType"))
    if model not in _MODELS:
        raise InputError(f"has the model {model:.60}", where=where, remedy=remedy)
    try:
        p = np.array(_get(data, "Intrinsics", "ModelParameters"), float)
        R = np.array(_get(data, "Rt", "Rotation"), float).reshape(3, 3)
        t = np.array(_get(data, "Rt", "Translation"), float).reshape(3)
        radius = float(data.get("MetricRadius") or METRIC_RADIUS)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError("isn't made of numbers", where=where, remedy=remedy) from error
    plausible = p.shape == (14,) and np.isfinite(p).all() and (np.abs(p) < 1e4).all()
    if not plausible or not (0.01 < p[2] < 100 and 0.01 < p[3] < 100):
        raise InputError("isn't 14 plausible ModelParameters", where=where, remedy=remedy)
    if p[10] or p[11]:
        raise InputError("has a shifted centre of distortion", where=where, remedy=remedy)
    full_size, corner = np.array(window.full_size, float), np.array(window.corner, float)
    # Stored relative to the image size, from its corner instead of a pixel's centre.
    cx, cy = p[:2] * full_size - corner - 0.5
    fx, fy = p[2:4] * full_size
    values = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "p1": p[13], "p2": p[12]}
    values |= {f"k{k}": p[3 + k] for k in range(1, 7)}
    lens = KinectLens(
        window.size[0],
        window.size[1],
        metric_radius=radius if 0.01 < radius < 100 else METRIC_RADIUS,
        tangential_factor=_MODELS[model],
        **{name: float(value) for name, value in values.items()},
    )
    return lens, se3.orthonormalise(se3.check_pose(se3.pose(R, t), where=f"{where}: Rt"))


def _get(data: Any, *keys: str) -> Any:
    for key in keys:
        data = data.get(key) if isinstance(data, dict) else None
    return data


def _integer(text: str | None) -> int:
    """The integer value of a tag, 0 if it is missing or invalid."""
    try:
        value = int(text or 0)
    except ValueError:
        return 0
    return value if abs(value) < 1 << 62 else 0
