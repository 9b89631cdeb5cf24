"""Map consistency against its definition, for good and bad poses."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ray_casting import rays_at, to_walls
from tofuse.apps.jobs.evaluating import evaluate
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras.cameras import BrownConrady, Camera, Fisheye, Pinhole, Rational, RayTable
from tofuse.engine.compute.thread_pool import threads
from tofuse.engine.errors import InputError, UnreadableFrameError
from tofuse.engine.frames.frames import CloudFrame, Frame, RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording, evenly_spaced
from tofuse.engine.geometry import quaternion, se3
from tofuse.engine.quality.map_agreement import (
    Consistency,
    SurfaceImage,
    consistency_of_images,
    map_consistency,
)
from tofuse.formats.poses.trajectory import (
    associated_poses,
    interpolated_poses,
    write_tum,
)
from tofuse.formats.readers.native import NativeSource
from written_run_json import write_run

# A synthetic room, and poses in it -------------------------------------------------------------


HALF = np.array([2.0, 1.5, 2.5])  # of the edges of the room, round the origin


def path(n: int) -> Float64:
    xi = np.zeros((n, 6))
    xi[:, 0] = np.linspace(-0.3, 0.3, n)
    xi[:, 2] = -1.0
    xi[:, 3] = 0.05 * np.sin(np.arange(n))
    xi[:, 4] = np.linspace(-0.5, 0.5, n)
    return se3.exp(xi)


def look(camera: Camera, poses: Float64, noise: float = 0.004) -> list[RangeFrame]:
    rng = np.random.default_rng(0)
    frames = []
    for k, T in enumerate(poses):
        z, _ = to_walls(*rays_at(T, camera), -HALF, HALF)
        z = np.nan_to_num(z + noise * rng.standard_normal(z.shape))
        z[rng.random(z.shape) < 0.05] = 0
        z = np.rint(z / 0.0005) * 0.0005
        frames.append(RangeFrame(k, k / 10, camera, z.astype(np.float32)))
    return frames


PINHOLE = Pinhole(80, 60, 70.0, 71.0, 39.2, 30.1)


def test_images_use_self_calibrated_camera_of_result(tmp_path: Path) -> None:
    """Frames state a focal length 5 % too large, which the result has corrected."""
    poses = path(12)
    wrong = replace(PINHOLE, fx=PINHOLE.fx * 1.05, fy=PINHOLE.fy * 1.05)
    frames = [replace(frame, camera=wrong) for frame in look(PINHOLE, poses, 0.0)]
    recording = Recording.of(ArraySource(frames), "room", "test")
    times = np.arange(12) / 10
    write_tum(tmp_path / "trajectory.txt", times, poses)
    write_tum(tmp_path / "true.txt", times, poses)
    frames = [{"index": k, "timestamp": t} for k, t in enumerate(times.tolist())]
    found = []
    for focal in (0.0, 0.05):
        config = {"corrections": [{"part": "camera-errors", "focal": focal, "offset_m": 0.0}]}
        write_run(tmp_path, frames=frames, config=config)
        for estimate in (tmp_path, tmp_path / "trajectory.txt"):
            score = evaluate(estimate, tmp_path / "true.txt", recording=recording).consistency
            found.append(score.rms_m)
        alone = evaluate(poses, tmp_path / "true.txt", recording=recording, config=config)
        assert alone.consistency.rms_m == pytest.approx(found[-1])
    assert found[0] == found[1] > 3 * found[2] == 3 * found[3]
    write_run(tmp_path, frames=frames, config={"corrections": [7]})
    with pytest.raises(InputError, match="is damaged"):
        evaluate(tmp_path, tmp_path / "true.txt", recording=recording)


# A slow reference implementation of the definition ---------------------------------------------


def twin(frames: list[RangeFrame], poses: Float64) -> tuple[float, float, int]:
    images = []
    for f in frames:
        rays = f.camera.rays().astype(float)
        z = f.depth.astype(float)
        if f.depth_kind == "range":
            z = z / np.sqrt(1 + (rays**2).sum(-1))
        z = np.where(np.isfinite(rays).all(-1) & (z >= 0.1) & (z <= 12), z, 0)
        step = 1
        while z.shape[1] // step > 320:
            step *= 2
        P = np.nan_to_num(np.dstack([rays * z[..., None], z]))[::step, ::step]
        N = np.zeros_like(P)
        for i in range(2, P.shape[0] - 2):
            for j in range(2, P.shape[1] - 2):
                right, left, down, up = P[i, j + 2], P[i, j - 2], P[i + 2, j], P[i - 2, j]
                c = P[i, j, 2]
                if c > 0 and all(
                    q[2] > 0 and abs(q[2] - c) <= 0.05 * c for q in (right, left, down, up)
                ):
                    n = np.cross(right - left, down - up)
                    if np.linalg.norm(n) > 0:
                        N[i, j] = n / np.linalg.norm(n)
        images.append((P, N, f.camera, step))

    def land(a: Any, b: Any, T_a_b: Float64) -> Any:
        p = b[0][b[0][..., 2] > 0]
        q = se3.transform(T_a_b, p)
        uv = np.rint(a[2].project(q) / a[3])
        h, w = a[0].shape[:2]
        with np.errstate(invalid="ignore"):
            inside = (q[:, 2] > 0.05) & (uv >= 0).all(1) & (uv[:, 0] < w) & (uv[:, 1] < h)
        u, v = uv[inside].astype(int).T
        q = q[inside]
        known = a[0][v, u, 2] > 0
        q, u, v = q[known], u[known], v[known]
        return q, a[0][v, u], a[1][v, u], (np.abs(q[:, 2] - a[0][v, u, 2]) < 0.25).sum() / len(p)

    squares, inliers, compared, pairs = 0.0, 0, 0, 0
    for i, a in enumerate(images):
        for j in range(i + 1, len(images)):
            T = np.linalg.inv(poses[i]) @ poses[j]
            q, at, n, forth = land(a, images[j], T)
            if min(forth, land(images[j], a, np.linalg.inv(T))[3]) < 0.35:
                continue
            has = (n != 0).any(1)
            near = has & (np.linalg.norm(q - at, axis=1) <= 0.10)
            squares += ((n * (q - at)).sum(1)[near] ** 2).sum()
            inliers, compared, pairs = inliers + near.sum(), compared + has.sum(), pairs + 1
    return float(np.sqrt(squares / inliers)), inliers / compared, pairs


def ray_table() -> RayTable:
    return RayTable(BrownConrady(40, 30, 36.0, 36.0, 19.0, 15.0, k1=-0.15, k2=0.03).rays())


def consistency_of_frames(frames, poses) -> Consistency:
    T = np.asarray(poses, float)
    posed = np.flatnonzero(np.isfinite(T).all((1, 2)))
    return consistency_of_images([SurfaceImage.of(frames[k]) for k in posed], T[posed])


@pytest.mark.parametrize(
    "camera",
    [
        Pinhole(40, 30, 36.0, 37.0, 19.0, 15.0),
        BrownConrady(40, 30, 36.0, 36.0, 19.0, 15.0, k1=-0.12, k2=0.02, p1=0.004, p2=-0.003),
        Rational(40, 30, 36.0, 36.0, 19.0, 15.0, k1=0.4, k2=-0.1, k3=0.01, k4=0.6, k5=-0.05),
        Fisheye(40, 30, 30.0, 30.0, 19.0, 15.0, k1=0.02, k2=-0.01, k3=0.002, k4=0.001),
        ray_table(),
        Pinhole(642, 40, 400.0, 400.0, 320.0, 20.0),  # every fourth pixel
    ],
    ids=["pinhole", "brown", "rational", "fisheye", "rays", "wide"],
)
def test_every_camera_model_matches_definition(camera: Camera) -> None:
    poses = path(5)
    frames = look(camera, poses)
    bent = poses @ se3.exp(0.004 * np.random.default_rng(1).standard_normal((5, 6)))
    rms, share, pairs = twin(frames, bent)
    found = consistency_of_frames(frames, bent)
    assert found.pairs == pairs > 3
    assert found.rms_m == pytest.approx(rms, rel=1e-4)
    assert found.inlier_ratio == pytest.approx(share, rel=1e-3)


def test_worse_poses_are_less_consistent() -> None:
    """Consistency ranks trajectories without a reference."""
    poses = path(8)
    frames = look(PINHOLE, poses)
    twists = np.random.default_rng(2).standard_normal((8, 6))
    results = [consistency_of_frames(frames, poses @ se3.exp(s * twists)) for s in (0, 0.01, 0.03)]
    assert results[0].rms_m < results[1].rms_m < results[2].rms_m
    assert results[0].inlier_ratio > results[1].inlier_ratio > results[2].inlier_ratio


def test_consistency_is_independent_of_threads_and_world_frame() -> None:
    poses = path(8)
    frames = look(PINHOLE, poses)
    with threads(1):
        one = consistency_of_frames(frames, poses)
    with threads(3):
        assert consistency_of_frames(frames, poses) == one
    moved = consistency_of_frames(frames, se3.exp([1, 2, 3, 0.4, 0.5, 0.6]) @ poses)
    assert moved.rms_m == pytest.approx(one.rms_m, rel=1e-3)


def test_views_without_overlap_have_no_pairs() -> None:
    away = np.stack([np.eye(4), se3.exp([0, 0, 0, 0, np.pi, 0])])
    found = consistency_of_frames(look(PINHOLE, away), away)
    assert found.pairs == 0
    plain = found.to_dict()
    assert plain == {"rms_m": None, "inlier_share": None, "pairs": 0, "frames": 2}
    json.dumps(plain, allow_nan=False)
    empty = [RangeFrame(k, k, PINHOLE, np.zeros((60, 80), np.float32)) for k in range(2)]
    assert consistency_of_frames(empty, away).pairs == 0
    assert consistency_of_frames([], np.zeros((0, 4, 4))).pairs == 0


# Recordings ------------------------------------------------------------------------------------


class Unreadable(ArraySource):
    def read(self, index: int) -> Frame:
        if index == 2:
            raise UnreadableFrameError("is cut off", where="depth/000002.png")
        return super().read(index)


def test_lost_and_unreadable_frames_are_skipped() -> None:
    poses = path(6)
    frames = look(PINHOLE, poses)
    given = poses.copy()
    given[4] = np.nan
    found = map_consistency(Recording.of(Unreadable(frames), "x", "test"), given)
    rest = [0, 1, 3, 5]
    assert found == consistency_of_frames([frames[k] for k in rest], poses[rest])
    assert found.frames == 4


def test_invalid_input_is_rejected() -> None:
    clouds = [CloudFrame.of(np.ones((4, 3)), index=k) for k in range(2)]
    recording = Recording.of(ArraySource(clouds), "clouds", "test")
    with pytest.raises(InputError, match="clouds: contains clouds"):
        map_consistency(recording, path(2))
    with pytest.raises(InputError, match="for 2 frames"):
        map_consistency(recording, path(3))
    with pytest.raises(InputError, match="frames: is 0"):
        map_consistency(recording, path(2), frames=0)


def test_frames_are_sampled_evenly() -> None:
    assert evenly_spaced(np.arange(10), 100).tolist() == list(range(10))
    assert evenly_spaced(np.arange(101), 5).tolist() == [0, 25, 50, 75, 100]
    assert evenly_spaced(np.array([3, 8, 9]), 2).tolist() == [3, 9]
    assert evenly_spaced(np.arange(0), 5).tolist() == []
    assert evenly_spaced("abcde", 3) == ["a", "c", "e"]


def test_poses_are_assigned_to_nearest_frame() -> None:
    T = path(4)
    out = associated_poses([0.0, 0.1, 0.2], [0.09, 0.105, 0.219, 0.35], T)
    assert np.isnan(out[0]).all()
    assert np.array_equal(out[1], T[1])  # the last of two poses for it
    assert np.array_equal(out[2], T[2])


def test_odometry_is_interpolated_between_its_poses() -> None:
    """The clocks of wheels and of a camera don't tick together."""
    T = path(5)
    times = [0.0, 0.2, 0.4, 1.2, 1.4]  # a gap of 0.8 s
    order = [3, 0, 4, 1, 2]
    at = [-0.03, -0.01, 0.0, 0.05, 0.4, 0.6, 1.3, 1.41, 1.5]
    out = interpolated_poses(at, np.array(times)[order], T[order])
    unknown = np.isnan(out).all((1, 2))
    assert unknown.tolist() == [True, False, False, False, False, True, False, False, True]
    np.testing.assert_allclose(out[[1, 2, 4, 7]], T[[0, 0, 2, 4]], atol=1e-12)
    quarter, half = se3.log(se3.inverse(T[[0, 3]]) @ out[[3, 6]])
    np.testing.assert_allclose(quarter, 0.25 * se3.log(se3.inverse(T[0]) @ T[1]), atol=1e-9)
    np.testing.assert_allclose(half, 0.5 * se3.log(se3.inverse(T[3]) @ T[4]), atol=1e-9)
    assert np.isnan(interpolated_poses(at, [], np.zeros((0, 4, 4)))).all()


