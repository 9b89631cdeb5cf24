"""Converting any recording to a native folder, or to the layouts of TUM RGB-D and Open3D."""

from __future__ import annotations

import copy
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64, UInt8
from tofuse.engine.cameras import Camera, Pinhole, RayTable
from tofuse.engine.errors import InputError, UnreadableFrameError
from tofuse.engine.frames import (
    POSES_BY,
    SATURATED_AMPLITUDE,
    CloudFrame,
    Frame,
    RangeFrame,
    Recording,
    depth_counts,
)
from tofuse.engine.noise import NOISE_MODEL
from tofuse.engine.sensor import DepthCorrection
from tofuse.formats.cameras import Rectifier, camera_file, pinhole_of, write_noise
from tofuse.formats.files import atomic, staging
from tofuse.formats.images import write_png
from tofuse.formats.poses import write_log, write_tum
from tofuse.formats.readers import NativeSource
from tofuse.formats.recordings import RecordingWriter
from tofuse.formats.rigs import check_one_camera
from tofuse.formats.sources import GRAVITY

FINEST_UNIT_M = 1e-4
MIN_SIGMA_UNIT_M = 1e-5
_SAMPLED_FRAMES = 24
_MAX_FRACTION = 0.05  # of a count, by the precision of float32
# Median amplitude at which rounding to counts (1.4 % rms) is much less than albedos usually differ
# between views (5 %); and room for the amplitudes of other frames.
_MANY_COUNTS, _HEADROOM = 20.0, 4.0
_CHANNELS = ("amplitude_image", "confidence_image", "color_image")


@dataclass(frozen=True)
class Conversion:
    """The result of a conversion: the folder, the number of frames, and warnings, one line each."""

    folder: Path
    frames: int
    warnings: tuple[str, ...]


def convert(recording: Recording, folder: str | Path) -> Conversion:
    """Write a recording as a native folder.

    Depth keeps its unit, if it is in whole counts of one, and each frame its camera, if they
    differ. Amplitude keeps its counts, and is multiplied by a power of ten if it is in fractions of
    them. A correction is stored with uncorrected depth. The folder appears when all is written.

    Parameters
    ----------
    recording
        Its selected frames are written.
    folder
        Must not exist, or be empty.

    Raises
    ------
    InputError
        If no frame can be read.
    OutputError
        If the folder isn't empty, or can't be written.
    """
    with staging.new_folder(folder) as temporary:
        count, warnings = _write(recording, temporary)
    return Conversion(Path(folder), count, tuple(warnings))


def _write(recording: Recording, folder: Path) -> tuple[int, list[str]]:
    check_one_camera(recording)
    warnings: list[str] = []
    recording, correction = _uncorrected(recording)
    sample = recording.readable(_SAMPLED_FRAMES)
    if not sample:
        raise InputError("no frame can be read", where=recording.path, remedy="check the recording")
    camera_per_frame = not _same_camera(sample)
    writer = _writer(recording, sample, folder, camera_per_frame)
    channels = _channels(sample)
    written: list[int] = []
    ups: list[Float64 | None] = []
    for k, item in enumerate(recording.read_all()):
        if isinstance(item, UnreadableFrameError):
            warnings.append(f"skipped: {item}")
            continue
        if not camera_per_frame and not _same_camera([sample[0], item]):
            raise InputError(
                "has another camera than the frames sampled before",
                where=f"{recording.path}: frame {item.index}",
                remedy="convert the parts of the recording one by one",
            )
        writer.add(_with_channels(item, channels))
        written.append(k)
        ups.append(item.up if isinstance(item, CloudFrame) else None)
    if not written:
        raise InputError("no frame can be read", where=recording.path, remedy="check the recording")
    _finish(recording, writer, written, correction, _gravity_of(ups))
    if writer.out_of_range:
        warnings.append(f"{quantities.count(writer.out_of_range, 'value')} too large for 16 bits")
    clouds = [f for f in sample if isinstance(f, CloudFrame)]
    if any((f.origin + f.shift).any() for f in clouds):
        warnings.append("the sensor's position within its clouds is lost")
    if NOISE_MODEL in recording.metadata:
        write_noise(folder / "noise.json", recording.metadata[NOISE_MODEL])
    return len(written), warnings


