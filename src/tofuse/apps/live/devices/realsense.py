"""Intel RealSense cameras, by the package pyrealsense2."""

from __future__ import annotations

from dataclasses import dataclass
from time import monotonic
from typing import Any, ClassVar

import numpy as np

from tofuse.apps.live import Device, DeviceError, Settings, Stream
from tofuse.engine.cameras import BrownConrady, Camera, Pinhole
from tofuse.engine.frames import RangeFrame
from tofuse.engine.parts import part
from tofuse.formats.cameras import lenses

_CLOCK_S = 1.0  # until frames have times by the computer's clock


class RealSenseStream(Stream):
    """See `Stream`."""

    def start(self, package: Any, options: Any) -> None:
        """See `Stream.start`."""
        self._rs, self._pipeline = package, package.pipeline()
        config = package.config()
        if options.serial:
            config.enable_device(options.serial)
        size = (options.width, options.height)
        stream, rate = package.stream, options.frame_rate_hz
        self._infrared = _is_tof(package, options.serial)
        config.enable_stream(stream.depth, *size, package.format.z16, rate)
        if self._infrared:
            config.enable_stream(stream.infrared, *size, package.format.y8, rate)
        self._profile = self._pipeline.start(config)

    def read_settings(self) -> Settings:
        """See `Stream.read_settings`."""
        self._settle_clock()
        device = self._profile.get_device()
        stream = self._profile.get_stream(self._rs.stream.depth).as_video_stream_profile()
        return Settings(
            str(device.get_info(self._rs.camera_info.name)),
            _camera(self._rs, stream.get_intrinsics()),
            float(device.first_depth_sensor().get_depth_scale()),
            "z",
            float(stream.fps()),
            "ir" if self._infrared else None,
        )

    def read(self, index: int) -> RangeFrame:
        """See `Stream.read`."""
        frames = self.wait()
        depth = frames.get_depth_frame()
        infrared = frames.get_infrared_frame() if self._infrared else None
        return self.frame(
            index,
            depth.get_timestamp() / 1000.0,
            np.asanyarray(depth.get_data()),
            np.asanyarray(infrared.get_data()) if infrared else None,
        )

    def poll(self, timeout_s: float) -> Any:
        """See `Stream.poll`."""
        arrived, frames = self._pipeline.try_wait_for_frames(int(timeout_s * 1000))
        return frames if arrived and frames.get_depth_frame() else None  # false where missing

    def _settle_clock(self) -> None:
        """Skip the first frames, whose times may be by the camera's clock, not yet the computer's.

        If that lasts, later times are by the camera's clock, too.
        """
        sensor, clock = self._profile.get_device().first_depth_sensor(), self._rs.timestamp_domain
        of_computer = self._rs.option.global_time_enabled
        if not (sensor.supports(of_computer) and sensor.get_option(of_computer)):
            return
        end = monotonic() + _CLOCK_S
        while monotonic() < end:
            depth = self.wait().get_depth_frame()
            if depth.get_frame_timestamp_domain() != clock.hardware_clock:
                return
        sensor.set_option(of_computer, 0.0)

    def close(self) -> None:
        """See `Stream.close`."""
        self._pipeline.stop()


@part("device", "realsense")
@dataclass(frozen=True)
class RealSense(Device):
    """A RealSense: depth, and the infrared image of ToF models (L515).

    Attributes
    ----------
    serial
        Serial number of the camera, if several are connected.
    width, height
        Of the depth image; 0 for the camera's default.
    frame_rate_hz
        An integer rate that the camera supports.
    """

    maker: ClassVar[str] = "RealSense"
    package: ClassVar[tuple[str, str]] = ("pyrealsense2", "pyrealsense2")
    stream: ClassVar[type[Stream]] = RealSenseStream
    serial: str = ""
    width: int = 0
    height: int = 0
    frame_rate_hz: int = 30


def _is_tof(rs: Any, serial: str) -> bool:
    """Whether the camera is of the L500 line, whose infrared image has the pixels of depth."""
    cameras = [
        camera
        for camera in rs.context().query_devices()
        if serial in ("", camera.get_info(rs.camera_info.serial_number))
    ]
    if not cameras:
        raise DeviceError(
            f"no camera {serial} is connected" if serial else "no camera is connected",
            where="RealSense",
            remedy="connect it, or pass its number with --set serial=NUMBER",
        )
    return str(cameras[0].get_info(rs.camera_info.product_line)) == "L500"


def _camera(rs: Any, lens: Any) -> Camera:
    size = (int(lens.width), int(lens.height))
    intrinsics = (float(lens.fx), float(lens.fy), float(lens.ppx), float(lens.ppy))
    coefficients = [float(c) for c in lens.coeffs]
    if lens.model == rs.distortion.none or not any(coefficients):
        return Pinhole(*size, *intrinsics)
    if lens.model == rs.distortion.brown_conrady:
        return BrownConrady(*size, *intrinsics, *coefficients)
    if lens.model == rs.distortion.inverse_brown_conrady:
        return lenses.inverse_brown(BrownConrady(*size, *intrinsics, *coefficients))
    raise DeviceError(
        f"has a lens of the model {lens.model}",
        where="RealSense",
        remedy="record the undistorted stream, or pass a camera.json with rays",
    )
