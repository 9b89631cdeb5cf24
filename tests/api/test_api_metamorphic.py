"""What must not change poses: where the coordinates of clouds begin, and points that stray."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import tofuse
from cli_calls import refuses
from tofuse.apps.export import export
from tofuse.apps.results import load_result
from tofuse.engine.frames import CloudFrame, map_shift
from tofuse.engine.geometry import se3
from tofuse.formats.geometry import read_pcd, read_ply
from tofuse.formats.poses import read_tum, write_tum

MAP = np.array([500_000.0, 4_000_000.0, 100.0])
T_TARGET_SOURCE = se3.exp([0.3, 0.1, 0.0, 0.0, 0.0, 0.1])


def room(points: int = 3000) -> np.ndarray:
    """(N, 3) points of three walls and of boxes before them, m."""
    rng = np.random.default_rng(0)
    parts = []
    for axis in range(3):
        wall = rng.uniform(0, 1, (points, 3)) * [6, 5, 3]
        wall[:, axis] = 0
        parts.append(wall)
    for _ in range(6):
        box = rng.uniform(0, 1, (points // 4, 3))
        face = rng.integers(0, 3, len(box))
        box[np.arange(len(box)), face] = rng.integers(0, 2, len(box))
        parts.append(rng.uniform(0.5, 4, 3) * [1, 1, 0.3] + box * rng.uniform(0.2, 0.9, 3))
    return np.concatenate(parts)


def view(T_world_view: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    world = room()
    world = world[rng.choice(len(world), 4000, replace=False)]
    points = world + rng.normal(0, 0.003, world.shape)
    return se3.transform(se3.inverse(T_world_view), points)


SOURCE, TARGET = view(T_TARGET_SOURCE, 1), view(np.eye(4), 0)


def write(path: Path, points: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, points, fmt="%.4f")
    return path


def register(folder: Path, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the pose in the coordinates of the files, by the documented call on their frames."""
    files = write(folder / "source.xyz", source), write(folder / "target.xyz", target)
    registration = tofuse.register(*[tofuse.open(file)[0] for file in files])
    assert registration.believed
    return registration.T_target_source