def _uncorrected(recording: Recording) -> tuple[Recording, DepthCorrection | None]:
    """A native recording without its depth correction, and the correction."""
    source = recording.source
    if not isinstance(source, NativeSource) or source.correction is None:
        return recording, None
    correction = source.correction
    uncorrected = copy.copy(source)
    uncorrected.correction = None
    return replace(recording, source=uncorrected), correction


def _same_camera(frames: list[Frame]) -> bool:
    cameras = [f.camera for f in frames if isinstance(f, RangeFrame)]
    return all(camera == cameras[0] for camera in cameras)


def _writer(
    recording: Recording, sample: list[Frame], folder: Path, camera_per_frame: bool
) -> RecordingWriter:
    metadata = recording.metadata
    first = sample[0]
    properties: dict[str, Any] = {
        name: metadata.get(name)
        for name in ("frame_rate_hz", "confidence_max", "sensor", "serial", POSES_BY)
    }
    if isinstance(first, CloudFrame):
        return RecordingWriter(folder, None, **properties)
    images = [f for f in sample if isinstance(f, RangeFrame)]
    camera = _common_camera([f.camera for f in images])
    sigmas = [float(f.sigma_image.max()) for f in images if f.sigma_image is not None]
    sigma_unit = metadata.get("sigma_unit_m")
    if sigma_unit is None and sigmas:
        sigma_unit = max(MIN_SIGMA_UNIT_M, _round_up(max(sigmas) / depth_counts.MAX_COUNTS))
    unit = metadata.get("depth_unit_m")
    if unit is None or not all(_is_counted(f, unit) for f in images):
        farthest = max(float(f.depth.max()) for f in images)
        unit = max(FINEST_UNIT_M, _round_up(1.25 * farthest / depth_counts.MAX_COUNTS))
    with_amplitude = [f for f in images if f.amplitude_image is not None]
    if with_amplitude:
        properties["amplitude_kind"] = with_amplitude[0].amplitude_kind
        if NOISE_MODEL not in metadata:  # which is of the recorded counts
            properties["amplitude_factor"] = _amplitude_factor(with_amplitude)
    return RecordingWriter(
        folder,
        camera,
        depth_unit_m=unit,
        depth_kind=first.depth_kind,
        ambiguity_m=first.ambiguity_m or metadata.get("ambiguity_m"),
        sigma_unit_m=sigma_unit if sigmas else None,
        color_registered=all(f.color_registered for f in images),
        camera_per_frame=camera_per_frame,
        **properties,
    )


def _is_counted(frame: RangeFrame, unit_m: float) -> bool:
    """Whether depth is stored in counts of a unit: not as floats in it, such as metres."""
    counts = frame.depth[frame.valid] / unit_m
    return bool((np.abs(counts - np.rint(counts)) < _MAX_FRACTION).all())


def _amplitude_factor(frames: list[RangeFrame]) -> float:
    """The power of ten of counts per unit of amplitude: 1 unless it has fractions that matter."""
    images = [f.amplitude_image for f in frames if f.amplitude_image is not None]
    values = np.concatenate([a[(a > 0) & (a < SATURATED_AMPLITUDE)] for a in images])
    if not len(values) or np.median(values) >= _MANY_COUNTS or (values == np.rint(values)).all():
        return 1.0
    return float(10 ** np.floor(np.log10(SATURATED_AMPLITUDE / _HEADROOM / values.max())))


def _round_up(value: float) -> float:
    """The value, rounded up to two digits."""
    if value <= 0:
        return 0.0
    digit = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(f"{np.ceil(value / digit) * digit:.2g}")


