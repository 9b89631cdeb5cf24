"""Orbbec's cameras (Femto, Gemini, Astra), by the package pyorbbecsdk, of version 1 or 2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from tofuse.apps.live import Device, DeviceError, Settings, Stream
from tofuse.engine.arrays import Float32
from tofuse.engine.cameras import DISTORTION_ORDER
from tofuse.engine.frames import RangeFrame
from tofuse.engine.parts import part
from tofuse.formats.cameras import lenses

# Models whose coefficients have other meanings than those of the rational model.
_OTHER_LENSES = ("MODIFIED_BROWN_CONRADY", "INVERSE_BROWN_CONRADY", "KANNALA_BRANDT4")


class OrbbecStream(Stream):
    """See `Stream`."""

    def start(self, package: Any, options: Any) -> None:
        """See `Stream.start`."""
        self._pipeline = package.Pipeline()
        config = package.Config()
        self._profile = _default_profile(self._pipeline, package.OBSensorType.DEPTH_SENSOR)
        config.enable_stream(self._profile)
        self._infrared = options.infrared and self._add_infrared(package, config)
        self._pipeline.start(config)

    def _add_infrared(self, package: Any, config: Any) -> bool:
        """Enable the infrared image, if the camera has one with the pixels of depth."""
        try:
            profile = _default_profile(self._pipeline, package.OBSensorType.IR_SENSOR)
        except package.OBError:
            return False
        has_pixels_of_depth = _size(profile) == _size(self._profile)
        if has_pixels_of_depth:
            config.enable_stream(profile)
        return has_pixels_of_depth

    def read_settings(self) -> Settings:
        """See `Stream.read_settings`."""
        depth = self.wait().get_depth_frame()
        lens, distortion = self._profile.get_intrinsic(), self._profile.get_distortion()
        intrinsics = {name: float(getattr(lens, name)) for name in ("fx", "fy", "cx", "cy")}
        names = DISTORTION_ORDER["rational"]
        coefficients = {name: float(getattr(distortion, name)) for name in names}
        model = getattr(getattr(distortion, "model", None), "name", "")  # version 1 states none
        if any(coefficients.values()) and model in _OTHER_LENSES:
            raise DeviceError(
                f"has a lens of the model {model}",
                where="Orbbec",
                remedy="record with Orbbec's viewer, and describe the lens by --camera camera.json",
            )
        size = _size(self._profile)
        return Settings(
            str(self._pipeline.get_device().get_device_info().get_name()),
            lenses.simplest_lens(size, intrinsics, coefficients, "Orbbec"),
            float(depth.get_depth_scale()) / 1000.0,
            "z",
            float(self._profile.get_fps()),
            "ir" if self._infrared else None,
        )

    def read(self, index: int) -> RangeFrame:
        """See `Stream.read`."""
        frames = self.wait()
        depth = frames.get_depth_frame()
        infrared = frames.get_ir_frame() if self._infrared else None
        return self.frame(
            index,
            depth.get_timestamp_us() / 1e6,
            _image(depth),
            None if infrared is None else _image(infrared),
        )

    def close(self) -> None:
        """See `Stream.close`."""
        self._pipeline.stop()

    def poll(self, timeout_s: float) -> Any:
        """See `Stream.poll`."""
        frames = self._pipeline.wait_for_frames(int(timeout_s * 1000))
        return None if frames is None or frames.get_depth_frame() is None else frames


@part("device", "orbbec")
@dataclass(frozen=True)
class Orbbec(Device):
    """An Orbbec camera: depth, and the infrared image of the same sensor if it has one.

    Attributes
    ----------
    infrared
        Whether to record the infrared image.
    """

    maker: ClassVar[str] = "Orbbec"
    package: ClassVar[tuple[str, str]] = ("pyorbbecsdk2", "pyorbbecsdk")
    stream: ClassVar[type[Stream]] = OrbbecStream
    infrared: bool = True


def _default_profile(pipeline: Any, sensor: Any) -> Any:
    return pipeline.get_stream_profile_list(sensor).get_default_video_stream_profile()


def _size(image: Any) -> tuple[int, int]:
    return int(image.get_width()), int(image.get_height())


def _image(frame: Any) -> Float32:
    width, height = _size(frame)
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