@pytest.fixture(scope="module")
def pose(tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    T = register(tmp_path_factory.mktemp("plain"), SOURCE, TARGET)
    assert se3.is_within(se3.inverse(T_TARGET_SOURCE) @ T, 0.003, 0.003)
    return T


def agree(T: np.ndarray, expected: np.ndarray, at: np.ndarray | float = 0.0) -> None:
    """Both poses move the source's points, whose origin is `at`, to the same places."""
    points = SOURCE + at
    np.testing.assert_allclose(
        se3.transform(T, points), se3.transform(expected, points), rtol=0, atol=0.002
    )


@pytest.mark.parametrize(
    "shift", [(900, -300, 20), (7000, 0, 0), (20_000, 0, 0), MAP], ids=lambda s: f"{s[0]:.0f}"
)
def test_translating_both_clouds_translates_pose(tmp_path, pose, shift) -> None:
    shift = np.array(shift, float)
    agree(register(tmp_path, SOURCE + shift, TARGET + shift), se3.about(shift, pose), shift)


def test_translating_one_cloud_translates_pose(tmp_path, pose) -> None:
    T = register(tmp_path, SOURCE + MAP, TARGET)
    expected = pose.copy()
    expected[:3, 3] -= pose[:3, :3] @ MAP
    agree(T, expected, MAP)


@pytest.mark.parametrize(
    ("where", "stray"), [("source", 9e3), ("target", 2e4), ("both", 1e6), ("both", 1e8)]
)
def test_one_stray_point_changes_nothing(tmp_path, pose, where, stray) -> None:
    point = np.array([[stray, -0.5 * stray, 1.0]])
    source = np.concatenate([SOURCE, point]) if where != "target" else SOURCE
    target = np.concatenate([TARGET, point]) if where != "source" else TARGET
    agree(register(tmp_path, source, target), pose)


def test_missing_returns_at_zero_of_map_coordinates(tmp_path, pose) -> None:
    zero = np.zeros((1, 3))
    source, target = (np.concatenate([points + MAP, zero]) for points in (SOURCE, TARGET))
    agree(register(tmp_path, source, target), se3.about(MAP, pose), MAP)


def test_some_percent_of_stray_points(tmp_path, pose) -> None:
    strays = np.random.default_rng(3).normal(0, 3000, (len(SOURCE) // 50, 3))
    agree(register(tmp_path, np.concatenate([SOURCE, strays]), TARGET), pose)


def test_permuted_axes_permute_pose(tmp_path, pose) -> None:
    axes = [2, 0, 1]
    T = register(tmp_path, SOURCE[:, axes], TARGET[:, axes])
    P = np.eye(4)[[*axes, 3]]
    agree(P.T @ T @ P, pose)


def test_order_and_duplicates_of_points(tmp_path, pose) -> None:
    order = np.random.default_rng(4).permutation(len(SOURCE))
    agree(register(tmp_path, SOURCE[order], np.repeat(TARGET, 2, axis=0)), pose)


def test_arrays_in_map_coordinates(pose) -> None:
    T = tofuse.register(SOURCE + MAP, TARGET + MAP).T_target_source
    agree(T, se3.about(MAP, pose), MAP)


def test_guess_is_in_coordinates_of_files(tmp_path, pose) -> None:
    files = write(tmp_path / "a.xyz", SOURCE + MAP), write(tmp_path / "b.xyz", TARGET + MAP)
    source, target = (tofuse.open(file)[0] for file in files)
    T = tofuse.register(source, target, guess=se3.about(MAP, T_TARGET_SOURCE)).T_target_source
    agree(T, se3.about(MAP, pose), MAP)


POSES = np.stack([se3.exp(k * np.array([0.3, 0.1, 0, 0, 0, 0.1])) for k in range(3)])


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Results of three clouds: as they are, in map coordinates, and with a stray point."""
    views = [view(T, k) for k, T in enumerate(POSES)]
    stray = np.array([[1e6, 5e5, 0.0]])
    inputs = {
        "plain": views,
        "map": [points + MAP for points in views],
        "stray": [np.concatenate([views[0], stray]), *views[1:]],
    }
    saved = {}
    for name, clouds in inputs.items():
        folder = tmp_path_factory.mktemp(name)
        for k, points in enumerate(clouds):
            write(folder / "in" / f"{k}.xyz", points)
        tofuse.reconstruct(tofuse.open(folder / "in")).save(folder / "out")
        saved[name] = folder / "out"
    return saved


def test_run_writes_poses_in_coordinates_of_files(results) -> None:
    _, plain = read_tum(results["plain"] / "trajectory.txt")
    _, in_map = read_tum(results["map"] / "trajectory.txt")
    _, strayed = read_tum(results["stray"] / "trajectory.txt")
    np.testing.assert_array_equal(in_map[0], np.eye(4))
    for k in range(3):
        agree(in_map[k], se3.about(MAP, plain[k]), MAP)
        agree(strayed[k], plain[k])


def test_run_keeps_georeference_of_clouds(results, tmp_path) -> None:
    shift = json.loads((results["map"] / "run.json").read_text())["shift_m"]
    assert shift == np.round(shift).tolist()
    np.testing.assert_allclose(shift, MAP, rtol=0, atol=5)  # near the points
    plain = read_ply(results["plain"] / "cloud.ply").points
    assert plain.dtype == np.float32
    written = read_ply(results["map"] / "cloud.ply").points
    assert written.dtype == np.float64
    export(results["map"], ["pcd", "las"], tmp_path)
    exported = read_pcd(tmp_path / "cloud.pcd").cloud.points
    np.testing.assert_allclose(exported, written, rtol=0, atol=1e-6)
    las = pytest.importorskip("laspy").read(tmp_path / "cloud.las")
    np.testing.assert_allclose(las.xyz, written, rtol=0, atol=1e-4)
    spans = [np.percentile(points, [5, 95], axis=0) for points in (written - MAP, plain)]
    np.testing.assert_allclose(*spans, rtol=0, atol=0.1)


def test_clouds_with_different_shifts_make_one_model() -> None:
    """Where medians round to different metres."""
    views = [view(T, k) for k, T in enumerate(POSES[:2])]
    east = 500_000.5 - np.mean([np.median(points[:, 0]) for points in views])
    offset = np.array([east, 4_000_000, 100])
    clouds = [CloudFrame.of(p + offset, index=k, timestamp=k) for k, p in enumerate(views)]
    assert clouds[0].shift[0] != clouds[1].shift[0]
    mapper = tofuse.Mapper("default")
    for cloud in clouds:
        mapper.push(cloud)
    result = mapper.finish()
    np.testing.assert_array_equal(result.shift, clouds[0].shift)
    in_files = se3.about(result.shift, result.trajectory[1])
    agree(in_files, se3.about(offset, POSES[1]), offset)


def test_stray_point_leaves_cloud_as_dense(results) -> None:
    counts = [len(read_ply(results[n] / "cloud.ply").points) for n in ("plain", "stray")]
    assert counts[1] == pytest.approx(counts[0], rel=0.02)


def test_loaded_result_is_relative_to_its_shift(results) -> None:
    plain, in_map = (load_result(results[name]) for name in ("plain", "map"))
    assert np.abs(in_map.cloud.points).max() < 10
    np.testing.assert_allclose(
        in_map.trajectory, se3.about(MAP - in_map.shift, plain.trajectory), rtol=0, atol=2e-3
    )


def test_evaluation_of_right_result_in_map_coordinates(results, tmp_path) -> None:
    write_tum(tmp_path / "truth.txt", range(3), se3.about(MAP, POSES))
    assert tofuse.evaluate(results["map"], tmp_path / "truth.txt").error.ate_rms_m < 0.015


def test_shift_is_decided_by_the_median() -> None:
    points = np.random.default_rng(0).normal(0, 5, (1000, 3))
    points[:300] += 1e7
    assert not map_shift(points).any()
    centre = np.median(points[300:], axis=0) - MAP
    np.testing.assert_allclose(map_shift(points[300:] - MAP), centre, rtol=0, atol=0.5)
    np.testing.assert_allclose(map_shift(points - MAP), centre, rtol=0, atol=5)
    assert not map_shift(np.full((10, 3), np.nan)).any()
    frame = CloudFrame.of(points[300:] + MAP)
    np.testing.assert_allclose(frame.points + frame.shift, points[300:] + MAP, atol=1e-4)
    moved = frame.relative_to(frame.shift + 1000)
    np.testing.assert_allclose(moved.points + moved.shift, points[300:] + MAP, atol=1e-3)


def test_depth_in_map_coordinates_needs_sensor(tmp_path, capsys) -> None:
    """Points are not measured from the origin of a map."""
    for k, points in enumerate((SOURCE, TARGET)):
        write(tmp_path / "in" / f"{k}.xyz", points + MAP)
    with pytest.raises(tofuse.InputError, match=r"frame 0: is in map coordinates.*max_depth"):
        tofuse.open(tmp_path / "in", max_depth=5.0)[0]
    arguments = ["run", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--max-depth", "5"]
    refuses(capsys, *arguments, says="frame 0: is in map coordinates")
    assert not (tmp_path / "out").exists()
    seen = CloudFrame.of(SOURCE + MAP, origin=MAP)
    np.testing.assert_allclose(seen.radial_range, np.linalg.norm(SOURCE, axis=1), atol=1e-3)
