"""One table of recordings in all formats: what is read, and what damage to them is reported."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import made_sens
import made_tof
from camera_files import EVERY, MAKERS, made, read_frames
from damaged_files import damage
from made_phones import CX, CY, DEPTH, FX, millimetres
from made_tof import adi_frame
from phone_checks import check_frames, check_lens
from tofuse.engine.errors import InputError, TofuseError
from tofuse.engine.frames.recording import Recording
from tofuse.formats.images.images import write_png
from tofuse.formats.recordings.open import open_recording, readers

# `benchmarks/attack.py` runs any number.
ROUNDS, CUTS = 12, 6
# TIFF and single PNG images have no camera but the given one; scans are written by libraries.
ELSEWHERE = {"tiff", "depth-png", "las", "e57"}


def digest(recording: Recording) -> list[float]:
    """Numbers that change if points, their pixels, channels, times, poses or warnings do."""
    totals = np.zeros(7)
    for frame in recording:
        order = np.linspace(1, 2, len(frame))
        totals[0] += len(frame)
        totals[1:4] += order @ frame.points / len(frame)
        image = getattr(frame, "confidence_image", None)
        sure = None if image is None else image[frame.valid]
        for k, channel in enumerate((frame.amplitude, frame.color, sure), 4):
            if channel is not None:
                totals[k] += order @ channel.reshape(len(frame), -1).mean(1) / len(frame)
    times = np.asarray(recording.timestamps)
    poses = [np.nansum(p) for p in (recording.reference, recording.odometry) if p is not None]
    rest = [times[0] % 1000, times[-1] - times[0], sum(poses), len(recording.warnings)]
    return [*totals.tolist(), *map(float, rest)]


# Valid points, means of x, y, z, amplitude, colour and confidence, first time modulo 1000 s,
# duration, sum of all poses, and number of warnings.
DIGESTS: dict[str, tuple[float, ...]] = {
    "3dscannerapp": (2301, 0.038234, 0.60273, 9.7493, 0, 85.385, 4.5409, 0.5, 0.4, 9.1929, 1),
    "stray": (2301, 0.038276, 0.60321, 9.7493, 0, 0, 4.5409, 100, 0.033333, 9.1929, 1),
    "arkitscenes": (2301, 0.038234, 0.60273, 9.7493, 0, 255.35, 4.5409, 418.328, 0.2, 9.1929, 0),
    "record3d": (2301, 0.031023, 0.80159, 9.7562, 0, 256.32, 0, 0, 0.033333, 9.1929, 1),
    "mkv": (1.8427e+05, -0.19698, -0.44597, 6.0053, 2000.8, 60.979, 0, 5.000007, 0.033333, 0, 0),
    "o3r": (642, -0.028973, 0.53476, 6.9903, 1.4191e+05, 0, 0, 0, 0.1, 0, 0),
    "npz": (570, -0.035101, 0.46616, 11.877, 223.28, 573.72, 16.029, 5, 0.3, 18.339, 0),
    "sens": (3599, 0.10151, 0.34361, 7.2086, 0, 380.35, 0, 1e-05, 0.066666, 8.24, 0),
    "scannet": (3599, 0.10151, 0.34361, 7.2086, 0, 380.35, 0, 0, 0.066667, 8.24, 0),
    "zense": (570, -0.036309, 0.49361, 12.328, 0, 0, 0, 0, 0.13333, 0, 1),
    "helios": (1845, 0.29965, 0.3251, 8.8547, 9101.4, 0, 0, 0, 2, 0, 1),
    "csv": (1845, 0.29964, 0.32509, 8.8548, 9101.4, 0, 0, 0, 2, 0, 0),
    "r3d": (2301, 0.031, 0.8016, 9.7561, 0, 256.32, 4.544, 0, 0.033333, 9.1929, 0),
    "polycam": (2301, 0.038234, 0.60273, 9.7493, 0, 256.39, 4.5409, 5, 0.5, 9.1929, 0),
    "nerfstudio": (2301, -0.05253, 0.56447, 9.7493, 0, 256.39, 0, 0, 2, 9.1929, 1),
    "nerfcapture": (2301, -0.12047, 0.25763, 9.7493, 0, 255.35, 0, 7, 0.2, 9.1929, 0),
    "hololens2": (2277, -0.023627, 0.52068, 8.4627, 5390.9, 0, 0, 0, 0.4, 9.1929, 0),
    "kinect2": (6.2054e+05, 0.0043393, 0.3808, 4.95, 0, 170.77, 0, 0, 2, 0, 2),
    "depth16": (2301, 0.038477, 0.42185, 9.7493, 0, 85.385, 23.945, 0, 0.2, 0, 1),
    "arducam": (2292, 0.051926, 0.43612, 9.7456, 0, 0, 185.04, 0, 0.2, 0, 0),
    "aditof": (9153, -0.33457, 0.48241, 8.6021, 3227.6, 0, 0, 0, 0.5, 0, 0),
    "native": (3600, 0.018199, 0.39758, 8.582, 900, 225, 31.5, 0, 0.2, 24, 1),
    "sr4000": (573, 0.057247, 0.3644, 11.491, 479.09, 0, 22.5, 0, 0.0625, 0, 0),
    "tum": (9.2159e+05, 0.0013921, 0.045244, 2.0231, 0, 4.5, 0, 102.16, 0.066667, -1.4855, 0),
    "7scenes": (9.2159e+05, -0.0071238, 0.45309, 10.115, 0, 4.5, 0, 0, 0.13333, -1.4855, 2),
    "redwood": (9.2159e+05, 0.0016957, 0.51451, 10.115, 0, 4.5, 0, 0, 0.066738, -1.4855, 1),
    "sun3d": (9216, 0.20337, 0.33357, 10.844, 0, 167.94, 0, 0, 0.132, 10.292, 0),
    "replica": (9216, 0.20338, 0.33357, 10.844, 0, 167.94, 0, 0, 2, 10.292, 0),
    "bop": (9216, 0.20338, 0.33357, 10.844, 0, 167.94, 0, 0, 2, 10.292, 0),
    "pairs": (9216, 0.20338, 0.33357, 10.844, 0, 167.94, 0, 0, 2, 0, 0),
    "pcd": (1655, 6.817, 7.1366, 13.63, 0, 0, 0, 0, 2, 8, 1),
    "ply": (32, 1.0201, 0.91402, 0.74226, 0, 0, 0, 0, 1, 4, 1),
    "xyz": (4, 9, 12, 15, 0, 10.5, 0, 0, 1, 0, 0),
    "slam6d": (4, 0.09, -0.12, 0.15, 0, 0, 0, 0, 1, 15.955, 1),
    "ptx": (16, 14.333, 16, 20.5, 1.75, 16.444, 0, 0, 2, 60, 0),
    "h5": (642, -0.028973, 0.53476, 6.9903, 1.4191e+05, 0, 0, 0, 0.1, 0, 0),
    "mcap": (576, 0.035607, 0.4362, 12.523, 0, 0, 0, 10, 2, 0, 0),
    "realsense": (576, 0.033295, 0.28397, 8.625, 592.37, 443.27, 0, 10, 0.066667, 0, 0),
    "orbbec": (576, 0.033295, 0.28397, 8.625, 6260.6, 664.63, 0, 10, 0.13333, 0, 0),
}  # fmt: skip


def test_every_format_is_in_the_table() -> None:
    assert {format_ for _, _, format_ in EVERY.values()} | ELSEWHERE == set(readers())


@pytest.mark.parametrize("name", EVERY)
def test_recording_is_read_completely(tmp_path: Path, name: str) -> None:
    path, format_ = made(name, tmp_path)
    recording = open_recording(tmp_path / path)
    assert recording.format == format_
    np.testing.assert_allclose(digest(recording), DIGESTS[name], rtol=1e-3, atol=2e-4)


# Recordings of the depth, colour and poses of `made_phones`: options of the check, and by how many
# pixels the focal length grows from frame to frame.
PHONES: dict[str, tuple[dict[str, Any], int]] = {
    "3dscannerapp": ({}, 1),
    "stray": ({}, 0),
    "arkitscenes": ({}, 1),
    "polycam": ({}, 1),
    "record3d": ({"turned": True, "exact": 2e-3}, 0),  # half floats
    "r3d": ({"turned": True, "exact": 0}, 0),
}


@pytest.mark.parametrize("name", PHONES)
def test_phones_are_read_as_they_were_written(tmp_path: Path, name: str) -> None:
    options, growth = PHONES[name]
    path, _ = made(name, tmp_path)
    recording = open_recording(tmp_path / path)
    check_frames(recording, **options)
    center = (CY, CX) if "turned" in options else (CX, CY)
    for k, frame in enumerate(recording):
        check_lens(frame, FX + growth * k, *center)


def turned_depth(path: Path) -> None:
    """The lens is of ARKit's landscape images: scaled to upright ones it would have two scales."""
    for k in range(3):
        write_png(path / f"depth_{k:05d}.png", millimetres(DEPTH[k]).T)


