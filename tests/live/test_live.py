"""Cameras by the manufacturers' packages (mocks), recording from them, and playing recordings."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

import tofuse
from fake_cameras import (
    HEIGHT,
    WIDTH,
    FakeK4A,
    FakeOrbbec,
    FakeRealSense,
    depth_counts,
    fake_ifm3d,
    infrared_counts,
)
from tofuse.apps.cli.program import main
from tofuse.apps.live.device import DeviceError, Stream, device_named, is_installed, known_devices
from tofuse.apps.live.recorder import QUEUE_FRAMES, record
from tofuse.engine.cameras.cameras import Pinhole, Rational
from tofuse.engine.errors import InputError, OutputError
from tofuse.engine.frames.frames import RangeFrame
from tofuse.formats.files import atomic

Install = Callable[..., None]


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Install:
    def put(*modules: ModuleType) -> None:
        for module in modules:
            module.__spec__ = ModuleSpec(module.__name__, None)
            monkeypatch.setitem(sys.modules, module.__name__, module)

    monkeypatch.setattr("tofuse.apps.live.device.TIMEOUT_S", 0.05)
    return put


def check_depth(frame: RangeFrame, k: int, unit_m: float) -> None:
    assert np.allclose(frame.depth, depth_counts(k) * unit_m, atol=1e-6)
    assert frame.depth[3, 4] == 0


def test_realsense_stream(install: Install) -> None:
    package = FakeRealSense()
    install(package)
    with device_named("realsense", {}).open() as stream:
        frames = [stream.read(k) for k in range(3)]  # the third to fifth that arrived
        with pytest.raises(DeviceError, match="sent no frame"):
            list(stream)
    assert package.stopped == 1
    assert package.enabled == ["depth", "infrared"]
    assert stream.settings.sensor == "Intel RealSense L515"
    assert stream.settings.camera == Pinhole(WIDTH, HEIGHT, 30.0, 31.0, 15.2, 11.9)
    check_depth(frames[2], 5, 0.00025)
    assert not frames[0].amplitude_image.any()
    assert np.array_equal(frames[2].amplitude_image, infrared_counts(5))
    assert frames[1].timestamp - frames[0].timestamp == pytest.approx(1 / 30, abs=1e-5)
    assert frames[0].timestamp > 1.7e9  # by the computer's clock
    assert frames[0].depth_kind == "z"


def test_realsense_keeps_the_clock_that_its_first_frames_have(
    install: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tofuse.apps.live.devices.realsense._CLOCK_S", 0.0)
    package = FakeRealSense()
    install(package)
    with device_named("realsense", {}).open():
        assert package.global_time == 0


def test_only_the_first_frame_may_take_long(
    install: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(FakeOrbbec(frames=0))
    device = device_named("orbbec", {})
    monkeypatch.setattr(device.stream, "timeout_s", 0.1)
    with pytest.raises(DeviceError, match=r"Orbbec: sent no frame for 0\.1 s"):
        device.open()
    install(FakeOrbbec())
    with device.open() as stream:
        assert stream.timeout_s == 0.05


def test_realsense_errors_are_reported(install: Install) -> None:
    package = FakeRealSense(model="ftheta")
    install(package)
    with pytest.raises(DeviceError, match="lens of the model ftheta"):
        device_named("realsense", {}).open()
    assert package.stopped == 1  # not left running
    package.plugged_in = False
    with pytest.raises(DeviceError, match="no camera is connected"):
        device_named("realsense", {}).open()
    with pytest.raises(DeviceError, match=r"no camera f999 is connected; .* set serial="):
        device_named("realsense", {"serial": "f999"}).open()


def test_azure_kinect_stream(install: Install) -> None:
    package = FakeK4A()
    install(package)
    with device_named(
        "azure-kinect", {"mode": "WFOV_2X2BINNED", "frame_rate_hz": "30"}
    ).open() as stream:
        assert package.config.depth_mode.name == "WFOV_2X2BINNED"
        assert package.config.camera_fps.name == "FPS_30"
        frame = stream.read(7)  # frame 0 gave the size, and frame 1 has no depth
    assert frame.index == 7
    check_depth(frame, 2, 0.001)
    assert frame.timestamp == pytest.approx(0.1 + 2 * 0.066667)
    camera = stream.settings.camera
    assert isinstance(camera, Rational)
    assert (camera.fx, camera.cy, camera.k1, camera.p2, camera.k3, camera.k6) == (
        30.0, 12.0, 0.5, -0.0002, 1.4, 1.4,
    )  # fmt: skip
    assert package.stopped == 1
    with (
        device_named("azure-kinect", {}).open() as stream,
        pytest.raises(DeviceError, match=r"stopped \(K4AException: \); check its cable"),
    ):
        list(stream)  # unplugged after its last frame
    with pytest.raises(DeviceError, match="does not start"):
        device_named("azure-kinect", {"device": "1"}).open()
    with pytest.raises(DeviceError, match="use 5, 15 or 30"):
        device_named("azure-kinect", {"frame_rate_hz": "20"}).open()


def test_orbbec_stream(install: Install) -> None:
    package = FakeOrbbec()
    install(package)
    with device_named("orbbec", {}).open() as stream:
        frame = stream.read(0)
        with pytest.raises(DeviceError, match="sent no frame"):
            list(stream)
    check_depth(frame, 2, 0.0005)
    assert np.array_equal(frame.amplitude_image, infrared_counts(2))
    camera = stream.settings.camera
    assert isinstance(camera, Rational)
    assert (camera.k1, camera.p1, camera.k3, camera.k4) == (0.5, 0.0001, 1.4, 0.4)
    assert frame.timestamp == pytest.approx(0.7 + 2 / 30, abs=1e-6)
    assert package.stopped == 1
    package.left, package.distortion.model = 6, SimpleNamespace(name="KANNALA_BRANDT4")
    with pytest.raises(DeviceError, match="lens of the model KANNALA_BRANDT4"):
        device_named("orbbec", {}).open()
    package.left, package.distortion.model = 6, SimpleNamespace(name="BROWN_CONRADY_K6")
    with device_named("orbbec", {}).open() as stream:
        assert isinstance(stream.settings.camera, Rational)


@pytest.mark.parametrize("converted", [True, False])
def test_ifm_stream(install: Install, converted: bool) -> None:
    install(*fake_ifm3d(converted=converted).values())
    with device_named("ifm-o3r", {}).open() as stream:
        frame = stream.read(0)
    assert frame.depth_kind == "range"
    assert frame.depth[0, 0] == 0  # flagged
    assert np.allclose(frame.depth[1:], depth_counts(1)[1:] * 0.0005, atol=1e-6)
    assert np.allclose(frame.sigma_image, 0.004)
    assert stream.settings.frame_rate_hz == 20
    assert stream.settings.camera.rays().shape == (HEIGHT, WIDTH, 2)
    with pytest.raises(DeviceError, match="does not start"):
        device_named("ifm-o3r", {"address": "0.0.0.0"}).open()


def test_invalid_options_and_missing_packages_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    assert set(known_devices()) == {"azure-kinect", "ifm-o3r", "orbbec", "realsense"}
    with pytest.raises(InputError, match="no camera 'webcam'"):
        device_named("webcam", {})
    with pytest.raises(InputError, match="unknown option 'serail'"):
        device_named("realsense", {"serail": "1"})
    with pytest.raises(InputError, match="use a whole number"):
        device_named("realsense", {"width": "wide"})
    with pytest.raises(InputError, match="use true or false"):
        device_named("orbbec", {"infrared": "1"})
    for name, kind in known_devices().items():
        monkeypatch.setitem(sys.modules, kind.package[1], None)  # as if not installed
        with pytest.raises(DeviceError, match=f"pip install {kind.package[0]}"):
            device_named(name, {}).open()


def test_recorded_frames_match_stream(install: Install, tmp_path: Path) -> None:
    install(*fake_ifm3d(frames=5).values())
    counts: list[int] = []
    with device_named("ifm-o3r", {}).open() as stream:
        done = record(stream, tmp_path / "a", frames=3, progress=counts.append)
    assert (done.frames, done.dropped, done.ended_by) == (3, 0, "asked")
    assert counts == [1, 2, 3]
    recording = tofuse.open(tmp_path / "a")
    assert recording.metadata["sensor"] == "ifm O3R (ToF)"
    assert np.diff(recording.timestamps) == pytest.approx(1 / 20, abs=1e-6)
    frame = recording[2]
    assert isinstance(frame, RangeFrame)
    assert frame.depth_kind == "range"
    assert np.allclose(frame.depth[1:], depth_counts(3)[1:] * 0.0005, atol=1e-5)
    assert np.allclose(frame.sigma_image, 0.004, atol=1e-4)
    assert np.allclose(frame.camera.rays(), stream.settings.camera.rays())


def test_failing_camera_keeps_recorded_frames(install: Install, tmp_path: Path) -> None:
    install(FakeRealSense(frames=7))
    with device_named("realsense", {}).open() as stream:
        done = record(stream, tmp_path / "a", seconds=60)
    assert done.frames == 4
    assert "sent no frame" in done.ended_by
    assert len(tofuse.open(tmp_path / "a")) == 4


@pytest.mark.parametrize("size", [800, 1000, 1250])
def test_full_disk_keeps_recorded_frames(
    size: int, install: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The files at the end need space as well, for which the last frames make room."""
    install(FakeRealSense(frames=8))

    def limited(write: Callable[..., None]) -> Callable[..., None]:
        def written(path: Path, content: Any) -> None:
            used = sum(p.stat().st_size for p in tmp_path.rglob("*") if p.is_file())
            if used + len(content) > size:
                raise OutputError("can't be written (no space left on device)", where=path)
            write(path, content)

        return written

    for name in ("write_bytes", "write_text"):
        monkeypatch.setattr(atomic, name, limited(getattr(atomic, name)))
    with device_named("realsense", {}).open() as stream:
        done = record(stream, tmp_path / "a", seconds=60)
    assert 0 < done.frames < 5
    assert f"{tmp_path / 'a'}{os.sep}" in done.ended_by
    assert "can't be written (no space left on device)" in done.ended_by
    assert len(tofuse.open(tmp_path / "a")) == done.frames
    assert len(list((tmp_path / "a").glob("*/*.png"))) == 2 * done.frames


