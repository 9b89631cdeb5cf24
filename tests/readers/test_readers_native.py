from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from refused import refused
from tofuse.engine.cameras.cameras import BrownConrady, Camera, Fisheye, Pinhole, Rational, RayTable
from tofuse.engine.cameras.depth_conversion import points_from_z
from tofuse.engine.errors import InputError, OutputError, UnreadableFrameError
from tofuse.engine.frames.frames import CloudFrame, RangeFrame
from tofuse.engine.geometry.se3 import exp
from tofuse.engine.sensor.camera_errors import DepthCorrection
from tofuse.formats.images.images import write_png
from tofuse.formats.poses.trajectory import write_tum
from tofuse.formats.readers.native import NativeSource
from tofuse.formats.recordings.native import RecordingWriter
from tofuse.formats.recordings.open import open_recording
from written import change_camera, record

PINHOLE = Pinhole(40, 30, 35.0, 36.0, 19.5, 14.5)
CAMERAS: list[Camera] = [
    PINHOLE,
    BrownConrady(40, 30, 35.0, 36.0, 19.5, 14.5, -0.1, 0.02, 0.001, -0.002, 0.003),
    Rational(40, 30, 35.0, 36.0, 19.5, 14.5, 0.4, 0.02, 0.001, -0.002, 0.003, 0.5, 0.1, 0.01),
    Fisheye(40, 30, 35.0, 36.0, 19.5, 14.5, 0.01, -0.002, 0.001, -0.0002),
    RayTable(PINHOLE.rays() * np.float32(1.1)),
]


def image(index: int, camera: Camera = PINHOLE, **changes: Any) -> RangeFrame:
    rng = np.random.default_rng([10, index])
    shape = (camera.height, camera.width)
    depth = rng.uniform(0.5, 4, shape).astype(np.float32)
    depth[:3] = 0
    values: dict[str, Any] = {
        "amplitude_image": rng.integers(0, 65536, shape).astype(np.float32),
        "confidence_image": rng.integers(0, 8, shape, np.uint8),
        "color_image": rng.integers(0, 256, (*shape, 3), np.uint8),
    } | changes
    return RangeFrame(index, index / 8, camera, depth, **values)


def write(folder: Path, count: int = 4, camera: Camera = PINHOLE, **options: Any) -> Path:
    frames = [image(k, camera) for k in range(count)]
    return record(folder, frames, **({"depth_unit_m": 0.0005} | options))


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
@pytest.mark.parametrize("kind", ["z", "range"])
def test_round_trip(tmp_path: Path, camera: Camera, kind: str) -> None:
    facts = {"frame_rate_hz": 8, "ambiguity_m": 5, "confidence_max": 7, "amplitude_kind": "raw"}
    source = NativeSource(write(tmp_path / "a", camera=camera, depth_kind=kind, **facts))
    assert source.warnings == []
    np.testing.assert_array_equal(source.timestamps, np.arange(4) / 8)
    assert type(source.camera) is type(camera)
    assert source.camera == camera
    for k in range(4):
        frame, truth = source.read(k), image(k, camera)
        assert frame.depth_kind == kind
        assert frame.index == k
        # Half a count of range changes z by no more.
        np.testing.assert_allclose(frame.z, truth.z, atol=0.00025 + 1e-6)
        for name in ("valid", "amplitude_image", "confidence_image", "color_image"):
            np.testing.assert_array_equal(getattr(frame, name), getattr(truth, name))
    assert facts.items() <= source.metadata.items()


