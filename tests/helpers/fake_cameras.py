"""Mocks of the manufacturers' packages, with the names and units of their documentation."""

from __future__ import annotations

import enum
import time
from datetime import UTC, datetime, timedelta
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from made_ifm import head_info
from tofuse.engine.arrays import UInt16

WIDTH, HEIGHT = 32, 24


def depth_counts(k: int) -> UInt16:
    """Depth of frame k: a slope, one invalid pixel, in counts."""
    counts = (1000 + 10 * np.arange(WIDTH) + k + np.zeros((HEIGHT, 1))).astype(np.uint16)
    counts[3, 4] = 0
    return counts


def infrared_counts(k: int) -> UInt16:
    return (40 + k + np.arange(HEIGHT)[:, None] + np.zeros(WIDTH)).astype(np.uint16)


def named(*names: str) -> SimpleNamespace:
    """Constants that are their own names."""
    return SimpleNamespace(**{name: name for name in names})


class FakeRealSense(ModuleType):
    """pyrealsense2: milliseconds, metres per count, images that are false where they are missing.

    Frame 0 has its time by the camera's clock, the others by the computer's; frame 1 lacks depth,
    and frame 3 the infrared image.
    """

    stream, format = named("depth", "infrared"), named("z16", "y8")
    distortion = named("none", "brown_conrady", "inverse_brown_conrady", "ftheta")
    camera_info = named("name", "product_line", "serial_number")

    option = named("global_time_enabled")
    timestamp_domain = SimpleNamespace(hardware_clock="hardware", global_time="global")

    def __init__(self, line: str = "L500", model: str = "none", frames: int = 7) -> None:
        super().__init__("pyrealsense2")
        self.sent, self.global_time, self.settled_after = 0, 1.0, 1
        self.line, self.model, self.left = line, model, frames
        self.plugged_in, self.stopped = True, 0
        self.enabled: list[str] = []
        coeffs = [0.1, -0.05, 0.001, -0.002, 0.01] if model != "none" else [0.0] * 5
        self.lens = SimpleNamespace(
            width=WIDTH, height=HEIGHT, fx=30.0, fy=31.0, ppx=15.2, ppy=11.9,
            model=model, coeffs=coeffs,
        )  # fmt: skip

    def _device(self) -> Any:
        info = {"name": "Intel RealSense L515", "product_line": self.line, "serial_number": "f001"}

        def set_option(option: str, value: float) -> None:
            self.global_time = value

        sensor = SimpleNamespace(
            get_depth_scale=lambda: 0.00025,
            supports=lambda option: True,
            get_option=lambda option: self.global_time,
            set_option=set_option,
        )
        return SimpleNamespace(get_info=info.__getitem__, first_depth_sensor=lambda: sensor)

    def context(self) -> Any:
        return SimpleNamespace(query_devices=lambda: [self._device()] if self.plugged_in else [])

    def config(self) -> Any:
        return SimpleNamespace(
            enable_device=lambda serial: None,
            enable_stream=lambda stream, w, h, kind, rate: self.enabled.append(stream),
        )

    def pipeline(self) -> Any:
        stream = SimpleNamespace(get_intrinsics=lambda: self.lens, fps=lambda: 30)
        profile = SimpleNamespace(
            get_device=self._device,
            get_stream=lambda s: SimpleNamespace(as_video_stream_profile=lambda: stream),
        )

        def try_wait_for_frames(timeout_ms: int) -> Any:
            if self.left == 0:
                time.sleep(timeout_ms / 1000)
                return False, None
            k = self.sent
            self.left, self.sent = self.left - 1, self.sent + 1
            by_camera = k < self.settled_after
            depth = SimpleNamespace(
                get_data=lambda: depth_counts(k),
                get_timestamp=lambda: (0 if by_camera else 1.7e12) + 5000.0 + 1000 / 30 * k,
                get_frame_timestamp_domain=lambda: "hardware" if by_camera else "global",
            )
            infrared = SimpleNamespace(get_data=lambda: infrared_counts(k).astype(np.uint8))
            return True, SimpleNamespace(
                get_depth_frame=lambda: None if k == 1 else depth,
                get_infrared_frame=lambda: None if k == 3 else infrared,
            )

        def stop() -> None:
            self.stopped += 1

        return SimpleNamespace(
            start=lambda c: profile, try_wait_for_frames=try_wait_for_frames, stop=stop
        )


class FakeK4A(ModuleType):
    """pyk4a: mm, microseconds, OpenCV's eight distortion coefficients."""

    class K4AException(Exception):  # noqa: N818
        pass

    class K4ATimeoutException(K4AException):
        pass

    ColorResolution = enum.Enum("ColorResolution", ["OFF", "RES_720P"])
    DepthMode = enum.Enum("DepthMode", ["NFOV_2X2BINNED", "NFOV_UNBINNED", "WFOV_2X2BINNED"])
    FPS = enum.Enum("FPS", ["FPS_5", "FPS_15", "FPS_30"])
    CalibrationType = enum.Enum("CalibrationType", ["DEPTH", "COLOR"])

    def __init__(self, frames: int = 6) -> None:
        super().__init__("pyk4a")
        self.left, self.stopped = frames, 0
        self.config: Any = None

    def Config(self, **options: Any) -> Any:
        return SimpleNamespace(**options)

    def PyK4A(self, config: Any, device_id: int = 0) -> Any:
        self.config = config
        K = np.array([[30.0, 0, 15.5], [0, 30.5, 12.0], [0, 0, 1]])
        k = np.array([0.5, -2.6, 0.0001, -0.0002, 1.4, 0.4, -2.4, 1.4])
        calibration = SimpleNamespace(
            get_camera_matrix=lambda kind: K, get_distortion_coefficients=lambda kind: k
        )

        def start() -> None:
            if device_id != 0:
                raise self.K4AException("no device")

        def get_capture(timeout: int = -1) -> Any:
            if self.left == 0:
                raise self.K4AException  # as when it is unplugged
            self.left -= 1
            k = 5 - self.left
            return SimpleNamespace(
                depth=None if k == 1 else depth_counts(k),  # occasionally only infrared arrives
                ir=infrared_counts(k),
                depth_timestamp_usec=100_000 + 66_667 * k,
            )

        def stop() -> None:
            self.stopped += 1

        return SimpleNamespace(
            start=start, get_capture=get_capture, stop=stop, calibration=calibration
        )


