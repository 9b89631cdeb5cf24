"""Converting any recording to the folder layouts of TUM RGB-D and Open3D."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

import numpy as np

from tofuse.arrays import UInt8
from tofuse.errors import InputError, UnreadableFrameError
from tofuse.files.atomic import make_folder, write_text
from tofuse.files.images import write_png
from tofuse.files.staging import new_folder
from tofuse.files.trajectory import write_log, write_tum
from tofuse.geometry.cameras import Pinhole
from tofuse.recordings.camera_file import SCHEMA, camera_fields
from tofuse.recordings.convert import Conversion
from tofuse.recordings.depth_counts import MAX_COUNTS
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.recording import Recording
from tofuse.recordings.rectify import Rectifier, pinhole_of

Layout = Literal["tum", "open3d"]
COUNTS_PER_M: dict[Layout, int] = {"tum": 5000, "open3d": 1000}
_WHITE_PERCENTILE = 99.0  # of the amplitude that is shown as white


def convert_to(
    recording: Recording,
    folder: str | Path,
    layout: Layout,
) -> Conversion:
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
    with new_folder(folder) as temporary:
        count, warnings = _write(recording, temporary, layout)
    return Conversion(Path(folder), count, tuple(warnings))


def _write(recording: Recording, folder: Path, layout: Layout) -> tuple[int, list[str]]:
    warnings: list[str] = []
    color_folder = "rgb" if layout == "tum" else "color"
    rectifier: Rectifier | None = None
    white = 0.0
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
            if item.color_image is None and item.amplitude_image is None:
                warnings.append("there is neither colour nor amplitude: colour images are black")
            elif item.amplitude_image is not None and item.amplitude_image.any():
                positive = item.amplitude_image[item.amplitude_image > 0]
                white = float(np.percentile(positive, _WHITE_PERCENTILE))
        frame = rectifier(item)
        counts = np.rint(frame.z.astype(float) * COUNTS_PER_M[layout])
        out_of_range += int((counts >= MAX_COUNTS).sum())
        counts[counts >= MAX_COUNTS] = 0
        name = f"{_name(len(written), item.timestamp - float(recording.timestamps[0]))}.png"
        write_png(make_folder(folder / "depth") / name, counts.astype(np.uint16))
        write_png(make_folder(folder / color_folder) / name, _color(frame, white))
        written.append(k)
    if rectifier is None:
        raise InputError("no frame can be read", where=recording.path, remedy="check the recording")
    if out_of_range:
        farthest = MAX_COUNTS / COUNTS_PER_M[layout]
        warnings.append(f"{out_of_range} pixels beyond {farthest:.1f} m don't fit, and are dropped")
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
        write_text(folder / f"{name}.txt", "# timestamp filename\n" + "".join(lines))
    if recording.reference is not None:
        write_tum(folder / "groundtruth.txt", times, recording.reference[written])
    # The layout does not store the camera; this file is for --camera.
    description = {"schema": SCHEMA, **camera_fields(camera)}
    description |= {"depth_unit_m": 1 / COUNTS_PER_M["tum"], "depth_kind": "z"}
    write_text(folder / "lens.json", json.dumps(description, indent=1) + "\n")


def _finish_open3d(recording: Recording, folder: Path, camera: Pinhole, written: list[int]) -> None:
    columns = [camera.fx, 0.0, 0.0, 0.0, camera.fy, 0.0, camera.cx, camera.cy, 1.0]
    description = {"width": camera.width, "height": camera.height, "intrinsic_matrix": columns}
    write_text(folder / "camera_intrinsic.json", json.dumps(description, indent=1) + "\n")
    if recording.reference is not None:
        poses = recording.reference[written]
        posed = np.isfinite(poses[:, 0, 0])
        write_log(folder / "trajectory.log", poses[posed], np.flatnonzero(posed))
