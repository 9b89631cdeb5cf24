"""Orbbec's cameras (Femto, Gemini, Astra), by the package pyorbbecsdk."""

from __future__ import annotations

from dataclasses import dataclass
from time import monotonic
from typing import Any, ClassVar

import numpy as np

from tofuse.apps.live import TIMEOUT_S, DeviceError, Settings, Stream, no_frame, not_started, vendor
from tofuse.engine.arrays import Float32
from tofuse.engine.cameras import DISTORTION_ORDER, Camera
from tofuse.engine.frames import RangeFrame
from tofuse.engine.parts import part
from tofuse.formats.cameras import lenses

_POLL_MS = 100


@part("device", "orbbec")
@dataclass(frozen=True)
class Orbbec:
    """An Orbbec camera: depth, and the infrared image of the same sensor if it has one.

    Attributes
    ----------
    infrared
        Whether to record the infrared image.
    """

    package: ClassVar[tuple[str, str]] = ("pyorbbecsdk", "pyorbbecsdk")
    infrared: bool = True

    def open(self) -> OrbbecStream:
        """See `Device.open`."""
        return OrbbecStream(self)


class OrbbecStream(Stream):
    """See `Stream`."""

    def __init__(self, options: Orbbec) -> None:
        ob: Any = vendor(options.package)
        try:
            self._pipeline = ob.Pipeline()
            config = ob.Config()
            profile = _default_profile(self._pipeline, ob.OBSensorType.DEPTH_SENSOR)
            config.enable_stream(profile)
            size = (int(profile.get_width()), int(profile.get_height()))
            self._infrared = options.infrared and _add_infrared(ob, self._pipeline, config, size)
            self._pipeline.start(config)
        except ob.OBError as error:
            raise not_started("Orbbec", error) from error
        try:
            depth = self._frames().get_depth_frame()
            name = self._pipeline.get_device().get_device_info().get_name()
            self.settings = Settings(
                str(name),
                _camera(profile.get_intrinsic(), profile.get_distortion(), size),
                float(depth.get_depth_scale()) / 1000.0,
                "z",
                float(profile.get_fps()),
                "ir" if self._infrared else None,
            )
        except BaseException:
            self._pipeline.stop()
            raise

    def read(self, index: int) -> RangeFrame:
        """See `Stream.read`."""
        frames = self._frames()
        depth = frames.get_depth_frame()
        amplitude = None
        if self._infrared:
            infrared = frames.get_ir_frame()
            amplitude = (
                np.zeros((self.settings.camera.height, self.settings.camera.width), np.float32)
                if infrared is None
                else _image(infrared)
            )
        return self.frame(index, depth.get_timestamp() / 1000.0, _image(depth), amplitude)

    def close(self) -> None:
        """See `Stream.close`."""
        self._pipeline.stop()

    def _frames(self) -> Any:
        """Wait for frames with depth: a camera that is starting or disconnected returns None."""
        end = monotonic() + TIMEOUT_S
        while monotonic() < end:
            frames = self._pipeline.wait_for_frames(_POLL_MS)
            if frames is not None and frames.get_depth_frame() is not None:
                return frames
        raise no_frame("Orbbec")


def _default_profile(pipeline: Any, sensor: Any) -> Any:
    return pipeline.get_stream_profile_list(sensor).get_default_video_stream_profile()


def _add_infrared(ob: Any, pipeline: Any, config: Any, size: tuple[int, int]) -> bool:
    """Enable the infrared image, if the camera has one with the pixels of depth."""
    try:
        profile = _default_profile(pipeline, ob.OBSensorType.IR_SENSOR)
    except ob.OBError:
        return False
    if (profile.get_width(), profile.get_height()) != size:
        return False
    config.enable_stream(profile)
    return True


def _image(frame: Any) -> Float32:
    height, width = int(frame.get_height()), int(frame.get_width())
    data = np.frombuffer(frame.get_data(), np.uint8)
    if data.size == 2 * height * width:
        data = data.view(np.uint16)
    if data.size != height * width:
        raise DeviceError(
            f"sent {data.size} bytes for {width} x {height} pixels",
            where="Orbbec",
            remedy="choose an uncompressed format (Y16, Y8) in the camera's settings",
        )
    return data.reshape(height, width).astype(np.float32)


def _camera(lens: Any, distortion: Any, size: tuple[int, int]) -> Camera:
    intrinsics = {name: float(getattr(lens, name)) for name in ("fx", "fy", "cx", "cy")}
    coefficients = {name: float(getattr(distortion, name)) for name in DISTORTION_ORDER["rational"]}
    return lenses.simplest_lens(size, intrinsics, coefficients, "Orbbec")