def _common_camera(cameras: list[Camera]) -> Camera:
    """The camera for camera.json: a lens if all frames have its model and distortion, else rays."""
    first = cameras[0]
    if all(camera == first for camera in cameras):
        return first
    if isinstance(first, Pinhole) and all(
        isinstance(c, Pinhole) and camera_file.same_distortion(c, first) for c in cameras
    ):
        return first
    return RayTable(first.rays())


def _channels(sample: list[Frame]) -> tuple[str, ...]:
    """The channels that any frame has: all frames of a native folder have the same."""
    return tuple(
        name for name in _CHANNELS if any(getattr(f, name, None) is not None for f in sample)
    )


def _with_channels(frame: Frame, channels: tuple[str, ...]) -> Frame:
    """The frame with exactly these channels, zeros for missing ones."""
    if isinstance(frame, CloudFrame):
        return frame
    shape = frame.depth.shape
    missing: dict[str, Any] = {}
    for name in channels:
        if getattr(frame, name) is None:
            dtype = np.float32 if name == "amplitude_image" else np.uint8
            missing[name] = np.zeros((*shape, 3) if name == "color_image" else shape, dtype)
    dropped = {n: None for n in _CHANNELS if n not in channels and getattr(frame, n) is not None}
    changes: dict[str, Any] = missing | dropped
    return replace(frame, **changes) if changes else frame


def _finish(
    recording: Recording,
    writer: RecordingWriter,
    written: list[int],
    correction: DepthCorrection | None,
    gravity: dict[str, Float64] | None,
) -> None:
    columns = getattr(recording.source, "frame_columns", None)
    source_indices = recording.indices[written]
    writer.finish(
        groundtruth=None if recording.reference is None else recording.reference[written],
        odometry=None if recording.odometry is None else recording.odometry[written],
        correction=correction,
        imu=getattr(recording.source, "imu", None)
        or (gravity and {"timestamp": recording.timestamps[written]} | gravity),
        frames=None
        if columns is None
        else {
            n: c[source_indices]
            for n, c in columns.items()
            if not (writer.camera_per_frame and n in camera_file.LENS_COLUMNS)
        },
    )


def _gravity_of(ups: list[Float64 | None]) -> dict[str, Float64] | None:
    """The columns of imu.csv that state what is up in clouds; None unless that is known of all."""
    if any(up is None for up in ups):
        return None
    return dict(zip(GRAVITY, -np.array(ups).T, strict=True))


Layout = Literal["tum", "open3d"]
COUNTS_PER_M: dict[Layout, int] = {"tum": 5000, "open3d": 1000}
_WHITE_PERCENTILE = 99.0  # of the amplitude that is shown as white


def convert_to(recording: Recording, folder: str | Path, layout: Layout) -> Conversion:
    """Write a recording's images in another layout.

    Both layouts support only pinhole cameras, z depth in counts of 0.2 mm (TUM) or 1 mm (Open3D),
    and colour at the pixels of depth. So images are rectified; without colour, amplitude is written
    as grey, with the same scale in all images. Confidence and noise are lost.

    Parameters
    ----------
    recording
        Range images.
    folder
        Must not exist, or be empty. It appears when all is written.
    layout
        The layout.

    Raises
    ------
    InputError
        If the recording contains clouds, or no frame can be read.
    OutputError
        If the folder isn't empty, or can't be written.
    """
    with staging.new_folder(folder) as temporary:
        count, warnings = _write_layout(recording, temporary, layout)
    return Conversion(Path(folder), count, tuple(warnings))


