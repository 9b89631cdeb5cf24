"""Azure Kinect, by the package pyk4a."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from tofuse.apps.live import TIMEOUT_S, DeviceError, Settings, Stream, no_frame, not_started, vendor
from tofuse.engine.cameras import Rational
from tofuse.engine.frames import RangeFrame
from tofuse.engine.parts import part

Mode = Literal["NFOV_2X2BINNED", "NFOV_UNBINNED", "WFOV_2X2BINNED", "WFOV_UNBINNED"]


@part("device", "azure-kinect")
@dataclass(frozen=True)
class AzureKinect:
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

    package: ClassVar[tuple[str, str]] = ("pyk4a", "pyk4a")
    mode: Mode = "NFOV_UNBINNED"
    frame_rate_hz: int = 15
    device: int = 0

    def open(self) -> AzureKinectStream:
        """See `Device.open`."""
        return AzureKinectStream(self)


class AzureKinectStream(Stream):
    """See `Stream`."""

    def __init__(self, options: AzureKinect) -> None:
        k4a: Any = vendor(options.package)
        rates = {5: "FPS_5", 15: "FPS_15", 30: "FPS_30"}
        if options.frame_rate_hz not in rates:
            raise DeviceError(
                f"is {options.frame_rate_hz}", where="frame_rate_hz", remedy="use 5, 15 or 30"
            )
        self._errors: tuple[type[Exception], ...] = (k4a.K4AException, k4a.K4ATimeoutException)
        try:
            self._device = k4a.PyK4A(
                k4a.Config(
                    color_resolution=k4a.ColorResolution.OFF,
                    depth_mode=k4a.DepthMode[options.mode],
                    camera_fps=k4a.FPS[rates[options.frame_rate_hz]],
                    synchronized_images_only=False,
                ),
                device_id=options.device,
            )
            self._device.start()
        except self._errors as error:
            raise not_started("Azure Kinect", error) from error
        try:
            # The image size of the mode is not part of the calibration, so it is taken from a
            # frame.
            depth = self._capture().depth
            lens = self._device.calibration
            K = np.asarray(lens.get_camera_matrix(k4a.CalibrationType.DEPTH), float)
            k = np.asarray(lens.get_distortion_coefficients(k4a.CalibrationType.DEPTH), float)
            self.settings = Settings(
                "Azure Kinect",
                Rational(
                    depth.shape[1], depth.shape[0], K[0, 0], K[1, 1], K[0, 2], K[1, 2], *k.ravel()
                ),
                0.001,
                "z",
                float(options.frame_rate_hz),
                "ir",
            )
        except BaseException:
            self.close()
            raise

    def read(self, index: int) -> RangeFrame:
        """See `Stream.read`."""
        capture = self._capture()
        return self.frame(index, capture.depth_timestamp_usec / 1e6, capture.depth, capture.ir)

    def close(self) -> None:
        """See `Stream.close`."""
        self._device.stop()

    def _capture(self) -> Any:
        """Wait for a capture with depth: some have only infrared."""
        for _ in range(8):
            try:
                capture = self._device.get_capture(timeout=int(TIMEOUT_S * 1000))
            except self._errors as error:
                raise no_frame("Azure Kinect") from error
            if capture.depth is not None:
                return capture
        raise no_frame("Azure Kinect")