def test_missing_pose_of_odometry_stays_missing() -> None:
    """Poses at every second image are interpolated, but one that is missing among others isn't."""
    T, images = path(9), np.arange(9) / 10
    odometry_at = partial(interpolated_poses, over_gaps=False)
    slow = odometry_at(images, images[::2], T[::2])
    assert np.isfinite(slow).all()
    known = np.arange(9) != 4
    assert np.isnan(odometry_at(images, images[known], T[known])).all((1, 2)).tolist() == [
        k == 4 for k in range(9)
    ]
    # The nearest pose, in such a gap, and if there are too few to know their interval.
    near = odometry_at(images, images[known] - 0.015, T[known])
    np.testing.assert_array_equal(near[3], T[3])
    two = odometry_at(images[:3], images[[0, 2]], T[[0, 2]])
    assert np.isnan(two).all((1, 2)).tolist() == [False, True, False]


def test_depths_are_requantized_to_recording_unit() -> None:
    """Neighbours that differ by exactly 5 % are classified as in double precision."""
    camera = Pinhole(60, 40, 50.0, 50.0, 30.0, 20.0)
    base = 20 * np.arange(30, 620)
    unit = 0.0002

    def known(depth: Float64, given: float | None) -> int:
        f = RangeFrame(0, 0.0, camera, np.asarray(depth, np.float32))
        return int((SurfaceImage.of(f, given).normals != 0).any(-1).sum())

    differ = 0
    for k in base[::7]:
        counts = np.full((40, 60), k)
        counts[:, 30:] = k + k // 20
        z = counts * unit
        c, n = z[0, 0], z[0, 59]
        exact = bool(abs(n - c) <= 0.05 * c)
        assert known(z, unit) == (36 * 56 if exact else 36 * 54)
        differ += known(z, None) != known(z, unit)
    assert differ > 0  # otherwise the test would be vacuous