@pytest.mark.parametrize("name", ["polycam", "3dscannerapp", "7scenes", "scannet", "redwood"])
def test_suffixes_in_capitals(tmp_path: Path, name: str) -> None:
    path, format_ = made(name, tmp_path)
    for file in [p for p in (tmp_path / path).rglob("*.*") if p.is_file()]:
        if "trinsic" not in file.name and file.suffix != ".log":
            file.rename(file.with_suffix(file.suffix.upper()))
    recording = open_recording(tmp_path / path)
    assert recording.format == format_
    np.testing.assert_allclose(digest(recording), DIGESTS[name], rtol=1e-3, atol=2e-4)


Change = Callable[[Path], object]
REFUSED = "refused"


def drop(pattern: str) -> Change:
    def change(path: Path) -> None:
        for file in list(path.glob(pattern)):
            shutil.rmtree(file) if file.is_dir() else file.unlink()

    return change


def put(name: str, content: str | bytes) -> Change:
    content = content.encode() if isinstance(content, str) else content
    return lambda path: (path / name).write_bytes(content)


def cut(by: int, name: str = "") -> Change:
    """Leave out the last bytes of a file."""

    def change(path: Path) -> None:
        file = path / name if name else path
        file.write_bytes(file.read_bytes()[:-by])

    return change


