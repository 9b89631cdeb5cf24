"""Trajectories of other programs: all formats give the same poses, invalid files a clear error."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError, InputWarning
from tofuse.engine.geometry import se3
from tofuse.engine.geometry.quaternion import from_matrix
from tofuse.engine.quality.trajectory_errors import evaluate_trajectory
from tofuse.formats.poses.trajectory import write_kitti, write_log, write_tum
from tofuse.formats.poses.trajectory_formats import TimedPoses, read_poses

POSES = np.stack(
    [se3.exp(np.array([0.1 * k, -0.05 * k, 0.02, 0.01 * k, 0.3 * k, -0.02 * k])) for k in range(5)]
)
TIMES = 1_700_000_000.0 + np.arange(5) / 30


def wxyz(T):
    return np.roll(from_matrix(T[:3, :3]), 1)


def euroc(path: Path, times: Float64 = TIMES) -> None:
    lines = ["#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],..."]
    for time, T in zip(times, POSES, strict=True):
        # Velocities and biases follow.
        cells = [f"{round(1e9 * time)}", *(repr(float(v)) for v in (*T[:3, 3], *wxyz(T), 1, 2, 3))]
        lines.append(",".join(cells))
    path.write_text("\n".join(lines) + "\n")


def orb_slam3(path: Path, times: Float64 = TIMES) -> None:
    """What ORB-SLAM3 calls EuRoC: times in ns, the quaternion in the order of TUM."""
    rows = [
        f"{1e9 * time:.6f} " + " ".join(str(float(v)) for v in (*T[:3, 3], *from_matrix(T[:3, :3])))
        for time, T in zip(times, POSES, strict=True)
    ]
    path.write_text("\n".join(rows) + "\n")


def colmap(path: Path) -> None:
    lines = ["# Image list with two lines of data per image:"]
    for k in (3, 0, 1, 4, 2):
        T = se3.inverse(POSES[k])
        numbers = " ".join(repr(float(v)) for v in (*wxyz(T), *T[:3, 3]))
        lines += [f"{k + 7} {numbers} 1 depth/frame_{k:05d}.png", "12.5 13.5 -1 20 21 5"]
    path.write_text("\n".join(lines) + "\n")


def transforms(path: Path) -> None:
    opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {"file_path": f"images/{k:04d}.jpg", "transform_matrix": (POSES[k] @ opengl).tolist()}
        for k in range(5)
    ]
    path.write_text(json.dumps({"fl_x": 500.0, "frames": frames}))


FORMATS = {
    "a.txt": lambda path: write_tum(path, TIMES, POSES),
    "data.csv": euroc,
    "orb.txt": orb_slam3,
    "kitti.txt": lambda path: write_kitti(path, POSES),
    "trajectory.log": lambda path: write_log(path, POSES, np.arange(5)),
    "images.txt": colmap,
    "transforms.json": transforms,
    "poses.npy": lambda path: np.save(path, POSES),
}
TIMED = ("a.txt", "data.csv", "orb.txt")


@pytest.mark.parametrize("name", FORMATS)
def test_all_formats_give_same_poses(name: str, tmp_path: Path) -> None:
    FORMATS[name](tmp_path / name)
    found = read_poses(tmp_path / name)
    assert (found.timestamps is not None) == (name in TIMED)
    np.testing.assert_allclose(found.of_frames(TIMES, np.arange(5)), POSES, atol=1e-6)
    if found.timestamps is not None:
        np.testing.assert_allclose(found.timestamps, TIMES, atol=1e-6)


def test_numbered_poses_are_assigned_to_selected_frames(tmp_path: Path) -> None:
    transforms(tmp_path / "transforms.json")
    some = read_poses(tmp_path / "transforms.json").of_frames(TIMES[:3], np.array([2, 9, 4]))
    np.testing.assert_allclose(some[[0, 2]], POSES[[2, 4]], atol=1e-9)
    assert np.isnan(some[1]).all()


def test_lost_frames_are_skipped(tmp_path: Path) -> None:
    lost = POSES.copy()
    lost[2] = np.nan
    np.save(tmp_path / "p.npy", lost)
    assert read_poses(tmp_path / "p.npy").frames.tolist() == [0, 1, 3, 4]
    rows = [" ".join(str(v) for v in T[:3].ravel()) for T in lost]
    (tmp_path / "kitti.txt").write_text("\n".join(rows))
    found = read_poses(tmp_path / "kitti.txt").of_frames(TIMES, np.arange(5))
    assert np.isnan(found[2]).all()
    np.testing.assert_allclose(found[3], POSES[3], atol=1e-9)


def test_too_few_unnumbered_poses_are_assigned_with_a_warning(tmp_path: Path) -> None:
    """Programs leave lost frames out of KITTI's files: then all later poses are of other frames."""
    write_kitti(tmp_path / "kitti.txt", POSES[:4])
    few = read_poses(tmp_path / "kitti.txt")
    with pytest.warns(InputWarning, match=r"kitti.txt: has 4 poses .*, and the recording 5 frames"):
        few.of_frames(TIMES, np.arange(5))
    few.of_frames(TIMES[:2], np.array([1, 3]))  # frames 1 and 3 of a recording of four