class FakeOrbbec(ModuleType):
    """pyorbbecsdk: mm per count, microseconds, None if no frame arrives in time."""

    class OBError(Exception):
        pass

    OBSensorType = SimpleNamespace(DEPTH_SENSOR="depth", IR_SENSOR="ir")

    def __init__(self, *, infrared: bool = True, rational: bool = True, frames: int = 6) -> None:
        super().__init__("pyorbbecsdk")
        self.left, self.stopped, self.infrared = frames, 0, infrared
        names = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
        values = (0.5, -2.6, 1.4, 0.4, -2.4, 1.4, 0.0001, -0.0002) if rational else (0.0,) * 8
        self.distortion = SimpleNamespace(**dict(zip(names, values, strict=True)))
        lens = SimpleNamespace(width=WIDTH, height=HEIGHT, fx=30.0, fy=30.5, cx=15.5, cy=12.0)
        self.profile = SimpleNamespace(
            get_width=lambda: WIDTH, get_height=lambda: HEIGHT, get_fps=lambda: 30,
            get_intrinsic=lambda: lens, get_distortion=lambda: self.distortion,
        )  # fmt: skip

    def Config(self) -> Any:
        return SimpleNamespace(enable_stream=lambda profile: None)

    def Pipeline(self) -> Any:
        def profiles(sensor: str) -> Any:
            if sensor == "ir" and not self.infrared:
                raise self.OBError("no such sensor")
            return SimpleNamespace(get_default_video_stream_profile=lambda: self.profile)

        def wait_for_frames(timeout_ms: int) -> Any:
            if self.left == 0:
                return None
            self.left -= 1
            k = 5 - self.left
            if k == 1:
                return None  # a late frame
            depth, infrared = self._frame(depth_counts(k), k), self._frame(infrared_counts(k), k)
            return SimpleNamespace(get_depth_frame=lambda: depth, get_ir_frame=lambda: infrared)

        def stop() -> None:
            self.stopped += 1

        info = SimpleNamespace(get_name=lambda: "Orbbec Femto Bolt")
        return SimpleNamespace(
            get_stream_profile_list=profiles,
            start=lambda config: None,
            stop=stop,
            wait_for_frames=wait_for_frames,
            get_device=lambda: SimpleNamespace(get_device_info=lambda: info),
        )

    def _frame(self, counts: UInt16, k: int) -> Any:
        return SimpleNamespace(
            get_width=lambda: WIDTH,
            get_height=lambda: HEIGHT,
            get_data=lambda: np.frombuffer(counts.tobytes(), np.uint8),
            get_depth_scale=lambda: 0.5,
            get_timestamp_us=lambda: 700_000 + round(1e6 / 30 * k),
        )


def fake_ifm3d(frames: int = 5, *, converted: bool = True) -> dict[str, ModuleType]:
    """ifm3dpy: futures, buffers by number; distances in m if the package has converted them."""

    class Error(Exception):
        pass

    left = [frames]
    ids = SimpleNamespace(
        RADIAL_DISTANCE_IMAGE=100, NORM_AMPLITUDE_IMAGE=101, RADIAL_DISTANCE_NOISE=105,
        CONFIDENCE_IMAGE=300, TOF_INFO=420,
    )  # fmt: skip

    def O3R(address: str) -> Any:
        if address == "0.0.0.0":
            raise Error("no route")
        return SimpleNamespace(
            port=lambda name: SimpleNamespace(pcic_port=50012),
            set=lambda what: None,
            get=lambda what: {"ports": {"port2": {"acquisition": {"framerate": 20.0}}}},
        )

    def FrameGrabber(unit: Any, pcic_port: int) -> Any:
        def wait_for(timeout_ms: int) -> Any:
            if left[0] == 0:
                return False, None
            left[0] -= 1
            k = 4 - left[0]
            counts = depth_counts(k)
            unit_m = np.float32(0.0005)
            flags = np.zeros((HEIGHT, WIDTH), np.uint16)
            flags[0, 0] = 1
            buffers = {
                100: counts * unit_m if converted else counts,
                101: infrared_counts(k).astype(np.float32),
                105: np.full_like(counts, 8) * unit_m if converted else np.full_like(counts, 8),
                300: flags,
                420: np.frombuffer(head_info(unit=0.0005), np.uint8),
            }
            time = datetime(2026, 1, 1, tzinfo=UTC) + timedelta(seconds=k / 20)
            return True, SimpleNamespace(get_buffer=buffers.__getitem__, timestamps=lambda: [time])

        return SimpleNamespace(
            start=lambda buffers: None,
            stop=lambda: SimpleNamespace(wait=lambda: None),
            wait_for_frame=lambda: SimpleNamespace(wait_for=wait_for),
        )

    package, device, grabber = (
        ModuleType(name) for name in ("ifm3dpy", "ifm3dpy.device", "ifm3dpy.framegrabber")
    )
    device.O3R, device.Error = O3R, Error  # type: ignore[attr-defined]
    grabber.FrameGrabber, grabber.buffer_id = FrameGrabber, ids  # type: ignore[attr-defined]
    return {m.__name__: m for m in (package, device, grabber)}
