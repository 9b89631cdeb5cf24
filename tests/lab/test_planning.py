"""Plans: the scene of a scan, binned cameras, and decisions."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import tofuse
from tofuse.apps.cli.program import main
from tofuse.engine.errors import InputError
from tofuse.engine.fusion import Mesh
from tofuse.engine.geometry import se3
from tofuse.lab import planning
from tofuse.lab.simulation import CAMERAS, camera_model
from tofuse.lab.simulation.models import noise_of


def sheet() -> Mesh:
    """A square of 2 m at z = 2 m, facing the camera, one half four times as bright as the other."""
    x, y = (g.ravel() for g in np.meshgrid(*[np.linspace(-1, 1, 21)] * 2))
    vertices = np.stack([x, y, np.full(len(x), 2.0)], 1).astype(np.float32)
    k = np.arange(len(x)).reshape(21, 21)
    a, b, c, d = (each.ravel() for each in (k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]))
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)]).astype(np.int32)
    color = np.repeat(np.where(x > 0, 200, 50)[:, None], 3, 1).astype(np.uint8)
    zeros = np.zeros(len(x), np.float32)
    normals = np.tile(np.float32([0, 0, -1]), (len(x), 1))
    return Mesh(vertices, faces, normals, color, zeros, zeros.astype(np.int32))


def test_scene_has_the_surface_and_the_brightness_of_the_scan() -> None:
    scene = planning.scene_of(sheet())
    rays = np.array([[-0.3, 0.1, 1.0], [0.3, 0.1, 1.0], [0.0, 0.9, 1.0]])
    hits = scene.cast(np.zeros(3), rays / np.linalg.norm(rays, axis=1)[:, None])
    np.testing.assert_allclose(hits.distance[:2], 2 * np.linalg.norm(rays[:2], axis=1), rtol=1e-5)
    assert np.isinf(hits.distance[2])
    assert hits.albedo[1] == pytest.approx(4 * hits.albedo[0], rel=0.05)
    assert 0.1 < hits.albedo[0] < hits.albedo[1] < 0.9


@pytest.mark.parametrize("name", CAMERAS)
def test_binned_camera_sees_the_same_with_less_noise(name: str) -> None:
    model = camera_model(name)
    binned = model.binned(100)
    n = round(model.camera.width / 100)
    assert binned.camera.width == model.camera.width // n <= 150
    # The ray of a binned pixel is the mean of those that it sums.
    full, rays = model.camera.rays().astype(float), binned.camera.rays()
    row, column = binned.camera.height // 2, binned.camera.width // 2
    block = full[n * row : n * row + n, n * column : n * column + n]
    np.testing.assert_allclose(rays[row, column], block.mean((0, 1)), atol=1e-4)
    # Sums of n^2 pixels in the same counts, with 1 / n of the noise.
    law, single = noise_of(binned).range, noise_of(model).range
    np.testing.assert_allclose(
        np.array([*vars(law).values()]) * n, [*vars(single).values()], rtol=1e-6
    )
    wall = [m.signal_electrons * m.counts_per_electron for m in (model, binned)]
    assert wall[0] == pytest.approx(wall[1])


def test_planned_frames_are_as_dense_as_the_motion_needs() -> None:
    steps = np.concatenate([np.full(20, 0.05), np.zeros(30)])  # 1 m, then a rest
    poses = np.tile(np.eye(4), (51, 1, 1))
    poses[1:, 0, 3] = np.cumsum(steps)
    times = np.arange(51) / 10
    plan = planning._planned(
        planning.scene_of(sheet()), camera_model("sr4000"), poses, times, depth_m=2.0
    )
    moved = np.linalg.norm(np.diff(plan.poses[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(moved, 1 / 17, rtol=0.01)
    # The camera moves as fast as on the path while a frame is exposed.
    t = 8 / plan.sequence.frame_rate_hz
    before, after = (plan.sequence.T_room_camera(t + dt) for dt in (-0.01, 0.01))
    assert np.linalg.norm((se3.inverse(before) @ after)[:3, 3]) == pytest.approx(
        0.02 * 0.5, rel=0.05
    )


def test_decisions() -> None:
    assert planning._decision(0.0029, 0.005) == "enough"
    assert planning._decision(0.0045, 0.005) == "undecided"
    assert planning._decision(0.0075, 0.005) == "undecided"
    assert planning._decision(0.0087, 0.005) == "not enough"
    assert planning._decision(np.inf, 0.005) == "not enough"


def test_bad_input_is_named(room_result) -> None:
    result = tofuse.load(room_result)
    with pytest.raises(InputError, match="no camera called 'sr5000'"):
        planning.expect(result, ["sr5000"])
    with pytest.raises(InputError, match="the path: has fewer than two poses"):
        planning.expect(result, ["sr4000"], poses=np.eye(4)[None])
    far = result.trajectory.copy()
    far[:, :3, 3] = 1000 * (far[:, :3, 3] + 0.1)  # in mm
    with pytest.raises(InputError, match=r"the path: leads .* away from the scan"):
        planning.expect(result, ["sr4000"], poses=far)
    # Behind the walls, or turned away from what was scanned, as in the axes of another world.
    for motion in (se3.translation([0, 0, 3.0]), se3.exp([0, 0, 0, 0, np.pi, 0])):
        elsewhere = result.trajectory @ motion
        with pytest.raises(InputError, match=r"the path: looks elsewhere than the scan: \d+ %"):
            planning.expect(result, ["sr4000"], poses=elsewhere)
    with pytest.raises(InputError, match="has no surface"):
        planning.expect(replace(result, mesh=None))


def test_a_scan_of_an_object_is_planned_from_where_its_camera_was(room_result, monkeypatch) -> None:
    result = tofuse.load(room_result)
    outside = result.trajectory.copy()
    outside[:, :3, 3] += [0, 0, 50]

    def reached(_mesh) -> None:
        raise NotImplementedError

    monkeypatch.setattr(planning, "scene_of", reached)
    with pytest.raises(NotImplementedError):
        planning.expect(replace(result, trajectory=outside), ["sr4000"])


def test_poses_of_a_path_may_be_in_any_order(room_result, monkeypatch) -> None:
    planned = []

    def stopped(_scene, _model, path, times, _depth) -> None:
        planned.append((path, times))
        raise NotImplementedError

    monkeypatch.setattr(planning, "_planned", stopped)
    result = tofuse.load(room_result)
    order = np.random.default_rng(0).permutation(len(result.trajectory))
    for rows in (np.arange(len(order)), order):
        with pytest.raises(NotImplementedError):
            planning.expect(
                result, ["sr4000"], poses=result.trajectory[rows], times=result.timestamps[rows]
            )
    for ordered, shuffled in zip(*planned, strict=True):
        np.testing.assert_array_equal(ordered, shuffled)


def test_path_without_times_is_in_the_order_of_its_images(
    room_result, tmp_path, monkeypatch
) -> None:
    """COLMAP and NeRF list images in any order."""
    axes = np.diag([1.0, -1, -1, 1])
    frames = [
        {"file_path": f"{k}.png", "transform_matrix": (se3.translation([k, 0, 0]) @ axes).tolist()}
        for k in (2, 0, 1)
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    planned = []

    def stopped(_scan, _cameras, poses, **_) -> None:
        planned.append(poses[:, 0, 3])
        raise InputError("stopped")

    monkeypatch.setattr(planning, "expect", stopped)
    main(["plan", str(room_result), "--path", str(tmp_path / "transforms.json")])
    np.testing.assert_allclose(planned, [[0, 1, 2]])


def test_coverage_is_by_the_first_frame_that_has_a_pose(room_result) -> None:
    result = tofuse.load(room_result)
    model, poses, lost = result.mesh, result.trajectory, 5
    T = se3.inverse(poses[lost])
    moved = replace(
        result,
        mesh=replace(model, vertices=se3.transform(T, model.vertices).astype(np.float32)),
        trajectory=np.concatenate([np.full((lost, 4, 4), np.nan), T @ poses[lost:]]),
    )
    assert planning._coverage(model, moved, poses) > 0.99


@pytest.mark.nightly
def test_plan_of_the_room(room_result, capsys) -> None:
    status = main(
        ["plan", str(room_result), "--camera", "ifm-o3r", "--tolerance", "50mm", "--json"]
    )
    said = json.loads(capsys.readouterr().out)
    (camera,) = said["cameras"]
    assert said["tolerance_m"] == 0.05
    assert camera["camera"] == "ifm-o3r"
    assert camera["posed"] == 1
    assert camera["coverage"] > 0.6
    assert status == {"enough": 0, "not enough": 3, "undecided": 4}[camera["decision"]]