def replaced(old: bytes, new: bytes, name: str = "") -> Change:
    def change(path: Path) -> None:
        file = path / name if name else path
        data = file.read_bytes()
        assert old in data
        file.write_bytes(data.replace(old, new, 1))

    return change


def fields(name: str, **changes: object) -> Change:
    """Change fields of a JSON file; None removes one."""

    def change(path: Path) -> None:
        data = json.loads((path / name).read_text()) | changes
        (path / name).write_text(json.dumps({k: v for k, v in data.items() if v is not None}))

    return change


def both(*changes: Change) -> Change:
    return lambda path: [change(path) for change in changes]


def adi(*frames: bytes) -> Change:
    return lambda path: path.write_bytes(b"".join(frames))


def longer_points(path: Path) -> None:
    """Points of another lens are 4 % longer than the depth: one of both is misread."""
    data = bytearray(adi_frame(0))
    at = len(data) - 6 * 64 * 48
    data[at:] = (np.frombuffer(bytes(data[at:]), "<i2") * 1.04).astype("<i2").tobytes()
    path.write_bytes(data)


SMALL = made_tof.Rational(32, 24, 23.0, 23.0, 15.5, 11.5)
TRANSFORMS = "transforms.json"
ONE_IMAGE = "only 2 of 3 frames have colour"