BAD = {
    "pandas.csv": (
        b"timestamp,tx,ty,tz,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n",
        "line 1: .* begin it with",
    ),
    "euroc.csv": (
        b"timestamp,x,y,z,w,x,y,z,vx,vy,vz\n1500000000000000000,0\n",
        "begin it with '#'",
    ),
    "empty.txt": (b"", "contains no poses"),
    "comments.txt": (b"# nothing\n", "contains no poses"),
    "two.txt": (b"1 2\n3 4\n", "has 2 columns"),
    "binary.txt": (bytes(range(256)), "binary.txt"),
    "words.txt": (b"a b c d e f g h\n", "could not convert|is no number|a"),
    "kitti-short.txt": (b"1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0\n", "line 2"),
    "kitti-scaled.txt": (b"2 0 0 0 0 2 0 0 0 0 2 0\n", "no rotation"),
    "kitti-nan.txt": (b"1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 nan 0 1 0 0 0 0 1 0\n", "line 2.*finite"),
    "kitti-far.txt": (b"1 0 0 0 0 1 0 1e30 0 0 1 0\n", "line 1: has a coordinate of 1e"),
    "euroc-nan.csv": (b"1500000000000000000,0,0,0,nan,0,0,0\n", "line 1.*finite"),
    "images-far.txt": (b"1 1 0 0 0 0 1e300 0 1 a1.png\n", "line 1: .*coordinate"),
    "short.log": (b"0 0 1\n1 0 0 0\n0 1 0 0\n", "not 5 for each pose"),
    "huge.log": (b"9" * 5000 + b" 0 1" + b"\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "names frame"),
    "huge.json": (
        b'{"frames": [{"transform_matrix": [[1' + b"0" * 400 + b"]]}]}",
        "transform_matrix",
    ),
    "images.txt": (b"1 1 0 0 0 0 0 0 1 camera.png\n", "without a number"),
    "twice.txt": (b"1 1 0 0 0 0 0 0 1 a1.png\n2 1 0 0 0 0 0 0 1 b1.png\n", "same number"),
    "quaternion.txt": (b"1 3 0 0 0 0 0 0 1 a1.png\n", "unit length"),
    "a.json": (b"{", "not valid JSON"),
    "list.json": (b"[1]", "no list 'frames'"),
    "none.json": (b'{"frames": []}', "no list 'frames'"),
    "matrix.json": (b'{"frames": [{"transform_matrix": "x"}]}', "transform_matrix|4x4"),
    "deep.json": (b"[" * 100_000, "not valid JSON"),
    "a.npy": (b"\x93NUMPY", "not an array"),
    "object.npy": (b"", "not an array"),
}


def test_folder_without_poses_has_a_remedy(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"contains none of .*; pass a result, or a file of poses"):
        read_poses(tmp_path)


@pytest.mark.parametrize("name", BAD)
def test_bad_file_is_rejected(name: str, tmp_path: Path) -> None:
    content, words = BAD[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        read_poses(tmp_path / name)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("shape", [(4, 4), (3, 2, 4), (0,)])
def test_wrong_array_shape_is_rejected(shape, tmp_path: Path) -> None:
    np.save(tmp_path / "p.npy", np.zeros(shape))
    with pytest.raises(InputError, match="shape"):
        read_poses(tmp_path / "p.npy")


def test_array_of_transposed_poses_is_rejected(tmp_path: Path) -> None:
    np.save(tmp_path / "p.npy", POSES.transpose(0, 2, 1))
    with pytest.raises(InputError, match=r"p.npy, pose \d: .*stored by columns"):
        read_poses(tmp_path / "p.npy")


def test_object_arrays_are_not_unpickled(tmp_path: Path) -> None:
    np.save(tmp_path / "p.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="not an array"):
        read_poses(tmp_path / "p.npy")


def test_damaged_files_never_crash(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for name, write in FORMATS.items():
        write(tmp_path / name)
        content = bytearray((tmp_path / name).read_bytes())
        for _ in range(40):
            damaged = bytearray(content)
            for at in rng.integers(0, len(damaged), 3):
                damaged[at] = rng.integers(0, 256)
            (tmp_path / name).write_bytes(damaged[: rng.integers(1, len(damaged) + 1)])
            try:
                found = read_poses(tmp_path / name)
            except InputError:
                continue
            assert isinstance(found, TimedPoses)
            assert np.isfinite(found.poses).all()


def test_true_error_is_within_interval() -> None:
    rng = np.random.default_rng(1)
    truth = np.tile(np.eye(4), (50, 1, 1))
    truth[:, :3, 3] = np.cumsum(rng.normal(0, 0.1, (50, 3)), axis=0)
    times = np.arange(50.0)

    def off(poses, metres):
        out = poses.copy()
        out[:, :3, 3] += np.cumsum(rng.normal(0, metres, (50, 3)), axis=0)
        return out

    def ate(a, b):
        return evaluate_trajectory(times, a, times, b)

    for _ in range(50):
        reference, estimate = off(truth, 0.01), off(truth, 0.005)
        low, high = ate(estimate, reference).ate_within(ate(reference, truth).ate_rms_m)
        assert low <= ate(estimate, truth).ate_rms_m <= high


@pytest.mark.parametrize("write", [euroc, orb_slam3])
def test_nanoseconds_may_begin_at_zero(write, tmp_path: Path) -> None:
    times = 5.0 * np.arange(5)
    write(tmp_path / "a.txt", times)
    read = read_poses(tmp_path / "a.txt")
    np.testing.assert_allclose(read.timestamps, times)
    np.testing.assert_allclose(read.poses, POSES, atol=1e-9)
