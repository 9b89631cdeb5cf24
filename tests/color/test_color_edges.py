"""Colour over a bare floor: it measures what depth leaves open, and says how well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from ray_casting import rays_at
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import Pinhole
from tofuse.engine.color import ColorView, measured_pairs, with_color
from tofuse.engine.color.color_views import SEARCHES
from tofuse.engine.compute import threads
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.graph import Measured, PoseGraph, build_graph
from tofuse.engine.graph.graph_covariances import GraphCovariances
from tofuse.engine.graph.levenberg import LevenbergMarquardt
from tofuse.engine.mapping.color_frames import ColorFrames
from tofuse.engine.mapping.reconstructing import reconstruct

DEPTH, COLOR = (
    Pinhole(128, 96, 120.0, 120.0, 63.5, 47.5),
    Pinhole(512, 384, 480.0, 480.0, 255.5, 191.5),
)
TEXEL_M = 0.004
# One standard deviation of the edges by depth, m and rad: of a floor, x, y and yaw are open.
OPEN, CLOSED = (0.03, 0.02), (0.002, 0.001)
DOWN = np.diag([1.0, -1.0, -1.0, 1.0])


def texture(rng: np.random.Generator) -> Float64:
    """(H, W) grey levels with details of several sizes."""
    shape = 1000, 1000
    layers = [gaussian_filter(rng.standard_normal(shape), s, mode="wrap") for s in (1.5, 4, 12)]
    return 120 + 40 * np.asarray(sum(layer / layer.std() for layer in layers)) / 2


def floor_view(
    k: int, T: Float64, floor: Float64 | None, rng: np.random.Generator
) -> tuple[RangeFrame, Float64]:
    """Return the depth of a floor at z = 0 and its colour; without texture only noise."""
    frames = []
    for camera in (DEPTH, COLOR):
        origin, directions = rays_at(T, camera)
        z = -origin[2] / directions[..., 2]
        frames.append((z, origin + directions * z[..., None]))
    image = np.full((COLOR.height, COLOR.width), 120.0)
    if floor is not None:
        places = np.moveaxis(frames[1][1][..., :2], 2, 0) / TEXEL_M + 500
        image = map_coordinates(floor, places, order=1, mode="wrap")
    image += rng.normal(0, 2, image.shape)
    z = frames[0][0] * (
        1 + 0.003 * gaussian_filter(rng.standard_normal(frames[0][0].shape), 8) * 28
    )
    color = np.repeat(image.clip(0, 255).astype(np.uint8)[..., None], 3, 2)
    return RangeFrame(k, 0.1 * k, DEPTH, z.astype(np.float32)), color


def walk(count: int = 8) -> Float64:
    """(N, 4, 4) true poses above a floor."""
    poses = []
    for k in range(count):
        T = se3.translation((0.08 * k, 0.03 * np.sin(k), 1.4))
        turn = se3.exp(
            [0, 0, 0, 0.3 + 0.05 * np.sin(2 * k), 0.05 * np.cos(k), 0.12 * np.sin(k / 2)]
        )
        poses.append(T @ DOWN @ turn)
    return np.stack(poses)


def drifted(truth: Float64, rng: np.random.Generator) -> PoseGraph:
    """Return a chain of edges with random errors that are large along the floor."""
    edges, poses = [], [truth[0]]
    for k in range(1, len(truth)):
        # Covariance in the floor's frame, as a right perturbation in that of camera k.
        sigma = np.array([OPEN[0], OPEN[0], CLOSED[0], CLOSED[1], CLOSED[1], OPEN[1]])
        A = np.zeros((6, 6))
        A[:3, :3] = A[3:, 3:] = truth[k][:3, :3].T
        C = A @ np.diag(sigma**2) @ A.T
        error = A @ (sigma * rng.standard_normal(6))
        measured = se3.inverse(truth[k - 1]) @ truth[k] @ se3.exp(error)
        edges.append(Measured(k - 1, k, measured, np.linalg.inv(C)))
        poses.append(poses[-1] @ measured)
    return build_graph(list(range(len(truth))), np.stack(poses), edges)


def scene(seed: int, *, textured: bool = True) -> tuple[PoseGraph, list[ColorView], Float64]:
    """Return a drifted graph, views and true poses."""
    rng = np.random.default_rng(seed)
    truth = walk()
    floor = texture(rng) if textured else None
    views = [ColorView.of(*floor_view(k, T, floor, rng)) for k, T in enumerate(truth)]
    return drifted(truth, rng), views, truth


def floor_errors(poses: Float64, truth: Float64) -> Float64:
    """(N, 6) errors of poses as right perturbations; the first pose is the true one."""
    return se3.log(se3.inverse(poses) @ truth)


@pytest.mark.parametrize("seed", range(3))
def test_colour_measures_the_motion_along_a_bare_floor(seed: int) -> None:
    graph, views, truth = scene(seed)
    refined, edges = with_color(graph, views, LevenbergMarquardt())
    assert len(edges) >= 7
    before, after = (np.abs(floor_errors(g.poses, truth)).max(0) for g in (graph, refined))
    assert np.linalg.norm(before[:3]) > 0.03
    assert np.linalg.norm(after[:3]) < 0.3 * np.linalg.norm(before[:3])
    assert np.degrees(np.linalg.norm(after[3:])) < 0.3


def test_stated_covariance_shrinks_and_holds() -> None:
    squared = []
    for seed in range(3):
        graph, views, truth = scene(seed)
        refined, _ = with_color(graph, views, LevenbergMarquardt())
        C = GraphCovariances(refined).of_poses[1:]
        of_depth = GraphCovariances(graph).of_poses[1:]
        assert (np.trace(C, axis1=1, axis2=2) < 0.3 * np.trace(of_depth, axis1=1, axis2=2)).all()
        e = floor_errors(refined.poses, truth)[1:]
        squared.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(C), e) / 6)
    assert 0.05 < np.mean(squared) < 2.5


def test_shutter_that_rolls_is_in_the_covariance() -> None:
    _, views, truth = scene(0)
    moving = [replace(view, speed=(0.3, 0.5)) for view in views]
    of_still, of_moving = (
        [m.information for m in measured_pairs(v, truth, SEARCHES[1])] for v in (views, moving)
    )
    assert len(of_still) >= 7
    for still, moved in zip(of_still, of_moving, strict=True):
        sigma = np.sqrt(np.diag(np.linalg.inv(moved)) - np.diag(np.linalg.inv(still)))
        # Both cameras of a pair move while their rows are read, within 20 ms.
        assert sigma[3:] == pytest.approx(np.sqrt(2) * 0.5 * 0.02 / np.sqrt(12), rel=0.1)
        # Rotations of one camera displace the other, too.
        assert (sigma[:3] > 0.95 * np.sqrt(2) * 0.3 * 0.02 / np.sqrt(12)).all()
        assert (sigma[:3] < 0.008).all()


def test_noise_without_texture_measures_nothing() -> None:
    graph, views, _ = scene(0, textured=False)
    refined, edges = with_color(graph, views, LevenbergMarquardt())
    assert edges == ()
    assert refined is graph


def test_repeated_pattern_does_not_mislead() -> None:
    graph, views, truth = scene(0)
    # One view shows another place: the same pattern, a metre away.
    rng = np.random.default_rng(0)
    elsewhere = truth[4].copy()
    elsewhere[:3, 3] += 0.15, 0.1, 0.0
    _, color = floor_view(4, elsewhere, texture(rng), rng)
    frame, _ = floor_view(4, truth[4], None, rng)
    views[4] = ColorView.of(frame, color)
    refined, edges = with_color(graph, views, LevenbergMarquardt())
    assert not any(4 in (m.i, m.j) for m in edges) or len(edges) >= 7
    after = floor_errors(refined.poses, truth)[np.delete(np.arange(len(truth)), 4)]
    assert np.linalg.norm(after[:, :3], axis=1).max() < 0.03


def test_any_number_of_threads_gives_the_same() -> None:
    graph, views, _ = scene(0)
    results = []
    for count in (1, 3):
        with threads(count):
            results.append(with_color(graph, views, LevenbergMarquardt())[0])
    assert np.array_equal(results[0].poses, results[1].poses)
    assert np.array_equal(results[0].information, results[1].information)


def test_recording_without_colour_is_not_read_again(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    frames = [floor_view(k, T, None, rng)[0] for k, T in enumerate(walk(4))]
    called = []
    monkeypatch.setattr(ColorFrames, "views", lambda *args: called.append(args) or [])
    reconstruct(Recording.of(ArraySource(frames), "floor", "arrays"))
    assert not called
