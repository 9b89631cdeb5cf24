"""Any recording as a native folder: nothing is lost on the way."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import made_arrays
from camera_files import MAKERS
from cli_calls import printed, refuses
from damaged_files import make_native, make_ply
from made_recordings import make_sr4000
from refused import refused
from tofuse.engine.cameras.cameras import Pinhole, RayTable
from tofuse.engine.errors import InputError, OutputError
from tofuse.engine.frames.frames import SATURATED_AMPLITUDE, CloudFrame, RangeFrame
from tofuse.engine.frames.recording import POSES_BY, ArraySource, Recording
from tofuse.engine.noise import NOISE
from tofuse.engine.noise.model import family_of
from tofuse.formats.cameras import read_noise, write_noise
from tofuse.formats.export.conversion import convert
from tofuse.formats.readers.native import NativeSource
from tofuse.formats.recordings import RecordingWriter
from tofuse.formats.recordings.open import open_recording
from tofuse.formats.rigs.rig_file import Rig, RigCamera, write_rig
from written import change_camera

CHANNELS = ("amplitude_image", "confidence_image", "color_image")


def check_same(before: Recording, after: Recording, *, depth: float = 1e-6) -> None:
    """Compare all that two recordings hold; `depth` is how far depth may be off, in m."""
    assert after.format == "native"
    assert len(after) == len(before)
    np.testing.assert_array_equal(after.timestamps, before.timestamps)
    for name in ("reference", "odometry"):
        old, new = getattr(before, name), getattr(after, name)
        assert (old is None) == (new is None)
        if old is not None:
            np.testing.assert_allclose(new, old, atol=1e-6)
    for key in ("sensor", "confidence_max", "frame_rate_hz", POSES_BY):
        assert after.metadata.get(key) == before.metadata.get(key)
    for a, b in zip(before, after, strict=True):
        assert (a.depth_kind, a.color_registered) == (b.depth_kind, b.color_registered)
        assert a.ambiguity_m == b.ambiguity_m
        np.testing.assert_array_equal(a.camera.rays(), b.camera.rays())
        np.testing.assert_array_equal(a.depth > 0, b.depth > 0)
        np.testing.assert_allclose(a.depth, b.depth, atol=depth)
        for name in CHANNELS:
            old, new = getattr(a, name), getattr(b, name)
            if old is None:
                assert new is None or not new.any()
            else:
                np.testing.assert_allclose(new, old, atol=0.51 if name[0] == "a" else 0)
        assert (a.sigma_image is None) == (b.sigma_image is None)
        if a.sigma_image is not None:
            np.testing.assert_allclose(b.sigma_image, a.sigma_image, atol=1e-5)
        if a.amplitude_image is not None:
            assert a.amplitude_kind == b.amplitude_kind
    family = [family_of(r, r[0] if isinstance(r[0], RangeFrame) else None) for r in (before, after)]
    if "sensor" in before.metadata:
        assert family[0] == family[1]


@pytest.mark.parametrize("name", MAKERS)
def test_every_camera(tmp_path: Path, name: str) -> None:
    make, file, _ = MAKERS[name]
    make(tmp_path / "scan" / (file or "."))
    before = open_recording(tmp_path / "scan" / (file or "."))
    done = convert(before, tmp_path / "out")
    assert (done.folder, done.frames, done.warnings) == (tmp_path / "out", len(before), ())
    # Float depth without a unit is rounded to 0.1 mm.
    rounded = 1e-6 if "depth_unit_m" in before.metadata else 0.51e-4
    check_same(before, open_recording(tmp_path / "out"), depth=rounded)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "scan"]


def test_depth_stored_as_floats(tmp_path: Path) -> None:
    """A unit of 1 m, as of float arrays, is no count to which depth is rounded."""
    folder = tmp_path / "native"
    make_native(folder)
    change_camera(folder, depth_unit_m=1.0)
    for k, path in enumerate(sorted((folder / "depth").iterdir())):
        depth = np.linspace(1, 2 + k, 30 * 40, dtype=np.float32)
        np.save(path.with_suffix(".npy"), depth.reshape(30, 40))
        path.unlink()
    before = open_recording(folder)
    check_same(before, open_recording(convert(before, tmp_path / "out").folder), depth=6e-5)


def test_amplitude_is_of_the_kind_of_frames_that_have_it(tmp_path: Path) -> None:
    depth, amplitude = np.ones((6, 8), np.float32), np.full((6, 8), 50, np.float32)
    camera = Pinhole(8, 6, 10.0, 10.0, 3.5, 2.5)
    frames = [
        RangeFrame(0, 0.0, camera, depth),
        RangeFrame(
            1, 0.1, camera, depth, amplitude_image=amplitude, amplitude_kind="range_compensated"
        ),
    ]
    convert(Recording.of(ArraySource(frames), "made", "made"), tmp_path / "out")
    assert open_recording(tmp_path / "out")[1].amplitude_kind == "range_compensated"


@pytest.mark.parametrize(("largest", "factor"), [(1.0, 1e4), (400.0, 1.0)])
def test_fractions_of_amplitude_are_kept(tmp_path: Path, largest: float, factor: float) -> None:
    """Intensities of 0 to 1 are not rounded to 0 and 1; larger ones keep their counts."""
    rng, camera = np.random.default_rng(3), Pinhole(8, 6, 10.0, 10.0, 3.5, 2.5)
    amplitude = rng.uniform(0.02, 1, (6, 8)).astype(np.float32) * np.float32(largest)
    amplitude[0, 0], amplitude[0, 1] = 0, SATURATED_AMPLITUDE
    frame = RangeFrame(0, 0.0, camera, np.ones((6, 8), np.float32), amplitude_image=amplitude)
    convert(Recording.of(ArraySource([frame]), "made", "made"), tmp_path / "out")
    found = open_recording(tmp_path / "out")[0].amplitude_image
    assert (found[0, 0], found[0, 1]) == (0, SATURATED_AMPLITUDE)
    np.testing.assert_allclose(found.ravel()[2:], factor * amplitude.ravel()[2:], atol=0.51)


def test_rays_of_each_frame(tmp_path: Path) -> None:
    make_sr4000(tmp_path / "scan")
    before = open_recording(tmp_path / "scan")
    convert(before, tmp_path / "out")
    after = open_recording(tmp_path / "out")
    check_same(before, after, depth=0.51e-4)
    assert isinstance(after[1].camera, RayTable)
    assert not np.array_equal(after[0].camera.rays(), after[1].camera.rays())
    (tmp_path / "out" / "rays" / "000001.npy").unlink()
    refused("rays: has 2 images", tmp_path / "out")


def test_correction_is_kept_with_raw_measurements(tmp_path: Path) -> None:
    make_native(tmp_path / "scan")
    write_noise(tmp_path / "scan" / "noise.json", NOISE["sr4000"])
    before = open_recording(tmp_path / "scan")
    convert(before.select(every=2), tmp_path / "out")
    after = open_recording(tmp_path / "out")
    check_same(before.select(every=2), after)
    for folder in ("scan", "out"):
        assert (tmp_path / folder / "correction.npz").is_file()
    source = after.source
    assert isinstance(source, NativeSource)
    assert source.imu["t"].tolist() == [0, 1, 2, 3]
    assert source.frame_columns["temperature_c"].tolist() == [0, 2]
    assert read_noise(tmp_path / "out" / "noise.json") == NOISE["sr4000"]
    # The given recording still applies its correction.
    assert isinstance(before.source, NativeSource)
    assert before.source.correction is not None


@pytest.mark.parametrize("up", [np.array([0.0, 0.6, 0.8]), None])
def test_clouds_in_map_coordinates(tmp_path: Path, up) -> None:
    """Each has its own shift; which way is up is of the format."""
    places = np.array([[500_000.123, 4_000_000.456, 3], [500_009.1, 4_000_002.4, 4]])
    points = [place + np.random.default_rng(3).uniform(-3, 3, (40, 3)) for place in places]
    frames = [CloudFrame.of(p, index=k, timestamp=float(k), up=up) for k, p in enumerate(points)]
    result = convert(Recording.of(ArraySource(frames), "scans", "las"), tmp_path / "out")
    assert not result.warnings
    for frame, expected in zip(open_recording(tmp_path / "out"), points, strict=True):
        np.testing.assert_allclose(frame.points + frame.shift, expected, atol=1e-3)
        assert (frame.up is None) == (up is None)
        if up is not None:
            np.testing.assert_allclose(frame.up, up, atol=1e-9)


def test_clouds(tmp_path: Path) -> None:
    make_ply(tmp_path / "scan")
    before = open_recording(tmp_path / "scan").select(end=1)
    convert(before, tmp_path / "out")
    (a,), (b,) = list(before), list(open_recording(tmp_path / "out"))
    assert isinstance(b, CloudFrame)
    np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_allclose(a.normals, b.normals)


def test_convert_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made_arrays.make_zense(tmp_path / "scan")
    path = tmp_path / "scan" / "depth_0001.png"
    path.write_bytes(path.read_bytes()[:60])
    words = ["convert", str(tmp_path / "scan"), "--out", str(tmp_path / "out")]
    lines = printed(capsys, *words).splitlines()
    assert lines[0] == f"2 frames in {tmp_path / 'out'}"
    assert any("depth_0001.png" in line for line in lines[1:])
    refuses(capsys, *words, says=f"{tmp_path / 'out'}: isn't empty; choose a new folder")
    refuses(capsys, *words[:-1], tmp_path / "new", "--start", "7", says="--start")
    assert not (tmp_path / "new").exists()


def test_rig_is_refused(tmp_path: Path) -> None:
    """As one recording it would be a single camera that jumps."""
    for name in ("left", "right"):
        make_native(tmp_path / "rig" / name)
    cameras = [RigCamera(n, n, np.eye(4), np.zeros((6, 6))) for n in ("left", "right")]
    write_rig(tmp_path / "rig" / "rig.json", Rig(tuple(cameras)))
    with pytest.raises(InputError, match=r"is a rig of several cameras"):
        convert(open_recording(tmp_path / "rig"), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_failed_conversion_leaves_nothing(tmp_path: Path, monkeypatch) -> None:
    made_arrays.make_npz(tmp_path / "a.npz")
    recording = open_recording(tmp_path / "a.npz")

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(RecordingWriter, "add", stop)
        with pytest.raises(KeyboardInterrupt):
            convert(recording, tmp_path / "out")
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]
    (tmp_path / "file").write_text("x")
    refused("is a file", recording, tmp_path / "file", by=convert, error=OutputError)
    shutil.rmtree(tmp_path / "out", ignore_errors=True)
    (tmp_path / "out").mkdir()
    assert convert(recording, tmp_path / "out").frames == 3


REAL: list[tuple[str, int, dict[str, Any]]] = [
    ("sr4000_corridor", 3, {"depth": 0.51e-4}),
    ("kinectv2_loop/recording", 8, {}),
    ("iphone_chair_3dscannerapp", 30, {}),
    ("iphone_stray", 90, {}),
    ("iphone_record3d", 12, {"depth": 0.51e-4}),
    ("azure_kinect_mkv", 1, {}),
    ("ifm_o3r", 1, {}),
    ("pico_zense_static", 5, {}),
    ("open3d_rgbd5", 2, {}),
]


@pytest.mark.nightly
@pytest.mark.parametrize(("name", "every", "how"), REAL)
def test_real_recordings(shared_data, tmp_path, name, every, how) -> None:
    before = open_recording(shared_data / name).select(every=every)
    convert(before, tmp_path / "out")
    check_same(before, open_recording(tmp_path / "out"), **how)
