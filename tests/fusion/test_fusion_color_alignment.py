"""Alignment of a texture's images with each other, at perturbed poses of the images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from test_fusion_texture import CAMERA, sheet

from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.fusion.color_alignment import Shown, aligned_poses
from tofuse.engine.fusion.texture import TextureView, _Seen, textured
from tofuse.engine.geometry import se3
from tofuse.engine.geometry.rays import homogeneous

WALL = sheet(61, 45, 0.03)
POSES = se3.exp(
    [[x, y, 0.1 * abs(x), 0.3 * y, -0.4 * x, 0.0] for x in (-0.3, 0, 0.3) for y in (-0.15, 0.15)]
)
ERRORS = np.random.default_rng(3).normal(0, [0.004] * 3 + [0.004] * 3, (len(POSES), 6))


def light(points: np.ndarray) -> np.ndarray:
    """Grey levels (...) of the wall: waves of 6 to 60 cm in random directions."""
    rng = np.random.default_rng(0)
    waves = 2 * np.pi / rng.uniform(0.06, 0.6, 40)
    angle, phase = rng.uniform(0, 2 * np.pi, (2, 40))
    along = points[..., :1] * np.cos(angle) + points[..., 1:2] * np.sin(angle)
    return 120 + 8 * np.sin(waves * along + phase).sum(-1)


def look(T: np.ndarray, fine: int = 4, gain: float = 1.0) -> tuple[RangeFrame, np.ndarray]:
    """A frame of the wall at z = 2 m, and its image at `fine` times the resolution."""
    v, u = np.mgrid[: 60 * fine, : 80 * fine]
    pixels = (np.stack([u, v], -1) + 0.5) / fine - 0.5
    rays = (pixels - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    away = homogeneous(rays) @ T[:3, :3].T
    z = (2.0 - T[2, 3]) / away[..., 2]
    grey = np.round(gain * light(away * z[..., None] + T[:3, 3])).clip(1, 255).astype(np.uint8)
    image = np.repeat(grey[..., None], 3, -1)
    depth = z.reshape(60, fine, 80, fine).mean((1, 3)).astype(np.float32)
    small = image[fine // 2 :: fine, fine // 2 :: fine]
    return RangeFrame(0, 0.0, CAMERA, depth, color_image=small), image


def views(gains=(1.0, 1.3, 0.8, 1.0, 0.7, 1.1)) -> list[TextureView]:
    return [TextureView.of(*look(T, gain=g)) for T, g in zip(POSES, gains, strict=True)]


def relative_errors(poses: np.ndarray) -> np.ndarray:
    """Rotations (rad) and translations (m) of errors relative to the first view's."""
    error = se3.log(se3.inverse(se3.inverse(POSES[0]) @ POSES) @ (se3.inverse(poses[0]) @ poses))
    return np.stack([np.linalg.norm(error[1:, k : k + 3], axis=1) for k in (3, 0)], -1)


def shift(poses: np.ndarray) -> float:
    """Median distance, in m, between what two views show of the same point of the wall."""
    spots = WALL.vertices[:: len(WALL) // 200].astype(float)
    at = []
    for T, estimate in zip(POSES, poses, strict=True):
        seen = se3.transform(T @ se3.inverse(estimate), spots) - T[:3, 3]
        at.append(T[:3, 3] + seen * (2.0 - T[2, 3]) / seen[..., 2:])
    return float(np.median(np.linalg.norm(np.std(at, axis=0), axis=-1)))


def test_alignment_brings_back_perturbed_poses() -> None:
    perturbed = POSES @ se3.exp(ERRORS)
    made = _Seen.of(WALL, views(), perturbed).aligned(WALL)
    assert shift(perturbed) > 0.005
    assert shift(made.poses) < 0.001
    assert relative_errors(made.poses)[:, 0].mean() < 0.5 * relative_errors(perturbed)[:, 0].mean()
    # True poses stay.
    assert shift(_Seen.of(WALL, views(), POSES).aligned(WALL).poses) < 0.0003


def test_texture_of_perturbed_poses_is_as_sharp_as_of_true_ones() -> None:
    def error(poses: np.ndarray) -> float:
        charts = textured(WALL, views([1.0] * 6), poses, 1024).charts
        inner = (np.abs(charts.vertices[:, :2]) < [0.6, 0.4]).all(1)
        truth = light(charts.vertices.astype(float))
        return float(np.abs(charts.color[inner, 0] - truth[inner]).mean())

    perturbed = POSES @ se3.exp(ERRORS - ERRORS.mean(0))
    assert error(perturbed) < 1.2 * error(POSES)  # 2.6 times without alignment


def test_images_that_do_not_agree_keep_their_poses() -> None:
    """Neither noise nor an image without contrast is aligned, nor a pose moved far."""
    seen = _Seen.of(WALL, views(), POSES)
    rng = np.random.default_rng(0)
    noise = [
        replace(v, image=rng.integers(0, 255, v.image.shape).astype(np.uint8)) for v in seen.views
    ]
    flat = [replace(v, image=np.full_like(v.image, 90)) for v in seen.views]
    np.testing.assert_allclose(replace(seen, views=flat).aligned(WALL).poses, POSES, atol=1e-9)
    moved = se3.log(se3.inverse(POSES) @ replace(seen, views=noise).aligned(WALL).poses)
    assert np.abs(moved).max() < 0.04
    # An image far from its place moves little, and does not drag the others along.
    far = np.zeros_like(ERRORS)
    far[1, 1] = 0.2
    made = _Seen.of(WALL, views(), POSES @ se3.exp(far)).aligned(WALL).poses
    moved = se3.log(se3.inverse(POSES @ se3.exp(far)) @ made)
    assert np.abs(moved[1]).max() < 0.04
    others = np.arange(len(POSES)) != 1
    assert np.abs(moved[others]).max() < 0.005


def test_a_single_view_and_points_that_one_view_shows_are_left_alone() -> None:
    one = _Seen.of(WALL, views()[:1], POSES[:1])
    assert one.aligned(WALL) is one
    nothing = Shown(
        views()[0].image,
        views()[0].projection,
        np.zeros(len(WALL), bool),
        np.zeros((len(WALL), 2), np.float32),
    )
    np.testing.assert_array_equal(aligned_poses(WALL.vertices, POSES[:2], [nothing] * 2), POSES[:2])