def test_zero_and_65535_are_invalid(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", 1)
    counts = np.full((30, 40), 1000, np.uint16)
    counts[0, 0], counts[0, 1], counts[0, 2] = 0, 65535, 65534
    write_png(folder / "depth" / "000000.png", counts)
    frame = NativeSource(folder).read(0)
    assert frame.depth[0, :4].tolist() == pytest.approx([0, 0, 65534 * 0.0005, 0.5])


@pytest.mark.parametrize("dtype", ["uint16", "float32", ">f8"])
def test_depth_saved_by_numpy(tmp_path: Path, dtype: str) -> None:
    folder = write(tmp_path / "r", depth_unit_m=0.001)
    as_png = [NativeSource(folder).read(k) for k in range(4)]
    for k, frame in enumerate(as_png):
        (folder / "depth" / f"{k:06d}.png").unlink()
        counts = np.rint(frame.depth * 1000)
        counts[5, 5] = 65535
        values = counts if dtype == "uint16" else np.where(counts > 0, counts / 1000, np.nan)
        values[5, 5] = 65535 if dtype == "uint16" else np.inf
        np.save(folder / "depth" / f"{k:06d}.npy", values.astype(dtype))
    for frame, truth in zip(map(NativeSource(folder).read, range(4)), as_png, strict=True):
        assert frame.depth[5, 5] == 0
        expected = np.where(frame.depth == 0, 0, truth.depth)
        np.testing.assert_allclose(frame.depth, expected, rtol=1e-6)
        assert frame.valid.sum() == truth.valid.sum() - 1
        np.testing.assert_array_equal(frame.color_image, truth.color_image)


@pytest.mark.parametrize(
    ("saved", "words"),
    [
        (np.full((30, 40), 1500.0), "median of 1500, which can't be m; save metres"),
        (np.ones((4, 30, 40)), r"of shape \(4, 30, 40\); save \(H, W\) floats"),
        (np.array([[{}]]), "is not an array; write it by numpy.save"),
        (np.ones((30, 40), complex), "is complex128"),
    ],
)
def test_other_arrays_as_depth_are_refused(tmp_path: Path, saved: Any, words: str) -> None:
    folder = write(tmp_path / "r", 1)
    (folder / "depth" / "000000.png").unlink()
    np.save(folder / "depth" / "000000.npy", saved)
    refused(words, 0, by=NativeSource(folder).read, error=UnreadableFrameError)
    np.save(folder / "depth" / "000000.npy", np.ones((40, 30)))
    refused(r"000000.npy: is 30 x 40 pixels, camera.json states", folder)


def test_depth_beyond_sixteen_bits_is_invalid_and_counted(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "a", PINHOLE, depth_unit_m=0.0001)
    depth = np.full((30, 40), 2.0, np.float32)
    depth[0, :5] = 6.5535
    writer.add(RangeFrame(0, 0.0, PINHOLE, depth))
    assert writer.out_of_range == 5
    assert len(NativeSource(writer.finish()).read(0)) == 30 * 40 - 5


def test_poses_tables_and_correction(tmp_path: Path) -> None:
    poses = exp(np.random.default_rng(11).normal(size=(3, 6)))
    poses[1] = np.nan
    correction = DepthCorrection(np.array([1.0, 3.0]), np.array([0.02, 0.04]))
    writer = RecordingWriter(tmp_path / "a", PINHOLE, depth_unit_m=0.0001)
    for k in range(3):
        depth = np.full((30, 40), 2.0, np.float32)
        writer.add(RangeFrame(k, 10 + k / 30, PINHOLE, depth))
    writer.finish(
        groundtruth=poses,
        odometry=poses[::-1],
        correction=correction,
        imu={"t": np.arange(9.0), "ax": np.ones(9)},
        frames={"integration_us": np.array([100, 200, 300])},
    )
    source = NativeSource(tmp_path / "a")
    np.testing.assert_allclose(source.reference[[0, 2]], poses[[0, 2]], atol=1e-14)
    assert np.isnan(source.reference[1]).all()
    np.testing.assert_allclose(source.odometry[0], poses[2], atol=1e-14)
    assert source.imu["t"].shape == (9,)
    assert source.frame_columns["integration_us"].tolist() == [100, 200, 300]
    # The correction applies to radial range, whatever is stored.
    frame = source.read(0)
    stored = RangeFrame(0, 0.0, PINHOLE, np.full((30, 40), 2.0, np.float32)).radial_range
    np.testing.assert_allclose(frame.radial_range, correction.correct(stored), atol=1e-5)
    assert source.metadata["corrected"]


def test_ground_truth_is_associated_by_time(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", 3)
    poses = exp(np.random.default_rng(12).normal(size=(3, 6)))
    write_tum(folder / "groundtruth.txt", [0.01, 0.15, 0.5], poses)
    source = NativeSource(folder)
    np.testing.assert_allclose(source.reference[0], poses[0], atol=1e-14)
    assert np.isnan(source.reference[1:]).all()
    assert "1 of 3 frames have a pose" in source.warnings[0]


def test_clouds(tmp_path: Path) -> None:
    rng = np.random.default_rng(13)
    writer = RecordingWriter(tmp_path / "a", None, frame_rate_hz=5.0)
    clouds = [rng.normal(size=(50 + k, 3)).astype(np.float32) for k in range(2)]
    clouds[1][7] = np.nan
    for k, points in enumerate(clouds):
        normals = points / np.linalg.norm(points, axis=1, keepdims=True)
        amplitude = np.arange(len(points), dtype=np.float32)
        color = rng.integers(0, 256, points.shape, np.uint8)
        writer.add(CloudFrame(k, k / 5, points, normals, None, amplitude, color))
    source = NativeSource(writer.finish())
    frame = source.read(0)
    assert isinstance(frame, CloudFrame)
    np.testing.assert_array_equal(frame.points, clouds[0])
    np.testing.assert_array_equal(frame.amplitude, np.arange(50))
    assert frame.normals is not None
    assert frame.color is not None
    assert len(source.read(1)) == 50
    (tmp_path / "a" / "camera.json").unlink()
    assert len(NativeSource(tmp_path / "a").read(0)) == 50


def test_color_of_other_camera_is_projected(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", 1)
    z = np.full((30, 40), 2.0)
    write_png(folder / "depth" / "000000.png", np.full((30, 40), 4000, np.uint16))
    # A colour camera of 80 x 50 pixels, 0.1 m to the right, whose image encodes its own pixels.
    color_camera = Pinhole(80, 50, 50.0, 50.0, 40.0, 25.0)
    T = np.eye(4)
    T[0, 3] = -0.1
    v, u = np.mgrid[:50, :80]
    write_png(folder / "color" / "000000.png", np.stack([u, v, 0 * u], -1).astype(np.uint8))
    intrinsics = {"width": 80, "height": 50, "fx": 50.0, "fy": 50.0, "cx": 40.0, "cy": 25.0}
    change_camera(folder, color={"intrinsics": intrinsics, "T_color_depth": T.tolist()})
    frame = NativeSource(folder).read(0)
    expected = np.rint(color_camera.project(points_from_z(PINHOLE, z) @ T[:3, :3].T + T[:3, 3]))
    inside = ((expected >= 0) & (expected < [80, 50])).all(-1)
    assert inside.sum() > 1000
    np.testing.assert_array_equal(frame.color_image[inside][:, :2], expected[inside])
    assert (frame.color_image[~inside] == 0).all()
    change_camera(folder, color=None)
    refused(r'"color" in camera.json', folder)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"schema": 2}, "schema is 2; write 1"),
        ({"schema": None}, "no schema, and is no camera.json; .* by `tofuse calibrate import`"),
        ({"model": "hexagonal"}, "model: is 'hexagonal'; write one of pinhole"),
        ({"model": ["pinhole"]}, "model: is"),
        ({"model": "rays"}, "no rays.npy"),
        ({"width": 41}, "40 x 30 pixels, camera.json states 41 x 30"),
        ({"width": 40.5}, "width: is 40.5"),
        ({"width": 10**9}, "width"),
        ({"fx": None}, "fx: is missing; use a positive number"),
        ({"fx": float("nan")}, "fx: is nan; use a finite"),
        ({"fx": 10**400}, "fx: is too large"),
        ({"distortion": [0.1]}, "distortion: has 1 number, the model 'pinhole' takes 0"),
        ({"model": "brown", "distortion": [0.1, "x"]}, r"distortion\[1\]: is 'x'"),
        ({"model": "brown", "distortion": [0.1, float("nan")]}, r"distortion\[1\]: is nan"),
        ({"depth_unit_m": None}, "depth_unit_m: is missing"),
        ({"depth_kind": "slant"}, "depth_kind: is 'slant'; write one of z, range"),
        ({"ambiguity_m": "five"}, "ambiguity_m: is 'five'"),
        ({"amplitude_kind": "loud"}, "amplitude_kind: is 'loud'"),
        ({"color": 5}, "color: has no intrinsics"),
        (
            {"color": {"intrinsics": {"width": 4, "height": 4, "fx": 1}, "T_color_depth": 0}},
            "color.intrinsics: fy: is missing",
        ),
    ],
)
def test_invalid_fields_are_named(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    folder = write(tmp_path / "a", 1)
    change_camera(folder, **changes)
    assert str(folder) in str(refused(words, folder))


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", '{"schema": 1,}', "[" * 100000, "\x00"])
def test_broken_json(tmp_path: Path, text: str) -> None:
    folder = write(tmp_path / "a", 1)
    (folder / "camera.json").write_text(text)
    refused("JSON", folder)


@pytest.mark.parametrize("name", ["amplitude", "confidence", "color", "depth"])
def test_inconsistent_counts(tmp_path: Path, name: str) -> None:
    folder = write(tmp_path / "a")
    (folder / name / "000002.png").unlink()
    refused(r"has 3 |has 4 ", folder)


def test_images_of_other_frames(tmp_path: Path) -> None:
    """Names of another first number are paired in order, but not those with other gaps."""
    folder = write(tmp_path / "a")
    for k in range(3, -1, -1):
        (folder / "color" / f"{k:06d}.png").rename(folder / "color" / f"{k + 1:06d}.png")
    assert any("paired in order" in line for line in NativeSource(folder).warnings)
    folder = write(tmp_path / "b")
    (folder / "timestamps.txt").unlink()
    for name in ("depth", "amplitude", "confidence"):
        (folder / name / "000001.png").unlink()
    (folder / "color" / "000002.png").unlink()
    refused("color: has names of other frames", folder)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("timestamps.txt", "0\n1\n2\n", "has 3 lines of 1 numbers for 4 frames"),
        ("timestamps.txt", "0\n1\nnan\n3\n", "line 3 is nan"),
        ("timestamps.txt", "0 1\n1 1\n2 1\n3 1\n", "4 lines of 2 numbers"),
        ("timestamps.txt", "0\n1\ntwo\n3\n", "not a table of numbers"),
        ("frames.csv", "a\n1\n", "has 1 row, depth/ has 4 files"),
        ("imu.csv", "", "is empty"),
        ("groundtruth.txt", "0 0 0\n", "line 1"),
        ("odometry.txt", "0 0 0 0 0 0 0 0\n", "line 1"),
        ("correction.npz", "no zip", "correction.npz"),
        ("rays.npy", "not a table", "rays.npy"),
    ],
)
def test_invalid_files_beside_images(tmp_path: Path, name: str, text: str, words: str) -> None:
    folder = write(tmp_path / "a")
    (folder / name).write_text(text)
    refused(words, folder)