DAMAGED: list[tuple[str, Change, str | tuple[int, ...], str]] = [
    ("sr4000", put("frm_0002.dat", "% Calibrated Distance\n1 2\n"), (1,), "interpolated"),
    ("tum", put("depth.txt", "1.0 ../../secret.png\n"), REFUSED, "depth.txt, line 1"),
    ("tum", put("depth.txt", "1.0 /etc/passwd\n"), REFUSED, "depth.txt, line 1"),
    ("tum", put("depth.txt", "1.0\n"), REFUSED, "depth.txt, line 1"),
    ("tum", put("depth.txt", "x depth/a.png\n"), REFUSED, "depth.txt, line 1"),
    ("tum", drop("rgb/*102.16*"), (), ONE_IMAGE),
    ("tum", drop("rgb/*.png"), (), "none of the colour images exists"),
    ("7scenes", put("frame-000002.pose.txt", "-1.#IND 0 0 0\n"), (), "frame-000002.pose.txt"),
    ("7scenes", drop("frame-000004.color.png"), (), ONE_IMAGE),
    ("redwood", put("trajectory.log", "0 0 1\n1 0 0 0\n"), REFUSED, "lines"),
    ("redwood", replaced(b"2 2 3", b"9 9 9", "trajectory.log"), REFUSED, "frame 9"),
    ("redwood", replaced(b"2 2 3", b"two", "trajectory.log"), REFUSED, "pose 2"),
    ("redwood", replaced(b"0.0 0.0 0.0 1.0", b"0 0 1 1", "trajectory.log"), REFUSED, "last row"),
    (
        "redwood",
        put("camera.json", '{"intrinsic_matrix": [1, 2, 3], "width": 640}'),
        REFUSED,
        "intrinsic_matrix: is not 3 x 3",
    ),
    ("redwood", drop("color/000001.png"), (), ONE_IMAGE),
    ("sun3d", put("intrinsics.txt", "570 0 320\n"), REFUSED, "intrinsics.txt: is not a 3x3 matrix"),
    ("bop", put("scene_camera.json", '{"0": []}'), REFUSED, "image 0: is missing"),
    ("bop", put("depth/a.png", b""), REFUSED, "has names that are no numbers"),
    ("sun3d", put("extrinsics/20140808220511.txt", "x"), (), "0511.txt: is not a table of"),
    ("replica", put("results/depth000001.png", b""), (1,), "depth000001.png: is empty"),
    ("pcd", put("0.pcd", "This is no point cloud.\n" * 100), (0,), "is not a PCD file"),
    ("ply", put("timestamps.txt", "0.5\n"), REFUSED, "timestamps.txt"),
    ("slam6d", put("scan000.pose", "1 2 3\n"), (), "scan000.pose"),
    ("ptx", put("b.ptx", "2\n3\n0 0 0\n"), REFUSED, "b.ptx: has no header of a PTX scan"),
    ("ptx", put("b.ptx", "5\n-3\n" + "0\n" * 9), REFUSED, "b.ptx: has no header of a PTX scan"),
    ("ptx", put("b.ptx", ""), REFUSED, "b.ptx: has no header of a PTX scan"),
    ("ptx", put("b.ptx", b"\xff" * 99), REFUSED, "b.ptx: has no header of a PTX scan"),
    ("ptx", cut(20, "b.ptx"), (2,), "b.ptx: has 4 lines of 4 numbers, not 6 of 4 or 7"),
    ("ptx", replaced(b"0 1 0 0", b"0 1 0 9", "b.ptx"), (), "can't be read"),
    ("3dscannerapp", put("frame_00001.json", '{"time": 1}'), (1,), "intrinsics: is missing"),
    ("3dscannerapp", turned_depth, REFUSED, "1920 x 1440 image, depth 24 x 32: another aspect"),
    ("stray", drop("camera_matrix.csv"), REFUSED, "camera_matrix.csv: is missing"),
    ("stray", put("odometry.csv", "timestamp,frame,x,y,z,qx,qy,qz,qw\n"), REFUSED, "no timestamp"),
    ("stray", put("imu.csv", "timestamp,a_x,a_y,a_z,alpha_x,alpha_y,alpha_z\n"), (), ""),
    ("native", put("imu.csv", "timestamp,ax,ay,az\n"), (), ""),
    ("native", put("groundtruth.txt", "# no poses\n"), (), "0 of 3 frames have a pose"),
    ("arkitscenes", drop("lowres_wide_intrinsics/*.428.*"), (1,), "has no file in lowres_wide_in"),
    ("arkitscenes", put("lowres_depth/a.png", b""), REFUSED, "name doesn't end with its time"),
    ("arkitscenes", put("lowres_wide.traj", "1 2 3\n"), REFUSED, "lowres_wide.traj: is not lines"),
    ("r3d", cut(2000), REFUSED, "damaged archive"),
    ("polycam", put("keyframes/cameras/5000000.json", '{"fx": NaN}'), (0,), "fy: is missing"),
    ("polycam", drop("keyframes/images/5250000.jpg"), (), ONE_IMAGE),
    ("polycam", drop("keyframes/depth"), REFUSED, "has no .png files"),
    ("nerfstudio", fields(TRANSFORMS, fl_x=None), REFUSED, "transforms.json: fl_x: is missing"),
    ("nerfstudio", fields(TRANSFORMS, fl_x="wide"), REFUSED, "fl_x: is 'wide'"),
    (
        "nerfstudio",
        fields(TRANSFORMS, camera_model="EQUIRECTANGULAR"),
        REFUSED,
        "use one of PERSPECTIVE",
    ),
    ("nerfstudio", fields(TRANSFORMS, k4=0.1), REFUSED, "k4: is not 0"),
    ("nerfstudio", fields(TRANSFORMS, w=100), REFUSED, "another aspect ratio"),
    ("nerfstudio", fields(TRANSFORMS, depth_unit_scale_factor=-1), REFUSED, "is -1"),
    ("nerfstudio", fields(TRANSFORMS, frames=[]), REFUSED, "has no frames with depth_file_path"),
    ("nerfstudio", fields(TRANSFORMS, frames={}), REFUSED, "has no list of frames"),
    (
        "nerfcapture",
        fields(TRANSFORMS, integer_depth_scale=None),
        REFUSED,
        "integer_depth_scale: is missing",
    ),
    ("kinect2", put("calib_ir.yaml", "cameraMatrix:\n data: [1, x]"), REFUSED, "of 9 numbers"),
    ("kinect2", drop("*.yaml"), REFUSED, "calib_ir.yaml"),
    ("depth16", drop("camera.json"), REFUSED, "contain neither size nor lens"),
    ("arducam", drop("camera.json"), REFUSED, "contain neither lens nor unit"),
    ("arducam", drop("confidence_*0103.raw"), (), "frames have no confidence"),
    ("arducam", put("depth_33_24_f32_1700000009000.raw", bytes(4 * 33 * 24)), (3,), "is 33 x 24"),
    ("aditof", adi(adi_frame(0, points=False)), REFUSED, "pass the lens with camera"),
    ("aditof", longer_points, REFUSED, "not at the depth along the rays"),
    ("aditof", adi(adi_frame(0), adi_frame(1, lens=SMALL)), (1,), "is 32 x 24 pixels"),
    ("aditof", cut(5), (), "is cut off or damaged: its end is left out"),
    ("aditof", adi(adi_frame(0)[:127]), REFUSED, ""),
    ("aditof", adi(b""), REFUSED, ""),
    ("sens", cut(200), (), "cut off after 2 of 3"),
    ("sens", lambda path: made_sens.make_sens(path, depth="occi"), REFUSED, "by method 2"),
    ("scannet", put("intrinsic/intrinsic_depth.txt", "577 0 320\n"), REFUSED, "not a 4x4 matrix"),
    ("scannet", drop("intrinsic/intrinsic_color.txt"), (), "lens of color/ is missing"),
    ("scannet", put("intrinsic/extrinsic_color.txt", "1 0 0 0\n"), (), "extrinsics: has 1 row"),
    ("scannet", drop("pose/2.txt"), (), ""),
    ("mkv", cut(1000), (), "colour can't be read in 1 frame, which is used without, the first: "),
    ("tum", cut(99, "rgb/1305031102.160000.png"), (), "colour can't be read in 1 frame"),
    ("3dscannerapp", put("frame_00001.jpg", b""), (), "frame_00001.jpg: is empty"),
    ("3dscannerapp", put("conf_00001.png", b""), (1,), "conf_00001.png: is empty"),
    ("arkitscenes", put("lowres_wide/41048190_3418.428.png", b""), (), "used without"),
    ("record3d", put("rgb/1.jpg", b""), (), "rgb/1.jpg: is empty"),
    ("nerfstudio", put("images/frame_1.jpg", b""), (), "frame_1.jpg: is empty"),
    ("scannet", put("color/1.jpg", b""), (), "color/1.jpg: is empty"),
    ("h5", put("", b"\x89HDF no more"), REFUSED, "a.h5"),
    ("npz", cut(100), REFUSED, "a.npz"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "change", "outcome", "says"), DAMAGED)
