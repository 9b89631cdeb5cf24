"""Heads of ifm's O3R, by the package ifm3dpy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tofuse.apps.live import TIMEOUT_S, Settings, Stream, no_frame, not_started, vendor
from tofuse.engine.frames import RangeFrame
from tofuse.engine.parts import part
from tofuse.formats.readers import head_camera, head_frame, read_info


@part("device", "ifm-o3r")
@dataclass(frozen=True)
class IfmO3r:
    """A head of an O3R: radial range, its standard deviation, amplitude.

    Attributes
    ----------
    address
        Network address of the processing unit.
    port
        Port of the head.
    """

    package: ClassVar[tuple[str, str]] = ("ifm3dpy", "ifm3dpy")
    address: str = "192.168.0.69"
    port: str = "port2"

    def open(self) -> IfmO3rStream:
        """See `Device.open`."""
        return IfmO3rStream(self)


class IfmO3rStream(Stream):
    """See `Stream`."""

    def __init__(self, options: IfmO3r) -> None:
        vendor(options.package)
        from ifm3dpy.device import O3R, Error
        from ifm3dpy.framegrabber import FrameGrabber, buffer_id

        self._id: Any = buffer_id
        try:
            unit = O3R(options.address)
            self._grabber = FrameGrabber(unit, pcic_port=unit.port(options.port).pcic_port)
            unit.set({"ports": {options.port: {"state": "RUN"}}})
            self._grabber.start(
                [
                    buffer_id.RADIAL_DISTANCE_IMAGE,
                    buffer_id.RADIAL_DISTANCE_NOISE,
                    buffer_id.NORM_AMPLITUDE_IMAGE,
                    buffer_id.CONFIDENCE_IMAGE,
                    buffer_id.TOF_INFO,
                ]
            )
            state = unit.get([f"/ports/{options.port}"])["ports"][options.port]
        except Error as error:
            raise not_started(f"ifm O3R at {options.address}", error) from error
        try:
            frame = self._wait()
            self._info = read_info(bytes(frame.get_buffer(buffer_id.TOF_INFO)), "ifm O3R: TOF_INFO")
            height, width = self._buffer(frame, "RADIAL_DISTANCE_IMAGE").shape
            rate = state.get("acquisition", {}).get("framerate", 10.0)
            self.settings = Settings(
                "ifm O3R (ToF)",
                head_camera(self._info, width, height, "ifm O3R"),
                self._info.distance_unit_m,
                "range",
                float(rate),
                "raw",
            )
        except BaseException:
            self.close()
            raise

    def read(self, index: int) -> RangeFrame:
        """See `Stream.read`."""
        frame = self._wait()
        return head_frame(
            index,
            frame.timestamps()[0].timestamp(),
            self._info,
            "ifm O3R",
            self._buffer(frame, "RADIAL_DISTANCE_IMAGE"),
            flags=self._buffer(frame, "CONFIDENCE_IMAGE"),
            noise=self._buffer(frame, "RADIAL_DISTANCE_NOISE"),
            amplitude=self._buffer(frame, "NORM_AMPLITUDE_IMAGE"),
        )

    def close(self) -> None:
        """See `Stream.close`."""
        self._grabber.stop().wait()

    def _wait(self) -> Any:
        arrived, frame = self._grabber.wait_for_frame().wait_for(int(TIMEOUT_S * 1000))
        if not arrived:
            raise no_frame("ifm O3R")
        return frame

    def _buffer(self, frame: Any, name: str) -> NDArray[Any]:
        return np.asarray(frame.get_buffer(getattr(self._id, name)))