def test_unsorted_and_repeated_timestamps_warn(tmp_path: Path) -> None:
    folder = write(tmp_path / "a")
    (folder / "timestamps.txt").write_text("0\n2\n1\n3\n")
    source = NativeSource(folder)
    assert source.timestamps.tolist() == [0, 2, 1, 3]
    assert "decreases at frame 2" in source.warnings[0]
    (folder / "timestamps.txt").write_text("0\n1\n1\n3\n")
    assert "frames 1 and 2 have the same timestamp" in NativeSource(folder).warnings[0]


@pytest.mark.parametrize(
    ("rays", "says"),
    [
        (PINHOLE.rays()[:, [0, *range(40)]], r"is 41 x 30, camera.json says 40 x 30"),
        (np.zeros((30, 40, 2), np.float32), "has only equal rays"),
        (np.full((30, 40, 2), np.nan, np.float32), "has no pixel with a ray"),
        (np.zeros((30, 40), np.float32), "shape"),
        (np.array([{}], object), r"rays\.npy"),
    ],
    ids=["size", "equal", "undefined", "shape", "objects"],
)
def test_unusable_rays(tmp_path: Path, rays: np.ndarray, says: str) -> None:
    folder = write(tmp_path / "a")
    np.save(folder / "rays.npy", rays, allow_pickle=True)
    refused(says, folder)