def test_damage_is_reported(tmp_path, name, change, outcome, says) -> None:
    path, format_ = made(name, tmp_path)
    change(tmp_path / path)
    if outcome == REFUSED:
        with pytest.raises(InputError) as refused:
            open_recording(tmp_path / path, format=format_)
        assert says in str(refused.value)
        assert len(str(refused.value).splitlines()) == 1
        return
    recording = open_recording(tmp_path / path, format=format_)
    errors = {k: e for k, e in enumerate(recording.read_all()) if isinstance(e, TofuseError)}
    assert tuple(errors) == outcome
    assert says in " ".join([*map(str, errors.values()), *recording.warnings])


@pytest.mark.nightly
@pytest.mark.parametrize("name", EVERY)
def test_random_damage_raises_only_package_errors(tmp_path: Path, name: str) -> None:
    original, copy = tmp_path / "original", tmp_path / "copy"
    path, format_ = made(name, original)
    whole = unread = refused = 0
    for k in range(ROUNDS):
        rng = np.random.default_rng([70, len(name), k])
        shutil.copytree(original, copy)
        for _ in range(1 + int(rng.integers(2))):
            if files := sorted(p for p in copy.rglob("*") if p.is_file()):
                damage(files, rng)
        read = read_frames(copy / path, format_ if k % 2 else None)
        whole, unread, refused = (
            whole + len(read.frames), unread + read.unread, refused + read.refused
        )  # fmt: skip
        shutil.rmtree(copy)
    # Some damage must have been noticed, and some harmless.
    assert unread + refused > 0
    assert whole > 0


@pytest.mark.nightly
@pytest.mark.parametrize("name", MAKERS)
def test_truncated_file_loses_no_frame_silently(tmp_path: Path, name: str) -> None:
    """Frames that are read have the same depth; an error or a warning tells of missing ones."""
    path, format_ = made(name, tmp_path)
    original = read_frames(tmp_path / path, format_)
    files = sorted(p for p in tmp_path.rglob("*") if p.is_file())
    rng = np.random.default_rng([71, len(name)])
    noticed = 0
    for _ in range(CUTS):
        file = files[rng.integers(len(files))]
        data = file.read_bytes()
        file.write_bytes(data[: rng.integers(len(data))])
        read = read_frames(tmp_path / path, format_)
        file.write_bytes(data)
        reported = read.refused or read.unread > 0 or read.warnings != original.warnings
        assert reported or len(read.frames) == len(original.frames)
        noticed += reported
        for frame in read.frames:
            # Files without a number of points may lose some.
            expected = original.frames[frame.index].depth[frame.valid]
            np.testing.assert_allclose(frame.depth[frame.valid], expected, rtol=1e-3)
    assert noticed > 0