def _write_layout(recording: Recording, folder: Path, layout: Layout) -> tuple[int, list[str]]:
    check_one_camera(recording)
    warnings: list[str] = []
    color_folder = "rgb" if layout == "tum" else "color"
    rectifier: Rectifier | None = None
    white, has_color, unregistered = 0.0, False, False
    written: list[int] = []
    out_of_range = 0
    for k, item in enumerate(recording.read_all()):
        if isinstance(item, UnreadableFrameError):
            warnings.append(f"skipped: {item}")
            continue
        if not isinstance(item, RangeFrame):
            raise InputError(
                "contains clouds, which these layouts don't support", where=recording.path,
                remedy="convert it to the native folder",
            )  # fmt: skip
        if rectifier is None:
            rectifier = Rectifier(pinhole_of(item.camera))
            if rectifier.pinhole != item.camera:
                warnings.append("images are rectified: these layouts support only pinhole cameras")
        if not white and item.amplitude_image is not None and (item.amplitude_image > 0).any():
            positive = item.amplitude_image[item.amplitude_image > 0]
            white = float(np.percentile(positive, _WHITE_PERCENTILE))
        has_color |= item.color_image is not None
        unregistered |= item.color_image is not None and not item.color_registered
        frame = rectifier(item)
        counts = np.rint(frame.z.astype(float) * COUNTS_PER_M[layout])
        out_of_range += int((counts >= depth_counts.MAX_COUNTS).sum())
        counts[counts >= depth_counts.MAX_COUNTS] = 0
        name = f"{_name(len(written), item.timestamp - float(recording.timestamps[0]))}.png"
        write_png(atomic.make_folder(folder / "depth") / name, counts.astype(np.uint16))
        write_png(atomic.make_folder(folder / color_folder) / name, _color(frame, white))
        written.append(k)
    if rectifier is None:
        raise InputError("no frame can be read", where=recording.path, remedy="check the recording")
    if not (white or has_color):
        warnings.append("there is neither colour nor amplitude: colour images are black")
    if unregistered:
        warnings.append(
            "colour is not registered to depth, but programs that read these layouts assume it is"
        )
    if out_of_range:
        farthest = depth_counts.MAX_COUNTS / COUNTS_PER_M[layout]
        warnings.append(
            f"{quantities.count(out_of_range, 'pixel')} beyond {farthest:.1f} m left out"
        )
    finish = _finish_tum if layout == "tum" else _finish_open3d
    finish(recording, folder, rectifier.pinhole, written)
    return len(written), warnings


def _name(number: int, seconds: float) -> str:
    """Name an image as Open3D's examples do: its number, and the microseconds since the first."""
    return f"{number:06d}-{max(0, round(seconds * 1e6)):012d}"


def _color(frame: RangeFrame, white: float) -> UInt8:
    if frame.color_image is not None:
        return frame.color_image
    grey = np.zeros(frame.depth.shape, np.uint8)
    if frame.amplitude_image is not None and white > 0:
        grey = (255 * np.sqrt((frame.amplitude_image / white).clip(0, 1))).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def _finish_tum(recording: Recording, folder: Path, camera: Pinhole, written: list[int]) -> None:
    times = recording.timestamps[written]
    for name in ("depth", "rgb"):
        lines = [
            f"{time:.6f} {name}/{_name(k, time - recording.timestamps[0])}.png\n"
            for k, time in enumerate(times)
        ]
        atomic.write_text(folder / f"{name}.txt", "# timestamp filename\n" + "".join(lines))
    if recording.reference is not None:
        write_tum(folder / "groundtruth.txt", times, recording.reference[written])
    # The layout does not store the camera; our reader takes this file for it.
    description = {"schema": camera_file.SCHEMA, **camera_file.camera_fields(camera)}
    description |= {"depth_unit_m": 1 / COUNTS_PER_M["tum"], "depth_kind": "z"}
    atomic.write_text(folder / "lens.json", json.dumps(description, indent=1) + "\n")


def _finish_open3d(recording: Recording, folder: Path, camera: Pinhole, written: list[int]) -> None:
    columns = [camera.fx, 0.0, 0.0, 0.0, camera.fy, 0.0, camera.cx, camera.cy, 1.0]
    description = {"width": camera.width, "height": camera.height, "intrinsic_matrix": columns}
    atomic.write_text(folder / "camera_intrinsic.json", json.dumps(description, indent=1) + "\n")
    if recording.reference is not None:
        poses = recording.reference[written]
        posed = np.isfinite(poses[:, 0, 0])
        write_log(folder / "trajectory.log", poses[posed], np.flatnonzero(posed))
