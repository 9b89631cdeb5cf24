"""Writes native recordings: folders of PNG images (or PLY clouds), described by a camera.json."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofuse.engine.arrays import Float32, UInt16
from tofuse.engine.cameras import Camera, Pinhole, RayTable
from tofuse.engine.errors import InputError, OutputError
from tofuse.engine.frames import (
    SATURATED_AMPLITUDE,
    CloudFrame,
    DepthKind,
    Frame,
    RangeFrame,
    depth_counts,
)
from tofuse.engine.fusion import GeometryRecord
from tofuse.engine.sensor import DepthCorrection
from tofuse.formats.cameras import camera_file, write_correction
from tofuse.formats.files import atomic, tables
from tofuse.formats.geometry import write_ply
from tofuse.formats.images import write_png
from tofuse.formats.poses import write_tum


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
    frame_rate_hz, ambiguity_m, confidence_max, amplitude_kind, sensor, serial, poses_by
        See `CameraFile`; None: not written.
    sigma_unit_m
        Metres per count of sigma; None: frames' sigma is not written.
    amplitude_factor
        Counts that are written per count of amplitude.
    color_registered
        Whether colour is registered to depth.
    camera_per_frame
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
        serial: str | None = None,
        poses_by: str | None = None,
        sigma_unit_m: float | None = None,
        amplitude_factor: float = 1.0,
        color_registered: bool = True,
        camera_per_frame: bool = False,
    ) -> None:
        self.folder = atomic.make_folder(folder)
        if any(self.folder.iterdir()):
            raise OutputError("isn't empty", where=self.folder, remedy="choose a new folder")
        self.camera = camera
        self.depth_unit_m, self.depth_kind = depth_unit_m, depth_kind
        self.sigma_unit_m, self.camera_per_frame = sigma_unit_m, camera_per_frame
        self.amplitude_factor = amplitude_factor
        self.out_of_range = 0
        self._lenses: list[tuple[float, ...]] = []
        self._channels: frozenset[str] | None = None
        self._times: list[float] = []
        self._description: dict[str, Any] = {"schema": camera_file.SCHEMA}
        if camera is not None:
            self._description |= camera_file.camera_fields(camera)
            self._description |= {"depth_unit_m": float(depth_unit_m), "depth_kind": depth_kind}
        optional: dict[str, Any] = {
            "frame_rate_hz": frame_rate_hz,
            "ambiguity_m": ambiguity_m,
            "confidence_max": confidence_max,
            "amplitude_kind": amplitude_kind,
            "sensor": sensor,
            "serial": serial,
            "poses_by": poses_by,
            "sigma_unit_m": sigma_unit_m,
            "color_registered": None if color_registered else False,
        }
        self._description |= {key: value for key, value in optional.items() if value is not None}

    def __len__(self) -> int:
        return len(self._times)

    def add(self, frame: Frame) -> None:
        """Write the next frame.

        Raises
        ------
        InputError
            If the frame has another size, kind or set of channels than the first.
        OutputError
            If it can't be written; nothing of it is left.
        """
        try:
            if isinstance(frame, CloudFrame):
                self._write_cloud(frame)
            else:
                self._write_images(frame)
        except OutputError:
            self._remove_files()
            raise
        self._times.append(float(frame.timestamp))

    def remove_last(self) -> None:
        """Remove the last frame."""
        self._times.pop()
        del self._lenses[len(self) :]
        self._remove_files()

    def _remove_files(self) -> None:
        """Remove the files of the frame that would be the next."""
        for path in self.folder.glob(f"*/{len(self):06d}.*"):
            path.unlink()

    def _frame_path(self, channel: str, suffix: str) -> Path:
        return atomic.make_folder(self.folder / channel) / f"{len(self):06d}{suffix}"

    def _write_cloud(self, frame: CloudFrame) -> None:
        if self.camera is not None:
            raise InputError("is a cloud", where=f"frame {frame.index}", remedy="add only images")
        self._check_channels(frame, "cloud")
        write_ply(
            self._frame_path("cloud", ".ply"),
            GeometryRecord(
                frame.points + frame.shift if frame.shift.any() else frame.points,
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
        write_png(self._frame_path("depth", ".png"), self._counts(depth))
        stored: dict[str, Callable[[Any], UInt16]] = {
            "amplitude": self._amplitude,
            "sigma": self._sigma,
        }
        for name, image in images.items():
            if image is not None:
                pixels = stored[name](image) if name in stored else image.astype(np.uint8)
                write_png(self._frame_path(name, ".png"), pixels)
        if self.camera_per_frame:
            self._write_camera(frame.camera, camera)

    def _write_camera(self, camera: Camera, common: Camera) -> None:
        if isinstance(common, Pinhole):
            if not isinstance(camera, Pinhole) or not camera_file.same_distortion(camera, common):
                raise InputError(
                    "has another lens model than the first",
                    where=f"frame {len(self)}",
                    remedy="use a RayTable as the common camera",
                )
            self._lenses.append((camera.fx, camera.fy, camera.cx, camera.cy))
            return
        with (
            atomic.replacing(self._frame_path("rays", ".npy")) as temporary,
            temporary.open("wb") as file,
        ):
            np.save(file, np.asarray(camera.rays(), np.float32))

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
        overflow = counts >= depth_counts.INVALID_DEPTH
        self.out_of_range += int(overflow.sum())
        return np.where(overflow, 0, counts).astype(np.uint16)

    def _sigma(self, sigma: Float32) -> UInt16:
        counts = np.rint(sigma.astype(float) / (self.sigma_unit_m or 1.0))
        return np.clip(counts, 0, depth_counts.MAX_COUNTS).astype(np.uint16)

    def _amplitude(self, amplitude: Float32) -> UInt16:
        is_saturated = amplitude == SATURATED_AMPLITUDE
        scaled = np.where(is_saturated, amplitude, self.amplitude_factor * amplitude.astype(float))
        counts = np.rint(np.nan_to_num(scaled))
        overflow = (counts >= SATURATED_AMPLITUDE) & ~is_saturated
        self.out_of_range += int(overflow.sum())
        counts[overflow] = SATURATED_AMPLITUDE - 1
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
        """Write the files common to all frames, camera.json last, and return the folder.

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
            with atomic.replacing(self.folder / "correction.npz") as temporary:
                write_correction(temporary, correction)
        if imu is not None:
            tables.write_columns(self.folder / "imu.csv", imu)
        if self._lenses:
            columns = dict(zip(camera_file.LENS_COLUMNS, np.array(self._lenses).T, strict=True))
            frames = {**(frames or {}), **columns}
        if frames is not None:
            if any(len(column) != len(self) for column in frames.values()):
                raise InputError(
                    f"columns don't have {len(self)} values", where=self.folder / "frames.csv"
                )
            tables.write_columns(self.folder / "frames.csv", frames)
        if isinstance(self.camera, RayTable):
            with atomic.replacing(self.folder / "rays.npy") as temporary:
                np.save(temporary, np.asarray(self.camera.table, np.float32))
        atomic.write_text(
            self.folder / "timestamps.txt", "".join(tables.exact(t) + "\n" for t in self._times)
        )
        atomic.write_text(
            self.folder / "camera.json", json.dumps(self._description, indent=1) + "\n"
        )
        return self.folder
