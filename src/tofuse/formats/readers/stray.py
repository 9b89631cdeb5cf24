"""Reader of Stray Scanner's folders (iPhone and iPad)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64, Intp, UInt8
from tofuse.engine.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import quaternion
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading, tables
from tofuse.formats.images import Video, first_size
from tofuse.formats.sources import Reader, ReaderOptions, Sniff, gravity_at, inputs, phones

FRAME_RATE_HZ = 60.0
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_LENS = ("fx", "fy", "cx", "cy")
# Axes of the phone are x right, y up and z towards the user; the camera's image is rotated by 90
# degrees. Apple's accelerometers measure g downwards at rest.
_IMU = {
    "a_y": ("ax", 1.0),
    "a_x": ("ay", 1.0),
    "a_z": ("az", 1.0),
    "alpha_y": ("wx", -1.0),
    "alpha_x": ("wy", -1.0),
    "alpha_z": ("wz", -1.0),
}


@part("reader", "stray", label="validated")
class Stray(Reader):
    """Stray Scanner: folders with depth/, confidence/, odometry.csv, imu.csv and rgb.mp4."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        if reading.is_folder(path / "depth") and reading.is_file(path / "odometry.csv"):
            return Sniff(1.0, "depth/ and odometry.csv")
        return None

    def open(self, path: Path, options: ReaderOptions) -> StraySource:
        """See `Reader.open`."""
        inputs.refuse_camera(options, "stray", inputs.PER_FRAME)
        return StraySource(path)


class StraySource(phones.PhoneSource):
    """Frames with ARKit's poses, which the app writes in this package's convention.

    Attributes
    ----------
    imu
        Columns of the native imu.csv, in the axes of the depth camera; or None.
    """

    def __init__(self, folder: Path) -> None:
        # Early versions of the app wrote arrays.
        files = reading.files_with(folder / "depth", ".png")
        files = files or reading.files_with(folder / "depth", ".npy")
        inputs.required(files, ".png or .npy files", folder / "depth")
        confidence = {p.stem: p for p in inputs.files_at(folder / "confidence", ".png")}
        super().__init__(
            files,
            np.arange(len(files)) / FRAME_RATE_HZ,
            confidence=[confidence.get(f.stem) for f in files],
            color=[None] * len(files),
        )
        self.numbers = [int(f.stem) if f.stem.isdecimal() else k for k, f in enumerate(files)]
        self.video = self._open_video(folder / "rgb.mp4")
        self.imu = self._read_imu(folder / "imu.csv")
        self._read_odometry(folder)
        if self.imu is not None:
            self.gravity = gravity_at(self.timestamps, self.imu)

    def full_resolution_color(self, index: int) -> UInt8 | None:
        """See `FileSource.full_resolution_color`."""
        return None if self.video is None else self.video.read(self.numbers[index])

    def color_path(self, index: int) -> Path:
        """See `PhoneSource.color_path`."""
        return super().color_path(index) if self.video is None else self.video.path

    def _open_video(self, path: Path) -> Video | None:
        if not reading.is_file(path):
            self.warnings.append(f"{path.name} is missing: there is no colour")
            return None
        try:
            video = Video(path)
        except InputError as error:
            self.warnings.append(f"{error}: colour is ignored")
            return None
        if 0 < video.count <= max(self.numbers):
            self.warnings.append(
                f"{path.name} has {video.count} frames, depth/ counts to {max(self.numbers)}: "
                "colour is ignored"
            )
            return None
        return video

    def _read_imu(self, path: Path) -> dict[str, Float64] | None:
        if not reading.is_file(path):
            return None
        try:
            columns = tables.read_columns(path)
        except InputError as error:
            self.warnings.append(f"{error}: ignored")
            return None
        if not {"timestamp", *_IMU} <= set(columns):
            self.warnings.append(f"{path}: has no columns {', '.join(_IMU)}: ignored")
            return None
        return {"timestamp": columns["timestamp"]} | {
            name: sign * columns[column] for column, (name, sign) in _IMU.items()
        }

    def _read_odometry(self, folder: Path) -> None:
        """Read timestamps, poses and, from newer versions of the app, per-frame intrinsics."""
        path = folder / "odometry.csv"
        columns = tables.read_columns(path)
        missing = [name for name in ("timestamp", "frame", *_POSE) if name not in columns]
        if missing:
            raise InputError(
                f"has no column {missing[0]!r}", where=path, remedy="copy the recording again"
            )
        rows = {int(n): k for k, n in enumerate(columns["frame"]) if np.isfinite(n)}
        row = np.array([rows.get(number, -1) for number in self.numbers])
        nothing = InputError(
            "has no timestamp of any image in depth/", where=path, remedy="copy it again"
        )
        if not rows:
            raise nothing
        # A non-finite value counts as a missing row.
        times = np.where(row < 0, np.nan, columns["timestamp"][row])
        valid = np.isfinite(times)
        if not valid.any():
            raise nothing
        if not valid.all():
            without = quantities.count(int((~valid).sum()), "frame")
            self.warnings.append(f"{path}: {without} without a row: interpolated")
        self.timestamps = inputs.interpolated(times)
        poses = np.full((len(row), 4, 4), np.nan)
        table = np.stack([columns[name] for name in _POSE], 1)[row]
        posed = (row >= 0) & np.isfinite(table).all(1) & (np.abs(table) < 1e6).all(1)
        posed &= np.abs(quaternion.length(np.where(posed[:, None], table, 0)[:, 3:]) - 1) < 0.01
        poses[posed] = quaternion.to_pose(table[posed, 3:], table[posed, :3])
        self.reference = poses if posed.any() else None
        self._read_lenses(folder, columns, row)

    def _read_lenses(self, folder: Path, columns: dict[str, Float64], row: Intp) -> None:
        size = first_size(self.files)
        images = [phones.IMAGE_SIZE]
        if self.video is not None:
            images.append((self.video.width, self.video.height))

        def lens(K: Float64, where: str | Path) -> Pinhole:
            # The video may have been downscaled since: K is of images around its centre.
            image = min(images, key=lambda image: abs(K[0, 2] - image[0] / 2))
            return phones.phone_lens(K, image, size, where)

        if reading.is_file(folder / "camera_matrix.csv"):
            path = folder / "camera_matrix.csv"
            K = tables.read_3x3(path, "copy it again")
            self.cameras = [lens(K, path)] * len(row)
        elif not all(name in columns for name in _LENS):
            raise InputError(
                "is missing, and odometry.csv has no fx, fy, cx, cy",
                where=folder / "camera_matrix.csv",
                remedy="copy the recording again",
            )
        else:
            self.cameras = [InputError("has no row", where=folder / "odometry.csv")] * len(row)
        if all(name in columns for name in _LENS):
            for k in np.flatnonzero(row >= 0):
                fx, fy, cx, cy = (columns[name][row[k]] for name in _LENS)
                K = camera_file.intrinsic_matrix(fx, fy, cx, cy)
                try:
                    self.cameras[k] = lens(K, f"{folder / 'odometry.csv'}, frame {k}")
                except InputError as error:
                    self.cameras[k] = error