# The reference tool ----------------------------------------------------------------------------


# The reference tool ----------------------------------------------------------------------------


def by_tool(shared_data: Path, recording: Path, trajectory: Path, frames: int) -> str:
    tool = shared_data.parent / "tools" / "map_consistency.py"
    if not tool.is_file():
        pytest.skip("the tool that defines map consistency is not on this machine")
    done = subprocess.run(
        [sys.executable, str(tool), str(recording), str(trajectory), "--frames", str(frames)],
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


def tool_format(found: Consistency) -> str:
    return f"rms {found.rms_m:.5f} m, inliers {found.inlier_ratio:.4f}, pairs {found.pairs}"


def ours(recording: Path, trajectory: Path, frames: int) -> Consistency:
    opened = Recording.of(NativeSource(recording), recording, "native")
    rows = np.loadtxt(trajectory)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = quaternion.to_matrix(rows[:, 4:8])
    poses[:, :3, 3] = rows[:, 1:4]
    return map_consistency(opened, associated_poses(opened.timestamps, rows[:, 0], poses), frames)


@pytest.mark.nightly
def test_output_matches_reference_tool_on_real_loop(shared_data: Path) -> None:
    recording = shared_data / "kinectv2_loop" / "recording"
    trajectory = recording / "reference_poses.txt"
    expected = by_tool(shared_data, recording, trajectory, 9)
    assert tool_format(ours(recording, trajectory, 9)) == expected