def test_rays_override_the_lens(tmp_path: Path) -> None:
    folder = write(tmp_path / "a")
    rays = (PINHOLE.rays() * 2).astype(np.float32)
    np.save(folder / "rays.npy", rays)
    np.testing.assert_array_equal(NativeSource(folder).read(0).camera.rays(), rays)


def test_rays_with_forged_header(tmp_path: Path) -> None:
    folder = write(tmp_path / "a")
    with (folder / "rays.npy").open("wb") as file:
        claim = {"descr": "<f4", "fortran_order": False, "shape": (30000, 4000000, 2)}
        np.lib.format.write_array_header_1_0(file, claim)
        file.write(bytes(1000))
    refused(r"rays\.npy", folder)


def test_damaged_frame_is_an_unreadable_frame(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", 5)
    path = folder / "depth" / "000001.png"
    path.write_bytes(path.read_bytes()[:200])
    write_png(folder / "depth" / "000002.png", np.zeros((30, 40), np.uint8))
    (folder / "amplitude" / "000003.png").write_bytes(b"")
    (folder / "confidence" / "000004.png").write_bytes(b"")
    source = NativeSource(folder)
    assert len(source.read(0))
    broken = ["depth/000001.png", "depth/000002.png", "amplitude/000003.png"]
    for k, name in enumerate([*broken, "confidence/000004.png"], 1):
        refused(name, k, by=source.read, error=UnreadableFrameError)


def test_frames_with_damaged_colour_are_used_without_it(tmp_path: Path) -> None:
    """One note counts them, also in a recording of several."""
    write(tmp_path / "a")
    folder = write(tmp_path / "b")
    (folder / "color" / "000001.png").write_bytes(b"")
    write_png(folder / "color" / "000002.png", np.zeros((31, 40, 3), np.uint8))
    (folder / "color" / "000003.png").unlink()
    (folder / "color" / "000003.png").symlink_to(tmp_path / "missing.png")
    recording = open_recording(tmp_path / "a", folder, max_depth=9)
    notes = recording.warnings
    for _ in range(2):  # not counted again
        colors = [frame.color_image is not None for frame in recording]
        assert colors == [True] * 5 + [False] * 3
    (note,) = set(recording.warnings) - set(notes)
    assert note.startswith("colour can't be read in 3 frames")
    assert "color/000001.png: is empty" in note
    np.testing.assert_array_equal(recording[6].depth, recording[2].depth)


def test_camera_of_different_image_size(tmp_path: Path) -> None:
    folder = write(tmp_path / "a")
    # The first image is truncated: the next readable one decides.
    (folder / "depth" / "000000.png").write_bytes(b"\x89PNG")
    change_camera(folder, width=80)
    with pytest.raises(InputError, match=r"camera.json states 80 x 30") as caught:
        NativeSource(folder)
    assert not isinstance(caught.value, UnreadableFrameError)


def test_a_first_image_of_another_size_is_one_frame_without_it(tmp_path: Path) -> None:
    """A thumbnail, or a frame of another mode of the camera, says nothing of the others."""
    folder = write(tmp_path / "a", 3)
    (folder / "color").mkdir(exist_ok=True)
    for k, size in enumerate([(60, 80, 3), (30, 40, 3), (30, 40, 3)]):
        write_png(folder / "color" / f"{k:06}.png", np.full(size, 100, np.uint8))
    recording = open_recording(folder)
    assert recording[0].color is None
    assert recording[1].color is not None
    assert any("colour can't be read in 1 frame" in line for line in recording.warnings)
    for k in (1, 2):
        write_png(folder / "color" / f"{k:06}.png", np.full((60, 80, 3), 100, np.uint8))
    refused(r"000000.png: is 80 x 60 pixels, camera.json states", folder)


def test_color_for_display_may_have_any_size(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", 2)
    (folder / "color").mkdir(exist_ok=True)
    for k in range(2):
        write_png(folder / "color" / f"{k:06}.png", np.full((90, 160, 3), 100, np.uint8))
    refused(r'"color_registered": false', folder)
    change_camera(folder, color_registered=False)
    frame = open_recording(folder)[0]
    assert not frame.color_registered
    assert frame.color_image.shape == (30, 40, 3)
    lens = {"width": 160, "height": 90, "fx": 100, "fy": 100, "cx": 80, "cy": 45}
    change_camera(folder, color={"intrinsics": lens})
    refused("T_color_depth: is missing", folder)


def test_writer_refuses_invalid_frames(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "a", PINHOLE)
    refused("no frames", by=writer.finish)
    writer.add(image(0))
    refused("channels", image(1, color_image=None), by=writer.add)
    with pytest.raises(InputError, match="40 x 31"):
        writer.add(
            RangeFrame(1, 0.0, Pinhole(40, 31, 30.0, 30.0, 0.0, 0.0), np.ones((31, 40), np.float32))
        )
    refused("cloud", CloudFrame.of(np.zeros((3, 3))), by=writer.add)
    refused("poses", by=writer.finish, groundtruth=np.zeros((2, 4, 4)))
    # At this point the folder is not a recording yet.
    refused(r"camera\.json", tmp_path / "a")
    writer.finish()
    refused("isn't empty", tmp_path / "a", PINHOLE, by=RecordingWriter, error=OutputError)


def test_same_frames_give_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write(tmp_path / name, camera=CAMERAS[4])
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*.*"))
    assert len(files) == 4 * 4 + 3
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
