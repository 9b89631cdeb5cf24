"""Azure Kinect, by the package pyk4a."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from tofuse.apps.live import Device, DeviceError, Settings, Stream
from tofuse.engine.cameras import Rational
from tofuse.engine.frames import RangeFrame
from tofuse.engine.parts import part

Mode = Literal["NFOV_2X2BINNED", "NFOV_UNBINNED", "WFOV_2X2BINNED", "WFOV_UNBINNED"]


class AzureKinectStream(Stream):
    """See `Stream`."""

    def start(self, package: Any, options: Any) -> None:
        """See `Stream.start`."""
        rates = {5: "FPS_5", 15: "FPS_15", 30: "FPS_30"}
        if options.frame_rate_hz not in rates:
            raise DeviceError(
                f"is {options.frame_rate_hz}", where="frame_rate_hz", remedy="use 5, 15 or 30"
            )
        self._k4a = package
        self._frame_rate_hz = float(options.frame_rate_hz)
        config = package.Config(
            color_resolution=package.ColorResolution.OFF,
            depth_mode=package.DepthMode[options.mode],
            camera_fps=package.FPS[rates[options.frame_rate_hz]],
            synchronized_images_only=False,
        )
        self._device = package.PyK4A(config, device_id=options.device)
        self._device.start()

    def read_settings(self) -> Settings:
        """See `Stream.read_settings`."""
        # The image size of the mode is not part of the calibration, so it is taken from a frame.
        rows, columns = self.wait().depth.shape
        lens, sensor = self._device.calibration, self._k4a.CalibrationType.DEPTH
        K = np.asarray(lens.get_camera_matrix(sensor), float)
        k = np.asarray(lens.get_distortion_coefficients(sensor), float)
        camera = Rational(columns, rows, K[0, 0], K[1, 1], K[0, 2], K[1, 2], *k.ravel())
        return Settings("Azure Kinect", camera, 0.001, "z", self._frame_rate_hz, "ir")

    def read(self, index: int) -> RangeFrame:
        """See `Stream.read`."""
        capture = self.wait()
        return self.frame(index, capture.depth_timestamp_usec / 1e6, capture.depth, capture.ir)

    def close(self) -> None:
        """See `Stream.close`."""
        self._device.stop()

    def poll(self, timeout_s: float) -> Any:
        """See `Stream.poll`."""
        try:
            capture = self._device.get_capture(timeout=int(timeout_s * 1000))
        except self._k4a.K4ATimeoutException:
            return None
        return None if capture.depth is None else capture


@part("device", "azure-kinect")
@dataclass(frozen=True)
class AzureKinect(Device):
    """An Azure Kinect: depth and the infrared image.

    Attributes
    ----------
    mode
        Field of view and resolution.
    frame_rate_hz
        5, 15 or 30; at most 15 with WFOV_UNBINNED.
    device
        Number of the camera, if several are connected.
    """

    maker: ClassVar[str] = "Azure Kinect"
    package: ClassVar[tuple[str, str]] = ("pyk4a", "pyk4a")
    stream: ClassVar[type[Stream]] = AzureKinectStream
    mode: Mode = "NFOV_UNBINNED"
    frame_rate_hz: int = 15
    device: int = 0
