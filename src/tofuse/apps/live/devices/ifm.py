"""Heads of ifm's O3R, by the package ifm3dpy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tofuse.apps.live import Device, Settings, Stream
from tofuse.engine.frames import RangeFrame
from tofuse.engine.parts import part
from tofuse.formats.readers import head_camera, head_frame, read_info


class IfmO3rStream(Stream):
    """See `Stream`."""

    def start(self, package: Any, options: Any) -> None:
        """See `Stream.start`."""
        from ifm3dpy.device import O3R
        from ifm3dpy.framegrabber import FrameGrabber, buffer_id

        self._id: Any = buffer_id
        unit, port = O3R(options.address), options.port
        self._grabber = FrameGrabber(unit, pcic_port=unit.port(port).pcic_port)
        unit.set({"ports": {port: {"state": "RUN"}}})
        images = ("RADIAL_DISTANCE_IMAGE", "RADIAL_DISTANCE_NOISE", "NORM_AMPLITUDE_IMAGE")
        buffers = (*images, "CONFIDENCE_IMAGE", "TOF_INFO")
        self._grabber.start([getattr(buffer_id, name) for name in buffers])
        state = unit.get([f"/ports/{port}"])["ports"][port]
        self._frame_rate_hz = float(state.get("acquisition", {}).get("framerate", 10.0))

    def read_settings(self) -> Settings:
        """See `Stream.read_settings`."""
        frame = self.wait()
        info = bytes(frame.get_buffer(self._id.TOF_INFO))
        self._info = read_info(info, "ifm O3R: TOF_INFO")
        height, width = self._buffer(frame, "RADIAL_DISTANCE_IMAGE").shape
        camera = head_camera(self._info, width, height, "ifm O3R")
        unit_m = self._info.distance_unit_m
        return Settings("ifm O3R (ToF)", camera, unit_m, "range", self._frame_rate_hz, "raw")

    def read(self, index: int) -> RangeFrame:
        """See `Stream.read`."""
        frame = self.wait()
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

    def poll(self, timeout_s: float) -> Any:
        """See `Stream.poll`."""
        arrived, frame = self._grabber.wait_for_frame().wait_for(int(timeout_s * 1000))
        return frame if arrived else None

    def _buffer(self, frame: Any, name: str) -> NDArray[Any]:
        return np.asarray(frame.get_buffer(getattr(self._id, name)))


@part("device", "ifm-o3r")
@dataclass(frozen=True)
class IfmO3r(Device):
    """A head of an O3R: radial range, its standard deviation, amplitude.

    Attributes
    ----------
    address
        Network address of the processing unit.
    port
        Port of the head.
    """

    maker: ClassVar[str] = "ifm O3R"
    package: ClassVar[tuple[str, str]] = ("ifm3dpy", "ifm3dpy")
    stream: ClassVar[type[Stream]] = IfmO3rStream
    address: str = "192.168.0.69"
    port: str = "port2"