class Endless(Stream):
    """Sends every requested frame immediately, and says when it has sent many."""

    def __init__(self, settings: Any, many: int) -> None:
        self.settings, self.many = settings, many
        self.sent_many = threading.Event()

    def read(self, index: int) -> RangeFrame:
        if index >= self.many:
            self.sent_many.set()
        return RangeFrame(
            index, index / 30, self.settings.camera, depth_counts(0) * np.float32(0.001)
        )

    def close(self) -> None:
        pass


def test_frame_that_does_not_fit_keeps_recorded_frames(install: Install, tmp_path: Path) -> None:
    class LosesAmplitude(Endless):
        def read(self, index: int) -> RangeFrame:
            frame = super().read(index)
            amplitude = None if index == 3 else frame.depth
            return RangeFrame(index, frame.timestamp, frame.camera, frame.depth, "z", amplitude)

    install(FakeRealSense())
    with device_named("realsense", {}).open() as camera:
        stream = LosesAmplitude(camera.settings, many=0)
    done = record(stream, tmp_path / "a", frames=9)
    assert (done.frames, "frame 3: has [] where" in done.ended_by) == (3, True)
    assert len(tofuse.open(tmp_path / "a")) == 3


def test_slow_disk_drops_and_counts_frames(install: Install, tmp_path: Path) -> None:
    install(FakeRealSense())
    with device_named("realsense", {}).open() as camera:
        stream = Endless(camera.settings, many=3 * QUEUE_FRAMES)

    def wait_for_disk(frames: int) -> None:
        assert stream.sent_many.wait(60)

    done = record(stream, tmp_path / "a", frames=100, progress=wait_for_disk)
    assert done.frames == 100
    assert done.dropped >= 2 * QUEUE_FRAMES - 1  # one is written, and the queue is full
    indices = np.rint(tofuse.open(tmp_path / "a").timestamps * 30)
    assert (np.diff(indices) >= 1).all()
    assert indices[-1] > 99  # dropped frames leave a gap in the timestamps


def test_record_command(
    install: Install,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    install(FakeK4A())
    out = tmp_path / "rec"
    assert main(["record", "azure-kinect", "--out", str(out), "--frames", "2"]) == 0
    assert "2 frames in" in capsys.readouterr().out
    assert main(["inspect", str(out)]) == 0
    assert "Azure Kinect" in capsys.readouterr().out
    monkeypatch.delitem(sys.modules, "pyk4a")  # the folder is checked before the camera
    assert main(["record", "azure-kinect", "--out", str(out)]) == 2
    assert f"{out}: isn't empty" in capsys.readouterr().err
    assert main(["record"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in known_devices())
    assert ("not installed" in listed) == any(
        not is_installed(kind) for kind in known_devices().values()
    )
    assert main(["record", "azure-kinect"]) == 2
    assert "--out: is missing" in capsys.readouterr().err
